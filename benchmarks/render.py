"""Time a flight over a large raster: ``python -m benchmarks.render DEM.tif``.

A fixed flight with sharp turns over the raster at two block sizes, without waiting for blocks, as a
person would fly; then the CPU's part of a frame with at least a thousand blocks in view. GPU times
are the driver's, whose name is in the CSV: a software driver's say little about a GPU's.

Exit status: 0 good; 2 wrong usage.
"""

import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

import terrainwave
from benchmarks.report import CsvSink
from terrainwave.render.camera import Camera, along, home, look
from terrainwave.render.frame import Frame
from terrainwave.render.offscreen import Offscreen
from terrainwave.render.style import Style

# Keys of the flight: places as shares of the extent, heights above the highest as shares of it,
# headings and pitches. Turns of up to 170 degrees between two keys.
KEYS = (
    (0.10, 0.10, 0.05, 45, -25), (0.35, 0.40, 0.02, 100, -20), (0.60, 0.30, 0.03, 270, -30),
    (0.50, 0.60, 0.02, 20, -15), (0.80, 0.80, 0.10, 190, -35), (0.30, 0.85, 0.03, 120, -20),
    (0.15, 0.50, 0.02, 290, -25), (0.45, 0.15, 0.30, 0, -45),
)  # fmt: skip
MANY_BLOCKS = 1000


@dataclass(frozen=True)
class Row:
    """One line of the CSV; times in milliseconds."""

    renderer: str
    what: str
    block: int
    width: int
    height: int
    max_pixel_error: float
    frames: int
    median_frame: float
    p99_frame: float
    largest_frame: float
    median_page: float
    median_select: float
    median_cpu: float
    p99_cpu: float
    median_triangles: float
    median_blocks: float
    missing_frames: int
    gpu_mib: float


def flight(frame: Frame) -> list[Camera]:
    """Return the cameras at the keys."""
    low, high = frame.box
    size = high - low
    return [
        Camera(
            (low[0] + x * size[0], low[1] + y * size[1], high[2] + z * float(size[0])),
            heading, pitch, 60.0,
        )
        for x, y, z, heading, pitch in KEYS
    ]  # fmt: skip


def fly(offscreen: Offscreen, cameras: list[Camera], n_frames: int, tau: float, block: int) -> Row:
    """Return what a flight took; blocks that come late are not waited for."""
    times, parts, drawn = [], [], []
    offscreen.draw(cameras[0], Style(), max_pixel_error=tau)  # the first picture is not timed
    for number in range(n_frames):
        camera = along(cameras, number / (n_frames - 1))
        started = time.perf_counter()
        frames = offscreen.draw(camera, Style(), max_pixel_error=tau, settle=False)
        offscreen.context.finish()
        times.append((time.perf_counter() - started) * 1e3)
        timings = offscreen.scene.timings
        parts.append((timings.page, timings.select))
        drawn.append((frames.n_triangles, len(frames.nodes), frames.n_missing))
    return _row(offscreen, "flight", block, tau, times, parts, drawn)


def many(offscreen: Offscreen, n_frames: int, block: int) -> Row | None:
    """Return the CPU's part (select, page, submit) with many blocks in view; nothing is drawn."""
    scene, camera = offscreen.scene, home(offscreen.scene.frame.box, offscreen.viewport)
    tau, n_blocks = 4.0, 0
    while n_blocks < MANY_BLOCKS and tau > 0.01:
        n_blocks = len(scene.settle(scene.view(camera, offscreen.viewport, tau)).nodes)
        tau *= 0.8
    if n_blocks < MANY_BLOCKS:
        return None
    tau /= 0.8
    times, parts, drawn = [], [], []
    for number in range(n_frames):
        view = scene.view(look(camera, 0.01 * number, 0), offscreen.viewport, tau)
        started = time.thread_time()
        frames = scene.update(view)
        offscreen.surface.instances(scene, view, frames).tobytes()
        offscreen.store.commands(frames.nodes).tobytes()
        times.append((time.thread_time() - started) * 1e3)
        parts.append((scene.timings.page, scene.timings.select))
        drawn.append((frames.n_triangles, len(frames.nodes), frames.n_missing))
    return _row(offscreen, "thousand blocks, CPU only", block, tau, times, parts, drawn)


def _row(offscreen, what, block, tau, times, parts, drawn) -> Row:
    page, select = np.median(np.array(parts), axis=0)
    cpu = times if "CPU" in what else np.array(parts).sum(axis=1)
    triangles, blocks, missing = np.array(drawn).T
    return Row(
        str(offscreen.context.info["GL_RENDERER"]),
        what,
        block,
        offscreen.viewport.width,
        offscreen.viewport.height,
        tau,
        len(times),
        float(np.median(times)),
        float(np.quantile(times, 0.99)),
        float(np.max(times)),
        float(page),
        float(select),
        float(np.median(cpu)),
        float(np.quantile(cpu, 0.99)),
        float(np.median(triangles)),
        float(np.median(blocks)),
        int((missing > 0).sum()),
        offscreen.n_bytes / 2**20,
    )


@click.command(help=__doc__)
@click.argument("dem", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--max-error", type=float, default=2.0, show_default=True)
@click.option("--radius", type=float, help="Of the body, for degrees without a CRS.")
@click.option("--size", default="640x480", show_default=True)
@click.option("--frames", "n_frames", type=int, default=300, show_default=True)
@click.option("--max-pixel-error", "tau", type=float, default=2.0, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), default="benchmarks/results/render.csv")
def main(
    dem: Path,
    max_error: float,
    radius: float | None,
    size: str,
    n_frames: int,
    tau: float,
    out: Path,
) -> None:
    """Measure, print and write the CSV."""
    width, height = (int(part) for part in size.split("x"))
    with tempfile.TemporaryDirectory() as folder, CsvSink(out, Row) as sink:
        for block in (256, 64):
            file = Path(folder) / f"{block}.twz"
            terrainwave.compress(dem, file, max_error=max_error, block=block, verify=False)
            with (
                terrainwave.open(file) as terrain,
                Offscreen(terrain, (width, height), samples=0, radius=radius) as offscreen,
            ):
                rows = [fly(offscreen, flight(offscreen.scene.frame), n_frames, tau, block)]
                if block == 64:
                    rows.append(many(offscreen, n_frames, block))
            for row in rows:
                if row is not None:
                    sink.write(row)
                    print(row)


if __name__ == "__main__":
    sys.exit(main())
