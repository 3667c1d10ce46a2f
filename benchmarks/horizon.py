"""What nearer ground hides in low flights: ``python -m benchmarks.horizon DEM.tif …``.

Each DEM is mirrored to --side samples and compressed by `rapid`. A camera flies as the low flights
of `benchmarks.flight` do, but from place to place, each of which waits for all that it needs: so
that nothing depends on the machine. Once with all blocks in view, once without those behind
nearer ground. Blocks and triangles are means over the places; MiB are those that a server without
delays has sent, the index among them; CPU milliseconds of the drawing thread's part of a frame
without draw calls.
"""

import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import common
from benchmarks.flight import LOW, Flights, Ground, Session
from benchmarks.rasters import mirrored_file
from benchmarks.slow_server import SlowServer
from terrainwave.render.scene.camera import Viewport

VIEWPORT, TAU = Viewport(1920, 1080), 1.0
N_PLACES, STEP_S = 60, 2.0

# Blocks that a frame draws and those that it needs, ancestors among them; `mib` of the whole
# flight, `mib_on_way` without what the first picture took.
Row = namedtuple(
    "Row", "raster mode horizon above places drawn wanted triangles mib mib_on_way cpu_ms"
)


def measure(dem: Path, mode: str, side: int, above: float, folder: Path) -> Iterator[Row]:
    """Yield a flight with and without what is hidden."""
    path = mirrored_file(dem, side, folder, max_error=1.0, method="rapid")
    place = Flights(Ground(path, None)).straight(LOW[0], above, LOW[2])
    options: dict[str, Any] = {
        "mode": mode, "viewport": VIEWPORT, "gpu": False, "n_threads": 2, "memory": 2048,
    }  # fmt: skip
    for horizon in (False, True):
        with (
            SlowServer(path.parent, latency=0.0, bits_per_second=1e9) as server,
            Session(server.url(path.name), horizon=horizon, **options) as session,
        ):
            notes, first = [], 0
            for number in range(N_PLACES):
                view = session.scene.view(place(number * STEP_S), VIEWPORT, TAU)
                session.scene.settle(view)
                cpu = time.thread_time()
                frames = session.scene.update(view)
                session.submit(view, frames)
                cpu = time.thread_time() - cpu
                wanted = len(session.scene.wanted)
                notes.append((len(frames.nodes), wanted, frames.n_triangles, cpu * 1e3))
                first = first or server.n_bytes
            drawn, wanted, triangles, _ = np.mean(notes, axis=0)
            yield Row(
                dem.stem, mode, "on" if horizon else "off", above, N_PLACES, round(drawn, 1),
                round(wanted, 1), round(triangles), round(server.n_bytes / 2**20, 2),
                round((server.n_bytes - first) / 2**20, 2),
                round(float(np.median(notes, axis=0)[3]), 2),
            )  # fmt: skip


@common.command("horizon.csv")
@common.rasters_argument
@common.option("--side", default=8192, help="Of the mirrored DEMs.")
@common.option("--mode", "modes", cls=common.ListOption, default=("adaptive", "batched"))
@common.option("--above", default=LOW[1], help="Metres over the highest ground around.")
def main(paths: list[Path], side: int, modes: tuple[str, ...], above: float, folder, out) -> None:
    """Measure, print and write the CSV."""
    common.write_rows(
        out,
        (row for dem in paths for mode in modes for row in measure(dem, mode, side, above, folder)),
    )


if __name__ == "__main__":
    main()
