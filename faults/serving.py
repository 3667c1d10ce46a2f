"""Load `terrainwave serve`: ``python -m faults.serving dem.tif``.

Serves files made from a raster on a free port of 127.0.0.1, and lets clients in a process of their
own ask for all there is, a mix of right, wrong and malformed requests, while others are slow.
Writes a line for each kind of request, and to ``…_memory.csv`` what the server held at times.

Exit status: 0 good; 1 an answer of 500, a request that hung, or a server that ended; 2 wrong usage.
"""

import json
import re
import signal
import statistics
import subprocess
import sys
import time
import urllib.request
from collections import Counter, namedtuple
from collections.abc import Sequence
from pathlib import Path

import click
import psutil

from benchmarks import common

Row = namedtuple(
    "Row",
    "kind requests per_second median_ms p99_ms n_good n_4xx n_503 n_5xx n_lost n_hung",
)
Held = namedtuple("Held", "when memory_mb handles threads connections")
_TERRAINWAVE = [sys.executable, "-m", "terrainwave"]
# How often the memory is looked at under load.
_N_LOOKS = 6
# The files: name and options of compress.
_FILES = {"lossless": ["--max-error", "0"], "metre": ["--max-error", "1"]}


@common.command("serving.csv")
@common.dem_argument
@common.option("--clients", "n_clients", type=common.COUNT, default=200)
@common.option("--slow", "n_slow", type=click.IntRange(min=0), default=20, help="Slow clients.")
@common.option("--seconds", type=click.FloatRange(1, 600), default=60.0)
def main(dem: Path, n_clients: int, n_slow: int, seconds: float, folder: Path, out: Path) -> None:
    """Run the measurement."""
    paths = [make(dem, folder / f"{name}.twz", options) for name, options in _FILES.items()]
    with subprocess.Popen(
        [*_TERRAINWAVE, "serve", *map(str, paths), "--port", "0"], stdout=subprocess.PIPE, text=True
    ) as server:
        try:
            address = re.search(r"http://\S+", server.stdout.readline() if server.stdout else "")
            if address is None:
                raise click.ClickException("the server did not start")
            warm_up(address[0])
            found, held = run(server.pid, address[0], n_clients, n_slow, seconds)
            has_ended = server.poll() is not None
        finally:
            server.send_signal(signal.SIGINT)
    n_begun, n_ended = found["slow"] or (0, 0)
    slow = Row("slow clients: connections", n_begun, round(n_begun / seconds, 1), 0, 0, 0, 0, 0, 0,
               n_ended, 0)  # fmt: skip
    rows = common.write_rows(out, [*rows_of(found["requests"], seconds), slow])
    common.write_rows(out.with_name(f"{out.stem}_memory.csv"), held)
    if has_ended or any(row.n_5xx or row.n_hung for row in rows):
        raise click.ClickException("an answer of 500, a request that hung, or no server")


def make(dem: Path, path: Path, options: Sequence[str]) -> Path:
    """Return a .twz file of the raster."""
    command = [*_TERRAINWAVE, "compress", str(dem), str(path), "--overwrite", "--quiet", *options]
    subprocess.run(command, check=True)
    return path


def warm_up(address: str) -> None:
    """Let the server compile its kernels: a request for each kind of work."""
    with urllib.request.urlopen(f"{address}terrains.json", timeout=60) as answer:
        terrains = json.load(answer)
    for terrain in terrains:
        west, south, east, north = terrain["bounds"]
        place = f"lon={(west + east) / 2}&lat={(south + north) / 2}"
        name = terrain["name"]
        for path in (f"height?{place}", "rgb/0/0/0.png", "mesh/layer.json", "mesh/0/0/0.terrain"):
            urllib.request.urlopen(f"{address}{name}/{path}", timeout=600).close()
        with urllib.request.urlopen(f"{address}{name}.tif", timeout=600) as raster:
            raster.read(1 << 20)


def run(
    pid: int, address: str, n_clients: int, n_slow: int, seconds: float
) -> tuple[dict, list[Held]]:
    """Return what the clients found, and what the server held before, while and after."""
    server = psutil.Process(pid)
    held = [held_by(server, "before")]
    with subprocess.Popen(
        [sys.executable, "-m", "faults.clients", address, str(n_clients),
         str(n_slow), str(seconds)],
        stdout=subprocess.PIPE, cwd=common.ROOT,
    ) as clients:  # fmt: skip
        began = time.monotonic()
        for part in range(1, _N_LOOKS + 1):
            # Shortly before the end: at the end the clients leave.
            time.sleep(max(0.0, began + (part / _N_LOOKS - 0.02) * seconds - time.monotonic()))
            held.append(held_by(server, f"at {seconds * part / _N_LOOKS:.0f} s"))
        try:
            told, _ = clients.communicate(timeout=seconds + 120)
        finally:
            clients.kill()
    time.sleep(7)  # connections that are kept alive are ended by then
    return json.loads(told), [*held, held_by(server, "after")]


def held_by(server: psutil.Process, when: str) -> Held:
    """Return what the server holds now."""
    connections = server.net_connections("tcp")
    n_connections = sum(one.status == psutil.CONN_ESTABLISHED for one in connections)
    return Held(
        when, round(server.memory_info().rss / 1e6, 1), server.num_fds(), server.num_threads(),
        n_connections,
    )  # fmt: skip


def rows_of(requests: list[list], seconds: float) -> list[Row]:
    """Return a line for each kind of request, and one for all.

    A request is its kind, milliseconds and status: 0 is a connection that was lost, -1 no answer
    in time.
    """
    kinds: dict[str, list[tuple[float, int]]] = {}
    for kind, milliseconds, status in requests:
        kinds.setdefault(kind, []).append((milliseconds, status))
        kinds.setdefault("~", []).append((milliseconds, status))
    rows = []
    for kind, answers in sorted(kinds.items()):
        # What is refused at once would hide what the others wait.
        times = [ms for ms, status in answers if status > 0 and status != 503] or [0.0]
        found = Counter(
            status if status in (0, -1, 503) else status // 100 for _, status in answers
        )
        rows.append(Row(
            kind.replace("~", "all"), len(answers), round(len(answers) / seconds, 1),
            round(statistics.median(times), 1),
            round(sorted(times)[int(0.99 * (len(times) - 1))], 1),
            found[2] + found[3], found[4], found[503], found[5], found[0], found[-1],
        ))  # fmt: skip
    return rows


if __name__ == "__main__":
    main()
