"""What levels and shared borders cost: ``python -m benchmarks.pyramid_cost DEM.tif ...``.

The format has one root block, so that a raster larger than a block has several levels. Here the
quadtree is told to allow as many roots as there are blocks: ``one_level`` is the two-stage 9/7
coder on the full grid alone, in blocks of 1024 cells that share their borders. Such files are
only counted, no reader takes them. ``pyramid`` is the closed pyramid of Yusov & Turlapov 2010 over
the same samples, in blocks of 256. Border rings 3 is their matching region of three contours, 1 the
default.

Exit status: 0 good; 2 wrong usage.
"""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import click

import terrainwave
from benchmarks.report import CsvSink
from terrainwave.grid import quadtree

BOUNDS = (1.0, 3.0, 10.0)
ROOTS_WITHOUT_LEVELS = 1 << 31  # per side: as many as the longest raster has samples


@dataclass(frozen=True)
class Row:
    """One line of the CSV, bits per sample of whole files."""

    raster: str
    max_error: float
    one_level: float
    pyramid: float
    pyramid_rings_3: float
    cost_of_pyramid_percent: float
    cost_of_rings_3_percent: float


def bits(source: Path, directory: Path, max_error: float, block: int, border_rings: int) -> float:
    """Return bits per sample of a file made with these options."""
    result = terrainwave.compress(
        source,
        directory / "x.twz",
        max_error=max_error,
        method="cdf97",
        block=block,
        border_rings=border_rings,
        verify=False,
        overwrite=True,
    )
    return result.bits_per_sample


@click.command(help=__doc__)
@click.argument("rasters", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), default="benchmarks/results/pyramid.csv")
def main(rasters: tuple[Path, ...], out: Path) -> None:
    """Measure, print and write the CSV."""
    with tempfile.TemporaryDirectory() as name, CsvSink(out, Row) as sink:
        for raster in rasters:
            for bound in BOUNDS:
                with patch.object(quadtree, "MAX_ROOTS_PER_SIDE", ROOTS_WITHOUT_LEVELS):
                    one = bits(raster, Path(name), bound, 1024, 1)
                pyramid = bits(raster, Path(name), bound, 256, 1)
                rings = bits(raster, Path(name), bound, 256, 3)
                row = Row(
                    raster.stem,
                    bound,
                    round(one, 4),
                    round(pyramid, 4),
                    round(rings, 4),
                    round(100 * (pyramid / one - 1), 1),
                    round(100 * (rings / pyramid - 1), 1),
                )
                sink.write(row)
                print(row)


if __name__ == "__main__":
    sys.exit(main())
