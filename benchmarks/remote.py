"""Count what window reads over http cost: ``python -m benchmarks.remote dem.tif --work DIR``.

The raster is mirrored to 16384 x 16384 samples and compressed, once; both files stay in the
working directory. A local server answers ranges after a delay, as a distant one would, and notes
when each request was in flight. Random windows are read, and the one in the centre, where four
segments of the file meet; each by a newly opened `Terrain`. Opening is not counted. `--reader` says
in the CSV which version of the code it was, where versions are compared.

Exit status: 0 good; 1 a limit was passed; 2 wrong usage.
"""

import csv
import json
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from statistics import median

import click
import numpy as np

from benchmarks.machine import describe_machine
from benchmarks.memory import make_mirrored

FIELDS = (
    "reader", "raster", "size", "max_error", "method", "level", "window", "n_windows", "statistic",
    "requests", "rounds", "bytes", "needed_bytes", "ratio",
)  # fmt: skip
# What issue 7 asks of the worst window of 512 x 512 samples of the full grid.
MAX_REQUESTS, MAX_ROUNDS, MAX_RATIO = 12, 3, 1.5
_SEED = 20260101
_RANGE = re.compile(r"bytes=(\d+)-(\d+)")


@dataclass(frozen=True)
class Cost:
    """What reading one window took; `needed_bytes` are its groups' payloads and those above."""

    requests: int
    rounds: int
    bytes: int
    needed_bytes: int

    @property
    def ratio(self) -> float:
        """Return the bytes that came over those that were needed."""
        return self.bytes / self.needed_bytes


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        """Answer one range after the server's delay."""
        server = self.server
        start = time.monotonic()
        time.sleep(server.delay)
        match = _RANGE.fullmatch(self.headers.get("Range", ""))
        first, last = int(match[1]), int(match[2])
        body = server.data[first : last + 1]
        self.send_response(206)
        self.send_header("Content-Length", str(len(body)))
        place = f"bytes {first}-{first + len(body) - 1}/{len(server.data)}"
        self.send_header("Content-Range", place)
        self.send_header("ETag", '"1"')
        self.end_headers()
        # Noted first: the client may look before this thread goes on.
        server.log.append((start, time.monotonic(), len(body)))
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Say nothing."""


class RangeServer(ThreadingHTTPServer):
    """Serves one file by ranges; `log` has start, end (seconds) and bytes of each request."""

    daemon_threads = True
    request_queue_size = 64

    def __init__(self, data: bytes, delay: float) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.data, self.delay = data, delay
        self.log: list[tuple[float, float, int]] = []

    @property
    def url(self) -> str:
        """Return the address of the file."""
        return f"http://127.0.0.1:{self.server_port}/a.twz"


@contextmanager
def serving(data: bytes, delay: float) -> Iterator[RangeServer]:
    """Serve `data` while the context lasts."""
    server = RangeServer(data, delay)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def count_rounds(intervals: Sequence[tuple[float, float]]) -> int:
    """Return the most intervals of which each begins after the one before has ended."""
    n_rounds, last_end = 0, -np.inf
    for start, end in sorted(intervals, key=lambda interval: interval[1]):
        if start >= last_end:
            n_rounds, last_end = n_rounds + 1, end
    return n_rounds


def window_cost(server: RangeServer, window: tuple[int, int, int, int], level: int = -1) -> Cost:
    """Read (row, col, n_rows, n_cols) of a level by a newly opened `Terrain`."""
    import terrainwave

    with terrainwave.open(server.url) as terrain:
        n_before = len(server.log)
        terrain.read(window, level=level)
        log = server.log[n_before:]
        needed = needed_bytes(terrain, window, level)
    rounds = count_rounds([(start, end) for start, end, _ in log])
    return Cost(len(log), rounds, sum(length for _, _, length in log), needed)


def needed_bytes(terrain, window: tuple[int, int, int, int], level: int) -> int:
    """Return the bytes of the payloads of the covering groups and of all above them."""
    from terrainwave.grid.quadtree import Region
    from terrainwave.read.decoder import unit_key, units_of

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


def compressed_mirror(raster: Path, size: int, max_error: float, folder: Path) -> Path:
    """Return the mirrored and compressed raster, made if it is not there yet."""
    import terrainwave

    target = folder / f"{raster.stem}-{size}-{max_error:g}.twz"
    if not target.exists():
        source = folder / f"{raster.stem}-{size}.tif"
        if not source.exists():
            make_mirrored(raster, source, size, "tiled")
        terrainwave.compress(
            source, target, max_error=max_error, mesh="none", verify=False, threads=2
        )
    return target


@click.command()
@click.argument("raster", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--work", type=click.Path(file_okay=False, path_type=Path), required=True)
@click.option("--size", type=int, default=16384, show_default=True, help="Rows and columns.")
@click.option("--max-error", type=float, default=1.0, show_default=True)
@click.option("--reader", default="current", show_default=True, help="Name of what is measured.")
@click.option("--level", type=click.IntRange(max=-1), default=-1, show_default=True)
@click.option("--window", "side", type=int, default=512, show_default=True)
@click.option("--windows", "n_windows", type=int, default=100, show_default=True)
@click.option("--delay", type=float, default=0.05, show_default=True, help="Seconds per request.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("benchmarks/results/remote.csv"),
    show_default=True,
)
def main(raster, work, size, max_error, reader, level, side, n_windows, delay, out) -> None:
    """Append centre, median and worst of each count to a CSV."""
    import terrainwave

    work.mkdir(parents=True, exist_ok=True)
    path = compressed_mirror(raster, size, max_error, work)
    with terrainwave.open(path) as terrain:
        method = terrain.info().method
        n_rows, _ = terrain.grid.level_shape(level % terrain.n_levels)
    with serving(path.read_bytes(), delay) as server:
        windows = windows_of(n_rows, side, n_windows)
        costs = [window_cost(server, window, level) for window in windows]
    centre, worst = costs[0], _summary(costs, max)
    rows = {"centre": values_of(centre), "median": _summary(costs, median), "worst": worst}
    is_new = not out.exists()
    with out.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if is_new:
            writer.writerow(FIELDS)
        for statistic, values in rows.items():
            case = (reader, raster.stem, size, max_error, method, level, side, n_windows)
            row = (*case, statistic, *values)
            writer.writerow(row)
            click.echo(",".join(map(str, row)))
    text = json.dumps(describe_machine(), indent=2) + "\n"
    out.with_suffix(".json").write_text(text, encoding="utf-8")
    requests, rounds, _, _, ratio = worst
    is_limited = (level, side, size) == (-1, 512, 16384)
    if not is_limited:
        return
    if requests > MAX_REQUESTS or rounds > MAX_ROUNDS or ratio > MAX_RATIO:
        raise click.ClickException(
            f"the worst window may take {MAX_REQUESTS} requests, {MAX_ROUNDS} rounds and"
            f" {MAX_RATIO} times the bytes"
        )


def values_of(cost: Cost) -> tuple[float, ...]:
    """Return the numbers of one window as they stand in the CSV."""
    return cost.requests, cost.rounds, cost.bytes, cost.needed_bytes, round(cost.ratio, 3)


def _summary(
    costs: Sequence[Cost], statistic: Callable[[Sequence[float]], float]
) -> tuple[float, ...]:
    """Return each number's statistic by itself."""
    columns = zip(*map(values_of, costs), strict=True)
    return tuple(round(statistic(column), 4) for column in columns)


if __name__ == "__main__":
    main()
