"""Time the viewer over a large raster: ``python -m benchmarks.render DEM.tif``.

A fixed flight with sharp turns in each mode, without waiting for blocks, as a person would fly; the
triangles of the same views once all blocks are here, at equal guaranteed error on screen; one view
of the same ground in files of two sizes; and the CPU's part of a frame with at least a thousand
blocks in view. The rasters are the DEM, mirrored (`benchmarks.memory`). GPU times are the driver's,
whose name is in the CSV: a software driver's say little about a GPU's. CPU times are of the drawing
thread, by its own clock, so that other work on the machine is not in them; those of paging and of
selection alone are by the wall clock. A stall is a frame whose CPU part takes more than a frame of
60 Hz.

Exit status: 0 good; 2 wrong usage.
"""

import contextlib
import json
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

import terrainwave
from benchmarks.machine import describe_machine
from benchmarks.memory import make_mirrored
from benchmarks.report import CsvSink
from terrainwave.render.camera import Camera, along, home, look, top_view
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
# Frames of a flight as a share of those asked for: the full terrain is slow to draw.
SHARES = {"adaptive": 1.0, "batched": 0.25, "full": 0.01}
# The ground that files of all sizes share, in samples from their first corner.
SHARED_SAMPLES = 4096
SAME_VIEW_FRAMES = 200
STALL_MS = 1000 / 60


@dataclass(frozen=True)
class Row:
    """One line of the CSV; times in milliseconds."""

    renderer: str
    what: str
    size: int
    mode: str
    block: int
    width: int
    height: int
    max_pixel_error: float
    frames: int
    median_frame: float
    p99_frame: float
    median_cpu: float
    p99_cpu: float
    median_page: float
    median_select: float
    median_submit: float
    stalls: int
    read_mib: float
    median_triangles: float
    median_blocks: float
    missing_frames: int
    gpu_mib: float


class CountingFile:
    """A file that counts the bytes read of it."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self.n_read = 0
        self._file = path.open("rb", buffering=0)
        self.seek = self._file.seek
        self.close = self._file.close

    def read(self, length: int = -1) -> bytes:
        """Return what the file gives."""
        data = self._file.read(length)
        self.n_read += len(data)
        return data


class Recorder:
    """What frames took and drew."""

    def __init__(self, offscreen: Offscreen, tau: float, file: CountingFile) -> None:
        self._offscreen, self._tau, self._file = offscreen, tau, file
        self._n_read = file.n_read
        self._frame_ms: list[float] = []
        self._cpu_ms: list[float] = []
        self._parts_ms: list[tuple[float, float, float]] = []
        self._drawn: list[tuple[int, int, int]] = []

    def frame(self, camera: Camera, *, draws: bool) -> None:
        """Page, select, submit, and draw if asked to; nothing is waited for."""
        offscreen, scene = self._offscreen, self._offscreen.scene
        started, cpu = time.perf_counter(), time.thread_time()
        view = scene.view(camera, offscreen.viewport, self._tau)
        frames = scene.update(view)
        updated = time.thread_time()
        offscreen.surface.instances(scene, view, frames).tobytes()
        ended = time.thread_time()
        self._cpu_ms.append((ended - cpu) * 1e3)
        timings = scene.timings
        self._parts_ms.append((timings.page, timings.select, (ended - updated) * 1e3))
        if draws:
            offscreen._target.use()
            offscreen.renderer.draw(view, frames, Style())
            offscreen.context.finish()
        self._frame_ms.append((time.perf_counter() - started) * 1e3)
        self._drawn.append((frames.n_triangles, len(frames.nodes), frames.n_missing))

    def picture(self, camera: Camera) -> None:
        """Draw a picture with all that it needs."""
        started = time.perf_counter()
        frames = self._offscreen.draw(camera, Style(), max_pixel_error=self._tau)
        self._offscreen.context.finish()
        self._frame_ms.append((time.perf_counter() - started) * 1e3)
        self._cpu_ms.append(0.0)
        self._parts_ms.append((0.0, 0.0, 0.0))
        self._drawn.append((frames.n_triangles, len(frames.nodes), frames.n_missing))

    def row(self, what: str, size: int) -> Row:
        """Return the line of the CSV."""
        offscreen = self._offscreen
        triangles, blocks, missing = np.array(self._drawn).T
        numbers = [
            float(np.quantile(times, share))
            for times in (self._frame_ms, self._cpu_ms)
            for share in (0.5, 0.99)
        ]
        return Row(
            str(offscreen.context.info["GL_RENDERER"]),
            what,
            size,
            offscreen.scene.mode.name,
            offscreen.scene.terrain.grid.block,
            offscreen.viewport.width,
            offscreen.viewport.height,
            self._tau,
            len(self._drawn),
            *(round(number, 3) for number in numbers),
            *(round(float(number), 3) for number in np.median(self._parts_ms, axis=0)),
            sum(milliseconds > STALL_MS for milliseconds in self._cpu_ms),
            round((self._file.n_read - self._n_read) / 2**20, 2),
            float(np.median(triangles)),
            float(np.median(blocks)),
            int((missing > 0).sum()),
            round(offscreen.n_bytes / 2**20, 1),
        )


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


def fly(offscreen: Offscreen, file: CountingFile, n_frames: int, tau: float, size: int) -> Row:
    """Return what a flight took; blocks that come late are not waited for."""
    cameras = flight(offscreen.scene.frame)
    offscreen.draw(cameras[0], Style(), max_pixel_error=tau)  # the first picture is not timed
    recorder = Recorder(offscreen, tau, file)
    for number in range(n_frames):
        camera = along(cameras, number / max(n_frames - 1, 1))
        if offscreen.scene.mode.is_partwise:
            recorder.picture(camera)
        else:
            recorder.frame(camera, draws=True)
    return recorder.row("flight", size)


def settled(offscreen: Offscreen, file: CountingFile, tau: float, size: int) -> Row:
    """Return what the views at the keys draw once all that they need is here."""
    recorder = Recorder(offscreen, tau, file)
    for camera in flight(offscreen.scene.frame):
        recorder.picture(camera)
    return recorder.row("views at the keys, settled", size)


def same_view(offscreen: Offscreen, file: CountingFile, tau: float, size: int) -> Row:
    """Return the CPU's part of a view straight down on the ground that all files share."""
    scene, frame = offscreen.scene, offscreen.scene.frame
    ends = np.array([0.0, SHARED_SAMPLES - 1.0])
    corners = frame.samples_to_local(ends, ends)
    low, high = frame.box
    box = (np.array([*corners.min(axis=0), low[2]]), np.array([*corners.max(axis=0), high[2]]))
    camera = top_view(box, offscreen.viewport)
    scene.settle(scene.view(camera, offscreen.viewport, tau))
    recorder = Recorder(offscreen, tau, file)
    for number in range(SAME_VIEW_FRAMES):
        recorder.frame(look(camera, 0.001 * (number % 2), 0), draws=False)
    return recorder.row("same view, CPU only", size)


def many(offscreen: Offscreen, file: CountingFile, n_frames: int, size: int) -> Row | None:
    """Return the CPU's part (select, page, submit) with many blocks in view; nothing is drawn."""
    scene, camera = offscreen.scene, home(offscreen.scene.frame.box, offscreen.viewport)
    tau, n_blocks = 4.0, 0
    while n_blocks < MANY_BLOCKS and tau > 0.01:
        n_blocks = len(scene.settle(scene.view(camera, offscreen.viewport, tau)).nodes)
        tau *= 0.8
    if n_blocks < MANY_BLOCKS:
        return None
    recorder = Recorder(offscreen, tau / 0.8, file)
    for number in range(n_frames):
        recorder.frame(look(camera, 0.01 * number, 0), draws=False)
    return recorder.row("thousand blocks, CPU only", size)


@click.command(help=__doc__)
@click.argument("dem", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--max-error", type=float, default=2.0, show_default=True)
@click.option("--radius", type=float, default=1_737_400.0, help="Of the body, without a CRS.")
@click.option("--size", default="640x480", show_default=True)
@click.option("--samples", default="4096,16384", show_default=True, help="Sides of the rasters.")
@click.option("--frames", "n_frames", type=int, default=300, show_default=True)
@click.option("--max-pixel-error", "tau", type=float, default=2.0, show_default=True)
@click.option("--work-dir", type=click.Path(path_type=Path), help="Keep rasters and files here.")
@click.option("--out", type=click.Path(path_type=Path), default="benchmarks/results/render.csv")
def main(
    dem: Path,
    max_error: float,
    radius: float,
    size: str,
    samples: str,
    n_frames: int,
    tau: float,
    work_dir: Path | None,
    out: Path,
) -> None:
    """Measure, print and write the CSV."""
    width, height = (int(part) for part in size.split("x"))
    with tempfile.TemporaryDirectory() as temporary, CsvSink(out, Row) as sink:
        folder = work_dir or Path(temporary)

        def measured(side: int, mode: str, block: int = 256) -> None:
            file = CountingFile(_file(dem, folder, side, block, max_error))
            with (
                contextlib.closing(file),
                terrainwave.open(file) as terrain,
                Offscreen(
                    terrain, (width, height), mode=mode, samples=0, radius=radius
                ) as offscreen,
            ):
                n = max(round(n_frames * SHARES[mode]), 2)
                rows: list[Row | None] = []
                if block != 256:
                    rows.append(many(offscreen, file, n, side))
                else:
                    rows.append(fly(offscreen, file, n, tau, side))
                    if mode != "full":
                        rows.append(settled(offscreen, file, tau, side))
                    if mode == "adaptive":
                        rows.append(same_view(offscreen, file, tau, side))
            for row in rows:
                if row is not None:
                    sink.write(row)
                    print(row, flush=True)

        sides = [int(part) for part in samples.split(",")]
        measured(min(sides), "adaptive", 64)
        for mode in SHARES:
            for side in sides:
                if mode != "full" or side == min(sides):
                    measured(side, mode)
    out.with_suffix(".json").write_text(json.dumps(describe_machine(), indent=2) + "\n")


def _file(dem: Path, folder: Path, side: int, block: int, max_error: float) -> Path:
    """Return the .twz file of a mirrored raster, made if it is not there."""
    raster, file = folder / f"{dem.stem}-{side}.tif", folder / f"{dem.stem}-{side}-{block}.twz"
    if not file.exists():
        if not raster.exists():
            make_mirrored(dem, raster, side, "tiled")
        terrainwave.compress(raster, file, max_error=max_error, block=block, verify=False)
    return file


if __name__ == "__main__":
    sys.exit(main())
