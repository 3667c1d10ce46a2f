"""One crack-free mesh over any area of a file, from the meshes of its blocks.

The area is cut into blocks of several levels: coarse ones if the index gives their heights at most
a quarter of the requested error, blocks of the full grid elsewhere. Each mesh gets the rest of the
error; the error of a coarse mesh between its samples is measured. Where levels meet, the finer
block uses the coarser one's border line unchanged: on nested grids its vertices are samples of the
finer block too, and the coarse mesh's error covers the samples between them. So no gap is stitched
and no error added.

With a budget of triangles the outlines of voids come from a level that fits the budget
(`mesh.outlines`): all originals are covered, and small voids may be.
"""

import logging
import warnings
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from fractions import Fraction
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import check_flags, checked_error, checked_whole
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError, TerrainwaveWarning
from terrainwave.file import TerrainFile
from terrainwave.grid.affine import (
    IDENTITY,
    Footprint,
    determinant,
    pixels_to_places,
    samples_to_places,
    without_shift,
)
from terrainwave.grid.quadtree import Block
from terrainwave.grid.quantum import as_fraction
from terrainwave.mesh.cut import Area, Cut, ErrorCut, Errors
from terrainwave.mesh.fitted import BlockFitter, MeshedBlock
from terrainwave.mesh.joined import clipped, joined
from terrainwave.mesh.loose import LooseMesher
from terrainwave.mesh.mesh_data import CURVATURE_SHARE, CurvatureShare, MeshData
from terrainwave.mesh.outlines import CoveredSamples, finest_outline
from terrainwave.mesh.sections import mesher_of
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh

_log = logging.getLogger(__name__)

# A budget of triangles is met within this ratio of the smallest error; then the search continues to
# the second ratio while more than a twentieth of the budget is left.
_BUDGET_RATIO, _LAST_RATIO = Fraction(102, 100), Fraction(1001, 1000)
_LEAST_USED = Fraction(95, 100)
# Triangles of a budget per edge of a void's outline. Sweeps for blocks with voids.
_OUTLINE_SHARE = 4
_OUTLINE_SWEEPS = 8
_ROUNDING = 2.0**-48
# Share of samples within tolerance, "almost everywhere" in Yusov & Turlapov 2010, §2.4. Thresholds
# of significance are lowered until it is reached, in at most this number of steps.
_LOOSE_SHARE, _MOST_STEPS = 0.95, 10

Made = TypeVar("Made", bound=MeshData)


class _UnreachableError(InvalidHeightsError):
    """A coarse level's meshes cannot keep to the error: its samples are too far apart."""


class _TooManyTrianglesError(InvalidHeightsError):
    """A mesh has more triangles than its budget."""


def mesh_area(
    terrain: TerrainFile,
    kind: type[Made],
    window: Any = None,
    *,
    bounds: Sequence[float] | None = None,
    level: int = -1,
    max_error: float | None = None,
    max_triangles: int | None = None,
    optimise: int = 0,
    guarantee: bool = True,
    progress: ProgressCallback | None = None,
) -> Made:
    """Return the mesh of `Terrain.mesh`, with its arguments and errors, as one of `kind`."""
    check_flags(guarantee=guarantee)
    max_error = checked_error("max_error", max_error)
    if max_triangles is not None:
        max_triangles = checked_whole("max_triangles", max_triangles, least=1)
    optimise = checked_whole("optimise", optimise, least=0)
    if not guarantee:
        if max_error is not None or max_triangles is not None or optimise:
            raise InvalidArgumentError(
                "found an error, a budget or sweeps with no guarantee, expected none of them: the"
                " zero trees alone say what the mesh is"
            )
        level = _level_with_trees(terrain, level)
    asked = terrain.checked_window(window, bounds=bounds, level=level)
    region = asked.region
    if note := asked.note_on_cut(terrain.res):
        warnings.warn(note, TerrainwaveWarning, stacklevel=3)
    if min(region.shape) < 2:
        raise InvalidArgumentError(
            f"found an area of {region.n_rows} x {region.n_cols} samples, expected at least"
            " 2 x 2: a mesh lies between samples"
        )
    # A budget leads to another error in each area, so edges would not match anyway.
    area = Area(terrain.grid, region, asked.level, optimise, is_tile=max_triangles is None)
    with ThreadPoolExecutor(terrain.n_threads, thread_name_prefix="terrainwave") as executor:
        extractor = _Extractor(terrain, area, kind, executor, Reporter(progress))
        if not guarantee:
            return extractor.loose_mesh()
        if max_triangles is not None:
            return extractor.within_budget(max_triangles, max_error)
        return extractor.mesh(max_error)


def _level_with_trees(terrain: TerrainFile, level: int) -> int:
    """Return the level to mesh by zero trees; -1 means the finest level that has some."""
    index = terrain.level_index(level)
    if terrain.n_levels == 1 or (level >= 0 and index == terrain.n_levels - 1):
        raise InvalidArgumentError(
            f"found level {index} of {terrain.n_levels}, expected a coarser one: the finest has no"
            " zero trees, which a mesh without a guarantee is made of"
        )
    return min(index, terrain.n_levels - 2)


class _Extractor(Generic[Made]):
    """Builder of the mesh of an area, as one of `kind`."""

    def __init__(
        self,
        terrain: TerrainFile,
        area: Area,
        kind: type[Made],
        executor: ThreadPoolExecutor,
        reporter: Reporter,
    ) -> None:
        self._terrain, self._header, self._area = terrain, terrain.header, area
        self._kind = kind
        self._grid = terrain.grid
        self._mesher = mesher_of(terrain)
        self._fitter = BlockFitter(area, self._mesher)
        self._errors = Errors(terrain, area)
        self._executor = executor
        self._reporter = reporter
        self._n_tries = 0
        # The error to mesh for; None: that of the stored meshes.
        self._goal: Fraction | None = None
        self._max_triangles: int | None = None
        scale = abs(as_fraction(terrain.raster_info.scale))
        self._quantum = terrain.header.quantum * scale  # physical height of one quantum

    def mesh(self, max_error: float | None) -> Made:
        if max_error is None:
            return self._stored_mesh()
        self._goal = self._asked(max_error)
        return self._mesh_within(self._goal)

    def _asked(self, max_error: float) -> Fraction:
        """Return an error in quanta; raise if the heights are further from the originals."""
        smallest = self._errors.smallest()
        # The precision of float64 suffices, as in the file's own fields.
        if max_error < float(smallest * self._quantum) * (1 - _ROUNDING):
            raise InvalidArgumentError(
                f"found `max_error` {max_error:g}, expected at least"
                f" {float(smallest * self._quantum):g}: the heights of this level are no nearer to"
                " the originals"
            )
        # Heights span less than 2^30 quanta: no surface is further away.
        return max(min(as_fraction(max_error) / self._quantum, Fraction(1 << 33)), smallest)

    def _stored_mesh(self) -> Made:
        if self._header.mesh == "none":
            if not self._area.is_finest:
                raise InvalidArgumentError(
                    "the file stores no meshes of coarse levels: add them with terrainwave mesh"
                    " --store, or give a `max_error`"
                )
            self._goal = self._errors.coded + max(self._errors.coded, Fraction(1))
            return self._mesh_within(self._goal)
        self._goal = self._errors.coded + Fraction(self._header.mesh_tolerance, 1 << FRACTION_BITS)
        blocks = sorted(self._area.blocks(self._area.level))
        if self._area.is_finest and self._area.sweeps:
            pieces = {block: self._errors.stored_piece(block, self._mesher) for block in blocks}
            return self._assemble(self._build_all(Cut(self._area, pieces)))

        def build(block: Block) -> MeshedBlock:
            mesh = self._mesher.mesh(block)
            return MeshedBlock(mesh, self._errors.of_mesh(block, mesh, self._mesher))

        return self._assemble(dict(self._each(build, blocks)))

    def loose_mesh(self) -> Made:
        """Return the mesh of only the zero trees, with its measured error."""
        level = self._area.level
        for n_steps in range(_MOST_STEPS + 1):
            loose = LooseMesher(self._terrain, n_steps)
            meshes = loose.meshes(self._area.blocks(level), self._executor.map)
            counts = list(self._executor.map(loose.samples_within, meshes, meshes.values()))
            n_covered, n_within = (sum(column) for column in zip((0, 0), *counts, strict=True))
            share = n_within / max(n_covered, 1)
            if share >= _LOOSE_SHARE or not loose.has_threshold:
                break

        def measured(block: Block) -> MeshedBlock:
            error = self._mesher.derived_error(block, meshes[block])
            return MeshedBlock(meshes[block], Fraction(error, 1 << FRACTION_BITS))

        made = self._assemble(dict(self._each(measured, list(meshes))))
        made.attributes["share"] = share if n_covered else None
        return made

    def _each(
        self, build: Callable[[Block], MeshedBlock], blocks: list[Block]
    ) -> Generator[tuple[Block, MeshedBlock]]:
        """Yield blocks with the results of `build`, computed in threads; report progress."""
        self._n_tries += 1
        stage = "meshing" if self._n_tries == 1 else f"meshing, try {self._n_tries}"
        n_samples = self._grid.block**2
        meshes = self._executor.map(build, blocks)
        for n_done, (block, meshed) in enumerate(zip(blocks, meshes, strict=True), 1):
            self._reporter.report(stage, n_done * n_samples, len(blocks) * n_samples)
            yield block, meshed

    def _mesh_within(self, error: Fraction, n_most: int | None = None) -> Made:
        """Return the mesh for an error in quanta."""
        level, are_nested = self._area.level, self._terrain.pyramid == "nested"
        samples_of = self._fitter.samples_of
        cut = ErrorCut(self._area, self._errors, error, samples_of, are_nested=are_nested)
        built = self._build_all(cut, n_most)
        while True:
            failed = sorted(block for block, mesh in built.items() if mesh.error is None)
            _log.debug(
                "meshed %d blocks within %g; %d need finer ones",
                len(built), error * self._quantum, len(failed),
            )  # fmt: skip
            if not failed:
                return self._assemble(built)
            if not self._area.is_finest and any(block.level == level for block in failed):
                raise _UnreachableError(
                    f"found max_error {float(error * self._quantum):g}, which level {level} cannot"
                    " reach: use a finer level or a larger max_error"
                )
            cut.refine(failed)
            built = self._build_all(cut, n_most)

    def _mesh_if_reached(self, error: Fraction, n_most: int) -> Made | None:
        try:
            return self._mesh_within(error, n_most)
        except (_UnreachableError, _TooManyTrianglesError):
            return None

    def _build_all(self, cut: Cut, n_most: int | None = None) -> dict[Block, MeshedBlock]:
        built, n_triangles = {}, 0
        # Closed early, it starts no more work.
        build = partial(self._fitter.build, cut)
        with closing(self._each(build, sorted(cut.pieces))) as meshes:
            for block, meshed in meshes:
                built[block] = meshed
                if n_most is not None and meshed.error is not None:
                    n_triangles += self._n_inside(block, meshed.mesh)
                    if n_triangles > n_most:
                        raise _TooManyTrianglesError(f"more than {n_most} triangles")
        return built

    def _n_inside(self, block: Block, mesh: BlockMesh) -> int:
        """Return how many triangles of a block's mesh the area's mesh will have."""
        return len(clipped(*joined(self._grid, [block], [mesh]), self._area.limits())[1])

    def within_budget(self, max_triangles: int, max_error: float | None) -> Made:
        """Return the mesh of the smallest error (within 2 %) that has at most `max_triangles`."""
        self._max_triangles = max_triangles
        self._simplify_outlines(max_triangles)
        high = self._largest_error()
        if max_error is not None:
            high = min(high, self._asked(max_error))
        best = self._mesh_within(high)
        if best.n_triangles > max_triangles:
            raise InvalidArgumentError(
                f"found `max_triangles` {max_triangles}, expected at least {best.n_triangles}: the"
                f" mesh with an error of {float(high * self._quantum):g} has as many"
            )
        low = self._errors.smallest()
        finest = self._mesh_if_reached(low, max_triangles)
        if finest is not None:
            return finest
        low = max(low, Fraction(1, 16))
        while high > low * _BUDGET_RATIO or (
            best.n_triangles < max_triangles * _LEAST_USED and high > low * _LAST_RATIO
        ):
            # The geometric mean, as errors span decades.
            middle = Fraction(float(low * high) ** 0.5).limit_denominator(1 << 20)
            if not low < middle < high:
                break
            mesh = self._mesh_if_reached(middle, max_triangles)
            if mesh is not None:
                best, high = mesh, middle
            else:
                low = middle
        return best

    def _simplify_outlines(self, max_triangles: int) -> None:
        """Reduce the outlines of voids to a level that fits a budget of triangles."""
        if not self._terrain.header.has_voids:
            return
        area, decoder = self._area, self._terrain.decoder
        n_edges = max_triangles // _OUTLINE_SHARE
        outline = finest_outline(self._grid, decoder, area.level, area.region, n_edges)
        mesher = mesher_of(self._terrain, CoveredSamples(self._grid, decoder, outline))
        self._fitter = BlockFitter(area, mesher, _OUTLINE_SWEEPS)

    def _largest_error(self) -> Fraction:
        """Return an error beyond which meshes have no fewer triangles, in quanta."""
        header = self._header
        return Fraction(2 * (header.z_max - header.z_min) + 2) + self._errors.smallest()

    def _assemble(self, built: dict[Block, MeshedBlock]) -> Made:
        blocks = sorted(built)
        meshes = [built[block].mesh for block in blocks]
        vertices, triangles = joined(self._grid, blocks, meshes)
        vertices, triangles = clipped(vertices, triangles, self._area.limits())
        errors = [built[b].error or 0 for b, m in zip(blocks, meshes, strict=True) if len(m.rows)]
        return self._placed(
            vertices, triangles, float(max(errors, default=Fraction(0)) * self._quantum)
        )

    def _curvature_share(self, error: float) -> CurvatureShare:
        """Return the error that a globe's curvature may add: its share of a goal.

        It is the same for all areas of a file that are made for the same error.
        """
        quantum = float(self._quantum)
        if self._goal is not None:
            error = float(self._goal) * quantum
        left = max(error - float(self._errors.coded) * quantum, 0.0)
        middle = np.array([size // 2 for size in self._terrain.shape])[:, None] + [0.0, 1.0]
        x, y = samples_to_places(self._terrain.raster_info.transform, *middle)
        cell = np.stack([x, y, np.zeros(2)], axis=1)
        share = left * CURVATURE_SHARE / (1 - CURVATURE_SHARE)
        return CurvatureShare(share, cell, self._max_triangles)

    def _placed(
        self, vertices: NDArray[np.float64], triangles: NDArray[np.int32], error: float
    ) -> Made:
        """Return the mesh in world coordinates, counter-clockwise seen from above."""
        crs, raster = self._terrain.crs, self._terrain.raster_info
        first_row, last_row, first_col, last_col = self._area.limits()
        row_0, col_0 = (first_row + last_row) // 4, (first_col + last_col) // 4
        rows, cols = vertices[:, 0] / 2 - row_0, vertices[:, 1] / 2 - col_0
        quanta = vertices[:, 2] / (1 << FRACTION_BITS)
        numerator, denominator = self._header.quantum.numerator, self._header.quantum.denominator
        heights = (quanta + self._header.base) * numerator / denominator
        x, y = pixels_to_places(without_shift(raster.transform), rows, cols)
        points = np.stack([x, y, heights * raster.scale + raster.offset], 1)
        if determinant(raster.transform) > 0:
            triangles = np.ascontiguousarray(triangles)
        else:
            triangles = np.ascontiguousarray(triangles[:, ::-1])
        origin = (*samples_to_places(raster.transform, float(row_0), float(col_0)), 0.0)
        # An array without georeference: its columns and rows are not degrees.
        attributes: dict[str, Any] = {"is_placed": raster.transform != IDENTITY}
        if raster.impossible_places is not None:
            attributes["impossible"] = raster.impossible_places
        attributes["curvature"] = self._curvature_share(error)
        corners = np.array([(r, c) for r in (first_row, last_row) for c in (first_col, last_col)])
        x, y = samples_to_places(raster.transform, *(corners.T / 2))
        attributes["area"] = (float(x.min()), float(y.min()), float(x.max()), float(y.max()))
        attributes["footprint"] = Footprint(raster.transform, self._terrain.shape)
        return self._kind(
            points, triangles, origin, error, crs, self._terrain.units, attributes,
            raster.heights_are,
        )  # fmt: skip
