"""The system of Yusov & Turlapov 2010: ``python -m benchmarks.zerotrees DEM.tif …``.

Of each raster the grid of their tables 1 and 2 (blocks, bounds, border rings of method cdf97),
three times: faithful to the paper, with trees of decoded layers, and without trees. And views of
the files with levels mixed, whose triangles stand beside those of regular blocks.

``--factor``: the last raster again, with so many times the samples a side, in steps of 0.1 m.
"""

from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import Affine
from scipy import ndimage

import terrainwave
from benchmarks import common
from benchmarks.render import KEYS, camera_at_key
from terrainwave import Cdf97, Zerotree
from terrainwave.mesh.statistics import mesh_levels
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Camera, Viewport, home

BLOCKS, BOUNDS, RINGS = (64, 256), (1.0, 3.0, 10.0), (1, 3)
# What the trees are, and whether the file is faithful.
TREES = {"coded": (Zerotree(labels="coded"), True), "layers": (Zerotree(labels="layer"), False),
         "none": (Zerotree(labels="plain"), False)}  # fmt: skip
VIEWPORT, TAUS = Viewport(1920, 1080), (1.0, 4.0)

# Bits per sample of the raster, metres. `triangles` are those of all blocks of the finest level,
# `regular` those of the full grid; `coarse`, `loose` and `significant` (a share of the finest
# nodes) are of the level above it.
GridRow = namedtuple(
    "GridRow",
    "raster block max_error rings trees rmse measured_error heights_bits labels_bits total_bits "
    "triangles regular coarse loose loose_error significant",
)  # fmt: skip
# Of the views with blocks of several levels: triangles of regular blocks over those of adaptive
# ones in the same places, without skirts. `triangles`: the median of all views.
ViewRow = namedtuple("ViewRow", "raster max_error trees tau views least median most triangles")


def measure_grid(dem: Path, folder: Path) -> Iterator[GridRow]:
    """Yield the cases of the grid; heights are coded once for all trees of a kind of file."""
    heights, file = folder / "heights.twz", folder / "trees.twz"
    cases = [(block, bound, rings) for block in BLOCKS for bound in BOUNDS for rings in RINGS]
    for block, max_error, rings in cases:
        for is_faithful in (True, False):
            terrainwave.compress(
                dem, heights, max_error=max_error, block=block, mesh="none",
                method=Cdf97(border_rings=rings, faithful=is_faithful), verify=False,
                overwrite=True,
            )  # fmt: skip
            report = terrainwave.verify(heights, dem)
            assert report.ok, report.problems
            for trees, (kind, is_such) in TREES.items():
                if is_such == is_faithful:
                    terrainwave.store_meshes(heights, file, mesh=kind, overwrite=True)
                    case = dem.stem, block, max_error, rings, trees
                    yield grid_row(file, case, report.errors)


def grid_row(file: Path, case: tuple, errors) -> GridRow:
    """Return the line of a file."""
    with terrainwave.open(file) as terrain:
        n_rows, n_cols = terrain.shape
        parts, levels = terrain.parts(), mesh_levels(terrain)
        loose = terrain.mesh(guarantee=False) if levels[-2].n_loose else None
    lengths = sum(parts.heights), parts.meshes, file.stat().st_size
    return GridRow(
        *case, round(errors.rmse, 4), errors.max_error,
        *(round(8 * length / (n_rows * n_cols), 4) for length in lengths),
        levels[-1].n_triangles, 2 * (n_rows - 1) * (n_cols - 1), levels[-2].n_triangles,
        loose.n_triangles if loose else "", round(loose.error, 3) if loose else "",
        round(levels[-2].significant, 5) if loose else "",
    )  # fmt: skip


def measure_views(dem: Path, folder: Path) -> Iterator[ViewRow]:
    """Yield views of the files of each raster, with blocks of 256."""
    file = folder / "view.twz"
    for max_error in BOUNDS:
        for trees, (kind, is_faithful) in TREES.items():
            terrainwave.compress(
                dem, file, max_error=max_error, method=Cdf97(faithful=is_faithful), mesh=kind,
                verify=False, overwrite=True,
            )  # fmt: skip
            with (
                terrainwave.open(file) as terrain,
                Scene(terrain, Everything(), max_triangles=1 << 40, horizon=False) as scene,
            ):
                cameras = [home(scene.frame.box, VIEWPORT)]
                cameras += [camera_at_key(scene.frame, key) for key in KEYS]
                for tau in TAUS:
                    found = [view_counts(scene, camera, tau) for camera in cameras]
                    ratios = [regular / own for n_levels, own, regular in found if n_levels > 1]
                    shares = np.quantile(ratios, (0, 0.5, 1)).round(3) if ratios else ("",) * 3
                    yield ViewRow(
                        dem.stem, max_error, trees, tau, len(ratios), *shares,
                        int(np.median([own for _, own, _ in found])),
                    )  # fmt: skip


def view_counts(scene: Scene, camera: Camera, tau: float) -> tuple[int, int, int]:
    """Return the levels drawn, their triangles without skirts, and those of regular blocks."""
    frames = scene.settle(scene.view(camera, VIEWPORT, tau))
    pieces = [scene.table.pieces[node] for node in frames.nodes]
    own = sum(len(scene.mode.builder.mesh(piece).triangles) for piece in pieces)
    sides = [scene.terrain.grid.block_region(piece.block).shape for piece in pieces]
    regular = sum(2 * (n_rows - 1) * (n_cols - 1) for n_rows, n_cols in sides)
    return len({piece.level for piece in pieces}), own, regular


class Everything:
    """A store that keeps all patches, and nothing of them."""

    max_blocks, n_bytes = 1 << 30, 0

    def put(self, node: int, built) -> bool:
        """Say that it is kept."""
        return True

    def drop(self, node: int) -> None:
        """Forget it."""


def resampled(dem: Path, factor: int, folder: Path) -> Path:
    """Return a raster with `factor` x as many samples a side, bicubic, in steps of 0.1 m."""
    target = folder / f"{dem.stem}_{factor}x.tif"
    with rasterio.open(dem) as source:
        heights, crs = source.read(1).astype(np.float64), source.crs
        # The first samples' centres stay where they are.
        middle = Affine.translation(0.5, 0.5)
        transform = source.transform @ middle @ Affine.scale(1 / factor) @ ~middle
    n_rows, n_cols = ((side - 1) * factor + 1 for side in heights.shape)
    fine = ndimage.zoom(heights, (n_rows / heights.shape[0], n_cols / heights.shape[1]), order=3)
    profile = {"driver": "GTiff", "height": n_rows, "width": n_cols, "count": 1, "dtype": "uint16"}
    with rasterio.open(target, "w", crs=crs, transform=transform, **profile) as dataset:
        dataset.write(np.rint(10 * fine).astype(np.uint16), 1)
        dataset.scales = (0.1,)
    return target


# Parts: their CSVs, and what measures them.
PARTS = {"grid": ("zerotrees", measure_grid), "views": ("zerotree_views", measure_views)}


@common.command()
@common.rasters_argument
@common.choices_option("--only", of=PARTS)
@common.option("--factor", type=common.COUNT, help="Resample the last raster, and take that too.")
def main(paths: list[Path], only: tuple[str, ...], factor: int, folder: Path, out: Path) -> None:
    """Measure, print and write the CSVs."""
    if factor:
        paths = [*paths, resampled(paths[-1], factor, folder)]
    for name, measure in map(PARTS.__getitem__, only):
        rows = (row for dem in paths for row in measure(dem, folder))
        common.write_rows(out / f"{name}.csv", rows)


if __name__ == "__main__":
    main()
