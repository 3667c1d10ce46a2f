"""Count what window reads over http cost: ``python -m benchmarks.remote dem.tif --work DIR``.

The raster is mirrored to 16384 x 16384 samples and compressed, once. A local server answers ranges
after a delay, as a distant one would, and notes when each request was in flight. Random windows are
read, and the one in the centre, where four segments meet; each by a newly opened `Terrain`, whose
opening is not counted. `--reader` tells versions of the code apart in the CSV.

Exit status: 0 good; 1 a limit was passed; 2 wrong usage.
"""

from collections import namedtuple
from collections.abc import Callable, Sequence
from math import inf
from statistics import median

import click
import numpy as np

import terrainwave
from benchmarks import common
from benchmarks.rasters import mirrored_file
from benchmarks.slow_server import SlowServer
from terrainwave.grid.quadtree import Region
from terrainwave.read.decoder import unit_key, units_of

# Requests, rounds and bytes / needed that issue 7 allows the worst window of 512 x 512 samples of
# the full grid.
LIMITS = 12, 3, 1.5
_SEED = 20260101

# What a window took; `needed_bytes` are its groups' payloads and those above, `ratio` is over them.
Cost = namedtuple("Cost", "requests rounds bytes needed_bytes ratio")
# One line of the CSV: a statistic of each number by itself, over all windows.
Row = namedtuple(
    "Row",
    "reader raster size max_error method level window n_windows statistic "
    + " ".join(Cost._fields),
)  # fmt: skip


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
def main(dem, size, max_error, reader, level, side, n_windows, delay, folder, out) -> None:
    """Append centre, median and worst of each count to a CSV."""
    path = mirrored_file(dem, size, folder, max_error=max_error, mesh="none", threads=2)
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
