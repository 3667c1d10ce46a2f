"""Check the meshes of a file, by code that shares nothing with what makes them (`checks`).

Walks the blocks of all levels depth first and holds a chain of ancestors, one window of originals,
and the border lines of blocks whose neighbours have not come yet.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import CorruptStreamError, TerrainwaveError
from terrainwave.grid.affine import determinant, places_to_pixels, places_to_samples, without_shift
from terrainwave.grid.quadtree import Block, Region
from terrainwave.names import UNBOUNDED_MESHES
from terrainwave.progress import Progress, ProgressCallback
from terrainwave.verification.checks import (
    NOTHING,
    Deviation,
    Surface,
    boundary_edges,
    deviation,
    pieces_of_mask,
    problems_of,
    refined_pieces,
)

_SIXTEENTHS = 16
# Meshes of areas are checked in windows of this many samples a side.
_WINDOW_SIDE = 2048
# Factors of the smallest error at which meshes of areas are checked.
_FACTORS = (2, 24)
_MAX_LISTED = 20
# Relative; what a decimal error loses as float64.
_SLACK = 1e-9

ReadOriginal = Callable[[Region], tuple[NDArray[np.generic], NDArray[np.bool_]]]


@dataclass(frozen=True)
class LevelMeshes:
    """The stored meshes of a level.

    Errors in physical units: `stored_error` is the largest one in the index, `measured_error` the
    largest distance that was found, from the originals, or without them from the decoded heights.
    """

    level: int
    n_blocks: int
    n_triangles: int
    stored_error: float
    measured_error: float


@dataclass(frozen=True)
class AreaMeshes:
    """What `Terrain.mesh` gives over the whole raster, window by window.

    `max_error` is what was asked for, None for the stored meshes; `stated_error` and
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
    """What was checked of a file's meshes.

    `against` is ``"original"`` or ``"decoded"``: what errors were measured from.
    """

    kind: str
    against: str
    levels: tuple[LevelMeshes, ...]
    areas: tuple[AreaMeshes, ...]


@dataclass
class Checks:
    """Problems, shortened to the first of them."""

    problems: list[str] = field(default_factory=list)
    n_left_out: int = 0

    def add(self, where: str, problems: Iterator[str] | list[str]) -> None:
        """Note problems of a place."""
        for problem in problems:
            if len(self.problems) < _MAX_LISTED:
                self.problems.append(f"{where}: {problem}")
            else:
                self.n_left_out += 1

    def all(self) -> list[str]:
        """Return the problems noted, and how many more there are."""
        if not self.n_left_out:
            return self.problems
        return [*self.problems, f"… and {self.n_left_out} more problems of meshes"]


class Ruler:
    """Heights of a file in 1/16 quanta, by the numbers of its header alone."""

    def __init__(self, terrain: Any) -> None:
        header, info = terrain.header, terrain.info()
        self._numerator, self._denominator = header.quantum.numerator, header.quantum.denominator
        self._base = int(header.base)
        self._is_grid = header.rho == 0
        self._is_integer = np.dtype(terrain.dtype).kind in "iu"
        self._scale, self._offset = float(info.scale), float(info.offset)
        # One quantum in physical units.
        self.quantum = float(info.quantum)
        # Heights off the grid are rounded to 1/16 quanta here.
        self.slack = 0 if self._is_grid else 1
        self.decoded_slack = 0 if self._is_grid else 1 + self._of_decoded(header)
        self.coded = math.ceil(terrain.quanta_error / self.quantum * _SIXTEENTHS * (1 - _SLACK))

    def _of_decoded(self, header: Any) -> int:
        """Return how far decoded heights off the grid are from their quanta, at most.

        By half a float's spacing, which is what `rho` is more than half a quantum; with remainders
        by all of `rho`.
        """
        rounded = Fraction(header.rho) / header.quantum
        if not header.has_remainders:
            rounded -= Fraction(1, 2)
        return max(math.ceil(rounded * _SIXTEENTHS), 0)

    def sixteenths(self, raw: NDArray[np.generic], valid: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return raw heights in 1/16 quanta: exact on a true grid, else the nearest."""
        heights = np.zeros(raw.shape, dtype=np.int64)
        if self._is_integer and self._is_grid and self._denominator == 1:
            whole = raw[valid].astype(np.int64) // self._numerator
            heights[valid] = (whole - self._base) * _SIXTEENTHS
            return heights
        quanta = raw[valid].astype(np.float64) * self._denominator / self._numerator
        if self._is_grid:
            heights[valid] = (np.rint(quanta).astype(np.int64) - self._base) * _SIXTEENTHS
        else:
            heights[valid] = np.rint((quanta - self._base) * _SIXTEENTHS).astype(np.int64)
        return heights

    def of_physical(self, heights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return physical heights, scale and offset applied, in 1/16 quanta; not rounded."""
        raw = (heights - self._offset) / self._scale
        return (raw * self._denominator / self._numerator - self._base) * _SIXTEENTHS

    def in_sixteenths(self, error: float) -> float:
        """Return a physical error in 1/16 quanta, whole where it is nearly so."""
        exact = error / self.quantum * _SIXTEENTHS
        near = round(exact)
        return float(near) if abs(exact - near) <= _SLACK * max(near, 1) else exact

    def physical(self, sixteenths: float) -> float:
        """Return an error of 1/16 quanta in physical units."""
        return sixteenths / _SIXTEENTHS * self.quantum


# One block


def block_surface(terrain: Any, block: Block) -> Surface:
    """Return a block's stored mesh in half samples of its level, from the block's first sample."""
    mesh = terrain.block_mesh(block)
    return Surface(
        mesh.rows.astype(np.int64), mesh.cols.astype(np.int64), mesh.heights, mesh.triangles
    )


def block_mask(terrain: Any, block: Block) -> NDArray[np.bool_]:
    """Return the validity of a block's samples, with those past the raster's edge.

    Samples of coarse levels may lie there; they are valid where the last ones inside are.
    """
    grid = terrain.grid
    region = grid.block_region(block)
    _, mask = terrain.read_with_mask(tuple(region), level=block.level, voids="any")
    stride = grid.stride(block.level)
    full = grid.full_region(block)
    n_rows, n_cols = (-(-(n - 1) // stride) + 1 for n in (full.n_rows, full.n_cols))
    return np.pad(mask, ((0, n_rows - region.n_rows), (0, n_cols - region.n_cols)), mode="edge")


def block_problems(terrain: Any, block: Block, surface: Surface) -> Iterator[str]:
    """Check that a block's mesh covers once what its samples span."""
    mask = block_mask(terrain, block)
    if min(mask.shape) < 2:
        if len(surface.triangles):
            yield "there are triangles over a single row or column of samples"
        return
    yield from problems_of(surface, mask.shape, pieces_of_mask(mask))


class Line(NamedTuple):
    """What a mesh has on a border line: vertices, and edges as pairs of places along it."""

    places: NDArray[np.int64]
    heights: NDArray[np.int64]
    edges: NDArray[np.int64]


def border_line(surface: Surface, axis: int, at: int) -> Line:
    """Return the line at row (`axis` 0) or column (1) `at`, in half samples."""
    across, along = (surface.rows, surface.cols) if axis == 0 else (surface.cols, surface.rows)
    on = np.flatnonzero(across == at)
    order = on[np.argsort(along[on], kind="stable")]
    edges = boundary_edges(surface.triangles, len(surface.rows))
    edges = edges[(across[edges] == at).all(axis=1)]
    return Line(along[order], surface.heights[order], np.sort(along[edges], axis=1))


def line_problems(one: Line, other: Line) -> Iterator[str]:
    """Check that two meshes leave no gap along the line they share.

    Vertices at one place have one height, and none lies inside an edge of the other mesh. Where a
    void touches the line, only one of the two may have vertices.
    """
    _, here, there = np.intersect1d(one.places, other.places, return_indices=True)
    n_apart = np.count_nonzero(one.heights[here] != other.heights[there])
    if n_apart:
        yield f"{n_apart} vertices of a shared border have two heights"
    n_inside = 0
    for places, edges in ((one.places, other.edges), (other.places, one.edges)):
        if len(edges):
            order = np.argsort(edges[:, 0])
            starts, stops = edges[order, 0], edges[order, 1]
            at = np.searchsorted(starts, places, side="left") - 1
            n_inside += int(np.count_nonzero((at >= 0) & (places < stops[np.maximum(at, 0)])))
    if n_inside:
        yield f"{n_inside} vertices of a shared border lie inside an edge of the neighbour"


# A mesh of an area


def surface_of_mesh(terrain: Any, mesh: Any, region: Region) -> Surface:
    """Return a `Mesh` in half samples of the full grid, from the first sample of `region`.

    Integers where all vertices lie on half samples, else floats: where it was cut.
    """
    transform = terrain.raster_info.transform
    # The place of the origin's pixel centre, first: vertices are near it, so nothing is lost.
    centre_row, centre_col = places_to_samples(transform, *mesh.origin[:2])
    down, right = places_to_pixels(without_shift(transform), *mesh.vertices[:, :2].T)
    cols = 2 * (right + round(centre_col) - region.col)
    rows = 2 * (down + round(centre_row) - region.row)
    heights = Ruler(terrain).of_physical(mesh.vertices[:, 2] + mesh.origin[2])
    triangles = mesh.triangles if determinant(transform) > 0 else mesh.triangles[:, ::-1]
    surface = Surface(_snapped(rows), _snapped(cols), _snapped(heights), triangles)
    if not all((values == np.rint(values)).all() for values in surface[:3]):
        return surface
    whole = [values.astype(np.int64) for values in surface[:3]]
    return Surface(whole[0], whole[1], whole[2], triangles)


def _snapped(values: NDArray[np.float64]) -> NDArray[Any]:
    """Return numbers within 1e-6 of integers, or of what float64 holds there, as these."""
    whole = np.rint(values)
    return np.where(np.abs(values - whole) <= 1e-6 + 1e-14 * np.abs(values), whole, values)


def area_pieces(terrain: Any, region: Region, level: int) -> NDArray[np.uint8]:
    """Count the full grid's quads in `region` that samples of a level span."""
    grid = terrain.grid
    stride = grid.stride(level)
    n_rows, n_cols = grid.level_shape(level)
    first_row, first_col = region.row // stride, region.col // stride
    last_row = -(-(region.row + region.n_rows - 1) // stride)
    last_col = -(-(region.col + region.n_cols - 1) // stride)
    inside = Region(
        first_row,
        first_col,
        min(last_row, n_rows - 1) - first_row + 1,
        min(last_col, n_cols - 1) - first_col + 1,
    )
    _, mask = terrain.read_with_mask(tuple(inside), level=level, voids="any")
    beyond = max(last_row - n_rows + 1, 0), max(last_col - n_cols + 1, 0)
    mask = np.pad(mask, ((0, beyond[0]), (0, beyond[1])), mode="edge")
    pieces = refined_pieces(pieces_of_mask(mask), stride)
    row, col = region.row - first_row * stride, region.col - first_col * stride
    return pieces[row : row + region.n_rows - 1, col : col + region.n_cols - 1]


def mesh_problems(terrain: Any, mesh: Any, region: Region, level: int | None) -> Iterator[str]:
    """Check a `Mesh` over `region` of the full grid as a surface.

    `level` is that of all its blocks; None if they may be of several: it then covers at least what
    the full grid's samples span, and coarser blocks may cover more.
    """
    surface = surface_of_mesh(terrain, mesh, region)
    shape = region.n_rows, region.n_cols
    if level is not None:
        yield from problems_of(surface, shape, area_pieces(terrain, region, level))
    else:
        finest = area_pieces(terrain, region, terrain.n_levels - 1)
        if (finest != NOTHING).all() and (finest == finest.max()).all():
            yield from problems_of(surface, shape, finest)
        else:
            yield from problems_of(surface, shape, at_least=finest)


def must_be_covered(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the samples that are corners of what `pieces_of_mask` gives."""
    covered = np.zeros(valid.shape, dtype=np.bool_)
    if min(valid.shape) < 2:
        return covered
    has = pieces_of_mask(valid) != NOTHING
    for rows in (slice(0, -1), slice(1, None)):
        for cols in (slice(0, -1), slice(1, None)):
            covered[rows, cols] |= has
    covered &= valid
    return covered


# A file


class MeshVerification:
    """The checks of one file's meshes.

    Parameters
    ----------
    terrain : Terrain
    read : callable, optional
        Returns raw originals and validity of a region of the full grid; without it errors are
        measured from the decoded heights, and may exceed what is stated by the file's own bound.
    """

    def __init__(
        self,
        terrain: Any,
        read: ReadOriginal | None = None,
        progress: ProgressCallback | None = None,
    ) -> None:
        self._terrain, self._grid = terrain, terrain.grid
        self._has_original = read is not None
        self._read = read or self._decoded
        self._progress = progress
        self._ruler = Ruler(terrain)
        # Of kinds that state what was measured and promise nothing more.
        self._is_unbounded = terrain.mesh_kind in UNBOUNDED_MESHES
        self._allowed = self._ruler.slack + (0 if read else self._ruler.coded)
        self._checks = Checks()
        self._lines: dict[tuple[Block, int], Line] = {}
        n_levels = terrain.n_levels
        self._n_blocks, self._n_triangles = [0] * n_levels, [0] * n_levels
        self._stored, self._measured = [0.0] * n_levels, [0.0] * n_levels
        self._n_done = self._n_total = 0

    def run(self) -> tuple[MeshReport, list[str]]:
        """Return the report and all problems."""
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
        return MeshReport(terrain.mesh_kind, against, levels, areas), self._checks.all()

    def _decoded(self, region: Region) -> tuple[NDArray[np.generic], NDArray[np.bool_]]:
        raw, valid = self._terrain.read_with_mask(tuple(region))
        return raw, valid

    def _report(self, n_samples: int) -> None:
        self._n_done += n_samples
        if self._progress is not None:
            itemsize = self._terrain.dtype.itemsize
            self._progress(
                Progress("verify meshes", self._n_done, self._n_total, self._n_done * itemsize)
            )

    # Stored meshes

    def _visit(self, block: Block, chain: list[tuple[Block, Surface]]) -> None:
        where = f"mesh of block {tuple(block)}"
        try:
            surface = block_surface(self._terrain, block)
            self._checks.add(where, block_problems(self._terrain, block, surface))
            self._check_lines(block, surface)
            self._stored[block.level] = max(
                self._stored[block.level], self._terrain.mesh_error(block)
            )
        except TerrainwaveError as error:
            self._checks.add(where, [str(error)])
            return
        self._n_blocks[block.level] += 1
        self._n_triangles[block.level] += len(surface.triangles)
        chain = [*chain, (block, surface)]
        if block.level < self._grid.k_max:
            for child in self._grid.children(block):
                self._visit(child, chain)
        else:
            region = self._grid.block_region(block)
            try:
                self._measure(region, chain)
            except CorruptStreamError as error:
                self._checks.add(where, [str(error)])
            self._report(region.n_rows * region.n_cols)

    def _measure(self, region: Region, chain: list[tuple[Block, Surface]]) -> None:
        raw, valid = self._read(region)
        samples = self._ruler.sixteenths(raw, valid)
        for block, surface in chain:
            stride = self._grid.stride(block.level)
            first = block.row * self._grid.block * stride, block.col * self._grid.block * stride
            stored = self._ruler.in_sixteenths(self._terrain.mesh_error(block))
            errors = deviation(
                surface.on_grid(stride),
                samples,
                valid,
                stored + self._allowed,
                (region.row - first[0], region.col - first[1]),
            )
            self._measured[block.level] = max(self._measured[block.level], errors.worst)
            where = f"mesh of block {tuple(block)}"
            self._checks.add(where, self._error_problems(errors, stored, region))
            # Coarse meshes lie over all valid samples below them.
            wanted = must_be_covered(valid) if block.level == self._grid.k_max else valid
            if min(valid.shape) > 1:
                self._checks.add(where, _missing(errors, wanted, region))
            if block.level == self._grid.k_max and not self._is_unbounded:
                self._checks.add(where, self._tolerance_problems(surface, region))

    def _tolerance_problems(self, surface: Surface, region: Region) -> Iterator[str]:
        """Check a finest mesh against the decoded heights, which it is made from."""
        raw, valid = self._decoded(region)
        tolerance = self._ruler.in_sixteenths(self._terrain.info().mesh_tolerance)
        errors = deviation(
            surface,
            self._ruler.sixteenths(raw, valid),
            valid,
            tolerance + self._ruler.decoded_slack,
        )
        if errors.n_beyond:
            yield (
                f"{errors.n_beyond} decoded heights are further from it than the tolerance"
                f" {self._ruler.physical(tolerance):g}; the worst, at row"
                f" {region.row + errors.row}, column {region.col + errors.col}, by"
                f" {self._ruler.physical(errors.worst):g}"
            )

    def _error_problems(self, errors: Deviation, stored: float, region: Region) -> Iterator[str]:
        if errors.n_beyond:
            what = "heights" if self._has_original else "decoded heights"
            yield (
                f"{errors.n_beyond} {what} are further from it than the stated error"
                f" {self._ruler.physical(stored):g}; the worst, at row"
                f" {region.row + errors.row}, column {region.col + errors.col}, by"
                f" {self._ruler.physical(errors.worst):g}"
            )

    def _check_lines(self, block: Block, surface: Surface) -> None:
        """Compare borders with neighbours that came before; keep those of the ones to come."""
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
                    self._checks.add(where, line_problems(kept, line))

    # Meshes of areas

    def _plans(self) -> Iterator[tuple[float | None, int]]:
        if min(self._terrain.shape) < 2 or determinant(self._terrain.raster_info.transform) == 0:
            return  # no area, or no place in the world
        yield None, 0
        bound, quantum = self._terrain.quanta_error, self._ruler.quantum
        for factor in _FACTORS:
            # With something of the bound left for the mesh.
            yield max(bound * factor, bound + quantum * factor), int(factor == _FACTORS[-1])

    def _windows(self) -> Iterator[Region]:
        n_rows, n_cols = self._terrain.shape
        for cells in Region(0, 0, n_rows - 1, n_cols - 1).tiles(_WINDOW_SIDE, _WINDOW_SIDE):
            yield Region(cells.row, cells.col, cells.n_rows + 1, cells.n_cols + 1)

    def _check_areas(self, max_error: float | None, optimise: int) -> AreaMeshes:
        n_windows = n_triangles = 0
        stated = measured = 0.0
        for region in self._windows():
            asked = "the stored error" if max_error is None else f"max_error {max_error:g}"
            where = f"mesh at {asked} of window {tuple(region)}"
            n_windows += 1
            try:
                mesh = self._terrain.mesh(tuple(region), max_error=max_error, optimise=optimise)
                problems, worst = self._check_area(mesh, region, max_error)
            except TerrainwaveError as error:
                self._checks.add(where, [str(error)])
                continue
            finally:
                self._report(region.n_rows * region.n_cols)
            self._checks.add(where, problems)
            n_triangles += mesh.n_triangles
            stated, measured = max(stated, mesh.error), max(measured, worst)
        return AreaMeshes(
            max_error, optimise, n_windows, n_triangles, stated, self._ruler.physical(measured)
        )

    def _check_area(
        self, mesh: Any, region: Region, max_error: float | None
    ) -> tuple[list[str], float]:
        terrain = self._terrain
        problems = []
        if max_error is not None and mesh.error > max_error * (1 + _SLACK):
            problems.append(f"it states an error of {mesh.error:g}")
        level = terrain.n_levels - 1 if max_error is None else None
        problems += mesh_problems(terrain, mesh, region, level)
        raw, valid = self._read(region)
        stated = self._ruler.in_sixteenths(mesh.error)
        errors = deviation(
            surface_of_mesh(terrain, mesh, region),
            self._ruler.sixteenths(raw, valid),
            valid,
            stated * (1 + _SLACK) + self._allowed,
        )
        problems += self._error_problems(errors, stated, region)
        problems += _missing(errors, must_be_covered(valid), region)
        return problems, errors.worst


def _missing(errors: Deviation, wanted: NDArray[np.bool_], region: Region) -> Iterator[str]:
    missing = wanted & ~errors.is_covered
    if missing.any():
        row, col = np.argwhere(missing)[0].tolist()
        yield (
            f"{np.count_nonzero(missing)} valid samples are not covered, one at row"
            f" {region.row + row}, column {region.col + col}"
        )


def verify_meshes(
    terrain: Any, read: ReadOriginal | None = None, progress: ProgressCallback | None = None
) -> tuple[MeshReport, list[str]]:
    """Check all meshes of a file; return the report and all problems."""
    return MeshVerification(terrain, read, progress).run()
