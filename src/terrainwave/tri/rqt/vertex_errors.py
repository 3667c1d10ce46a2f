"""Errors and dependencies of a restricted quadtree's vertices (`view`)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.tri.rqt.stored import neighbours, own_neighbours
from terrainwave.tri.triangle import area_of

_ROUNDING = 2.0**-22
_TINY = 1e-6  # shift that makes an error negative


def rounding_of(heights: tuple[float, float]) -> float:
    """Return a bound on float32 rounding of heights within these bounds and of derived values."""
    return float(np.abs(heights).max()) * _ROUNDING


def twist_of(heights: NDArray[np.floating[Any]]) -> float:
    """Return the largest distance of a cell's bilinear surface from its two triangles."""
    twists = np.abs(heights[:-1, :-1] - heights[:-1, 1:] - heights[1:, :-1] + heights[1:, 1:])
    return float(np.max(twists, initial=0, where=~np.isnan(twists))) / 4


@kernel
def is_corner(row, col, tile):
    """Return whether a position is a corner of tiles; those are always vertices."""
    return (row | col) & (tile - 1) == 0


@kernel
def needs_of(row, col, tile):
    """Return the two vertices that one depends on; itself twice if it is a tile's corner."""
    if is_corner(row, col, tile):
        return row, col, row, col
    _, _, _, _, r2, c2, r3, c3 = own_neighbours(row, col)
    return r2, c2, r3, c3


@kernel
def measure_tile(first_row, first_col, base, is_bound, z, coefficients, errors):
    """Widen the errors of a tile's vertices, finest first, by those in the tile.

    `z` and `errors` are those of the tile, whose first sample is at `first_row` and `first_col`:
    these decide the diagonals of its cells. `coefficients` are magnitudes by vertex; if empty,
    errors are the distances from the mean of the neighbours, on the tile's border of those inside.
    """
    side = z.shape[0] - 1
    stride = 1
    while stride < side:
        for is_centre in range(2):
            for row in range(0, side + 1, stride):
                is_odd = row & stride != 0
                if is_centre and not is_odd:
                    continue
                for col in range(stride if is_centre or not is_odd else 0, side + 1, 2 * stride):
                    _measure_vertex(
                        row, col, stride, first_row, first_col, base, is_bound, z, coefficients,
                        errors,
                    )  # fmt: skip
        stride *= 2


@kernel
def _measure_vertex(
    row, col, stride, first_row, first_col, base, is_bound, z, coefficients, errors
):
    """Widen the error of one vertex by its triangles in a tile, and its dependencies by that."""
    r0, c0, r1, c1, r2, c2, r3, c3 = neighbours(row + first_row, col + first_col, stride)
    r0, r1, r2, r3 = r0 - first_row, r1 - first_row, r2 - first_row, r3 - first_row
    c0, c1, c2, c3 = c0 - first_col, c1 - first_col, c2 - first_col, c3 - first_col
    if not is_bound:
        detail = _detail(row, col, ((r0, c0), (r1, c1), (r2, c2), (r3, c3)), z)
        if coefficients.shape[0] > 0 and not np.isnan(z[row, col]):
            own = np.float64(coefficients[row, col])
            detail = own if detail >= 0 else -own - _TINY
        widen(errors, row, col, detail)
    for r, c in ((r2, c2), (r3, c3)):
        if is_bound and _is_inside(r, c, z.shape):
            error = _distance(r0, c0, r1, c1, r, c, z)
            error += -base if error < 0 else base
            widen(errors, row, col, error * (1 + _ROUNDING))
    for r, c in ((r2, c2), (r3, c3)):
        if _is_inside(r, c, z.shape):
            widen(errors, r, c, np.float64(errors[row, col]))


@kernel
def widen_everywhere(errors, tile):
    """Make errors no smaller than those of all dependent vertices, in other tiles too."""
    n_rows, n_cols = errors.shape
    stride = 1
    while stride < tile:
        for is_centre in range(2):
            for row in range(0, n_rows, stride):
                is_odd = row & stride != 0
                if is_centre and not is_odd:
                    continue
                for col in range(stride if is_centre or not is_odd else 0, n_cols, 2 * stride):
                    r2, c2, r3, c3 = needs_of(row, col, tile)
                    for r, c in ((r2, c2), (r3, c3)):
                        if _is_inside(r, c, errors.shape):
                            widen(errors, r, c, np.float64(errors[row, col]))
        stride *= 2


@kernel
def _is_inside(row, col, shape):
    return 0 <= row < shape[0] and 0 <= col < shape[1]


@kernel
def widen(errors, row, col, error):
    """Raise an error to another one, and make it negative if either is; return if it changed."""
    before = errors[row, col]
    larger = max(abs(np.float64(before)), abs(error))
    errors[row, col] = -larger if before < 0 or error < 0 else larger
    return errors[row, col] != before


@kernel
def _detail(row, col, around, z):
    """Return |h - mean of its four neighbours|; a negative number next to a void."""
    (r0, c0), (r1, c1) = around[:2]
    total, count = 0.0, 0
    for r, c in around:
        if 0 <= r < z.shape[0] and 0 <= c < z.shape[1]:
            total += z[r, c]
            count += 1
    detail = abs(z[row, col] - total / count)
    if not np.isnan(detail):
        return detail
    is_void = np.isnan(z[row, col]) and np.isnan(z[r0, c0]) and np.isnan(z[r1, c1])
    return 0.0 if is_void else -_TINY


@kernel
def _distance(r0, c0, r1, c1, r2, c2, z):
    """Return the largest distance of samples from a triangle.

    0 if all are void; if some are, the range of the others as a negative number.
    """
    area = np.float64(area_of(r0, c0, r1, c1, r2, c2))
    n_void, largest, low, high = 0, 0.0, np.inf, -np.inf
    top, bottom = min(r0, r1, r2), max(r0, r1, r2)
    left, right = min(c0, c1, c2), max(c0, c1, c2)
    z0, z1, z2 = np.float64(z[r0, c0]), np.float64(z[r1, c1]), np.float64(z[r2, c2])
    for r in range(top, bottom + 1):
        for c in range(left, right + 1):
            one = area_of(r, c, r1, c1, r2, c2) / area
            two = area_of(r0, c0, r, c, r2, c2) / area
            three = 1 - one - two
            if min(one, two, three) < -1e-9:
                continue
            if np.isnan(z[r, c]):
                n_void += 1
                continue
            low, high = min(low, z[r, c]), max(high, z[r, c])
            apart = abs(one * z0 + two * z1 + three * z2 - z[r, c])
            if apart > largest:
                largest = apart
    if n_void:
        return low - high - _TINY if high >= low else 0.0
    return largest
