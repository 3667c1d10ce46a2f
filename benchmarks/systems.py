"""The systems of the sources side by side: ``python -m benchmarks.systems DEM.tif``.

Of one raster all methods at the same bounds; all modes of the viewer from the same cameras at
one error on screen; and the papers' own figures beside those.

``--only dynamic`` flies over the first 512 samples a side, down on them, and low towards the far
corner: mode dynamic against rqt at one threshold, by the papers' errors, by coefficients of cdf53
and by measured ones; and dynamic by steps, down and 30 times as fast. `largest_pixels` is the
largest distance on screen of some originals in view.

CPU times are of the drawing thread, by its own clock, without draw calls: a software driver draws
in that thread. "frame" is the time until the driver has drawn. Bytes are those handed to moderngl.
"""

import contextlib
import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import moderngl
import numpy as np

import terrainwave
from benchmarks import common, tables
from benchmarks.rasters import coefficients_of, load_raster
from benchmarks.render import camera_at_key
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
from terrainwave.render.modes import MODES
from terrainwave.render.modes.front import eye_of
from terrainwave.render.scene.camera import Camera, Viewport, gamma_guaranteed, home, look, project
from terrainwave.render.scene.selection import View
from terrainwave.tri.dynamic.dynamic import DynamicMesh
from terrainwave.tri.rqt.view import RestrictedMesh

# The papers' figures; "ours" are format strings.
PAPERS = Path(__file__).with_name("papers.csv")
BOUNDS = (1.0, 3.0, 10.0)
METHODS = ("predictive", "cdf97", "cdf53", "store")
EMBEDDED = "cdf53"
# Of the file that all modes draw.
VIEW_ERROR = 1.0
SIZE, TAU = (640, 480), 2.0
N_FRAMES, N_DRAWN = 20, 3
# A mode builds what comes into view as the camera moves; degrees per frame.
TURN = 0.5
# Cameras: name and key, as in `benchmarks.render`.
# Zhang et al.'s factor, and their other filter.
VARIANTS = {
    "batched, paper, μ = 0.5": {"mode": "batched", "error": "paper"},
    "batched, paper, μ = 1": {"mode": "batched", "error": "paper", "detail": 1.0},
    "batched, order 2": {"mode": "batched", "order": 2},
}
KEYS = {"slope": (0.10, 0.10, 0.030, 45, -20), "low": (0.30, 0.35, 0.004, 75, -14)}
# Of the flights. Shapes of meshes follow from the ratio of metres per sample to heights.
SIDE, TAUS, SCREEN = 512, (1.0, 2.0, 4.0), Viewport(1280, 720)
PIXEL, MORPH, N_CHECKED = 118.0, 1.25, 400

# One method at one bound, without meshes. Where the goal is "rate", it was the size of predictive.
MethodRow = namedtuple(
    "MethodRow", "raster method goal max_error bits_per_sample rmse measured_error"
)
# Milliseconds, medians over frames. `tau` is what the scene kept, pixels; what was asked for in
# mode full, which splits all. `submitted` are the triangles the GPU is asked for: in mode
# vertex-texture those of whole patches. `first_bytes` were uploaded until the picture was whole.
# `largest_pixels`: of the bounds of all blocks drawn, in mode batched.
ModeRow = namedtuple(
    "ModeRow",
    "raster renderer camera mode tau triangles submitted cpu_ms frame_ms first_bytes frame_bytes "
    "largest_pixels",
)  # fmt: skip
# A flight; milliseconds of CPU time of the one thread.
FlightRow = namedtuple(
    "FlightRow",
    "raster view system error side tau frames build_seconds median_ms largest_ms vertices "
    "triangles full_share touched touched_percent largest_pixels",
)  # fmt: skip
# A figure of a paper, ours beside it, and what differs.
PaperRow = namedtuple("PaperRow", "source what paper ours differs")


def measure_methods(dem: Path, folder: Path) -> Iterator[MethodRow]:
    """Yield all methods at all bounds, then cdf53 cut to the sizes of predictive."""
    file = folder / "method.twz"
    sizes: dict[float, float] = {}
    goals = [("max_error", method, bound) for method in METHODS for bound in (0.0, *BOUNDS)]
    for goal, method, bound in [*goals, *(("rate", EMBEDDED, bound) for bound in BOUNDS)]:
        cut = {"method": terrainwave.Cdf53(rate=sizes[bound])} if goal == "rate" else {}
        bounded = {"method": method, "max_error": bound}
        terrainwave.compress(dem, file, mesh="none", verify=False, overwrite=True, **cut or bounded)
        report = terrainwave.verify(file, dem)
        assert report.ok, report.problems
        with terrainwave.open(file) as terrain:
            bits = round(8 * file.stat().st_size / (terrain.shape[0] * terrain.shape[1]), 4)
        sizes.setdefault(bound, bits)
        errors = round(report.errors.rmse, 4), report.errors.max_error
        yield MethodRow(dem.stem, method, goal, bound, bits, *errors)


@contextlib.contextmanager
def counted_uploads() -> Iterator[list[int]]:
    """Give the bytes of each write to a buffer or a texture meanwhile."""
    sizes: list[int] = []

    def counting(write):
        def count(target, data, *args, **options):
            sizes.append(memoryview(data).nbytes)
            return write(target, data, *args, **options)

        return count

    with contextlib.ExitStack() as stack:
        for kind in (moderngl.Buffer, moderngl.Texture, moderngl.TextureArray):
            stack.enter_context(mock.patch.object(kind, "write", counting(kind.write)))
        yield sizes


@contextlib.contextmanager
def no_draw_calls() -> Iterator[list[int]]:
    """Leave out draw calls; give the triangles of each that draws instances."""
    submitted: list[int] = []

    def render(array, mode=None, vertices=-1, *, first=0, instances=-1):
        n = array.vertices if vertices < 0 else vertices
        submitted.append(n // 3 * max(instances, 0))

    with (
        mock.patch.object(moderngl.VertexArray, "render", render),
        mock.patch.object(moderngl.VertexArray, "render_indirect"),
    ):
        yield submitted


def camera_of(name: str, canvas: Canvas) -> Camera:
    """Return the camera of a name."""
    if name == "overview":
        return home(canvas.scene.frame.box, canvas.viewport)
    return camera_at_key(canvas.scene.frame, KEYS[name])


def measure_mode(file: Path, name: str, camera_name: str, mode: str) -> ModeRow:
    """Return what a mode draws and takes from one camera; nothing has been read before."""
    with (
        terrainwave.open(file) as terrain,
        Canvas(
            terrain, SIZE, samples=0, horizon=False, **VARIANTS.get(mode, {"mode": mode})
        ) as canvas,
    ):
        camera = camera_of(camera_name, canvas)
        with counted_uploads() as first:
            frames = canvas.draw(camera, Style(), max_pixel_error=TAU)
        canvas.context.finish()
        is_partwise = canvas.scene.mode.is_partwise
        cpu_ms, frame_bytes, mine = (None,) * 3 if is_partwise else _turn(canvas, camera)
        times = []
        for number in range(1 if is_partwise else N_DRAWN):
            started = time.perf_counter()
            canvas.draw(look(camera, TURN * number, 0), Style(), max_pixel_error=TAU)
            canvas.context.finish()
            times.append((time.perf_counter() - started) * 1e3)
        return ModeRow(
            name, str(canvas.context.info["GL_RENDERER"]), camera_name, mode,
            round(frames.tau or TAU, 3), frames.n_triangles,
            mine if mode == "vertex-texture" else frames.n_triangles, cpu_ms,
            round(float(np.median(times)), 1), sum(first), frame_bytes,
            _largest_error(canvas, camera) if mode.startswith("batched") else None,
        )  # fmt: skip


def _largest_error(canvas: Canvas, camera: Camera) -> float:
    """Return the largest error of a block on screen, pixels, by the bound that it has."""
    scene = canvas.scene
    frames = scene.settle(scene.view(camera, canvas.viewport, TAU))
    blocks = [scene.table.pieces[node].block for node in frames.nodes.tolist()]
    errors = [scene.mode.grid(block).error for block in blocks]
    pixels = np.array(errors) * gamma_guaranteed(camera, canvas.viewport) / frames.distances
    return round(float(pixels.max()), 2)


def _turn(canvas: Canvas, camera: Camera) -> tuple[float, int, int]:
    """Return CPU milliseconds, bytes and instanced triangles of a frame of a turn; all is here."""
    scene, viewport = canvas.scene, canvas.viewport
    cameras = [look(camera, TURN * number, 0) for number in range(N_FRAMES + 1)]
    for moved in [*cameras, camera]:
        scene.settle(scene.view(moved, viewport, TAU))
    times, n_bytes = [], []
    with no_draw_calls() as submitted:
        for moved in cameras[1:]:
            with counted_uploads() as sizes:
                started = time.thread_time()
                view = scene.view(moved, viewport, TAU)
                canvas.renderer.draw(view, scene.update(view), Style())
                times.append((time.thread_time() - started) * 1e3)
            n_bytes.append(sum(sizes))
    return round(float(np.median(times)), 3), int(np.median(n_bytes)), sum(submitted) // N_FRAMES


def measure_modes(dem: Path, folder: Path) -> Iterator[ModeRow]:
    """Yield all modes from all cameras."""
    file = folder / "modes.twz"
    terrainwave.compress(dem, file, max_error=VIEW_ERROR, verify=False, overwrite=True)
    for mode in ("dynamic", "rqt"):
        measure_mode(file, dem.stem, "overview", mode)  # compiles
    for camera in ("overview", *KEYS):
        for mode in (*MODES, *VARIANTS):
            yield measure_mode(file, dem.stem, camera, mode)


def camera_at(view: str, number: int, top: float) -> Camera:
    """Return the view of a frame, 10 m further each frame."""
    away = number * (300.0 if view == "fast" else 10.0)
    if view == "low":
        x = 100 * PIXEL + away
        return Camera((x, -x, top + 5000), 135, -20, 60)
    middle = 256 * PIXEL
    return Camera((middle + away, -1.5 * middle + away, top + 0.9 * middle), 0, -60, 45)


def largest_pixels(frame, heights, camera: Camera, rng) -> float:
    """Return the largest distance on screen of some originals in view from a mesh, pixels."""
    rows, cols = rng.integers(0, heights.shape, (20 * N_CHECKED, 2)).T
    points = np.column_stack([cols * PIXEL, -rows * PIXEL, heights[rows, cols].astype(float)])
    seen = project(camera, SCREEN, points)[:, :2]
    size = np.array([SCREEN.width, SCREEN.height])
    with np.errstate(invalid="ignore"):
        inside = np.flatnonzero(((seen > 0) & (seen < size)).all(axis=1))[:N_CHECKED]
    a, b, c = (frame.vertices[frame.triangles[:, k]] for k in range(3))
    whole = _cross(b - a, c - a)
    largest = 0.0
    for point, pixel in zip(points[inside], seen[inside], strict=True):
        with np.errstate(all="ignore"):
            one, two = _cross(point - a, c - a) / whole, _cross(b - a, point - a) / whole
            over = np.flatnonzero((one >= -1e-9) & (two >= -1e-9) & (one + two <= 1 + 1e-9))
        for k in over.tolist():
            z = a[k, 2] + one[k] * (b[k, 2] - a[k, 2]) + two[k] * (c[k, 2] - a[k, 2])
            at = project(camera, SCREEN, np.array([[point[0], point[1], z]]))[0, :2]
            largest = max(largest, float(np.linalg.norm(at - pixel)))
    return largest


def _cross(u, v):
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


def fly(name: str, view: str, system: str, error: str, heights, tau: float, n: int) -> FlightRow:
    """Return what a flight of `n` frames took."""
    top, matrix = float(heights.max()), (PIXEL, 0.0, 0.0, 0.0, -PIXEL, 0.0)
    started = time.thread_time()
    if system.startswith("dynamic"):
        mesh = DynamicMesh(heights, sample_matrix=matrix, error=error)
        n_nodes = mesh.n_nodes
        options = {"morph": MORPH, "is_stepwise": "stepwise" in system}
    else:
        known = {"coefficients": coefficients_of(heights)} if error == "coefficient" else {}
        mesh = RestrictedMesh(heights, sample_matrix=matrix, error=error, **known)
        n_nodes, options = heights.size, {}
    build = time.thread_time() - started
    times, touched = [], []
    # The first update marks all nodes, and the first of all compiles.
    for number in (0, *range(n + 1)):
        camera = camera_at(view, number, top)
        eye = eye_of(View(camera, SCREEN))
        started = time.thread_time()
        frame = mesh.update(eye, tau, **options)
        times.append((time.thread_time() - started) * 1e3)
        touched.append(frame.n_touched)
    n_rows, n_cols = heights.shape
    n_touched, n_triangles = int(np.median(touched[2:])), len(frame.triangles)
    return FlightRow(
        name, view, system, error, n_rows, tau, n, build, float(np.median(times[2:])),
        max(times[2:]), len(frame.vertices), n_triangles,
        n_triangles / (2 * (n_rows - 1) * (n_cols - 1)), n_touched, 100 * n_touched / n_nodes,
        largest_pixels(frame, heights, camera, np.random.default_rng(1)),
    )  # fmt: skip


def measure_flights(dem: Path, n_frames: int) -> Iterator[FlightRow]:
    """Yield the flights."""
    heights = load_raster(dem, SIDE).heights.astype(np.float32)
    runs = [(view, "dynamic", "measured") for view in ("down", "low", "fast")]
    runs += [(view, "dynamic, stepwise", "measured") for view in ("down", "fast")]
    runs += [("down", "rqt", error) for error in ("measured", "paper", "coefficient")]
    for tau in TAUS:
        for run in [*runs, ("down", "dynamic", "paper")]:
            yield fly(dem.name, *run, heights, tau, n_frames)


def compare_papers(results: Path) -> Iterator[PaperRow]:
    """Yield the papers' figures beside those of the CSVs, which `PAPERS` names in braces."""
    names = "zerotrees", "zerotree_views", "systems_methods", "systems_modes", "dynamic"
    grid, views, methods, modes, flights = (
        common.read_rows(results / f"{name}.csv") for name in names
    )
    flights = [row for row in flights if row["side"] == SIDE]
    ours = {
        mode: _range(1e3 / row["frame_ms"] for row in modes if row["mode"] == mode)
        for mode in ("adaptive", "batched")
    }
    ours["most"] = max(row["triangles"] for row in modes if row["mode"] == "batched") / 1e6
    views = [row for row in views if (row["trees"], row["max_error"]) == ("coded", 1)]
    views = [row for row in views if row["views"]]
    ours["regular"] = _range(row["median"] for row in views)
    cases: dict[str, list[str]] = {}
    for row in grid:
        if row["trees"] == "coded":
            found = [row[key] for key in ("rmse", "heights_bits", "labels_bits", "total_bits")]
            case = f"case_{row['block']}_{row['max_error']:g}_{row['rings']}"
            figures = " / ".join(f"{value:.3f}" for value in found)
            cases.setdefault(case, []).append(f"{row['raster']} {figures}")
            heights = f"{row['raster']} {found[1]:.3f}"
            cases.setdefault(f"heights_{case}", []).append(heights)
    ours |= {case: "; ".join(figures) for case, figures in cases.items()}
    for row in flights:
        if row["view"] == "down":
            ours[f"{row['system']}_{row['error']}_{row['tau']:g}"] = row["triangles"]
    touched = (row["touched_percent"] for row in flights if row["system"] == "dynamic")
    ours["touched"] = _range(touched)
    for row in methods:
        if (row["method"], row["goal"], row["max_error"]) == (EMBEDDED, "max_error", 0):
            ours[EMBEDDED] = 16 / row["bits_per_sample"]
    made = tables.rows_of(tables.TABLES["zerotree_pyramids"], results)
    ours |= {case: _range((row[case] for row in made), 2) for case in ("growing", "neville")}
    for row in common.read_rows(PAPERS):
        yield PaperRow(**row | {"ours": row["ours"].format_map(ours)})


def _range(values, n_digits: int = 1) -> str:
    ordered = sorted(values)
    return f"{ordered[0]:.{n_digits}f}–{ordered[-1]:.{n_digits}f}"


PARTS = ("methods", "modes", "papers", "dynamic")


@common.command()
@common.dem_argument
@common.choices_option("--only", of=PARTS, default=PARTS[:3])
@common.option("--frames", type=common.COUNT, default=60, help="Of each flight.")
def main(dem: Path, only: tuple[str, ...], frames: int, folder: Path, out: Path) -> None:
    """Measure, print and write the CSVs."""
    measures = {
        "methods": ("systems_methods", lambda: measure_methods(dem, folder)),
        "modes": ("systems_modes", lambda: measure_modes(dem, folder)),
        "papers": ("systems_papers", lambda: compare_papers(out)),
        "dynamic": ("dynamic", lambda: measure_flights(dem, frames)),
    }
    for part in only:
        name, measure = measures[part]
        common.write_rows(out / f"{name}.csv", measure())


if __name__ == "__main__":
    main()
