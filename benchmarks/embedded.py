"""Compare method cdf53 with JPEG 2000's 5/3: ``python -m benchmarks.embedded DEM.tif …``.

Lossless sizes and, with --rate, errors of streams cut to so many bits per sample. The peer is
OpenJPEG by GDAL, one tile, as a bare code stream; of several fills for voids the best, the mask
charged. Its irreversible 9/7 stands beside it. Rasters of floats are left out.
"""

from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
from rasterio.io import MemoryFile

import terrainwave
from benchmarks import common
from benchmarks.rasters import Forms, Raster, load_raster, make_forms, write_geotiff

CDF53, OPENJPEG53, OPENJPEG97 = "terrainwave-cdf53", "openjpeg-5/3", "openjpeg-9/7"

# One line of the CSV; `rate` is the bits per sample asked for, empty where lossless.
Row = namedtuple("Row", "raster n_rows n_cols codec rate n_bytes bits_per_sample psnr max_error")


def make_row(raster: Raster, codec: str, rate: float | None, n_bytes: int, decoded) -> Row:
    """Return a line; compares valid samples only."""
    heights = raster.valid.astype(np.float64)
    errors = decoded[raster.mask].astype(np.float64) - heights
    mean_square = float(np.mean(errors**2))
    if rate is None and mean_square > 0:
        raise ValueError(f"{codec} is not lossless on {raster.name}")
    psnr = "" if mean_square == 0 else f"{10 * np.log10(np.ptp(heights) ** 2 / mean_square):.2f}"
    return Row(
        raster.name, *raster.heights.shape, codec, "" if rate is None else f"{rate:g}", n_bytes,
        round(8 * n_bytes / raster.heights.size, 4), psnr, float(np.abs(errors).max()),
    )  # fmt: skip


def measure_cdf53(raster: Raster, rate: float | None, folder: Path) -> Row:
    """Compress with the proof at the end, without meshes."""
    source, target = folder / "source.tif", folder / "target.twz"
    write_geotiff(raster, source)
    goal = {"max_error": 0} if rate is None else {"rate": rate}
    result = terrainwave.compress(
        source, target, method="cdf53", mesh="none", overwrite=True, **goal
    )
    with terrainwave.open(target) as terrain:
        return make_row(raster, CDF53, rate, result.n_bytes, terrain.read())


def measure_openjpeg(forms: Forms, rate: float | None, codec: str) -> Row:
    """Return the smallest, or of cut streams the best, over the fills of voids."""
    rows = []
    for _, filled in forms.fills:
        n_bytes, decoded = code_openjpeg(filled, rate, forms.mask_bytes, codec == OPENJPEG53)
        rows.append(make_row(forms.raster, codec, rate, n_bytes + forms.mask_bytes, decoded))
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
    # In per cent; GDAL says that a cut stream is lossy.
    quality = 100.0 if rate is None else 100 * (rate - 8 * mask_bytes / image.size) / n_bits
    with MemoryFile(ext=".j2k") as file:
        with file.open(
            driver="JP2OpenJPEG", height=n_rows, width=n_cols, count=1, dtype="uint16",
            REVERSIBLE="YES" if is_reversible else "NO", CODEC="J2K", NBITS=n_bits,
            QUALITY=quality, BLOCKXSIZE=max(n_cols, 1024), BLOCKYSIZE=max(n_rows, 1024),
            RESOLUTIONS=6,
        ) as sink:  # fmt: skip
            sink.write(image, 1)
        n_bytes = len(file.getbuffer())
        with file.open() as source:
            return n_bytes, source.read(1).astype(np.int64) + low


def measure(paths: list[Path], crop: int | None, rates, folder: Path) -> Iterator[Row]:
    """Yield the lines of rasters of integers: lossless, then each rate."""
    for path in paths:
        raster = load_raster(path, crop)
        if not raster.is_integer:
            continue
        forms = make_forms(raster)
        for rate in (None, *rates):
            yield measure_cdf53(raster, rate, folder)
            yield measure_openjpeg(forms, rate, OPENJPEG53)
            if rate is not None:
                yield measure_openjpeg(forms, rate, OPENJPEG97)


@common.command("embedded.csv")
@common.rasters_argument
@common.option("--rate", "rates", cls=common.ListOption, type=float, help="Bits per sample.")
@common.crop_option
@click.option("--append", is_flag=True, help="Keep the rows that are there.")
def main(paths, rates, crop, append, folder, out) -> None:
    """Measure rasters of integers."""
    common.write_rows(out, measure(paths, crop, rates, folder), append=append)


if __name__ == "__main__":
    main()
