"""The default mesh: cells merged in halves, centred vertices, fitted heights (DESIGN §5).

After Yusov & Turlapov 2010 §2.5, with three changes: cells merge in halves (an alternating binary
tree) as well as in fours, the vertex of a cell lies at its centre, and its height is the middle of
the interval that keeps every sample of its star within the tolerance. Derived from decoded heights
and the tolerance alone, so it costs no bits.

Everything is exact: heights are integers held in float64 (|products| < 2^53), so that every
machine finds the same mesh. The mesh starts as the full grid with merged borders and stays a height
field that covers the samples once, as no step may make a triangle of area <= 0.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.tri.fit import fit_triangle, scaled_heights
from terrainwave.tri.mesh import BlockMesh

# Levels of merged cells: single samples, samples that stay as they are, those of border lines that
# are no vertices. Up to _FREE a sample has not moved.
_FREE, _LOCKED, _MERGED = 0, -1, 127
_VOID = -1
_FAR = np.int64(1) << 32
_PASSES = 2
# Sides of the cells that are tried whole, before halves.
_SQUARES = (8, 4, 2)


class Lines(NamedTuple):
    """Which samples of the four border lines are vertices, each from left to right or downwards."""

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
) -> BlockMesh:
    """Return the mesh of a rectangle of samples.

    Parameters
    ----------
    heights : ndarray of int32, shape (n_rows, n_cols)
        Decoded heights in quanta.
    mask : ndarray of bool, shape (n_rows, n_cols)
        Valid samples; the mesh covers the grid triangles between three of them.
    locked : ndarray of bool, shape (n_rows, n_cols)
        Samples that stay vertices: those of `borders.beside_void`.
    lines : Lines
        Vertices of the borders; those of `locked` must be among them.
    tolerance : int
        In 1/16 quanta: no valid sample inside is further from the mesh. On border lines the
        distance is that of the chords between the vertices given.
    offset : tuple of int
        Row and column of the first sample in its block, which cells are aligned to.

    Notes
    -----
    O(n log n) for n samples; about 100 ns per sample.
    """
    n_rows, n_cols = heights.shape
    if n_rows < 2 or n_cols < 2 or not mask.any():
        return _empty()
    scaled, scale = scaled_heights(heights, mask, tolerance)
    root = np.arange(n_rows * n_cols, dtype=np.int32).reshape(heights.shape)
    root[~mask] = _VOID
    levels = np.where(locked, _LOCKED, _FREE).astype(np.int8)
    levels[[0, -1]] = levels[:, [0, -1]] = _LOCKED
    _merge_border(root, levels, lines.top, lines.bottom, lines.left, lines.right)
    rows, cols = _double_places(n_rows, n_cols)
    z = scaled.ravel().astype(np.float64)
    _merge_cells(
        scaled, root, levels, rows, cols, z, offset[0], offset[1], scale.tolerance,
        scale.lowest, scale.highest,
    )  # fmt: skip
    triangles = np.empty((_count_triangles(root), 3), dtype=np.int32)
    _fill_triangles(root, triangles)
    used, triangles = _used_vertices(triangles, n_rows * n_cols)
    places = rows[used].astype(np.int32), cols[used].astype(np.int32)
    return BlockMesh(*places, scale.to_mesh(z[used]), triangles)


def _empty() -> BlockMesh:
    none = np.empty(0, dtype=np.int32)
    return BlockMesh(none, none, none.astype(np.int64), none.reshape(0, 3))


def _double_places(n_rows: int, n_cols: int) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    rows = np.repeat(2 * np.arange(n_rows, dtype=np.int16), n_cols)
    return rows, np.tile(2 * np.arange(n_cols, dtype=np.int16), n_rows)


@kernel
def _merge_border(root, levels, top, bottom, left, right):
    """Let the samples of border lines that are no vertices share the vertex before them."""
    n_rows, n_cols = root.shape
    for row, line in ((0, top), (n_rows - 1, bottom)):
        last = root[row, 0]
        for col in range(n_cols):
            if line[col]:
                last = root[row, col]
            else:
                root[row, col] = last
                levels[row, col] = _MERGED
    for col, line in ((0, left), (n_cols - 1, right)):
        last = root[0, col]
        for row in range(n_rows):
            if line[row]:
                last = root[row, col]
            else:
                root[row, col] = last
                levels[row, col] = _MERGED


@kernel
def _ceil_half(value):
    return -(-value >> 1)


@kernel
def _fit_pair(heights, levels, n_cols, at, tolerance):
    """Return (verdict, low, high) for merging the samples `at` and `at` + 1 of flat arrays.

    Each of the two lies on the edge from the new vertex, between them, to the sample beyond it, if
    that has not moved: 2/3 of the new height and 1/3 of that sample's. Verdict 1: these are all
    conditions; -1: they can't be met; 0: look at the whole star, which gives the same intervals.
    """
    slack = 3 * tolerance
    low, high = -_FAR, _FAR
    verdict = 1
    if levels[at - 1] <= _FREE:
        first = 3 * np.int64(heights[at]) - heights[at - 1]
        low, high = _ceil_half(first - slack), (first + slack) >> 1
    else:
        verdict = 0
    if levels[at + 2] <= _FREE:
        second = 3 * np.int64(heights[at + 1]) - heights[at + 2]
        low = max(low, _ceil_half(second - slack))
        high = min(high, (second + slack) >> 1)
    else:
        verdict = 0
    if low > high:
        return -1, low, high
    for k in range(3):
        if not (levels[at - n_cols - 1 + k] <= _FREE and levels[at + n_cols + k] <= _FREE):
            verdict = 0
    return verdict, low, high


@kernel
def _fit_quad(heights, levels, n_cols, at, tolerance):
    """Return (verdict, low, high) for merging the 2 x 2 samples from `at` on; see `_fit_pair`.

    The upper left and lower right sample lie on edges to the samples beyond them; the other two in
    triangles, with weight 1/2 of the new height and 1/4 of each of two samples.
    """
    low, high = -2 * _FAR, 2 * _FAR
    verdict = 1
    if levels[at - n_cols - 1] <= _FREE:
        twice = 3 * np.int64(heights[at]) - heights[at - n_cols - 1]
        low, high = twice - 3 * tolerance, twice + 3 * tolerance
    else:
        verdict = 0
    if levels[at + 2 * n_cols + 2] <= _FREE:
        twice = 3 * np.int64(heights[at + n_cols + 1]) - heights[at + 2 * n_cols + 2]
        low, high = max(low, twice - 3 * tolerance), min(high, twice + 3 * tolerance)
    else:
        verdict = 0
    if levels[at - n_cols + 1] <= _FREE and levels[at + 2] <= _FREE:
        twice = 4 * np.int64(heights[at + 1]) - heights[at - n_cols + 1]
        twice -= heights[at + 2]
        low, high = max(low, twice - 4 * tolerance), min(high, twice + 4 * tolerance)
    else:
        verdict = 0
    if levels[at + n_cols - 1] <= _FREE and levels[at + 2 * n_cols] <= _FREE:
        twice = 4 * np.int64(heights[at + n_cols]) - heights[at + n_cols - 1]
        twice -= heights[at + 2 * n_cols]
        low, high = max(low, twice - 4 * tolerance), min(high, twice + 4 * tolerance)
    else:
        verdict = 0
    low, high = _ceil_half(low), high >> 1
    if low > high:
        return -1, low, high
    if not (
        levels[at - n_cols] <= _FREE
        and levels[at - 1] <= _FREE
        and levels[at + n_cols + 2] <= _FREE
        and levels[at + 2 * n_cols + 1] <= _FREE
    ):
        verdict = 0
    return verdict, low, high


@kernel
def _fit_cell(
    heights, root, levels, rows, cols, z, me, top, bottom, left, right, are_single_known,
    tolerance, low, high,
):  # fmt: skip
    """Return the interval of heights of vertex `me` whose cluster is this rectangle of samples.

    All triangles that touch it are those of the quads around the rectangle. Empty, (1, 0), if one
    of them has no area. Quads of four samples that have not moved are left out where low and high
    are what they allow: `are_single_known`.
    """
    row_0, col_0 = np.int64(rows[me]), np.int64(cols[me])
    for row in range(top - 1, bottom + 1):
        stride = right - left + 1 if top <= row < bottom else 1
        for col in range(left - 1, right + 1, stride):
            a, b = root[row, col], root[row, col + 1]
            d, c = root[row + 1, col], root[row + 1, col + 1]
            if are_single_known and (
                levels[row, col] <= _FREE
                and levels[row, col + 1] <= _FREE
                and levels[row + 1, col] <= _FREE
                and levels[row + 1, col + 1] <= _FREE
            ):
                continue
            for half in range(2):
                # Of triangle a, b, c or a, c, d: the two vertices after `me`.
                if half == 0:
                    if a == b or b == c:
                        continue
                    p_1 = b if a == me else (c if b == me else a)
                    p_2 = c if a == me else (a if b == me else b)
                    if a != me and b != me and c != me:
                        continue
                else:
                    if c == d or d == a:
                        continue
                    p_1 = c if a == me else (d if c == me else a)
                    p_2 = d if a == me else (a if c == me else c)
                    if a != me and c != me and d != me:
                        continue
                if a == c or a < 0 or c < 0 or p_1 < 0 or p_2 < 0:
                    continue
                row_1, col_1 = np.int64(rows[p_1]), np.int64(cols[p_1])
                row_2, col_2 = np.int64(rows[p_2]), np.int64(cols[p_2])
                if (col_1 - col_0) * (row_2 - row_0) - (col_2 - col_0) * (row_1 - row_0) <= 0:
                    return 1.0, 0.0
                low, high = fit_triangle(
                    heights, row_0, col_0, row_1, col_1, z[p_1], row_2, col_2, z[p_2], tolerance,
                    low, high,
                )  # fmt: skip
                if low > high:
                    return low, high
    return low, high


@kernel
def _set_root(root, top, bottom, left, right, value):
    for row in range(top, bottom + 1):
        for col in range(left, right + 1):
            root[row, col] = value


@kernel
def _merge_squares(
    heights, root, levels, rows, cols, z, row_0, col_0, side, tolerance, lowest, highest
):
    """Try whole cells of `side` x `side` single samples, before they are tried in halves."""
    n_rows, n_cols = heights.shape
    whole_tolerance = np.int64(tolerance)
    flat_heights, flat_levels = heights.reshape(-1), levels.reshape(-1)
    level = 0
    while side >> level > 1:
        level += 1
    level *= 2
    for cell_row in range((row_0 + 1) // side * side, row_0 + n_rows - 1, side):
        top, bottom = max(cell_row - row_0, 1), min(cell_row + side - 1 - row_0, n_rows - 2)
        for cell_col in range((col_0 + 1) // side * side, col_0 + n_cols - 1, side):
            left, right = max(cell_col - col_0, 1), min(cell_col + side - 1 - col_0, n_cols - 2)
            is_free = True
            for row in range(top, bottom + 1):
                for col in range(left, right + 1):
                    is_free &= levels[row, col] == _FREE
            if not is_free:
                continue
            verdict, low, high, are_known = 0, lowest, highest, False
            if side > 2:
                # The middle against the corners: most cells that don't fit fail here.
                a, b = np.int64(heights[top, left]), np.int64(heights[top, right])
                d, c = np.int64(heights[bottom, left]), np.int64(heights[bottom, right])
                middle = 4 * np.int64(heights[(top + bottom) >> 1, (left + right) >> 1])
                if (
                    abs(a + c - b - d) > 4 * whole_tolerance
                    or abs(middle - a - b - c - d) > 8 * whole_tolerance
                ):
                    continue
            elif bottom > top and right > left:
                verdict, first, last = _fit_quad(
                    flat_heights, flat_levels, n_cols, top * n_cols + left, whole_tolerance
                )
                if verdict < 0:
                    continue
                low, high, are_known = max(low, float(first)), min(high, float(last)), True
            me = root[top, left]
            _set_root(root, top, bottom, left, right, me)
            rows[me], cols[me] = top + bottom, left + right
            if verdict == 0:
                low, high = _fit_cell(
                    heights, root, levels, rows, cols, z, me, top, bottom, left, right, are_known,
                    tolerance, low, high,
                )  # fmt: skip
            if low <= high:
                z[me] = np.floor((low + high) * 0.5)
                for row in range(top, bottom + 1):
                    for col in range(left, right + 1):
                        levels[row, col] = level
            else:
                rows[me], cols[me] = 2 * top, 2 * left
                for row in range(top, bottom + 1):
                    for col in range(left, right + 1):
                        root[row, col] = row * n_cols + col


@kernel
def _is_as_before(merged, top, bottom, left, right, before):
    """Say whether nothing around a cell has merged since sweep `before` tried it.

    In that sweep the cells above and to the left came before it, the others after it.
    """
    for col in range(left - 1, right + 2):
        if merged[top - 1, col] > before or merged[bottom + 1, col] >= before:
            return False
    for row in range(top, bottom + 1):
        if merged[row, left - 1] > before or merged[row, right + 1] >= before:
            return False
    return True


@kernel
def _merge_halves(
    heights, root, levels, merged, rows, cols, z, row_0, col_0, level, sweep, before, tolerance,
    lowest, highest,
):  # fmt: skip
    """Try to merge the two halves of every cell of a level of the binary tree.

    `merged` is the sweep in which a sample's cell last grew; `before`, the sweep that tried this
    level last: a cell that failed there, and has all around it as it was, would fail again.
    """
    n_rows, n_cols = heights.shape
    whole_tolerance = np.int64(tolerance)
    flat_heights, flat_levels = heights.reshape(-1), levels.reshape(-1)
    width, height = 1 << ((level + 1) >> 1), 1 << (level >> 1)
    is_odd = level & 1
    for cell_row in range((row_0 + 1) // height * height, row_0 + n_rows - 1, height):
        top, bottom = max(cell_row - row_0, 1), min(cell_row + height - 1 - row_0, n_rows - 2)
        for cell_col in range((col_0 + 1) // width * width, col_0 + n_cols - 1, width):
            left = max(cell_col - col_0, 1)
            if levels[top, left] != level - 1:
                continue
            right = min(cell_col + width - 1 - col_0, n_cols - 2)
            row_2, col_2 = top, left
            if is_odd:
                col_2 = max(cell_col + (width >> 1) - col_0, left)
            else:
                row_2 = max(cell_row + (height >> 1) - row_0, top)
            if row_2 > bottom or col_2 > right or (row_2, col_2) == (top, left):
                levels[top, left] = level  # one half lies outside: the other is the whole
                continue
            if levels[row_2, col_2] != level - 1:
                continue
            if (
                merged[top, left] < before
                and merged[row_2, col_2] < before
                and _is_as_before(merged, top, bottom, left, right, before)
            ):
                continue
            verdict, low, high, are_known = 0, lowest, highest, level == 1
            if level == 1:
                verdict, first, last = _fit_pair(
                    flat_heights, flat_levels, n_cols, top * n_cols + left, whole_tolerance
                )
                if verdict < 0:
                    continue
                low, high = max(low, float(first)), min(high, float(last))
            me, other = root[top, left], root[row_2, col_2]
            old_row, old_col = rows[me], cols[me]
            _set_root(root, row_2, bottom, col_2, right, me)
            rows[me], cols[me] = top + bottom, left + right
            if verdict == 0:
                low, high = _fit_cell(
                    heights, root, levels, rows, cols, z, me, top, bottom, left, right, are_known,
                    tolerance, low, high,
                )  # fmt: skip
            if low <= high:
                z[me] = np.floor((low + high) * 0.5)
                levels[top, left] = level
                levels[row_2, col_2] = level
                merged[top : bottom + 1, left : right + 1] = sweep
            else:
                rows[me], cols[me] = old_row, old_col
                _set_root(root, row_2, bottom, col_2, right, other)


@kernel
def _merge_cells(heights, root, levels, rows, cols, z, row_0, col_0, tolerance, lowest, highest):
    """Merge samples into cells: whole squares first, then halves from the finest up."""
    n_rows, n_cols = heights.shape
    if n_rows < 3 or n_cols < 3:
        return  # border lines alone
    for side in _SQUARES:
        _merge_squares(
            heights, root, levels, rows, cols, z, row_0, col_0, side, tolerance, lowest, highest
        )
    n_levels = 0
    while (1 << n_levels) < max(n_rows + row_0, n_cols + col_0) - 1:
        n_levels += 1
    merged = np.zeros(root.shape, dtype=np.uint8)
    sweep = 0
    for number in range(_PASSES):
        for level in range(1, 2 * n_levels + 1):
            sweep += 1
            before = sweep - 2 * n_levels if number else 0
            _merge_halves(
                heights, root, levels, merged, rows, cols, z, row_0, col_0, level, sweep, before,
                tolerance, lowest, highest,
            )  # fmt: skip


@kernel
def _triangles_of(a, b, c, d):
    """Return the vertices of the up to two triangles of a quad, -1 where there is none."""
    n_voids = (1 if a < 0 else 0) + (1 if b < 0 else 0) + (1 if c < 0 else 0) + (1 if d < 0 else 0)
    if n_voids > 1:
        return -1, -1, -1, -1, -1, -1
    if a < 0:
        return b, c, d, -1, -1, -1
    if b < 0:
        return a, c, d, -1, -1, -1
    if c < 0:
        return a, b, d, -1, -1, -1
    if d < 0:
        return a, b, c, -1, -1, -1
    return a, b, c, a, c, d


@kernel
def _count_triangles(root):
    count = 0
    for row in range(root.shape[0] - 1):
        for col in range(root.shape[1] - 1):
            a, b, c, d, e, f = _triangles_of(
                root[row, col], root[row, col + 1], root[row + 1, col + 1], root[row + 1, col]
            )
            count += 1 if a >= 0 and a != b and b != c and a != c else 0
            count += 1 if d >= 0 and d != e and e != f and d != f else 0
    return count


@kernel
def _fill_triangles(root, triangles):
    count = 0
    for row in range(root.shape[0] - 1):
        for col in range(root.shape[1] - 1):
            a, b, c, d, e, f = _triangles_of(
                root[row, col], root[row, col + 1], root[row + 1, col + 1], root[row + 1, col]
            )
            if a >= 0 and a != b and b != c and a != c:
                triangles[count, 0], triangles[count, 1], triangles[count, 2] = a, b, c
                count += 1
            if d >= 0 and d != e and e != f and d != f:
                triangles[count, 0], triangles[count, 1], triangles[count, 2] = d, e, f
                count += 1


def _used_vertices(
    triangles: NDArray[np.int32], n_samples: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return the vertices that triangles use in order, and the triangles by their new numbers."""
    number = np.zeros(n_samples, dtype=np.int32)
    return _number_vertices(triangles, number), triangles


@kernel
def _number_vertices(triangles, number):
    for t in range(triangles.shape[0]):
        for k in range(3):
            number[triangles[t, k]] = 1
    count = 0
    for vertex in range(number.shape[0]):
        if number[vertex]:
            number[vertex] = count
            count += 1
        else:
            number[vertex] = -1
    used = np.empty(count, dtype=np.int64)
    for vertex in range(number.shape[0]):
        if number[vertex] >= 0:
            used[number[vertex]] = vertex
    for t in range(triangles.shape[0]):
        for k in range(3):
            triangles[t, k] = number[triangles[t, k]]
    return used
