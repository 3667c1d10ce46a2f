"""Time the dynamic triangulation: ``python -m benchmarks.dynamic DEM.tif``.

Views of the first 512, 1024, 2048 and 4096 samples a side: one down on the first 512, the same for
all; and one low over the ground towards the far corner, which shows more the larger the raster is.
CPU milliseconds of an update by τ, vertices, triangles, nodes touched, and the largest distance on
screen of originals in view (of some, at random). On the first 512 also dynamic against rqt at one
threshold, by the papers' errors and by measured ones.

Exit status: 0 good; 2 wrong usage.
"""

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import rasterio

from benchmarks.report import CsvSink
from terrainwave.render.camera import Camera, Viewport, project
from terrainwave.render.modes.whole import eye_of
from terrainwave.render.selection import View
from terrainwave.tri.dynamic import DynamicMesh
from terrainwave.tri.rqt_view import RestrictedMesh

SIZES = (512, 1024, 2048, 4096)
TAUS = (1.0, 2.0, 4.0)
VIEWPORT = Viewport(1280, 720)
# Metres per sample: shapes of meshes follow from its ratio to heights alone.
PIXEL = 118.0
MORPH = 1.25
N_CHECKED = 400


@dataclass(frozen=True)
class Row:
    """One line of the CSV; milliseconds of CPU time of the one thread."""

    raster: str
    view: str
    system: str
    error: str
    side: int
    tau: float
    frames: int
    build_seconds: float
    median_ms: float
    largest_ms: float
    vertices: int
    triangles: int
    full_share: float
    touched: int
    touched_percent: float
    largest_pixels: float


def camera_at(view: str, number: int, top: float) -> Camera:
    """Return the view of a frame, 10 m further each frame."""
    away = 10.0 * number
    if view == "low":
        x = 100 * PIXEL + away
        return Camera((x, -x, top + 5000), 135, -20, 60)
    middle = 256 * PIXEL
    return Camera((middle + away, -1.5 * middle + away, top + 0.9 * middle), 0, -60, 45)


def largest_pixels(frame, heights, camera: Camera, rng) -> float:
    """Return the largest distance on screen of some originals in view from a mesh, pixels."""
    rows, cols = rng.integers(0, heights.shape, (20 * N_CHECKED, 2)).T
    points = np.column_stack([cols * PIXEL, -rows * PIXEL, heights[rows, cols].astype(float)])
    seen = project(camera, VIEWPORT, points)[:, :2]
    size = np.array([VIEWPORT.width, VIEWPORT.height])
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
            at = project(camera, VIEWPORT, np.array([[point[0], point[1], z]]))[0, :2]
            largest = max(largest, float(np.linalg.norm(at - pixel)))
    return largest


def _cross(u, v):
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


def fly(name: str, view: str, system: str, error: str, heights, tau: float, n_frames: int) -> Row:
    """Return what a flight took."""
    top, matrix = float(heights.max()), (PIXEL, 0.0, 0.0, 0.0, -PIXEL, 0.0)
    started = time.thread_time()
    if system == "dynamic":
        dynamic = DynamicMesh(heights, sample_matrix=matrix, error=error)
        update = lambda eye: dynamic.update(eye, tau, morph=MORPH)  # noqa: E731
        n_nodes = dynamic.n_nodes
    else:
        limits = float(heights.min()), top
        rqt = RestrictedMesh(heights.shape, limits, heights, sample_matrix=matrix, error=error)
        update = lambda eye: rqt.update(eye, tau)  # noqa: E731
        n_nodes = heights.size
    build = time.thread_time() - started
    times, touched = [], []
    first = eye_of(View(camera_at(view, 0, top), VIEWPORT))
    update(first)  # marks all nodes, and compiles
    update(first)
    for number in range(1, n_frames + 1):
        camera = camera_at(view, number, top)
        eye = eye_of(View(camera, VIEWPORT))
        started = time.thread_time()
        frame = update(eye)
        times.append((time.thread_time() - started) * 1e3)
        touched.append(frame.n_touched)
    side, n_full = heights.shape[0], 2 * (heights.shape[0] - 1) * (heights.shape[1] - 1)
    largest = largest_pixels(frame, heights, camera, np.random.default_rng(1))
    n_touched = int(np.median(touched))
    return Row(
        name, view, system, error, side, tau, n_frames, build, float(np.median(times)), max(times),
        len(frame.vertices), len(frame.triangles), len(frame.triangles) / n_full, n_touched,
        100 * n_touched / n_nodes, largest,
    )  # fmt: skip


@click.command(help=__doc__)
@click.argument("dem", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--frames", "n_frames", type=int, default=60, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), default="benchmarks/results/dynamic.csv")
def main(dem: Path, n_frames: int, out: Path) -> None:
    """Measure, print and write the CSV."""
    with rasterio.open(dem) as dataset:
        heights = dataset.read(1).astype(np.float32)
    with CsvSink(out, Row) as sink:
        for side in SIZES:
            part = np.ascontiguousarray(heights[:side, :side])
            if part.shape != (side, side):
                break
            for tau in TAUS:
                runs = [("down", "dynamic", "measured"), ("low", "dynamic", "measured")]
                if side == SIZES[0]:
                    runs += [("down", "dynamic", "paper")]
                    runs += [("down", "rqt", error) for error in ("measured", "paper")]
                for view, system, error in runs:
                    row = fly(dem.name, view, system, error, part, tau, n_frames)
                    sink.write(row)
                    print(row)


if __name__ == "__main__":
    sys.exit(main())
