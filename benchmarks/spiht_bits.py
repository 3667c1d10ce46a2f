"""Count SPIHT's decisions and the bits that adaptive models code them in.

``python -m benchmarks.spiht_bits DEM.tif …``. One raw bit for each decision is SPIHT without
arithmetic coding. Rasters with voids are left out: here nothing fills them.
"""

from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

from benchmarks.lists import ListCommand
from benchmarks.rasters import Raster, find_rasters, load_raster
from benchmarks.report import CsvSink
from terrainwave.codec.spiht import encode_field
from terrainwave.coding.lifting53 import forward_transform


@dataclass(frozen=True)
class Row:
    """One line of the CSV: bits per sample of a raster coded as one tile without loss."""

    raster: str
    n_rows: int
    n_cols: int
    raw_bits: float
    coded_bits: float


def measure(raster: Raster) -> Row:
    """Transform a raster down to one sample and code it."""
    field = raster.heights.astype(np.int64)
    n_transforms = (max(field.shape) - 1).bit_length()
    forward_transform(field, n_transforms, 0)
    coded = encode_field(field, n_transforms)
    return Row(
        raster=raster.name,
        n_rows=field.shape[0],
        n_cols=field.shape[1],
        raw_bits=round(coded.n_decisions / field.size, 4),
        coded_bits=round(8 * len(coded.stream) / field.size, 4),
    )


@click.command(cls=ListCommand)
@click.argument("places", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--crop", type=click.IntRange(min=2), default=1025, show_default=True)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("benchmarks/results/spiht_bits.csv"),
    show_default=True,
)
def main(places, crop, out) -> None:
    """Measure the integer GeoTIFFs in PLACES, their upper left CROP × CROP samples."""
    with CsvSink(out, Row) as sink:
        for path in find_rasters(list(places)):
            raster = load_raster(path, crop)
            if not (raster.is_integer and raster.mask.all()):
                continue
            row = measure(raster)
            sink.write(row)
            click.echo(f"{row.raster:32} {row.raw_bits:.4f} raw, {row.coded_bits:.4f} coded")


if __name__ == "__main__":
    main()
