"""Count what window reads over http cost: ``python -m benchmarks.remote dem.tif --work DIR``.

The raster is mirrored to 16384 x 16384 samples and compressed, once. A local server answers ranges
after a delay, as a distant one would, and notes when each request was in flight. Random windows are
read, and the one in the centre, where four segments meet; each by a newly opened `Terrain`, whose
opening is not counted. `--reader` tells versions of the code apart in the CSV.

``--cog``: into ``remote_cog.csv``, the same windows of a COG (LERC_ZSTD, blocks of 512, overviews,
the same bound), which GDAL makes of the same GeoTIFF and rasterio reads by /vsicurl/ with what GDAL
documents for COGs (`SETTINGS`), beside ours. Each window is opened, read and closed in a process
forked for it, in turns: no connection, header or cache is at hand on either side.

Exit status: 0 good; 1 a limit was passed; 2 wrong usage.
"""

import multiprocessing
import time
from collections import namedtuple
from collections.abc import Callable, Iterator, Sequence
from math import inf
from pathlib import Path
from statistics import median

import click
import numpy as np
import rasterio
from rasterio.windows import Window

import terrainwave
from benchmarks import common
from benchmarks.rasters import load_raster, mirrored_file, write_cog
from benchmarks.slow_server import SlowServer
from benchmarks.windows import read_cog, read_terrain
from terrainwave.grid.quadtree import Region
from terrainwave.read.decoder import unit_key, units_of

# Requests, rounds and bytes / needed of the worst window of 512 x 512 samples of the full grid:
# where four segments meet (docs/decisions/0035).
LIMITS = 8, 3, 2.5
_SEED = 20260101

# What a window took; `needed_bytes` are its groups' payloads and those above, `ratio` is over them.
Cost = namedtuple("Cost", "requests rounds bytes needed_bytes ratio")
# One line of the CSV: a statistic of each number by itself, over all windows.
Row = namedtuple(
    "Row",
    "reader raster size max_error method level window n_windows statistic "
    + " ".join(Cost._fields),
)  # fmt: skip
# A line of `remote_cog.csv`, likewise; seconds on the wall and of the reader's processor.
PeerRow = namedtuple(
    "PeerRow",
    "reader raster max_error window n_windows delay_s file_bytes statistic requests rounds bytes "
    "seconds cpu_seconds",
)
# What GDAL documents for COGs over http; without its HEAD request windows took longer.
SETTINGS = {
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "CPL_VSIL_CURL_ALLOWED_EXTENSIONS": ".tif",
    "GDAL_INGESTED_BYTES_AT_OPEN": "32768",
    "GDAL_HTTP_MERGE_CONSECUTIVE_RANGES": "YES",
    "VSI_CACHE": "TRUE",
}
READERS = {"terrainwave": read_terrain, "cog": read_cog}


def count_rounds(intervals: Sequence[tuple[float, float]]) -> int:
    """Return the most intervals of which each begins after the one before has ended."""
    n_rounds, last_end = 0, -np.inf
    for start, end in sorted(intervals, key=lambda interval: interval[1]):
        if start >= last_end:
            n_rounds, last_end = n_rounds + 1, end
    return n_rounds


def window_cost(
    server: SlowServer, name: str, window: tuple[int, int, int, int], level: int = -1
) -> Cost:
    """Read (row, col, n_rows, n_cols) of a level by a newly opened `Terrain`."""
    with terrainwave.open(server.url(name)) as terrain:
        n_before = len(server.log)
        terrain.read(window, level=level)
        log = server.log[n_before:]
        needed = needed_bytes(terrain, window, level)
    rounds = count_rounds([(exchange.start, exchange.end) for exchange in log])
    n_bytes = sum(exchange.n_bytes for exchange in log)
    return Cost(len(log), rounds, n_bytes, needed, round(n_bytes / needed, 3))


def needed_bytes(terrain, window: tuple[int, int, int, int], level: int) -> int:
    """Return the bytes of the payloads of the covering groups and of all above them."""
    container = terrain.container
    counted = level % terrain.n_levels  # from the coarse end
    keys = set(units_of(container.grid, counted, Region(*window)))
    for key in list(keys):
        while not key.is_root_key:
            key = unit_key(key)
            keys.add(key)
    return sum(map(len, container.payloads(sorted(keys))))


def timed_read(reader: str, address: str, window: Window) -> tuple[float, float]:
    """Return what it takes to open a file, read a window and close it: wall clock, processor."""
    start, cpu_start = time.perf_counter(), time.process_time()
    READERS[reader](address, window)
    return time.perf_counter() - start, time.process_time() - cpu_start


def exchanges(server: SlowServer, reader: str, name: str, window: Window) -> tuple:
    """Return requests, rounds, bytes and seconds of a window read in a process of its own."""
    n_before = len(server.log)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        seconds = pool.apply(timed_read, (reader, server.url(name), window))
    log = server.log[n_before:]
    rounds = count_rounds([(exchange.start, exchange.end) for exchange in log])
    return len(log), rounds, sum(exchange.n_bytes for exchange in log), *seconds


def peer_rows(path: Path, source: Path, windows, delay: float, max_error: float) -> Iterator:
    """Yield centre, median and worst of both readers; `source` is what `path` was made of."""
    files = {"terrainwave": path, "cog": path.with_suffix(".cog.tif")}
    if not files["cog"].exists():
        write_cog(source, files["cog"], max_error)
    windows = [Window(col, row, n_cols, n_rows) for row, col, n_rows, n_cols in windows]
    found: dict[str, list[tuple]] = {reader: [] for reader in READERS}
    with rasterio.Env(**SETTINGS), SlowServer(path.parent, delay, inf) as server:
        for window in windows:
            original = load_raster(source, window=window).heights.astype(np.float64)
            for reader, read in READERS.items():  # off the clock; kernels get warm, too
                if np.abs(read(files[reader], window) - original).max() > max_error:
                    raise click.ClickException(f"{reader} broke the bound in {window}")
            for reader, costs in found.items():
                costs.append(exchanges(server, reader, files[reader].name, window))
    side = windows[0].height
    for reader, costs in found.items():
        head = reader, source.stem, max_error, side, len(windows), delay
        head += (files[reader].stat().st_size,)
        of_columns = {"centre": lambda column: column[0], "median": median, "worst": max}
        for name, statistic in of_columns.items():
            yield PeerRow(*head, name, *(round(statistic(c), 4) for c in zip(*costs, strict=True)))


def windows_of(size: int, side: int, n_windows: int) -> list[tuple[int, int, int, int]]:
    """Return the window in the centre and random ones, `n_windows` in all."""
    places = np.random.default_rng(_SEED).integers(0, size - side + 1, (n_windows - 1, 2))
    corners = [((size - side) // 2,) * 2, *places.tolist()]
    return [(row, col, side, side) for row, col in corners]


@common.command("remote.csv")
@common.dem_argument
@common.option("--size", type=common.COUNT, default=16384, help="Rows and columns.")
@common.option("--max-error", default=1.0)
@common.option("--reader", default="current", help="Name of what is measured.")
@common.option("--level", type=click.IntRange(max=-1), default=-1)
@common.option("--window", "side", type=common.COUNT, default=512)
@common.option("--windows", "n_windows", type=common.COUNT, default=100)
@common.option("--delay", default=0.05, help="Seconds per request.")
@click.option("--cog", is_flag=True, help="Beside a COG, into remote_cog.csv.")
def main(dem, size, max_error, reader, level, side, n_windows, delay, cog, folder, out) -> None:
    """Append centre, median and worst of each count to a CSV."""
    path = mirrored_file(dem, size, folder, max_error=max_error, mesh="none", threads=2)
    if cog:
        windows = windows_of(size, side, n_windows)
        rows = peer_rows(path, folder / f"{dem.stem}-{size}.tif", windows, delay, max_error)
        common.write_rows(out.with_name("remote_cog.csv"), rows)
        return
    with terrainwave.open(path) as terrain:
        method = terrain.info().method
        n_rows, _ = terrain.grid.level_shape(level % terrain.n_levels)
    with SlowServer(path.parent, delay, inf) as server:
        windows = windows_of(n_rows, side, n_windows)
        costs = [window_cost(server, path.name, window, level) for window in windows]
    worst = _summary(costs, max)
    statistics = {"centre": costs[0], "median": _summary(costs, median), "worst": worst}
    case = reader, dem.stem, size, max_error, method, level, side, n_windows
    rows = [Row(*case, name, *cost) for name, cost in statistics.items()]
    common.write_rows(out, rows, append=True)
    found = worst.requests, worst.rounds, worst.ratio
    is_limited = (level, side, size) == (-1, 512, 16384)
    if is_limited and any(number > most for number, most in zip(found, LIMITS, strict=True)):
        raise click.ClickException(f"the worst window may take {LIMITS}: requests, rounds, bytes")


def _summary(costs: Sequence[Cost], statistic: Callable[[Sequence[float]], float]) -> Cost:
    """Return each number's statistic by itself."""
    return Cost(*(round(statistic(column), 4) for column in zip(*costs, strict=True)))


if __name__ == "__main__":
    main()
