"""The systems of the sources side by side: ``python -m benchmarks.systems DEM.tif``.

Tables of one raster: the grid of Yusov & Turlapov 2010 (blocks, bounds, border rings, method
cdf97 with zerotree meshes); all methods at the same bounds; all modes of the viewer from the same
cameras at one error on screen; and the papers' own figures beside those. Dynamic against rqt at one
threshold comes from ``results/dynamic.csv`` (`benchmarks.dynamic`). ``--pictures`` draws the meshes
of all modes into docs/images.

CPU times are of the drawing thread, by its own clock: view, paging, selection or marks, mesh and
copies to the GPU. Draw calls are left out, as a software driver draws in that thread; "frame" is
the time until the driver has drawn. Bytes are those handed to moderngl for buffers and textures.

Exit status: 0 good; 2 wrong usage.
"""

import contextlib
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import click
import moderngl
import numpy as np

import terrainwave
from benchmarks.report import CsvSink
from benchmarks.tables import read_rows
from terrainwave.codec import registry
from terrainwave.errors import InvalidHeightsError
from terrainwave.render.camera import Camera, Viewport, home, look
from terrainwave.render.frame import Frame
from terrainwave.render.modes import MODES
from terrainwave.render.offscreen import Offscreen
from terrainwave.render.style import Style

RESULTS = Path(__file__).parent / "results"
IMAGES = Path(__file__).parent.parent / "docs" / "images"
BLOCKS, BOUNDS, RINGS = (64, 256), (1.0, 3.0, 10.0), (1, 3)
METHODS = ("predictive", "cdf97", "cdf53", "store")
EMBEDDED = "cdf53"
METHOD_BOUNDS = (0.0, *BOUNDS)
# Of the file that all modes draw.
VIEW_ERROR = 1.0
SIZE, TAU = (640, 480), 2.0
N_FRAMES, N_DRAWN = 20, 3
# A mode builds what comes into view as the camera moves; degrees per frame.
TURN = 0.5
# name: place as shares of the extent, height above the highest as a share of it, heading, pitch
KEYS = {
    "slope": (0.10, 0.10, 0.030, 45, -20),
    "low": (0.30, 0.35, 0.004, 75, -14),
}
PICTURE_SIZE, PICTURE_CAMERA = (400, 300), "slope"


@dataclass(frozen=True)
class GridRow:
    """One case of the grid; bits per sample of the raster, metres.

    `triangles` are those of all blocks of the finest level, `regular` those of the full grid.
    """

    raster: str
    block: int
    max_error: float
    rings: int
    rmse: float
    measured_error: float
    heights_bits: float
    labels_bits: float
    total_bits: float
    triangles: int
    regular: int


@dataclass(frozen=True)
class MethodRow:
    """One method at one bound, without meshes; bits per sample, metres.

    Where the goal is ``rate``, it was the size of predictive at `max_error`.
    """

    raster: str
    method: str
    goal: str
    max_error: float
    bits_per_sample: float
    rmse: float
    measured_error: float


@dataclass(frozen=True)
class ModeRow:
    """One mode from one camera; milliseconds, medians over frames.

    `tau` is what the scene kept, pixels; what was asked for in mode full, which splits all.
    `submitted` are the triangles the GPU is asked for: in mode vertex-texture those of whole
    patches. `first_bytes` were uploaded until the first picture was whole.
    """

    raster: str
    renderer: str
    camera: str
    mode: str
    tau: float
    triangles: int
    submitted: int
    cpu_ms: float | None
    frame_ms: float
    first_bytes: int
    frame_bytes: int | None


@dataclass(frozen=True)
class PaperRow:
    """A figure of a paper, ours beside it, and what differs."""

    source: str
    what: str
    paper: str
    ours: str
    differs: str


# Method and files


def measure_grid(dem: Path, folder: Path) -> Iterator[GridRow]:
    """Yield the cases of the grid."""
    file = folder / "grid.twz"
    for block in BLOCKS:
        for max_error in BOUNDS:
            for rings in RINGS:
                terrainwave.compress(
                    dem, file, max_error=max_error, method="cdf97", block=block,
                    border_rings=rings, mesh="zerotree", verify=False, overwrite=True,
                )  # fmt: skip
                errors = _errors(file, dem)
                with terrainwave.open(file) as terrain:
                    n_rows, n_cols = terrain.shape
                    per_byte = 8 / (n_rows * n_cols)
                    pages = [found.page for found in terrain.container.present_segments()]
                    heights, labels = (
                        sum(int(getattr(page, name).sum()) for page in pages)
                        for name in ("payload_lengths", "mesh_lengths")
                    )
                    blocks = terrain.grid.blocks(terrain.n_levels - 1)
                    n_triangles = sum(len(terrain.block_mesh(found).triangles) for found in blocks)
                yield GridRow(
                    dem.stem, block, max_error, rings, round(errors.rmse, 4), errors.max_error,
                    round(heights * per_byte, 4), round(labels * per_byte, 4),
                    round(file.stat().st_size * per_byte, 4), n_triangles,
                    2 * (n_rows - 1) * (n_cols - 1),
                )  # fmt: skip


def measure_methods(dem: Path, folder: Path) -> Iterator[MethodRow]:
    """Yield all methods at all bounds; those this version lacks are named and left out.

    Then cdf53 cut to the sizes of predictive.
    """
    file = folder / "method.twz"
    sizes: dict[float, float] = {}
    for method in METHODS:
        for max_error in METHOD_BOUNDS:
            try:
                row = _measure_method(dem, file, method, max_error, max_error=max_error)
            except InvalidHeightsError as error:
                print(f"left out: {method}: {error}")
                break
            if method == "predictive":
                sizes[max_error] = row.bits_per_sample
            yield row
    if EMBEDDED in registry.METHODS:
        for bound in BOUNDS:
            yield _measure_method(dem, file, EMBEDDED, bound, rate=sizes[bound])


def _measure_method(dem: Path, file: Path, method: str, bound: float, **goal: float) -> MethodRow:
    """Return what a method takes for one goal of `compress`; `bound` is what the row is about."""
    terrainwave.compress(
        dem, file, method=method, mesh="none", verify=False, overwrite=True, **goal
    )
    errors = _errors(file, dem)
    with terrainwave.open(file) as terrain:
        bits = 8 * file.stat().st_size / (terrain.shape[0] * terrain.shape[1])
    return MethodRow(
        dem.stem, method, next(iter(goal)), bound, round(bits, 4), round(errors.rmse, 4),
        errors.max_error,
    )  # fmt: skip


def _errors(file: Path, dem: Path):
    report = terrainwave.verify(file, dem)
    assert report.ok, report.problems
    assert report.errors is not None
    return report.errors


# Modes


class Uploads:
    """Counts the bytes that go to buffers and textures."""

    def __init__(self) -> None:
        self.n_bytes = 0

    @contextlib.contextmanager
    def counted(self) -> Iterator[None]:
        """Count what is written meanwhile."""
        with contextlib.ExitStack() as stack:
            for kind in (moderngl.Buffer, moderngl.Texture, moderngl.TextureArray):
                stack.enter_context(mock.patch.object(kind, "write", self._counting(kind.write)))
            yield

    def _counting(self, write):
        def counting(target, data, *args, **options):
            self.n_bytes += memoryview(data).nbytes
            return write(target, data, *args, **options)

        return counting


@contextlib.contextmanager
def no_draw_calls() -> Iterator[list[int]]:
    """Leave out draw calls; give the triangles of each that counts its own."""
    submitted: list[int] = []

    def render(array, mode=None, vertices=-1, *, first=0, instances=-1):
        n = array.vertices if vertices < 0 else vertices
        submitted.append(n // 3 * max(instances, 1))

    with (
        mock.patch.object(moderngl.VertexArray, "render", render),
        mock.patch.object(moderngl.VertexArray, "render_indirect"),
    ):
        yield submitted


def cameras(frame: Frame, viewport: Viewport) -> dict[str, Camera]:
    """Return the cameras by name."""
    low, high = frame.box
    size = high - low
    found = {"overview": home(frame.box, viewport)}
    for name, (x, y, z, heading, pitch) in KEYS.items():
        place = low[0] + x * size[0], low[1] + y * size[1], high[2] + z * float(size[0])
        found[name] = Camera(place, heading, pitch, 60.0)
    return found


def measure_mode(file: Path, name: str, camera_name: str, mode: str) -> ModeRow:
    """Return what a mode draws and takes from one camera; nothing has been read before."""
    uploads = Uploads()
    with (
        terrainwave.open(file) as terrain,
        Offscreen(terrain, SIZE, mode=mode, samples=0) as offscreen,
    ):
        camera = cameras(offscreen.scene.frame, offscreen.viewport)[camera_name]
        with uploads.counted():
            frames = offscreen.draw(camera, Style(), max_pixel_error=TAU)
        offscreen.context.finish()
        first_bytes, submitted = uploads.n_bytes, frames.n_triangles
        cpu_ms = frame_bytes = None
        if not offscreen.scene.mode.is_partwise:
            cpu_ms, frame_bytes, mine = _fly(offscreen, camera, uploads)
            submitted = mine if mode == "vertex-texture" else submitted
        times = []
        for number in range(1 if offscreen.scene.mode.is_partwise else N_DRAWN):
            started = time.perf_counter()
            moved = look(camera, TURN * number, 0)
            offscreen.draw(moved, Style(), max_pixel_error=TAU)
            offscreen.context.finish()
            times.append((time.perf_counter() - started) * 1e3)
        return ModeRow(
            name, str(offscreen.context.info["GL_RENDERER"]), camera_name, mode,
            round(frames.tau or TAU, 3), frames.n_triangles, submitted, cpu_ms,
            round(float(np.median(times)), 1), first_bytes, frame_bytes,
        )  # fmt: skip


def _fly(offscreen: Offscreen, camera: Camera, uploads: Uploads) -> tuple[float, int, int]:
    """Return CPU milliseconds, bytes and the last frame's triangles of a turn; all is here."""
    scene, viewport = offscreen.scene, offscreen.viewport
    turn = [look(camera, TURN * number, 0) for number in range(N_FRAMES + 1)]
    for moved in [*turn, camera]:
        scene.settle(scene.view(moved, viewport, TAU))
    times, n_bytes = [], []
    with no_draw_calls() as submitted:
        for moved in turn[1:]:
            with uploads.counted():
                before, started = uploads.n_bytes, time.thread_time()
                view = scene.view(moved, viewport, TAU)
                offscreen.renderer.draw(view, scene.update(view), Style())
                times.append((time.thread_time() - started) * 1e3)
                n_bytes.append(uploads.n_bytes - before)
    return round(float(np.median(times)), 3), int(np.median(n_bytes)), max(submitted)


def draw_pictures(file: Path) -> None:
    """Draw the meshes of all modes from one camera, side by side."""
    from PIL import Image, ImageDraw

    width, height = PICTURE_SIZE
    sheet = Image.new("RGB", (3 * width, 2 * height))
    style = Style(wireframe=True, haze=0, background=(16, 18, 22))
    for k, mode in enumerate(MODES):
        with (
            terrainwave.open(file) as terrain,
            Offscreen(terrain, PICTURE_SIZE, mode=mode) as offscreen,
        ):
            camera = cameras(offscreen.scene.frame, offscreen.viewport)[PICTURE_CAMERA]
            pixels, frames = offscreen.picture(camera, style, max_pixel_error=TAU)
        picture = Image.fromarray(pixels)
        label = f"{mode}: {frames.n_triangles:,}"
        ImageDraw.Draw(picture).text((8, 6), label, fill=(255, 255, 255))
        sheet.paste(picture, (k % 3 * width, k // 3 * height))
    sheet.save(IMAGES / "systems-modes.jpg", quality=48, optimize=True)


# Papers

# Yusov & Turlapov 2010, tables 1 and 2, three rings: (block, bound): RMSE, heights, labels, total
CAUCASUS = {
    (256, 1): (0.553, 3.604, 0.090, 3.694),
    (256, 3): (1.592, 2.086, 0.189, 2.275),
    (256, 10): (4.527, 0.926, 0.208, 1.134),
    (64, 1): (0.566, 3.979, 0.088, 4.067),
    (64, 3): (1.571, 2.368, 0.080, 2.448),
    (64, 10): (4.473, 1.106, 0.071, 1.177),
}
PUGET_SOUND = {
    (256, 1): (0.449, 0.636, 0.193, 0.829),
    (256, 3): (1.120, 0.287, 0.114, 0.401),
    (256, 10): (3.099, 0.116, 0.049, 0.165),
    (64, 1): (0.423, 0.837, 0.036, 0.873),
    (64, 3): (1.077, 0.431, 0.030, 0.461),
    (64, 10): (2.931, 0.210, 0.025, 0.235),
}
_Y06 = "Yusov & Turlapov 2006"
_Y10 = "Yusov & Turlapov 2010"


def compare_papers(results: Path) -> Iterator[PaperRow]:
    """Yield the papers' figures beside those of the CSVs."""
    grid, methods, modes = (
        read_rows(results, name) for name in ("systems", "systems_methods", "systems_modes")
    )
    moving = read_rows(results, "dynamic")
    for row in grid:
        case = int(row["block"]), int(float(row["max_error"]))
        if row["rings"] != "3":
            continue
        found = [row[key] for key in ("rmse", "heights_bits", "labels_bits", "total_bits")]
        paper = "; ".join(
            f"{name} " + " / ".join(f"{value:.3f}" for value in figures[case])
            for name, figures in (("Caucasus", CAUCASUS), ("Puget Sound", PUGET_SOUND))
        )
        yield PaperRow(
            _Y10, f"RMSE / heights / labels / total, block {case[0]}, {case[1]} m", paper,
            " / ".join(f"{float(value):.3f}" for value in found),
            "theirs 8192² at 30 m and 16384² at 10 m, in steps of 0.1 m; ours "
            f"{row['raster']}, in whole metres",
        )  # fmt: skip
    ratios = [int(row["regular"]) / int(row["triangles"]) for row in grid]
    yield PaperRow(
        _Y10, "regular blocks' triangles / adaptive blocks'", "3–5",
        f"{min(ratios):.1f}–{max(ratios):.1f}",
        "theirs of a view on Puget Sound with levels mixed, ours of the finest level",
    )  # fmt: skip
    adaptive = [row for row in modes if row["mode"] == "adaptive"]
    yield PaperRow(
        _Y10, "frames per second", "≥ 100 at 1920 × 1280, up to 1 M triangles", _rate(adaptive),
        "theirs GeForce GTX 295; ours 640 × 480 on a processor",
    )  # fmt: skip
    batched = [row for row in modes if row["mode"] == "batched"]
    yield PaperRow(
        "Zhang, Zhang & Zhang 2012", "frames per second; triangles",
        "≥ 180 at 1024 × 768; 2.539 M, 4.2–5.7 ms per frame",
        f"{_rate(batched)}; {max(int(row['triangles']) for row in batched) / 1e6:.3f} M",
        "theirs GeForce 9600 GT, Hawaii, 13825 × 16769, error factor 0.5 without a bound; ours "
        "a processor, measured errors",
    )  # fmt: skip
    small = [row for row in moving if row["side"] == "512" and row["view"] == "down"]
    found = {(row["system"], row["error"], float(row["tau"])): row for row in small}
    pairs = []
    for error, tau in (("paper", 1.0), ("paper", 2.0), ("measured", 1.0), ("measured", 2.0)):
        one, two = (int(found[system, error, tau]["triangles"]) for system in ("dynamic", "rqt"))
        pairs.append(f"{one} / {two} ({error} errors, τ = {tau:g})")
    yield PaperRow(
        _Y06, "triangles, dynamic / a restricted quadtree", "20569 / 23510; 6983 / 7420",
        "; ".join(pairs),
        "theirs Africa, 512², against QUADTin; ours the Moon, 512², against our rqt: the same "
        "threshold on different coefficients",
    )  # fmt: skip
    touched = [
        float(row["touched_percent"])
        for row in moving
        if row["side"] == "512" and row["system"] == "dynamic"
    ]
    yield PaperRow(
        _Y06, "nodes touched per frame, % of the tree", "1.3–7.3",
        f"{min(touched):.1f}–{max(touched):.1f}", "other views; τ of 1 to 4 pixels",
    )  # fmt: skip
    lossless = [
        f"{16 / float(row['bits_per_sample']):.1f} : 1, lossless, of 16 bits"
        for row in methods
        if row["method"] == "cdf53" and row["max_error"] == "0.0"
    ]
    yield PaperRow(
        "Zheng, Wang & Wang", "size by 5/3 and SPIHT", "16 GB to 286 MB (60 : 1)",
        *(lossless or ["not measured yet"]),
        "theirs Shenzhen, 130175² samples of about a byte; not said whether it is lossless",
    )  # fmt: skip


def _rate(rows: list[dict[str, str]]) -> str:
    frames = sorted(1e3 / float(row["frame_ms"]) for row in rows)
    return f"{frames[0]:.1f}–{frames[-1]:.1f}"


def _write(path: Path, kind: type, rows: Iterator) -> None:
    with CsvSink(path, kind) as sink:
        for row in rows:
            sink.write(row)
            print(row, flush=True)


def _measure_modes(file: Path, name: str) -> Iterator[ModeRow]:
    measure_mode(file, name, "overview", "dynamic")  # compiles
    measure_mode(file, name, "overview", "rqt")
    for camera_name in ("overview", *KEYS):
        for mode in MODES:
            yield measure_mode(file, name, camera_name, mode)


PARTS = ("grid", "methods", "modes", "papers")


@click.command(help=__doc__)
@click.argument("dem", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--only", multiple=True, type=click.Choice(PARTS), help="Measure these alone.")
@click.option("--pictures", is_flag=True, help="Draw docs/images/systems-modes.jpg too.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=RESULTS)
def main(dem: Path, only: tuple[str, ...], pictures: bool, out: Path) -> None:
    """Measure, print and write the CSVs."""
    parts = only or PARTS
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if "grid" in parts:
            _write(out / "systems.csv", GridRow, measure_grid(dem, folder))
        if "methods" in parts:
            _write(out / "systems_methods.csv", MethodRow, measure_methods(dem, folder))
        file = folder / "view.twz"
        if "modes" in parts or pictures:
            terrainwave.compress(dem, file, max_error=VIEW_ERROR, verify=False)
        if "modes" in parts:
            _write(out / "systems_modes.csv", ModeRow, _measure_modes(file, dem.stem))
        if pictures:
            draw_pictures(file)
    if "papers" in parts:
        _write(out / "systems_papers.csv", PaperRow, compare_papers(out))


if __name__ == "__main__":
    sys.exit(main())
