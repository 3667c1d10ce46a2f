"""Compare method cdf53 with JPEG 2000's 5/3: ``python -m benchmarks.embedded DEM.tif …``.

Lossless sizes and, with --rate, the error of streams cut to so many bits per sample. The peer is
OpenJPEG by GDAL's driver, one tile, as a bare code stream; of several fills for voids the best,
with the mask charged. Its irreversible 9/7 stands beside it: cdf53 is no match for that.
"""

import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from rasterio.errors import NotGeoreferencedWarning
from rasterio.io import MemoryFile

import terrainwave
from benchmarks.lists import ListCommand, ListOption
from benchmarks.rasters import Forms, Raster, find_rasters, load_raster, make_forms, write_geotiff
from benchmarks.report import CsvSink

CDF53, OPENJPEG53, OPENJPEG97 = "terrainwave-cdf53", "openjpeg-5/3", "openjpeg-9/7"
# GDAL says that a cut stream is lossy.
LOSSLESS = 100.0


@dataclass(frozen=True)
class Row:
    """One line of the CSV; `rate` is the bits per sample asked for, empty where lossless."""

    raster: str
    n_rows: int
    n_cols: int
    codec: str
    rate: str
    n_bytes: int
    bits_per_sample: float
    psnr: str
    max_error: float


def make_row(raster: Raster, codec: str, rate: float | None, n_bytes: int, decoded) -> Row:
    """Return a line; compares valid samples only."""
    heights = raster.valid.astype(np.float64)
    errors = decoded[raster.mask].astype(np.float64) - heights
    mean_square = float(np.mean(errors**2))
    if rate is None and mean_square > 0:
        raise ValueError(f"{codec} is not lossless on {raster.name}")
    psnr = "" if mean_square == 0 else f"{10 * np.log10(np.ptp(heights) ** 2 / mean_square):.2f}"
    return Row(
        raster=raster.name,
        n_rows=raster.heights.shape[0],
        n_cols=raster.heights.shape[1],
        codec=codec,
        rate="" if rate is None else f"{rate:g}",
        n_bytes=n_bytes,
        bits_per_sample=round(8 * n_bytes / raster.heights.size, 4),
        psnr=psnr,
        max_error=float(np.abs(errors).max()),
    )


def measure_cdf53(raster: Raster, rate: float | None, folder: Path) -> Row:
    """Compress with the proof at the end, without meshes."""
    source, target = folder / "source.tif", folder / "target.twz"
    write_geotiff(raster, source)
    goal = {"max_error": 0} if rate is None else {"rate": rate}
    result = terrainwave.compress(
        source, target, method="cdf53", mesh="none", overwrite=True, **goal
    )
    with terrainwave.open(target) as terrain:
        decoded = terrain.read()
    return make_row(raster, CDF53, rate, result.n_bytes, decoded)


def measure_openjpeg(forms: Forms, rate: float | None, *, is_reversible: bool) -> Row:
    """Return the smallest, or of cut streams the best, over the fills of voids."""
    rows = []
    name = OPENJPEG53 if is_reversible else OPENJPEG97
    for _, filled in forms.fills:
        n_bytes, decoded = code_openjpeg(filled, rate, forms.mask_bytes, is_reversible)
        rows.append(make_row(forms.raster, name, rate, n_bytes + forms.mask_bytes, decoded))
    if rate is None:
        return min(rows, key=lambda row: row.n_bytes)
    return max(rows, key=lambda row: float(row.psnr or "inf"))


def code_openjpeg(
    raster: Raster, rate: float | None, mask_bytes: int, is_reversible: bool
) -> tuple[int, np.ndarray]:
    """Return the bytes of a code stream cut to `rate`, less the mask, and what it decodes to."""
    low = int(raster.heights.min())
    image = (raster.heights.astype(np.int64) - low).astype(np.uint16)
    n_bits = max(int(image.max()).bit_length(), 1)
    n_rows, n_cols = image.shape
    quality = LOSSLESS
    if rate is not None:
        quality = 100 * (rate - 8 * mask_bytes / image.size) / n_bits
    options = {
        "driver": "JP2OpenJPEG",
        "height": n_rows,
        "width": n_cols,
        "count": 1,
        "dtype": "uint16",
        "REVERSIBLE": "YES" if is_reversible else "NO",
        "CODEC": "J2K",
        "NBITS": n_bits,
        "QUALITY": quality,
        "BLOCKXSIZE": max(n_cols, 1024),
        "BLOCKYSIZE": max(n_rows, 1024),
        "RESOLUTIONS": 6,
    }
    with MemoryFile(ext=".j2k") as file:
        with file.open(**options) as sink:
            sink.write(image, 1)
        n_bytes = len(file.getbuffer())
        with file.open() as source:
            decoded = source.read(1)
    return n_bytes, decoded.astype(np.int64) + low


def measure_raster(path: Path, crop: int | None, rates, folder: Path) -> Iterator[Row]:
    """Yield the lines of a raster: lossless, then each rate."""
    raster = load_raster(path, crop)
    if not raster.is_integer:
        return
    forms = make_forms(raster)
    for rate in (None, *rates):
        yield measure_cdf53(raster, rate, folder)
        yield measure_openjpeg(forms, rate, is_reversible=True)
        if rate is not None:
            yield measure_openjpeg(forms, rate, is_reversible=False)


@click.command(cls=ListCommand)
@click.argument("places", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--rate", "rates", cls=ListOption, type=float, default=(), help="Bits per sample.")
@click.option("--crop", type=click.IntRange(min=1), help="Use the upper left N × N samples.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("benchmarks/results/embedded.csv"),
    show_default=True,
)
def main(places, rates, crop, out) -> None:
    """Measure the integer GeoTIFFs in PLACES (files or directories)."""
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    paths = find_rasters(list(places))
    if not paths:
        raise click.UsageError("no GeoTIFFs there")
    with tempfile.TemporaryDirectory() as name, CsvSink(out, Row) as sink:
        for path in paths:
            for row in measure_raster(path, crop, rates, Path(name)):
                sink.write(row)
                click.echo(
                    f"{row.raster:32} {row.codec:18} {row.rate or 'lossless':>8}:"
                    f" {row.bits_per_sample:.4f} bit/sample, {row.psnr or '∞'} dB"
                )


if __name__ == "__main__":
    main()
