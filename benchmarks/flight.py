"""Fly in real time over a large file: ``python -m benchmarks.flight DEM.tif`` or ``FILE.twz``.

Frames are paced at 60 per second of wall clock and the camera follows the clock, whatever frames
take. Uploads go to a surface that draws nothing, a GPU that costs nothing, as software rendering
would take the cores that decode; with ``--gpu`` they go to OpenGL and are drawn. A DEM is mirrored
to --side samples first, and compressed by `rapid`.

`web` are the jumps and `web-low` the low flight over http, from a server 50 ms away, 20 Mbit/s.

A frame is *above τ* if something in it has a larger error on screen than τ and the file has finer
data for it; the largest error on screen is of such pieces (τ where there are none). Times to τ: of
a jump until all is within τ; of other flights from opening the file. CPU is the drawing thread's.
"""

import contextlib
import math
import time
from collections import namedtuple
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np

import terrainwave
from benchmarks import common
from benchmarks.rasters import mirrored_file
from benchmarks.render import CountingFile
from benchmarks.slow_server import SlowServer
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.gpu.surfaces import surface_of
from terrainwave.render.look.style import Style
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Camera, Viewport
from terrainwave.render.scene.frame import frame_of
from terrainwave.render.scene.selection import View

HERTZ = 60
# Frames after which a flight has begun: the first picture is not a part of it.
SETTLING_S = 2.0
# Metres per second, metres over the highest ground around, degrees: how flights are.
LOW, FAST = (250.0, 300.0, -12.0), (2500.0, 1000.0, -15.0)
TURN_DEGREES_PER_S = 2.0
# Metres over the ground, degrees: down at a place, as when one looks for it; low, to the horizon.
JUMPS = {"jump": (1000.0, -30.0), "horizon": LOW[1:]}
N_JUMPS, JUMP_TIMEOUT_S = 13, 10.0
# From a server with 50 ms of latency and 20 Mbit/s.
WEB = {"web": "jump", "web-low": "low"}
WHATS = ("low", "fast", "jump", "horizon", "spiral", *WEB)
# A spiral: from and to so many metres over the ground, radius in metres, degrees per second.
SPIRAL_HEIGHTS, SPIRAL_RADIUS, SPIRAL_TURN = (6000.0, 300.0), 3000.0, 15.0
Place = Callable[[float], Camera]

# One line of the CSV: milliseconds of CPU, pixels of error.
Row = namedtuple(
    "Row",
    "renderer what mode speed frames late_frames above_tau_share missing_share median_error_px "
    "p99_error_px largest_error_px median_time_to_tau_s time_to_tau_s median_cpu_ms p99_cpu_ms "
    "median_build_ms p99_build_ms built cancelled read_mib median_triangles store_mib fps low_fps "
    "horizon median_blocks median_wanted",
)  # fmt: skip


class _Nothing:
    """Stands for any object of OpenGL: takes what is written and does nothing."""

    size = (4, 1 << 30)

    def write(self, data: Any, **_: Any) -> None:
        """Take data; memory is read once, as an upload does."""
        memoryview(data).tobytes()

    def read(self) -> bytes:
        """Return what is there: nothing."""
        return b""

    def get(self, _name: str, default: Any = None) -> Any:
        """Say that a program has no such uniform."""
        return default

    def __getattr__(self, _name: str) -> Callable[..., None]:
        return lambda *_, **__: None


class _Buffer(_Nothing):
    size = 1 << 62


class NoGpu(_Nothing):
    """A context of OpenGL that accepts all and draws nothing."""

    version_code, info = 430, {"GL_MAX_ARRAY_TEXTURE_LAYERS": 2048}

    def _make(self, *_: Any, **__: Any) -> _Nothing:
        return _Nothing()

    def buffer(self, *_: Any, **__: Any) -> _Buffer:
        """Return a buffer that is always large enough."""
        return _Buffer()

    texture = texture_array = program = vertex_array = _make


class Ground:
    """Heights over which cameras fly: the highest around, of a coarse level of another opening."""

    def __init__(self, path: Path, radius: float | None) -> None:
        with terrainwave.open(path) as terrain:
            self.frame = frame_of(terrain, radius=radius)
            level = max(terrain.n_levels - 6, 0)
            heights = np.asarray(
                terrain.read(level=level, masked=True).astype(float).filled(np.nan)
            )
            self._stride = terrain.grid.stride(level)
        wide = np.pad(heights, 1, mode="edge")
        shifts = [
            wide[r : r + heights.shape[0], c : c + heights.shape[1]]
            for r in range(3)
            for c in range(3)
        ]
        self._heights = np.nanmax(np.stack(shifts), axis=0) * self.frame.metres[2]
        a, b, c, d, e, f = self.frame.sample_matrix
        self._inverse = np.linalg.inv(np.array([[a, b], [d, e]])), np.array([c, f])

    def height(self, x: float, y: float) -> float:
        """Return the highest ground around a place, local metres, smoothly."""
        matrix, origin = self._inverse
        col, row = matrix @ (np.array([x, y]) - origin) / self._stride
        n_rows, n_cols = self._heights.shape
        row, col = min(max(row, 0.0), n_rows - 1.001), min(max(col, 0.0), n_cols - 1.001)
        r, c = int(row), int(col)
        part = self._heights[r : r + 2, c : c + 2]
        weights = np.outer([1 - (row - r), row - r], [1 - (col - c), col - c])
        return float((part * weights).sum())


class Flights:
    """The ways that are flown: places at times."""

    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        low, high = ground.frame.box
        self._low, self._size = low[:2], (high - low)[:2]

    def straight(self, speed: float, above: float, pitch: float) -> Place:
        """Return a flight at one speed over the ground, in a wide curve that stays over it."""

        def at(seconds: float) -> Camera:
            turn = math.radians(TURN_DEGREES_PER_S)
            radius = min(speed / turn, float(self._size.min()) * 0.3)
            angle = speed * seconds / radius
            x, y = (
                self._low + self._size / 2 + radius * np.array([-math.cos(angle), math.sin(angle)])
            )
            return self._camera(x, y, above, math.degrees(angle), pitch)

        return at

    def spiral(self, seconds: float) -> Place:
        """Return a way down around the middle, in `seconds`."""
        top, bottom = SPIRAL_HEIGHTS

        def at(now: float) -> Camera:
            above = top * (bottom / top) ** min(now / seconds, 1.0)
            angle = math.radians(SPIRAL_TURN) * now
            side = SPIRAL_RADIUS * np.array([-math.cos(angle), math.sin(angle)])
            x, y = self._low + self._size * 0.4 + side
            return self._camera(x, y, above, math.degrees(angle), -30.0)

        return at

    def jumps(self, above: float, pitch: float) -> list[Camera]:
        """Return places far from one another."""
        random = np.random.default_rng(5)
        places = self._low + self._size * random.uniform(0.1, 0.9, (N_JUMPS, 2))
        headings = random.uniform(0, 360, N_JUMPS)
        return [
            self._camera(x, y, above, heading, pitch)
            for (x, y), heading in zip(places, headings, strict=True)
        ]

    def _camera(self, x: float, y: float, above: float, heading: float, pitch: float) -> Camera:
        z = self._ground.height(x, y) + above
        return Camera((float(x), float(y), z), heading % 360, pitch)


class Session:
    """A file opened, its scene and what takes the uploads."""

    def __init__(
        self, file: Any, mode: str, viewport: Viewport, *, gpu: bool, n_threads: int, memory: int,
        **options: Any,
    ) -> None:  # fmt: skip
        self.viewport, self._closing = viewport, contextlib.ExitStack()
        self.opened = time.perf_counter()
        self.terrain = self._closing.enter_context(terrainwave.open(file))
        if gpu:
            self._canvas = self._closing.enter_context(
                Canvas(
                    self.terrain, (viewport.width, viewport.height), mode=mode, samples=0,
                    n_workers=n_threads, max_bytes=memory << 20, **options,
                )
            )  # fmt: skip
            self.renderer = str(self._canvas.context.info["GL_RENDERER"])
            self.scene = self._canvas.scene
        else:
            side = self.terrain.grid.block
            self._surface = surface_of(mode, NoGpu(), side, max_bytes=memory << 20)
            self.scene = self._closing.enter_context(
                Scene(self.terrain, self._surface.store, mode=mode, n_workers=n_threads, **options)
            )
            self.renderer = "none"

    def submit(self, view: View, frames: Any) -> None:
        """Draw a frame, or do the processor's part of it."""
        if self.renderer == "none":
            self._surface.submit(self.scene, view, frames)
            return
        self._canvas.framebuffer.use()
        self._canvas.renderer.draw(view, frames, Style())
        self._canvas.context.finish()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.close()


class Recorder:
    """Runs frames by the clock and notes what they took and drew."""

    def __init__(self, session: Session, tau: float) -> None:
        self._session, self._tau = session, tau
        # Of each frame: seconds since the start, CPU ms, wall ms, error, missing, triangles, blocks
        # drawn and wanted.
        self.notes: list[tuple[float, ...]] = []
        self.n_late = 0
        self.reached: list[float] = []  # seconds until all was within τ

    def frame(self, camera: Camera, now: float) -> bool:
        """Page, select, submit; return whether all is within τ."""
        session, scene = self._session, self._session.scene
        started, cpu = time.perf_counter(), time.thread_time()
        view = scene.view(camera, session.viewport, self._tau)
        frames = scene.update(view)
        session.submit(view, frames)
        cpu_ms, wall_ms = (time.thread_time() - cpu) * 1e3, (time.perf_counter() - started) * 1e3
        error = scene.drawn_error(view, frames) / view.max_pixel_error * self._tau
        if not len(frames.nodes):  # a hole
            error = math.hypot(session.viewport.width, session.viewport.height)
        blocks = len(frames.nodes), len(scene.wanted)
        self.notes.append(
            (now, cpu_ms, wall_ms, error, frames.n_missing, frames.n_triangles, *blocks)
        )
        return error <= self._tau * (1 + 1e-9)

    def fly(self, place: Place, seconds: float, *, since: float = 0.0, stops: bool = False) -> None:
        """Fly by the clock; note when all was within τ first, and stop there if asked to."""
        start, number, is_reached = time.perf_counter(), 0, False
        since = since or start
        while (now := time.perf_counter() - start) < seconds:
            if self.frame(place(now), now) and not is_reached:
                is_reached = True
                self.reached.append(time.perf_counter() - since)
                if stops:
                    return
            number += 1
            wait = number / HERTZ - (time.perf_counter() - start)
            if wait < 0:  # these frames are lost
                lost = math.ceil(-wait * HERTZ)
                number, self.n_late = number + lost, self.n_late + lost
                wait = number / HERTZ - (time.perf_counter() - start)
            time.sleep(max(wait, 0.0))
        if not is_reached:
            self.reached.append(math.inf)

    def row(self, what: str, speed: float, n_read: int, settling: float) -> Row:
        """Return the line of the CSV."""
        session, scene = self._session, self._session.scene
        seconds, cpu_ms, wall_ms, errors, missing, *drawn_parts = np.array(self.notes).T
        flown = seconds >= settling
        drawn = errors[flown]
        above = drawn > self._tau * (1 + 1e-9)
        builds = np.array(scene.build_ms or [0.0])
        triangles, *blocks = (float(np.median(part[flown])) for part in drawn_parts)
        fps = low_fps = math.nan
        if session.renderer != "none":
            fps, low_fps = 1e3 / np.median(wall_ms), 1e3 / np.quantile(wall_ms, 0.99)
        numbers = [
            above.mean(), (missing[flown] > 0).mean(), *np.quantile(drawn, [0.5, 0.99, 1.0]),
            np.median(self.reached), max(self.reached), *np.quantile(cpu_ms[flown], [0.5, 0.99]),
            *np.quantile(builds, [0.5, 0.99]),
        ]  # fmt: skip
        return Row(
            session.renderer, what, scene.mode.name, speed, int(flown.sum()), self.n_late,
            *(round(float(number), 4) for number in numbers), len(builds), scene.n_cancelled,
            round(n_read / 2**20, 2), triangles,
            round(scene.store.n_bytes / 2**20, 1), round(float(fps), 1), round(float(low_fps), 1),
            scene.has_horizon, *blocks,
        )  # fmt: skip


def flights_of(ground: Ground, seconds: float) -> dict[str, tuple[float, Place]]:
    """Return the flights by name, with their speeds."""
    flights = Flights(ground)
    return {
        "low": (LOW[0], flights.straight(*LOW)),
        "fast": (FAST[0], flights.straight(*FAST)),
        "spiral": (round(SPIRAL_RADIUS * math.radians(SPIRAL_TURN)), flights.spiral(seconds)),
    }


def measure(session: Session, ground: Ground, what: str, seconds: float, tau: float) -> Recorder:
    """Fly, or jump; return what was noted."""
    recorder = Recorder(session, tau)
    if what in JUMPS:
        first, *others = Flights(ground).jumps(*JUMPS[what])
        session.scene.settle(session.scene.view(first, session.viewport, tau))
        for camera in others:
            recorder.fly(lambda _, camera=camera: camera, JUMP_TIMEOUT_S, stops=True)
    else:
        _, place = flights_of(ground, seconds)[what]
        recorder.fly(place, seconds, since=session.opened)
    return recorder


def row_of(path: Path, ground: Ground, what: str, seconds: float, tau: float, **options) -> Row:
    """Return the row of a flight from a file, or over a slow line (`WEB`)."""
    flown, settling = WEB.get(what, what), 0.0 if WEB.get(what, what) in JUMPS else SETTLING_S
    speed = 0.0 if flown in JUMPS else flights_of(ground, seconds)[flown][0]
    with contextlib.ExitStack() as closing:
        if what in WEB:
            server = closing.enter_context(SlowServer(path.parent))
            session = closing.enter_context(Session(server.url(path.name), **options))
            recorder = measure(session, ground, flown, seconds, tau)
            return recorder.row(what, speed, server.n_bytes, settling)
        file = closing.enter_context(contextlib.closing(CountingFile(path)))
        session = closing.enter_context(Session(file, **options))
        recorder = measure(session, ground, flown, seconds, tau)
        return recorder.row(what, speed, file.n_read, settling)


@common.command("flight.csv")
@common.dem_argument
@common.option("--seconds", default=20.0, help="Of each flight.")
@common.option("--side", default=16384, help="Of the mirrored DEM.")
@common.option("--max-error", default=1.0)
@common.option("--mode", "modes", cls=common.ListOption, default=("adaptive", "batched"))
@common.choices_option("--what", of=WHATS)
@common.option("--size", default="1920x1080")
@common.option("--max-pixel-error", "tau", default=1.0)
@common.option("--threads", default=2)
@common.option("--memory", default=1024, help="MiB.")
@common.option("--radius", type=float, help="Of the body, without a CRS.")
@common.option("--gpu", is_flag=True, help="Draw by OpenGL.")
def main(
    dem, seconds, side, max_error, modes, what, size, tau, threads, memory, radius, gpu, folder, out
) -> None:
    """Measure, print and write the CSV."""
    viewport = Viewport(*(int(part) for part in size.split("x")))
    path = dem
    if dem.suffix != ".twz":
        path = mirrored_file(dem, side, folder, max_error=max_error, method="rapid")
    ground = Ground(path, radius)

    def rows() -> Iterator[Row]:
        for mode in modes:
            options = {
                "mode": mode, "viewport": viewport, "gpu": gpu, "n_threads": threads,
                "memory": memory,
            }  # fmt: skip
            options |= {} if radius is None else {"radius": radius}
            _warm_up(path, ground, tau, options)
            for one in what:
                yield row_of(path, ground, one, seconds, tau, **options)

    common.write_rows(out, rows())


def _warm_up(path: Path, ground: Ground, tau: float, options: dict[str, Any]) -> None:
    """Compile what flights use."""
    with Session(path, **options | {"gpu": False, "memory": 256}) as session:
        for camera in Flights(ground).jumps(*JUMPS["horizon"])[:2]:
            view = session.scene.view(camera, session.viewport, 4 * tau)
            session.submit(view, session.scene.settle(view))
            session.scene.update(view)


if __name__ == "__main__":
    main()
