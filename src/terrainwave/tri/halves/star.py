"""Interval of heights that a cell's vertex may take, from the triangles around the cell.

Most of these have one of a few shapes. For each shape a table stores its program: the samples of a
triangle and their ratios of weights. Triangles without one need divisions at every sample.
"""

import numpy as np

from terrainwave.coding.jit import inlined_kernel, kernel, kernel_part
from terrainwave.tri.halves.certificates import NO_TEST, ring_pair, write_refusal
from terrainwave.tri.halves.height_fit import fit_triangle
from terrainwave.tri.halves.workspace import (
    COL_MASK,
    FREE,
    HEIGHT,
    HIGH,
    LEVEL,
    LOW,
    N_ENTRIES,
    N_SLOTS_LOG2,
    N_USED,
    OFFSETS,
    OTHERS,
    PLANES,
    RATIOS,
    ROW_BITS,
    TABLE,
    VERTEX,
)

# A triangle's key: distances of its two other vertices from the first, each of the four -32 … 31
# half samples, and whether the first lies on a sample's row and column. The bit above distinguishes
# it from an empty slot. So twice the area, in half samples, is at most 2 * 32 * 32.
_REACH, _REACH_BITS = 32, 6
_IS_KEY = 1 << (4 * _REACH_BITS + 2)
_HASH = 0x9E3779B1  # 2^32 over the golden ratio

# A program: its first entry and, in the low bits, their number; or a triangle without one.
_COUNT_BITS = 6
_MAX_ENTRIES = (1 << _COUNT_BITS) - 1
_NO_PROGRAM = -1

# Programs find the bounds (h * area - w_1 * z_1 - w_2 * z_2 -+ tolerance * area) / w_0 in float64.
# With heights and tolerances up to 2^24, each of h * area / w_0, the two w * z / w_0 together and
# tolerance * area / w_0 is at most 2^35, and roundings of floats, products and sums move a bound by
# less than 16 * 2^-53 * 2^35 = 2^-14. Widened by 2^-13, it is less than 2^-12 outside the true one
# and never inside; and that, a multiple of 1 / w_0, is whole or 2^-11 or more inside the next
# whole number. So both have the same ceiling, or floor. Greater heights take `fit_triangle`.
MAX_PROGRAM_HEIGHT = float(1 << 24)
_MARGIN = 2.0**-13


@inlined_kernel
def fit_star(work, floats, plane, pitch, has_table, cell, are_unmoved_known, tolerance, test):
    """Narrow the interval of heights of a vertex whose cell is this rectangle of samples.

    `cell` is its first and last row, first and last column. Its triangles are those between the
    centre and two neighbours on the ring of samples around the cell; two corners of the ring touch
    no triangle of the cell. With `are_unmoved_known`, the interval already includes triangles of
    two samples that have not moved, which are skipped.

    The interval is ``floats[LOW]`` to ``floats[HIGH]``, empty if a triangle has no area. Then the
    refusal by this `test` is recorded, with the positions on the ring of the triangles that raised
    and lowered it last.

    Uses the triangles with programs and lists the others, for `fit_rest`; returns the number of
    these, and the two positions. Arrays are used last outside of branches, and all called kernels
    are inlined, as otherwise every star would cost reference counts.
    """
    top, bottom, left, right = cell
    row_0, col_0 = top + bottom, left + right
    width, height = right - left + 1, bottom - top + 1
    vertices, levels = PLANES + VERTEX * plane, PLANES + LEVEL * plane
    others = PLANES + OTHERS * plane
    home = top * pitch + left
    centre = PLANES + HEIGHT * plane + (row_0 >> 1) * pitch + (col_0 >> 1)
    place_0 = _IS_KEY | (row_0 & 1) << 1 | (col_0 & 1)
    at = home - pitch - 1
    place = np.int64(work[np.uint64(vertices + 2 * at)])
    row_1, col_1 = place >> ROW_BITS, place & COL_MASK
    z_1 = float(work[np.uint64(vertices + 2 * at + 1)])
    is_known_1 = are_unmoved_known and work[np.uint64(levels + at)] <= FREE
    start = at
    low, high = floats[LOW], floats[HIGH]
    low_pair = high_pair = ring_pair(home, at, at)
    n_others = 0
    for side in range(4):
        stride, count, at = _side_of(side, at, pitch, width, height)
        for _ in range(count):
            at += stride
            other = np.int64(work[np.uint64(vertices + 2 * at)])
            if other == place:
                is_known_1 = False  # a vertex shared by a border line's samples
                continue
            is_known_2 = are_unmoved_known and work[np.uint64(levels + at)] <= FREE
            row_2, col_2 = other >> ROW_BITS, other & COL_MASK
            z_2 = float(work[np.uint64(vertices + 2 * at + 1)])
            if not (is_known_1 and is_known_2):
                area = (col_1 - col_0) * (row_2 - row_0) - (col_2 - col_0) * (row_1 - row_0)
                program = np.int64(_NO_PROGRAM)
                key = _key_of(row_1 - row_0, col_1 - col_0, row_2 - row_0, col_2 - col_0, place_0)
                if has_table and key:
                    slot = _slot_of(key)
                    if work[np.uint64(slot)] == key:
                        program = np.int64(work[np.uint64(slot + 1)])
                new_low, new_high = low, high
                if area <= 0:
                    new_low, new_high = np.inf, -np.inf
                elif program < 0:
                    work[np.uint64(others + 2 * n_others)] = start
                    work[np.uint64(others + 2 * n_others + 1)] = at
                    n_others += 1
                else:
                    new_low, new_high = _by_program(
                        work, floats, centre, program, z_1, z_2, tolerance, low, high
                    )
                if new_low > low:
                    low, low_pair = new_low, ring_pair(home, start, at)
                if new_high < high:
                    high, high_pair = new_high, ring_pair(home, start, at)
                if low > high:
                    break
            place, start, row_1, col_1, z_1 = other, at, row_2, col_2, z_2
            is_known_1 = is_known_2
        if low > high:
            break
    low, high = np.ceil(low), np.floor(high)
    floats[LOW], floats[HIGH] = low, high
    if low <= high or are_unmoved_known:
        test = NO_TEST
    write_refusal(work, plane, pitch, home, height, test, low_pair, high_pair)
    return n_others, low_pair, high_pair


@kernel_part
def _by_program(work, floats, centre, program, z_1, z_2, tolerance, low, high):
    """Narrow an interval by the samples of a triangle that has a program."""
    first = program >> _COUNT_BITS
    for k in range(first, first + (program & _MAX_ENTRIES)):
        offset = np.int64(work[np.uint64(OFFSETS + k)])
        ratio = floats[np.uint64(RATIOS + 3 * k)]
        middle = float(work[np.uint64(centre + offset)]) * ratio
        middle -= floats[np.uint64(RATIOS + 3 * k + 1)] * z_1
        middle -= floats[np.uint64(RATIOS + 3 * k + 2)] * z_2
        slack = tolerance * ratio + _MARGIN
        least, most = middle - slack, middle + slack
        low = least if least > low else low
        high = most if most < high else high
    return low, high


@inlined_kernel
def _side_of(side, at, pitch, width, height):
    """Return stride and length of a side of the ring, and the position before its first one.

    To the right, down, to the left, up; past the corner that is left out.
    """
    if side == 0:
        return 1, width, at
    if side == 1:
        return pitch, height + 1, at + 1
    if side == 2:
        return -1, width, at
    return -pitch, height + 1, at - 1


@kernel
def fit_rest(
    work, floats, plane, pitch, has_table, cell, are_unmoved_known, tolerance, test, listed
):
    """Narrow an interval by the triangles that `fit_star` has `listed`; write their programs."""
    n_others, low_pair, high_pair = listed
    top, bottom, left, right = cell
    row_0, col_0 = top + bottom, left + right
    vertices, others = PLANES + VERTEX * plane, PLANES + OTHERS * plane
    home = top * pitch + left
    place_0 = _IS_KEY | (row_0 & 1) << 1 | (col_0 & 1)
    low, high = floats[LOW], floats[HIGH]
    for k in range(n_others):
        start = np.int64(work[np.uint64(others + 2 * k)])
        at = np.int64(work[np.uint64(others + 2 * k + 1)])
        place_1 = np.int64(work[np.uint64(vertices + 2 * start)])
        place_2 = np.int64(work[np.uint64(vertices + 2 * at)])
        row_1, col_1 = place_1 >> ROW_BITS, place_1 & COL_MASK
        row_2, col_2 = place_2 >> ROW_BITS, place_2 & COL_MASK
        key = _key_of(row_1 - row_0, col_1 - col_0, row_2 - row_0, col_2 - col_0, place_0)
        if has_table and key:
            slot = _slot_of(key)
            if work[np.uint64(slot)] == 0:
                _write_program(
                    work, floats, pitch, slot, key, (row_0, col_0), (row_1, col_1), (row_2, col_2)
                )
        new_low, new_high = fit_triangle(
            work, PLANES + HEIGHT * plane, pitch, (row_0, col_0),
            (row_1, col_1, float(work[np.uint64(vertices + 2 * start + 1)])),
            (row_2, col_2, float(work[np.uint64(vertices + 2 * at + 1)])),
            tolerance, low, high,
        )  # fmt: skip
        if new_low > low:
            low, low_pair = new_low, ring_pair(home, start, at)
        if new_high < high:
            high, high_pair = new_high, ring_pair(home, start, at)
        if low > high:
            break
    low, high = np.ceil(low), np.floor(high)
    floats[LOW], floats[HIGH] = low, high
    if low <= high or are_unmoved_known:
        test = NO_TEST
    write_refusal(work, plane, pitch, home, bottom - top + 1, test, low_pair, high_pair)


@inlined_kernel
def _key_of(down_1, right_1, down_2, right_2, place_0):
    """Return the key of a triangle, 0 if it is too large to have one."""
    down_1, right_1, down_2, right_2 = (
        down_1 + _REACH, right_1 + _REACH, down_2 + _REACH, right_2 + _REACH
    )  # fmt: skip
    key = np.int64(0)
    if (down_1 | right_1 | down_2 | right_2) >> _REACH_BITS == 0:
        key = (down_1 << _REACH_BITS | right_1) << 2 * _REACH_BITS
        key = (key | down_2 << _REACH_BITS | right_2) << 2 | place_0
    return key


@inlined_kernel
def _slot_of(key):
    """Return the start of a key's slot."""
    return TABLE + 2 * (((key * _HASH) & 0xFFFFFFFF) >> (32 - N_SLOTS_LOG2))


@kernel
def _write_program(work, floats, pitch, slot, key, place, second, third):
    """Write the entries of a triangle into the table: a sample and three ratios of weights each.

    Samples on the edge to the triangle's last vertex are left to the next triangle of the star.
    """
    row_0, col_0 = place
    row_1, col_1 = second
    row_2, col_2 = third
    area = (col_1 - col_0) * (row_2 - row_0) - (col_2 - col_0) * (row_1 - row_0)
    first = np.int64(work[N_USED])
    count = 0
    for row in range((min(row_0, row_1, row_2) + 1) >> 1, (max(row_0, row_1, row_2) >> 1) + 1):
        for col in range((min(col_0, col_1, col_2) + 1) >> 1, (max(col_0, col_1, col_2) >> 1) + 1):
            weight_0 = (col_1 - 2 * col) * (row_2 - 2 * row) - (col_2 - 2 * col) * (row_1 - 2 * row)
            weight_1 = (col_2 - 2 * col) * (row_0 - 2 * row) - (col_0 - 2 * col) * (row_2 - 2 * row)
            weight_2 = area - weight_0 - weight_1
            if weight_0 <= 0 or weight_1 < 0 or weight_2 < 0 or (weight_1 == 0 and weight_2 > 0):
                continue
            entry = first + count
            if count == _MAX_ENTRIES or entry == N_ENTRIES:
                work[slot], work[slot + 1] = key, _NO_PROGRAM
                return
            work[OFFSETS + entry] = (row - (row_0 >> 1)) * pitch + col - (col_0 >> 1)
            floats[RATIOS + 3 * entry] = float(area) / float(weight_0)
            floats[RATIOS + 3 * entry + 1] = float(weight_1) / float(weight_0)
            floats[RATIOS + 3 * entry + 2] = float(weight_2) / float(weight_0)
            count += 1
    work[slot], work[slot + 1] = key, first << _COUNT_BITS | count
    work[N_USED] = first + count
