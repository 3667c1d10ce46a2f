"""Heights of a vertex that keep the samples of a triangle within a tolerance, exactly.

Heights are integers, centred and held in float64: with |z| <= 2^30 and areas below 2^22 every
product is below 2^53, so all machines find the same intervals, with fused multiplications or not.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import inlined_kernel
from terrainwave.tri.block_mesh import FRACTION_BITS

_MAX_RANGE = 1 << 30
# Width of a triangle, in columns, up to which scanning its whole rectangle is faster.
_NARROW = 6


class FixedPoint(NamedTuple):
    """Fixed-point representation of heights: ``value = (quanta - base) << bits``.

    `tolerance` is in this unit, as are `lowest` and `highest`, the limits of vertices.
    """

    base: int
    bits: int
    tolerance: float
    lowest: float
    highest: float

    def to_mesh(self, values: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return heights in 1/16 quanta."""
        whole = values.astype(np.int64) << (FRACTION_BITS - self.bits)
        return whole + (self.base << FRACTION_BITS)

    def of_mesh(self, heights: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return heights in 1/16 quanta as values; the inverse of `to_mesh`."""
        whole = (heights - (self.base << FRACTION_BITS)) >> (FRACTION_BITS - self.bits)
        return whole.astype(np.float64)


def fixed_point(lowest: int, highest: int, tolerance: int) -> FixedPoint:
    """Return the fixed point for valid heights in a range of quanta; `tolerance`: 1/16 quanta.

    Its unit is 1/16 quantum if the range leaves room for that, else a whole quantum.
    """
    base = (lowest + highest) >> 1
    bits = FRACTION_BITS if (highest - lowest) << FRACTION_BITS < _MAX_RANGE else 0
    slack = min(tolerance >> (FRACTION_BITS - bits), _MAX_RANGE)
    least, most = ((lowest - base) << bits) - slack, ((highest - base) << bits) + slack
    return FixedPoint(base, bits, float(slack), float(least), float(most))


def scaled_heights(
    heights: NDArray[np.int32], mask: NDArray[np.bool_], tolerance: int
) -> tuple[NDArray[np.int32], FixedPoint]:
    """Return heights as values, and the scale; `tolerance` is in 1/16 quanta."""
    valid = heights[mask]
    scale = fixed_point(int(valid.min()), int(valid.max()), tolerance)
    values = ((heights.astype(np.int64) - scale.base) << scale.bits).astype(np.int32)
    return values, scale


@inlined_kernel
def fit_triangle(heights, start, pitch, place, second, third, tolerance, low, high):
    """Narrow the interval of a vertex's height to the values that a triangle's samples allow.

    Heights are flat: sample (row, col) is number ``start + row * pitch + col``. Positions are
    doubled: `place` is vertex 0's (row, col), the others are (row, col, height). The interval has
    whole numbers; low > high if it is empty. Samples on the edge opposite to vertex 0 don't depend
    on its height: the triangle beyond the edge, or a border, tests them.

    Quotients of integers n / d, |n| < 2^53, round to the right floor and ceiling: they are 1 / d or
    more from any integer that they don't equal, and rounding moves them by less.
    """
    row_0, col_0 = place
    row_1, col_1, z_1 = second
    row_2, col_2, z_2 = third
    area = (col_1 - col_0) * (row_2 - row_0) - (col_2 - col_0) * (row_1 - row_0)
    scale = float(area)
    slack = tolerance * scale
    first_col, last_col = (min(col_0, col_1, col_2) + 1) >> 1, max(col_0, col_1, col_2) >> 1
    first_row, last_row = (min(row_0, row_1, row_2) + 1) >> 1, max(row_0, row_1, row_2) >> 1
    growth_0, growth_1 = -2 * (row_2 - row_1), -2 * (row_0 - row_2)
    growth_2 = -(growth_0 + growth_1)
    rise = float(growth_1) * z_1 + float(growth_2) * z_2
    is_wide = last_col - first_col > _NARROW
    # From the end nearer to vertex 0, where samples narrow the interval most.
    down, top = 1, first_row
    if row_0 > first_row + last_row:
        down, top = -1, last_row
    left = 2 * first_col
    first_0 = (col_1 - left) * (row_2 - 2 * top) - (col_2 - left) * (row_1 - 2 * top)
    first_1 = (col_2 - left) * (row_0 - 2 * top) - (col_0 - left) * (row_2 - 2 * top)
    at = start + top * pitch + first_col
    for _ in range(last_row - first_row + 1):
        weight_0, weight_1 = first_0, first_1
        weight_2 = area - weight_0 - weight_1
        skip, most = 0, last_col - first_col
        if is_wide:
            # Range in which no weight is negative, and that of vertex 0 is not 0.
            skip, most = _cut(weight_0 - 1, growth_0, skip, most)
            skip, most = _cut(weight_1, growth_1, skip, most)
            skip, most = _cut(weight_2, growth_2, skip, most)
            weight_0 += skip * growth_0
            weight_1 += skip * growth_1
            weight_2 += skip * growth_2
        fixed = float(weight_1) * z_1 + float(weight_2) * z_2
        if is_wide and not _narrows(
            heights, at + skip, most - skip + 1, scale, slack, (fixed, rise),
            (float(weight_0), float(growth_0)), low, high,
        ):  # fmt: skip
            most = -1
        for col in range(at + skip, at + most + 1):
            if weight_0 > 0 and (weight_1 | weight_2) >= 0:
                rest = float(heights[np.uint64(col)]) * scale - fixed
                share = float(weight_0)
                if rest - slack > low * share:
                    low = np.ceil((rest - slack) / share)
                if rest + slack < high * share:
                    high = np.floor((rest + slack) / share)
            weight_0 += growth_0
            weight_1 += growth_1
            weight_2 += growth_2
            fixed += rise
        if low > high:
            break
        at += down * pitch
        first_0 += 2 * down * (col_2 - col_1)
        first_1 += 2 * down * (col_0 - col_2)
    return low, high


@inlined_kernel
def _narrows(heights, at, count, scale, slack, fixed_line, share_line, low, high):
    """Return whether any sample of a row of a triangle narrows the interval; a vectorisable loop.

    Lines are the value at the first sample and its increment from one to the next. All of it is
    exact, as in `fit_triangle`: so are weights times heights and their differences.
    """
    fixed, rise = fixed_line
    share, growth = share_line
    n_beyond = 0
    for k in range(count):
        place = float(np.int32(k))
        rest = float(heights[np.uint64(at + k)]) * scale - (fixed + place * rise)
        own = share + place * growth
        is_beyond = (rest - slack > low * own) | (rest + slack < high * own)
        n_beyond += 1 if is_beyond else 0
    return n_beyond > 0


@inlined_kernel
def _cut(weight, growth, skip, most):
    """Shorten the range `skip` … `most` to positions where weight + position * step >= 0."""
    if growth > 0:
        if weight < 0:
            skip = max(skip, int(np.ceil(float(-weight) / float(growth))))
    elif weight < 0:
        most = -1
    elif growth < 0:
        most = min(most, int(np.floor(float(weight) / float(-growth))))
    return skip, most
