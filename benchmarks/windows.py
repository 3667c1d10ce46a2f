"""What a window of a file just opened costs, beside a COG: ``python -m benchmarks.windows DIR``.

Each window is read from a file on disk that is opened for it and closed after it, one thread on
one core, the files in the cache of the system, kernels warm; both readers take turns on each
window. The COG (LERC_ZSTD, blocks of 512, overviews) is made by GDAL of the same GeoTIFF, in its
own type, and read by ``rasterio.open(...).read(1, window=...)``. "aligned" windows begin at
multiples of their size, where blocks of either file do; "any" ones begin anywhere. Rasters that
are smaller than a window in either direction are left out.
"""

from collections import namedtuple
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from statistics import median

import click
import numpy as np
import rasterio
from rasterio.windows import Window

import terrainwave
from benchmarks import common
from benchmarks.rasters import largest_error, load_raster, write_pair

# Milliseconds of processor time, from opening to closing; bytes and error are of the whole file.
Row = namedtuple(
    "Row", "raster max_error place window n_windows reader n_bytes error median_ms p90_ms most_ms"
)
PLACES = ("aligned", "any")


def corners(shape: tuple[int, int], side: int, place: str, n: int) -> list[tuple[int, int]]:
    """Return the first row and column of `n` windows, the same ones each time."""
    rng = np.random.default_rng(1)
    unit = side if place == "aligned" else 1
    rows, cols = (rng.integers(0, (length - side) // unit + 1, n) * unit for length in shape)
    return list(zip(rows.tolist(), cols.tolist(), strict=True))


def read_terrain(path: Path, window: Window | None = None, **options) -> np.ndarray:
    """Open a file of ours, read a window or all of it, close it."""
    rows_cols = window and (window.row_off, window.col_off, window.height, window.width)
    with terrainwave.open(path, threads=1, **options) as terrain:
        return terrain.read(rows_cols)


def read_cog(path: Path, window: Window | None = None) -> np.ndarray:
    """Open a GeoTIFF, read a window or all of it, close it."""
    with rasterio.open(path) as dataset:
        return dataset.read(1, window=window)


READERS = {"terrainwave": read_terrain, "cog": read_cog}


def times_of(readers: dict, files: dict, windows: Sequence) -> dict[str, list[float]]:
    """Return the milliseconds of each reader for each window, in turns, sorted."""
    took: dict[str, list[float]] = {name: [] for name in readers}
    for window in [windows[0], *windows]:  # the first one twice: it warms up
        tasks = [partial(read, files[name], window) for name, read in readers.items()]
        for name, timed in zip(readers, common.take_turns(lambda t=tasks: t, 1)):
            took[name].append(1000 * timed.seconds)
    return {name: sorted(found[1:]) for name, found in took.items()}


def measure(paths, bounds, side: int, n_windows: int, folder: Path) -> Iterator[Row]:
    """Yield the rows of each raster, bound, kind of place and reader."""
    for path in paths:
        raster = load_raster(path)
        if min(raster.heights.shape) < side:
            continue
        for bound in bounds:
            files = write_pair(path, folder / "windows", bound)
            errors = {
                name: largest_error(raster.heights, read(files[name]), raster.mask)
                for name, read in READERS.items()
            }
            if errors["terrainwave"] > bound + raster.slack:
                raise click.ClickException(f"{path.name}: {errors} is above {bound}")
            for place in PLACES:
                windows = [
                    Window(col, row, side, side)
                    for row, col in corners(raster.heights.shape, side, place, n_windows)
                ]
                for name, found in times_of(READERS, files, windows).items():
                    numbers = (median(found), found[9 * len(found) // 10], found[-1])
                    yield Row(
                        path.stem, bound, place, side, n_windows, name,
                        files[name].stat().st_size, round(errors[name], 4),
                        *(round(number, 2) for number in numbers),
                    )  # fmt: skip


@common.command("windows.csv")
@common.rasters_argument
@common.bounds_option(1.0)
@common.option("--side", type=common.COUNT, default=512)
@common.option("--windows", type=common.COUNT, default=40)
def main(paths, bounds, side, windows, folder, out) -> None:
    """Measure windows of files just opened."""
    common.pin_to_cores()
    with rasterio.Env():  # made once, as rasterio advises, not for each file
        common.write_rows(out, measure(paths, bounds, side, windows, folder))


if __name__ == "__main__":
    main()
