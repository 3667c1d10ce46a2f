"""Compare meshes with measured errors and without: ``python -m benchmarks.unmeasured DIR``.

Each raster is compressed twice, with `measure_meshes` and without. `unmeasured_views.csv` has the
triangles that the viewer draws of both at the same τ: one view of all of the raster, jumps to
places and to the horizon, and moments of flights (`benchmarks.flight`). A bound without
measurements is larger than a measured error, so it selects finer blocks; but of meshes for views,
which take fewer triangles for it (decision 29).

`unmeasured_bounds.csv` has, by level, how far the bound is above the true error of each mesh,
measured from the original. Exit status 1 means that a bound was below it.
"""

import contextlib
import math
from collections import namedtuple
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np

import terrainwave
from benchmarks import common
from benchmarks.flight import FAST, JUMPS, Flights, Ground
from benchmarks.zerotrees import Everything
from terrainwave.mesh.blocks import BlockMesher, measure_meshes
from terrainwave.mesh.sections import mesher_of
from terrainwave.raster_io.source import RasterSource
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Camera, Viewport, home

VIEWPORT = Viewport(1920, 1080)
BOUNDS, TAUS = (0.0, 1.0, 5.0), (1.0, 4.0)
N_JUMPS, FAST_S, SPIRAL_S = 6, (0.0, 20.0), (0.0, 5.0, 10.0)

ViewRow = namedtuple(
    "ViewRow",
    "raster max_error tau n_views median_triangles sum_ratio mean_ratio least_ratio most_ratio",
)
BoundRow = namedtuple(
    "BoundRow", "raster max_error level meshes n_blocks least_ratio mean_ratio most_ratio"
)


def cameras(scene: Scene, ground: Ground) -> list[Camera]:
    """Return the views of a raster."""
    flights = Flights(ground)
    found = [home(scene.frame.box, VIEWPORT)]
    for above, pitch in JUMPS.values():
        found += flights.jumps(above, pitch)[:N_JUMPS]
    fast, spiral = flights.straight(*FAST), flights.spiral(2 * max(SPIRAL_S))
    return found + [fast(now) for now in FAST_S] + [spiral(now) for now in SPIRAL_S]


def triangles(file: Path, ground: Ground, tau: float) -> np.ndarray:
    """Return how many triangles each view draws."""
    with (
        terrainwave.open(file) as terrain,
        Scene(terrain, Everything(), max_triangles=1 << 40, horizon=False) as scene,
    ):
        views = [scene.view(camera, VIEWPORT, tau) for camera in cameras(scene, ground)]
        return np.array([scene.settle(view).n_triangles for view in views], dtype=float)


class ViewMesher:
    """What `measure_meshes` asks of a mesher, of meshes for views."""

    def __init__(self, mesher: BlockMesher) -> None:
        self.mesh = mesher.view_mesh

    def bounded_error(self, *_: object) -> int:
        """Leave out the finest level, which has no other meshes for views."""
        return 0


def bound_rows(dem: Path, file: Path, max_error: float) -> Iterator[BoundRow]:
    """Yield how bounds and errors of meshes compare on each coarse level."""
    with terrainwave.open(file) as terrain, contextlib.closing(RasterSource(dem)) as source:
        mesher, lost = mesher_of(terrain), Fraction(terrain.quantizer.lost)

        def originals(region):
            raw, valid = source.read(*region)
            return terrain.quantizer.quantize(raw, valid), valid

        for meshes, own in (("of files", mesher), ("for views", ViewMesher(mesher))):
            found = measure_meshes(
                terrain.grid, own, originals, common.InlineExecutor(), lambda _: None, lost
            )
            ratios = {}
            for block, error in found.items():
                if block.level < terrain.n_levels - 1 and error:
                    bound = mesher.derived_error(block, own.mesh(block))
                    ratios.setdefault(block.level, []).append(bound / error)
            for level, of_level in sorted(ratios.items()):
                mean = math.exp(np.log(of_level).mean())
                yield BoundRow(
                    dem.stem, max_error, level, meshes, len(of_level),
                    *(round(float(ratio), 3) for ratio in (min(of_level), mean, max(of_level))),
                )  # fmt: skip


def view_rows(dem: Path, measured: Path, file: Path, max_error: float) -> Iterator[ViewRow]:
    """Yield what is drawn of both files."""
    ground = Ground(file, None)
    for tau in TAUS:
        before, now = triangles(measured, ground, tau), triangles(file, ground, tau)
        is_seen = before > 0  # of a small raster, some views see nothing
        before, now = before[is_seen], now[is_seen]
        ratios = now / before
        numbers = (
            now.sum() / before.sum(),
            np.exp(np.log(ratios).mean()),
            min(ratios),
            max(ratios),
        )
        yield ViewRow(
            dem.stem, max_error, tau, len(ratios), int(np.median(before)),
            *(round(float(number), 3) for number in numbers),
        )  # fmt: skip


@common.command()
@common.rasters_argument
@common.bounds_option(*BOUNDS)
def main(paths: list[Path], bounds: tuple[float, ...], folder: Path, out: Path) -> None:
    """Measure, print and write the CSVs."""
    views, levels = [], []
    for dem in paths:
        for bound in bounds:
            file, measured = folder / "unmeasured.twz", folder / "measured.twz"
            for path, measures in ((file, False), (measured, True)):
                terrainwave.compress(
                    dem, path, max_error=bound, measure_meshes=measures, verify=False,
                    overwrite=True,
                )  # fmt: skip
            views += view_rows(dem, measured, file, bound)
            levels += bound_rows(dem, file, bound)
    common.write_rows(out / "unmeasured_views.csv", views)
    common.write_rows(out / "unmeasured_bounds.csv", levels)
    raise SystemExit(min((row.least_ratio for row in levels), default=1.0) < 1)


if __name__ == "__main__":
    main()
