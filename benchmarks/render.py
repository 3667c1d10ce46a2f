"""Time the viewer over a large raster: ``python -m benchmarks.render DEM.tif``.

The DEM is mirrored. In each mode a fixed flight with sharp turns, without waiting for blocks, as a
person would fly; the same views once all blocks are here; one view of the same ground in files of
two sizes; and the CPU's part of a frame with a thousand blocks in view. GPU times are the driver's,
whose name is in the CSV: a software driver's say little about a GPU's. CPU times are of the drawing
thread, by its own clock; those of paging and selection by the wall clock. A stall is a frame whose
CPU part takes more than a frame of 60 Hz. A frame misses blocks where coarser ones stand in for
them; errors on screen are those of what is drawn and could be finer. `benchmarks.flight` flies by
the clock.
"""

import contextlib
import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import terrainwave
from benchmarks import common
from benchmarks.rasters import mirrored_file
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
from terrainwave.render.scene.camera import Camera, along, home, look, top_view
from terrainwave.render.scene.frame import Frame

# Keys of the flight: places as shares of the extent, heights above the highest as shares of it,
# headings and pitches. Turns of up to 170 degrees between two keys.
KEYS = (
    (0.10, 0.10, 0.05, 45, -25), (0.35, 0.40, 0.02, 100, -20), (0.60, 0.30, 0.03, 270, -30),
    (0.50, 0.60, 0.02, 20, -15), (0.80, 0.80, 0.10, 190, -35), (0.30, 0.85, 0.03, 120, -20),
    (0.15, 0.50, 0.02, 290, -25), (0.45, 0.15, 0.30, 0, -45),
)  # fmt: skip
MANY_BLOCKS, SMALL_BLOCK = 1000, 64
# Frames of a flight as a share of those asked for: the full terrain is slow to draw.
SHARES = {"adaptive": 1.0, "batched": 0.25, "full": 0.01}
# The ground that files of all sizes share, in samples from their first corner.
SHARED_SAMPLES = 4096
SAME_VIEW_FRAMES = 200
STALL_MS = 1000 / 60

# One line of the CSV; times in milliseconds.
Row = namedtuple(
    "Row",
    "renderer what size mode block width height max_pixel_error frames median_frame p99_frame "
    "median_cpu p99_cpu median_page median_select median_submit stalls read_mib "
    "median_triangles median_blocks missing_frames median_error_px p99_error_px gpu_mib",
)  # fmt: skip


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

    def __init__(self, canvas: Canvas, tau: float, file: CountingFile) -> None:
        self._canvas, self._tau, self._file = canvas, tau, file
        self._n_read = file.n_read
        # Of each frame: milliseconds, CPU, paging, selection, submission; what was drawn.
        self._times: list[tuple[float, ...]] = []
        self._drawn: list[tuple[float, ...]] = []

    def frame(self, camera: Camera, *, draws: bool) -> None:
        """Page, select, submit, and draw if asked to; nothing is waited for."""
        canvas, scene = self._canvas, self._canvas.scene
        started, cpu = time.perf_counter(), time.thread_time()
        view = scene.view(camera, canvas.viewport, self._tau)
        frames = scene.update(view)
        updated = time.thread_time()
        canvas.surface.instances(scene, view, frames).tobytes()
        ended = time.thread_time()
        parts = scene.timings.page, scene.timings.select, (ended - updated) * 1e3
        if draws:
            canvas._target.use()
            canvas.renderer.draw(view, frames, Style())
            canvas.context.finish()
        self._note(view, frames, started, (ended - cpu) * 1e3, parts)

    def picture(self, camera: Camera) -> None:
        """Draw a picture with all that it needs."""
        started = time.perf_counter()
        frames = self._canvas.draw(camera, Style(), max_pixel_error=self._tau)
        self._canvas.context.finish()
        view = self._canvas.scene.view(camera, self._canvas.viewport, self._tau)
        self._note(view, frames, started, 0.0, (0.0, 0.0, 0.0))

    def _note(self, view, frames, started: float, cpu_ms: float, parts_ms) -> None:
        self._times.append(((time.perf_counter() - started) * 1e3, cpu_ms, *parts_ms))
        error = 0.0
        if not self._canvas.scene.mode.is_partwise:
            error = self._canvas.scene.drawn_error(view, frames)
        self._drawn.append((frames.n_triangles, len(frames.nodes), frames.n_missing, error))

    def row(self, what: str, size: int) -> Row:
        """Return the line of the CSV."""
        canvas, viewport = self._canvas, self._canvas.viewport
        triangles, blocks, missing, errors = np.array(self._drawn).T
        frame_ms, cpu_ms, *parts_ms = np.array(self._times).T
        times = [np.quantile(ms, share) for ms in (frame_ms, cpu_ms) for share in (0.5, 0.99)]
        times += [np.median(ms) for ms in parts_ms]
        return Row(
            str(canvas.context.info["GL_RENDERER"]), what, size, canvas.scene.mode.name,
            canvas.scene.terrain.grid.block, viewport.width, viewport.height, self._tau,
            len(self._drawn), *(round(float(ms), 3) for ms in times),
            int((cpu_ms > STALL_MS).sum()), round((self._file.n_read - self._n_read) / 2**20, 2),
            float(np.median(triangles)), float(np.median(blocks)), int((missing > 0).sum()),
            *(round(float(np.quantile(errors, share)), 2) for share in (0.5, 0.99)),
            round(canvas.n_bytes / 2**20, 1),
        )  # fmt: skip


def camera_at_key(frame: Frame, key: tuple[float, ...]) -> Camera:
    """Return the camera at a key."""
    low, high = frame.box
    size = high - low
    x, y, z, heading, pitch = key
    place = low[0] + x * size[0], low[1] + y * size[1], high[2] + z * float(size[0])
    return Camera(place, heading, pitch, 60.0)


def fly(canvas: Canvas, file: CountingFile, n_frames: int, tau: float, size: int) -> Row:
    """Return what a flight took; blocks that come late are not waited for."""
    cameras = [camera_at_key(canvas.scene.frame, key) for key in KEYS]
    canvas.draw(cameras[0], Style(), max_pixel_error=tau)  # the first picture is not timed
    recorder = Recorder(canvas, tau, file)
    for number in range(n_frames):
        camera = along(cameras, number / max(n_frames - 1, 1))
        if canvas.scene.mode.is_partwise:
            recorder.picture(camera)
        else:
            recorder.frame(camera, draws=True)
    return recorder.row("flight", size)


def same_view(canvas: Canvas, file: CountingFile, tau: float, size: int) -> Row:
    """Return the CPU's part of a view straight down on the ground that all files share."""
    scene, frame = canvas.scene, canvas.scene.frame
    ends = np.array([0.0, SHARED_SAMPLES - 1.0])
    corners = frame.samples_to_local(ends, ends)
    low, high = frame.box
    box = (np.array([*corners.min(axis=0), low[2]]), np.array([*corners.max(axis=0), high[2]]))
    camera = top_view(box, canvas.viewport)
    scene.settle(scene.view(camera, canvas.viewport, tau))
    recorder = Recorder(canvas, tau, file)
    for number in range(SAME_VIEW_FRAMES):
        recorder.frame(look(camera, 0.001 * (number % 2), 0), draws=False)
    return recorder.row("same view, CPU only", size)


def many(canvas: Canvas, file: CountingFile, n_frames: int, size: int) -> Row | None:
    """Return the CPU's part (select, page, submit) with many blocks in view; nothing is drawn."""
    scene, camera = canvas.scene, home(canvas.scene.frame.box, canvas.viewport)
    tau, n_blocks = 4.0, 0
    while n_blocks < MANY_BLOCKS and tau > 0.01:
        n_blocks = len(scene.settle(scene.view(camera, canvas.viewport, tau)).nodes)
        tau *= 0.8
    if n_blocks < MANY_BLOCKS:
        return None
    recorder = Recorder(canvas, tau / 0.8, file)
    for number in range(n_frames):
        recorder.frame(look(camera, 0.01 * number, 0), draws=False)
    return recorder.row("thousand blocks, CPU only", size)


def measure(
    path: Path, mode: str, n_frames: int, tau: float, side: int, viewport: tuple[int, int], radius
) -> Iterator[Row]:
    """Yield the rows of a file in a mode; of one with small blocks, that with many in view."""
    file = CountingFile(path)
    with (
        contextlib.closing(file),
        terrainwave.open(file) as terrain,
        Canvas(terrain, viewport, mode=mode, samples=0, radius=radius) as canvas,
    ):
        n = max(round(n_frames * SHARES[mode]), 2)
        if terrain.grid.block == SMALL_BLOCK:
            row = many(canvas, file, n, side)
            if row:
                yield row
            return
        yield fly(canvas, file, n, tau, side)
        if mode != "full":
            recorder = Recorder(canvas, tau, file)
            for key in KEYS:
                recorder.picture(camera_at_key(canvas.scene.frame, key))
            yield recorder.row("views at the keys, settled", side)
        if mode == "adaptive":
            yield same_view(canvas, file, tau, side)


@common.command("render.csv")
@common.dem_argument
@common.option("--max-error", default=2.0)
@common.option("--radius", default=1_737_400.0, help="Of the body, without a CRS.")
@common.option("--size", default="640x480")
@common.option("--samples", default="4096,16384", help="Sides of the rasters.")
@common.option("--frames", "n_frames", type=common.COUNT, default=300)
@common.option("--max-pixel-error", "tau", default=2.0)
def main(dem, max_error, radius, size, samples, n_frames, tau, folder, out) -> None:
    """Measure, print and write the CSV."""
    viewport = tuple(int(part) for part in size.split("x"))
    sides = [int(part) for part in samples.split(",")]
    runs = [("adaptive", min(sides), SMALL_BLOCK)]
    runs += [(mode, side, 256) for mode in ("adaptive", "batched") for side in sides]
    runs.append(("full", min(sides), 256))

    def rows() -> Iterator[Row]:
        for mode, side, block in runs:
            file = mirrored_file(dem, side, folder, max_error=max_error, block=block)
            yield from measure(file, mode, n_frames, tau, side, viewport, radius)

    common.write_rows(out, rows())


if __name__ == "__main__":
    main()
