"""The system of Yusov & Turlapov 2010: ``python -m benchmarks.zerotrees DEM.tif …``.

Of each raster the grid of their tables 1 and 2 (blocks, bounds, border rings of method cdf97),
three times: faithful to the paper, with trees of decoded layers, and without trees. And views of
the files with levels mixed, whose triangles stand beside those of regular blocks.

``--factor``: the last raster again, with so many times the samples a side, in steps of 0.1 m.

``--only pyramids``: faithful files as they are; with a bound that doubles with each coarser level,
as the paper tried first; and with children predicted by Neville's filter of order 4 instead of the
9/7 synthesis. No option makes such files: encoder and decoder are changed here.

``--only contours``: faithful files as they are, whose contours are predicted from the parent's
line; and with contours as the paper codes them (§2.3): heights quantised by equation (1), the
differences of neighbours in the context of the previous one, signs in that of the previous sign,
without a wavelet. Models of both start trained: those of the paper's contours on the raster itself,
in a run before. Encoder and decoder are changed here.

``--only shares``: meshes of the trees alone: their largest error, and the share of the samples that
are within the tolerance of guaranteed meshes, Err_Tri, and within twice the bound.
"""

import math
from collections import namedtuple
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from copy import copy
from pathlib import Path
from typing import Any
from unittest import mock

import click
import numpy as np
import rasterio
from rasterio.transform import Affine
from scipy import ndimage

import terrainwave
from benchmarks import common
from benchmarks.render import KEYS, camera_at_key
from terrainwave import Cdf97, Zerotree
from terrainwave.codec import unit_specs
from terrainwave.codec.cdf97 import refiner
from terrainwave.codec.refiner import GroupSpec
from terrainwave.coding.jit import kernel
from terrainwave.coding.rangecoder import (
    N_PREFIX,
    N_UNARY,
    RANGE,
    code_bit,
    code_magnitude,
    n_bytes_begun,
    new_models,
)
from terrainwave.grid.quadtree import Block, Grid
from terrainwave.mesh.loose import LooseMesher
from terrainwave.mesh.statistics import mesh_levels
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Camera, Viewport, home
from terrainwave.tri.block_mesh import FRACTION_BITS

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
# Of a file whose pyramid is made in another way. `growth`: the bound of a level over that of the
# next finer one.
PyramidRow = namedtuple(
    "PyramidRow", "raster block max_error growth filter rmse measured_error heights_bits"
)
# Of a file whose contours are coded in this `way`: "parent" or "paper". Bits per sample of the
# contours, each as often as a group codes it, and of the raster.
ContourRow = namedtuple(
    "ContourRow",
    "raster block rings max_error way samples contour_bits measured_error heights_bits",
)
# Of the level above the finest: `coarse` triangles within tolerance, `loose` ones of trees alone,
# with their error in metres and the share of the samples within the tolerance; the least and the
# greatest tolerance of its blocks, in metres, and the share within twice the bound.
ShareRow = namedtuple(
    "ShareRow",
    "raster block max_error trees coarse loose loose_error share least_tolerance most_tolerance"
    " in_two_bounds",
)


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
    regular = sum(2 * n_cells(scene.terrain.grid, piece.block) for piece in pieces)
    return len({piece.level for piece in pieces}), own, regular


def n_cells(grid: Grid, block: Block) -> int:
    """Return how many cells of samples a block has inside the raster."""
    region = grid.block_region(block)
    return (region.n_rows - 1) * (region.n_cols - 1)


class Everything:
    """A store that keeps all patches, and nothing of them."""

    max_blocks, n_bytes = 1 << 30, 0

    def put(self, node: int, built) -> bool:
        """Say that it is kept."""
        return True

    def drop(self, node: int) -> None:
        """Forget it."""


def measure_pyramids(dem: Path, folder: Path) -> Iterator[PyramidRow]:
    """Yield faithful files with one bound, with bounds that grow, and with the other filter."""
    file = folder / "pyramid.twz"
    for block, max_error in ((block, bound) for block in BLOCKS for bound in BOUNDS):
        for growth, predictor in ((1, "9/7"), (2, "9/7"), (1, "Neville 4")):
            with ExitStack() as changes:
                if growth > 1:
                    with rasterio.open(dem) as raster:
                        k_max = Grid(raster.height, raster.width, block).k_max
                    changes.enter_context(growing_bounds(growth, k_max))
                if predictor != "9/7":
                    changes.enter_context(mock.patch.object(refiner, "_predict", by_neville))
                terrainwave.compress(
                    dem, file, max_error=max_error, block=block, mesh="none",
                    method=Cdf97(faithful=True), verify=False, overwrite=True,
                )  # fmt: skip
                report = terrainwave.verify(file, dem)
                assert report.ok, report.problems
                with terrainwave.open(file) as terrain:
                    n_bytes, n = sum(terrain.parts().heights), np.prod(terrain.shape)
            yield PyramidRow(
                dem.stem, block, max_error, growth, predictor, round(report.errors.rmse, 4),
                report.errors.max_error, round(float(8 * n_bytes / n), 4),
            )  # fmt: skip


@contextmanager
def growing_bounds(growth: int, k_max: int) -> Iterator[None]:
    """Let the bound of each level be `growth` times that of the next finer one."""

    def spec(**fields: Any) -> GroupSpec:
        half = (fields["step"] >> 1) * growth ** (k_max - fields["level"])
        return GroupSpec(**fields | {"step": 2 * half + 1})

    with mock.patch.object(unit_specs, "GroupSpec", spec):
        yield


def by_neville(spec: GroupSpec, parent: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return what `refiner._predict` does, by Neville's interpolation of order 4."""
    shape = spec.region.shape
    heights = np.zeros(shape, dtype=np.int32)
    if parent is not None:
        assert spec.parent_region is not None
        first = (
            2 * RING + spec.region.row - 2 * spec.parent_region.row,
            2 * RING + spec.region.col - 2 * spec.parent_region.col,
        )
        wide = interpolated(parent.astype(np.float64))
        part = wide[first[0] : first[0] + shape[0], first[1] : first[1] + shape[1]]
        heights = np.floor(part + 0.5).astype(np.int32)
    return heights, np.zeros(shape, dtype=np.bool_)


RING = 3  # samples around a parent, continued evenly


def interpolated(parent: np.ndarray) -> np.ndarray:
    """Return twice as many samples a side, `RING` parents more all around."""
    for axis in (0, 1):
        kind = {"mode": "reflect", "reflect_type": "odd"} if parent.shape[axis] > RING else {
            "mode": "edge"
        }  # fmt: skip
        around = [(RING, RING) if axis == k else (0, 0) for k in (0, 1)]
        parent = np.pad(parent, around, **kind)

    def shifted(row: int, col: int) -> np.ndarray:
        return np.roll(parent, (-row, -col), (0, 1))

    def line(row: int, col: int) -> np.ndarray:
        near = shifted(0, 0) + shifted(row, col)
        far = shifted(-row, -col) + shifted(2 * row, 2 * col)
        return (9 * near - far) / 16

    wide = np.empty((2 * parent.shape[0], 2 * parent.shape[1]))
    wide[::2, ::2], wide[::2, 1::2], wide[1::2, ::2] = parent, line(0, 1), line(1, 0)
    ends = [(-1, 0), (-1, 1), (2, 0), (2, 1), (0, -1), (1, -1), (0, 2), (1, 2)]
    near = sum(shifted(row, col) for row in (0, 1) for col in (0, 1))
    wide[1::2, 1::2] = (10 * near - sum(shifted(*end) for end in ends)) / 32
    return wide


def measure_contours(dem: Path, folder: Path) -> Iterator[ContourRow]:
    """Yield faithful files with contours from the parent's, and as the paper has them."""
    file = folder / "contours.twz"
    for block, rings, max_error in (
        (block, rings, bound) for block in BLOCKS for rings in RINGS for bound in BOUNDS
    ):
        for way in ("parent", "paper"):
            contours = Contours() if way == "paper" else None
            for is_trained in (False, True) if contours else (True,):
                counts = Counts(contours.code if contours else refiner.code_border)
                with mock.patch.object(refiner, "code_border", counts.code_border):
                    terrainwave.compress(
                        dem, file, max_error=max_error, block=block, mesh="none", threads=1,
                        method=Cdf97(faithful=True, border_rings=rings), verify=False,
                        overwrite=True,
                    )  # fmt: skip
                    if contours and not is_trained:
                        contours.train()
                        continue
                    report = terrainwave.verify(file, dem)
                    assert report.ok, report.problems
            with terrainwave.open(file) as terrain:
                n_bytes, n = sum(terrain.parts().heights), np.prod(terrain.shape)
            yield ContourRow(
                dem.stem, block, rings, max_error, way, counts.n_samples,
                round(counts.n_bits / counts.n_samples, 4), report.errors.max_error,
                round(float(8 * n_bytes / n), 4),
            )  # fmt: skip


class Counts:
    """Stands for `code_border`; counts what it codes when it encodes: samples, and their bits."""

    def __init__(self, code_border) -> None:
        self._code_border = code_border
        self.n_samples, self.n_bits = 0, 0.0

    def code_border(
        self, spec, parent, target, mask, coder, heights, is_known, *, is_nested: bool
    ) -> None:
        """Code the samples of a unit that neighbours share."""
        before = bits_of(coder.state)
        self._code_border(spec, parent, target, mask, coder, heights, is_known, is_nested=is_nested)
        if target is not None:
            self.n_samples += int((is_known & mask).sum())
            self.n_bits += bits_of(coder.state) - before


def bits_of(state: np.ndarray) -> float:
    """Return the bits that an encoder has put out, with what narrowed its range since."""
    return 8 * int(n_bytes_begun(state)) + 32 - math.log2(state[RANGE])


class Contours:
    """The paper's coding of contours (§2.3), with an arithmetic coder of adaptive bits.

    What the paper leaves open: a contour is a ring around a group, one for each of its
    `border_rings`, without the sides on the raster's edge; it begins, and goes on after such a
    side, with the difference from the parent's height there, quantised.
    """

    def __init__(self) -> None:
        self._starts = new_models(N_CONTOUR_MODELS)
        self._kept: np.ndarray | None = self._starts

    def train(self) -> None:
        """Take the models as they are after all groups for those that each group starts with."""
        counts = np.minimum(self._starts & 1023, TRAINED_COUNT)
        self._starts = (self._starts >> 10 << 10) | counts
        self._kept = None

    def code(
        self, spec, parent, target, mask, coder, heights, is_known, *, is_nested: bool
    ) -> None:
        """Encode the shared samples of `target`, or decode them where it is None, in place."""
        if parent is None:
            return
        models = self._starts.copy() if self._kept is None else self._kept
        coder = coder._replace(models=models)
        for run in contour_runs(spec):
            rows, cols = np.array([at for at in run if not is_known[at]], dtype=np.int64).T
            values = np.empty(len(rows), dtype=np.int64)
            first = int(predicted_at(spec, parent, rows[0], cols[0])) // spec.step
            goals = None if target is None else target[rows, cols].astype(np.int64)
            code_contour(goals, mask[rows, cols], np.int64(spec.step), first, coder, values)
            heights[rows, cols], is_known[rows, cols] = values, True


# Models of differences by the previous one, and of signs by the previous sign.
N_CONTEXTS = 12
SIGNS = N_CONTEXTS * (1 + N_UNARY)
PREFIX = SIGNS + 3
N_CONTOUR_MODELS = PREFIX + N_PREFIX
TRAINED_COUNT = 24  # bits that a trained start counts for


@kernel
def code_contour(goals, mask, step, first, coder, out):
    """Encode a contour, or decode it where `goals` is None, into `out`.

    Void samples have the height before them.
    """
    before, size, sign = first, np.int64(0), np.int64(0)
    for i in range(out.shape[0]):
        if mask[i]:
            apart = np.int64(0)
            if goals is not None:
                apart = goals[i] // step - before
            context = min(size, np.int64(N_CONTEXTS - 1))
            size = np.int64(0)
            if code_bit(coder, context, np.int64(apart != 0)):
                model = SIGNS + sign + 1
                is_less = code_bit(coder, model, np.int64(apart < 0))
                unary = N_CONTEXTS + context * N_UNARY
                size = 1 + code_magnitude(
                    coder, unary, np.int64(PREFIX), np.int64(0), abs(apart) - 1
                )
                sign = np.int64(-1 if is_less else 1)
                before += sign * size
            else:
                sign = np.int64(0)
        out[i] = before * step + (step >> 1)


def contour_runs(spec: GroupSpec) -> Iterator[list[tuple[int, int]]]:
    """Yield the shared samples of a unit: rings around it, cut where a side is not shared."""
    n_rows, n_cols = spec.region.shape
    top, left = spec.core.row - spec.region.row, spec.core.col - spec.region.col
    bottom, right = top + spec.core.n_rows - 1, left + spec.core.n_cols - 1
    shared, reach = spec.shared, spec.rings >> 1
    seen: set[tuple[int, int]] = set()
    for k in range(-reach, reach + 1):
        # A side that is not shared goes to the region's edge.
        first_row, last_row = top + k if shared.top else 0, bottom - k if shared.bottom else n_rows
        first_col, last_col = left + k if shared.left else 0, right - k if shared.right else n_cols
        rows, cols = range(first_row, last_row + 1), range(first_col, last_col + 1)
        sides = (
            (shared.top, [(top + k, col) for col in cols]),
            (shared.right, [(row, right - k) for row in rows]),
            (shared.bottom, [(bottom - k, col) for col in reversed(cols)]),
            (shared.left, [(row, left + k) for row in reversed(rows)]),
        )
        run: list[tuple[int, int]] = []
        for is_shared, side in sides:
            if is_shared:
                for at in side:
                    if 0 <= at[0] < n_rows and 0 <= at[1] < n_cols and at not in seen:
                        seen.add(at)
                        run.append(at)
            elif run:
                yield run
                run = []
        if run:
            yield run


def predicted_at(spec: GroupSpec, parent: np.ndarray, row: int, col: int) -> int:
    """Return the parent's height at a sample of a unit's region, or beside it."""
    assert spec.parent_region is not None
    r = (row + spec.region.row - 2 * spec.parent_region.row) >> 1
    c = (col + spec.region.col - 2 * spec.parent_region.col) >> 1
    return int(parent[min(r, parent.shape[0] - 1), min(c, parent.shape[1] - 1)])


def measure_shares(dem: Path, folder: Path) -> Iterator[ShareRow]:
    """Yield meshes of trees alone."""
    file = folder / "shares.twz"
    for block, max_error in ((block, bound) for block in BLOCKS for bound in BOUNDS):
        for trees in ("coded", "layers"):
            kind, is_faithful = TREES[trees]
            terrainwave.compress(
                dem, file, max_error=max_error, block=block, mesh=kind,
                method=Cdf97(faithful=is_faithful), verify=False, overwrite=True,
            )  # fmt: skip
            with (
                terrainwave.open(file) as terrain,
                mock.patch.object(
                    LooseMesher,
                    "samples_within",
                    new=(counts := SharesWithin(terrain, 2 * max_error)).count,
                ),
            ):
                loose = terrain.mesh(guarantee=False)
                coarse = mesh_levels(terrain)[-2].n_triangles
            yield ShareRow(
                dem.stem, block, max_error, trees, coarse, loose.n_triangles,
                round(loose.error, 2), round(loose.share, 4), *counts.summary(),
            )  # fmt: skip


class SharesWithin:
    """Counts of samples within another distance of a loose mesh than its blocks' tolerances.

    Counts of a mesh that was refined replace the earlier ones.
    """

    def __init__(self, terrain: Any, distance: float) -> None:
        self.unit = terrain.quantizer.quantum / (1 << FRACTION_BITS)
        self.distance = int(distance / self.unit)
        self.tolerances: dict[Block, int] = {}
        self.found: dict[Block, tuple[int, int]] = {}
        self.samples_within = LooseMesher.samples_within

    @property
    def count(self) -> Any:
        """Return what takes the place of `LooseMesher.samples_within`."""

        def samples_within(mesher: Any, block: Block, mesh: Any) -> tuple[int, int]:
            self.tolerances[block] = mesher._mesher.tolerance(block)
            other = copy(mesher)
            other._mesher = copy(mesher._mesher)
            other._mesher.tolerance = lambda _: self.distance
            self.found[block] = self.samples_within(other, block, mesh)
            return self.samples_within(mesher, block, mesh)

        return samples_within

    def summary(self) -> tuple[float, float, float]:
        """Return the least and the greatest tolerance in metres, and the share within."""
        covered, within = (sum(counts) for counts in zip(*self.found.values(), strict=True))
        tolerances = [tolerance * self.unit for tolerance in self.tolerances.values()]
        return round(min(tolerances), 2), round(max(tolerances), 2), round(within / covered, 4)


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


PARTS = ("grid", "views", "pyramids", "contours", "shares")


@common.command()
@common.rasters_argument
@common.option("--only", cls=common.ListOption, type=click.Choice(PARTS), default=None)
@common.option("--factor", type=common.COUNT, help="Resample the last raster, and take that too.")
def main(paths: list[Path], only: tuple[str, ...], factor: int, folder: Path, out: Path) -> None:
    """Measure, print and write the CSVs."""
    if factor:
        paths = [*paths, resampled(paths[-1], factor, folder)]
    for part, name, measure in (
        ("grid", "zerotrees", measure_grid), ("views", "zerotree_views", measure_views),
        ("pyramids", "zerotree_pyramids", measure_pyramids),
        ("contours", "zerotree_contours", measure_contours),
        ("shares", "zerotree_shares", measure_shares),
    ):  # fmt: skip
        if part in (only or PARTS):
            rows = (row for dem in paths for row in measure(dem, folder))
            common.write_rows(out / f"{name}.csv", rows)


if __name__ == "__main__":
    main()
