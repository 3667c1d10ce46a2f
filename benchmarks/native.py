"""What reading takes with the native library and without: ``python -m benchmarks.native DIR``.

The native library must be there (``terrainwave doctor``). One thread on one core, processor time,
from opening a file to closing it; readers take turns. "whole" is the full grid, "window" 512
samples a side in the middle of it; the COG (LERC_ZSTD, blocks of 512) is made by GDAL of the same
GeoTIFF. "first" is a process of its own that reads the whole file where no kernel has been compiled
yet, from the start of Python to its end, "again" the same once more.
"""

import os
import shutil
import statistics
import sys
from collections import namedtuple
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import click
import numpy as np
import rasterio
from rasterio.windows import Window

import terrainwave
from benchmarks import common
from benchmarks.cold import READ, seconds_of
from benchmarks.rasters import write_pair
from benchmarks.windows import read_cog, read_terrain
from terrainwave.coding import native_library
from terrainwave.read import native

# Milliseconds of processor time, medians; `samples` are those that are read.
Row = namedtuple("Row", "raster max_error task reader samples n_runs median_ms most_ms")
SIDE = 512


def warm_rows(path: Path, bound: float, folder: Path, n_runs: int) -> Iterator[Row]:
    """Yield the rows of a raster, all compiled."""
    ours, cog = write_pair(path, folder / "native", bound, method="rapid").values()
    with terrainwave.open(ours) as terrain:
        n_rows, n_cols = terrain.shape
    side = min(SIDE, n_rows, n_cols)
    middle = Window((n_cols - side) // 2, (n_rows - side) // 2, side, side)
    for task, window in (("whole", None), ("window", middle)):
        readers = {
            "native": partial(read_terrain, ours, window, native=True),
            "numba": partial(read_terrain, ours, window, native=False),
            "cog": partial(read_cog, cog, window),
        }
        for reader in readers.values():
            reader()  # warms up
        tasks = list(readers.values())
        timed = common.take_turns(lambda tasks=tasks: tasks, n_runs)
        if timed[0].result.tobytes() != timed[1].result.tobytes():
            raise click.ClickException(f"{path.name}: heights differ with and without the library")
        for name, one in zip(readers, timed, strict=True):
            numbers = (round(1000 * seconds, 2) for seconds in (one.seconds, one.most))
            yield Row(path.stem, bound, task, name, one.result.size, n_runs, *numbers)


def first_rows(path: Path, bound: float, folder: Path, n_runs: int) -> Iterator[Row]:
    """Yield the rows of processes that read the file that `warm_rows` has left."""
    with terrainwave.open(folder / "native.twz") as terrain:
        n_samples = int(np.prod(terrain.shape))
    found: dict[tuple[str, str], list[float]] = {}
    for _ in range(n_runs):
        for reader, switch in (("native", "1"), ("numba", "0")):
            cache = folder / "cache"
            shutil.rmtree(cache, ignore_errors=True)
            os.environ[native_library.SWITCH] = switch
            for task in ("first", "again"):
                seconds = seconds_of(
                    sys.executable, common.ROOT / "src",
                    ["-c", READ, str(folder / "native.twz")], cache,
                )  # fmt: skip
                found.setdefault((task, reader), []).append(1000 * seconds)
    del os.environ[native_library.SWITCH]
    for (task, reader), times in found.items():
        numbers = (round(statistics.median(times)), round(max(times)))
        yield Row(path.stem, bound, task, reader, n_samples, n_runs, *numbers)


def measure(paths, bounds, n_runs: int, n_first: int, folder: Path) -> Iterator[Row]:
    """Yield the rows of each raster and bound; of processes, those of the first pair alone."""
    for number, path in enumerate(paths):
        for place, bound in enumerate(bounds):
            yield from warm_rows(path, bound, folder, n_runs)
            if number == place == 0:
                yield from first_rows(path, bound, folder, n_first)


@common.command("native.csv")
@common.rasters_argument
@common.bounds_option(1.0, 10.0)
@common.option("--runs", type=common.COUNT, default=15)
@common.option("--first-runs", type=common.COUNT, default=3)
def main(paths, bounds, runs, first_runs, folder, out) -> None:
    """Measure reading with the native library and without."""
    if native.installed() is None:
        raise click.UsageError("found no native library: terrainwave doctor says why")
    common.pin_to_cores()
    with rasterio.Env():
        common.write_rows(out, measure(paths, bounds, runs, first_runs, folder))


if __name__ == "__main__":
    main()
