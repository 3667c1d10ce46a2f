"""What a window of a file just opened costs: ``python -m benchmarks.windows DIR``.

Each window is read from a file that is opened for it and closed after it, one thread on one core,
kernels warm. "aligned" ones begin at multiples of their size, where groups of blocks do, so that
one group of each level has them; "any" ones begin anywhere, across up to four. Rasters that are
smaller than a window in either direction are left out.
"""

import statistics
import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rasterio

import terrainwave
from benchmarks import common

# Milliseconds of processor time, from opening to closing.
Row = namedtuple("Row", "raster max_error method place window n_windows median_ms p90_ms most_ms")
PLACES = ("aligned", "any")


def corners(shape: tuple[int, int], side: int, place: str, n: int) -> list[tuple[int, int]]:
    """Return the first row and column of `n` windows, the same ones each time."""
    rng = np.random.default_rng(1)
    unit = side if place == "aligned" else 1
    rows, cols = (rng.integers(0, (length - side) // unit + 1, n) * unit for length in shape)
    return list(zip(rows.tolist(), cols.tolist(), strict=True))


def milliseconds(path: Path, window: tuple[int, int, int, int]) -> float:
    """Return what it takes to open a file and read a window."""
    start = time.process_time()
    with terrainwave.open(path, threads=1) as terrain:
        terrain.read(window)
    return 1000 * (time.process_time() - start)


def measure(paths, bounds, side: int, n_windows: int, folder: Path) -> Iterator[Row]:
    """Yield the rows of each raster, bound and kind of place."""
    for path in paths:
        with rasterio.open(path) as dataset:
            shape = dataset.shape
        if min(shape) < side:
            continue
        for bound in bounds:
            file = folder / "windows.twz"
            terrainwave.compress(path, file, max_error=bound, mesh="none", overwrite=True)
            with terrainwave.open(file) as terrain:
                method = terrain.info().method
            for place in PLACES:
                windows = [
                    (*corner, side, side) for corner in corners(shape, side, place, n_windows)
                ]
                milliseconds(file, windows[0])
                took = sorted(milliseconds(file, window) for window in windows)
                numbers = (statistics.median(took), took[9 * len(took) // 10], took[-1])
                yield Row(
                    path.stem, bound, method, place, side, n_windows,
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
    common.write_rows(out, measure(paths, bounds, side, windows, folder))


if __name__ == "__main__":
    main()
