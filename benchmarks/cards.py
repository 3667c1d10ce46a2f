"""The viewer on the card of this machine: ``python -m benchmarks.cards DEM.tif``.

The DEM is mirrored. In each mode the fixed flight of `benchmarks.render`, with sharp turns, and the
low and the fast one of `benchmarks.flight`: by frames here, 60 to a second of flight, each drawn as
soon as the one before it, without waiting for blocks. A frame lasts until the driver has drawn it.

Appends lines that say on which card: by a software driver, such as llvmpipe, they say nothing of a
GPU. `low_fps` is that of the slowest hundredth of the frames. Bytes are those handed to moderngl.
"""

from collections import namedtuple
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

import terrainwave
from benchmarks import common
from benchmarks.flight import FAST, HERTZ, LOW, Flights, Ground
from benchmarks.rasters import mirrored_file
from benchmarks.render import KEYS, camera_at_key
from benchmarks.systems import counted_uploads
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
from terrainwave.render.scene.camera import Camera, along

# What a driver without a card calls itself.
SOFTWARE = ("llvmpipe", "softpipe", "swrast", "swiftshader")

Row = namedtuple(
    "Row",
    "card is_software system mode flight width height tau frames fps low_fps triangles "
    "million_triangles_per_s upload_mb_per_s",
)


def flights_of(
    path: Path, n_frames: int, radius: float | None
) -> dict[str, Callable[[int], Camera]]:
    """Return cameras by flight and number of the frame."""
    ground, turns = Ground(path, radius), max(n_frames - 1, 1)
    keys = [camera_at_key(ground.frame, key) for key in KEYS]
    low, fast = (Flights(ground).straight(*how) for how in (LOW, FAST))
    return {
        "turns": lambda number: along(keys, number / turns),
        "low": lambda number: low(number / HERTZ),
        "fast": lambda number: fast(number / HERTZ),
    }


def measure(
    path: Path, mode: str, size: tuple[int, int], n_frames: int, tau: float, radius: float | None
) -> Iterator[Row]:
    """Yield the flights in a mode."""
    for name, camera_of in flights_of(path, n_frames, radius).items():
        with (
            terrainwave.open(path) as terrain,
            Canvas(terrain, size, mode=mode, samples=0, radius=radius) as canvas,
        ):
            canvas.draw(camera_of(0), Style(), max_pixel_error=tau)  # the first picture: not timed
            canvas.context.finish()
            with counted_uploads() as uploads:
                notes = [frame(canvas, camera_of(number), tau) for number in range(n_frames)]
            yield row_of(canvas, name, tau, np.array(notes), sum(uploads))


def frame(canvas: Canvas, camera: Camera, tau: float) -> tuple[float, int]:
    """Draw a frame; return its seconds and triangles."""
    started = perf_counter()
    frames = canvas.draw(camera, Style(), max_pixel_error=tau, settle=False)
    canvas.context.finish()
    return perf_counter() - started, frames.n_triangles


def row_of(canvas: Canvas, name: str, tau: float, notes: Any, n_bytes: int) -> Row:
    """Return the line of a flight."""
    seconds, triangles = notes.T
    slowest = np.sort(seconds)[-max(len(seconds) // 100, 1) :]
    info, mode, viewport = canvas.context.info, canvas.scene.mode.name, canvas.viewport
    card, total = str(info["GL_RENDERER"]), float(seconds.sum())
    return Row(
        card, any(word in card.lower() for word in SOFTWARE), common.describe_machine()["system"],
        mode, name, viewport.width, viewport.height, tau, len(notes),
        round(len(notes) / total, 2), round(1 / float(slowest.mean()), 2),
        int(np.median(triangles)), round(float(triangles.sum()) / total / 1e6, 2),
        round(n_bytes / total / 1e6, 2),
    )  # fmt: skip


@common.command("cards.csv")
@common.dem_argument
@common.option("--side", default=16384, help="Of the mirrored DEM.")
@common.option("--max-error", default=1.0)
@common.option("--mode", "modes", cls=common.ListOption, default=("adaptive", "batched"))
@common.option("--size", default="1920x1080")
@common.option("--frames", "n_frames", type=common.COUNT, default=600)
@common.option("--max-pixel-error", "tau", default=1.0)
@common.option("--radius", type=float, help="Of the body, without a CRS.")
def main(dem, side, max_error, modes, size, n_frames, tau, radius, folder, out) -> None:
    """Measure, print and append to the CSV."""
    width, height = (int(part) for part in size.split("x"))
    path = mirrored_file(dem, side, folder, max_error=max_error, method="rapid")
    rows = (
        row for mode in modes for row in measure(path, mode, (width, height), n_frames, tau, radius)
    )
    common.write_rows(out, rows, append=True)


if __name__ == "__main__":
    main()
