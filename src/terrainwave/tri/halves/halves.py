"""Default mesh: cells merged in halves, centred vertices, fitted heights.

After Yusov & Turlapov 2010 §2.5, with three changes: cells merge in halves (an alternating binary
tree) as well as in fours, the vertex of a cell lies at its centre, and its height is the middle of
the interval that keeps every sample of its star within the tolerance. It depends only on decoded
heights and the tolerance, so it costs no bits.

Everything is exact: heights are integers, and where float64 holds quotients of them, comments say
why they round to the right integer; so every machine finds the same mesh. The mesh starts as the
full grid with merged borders and stays a height field that covers the samples once, as no step may
make a triangle of area <= 0.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import inlined_kernel, kernel, kernel_part
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh, no_mesh
from terrainwave.tri.halves.certificates import refusal_stands, test_of
from terrainwave.tri.halves.height_fit import fixed_point
from terrainwave.tri.halves.star import MAX_PROGRAM_HEIGHT, fit_rest, fit_star
from terrainwave.tri.halves.workspace import (
    FREE,
    HEIGHT,
    HIGH,
    LEVEL,
    LOW,
    MEMORY,
    PLANES,
    ROW_BITS,
    SWEEP,
    VERTEX,
    WIDE,
    fill_workspace,
    finished_mesh,
)

# More than any interval of heights: no condition.
_FAR = np.int64(1) << 40
_PASSES = 2
# Levels of the cells that are tried whole, before halves: 8 x 8, 4 x 4 and 2 x 2 samples.
_WHOLE_LEVELS = (6, 4, 2)
_MAX_INT32 = float((1 << 31) - 1)


class Lines(NamedTuple):
    """Vertices of the four border lines, each from left to right or downwards."""

    top: NDArray[np.bool_]
    bottom: NDArray[np.bool_]
    left: NDArray[np.bool_]
    right: NDArray[np.bool_]


def triangulate(
    heights: NDArray[np.int32],
    mask: NDArray[np.bool_],
    locked: NDArray[np.bool_],
    lines: Lines,
    tolerance: int,
    offset: tuple[int, int] = (0, 0),
    leash: int | None = None,
) -> BlockMesh:
    """Return the mesh of a rectangle of samples, in O(n log n) for n samples.

    `heights` are decoded heights in quanta. The mesh covers the grid triangles between three
    samples of `mask`. `locked` samples, from `borders.beside_void`, stay vertices; those on borders
    must be among `lines`, the vertices of the borders. No valid sample inside is further from the
    mesh than `tolerance`, in 1/16 quanta; on border lines the distance is that of the chords
    between the vertices given. `offset` is row and column of the first sample in its block, which
    cells are aligned to. No vertex between samples is further than `leash` from their bilinear
    surface: not for meshes of files, as where the ground bends their vertices lie above ridges and
    below valleys. Each thread keeps some 5 MB for the next mesh.
    """
    n_rows, n_cols = heights.shape
    if n_rows < 2 or n_cols < 2:
        return no_mesh()
    n_valid, least, most = _valid_range(heights, mask)
    if not n_valid:
        return no_mesh()
    scale = fixed_point(least, most, tolerance)
    space = MEMORY.workspace(n_rows, n_cols)
    fill_workspace(
        heights, mask, locked, np.concatenate(lines), scale.base, scale.bits,
        space.work, space.plane, space.pitch,
    )  # fmt: skip
    has_table = max(-scale.lowest, scale.highest, scale.tolerance) <= MAX_PROGRAM_HEIGHT
    shift = FRACTION_BITS - scale.bits
    if n_rows > 2 and n_cols > 2:  # otherwise only border lines
        most = math.inf if leash is None else float(leash >> shift)
        _merge_cells(
            space.work, space.floats, space.plane, space.pitch, (n_rows, n_cols), offset, has_table,
            scale.tolerance, (scale.lowest, scale.highest, most),
        )  # fmt: skip
    base = scale.base << FRACTION_BITS
    has_voids = n_valid < n_rows * n_cols
    return finished_mesh(space, (n_rows, n_cols), base, shift, has_voids=has_voids)


@kernel
def _valid_range(heights, mask):
    """Return the number of valid samples, the lowest and the highest."""
    count = 0
    lowest, highest = np.int32((1 << 31) - 1), np.int32(-(1 << 31))
    for row in range(heights.shape[0]):
        for col in range(heights.shape[1]):
            if mask[row, col]:
                count += 1
                lowest = min(lowest, heights[row, col])
                highest = max(highest, heights[row, col])
    return count, np.int64(lowest), np.int64(highest)


@inlined_kernel
def _ceil_half(value):
    return -(-value >> 1)


@inlined_kernel
def _wide(work, at):
    return np.int64(work[np.uint64(at)])


@inlined_kernel
def _fit_pair(work, plane, pitch, at, tolerance):
    """Return (verdict, low, high) for merging the samples `at` and `at` + 1.

    Each of the two lies on the edge from the new vertex, between them, to the sample beyond it, if
    that has not moved: 2/3 of the new height and 1/3 of that sample's. Verdict 1: these are all
    conditions; -1: they can't be met; 0: the whole star must be tested, which gives the same
    intervals.
    """
    own, level = PLANES + HEIGHT * plane + at, PLANES + LEVEL * plane + at
    above, below = level - pitch, level + pitch
    left, right = _wide(work, level - 1), _wide(work, level + 2)
    first = 3 * _wide(work, own) - _wide(work, own - 1)
    second = 3 * _wide(work, own + 1) - _wide(work, own + 2)
    slack_1 = 3 * tolerance if left <= FREE else _FAR
    slack_2 = 3 * tolerance if right <= FREE else _FAR
    low = max(first - slack_1, second - slack_2)
    high = min(first + slack_1, second + slack_2)
    low, high = _ceil_half(low), high >> 1
    most = max(left, right)
    most = max(most, _wide(work, above - 1), _wide(work, above), _wide(work, above + 1))
    most = max(most, _wide(work, below), _wide(work, below + 1), _wide(work, below + 2))
    verdict = 1 if most <= FREE else 0
    return verdict if low <= high else -1, low, high


@inlined_kernel
def _fit_quad(work, plane, pitch, at, tolerance):
    """Return (verdict, low, high) for merging the 2 x 2 samples from `at` on; see `_fit_pair`.

    The upper left and lower right sample lie on edges to the samples beyond them; the other two in
    triangles, with weight 1/2 of the new height and 1/4 of each of two samples.
    """
    own, level = PLANES + HEIGHT * plane + at, PLANES + LEVEL * plane + at
    own_2, level_2 = own + pitch, level + pitch
    above, below = level - pitch, level_2 + pitch
    upper_left, lower_right = _wide(work, above - 1), _wide(work, below + 2)
    upper_right = max(_wide(work, above + 1), _wide(work, level + 2))
    lower_left = max(_wide(work, level_2 - 1), _wide(work, below))
    twice = 3 * _wide(work, own) - _wide(work, own - pitch - 1)
    slack = 3 * tolerance if upper_left <= FREE else _FAR
    low, high = twice - slack, twice + slack
    twice = 3 * _wide(work, own_2 + 1) - _wide(work, own_2 + pitch + 2)
    slack = 3 * tolerance if lower_right <= FREE else _FAR
    low, high = max(low, twice - slack), min(high, twice + slack)
    twice = 4 * _wide(work, own + 1) - _wide(work, own - pitch + 1) - _wide(work, own + 2)
    slack = 4 * tolerance if upper_right <= FREE else _FAR
    low, high = max(low, twice - slack), min(high, twice + slack)
    twice = 4 * _wide(work, own_2) - _wide(work, own_2 - 1) - _wide(work, own_2 + pitch)
    slack = 4 * tolerance if lower_left <= FREE else _FAR
    low, high = max(low, twice - slack), min(high, twice + slack)
    low, high = _ceil_half(low), high >> 1
    most = max(upper_left, lower_right, upper_right, lower_left)
    most = max(most, _wide(work, above), _wide(work, level - 1))
    most = max(most, _wide(work, level_2 + 2), _wide(work, below + 1))
    verdict = 1 if most <= FREE else 0
    return verdict if low <= high else -1, low, high


@inlined_kernel
def _bilinear(work, plane, pitch, cell):
    """Return the height of the bilinear surface of the samples at the middle of a cell."""
    top, bottom, left, right = cell
    upper = PLANES + HEIGHT * plane + ((top + bottom) >> 1) * pitch
    lower = PLANES + HEIGHT * plane + ((top + bottom + 1) >> 1) * pitch
    col, beside = (left + right) >> 1, (left + right + 1) >> 1
    total = _wide(work, upper + col) + _wide(work, upper + beside)
    return float(total + _wide(work, lower + col) + _wide(work, lower + beside)) * 0.25


@inlined_kernel
def _is_near_plane(work, plane, pitch, cell, tolerance):
    """Return whether a cell's corners and middle are as near to a plane as its samples must be.

    Most cells of more than 2 x 2 samples that don't fit fail here.
    """
    top, bottom, left, right = cell
    heights = PLANES + HEIGHT * plane
    a, b = _wide(work, heights + top * pitch + left), _wide(work, heights + top * pitch + right)
    d = _wide(work, heights + bottom * pitch + left)
    c = _wide(work, heights + bottom * pitch + right)
    middle = _wide(work, heights + ((top + bottom) >> 1) * pitch + ((left + right) >> 1))
    bend = abs(4 * middle - a - b - c - d)
    return abs(a + c - b - d) <= 4 * tolerance and bend <= 8 * tolerance


@inlined_kernel
def _is_free(work, plane, pitch, cell):
    """Return whether no sample of a cell has merged or must stay."""
    top, bottom, left, right = cell
    levels = PLANES + LEVEL * plane
    taken = np.int32(0)
    for row in range(top, bottom + 1):
        for at in range(row * pitch + left, row * pitch + right + 1):
            taken |= work[np.uint64(levels + at)]
    return taken == FREE


@inlined_kernel
def _is_free_quad(work, plane, pitch, at):
    """Do as `_is_free` for 2 x 2 samples."""
    upper, lower = PLANES + LEVEL * plane + at, PLANES + LEVEL * plane + at + pitch
    taken = work[np.uint64(upper)] | work[np.uint64(upper + 1)]
    return taken | work[np.uint64(lower)] | work[np.uint64(lower + 1)] == FREE


@inlined_kernel
def _is_as_before(work, plane, pitch, cell, before):
    """Return whether nothing around a cell has merged since sweep `before` tried it.

    In that sweep the cells above and to the left came before it, the others after it.
    """
    top, bottom, left, right = cell
    above = PLANES + SWEEP * plane + (top - 1) * pitch
    below = PLANES + SWEEP * plane + (bottom + 1) * pitch
    last_before = last_after = np.int32(0)
    for col in range(left - 1, right + 2):
        last_before = max(last_before, work[np.uint64(above + col)])
        last_after = max(last_after, work[np.uint64(below + col)])
    for beside in range(above + pitch, below, pitch):
        last_before = max(last_before, work[np.uint64(beside + left - 1)])
        last_after = max(last_after, work[np.uint64(beside + right + 1)])
    return last_before <= before and last_after < before


@kernel_part
def _second_half(level, cell, middle_row, middle_col):
    """Return the first row and column of a cell's second half."""
    if level & 1:
        return cell[0], max(middle_col, cell[2])
    return max(middle_row, cell[0]), cell[2]


@kernel_part
def _mark(work, levels, pitch, cell, other, level, is_whole):
    """Set the level of a merged cell: at all samples, or at the first ones of its halves."""
    top, bottom, left, right = cell
    if is_whole:
        for row in range(top, bottom + 1):
            for col in range(left, right + 1):
                work[np.uint64(levels + row * pitch + col)] = level
    else:
        work[np.uint64(levels + top * pitch + left)] = level
        work[np.uint64(levels + other)] = level


@inlined_kernel
def _move(work, plane, pitch, cell, place, height, sweep):
    """Let the samples of a cell share a vertex.

    Those inside a wide one are not updated: no ring meets them, and `read_mesh` skips them.
    """
    top, bottom, left, right = cell
    vertices, sweeps = PLANES + VERTEX * plane, PLANES + SWEEP * plane
    for row in range(top, bottom + 1):
        skip = right - left if top < row < bottom and right - left >= WIDE else 1
        for at in range(row * pitch + left, row * pitch + right + 1, skip):
            work[np.uint64(vertices + 2 * at)] = place
            work[np.uint64(vertices + 2 * at + 1)] = height
            work[np.uint64(sweeps + at)] = sweep


@kernel
def _merge_cells(work, floats, plane, pitch, shape, offset, has_table, tolerance, limits):
    """Sweep over the cells of all levels: whole squares, then halves in passes, finest first.

    `limits` are the lowest and the highest height of a vertex, and its largest distance from the
    bilinear surface of the samples.
    """
    reach = max(shape[0] + offset[0], shape[1] + offset[1]) - 2
    n_levels = 0
    while reach >> n_levels:
        n_levels += 1
    n_whole = len(_WHOLE_LEVELS)
    found = 1  # a bit for each level that has had cells
    for sweep in range(1, n_whole + _PASSES * 2 * n_levels + 1):
        level, before = _WHOLE_LEVELS[min(sweep, n_whole) - 1], 0
        if sweep > n_whole:
            level = (sweep - n_whole - 1) % (2 * n_levels) + 1
            if not found >> (level - 1) & 1:
                continue  # no halves
            if sweep - 2 * n_levels > n_whole:
                before = sweep - 2 * n_levels
        n_merged = _sweep_cells(
            work, floats, plane, pitch, shape, offset, has_table, (level, sweep, before),
            tolerance, limits,
        )  # fmt: skip
        if n_merged:
            found |= 1 << level


@kernel_part
def _sweep_cells(work, floats, plane, pitch, shape, offset, has_table, number, tolerance, limits):
    """Try to merge every cell of a level of the binary tree, of two halves or of single samples.

    `number` is the level, the sweep, and the last sweep that tried this level: a cell that failed
    there, with nothing changed around it, would fail again. A sample's sweep is the one in which
    its cell last grew. Returns the number of merged cells.
    """
    (n_rows, n_cols), (row_0, col_0), (level, sweep, before) = shape, offset, number
    n_merged = 0
    is_whole = sweep <= len(_WHOLE_LEVELS)
    whole_tolerance = np.int64(tolerance)
    levels, sweeps = PLANES + LEVEL * plane, PLANES + SWEEP * plane
    width, height = 1 << ((level + 1) >> 1), 1 << (level >> 1)
    for cell_row in range((row_0 + 1) // height * height, row_0 + n_rows - 1, height):
        top, bottom = max(cell_row - row_0, 1), min(cell_row + height - 1 - row_0, n_rows - 2)
        for cell_col in range((col_0 + 1) // width * width, col_0 + n_cols - 1, width):
            left = max(cell_col - col_0, 1)
            at = top * pitch + left
            if not is_whole and work[np.uint64(levels + at)] != level - 1:
                continue
            right = min(cell_col + width - 1 - col_0, n_cols - 2)
            cell = top, bottom, left, right
            other = at
            is_quad = is_whole and level == 2 and bottom > top and right > left
            if is_quad:
                if not _is_free_quad(work, plane, pitch, at):
                    continue
            elif is_whole:
                if level > 2 and not _is_near_plane(work, plane, pitch, cell, whole_tolerance):
                    continue
                if not _is_free(work, plane, pitch, cell):
                    continue
            else:
                row_2, col_2 = _second_half(
                    level, cell, cell_row + (height >> 1) - row_0, cell_col + (width >> 1) - col_0
                )
                other = row_2 * pitch + col_2
                if row_2 > bottom or col_2 > right or other == at:
                    # One half lies outside: the other is the whole.
                    work[np.uint64(levels + at)] = level
                    n_merged += 1
                    continue
                if work[np.uint64(levels + other)] != level - 1:
                    continue
                if level > 1 and refusal_stands(work, plane, pitch, at, bottom - top + 1, level):
                    continue
                if (
                    work[np.uint64(sweeps + at)] < before
                    and work[np.uint64(sweeps + other)] < before
                    and _is_as_before(work, plane, pitch, cell, before)
                ):
                    continue
            verdict, low, high = 0, limits[0], limits[1]
            if limits[2] < np.inf:
                middle = _bilinear(work, plane, pitch, cell)
                low = max(low, np.ceil(middle - limits[2]))
                high = min(high, np.floor(middle + limits[2]))
                if low > high:
                    continue
            if level == 1:
                verdict, first, last = _fit_pair(work, plane, pitch, at, whole_tolerance)
                low, high = max(low, float(first)), min(high, float(last))
            elif is_quad:
                verdict, first, last = _fit_quad(work, plane, pitch, at, whole_tolerance)
                low, high = max(low, float(first)), min(high, float(last))
            if verdict < 0:
                continue
            if verdict == 0:
                floats[LOW], floats[HIGH] = low, high
                test = test_of(level, sweep)
                is_known = level == 1 or is_quad
                listed = fit_star(
                    work, floats, plane, pitch, has_table, cell, is_known, tolerance, test
                )
                if listed[0] and floats[LOW] <= floats[HIGH]:
                    fit_rest(
                        work, floats, plane, pitch, has_table, cell, is_known, tolerance, test,
                        listed,
                    )  # fmt: skip
                low, high = floats[LOW], floats[HIGH]
            if low > high:
                continue
            vertex = np.floor((low + high) * 0.5)
            if vertex > _MAX_INT32:
                continue  # for a range of 2^31 quanta, and a tolerance of half of it
            n_merged += 1
            _mark(work, levels, pitch, cell, other, level, is_whole)
            place = np.int32((top + bottom) << ROW_BITS | left + right)
            _move(work, plane, pitch, cell, place, np.int32(vertex), sweep)
    return n_merged
