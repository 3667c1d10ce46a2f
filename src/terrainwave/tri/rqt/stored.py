"""Restricted quadtree triangulation: nested right triangles, closed under dependencies.

R. Pajarola, "Large scale terrain visualization using the restricted quadtree triangulation", 1998,
as described by Zheng, Wang, Wang ("each vertex depends on two others of its own or the next coarser
level: where it is selected, so must they be"). A vertex is the middle of the longest side of its
adjacent triangles, which it splits; it depends on the vertices that made them. A selection that is
closed under this has a conforming triangulation, without cracks.

Two selections, by

* error: a vertex is selected if one of the triangles it would split has an error, over all
  samples it covers, above the tolerance: unsplit triangles keep the tolerance, guaranteed;
* coefficients of a wavelet above the tolerance: HL and LH are those of vertices in
  the middles of edges, HH of those at centres (Zheng et al.). No bound.

Blocks of any size: triangles live on a virtual grid of 2**n + 1, with the least sufficient n. Its
rows and columns map to those of the samples monotonically, some twice. Degenerate triangles are
dropped; one with three different corners on a line is split. A block of 2**n + 1 samples is its own
virtual grid. Voids as in `zerotree.labels`. All rules have the form "where these vertices are, so
is that", and so has keeping more of them (`zerotree.agreement`): there is a least selection that
obeys them, whatever the order.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh
from terrainwave.tri.quads import Keep, build_mesh, corner_of_quad, triangles_of_quad, void_edges
from terrainwave.tri.triangle import MAX_TOLERANCE, area_of, fits

Selection = NDArray[np.uint8]


def select_vertices(
    # shape (n_rows, n_cols); decoded heights in quanta, within ±2**30; 1 to 4097 samples a side
    heights: NDArray[np.int32],
    mask: NDArray[np.bool_],  # True for valid samples
    tolerance: int,  # in 1/16 quanta; >= 0
    *,
    keep: Keep | None = None,  # samples that must be vertices besides those at voids
    # magnitudes in quanta: vertices are selected by them, and the tolerance is not guaranteed
    coefficients: NDArray[np.int64] | None = None,
) -> Selection:
    """Return the closed selection of a block on its virtual grid; `rqt_mesh` makes the mesh."""
    mask = np.ascontiguousarray(mask)
    rows, cols = virtual_places(heights.shape)
    selection = void_edges(mask)[np.ix_(rows, cols)].astype(np.uint8)
    if keep is not None:
        at_rows, at_cols = np.nonzero(keep)
        selection[_coarsest(rows)[at_rows], _coarsest(cols)[at_cols]] = 1
    if coefficients is not None:
        is_large = coefficients << FRACTION_BITS > tolerance
        selection |= is_large[np.ix_(rows, cols)]
    _select(
        np.ascontiguousarray(heights), mask, min(tolerance, MAX_TOLERANCE), rows, cols,
        coefficients is None, selection,
    )  # fmt: skip
    stack = _new_stack(len(rows))
    while _split_lines(rows, cols, stack, selection):
        pass
    return selection


def _new_stack(n: int) -> NDArray[np.int64]:
    """Return a stack for a depth-first walk over the triangles of a virtual grid of n x n."""
    return np.empty((4 * (n.bit_length() + 2), 6), dtype=np.int64)


def virtual_places(shape: tuple[int, int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the sample row of each virtual row, and the sample column of each virtual column."""
    n_cells = 1 << (max(*shape, 2) - 2).bit_length()
    places = np.arange(n_cells + 1, dtype=np.int64)
    return places * (shape[0] - 1) // n_cells, places * (shape[1] - 1) // n_cells


def _coarsest(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return, for each sample along an axis, its virtual position with the largest stride.

    A sample on a border is a vertex only if that position is selected: the positions of larger
    stride around a selected one on the border are the ends of the edges that it splits. So keeping
    vertices that a selection already has changes nothing.
    """
    coarsest = np.zeros(int(places[-1]) + 1, dtype=np.int64)
    virtual = np.arange(len(places), dtype=np.int64)
    strides = virtual & -virtual
    strides[0] = len(places)
    order = np.argsort(strides, kind="stable")
    coarsest[places[order]] = virtual[order]
    return coarsest


def vertices_of(selection: Selection, shape: tuple[int, int]) -> Keep:
    """Return which samples of a block are vertices; for `agreement.border_of`."""
    rows, cols = virtual_places(shape)
    at_rows, at_cols = np.nonzero(selection)
    is_vertex = np.zeros(shape, dtype=np.bool_)
    is_vertex[rows[at_rows], cols[at_cols]] = True
    return is_vertex


def rqt_mesh(
    heights: NDArray[np.int32], mask: NDArray[np.bool_], selection: Selection
) -> BlockMesh:
    """Return the triangles of a closed selection; vertices in the order of their samples."""
    mask = np.ascontiguousarray(mask)
    rows, cols = virtual_places(heights.shape)
    vertex_of = np.full(heights.shape, -1, dtype=np.int32)
    corners = np.empty((2 * heights.size, 3), dtype=np.int64)
    stack = _new_stack(len(rows))
    count = 0
    if min(heights.shape) > 1:
        count = _emit(mask, rows, cols, selection, stack, vertex_of, corners)
    return build_mesh(heights, vertex_of, corners[:count])


@kernel
def neighbours(row, col, s):
    """Return the ends of the edge that virtual vertex (row, col) of stride `s` splits.

    Then the tops of the two adjacent triangles; it depends on these. Diagonals alternate from cell
    to cell. Strides are powers of two, and bits are faster than divisions.
    """
    if row & s and col & s:
        if ((row - s) ^ (col - s)) & (2 * s) == 0:
            return row - s, col - s, row + s, col + s, row - s, col + s, row + s, col - s
        return row - s, col + s, row + s, col - s, row - s, col - s, row + s, col + s
    if col & s:
        return row, col - s, row, col + s, row - s, col, row + s, col
    return row - s, col, row + s, col, row, col - s, row, col + s


@kernel
def own_neighbours(row, col):
    """Return the `neighbours` of a vertex at the stride of its position; not (0, 0)."""
    both = row | col
    return neighbours(row, col, both & -both)


@kernel
def _select(heights, mask, tolerance, rows, cols, is_bound, selection):
    """Select from the finest vertices upwards; selected vertices select their dependencies."""
    n = rows.shape[0] - 1
    s = 1
    while s < n:
        for centres in range(2):
            for row in range(0, n + 1, s):
                is_odd = (row // s) % 2 == 1
                if centres and not is_odd:
                    continue
                for col in range(s if centres or not is_odd else 0, n + 1, 2 * s):
                    r0, c0, r1, c1, r2, c2, r3, c3 = neighbours(row, col, s)
                    second = 0 <= r2 <= n and 0 <= c2 <= n
                    third = 0 <= r3 <= n and 0 <= c3 <= n
                    if not selection[row, col]:
                        wanted = is_bound and second and _exceeds(
                            heights, mask, tolerance, rows[r0], cols[c0], rows[r1], cols[c1],
                            rows[r2], cols[c2],
                        )  # fmt: skip
                        wanted = wanted or (is_bound and third and _exceeds(
                            heights, mask, tolerance, rows[r0], cols[c0], rows[r1], cols[c1],
                            rows[r3], cols[c3],
                        ))  # fmt: skip
                        if not wanted:
                            continue
                        selection[row, col] = 1
                    if second:
                        selection[r2, c2] = 1
                    if third:
                        selection[r3, c3] = 1
        s *= 2
    selection[0, 0] = selection[0, n] = selection[n, 0] = selection[n, n] = 1


@kernel
def _exceeds(heights, mask, tolerance, r0, c0, r1, c1, r2, c2):
    """Return whether a triangle of samples has an error above the tolerance."""
    # With a void corner it is split by vertices at the void's edge, or is entirely void.
    if not (mask[r0, c0] and mask[r1, c1] and mask[r2, c2]):
        return False
    area = area_of(r0, c0, r1, c1, r2, c2)
    if area == 0:
        return False
    if area < 0:
        return not fits(heights, r0, c0, r2, c2, r1, c1, tolerance)
    return not fits(heights, r0, c0, r1, c1, r2, c2, tolerance)


@kernel
def _start_walk(first, n, stack):
    """Push one half of the root on the stack: ends of its longest side, then the top."""
    stack[0, 0] = stack[0, 1] = 0 if first == 0 else n
    stack[0, 2] = stack[0, 3] = n - stack[0, 0]
    stack[0, 4], stack[0, 5] = (0, n) if first == 0 else (n, 0)


@kernel
def split_top(selection, stack, depth):
    """Replace the triangle at ``stack[depth]`` by its halves if it is split; return whether."""
    r0, c0, r1, c1 = stack[depth, 0], stack[depth, 1], stack[depth, 2], stack[depth, 3]
    if (r0 + r1) & 1 or (c0 + c1) & 1:
        return False
    row, col = (r0 + r1) >> 1, (c0 + c1) >> 1
    if not selection[row, col]:
        return False
    r2, c2 = stack[depth, 4], stack[depth, 5]
    stack[depth, 0], stack[depth, 1] = r2, c2
    stack[depth, 2], stack[depth, 3] = r0, c0
    stack[depth, 4], stack[depth, 5] = row, col
    stack[depth + 1, 0], stack[depth + 1, 1] = r1, c1
    stack[depth + 1, 2], stack[depth + 1, 3] = r2, c2
    stack[depth + 1, 4], stack[depth + 1, 5] = row, col
    return True


@kernel
def _split_lines(rows, cols, stack, selection):
    """Select the middles of triangles with three different corners on a line; count them."""
    n = rows.shape[0] - 1
    count = 0
    for first in range(2):
        _start_walk(first, n, stack)
        depth = 1
        while depth > 0:
            depth -= 1
            if split_top(selection, stack, depth):
                depth += 2
                continue
            r0, c0, r1, c1 = stack[depth, 0], stack[depth, 1], stack[depth, 2], stack[depth, 3]
            y0, x0, y1, x1 = rows[r0], cols[c0], rows[r1], cols[c1]
            y2, x2 = rows[stack[depth, 4]], cols[stack[depth, 5]]
            if area_of(y0, x0, y1, x1, y2, x2) != 0:
                continue
            if (y0 == y1 and x0 == x1) or (y1 == y2 and x1 == x2) or (y0 == y2 and x0 == x2):
                continue
            _select_closed(selection, (r0 + r1) >> 1, (c0 + c1) >> 1, stack, depth)
            count += 1
    return count


@kernel
def _select_closed(selection, row, col, stack, depth):
    """Select a virtual vertex and all it depends on; uses the stack above `depth`."""
    n = selection.shape[0] - 1
    base = depth
    stack[depth, 0], stack[depth, 1] = row, col
    depth += 1
    while depth > base:
        depth -= 1
        row, col = stack[depth, 0], stack[depth, 1]
        if selection[row, col]:
            continue
        selection[row, col] = 1
        _, _, _, _, r2, c2, r3, c3 = own_neighbours(row, col)
        for i, j in ((r2, c2), (r3, c3)):
            if 0 <= i <= n and 0 <= j <= n and not selection[i, j]:
                stack[depth, 0], stack[depth, 1] = i, j
                depth += 1


@kernel
def _is_whole(mask, row, col):
    upper, lower = mask[row, col] and mask[row, col + 1], mask[row + 1, col]
    return upper and lower and mask[row + 1, col + 1]


@kernel
def _emit(mask, rows, cols, selection, stack, vertex_of, corners):
    """Fill `corners` with the triangles and mark their samples; return their number."""
    n = rows.shape[0] - 1
    n_cols = mask.shape[1]
    count = 0
    for first in range(2):
        _start_walk(first, n, stack)
        depth = 1
        while depth > 0:
            depth -= 1
            if split_top(selection, stack, depth):
                depth += 2
                continue
            r0, c0 = rows[stack[depth, 0]], cols[stack[depth, 1]]
            r1, c1 = rows[stack[depth, 2]], cols[stack[depth, 3]]
            r2, c2 = rows[stack[depth, 4]], cols[stack[depth, 5]]
            area = area_of(r0, c0, r1, c1, r2, c2)
            if area == 0 or not (mask[r0, c0] and mask[r1, c1] and mask[r2, c2]):
                continue
            if area == 1 or area == -1:
                # One diagonal of a quad; with a void corner the quad's triangle is added below.
                top, left = min(r0, r1, r2), min(c0, c1, c2)
                if not _is_whole(mask, top, left):
                    continue
            if area < 0:
                r1, c1, r2, c2 = r2, c2, r1, c1
            corners[count, 0], corners[count, 1] = r0 * n_cols + c0, r1 * n_cols + c1
            corners[count, 2] = r2 * n_cols + c2
            vertex_of[r0, c0] = vertex_of[r1, c1] = vertex_of[r2, c2] = 0
            count += 1
    for row in range(mask.shape[0] - 1):
        for col in range(n_cols - 1):
            if _is_whole(mask, row, col):
                continue
            kinds = triangles_of_quad(mask, row, col)
            for shift in range(4):
                if (kinds >> shift) & 1:
                    for k in range(3):
                        down, right = corner_of_quad(1 << shift, k)
                        corners[count, k] = (row + down) * n_cols + col + right
                        vertex_of[row + down, col + right] = 0
                    count += 1
    return count
