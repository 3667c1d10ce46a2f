"""Fewer triangles by half-edge collapses, with the same test as the mesh itself.

A vertex moves onto a neighbour, which takes the middle of the interval of heights that keeps every
sample of the new star within the tolerance. Vertices on block borders do not move, so blocks still
fit together. On the outline of a void only vertices on a straight line between their two neighbours
are removed, so that the mesh covers the same area.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.tri.block_mesh import BlockMesh, used_only
from terrainwave.tri.halves.height_fit import fit_triangle, scaled_heights

_MAX_DEGREE = 24
# Degree of vertices with more triangles: these are not listed, and the vertex does not move.
_TOO_MANY = 1 << 20
# New triangles are at least this thick, twice the area over the longest edge squared, or as thick
# as the thinnest of those they replace: 1/16 is a height of a sixteenth of the longest edge.
_MIN_THICKNESS = 1.0 / 16
# Mobility of vertices: anywhere, nowhere, along the straight outline of a void.
_FREE, _FIXED, _OUTLINE = 0, 1, 2


def simplify(
    mesh: BlockMesh,  # within the tolerance already
    # `heights, mask`: shape (n_rows, n_cols); decoded heights in quanta and validity; the mesh
    # begins at sample (0, 0)
    heights: NDArray[np.int32],
    mask: NDArray[np.bool_],
    tolerance: int,  # in 1/16 quanta
    n_sweeps: int,  # number of sweeps over all vertices; they end early when one changes nothing
    min_thickness: float = _MIN_THICKNESS,
) -> BlockMesh:
    """Return a mesh of the same samples with fewer triangles, within the same tolerance."""
    if not len(mesh.triangles):
        return mesh
    values, scale = scaled_heights(heights, mask, tolerance)
    z = scale.of_mesh(mesh.heights)
    triangles = mesh.triangles.copy()
    is_alive = _sweep(
        values.ravel(), values.shape, (mesh.rows, mesh.cols, z, triangles), scale.tolerance,
        (scale.lowest, scale.highest), n_sweeps, min_thickness,
    )  # fmt: skip
    return used_only(mesh.rows, mesh.cols, scale.to_mesh(z), triangles[is_alive])


@kernel
def _others(triangles, t, v):
    """Return the two vertices of a triangle after `v`, in its order."""
    if triangles[t, 0] == v:
        return triangles[t, 1], triangles[t, 2]
    if triangles[t, 1] == v:
        return triangles[t, 2], triangles[t, 0]
    return triangles[t, 0], triangles[t, 1]


@kernel
def _has(triangles, t, v):
    return triangles[t, 0] == v or triangles[t, 1] == v or triangles[t, 2] == v


@kernel
def _thickness(row_0, col_0, row_1, col_1, row_2, col_2):
    """Return twice the area over the longest edge squared; 0 or less for no area."""
    area = (col_1 - col_0) * (row_2 - row_0) - (col_2 - col_0) * (row_1 - row_0)
    longest = max(
        (col_1 - col_0) ** 2 + (row_1 - row_0) ** 2,
        (col_2 - col_1) ** 2 + (row_2 - row_1) ** 2,
        (col_0 - col_2) ** 2 + (row_0 - row_2) ** 2,
    )
    return float(area) / float(longest)


@kernel
def _thinnest(rows, cols, triangles, star, n):
    thinnest = 1.0
    for i in range(n):
        a, b, c = triangles[star[i], 0], triangles[star[i], 1], triangles[star[i], 2]
        thinnest = min(
            thinnest,
            _thickness(
                np.int64(rows[a]), np.int64(cols[a]), np.int64(rows[b]), np.int64(cols[b]),
                np.int64(rows[c]), np.int64(cols[c]),
            ),
        )  # fmt: skip
    return thinnest


@kernel
def _is_thick(rows, cols, triangles, star, n, v, u, least):
    """Return whether all remaining triangles of v's star have area and are thick, with v on u."""
    row_0, col_0 = np.int64(rows[u]), np.int64(cols[u])
    for i in range(n):
        if _has(triangles, star[i], u):
            continue
        a, b = _others(triangles, star[i], v)
        row_1, col_1 = np.int64(rows[a]), np.int64(cols[a])
        row_2, col_2 = np.int64(rows[b]), np.int64(cols[b])
        if (col_1 - col_0) * (row_2 - row_0) - (col_2 - col_0) * (row_1 - row_0) <= 0:
            return False
        if _thickness(row_0, col_0, row_1, col_1, row_2, col_2) < least:
            return False
    return True


@kernel
def _fit_star(values, n_cols, mesh, star, n, centre, u, without, tolerance, limits):
    """Narrow the interval of u's height by the star of `centre`, moved onto u."""
    (rows, cols, z, triangles), (low, high) = mesh, limits
    row_0, col_0 = np.int64(rows[u]), np.int64(cols[u])
    for i in range(n):
        if _has(triangles, star[i], without):
            continue
        a, b = _others(triangles, star[i], centre)
        second = np.int64(rows[a]), np.int64(cols[a]), z[a]
        third = np.int64(rows[b]), np.int64(cols[b]), z[b]
        low, high = fit_triangle(
            values, 0, n_cols, (row_0, col_0), second, third, tolerance, low, high
        )
        if low > high:
            break
    return low, high


@kernel
def _n_common(triangles, stars, degrees, v, u):
    """Return the number of common neighbours of v and u.

    Two, or one on an outline; otherwise the collapse would pinch the surface.
    """
    count = 0
    for i in range(degrees[v]):
        # Each neighbour comes first in one of v's triangles, except the last one on an outline.
        p, _ = _others(triangles, stars[v, i], v)
        if p == u:
            continue
        for k in range(degrees[u]):
            if _has(triangles, stars[u, k], p):
                count += 1
                break
    return count


@kernel
def _remove(stars, degrees, v, t):
    if degrees[v] >= _TOO_MANY:
        return
    for i in range(degrees[v]):
        if stars[v, i] == t:
            degrees[v] -= 1
            stars[v, i] = stars[v, degrees[v]]
            return


@kernel
def _outline_neighbours(triangles, stars, degrees, v):
    """Return the neighbours before and after v on the boundary, and the number of gaps in its star.

    (-1, -1, 0) for a vertex inside. With several gaps, one neighbour on either side of any is
    returned.
    """
    before, after, n_gaps = np.int64(-1), np.int64(-1), 0
    for i in range(degrees[v]):
        first, last = _others(triangles, stars[v, i], v)
        is_first_shared = is_last_shared = False
        for k in range(degrees[v]):
            other_first, other_last = _others(triangles, stars[v, k], v)
            is_first_shared |= first == other_last
            is_last_shared |= last == other_first
        if not is_last_shared:
            after = np.int64(last)
            n_gaps += 1
        if not is_first_shared:
            before = np.int64(first)
    return before, after, n_gaps


@kernel
def _kinds_of_vertices(rows, cols, triangles, stars, degrees, last_row, last_col):
    """Return how each vertex may move. Vertices with too many triangles to list are fixed."""
    n_vertices = degrees.shape[0]
    kinds = np.zeros(n_vertices, dtype=np.uint8)
    for v in range(n_vertices):
        if degrees[v] > _MAX_DEGREE:
            kinds[v] = _FIXED
            continue
        _, _, n_gaps = _outline_neighbours(triangles, stars, degrees, v)
        if n_gaps == 0:
            continue
        is_inside = 0 < rows[v] < last_row and 0 < cols[v] < last_col
        kinds[v] = _OUTLINE if n_gaps == 1 and is_inside else _FIXED
    return kinds


@kernel
def _is_between(rows, cols, v, before, after):
    """Return whether v lies on the straight line from one neighbour to the other."""
    down_1, right_1 = np.int64(rows[before]) - rows[v], np.int64(cols[before]) - cols[v]
    down_2, right_2 = np.int64(rows[after]) - rows[v], np.int64(cols[after]) - cols[v]
    return down_1 * right_2 == down_2 * right_1 and down_1 * down_2 + right_1 * right_2 < 0


@kernel
def _sweep(values, shape, mesh, tolerance, limits, n_sweeps, min_thickness):
    """Collapse in place; return which triangles are left."""
    (n_rows, n_cols), (rows, cols, _, triangles) = shape, mesh
    n_vertices = rows.shape[0]
    last_row, last_col = 2 * (n_rows - 1), 2 * (n_cols - 1)
    # While v's triangles are moved to u, the two that vanish may still be in u's list.
    stars = np.empty((n_vertices, _MAX_DEGREE + 2), dtype=np.int32)
    degrees = np.zeros(n_vertices, dtype=np.int32)
    is_alive = np.ones(triangles.shape[0], dtype=np.bool_)
    for t in range(triangles.shape[0]):
        for k in range(3):
            v = triangles[t, k]
            if degrees[v] < _MAX_DEGREE:
                stars[v, degrees[v]] = t
            degrees[v] += 1
    for v in range(n_vertices):
        if degrees[v] > _MAX_DEGREE:
            degrees[v] = _TOO_MANY
    kinds = _kinds_of_vertices(rows, cols, triangles, stars, degrees, last_row, last_col)
    is_gone = np.zeros(n_vertices, dtype=np.bool_)
    is_waiting = np.ones(n_vertices, dtype=np.bool_)
    for _ in range(n_sweeps):
        n_done = 0
        for v in range(n_vertices):
            if is_gone[v] or kinds[v] == _FIXED or not is_waiting[v]:
                continue
            is_waiting[v] = False
            u = _collapse_target(
                values, n_cols, mesh, stars, degrees, kinds, v, tolerance, limits, min_thickness
            )
            if u < 0:
                continue
            n_done += 1
            for i in range(degrees[v]):
                t = stars[v, i]
                if _has(triangles, t, u):
                    is_alive[t] = False
                    a, b = _others(triangles, t, v)
                    _remove(stars, degrees, a, t)
                    _remove(stars, degrees, b, t)
                else:
                    for k in range(3):
                        if triangles[t, k] == v:
                            triangles[t, k] = u
                    stars[u, degrees[u]] = t
                    degrees[u] += 1
            is_gone[v] = True
            for i in range(degrees[u]):
                for k in range(3):
                    is_waiting[triangles[stars[u, i], k]] = True
        if n_done == 0:
            break
    return is_alive


@kernel
def _collapse_target(
    values, n_cols, mesh, stars, degrees, kinds, v, tolerance, limits, min_thickness
):
    """Return the first neighbour that v can move onto, with its height set; -1 if none.

    For a vertex on an outline the candidates are its two neighbours there, if it lies between them.
    """
    rows, cols, z, triangles = mesh
    before, after, n_vanish = np.int64(-1), np.int64(-1), 2
    if kinds[v] == _OUTLINE:
        before, after, _ = _outline_neighbours(triangles, stars, degrees, v)
        n_vanish = 1
        if not _is_between(rows, cols, v, before, after):
            return -1
    least = min(min_thickness, _thinnest(rows, cols, triangles, stars[v], degrees[v]))
    n_targets = degrees[v] if n_vanish == 2 else 2
    for i in range(n_targets):
        u = after if i else before
        if n_vanish == 2:
            first, _ = _others(triangles, stars[v, i], v)
            u = np.int64(first)
        if degrees[u] + degrees[v] - 2 * n_vanish > _MAX_DEGREE:
            continue
        if not _is_thick(rows, cols, triangles, stars[v], degrees[v], v, u, least):
            continue
        if _n_common(triangles, stars, degrees, v, u) != n_vanish:
            continue
        low, high = limits
        if kinds[u] != _FREE:
            low, high = z[u], z[u]
        low, high = _fit_star(
            values, n_cols, mesh, stars[v], degrees[v], v, u, u, tolerance, (low, high)
        )
        if low > high:
            continue
        if kinds[u] == _FREE:
            low, high = _fit_star(
                values, n_cols, mesh, stars[u], degrees[u], u, u, v, tolerance, (low, high)
            )
            if low > high:
                continue
            z[u] = np.floor((low + high) * 0.5)
        return u
    return -1
