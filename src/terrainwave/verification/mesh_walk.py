"""Check of the meshes of a file, by code independent of their construction (`checks`).

Walks the blocks of all levels depth first and holds a chain of ancestors, one window of originals,
and the border lines of blocks with pending neighbours.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from terrainwave.errors import CorruptStreamError, TerrainwaveError
from terrainwave.grid.affine import determinant
from terrainwave.grid.quadtree import Block, Region
from terrainwave.names import UNBOUNDED_MESHES
from terrainwave.progress import Progress, ProgressCallback
from terrainwave.verification.checks import CheckedMesh, deviation
from terrainwave.verification.on_grid import (
    BorderLine,
    QuantaScale,
    ReadOriginal,
    area_problems,
    block_mask,
    block_problems,
    block_surface,
    border_line,
    error_problems,
    line_problems,
    missing_samples,
    must_be_covered,
)

# Side of the windows in which meshes of areas are checked, in samples.
_WINDOW_SIDE = 2048
# Factors of the smallest error for which meshes of areas are checked.
_FACTORS = (2, 24)
_MAX_LISTED = 20


@dataclass(frozen=True)
class LevelMeshes:
    """Stored meshes of a level, with errors in physical units.

    `stored_error` is the largest one in the index, or else bound of the meshes; `measured_error`
    the largest distance from the originals, or without them from the decoded heights.
    """

    level: int
    n_blocks: int
    n_triangles: int
    stored_error: float
    measured_error: float


@dataclass(frozen=True)
class AreaMeshes:
    """Meshes of `Terrain.mesh` over the whole raster, window by window.

    `max_error` is the requested error, None for the stored meshes; `stated_error` and
    `measured_error` are the largest of all windows, in physical units.
    """

    max_error: float | None
    optimise: int
    n_windows: int
    n_triangles: int
    stated_error: float
    measured_error: float


@dataclass(frozen=True)
class MeshReport:
    """Result of checking a file's meshes, with errors from the ``"original"`` or ``"decoded"``."""

    kind: str
    against: str
    levels: tuple[LevelMeshes, ...]
    areas: tuple[AreaMeshes, ...]


class _Stated(NamedTuple):
    """A block, its mesh, and the stated error of the mesh, in 1/16 quanta."""

    block: Block
    surface: CheckedMesh
    error: float


class MeshVerification:
    """The checks of one file's meshes.

    Without `read` errors are measured from the decoded heights, and may exceed the stated ones by
    the file's own bound.
    """

    def __init__(
        self,
        terrain: Any,
        read: ReadOriginal | None = None,
        progress: ProgressCallback | None = None,
    ) -> None:
        self._terrain, self._grid = terrain, terrain.grid
        self._has_original = read is not None
        self._read: ReadOriginal = read or terrain.read_with_mask
        self._progress = progress
        self._ruler = QuantaScale(terrain)
        # Kinds that state measured errors and have no bound.
        self._is_unbounded = terrain.mesh_kind in UNBOUNDED_MESHES
        self._allowed = self._ruler.slack + (0 if read else self._ruler.coded)
        self._what = "heights" if read else "decoded heights"
        self._problems: list[str] = []
        self._n_problems = 0
        self._lines: dict[tuple[Block, int], BorderLine] = {}
        n_levels = terrain.n_levels
        self._n_blocks, self._n_triangles = [0] * n_levels, [0] * n_levels
        self._stored, self._measured = [0.0] * n_levels, [0.0] * n_levels
        self._n_done = self._n_total = 0

    def run(self) -> tuple[MeshReport, list[str]]:
        terrain, n_samples = self._terrain, self._grid.n_rows * self._grid.n_cols
        plans = list(self._plans())
        has_stored = terrain.mesh_kind != "none"
        self._n_total = n_samples * (len(plans) + has_stored)
        if has_stored:
            for block in self._grid.blocks(0):
                self._visit(block, [])
        areas = tuple(self._check_areas(*plan) for plan in plans)
        levels = tuple(
            LevelMeshes(
                level,
                self._n_blocks[level],
                self._n_triangles[level],
                self._stored[level],
                self._ruler.physical(self._measured[level]),
            )
            for level in range(terrain.n_levels if has_stored else 0)
        )
        against = "original" if self._has_original else "decoded"
        if self._n_problems > _MAX_LISTED:
            n_more = self._n_problems - _MAX_LISTED
            self._problems.append(f"… and {n_more} more problems of meshes")
        return MeshReport(terrain.mesh_kind, against, levels, areas), self._problems

    def _add(self, where: str, problems: Iterable[str]) -> None:
        for problem in problems:
            self._n_problems += 1
            if self._n_problems <= _MAX_LISTED:
                self._problems.append(f"{where}: {problem}")

    def _report(self, n_samples: int) -> None:
        self._n_done += n_samples
        if self._progress is not None:
            itemsize = self._terrain.dtype.itemsize
            self._progress(
                Progress("verify meshes", self._n_done, self._n_total, self._n_done * itemsize)
            )

    def _visit(self, block: Block, chain: list[_Stated]) -> None:
        where = f"mesh of block {tuple(block)}"
        try:
            surface = block_surface(self._terrain, block)
            self._add(where, block_problems(self._terrain, block, surface))
            self._check_lines(block, surface)
            stated = self._terrain.mesh_error(block)
        except TerrainwaveError as error:
            self._add(where, [str(error)])
            return
        self._stored[block.level] = max(self._stored[block.level], stated)
        self._n_blocks[block.level] += 1
        self._n_triangles[block.level] += len(surface.triangles)
        chain = [*chain, _Stated(block, surface, self._ruler.in_sixteenths(stated))]
        if block.level < self._grid.k_max:
            for child in self._grid.children(block):
                self._visit(child, chain)
        else:
            region = self._grid.block_region(block)
            try:
                self._measure(region, chain)
            except CorruptStreamError as error:
                self._add(where, [str(error)])
            self._report(region.n_rows * region.n_cols)

    def _measure(self, region: Region, chain: list[_Stated]) -> None:
        raw, valid = self._read(region)
        samples = self._ruler.sixteenths(raw, valid)
        for block, surface, stored in chain:
            stride = self._grid.stride(block.level)
            first = block.row * self._grid.block * stride, block.col * self._grid.block * stride
            errors = deviation(
                surface.on_grid(stride),
                samples,
                valid,
                stored + self._allowed,
                (region.row - first[0], region.col - first[1]),
            )
            self._measured[block.level] = max(self._measured[block.level], errors.worst)
            where = f"mesh of block {tuple(block)}"
            self._add(where, error_problems(self._ruler, errors, stored, region, self._what))
            # Coarse meshes lie over all valid samples below them.
            wanted = must_be_covered(valid) if block.level == self._grid.k_max else valid
            if min(valid.shape) > 1:
                self._add(where, missing_samples(errors, wanted, region))
            if block.level == self._grid.k_max and not self._is_unbounded:
                self._add(where, self._tolerance_problems(surface, region))

    def _tolerance_problems(self, surface: CheckedMesh, region: Region) -> Iterator[str]:
        raw, valid = self._terrain.read_with_mask(region)
        tolerance = self._ruler.in_sixteenths(self._terrain.info().mesh_tolerance)
        errors = deviation(
            surface,
            self._ruler.sixteenths(raw, valid),
            valid,
            tolerance + self._ruler.decoded_slack,
        )
        return error_problems(
            self._ruler, errors, tolerance, region, "decoded heights", "tolerance"
        )

    def _check_lines(self, block: Block, surface: CheckedMesh) -> None:
        grid = self._grid
        mask_shape = block_mask(self._terrain, block).shape
        for axis, (down, right) in enumerate(((1, 0), (0, 1))):
            before = Block(block.level, block.row - down, block.col - right)
            after = Block(block.level, block.row + down, block.col + right)
            # In any order: the first to come keeps its line, under the upper or left block.
            for upper, at, other in (
                (before, 0, before), (block, 2 * (mask_shape[axis] - 1), after),
            ):  # fmt: skip
                if not grid.contains(other):
                    continue
                line = border_line(surface, axis, at)
                kept = self._lines.pop((upper, axis), None)
                if kept is None:
                    self._lines[upper, axis] = line
                else:
                    where = f"meshes of blocks {tuple(block)} and {tuple(other)}"
                    self._add(where, line_problems(kept, line))

    def _plans(self) -> Iterator[tuple[float | None, int]]:
        if min(self._terrain.shape) < 2 or determinant(self._terrain.raster_info.transform) == 0:
            return  # no area, or no position in the world
        yield None, 0
        bound, quantum = self._terrain.quanta_error, self._ruler.quantum
        for factor in _FACTORS:
            # Leaves some of the bound to the mesh.
            yield max(bound * factor, bound + quantum * factor), int(factor == _FACTORS[-1])

    def _windows(self) -> Iterator[Region]:
        n_rows, n_cols = self._terrain.shape
        for cells in Region(0, 0, n_rows - 1, n_cols - 1).tiles(_WINDOW_SIDE, _WINDOW_SIDE):
            yield Region(cells.row, cells.col, cells.n_rows + 1, cells.n_cols + 1)

    def _check_areas(self, max_error: float | None, optimise: int) -> AreaMeshes:
        terrain = self._terrain
        n_windows = n_triangles = 0
        stated = measured = 0.0
        for region in self._windows():
            asked = "the stored error" if max_error is None else f"max_error {max_error:g}"
            where = f"mesh at {asked} of window {tuple(region)}"
            n_windows += 1
            try:
                mesh = terrain.mesh(tuple(region), max_error=max_error, optimise=optimise)
                problems, worst = area_problems(
                    terrain, mesh, region, max_error, self._read if self._has_original else None
                )
            except TerrainwaveError as error:
                self._add(where, [str(error)])
                continue
            finally:
                self._report(region.n_rows * region.n_cols)
            self._add(where, problems)
            n_triangles += mesh.n_triangles
            stated, measured = max(stated, mesh.error), max(measured, worst)
        return AreaMeshes(max_error, optimise, n_windows, n_triangles, stated, measured)
