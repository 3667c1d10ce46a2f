"""A file's meshes as surfaces on its grids, and the required cover by its samples."""

import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.affine import determinant, places_to_pixels, places_to_samples, without_shift
from terrainwave.grid.quadtree import Block, Region
from terrainwave.verification.checks import (
    NOTHING,
    CheckedMesh,
    Deviation,
    boundary_edges,
    deviation,
    pieces_of_mask,
    problems_of,
    refined_pieces,
)

SIXTEENTHS = 16
# Relative tolerance for decimal errors as float64.
_SLACK = 1e-9


class QuantaScale:
    """Conversion of a file's heights to 1/16 quanta, only by the numbers of its header."""

    def __init__(self, terrain: Any) -> None:
        header, info = terrain.header, terrain.info()
        self._numerator, self._denominator = header.quantum.numerator, header.quantum.denominator
        self._base = int(header.base)
        self._is_grid = header.rho == 0
        self._is_integer = np.dtype(terrain.dtype).kind in "iu"
        self._scale, self._offset = float(info.scale), float(info.offset)
        self.quantum = float(info.quantum)
        # Heights off the grid are rounded to 1/16 quanta here.
        self.slack = 0 if self._is_grid else 1
        self.decoded_slack = 0 if self._is_grid else 1 + self._of_decoded(header)
        self.coded = math.ceil(terrain.quanta_error / self.quantum * SIXTEENTHS * (1 - _SLACK))

    def _of_decoded(self, header: Any) -> int:
        """Return the largest distance of decoded heights off the grid from their quanta.

        Half a float's spacing, the excess of `rho` over half a quantum; with remainders all of
        `rho`.
        """
        rounded = Fraction(header.rho) / header.quantum
        if not header.has_remainders:
            rounded -= Fraction(1, 2)
        return max(math.ceil(rounded * SIXTEENTHS), 0)

    def sixteenths(self, raw: NDArray[np.generic], valid: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return raw heights in 1/16 quanta: exact on a true grid, else the nearest."""
        heights = np.zeros(raw.shape, dtype=np.int64)
        if self._is_integer and self._is_grid and self._denominator == 1:
            whole = raw[valid].astype(np.int64) // self._numerator
            heights[valid] = (whole - self._base) * SIXTEENTHS
            return heights
        quanta = raw[valid].astype(np.float64) * self._denominator / self._numerator
        if self._is_grid:
            heights[valid] = (np.rint(quanta).astype(np.int64) - self._base) * SIXTEENTHS
        else:
            heights[valid] = np.rint((quanta - self._base) * SIXTEENTHS).astype(np.int64)
        return heights

    def of_physical(self, heights: NDArray[np.float64]) -> NDArray[np.float64]:
        raw = (heights - self._offset) / self._scale
        return (raw * self._denominator / self._numerator - self._base) * SIXTEENTHS

    def in_sixteenths(self, error: float) -> float:
        """Return a physical error in 1/16 quanta, rounded if it is nearly whole."""
        exact = error / self.quantum * SIXTEENTHS
        near = round(exact)
        return float(near) if abs(exact - near) <= _SLACK * max(near, 1) else exact

    def physical(self, sixteenths: float) -> float:
        return sixteenths / SIXTEENTHS * self.quantum


def block_surface(terrain: Any, block: Block) -> CheckedMesh:
    """Return a block's stored mesh in half samples of its level, from the block's first sample."""
    mesh = terrain.block_mesh(block)
    return CheckedMesh(
        mesh.rows.astype(np.int64), mesh.cols.astype(np.int64), mesh.heights, mesh.triangles
    )


def block_mask(terrain: Any, block: Block) -> NDArray[np.bool_]:
    """Return the validity of a block's samples; past the raster's edge that of the last inside."""
    grid = terrain.grid
    region = grid.block_region(block)
    _, mask = terrain.read_with_mask(region, level=block.level, voids="any")
    stride = grid.stride(block.level)
    full = grid.full_region(block)
    n_rows, n_cols = (-(-(n - 1) // stride) + 1 for n in (full.n_rows, full.n_cols))
    return np.pad(mask, ((0, n_rows - region.n_rows), (0, n_cols - region.n_cols)), mode="edge")


def block_problems(terrain: Any, block: Block, surface: CheckedMesh) -> Iterator[str]:
    mask = block_mask(terrain, block)
    if min(mask.shape) < 2:
        if len(surface.triangles):
            yield "there are triangles over a single row or column of samples"
        return
    yield from problems_of(surface, mask.shape, pieces_of_mask(mask))


class BorderLine(NamedTuple):
    """Part of a mesh on a border line: vertices, and edges as pairs of positions along it."""

    places: NDArray[np.int64]
    heights: NDArray[np.int64]
    edges: NDArray[np.int64]


def border_line(surface: CheckedMesh, axis: int, at: int) -> BorderLine:
    across, along = (surface.rows, surface.cols) if axis == 0 else (surface.cols, surface.rows)
    on = np.flatnonzero(across == at)
    order = on[np.argsort(along[on], kind="stable")]
    edges = boundary_edges(surface.triangles, len(surface.rows))
    edges = edges[(across[edges] == at).all(axis=1)]
    return BorderLine(along[order], surface.heights[order], np.sort(along[edges], axis=1))


def line_problems(one: BorderLine, other: BorderLine) -> Iterator[str]:
    """Check that two meshes leave no gap along their common line.

    Vertices at one position have one height, and none lies inside an edge of the other mesh.
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


def surface_of_mesh(terrain: Any, mesh: Any, region: Region) -> CheckedMesh:
    """Return a `Mesh` in half samples of the full grid: integers if all vertices lie on them."""
    transform = terrain.raster_info.transform
    # Relative to the origin's pixel centre: vertices are near it, so no precision is lost.
    centre_row, centre_col = places_to_samples(transform, *mesh.origin[:2])
    down, right = places_to_pixels(without_shift(transform), *mesh.vertices[:, :2].T)
    cols = 2 * (right + round(centre_col) - region.col)
    rows = 2 * (down + round(centre_row) - region.row)
    heights = QuantaScale(terrain).of_physical(mesh.vertices[:, 2] + mesh.origin[2])
    triangles = mesh.triangles if determinant(transform) > 0 else mesh.triangles[:, ::-1]
    surface = CheckedMesh(_snapped(rows), _snapped(cols), _snapped(heights), triangles)
    if not all((values == np.rint(values)).all() for values in surface[:3]):
        return surface
    whole = [values.astype(np.int64) for values in surface[:3]]
    return CheckedMesh(whole[0], whole[1], whole[2], triangles)


def _snapped(values: NDArray[np.float64]) -> NDArray[Any]:
    """Return numbers; those within 1e-6 or float64's precision of integers are rounded."""
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
    _, mask = terrain.read_with_mask(inside, level=level, voids="any")
    beyond = max(last_row - n_rows + 1, 0), max(last_col - n_cols + 1, 0)
    mask = np.pad(mask, ((0, beyond[0]), (0, beyond[1])), mode="edge")
    pieces = refined_pieces(pieces_of_mask(mask), stride)
    row, col = region.row - first_row * stride, region.col - first_col * stride
    return pieces[row : row + region.n_rows - 1, col : col + region.n_cols - 1]


def mesh_problems(terrain: Any, mesh: Any, region: Region, level: int | None) -> Iterator[str]:
    """Check a `Mesh` over `region` of the full grid, with blocks of one `level` or of several.

    Of several, it must cover at least the span of the full grid's samples.
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
    """Return the samples that are corners of the result of `pieces_of_mask`."""
    covered = np.zeros(valid.shape, dtype=np.bool_)
    if min(valid.shape) < 2:
        return covered
    has = pieces_of_mask(valid) != NOTHING
    for rows in (slice(0, -1), slice(1, None)):
        for cols in (slice(0, -1), slice(1, None)):
            covered[rows, cols] |= has
    covered &= valid
    return covered


_STRIP_SAMPLES = 1 << 24

ReadOriginal = Callable[[Region], tuple[NDArray[np.generic], NDArray[np.bool_]]]


def area_problems(
    terrain: Any,
    mesh: Any,
    region: Region,
    max_error: float | None,
    read: ReadOriginal | None = None,
) -> tuple[list[str], float]:
    """Return the problems of a `Mesh` of `region`, and the largest distance of samples from it.

    `max_error` is None for the stored meshes. Without `read`, errors are measured from the decoded
    heights, and may exceed the stated ones by the file's own bound.
    """
    ruler, problems, worst = QuantaScale(terrain), [], 0
    if max_error is not None and mesh.error > max_error * (1 + _SLACK):
        problems.append(f"it states an error of {mesh.error:g}")
    level = terrain.n_levels - 1 if max_error is None else None
    problems += mesh_problems(terrain, mesh, region, level)
    surface, stated = surface_of_mesh(terrain, mesh, region), ruler.in_sixteenths(mesh.error)
    limit = stated * (1 + _SLACK) + ruler.slack + (0 if read else ruler.coded)
    for strip in region.tiles(max(_STRIP_SAMPLES // region.n_cols, 2), region.n_cols):
        # One more row at the end: quads are covered between rows.
        last = min(strip.row + strip.n_rows + 1, region.row + region.n_rows)
        strip = strip._replace(n_rows=last - strip.row)
        raw, valid = (read or terrain.read_with_mask)(strip)
        place = strip.row - region.row, 0
        errors = deviation(surface, ruler.sixteenths(raw, valid), valid, limit, place)
        what = "heights" if read else "decoded heights"
        problems += error_problems(ruler, errors, stated, strip, what)
        problems += missing_samples(errors, must_be_covered(valid), strip)
        worst = max(worst, errors.worst)
    return problems, ruler.physical(worst)


def error_problems(
    ruler: QuantaScale,
    errors: Deviation,
    most: float,
    region: Region,
    what: str,
    of: str = "stated error",
) -> Iterator[str]:
    if errors.n_beyond:
        yield (
            f"{errors.n_beyond} {what} are further from it than the {of}"
            f" {ruler.physical(most):g}; the worst, at row"
            f" {region.row + errors.row}, column {region.col + errors.col}, by"
            f" {ruler.physical(errors.worst):g}"
        )


def missing_samples(errors: Deviation, wanted: NDArray[np.bool_], region: Region) -> Iterator[str]:
    missing = wanted & ~errors.is_covered
    if missing.any():
        row, col = np.argwhere(missing)[0].tolist()
        yield (
            f"{np.count_nonzero(missing)} valid samples are not covered, one at row"
            f" {region.row + row}, column {region.col + col}"
        )
