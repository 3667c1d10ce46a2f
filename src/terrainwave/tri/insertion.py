"""Insertion of points into a triangulation that is too far from them: greedy, the worst one first.

After M. Garland and P. S. Heckbert, Fast Polygonal Approximation of Terrains and Height Fields
(1995), greedy insertion with a Delaunay triangulation. Departures: the worst point of each triangle
goes in, in no order over all triangles; edges next to triangles that must not change, and edges of
the triangulation's border, stay.

Positions are integers, so point location is exact; the better of two diagonals is chosen in
float64.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel

_NONE = -1
# Limit of positions, so that products of two differences fit.
MAX_PLACE = 1 << 20


def insert_points(
    places: NDArray[np.int64],
    heights: NDArray[np.float64],
    triangles: NDArray[np.int32],
    is_open: NDArray[np.bool_],
    points: NDArray[np.int64],
    point_heights: NDArray[np.float64],
    tolerance: float,
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return which points became vertices, and the triangles with them.

    Places, int64 (n, 2), are x and y, 0 ... `MAX_PLACE`. Triangles are counter-clockwise, and each
    edge belongs to one or two. Only triangles of `is_open` accept points. Points nearer than the
    tolerance to the surface stay out, as do points on the border and on vertices. Inserted points
    are vertices n_vertices, n_vertices + 1, ...
    """
    n_vertices, n_points, n_triangles = len(places), len(points), len(triangles)
    n_most = n_triangles + 2 * n_points
    x, y = (np.concatenate([places[:, k], np.zeros(n_points, dtype=np.int64)]) for k in range(2))
    z = np.concatenate([heights, np.zeros(n_points)])
    corners = np.zeros((n_most, 3), dtype=np.int64)
    corners[:n_triangles] = triangles
    beside = np.full((n_most, 3), _NONE, dtype=np.int64)
    beside[:n_triangles] = _neighbours(triangles)
    open_ = np.zeros(n_most, dtype=np.bool_)
    open_[:n_triangles] = is_open
    inserted = np.zeros(n_points, dtype=np.int64)
    n_inserted = _insert(
        x, y, z, n_vertices, corners, beside, open_, n_triangles,
        (np.ascontiguousarray(points[:, 0]), np.ascontiguousarray(points[:, 1]), point_heights),
        float(tolerance), inserted,
    )  # fmt: skip
    made = corners[: n_triangles + 2 * n_inserted].astype(np.int32)
    return inserted[:n_inserted], made


def _neighbours(triangles: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the triangle beyond the edge opposite to each corner; -1 on the border."""
    starts = triangles[:, [1, 2, 0]].astype(np.int64).ravel()
    ends = triangles[:, [2, 0, 1]].astype(np.int64).ravel()
    size = int(triangles.max(initial=0)) + 1
    forward, backward = starts * size + ends, ends * size + starts
    order = np.argsort(forward)
    at = np.minimum(np.searchsorted(forward, backward, sorter=order), len(order) - 1)
    found = order[at]
    return np.where(forward[found] == backward, found // 3, _NONE).reshape(-1, 3)


@kernel
def _cross(x, y, a, b, p_x, p_y):
    """Return twice the area of vertices a, b and a point."""
    return (x[b] - x[a]) * (p_y - y[a]) - (y[b] - y[a]) * (p_x - x[a])


@kernel
def _holds(x, y, corners, t, p_x, p_y):
    """Return whether a point lies in a triangle or on its edges."""
    a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
    return (
        _cross(x, y, a, b, p_x, p_y) >= 0
        and _cross(x, y, b, c, p_x, p_y) >= 0
        and _cross(x, y, c, a, p_x, p_y) >= 0
    )


@kernel
def _share_out(x, y, corners, chain, first, following, where, p_x, p_y):
    """Give the points of a chain to the triangles that hold them."""
    while chain >= 0:
        after = following[chain]
        for k in range(where.shape[0]):
            t = where[k]
            if t >= 0 and _holds(x, y, corners, t, p_x[chain], p_y[chain]):
                following[chain] = first[t]
                first[t] = chain
                break
        chain = after


@kernel
def _replace(beside, t, old, new):
    """Replace a neighbour of a triangle, if the triangle exists."""
    if t >= 0:
        for k in range(3):
            if beside[t, k] == old:
                beside[t, k] = new
                return


@kernel
def _set(corners, beside, t, a, b, c, at_a, at_b, at_c):
    corners[t, 0], corners[t, 1], corners[t, 2] = a, b, c
    beside[t, 0], beside[t, 1], beside[t, 2] = at_a, at_b, at_c


@kernel
def _worst(x, y, z, corners, t, first, following, points):
    """Return the point of a triangle's chain that is furthest from its plane, and its distance."""
    p_x, p_y, p_z = points
    a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
    area = float(_cross(x, y, a, b, x[c], y[c]))
    worst, at, point = -1.0, -1, first[t]
    while point >= 0:
        w_a = float(_cross(x, y, b, c, p_x[point], p_y[point]))
        w_b = float(_cross(x, y, c, a, p_x[point], p_y[point]))
        apart = abs((w_a * z[a] + w_b * z[b] + (area - w_a - w_b) * z[c]) / area - p_z[point])
        if apart > worst:
            worst, at = apart, point
        point = following[point]
    return at, worst


@kernel
def _unlink(first, following, t, point):
    if first[t] == point:
        first[t] = following[point]
        return
    before = first[t]
    while following[before] != point:
        before = following[before]
    following[before] = following[point]


@kernel
def _joined_chains(first, following, t, u):
    """Return the points of two triangles as one chain, and empty theirs."""
    chain = first[t]
    if chain < 0:
        chain = first[u]
    else:
        last = chain
        while following[last] >= 0:
            last = following[last]
        following[last] = first[u]
    first[t] = first[u] = -1
    return chain


@kernel
def _is_in_circle(x, y, a, b, c, d):
    """Return whether vertex d lies clearly inside the circle through a, b, c."""
    a_x, a_y = float(x[a] - x[d]), float(y[a] - y[d])
    b_x, b_y = float(x[b] - x[d]), float(y[b] - y[d])
    c_x, c_y = float(x[c] - x[d]), float(y[c] - y[d])
    a_2, b_2, c_2 = a_x * a_x + a_y * a_y, b_x * b_x + b_y * b_y, c_x * c_x + c_y * c_y
    one = a_x * (b_y * c_2 - c_y * b_2)
    two = a_y * (b_x * c_2 - c_x * b_2)
    three = a_2 * (b_x * c_y - c_x * b_y)
    # Rounding of float64 must not flip an edge to and fro.
    return one - two + three > 1e-12 * (abs(one) + abs(two) + abs(three))


@kernel
def _turn_to(corners, beside, t, corner):
    """Rotate a triangle's lists so that a corner comes first."""
    while corners[t, 0] != corner:
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        _set(corners, beside, t, b, c, a, beside[t, 1], beside[t, 2], beside[t, 0])


@kernel
def _opposite(corners, beside, t, neighbour):
    """Return the corner of a triangle opposite to a neighbour."""
    for k in range(3):
        if beside[t, k] == neighbour:
            return corners[t, k]
    return -1


@kernel
def _flip(x, y, corners, beside, open_, t, first, following, p_x, p_y, where):
    """Flip the edge opposite to a triangle's first corner if the other diagonal is better.

    Returns the triangle beyond, or -1 if the edge stays.
    """
    w = beside[t, 0]
    if w < 0 or not (open_[t] and open_[w]):
        return -1
    v, a, b = corners[t, 0], corners[t, 1], corners[t, 2]
    _turn_to(corners, beside, w, _opposite(corners, beside, w, t))
    d = corners[w, 0]
    if not _is_in_circle(x, y, v, a, b, d):
        return -1
    if _cross(x, y, v, a, x[d], y[d]) <= 0 or _cross(x, y, v, d, x[b], y[b]) <= 0:
        return -1
    # w is (d, b, a): beyond b lies the edge from a to d, beyond a that from d to b.
    beyond_ad, beyond_db = beside[w, 1], beside[w, 2]
    beyond_bv, beyond_va = beside[t, 1], beside[t, 2]
    _set(corners, beside, t, v, a, d, beyond_ad, w, beyond_va)
    _set(corners, beside, w, v, d, b, beyond_db, beyond_bv, t)
    _replace(beside, beyond_ad, w, t)
    _replace(beside, beyond_bv, t, w)
    where[0], where[1], where[2], where[3] = t, w, -1, -1
    chain = _joined_chains(first, following, t, w)
    _share_out(x, y, corners, chain, first, following, where, p_x, p_y)
    return w


@kernel
def _split(corners, beside, open_, t, on_edge, v, n, where):
    """Insert vertex v into triangle t, or on its edge opposite to the first corner.

    New triangles are n and n + 1. In those with v it then comes first; `where` lists them.
    """
    a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
    beyond_bc, beyond_ca, beyond_ab = beside[t, 0], beside[t, 1], beside[t, 2]
    open_[n] = open_[t]
    if not on_edge:
        _set(corners, beside, t, v, b, c, beyond_bc, n, n + 1)
        _set(corners, beside, n, v, c, a, beyond_ca, n + 1, t)
        _set(corners, beside, n + 1, v, a, b, beyond_ab, t, n)
        open_[n + 1] = open_[t]
        _replace(beside, beyond_ca, t, n)
        _replace(beside, beyond_ab, t, n + 1)
        where[0], where[1], where[2], where[3] = t, n, n + 1, -1
        return
    u = beyond_bc
    _turn_to(corners, beside, u, _opposite(corners, beside, u, t))
    d = corners[u, 0]  # u is (d, c, b)
    beyond_bd, beyond_dc = beside[u, 1], beside[u, 2]
    _set(corners, beside, t, v, a, b, beyond_ab, n + 1, n)
    _set(corners, beside, n, v, c, a, beyond_ca, t, u)
    _set(corners, beside, u, v, d, c, beyond_dc, n, n + 1)
    _set(corners, beside, n + 1, v, b, d, beyond_bd, u, t)
    open_[n + 1] = open_[u]
    _replace(beside, beyond_ca, t, n)
    _replace(beside, beyond_bd, u, n + 1)
    where[0], where[1], where[2], where[3] = t, n, u, n + 1


@kernel
def _insert(x, y, z, n, corners, beside, open_, n_triangles, points, tolerance, inserted):
    p_x, p_y, p_z = points
    n_points, n_first, n_inserted = p_x.shape[0], n, 0
    first = np.full(corners.shape[0], -1, np.int64)
    following = np.full(n_points, -1, np.int64)
    where = np.full(4, -1, np.int64)
    _locate(x, y, corners, open_, n_triangles, points, first, following)
    waiting = np.empty(corners.shape[0], np.int64)
    is_waiting = np.zeros(corners.shape[0], np.bool_)
    unsure = np.empty(corners.shape[0] * 2 + 8, np.int64)
    n_waiting = 0
    for t in range(n_triangles - 1, -1, -1):
        if first[t] >= 0:
            waiting[n_waiting] = t
            is_waiting[t] = True
            n_waiting += 1
    while n_waiting:
        n_waiting -= 1
        t = waiting[n_waiting]
        is_waiting[t] = False
        point, apart = _worst(x, y, z, corners, t, first, following, points)
        if point < 0 or apart <= tolerance:
            continue
        _unlink(first, following, t, point)
        n_zero, opposite = 0, -1
        for k in range(3):
            b, c = corners[t, (k + 1) % 3], corners[t, (k + 2) % 3]
            if _cross(x, y, b, c, p_x[point], p_y[point]) == 0:
                n_zero += 1
                opposite = k
        if n_zero > 1 or (n_zero == 1 and beside[t, opposite] < 0):
            # On a vertex or the border, which stay: use the next worst.
            waiting[n_waiting] = t
            is_waiting[t] = True
            n_waiting += 1
            continue
        v = n_first + n_inserted
        x[v], y[v], z[v] = p_x[point], p_y[point], p_z[point]
        inserted[n_inserted] = point
        n_inserted += 1
        if n_zero:
            _turn_to(corners, beside, t, corners[t, opposite])
            chain = _joined_chains(first, following, t, beside[t, 0])
        else:
            chain = first[t]
            first[t] = -1
        _split(corners, beside, open_, t, n_zero == 1, v, n_triangles, where)
        n_triangles += 2
        _share_out(x, y, corners, chain, first, following, where, p_x, p_y)
        n_unsure = 0
        for k in range(4):
            if where[k] >= 0:
                unsure[n_unsure] = where[k]
                n_unsure += 1
        while n_unsure:
            n_unsure -= 1
            t = unsure[n_unsure]
            w = _flip(x, y, corners, beside, open_, t, first, following, p_x, p_y, where)
            if w >= 0:
                unsure[n_unsure], unsure[n_unsure + 1] = t, w
                n_unsure += 2
            elif open_[t] and first[t] >= 0 and not is_waiting[t]:
                waiting[n_waiting] = t
                is_waiting[t] = True
                n_waiting += 1
    return n_inserted


@kernel
def _locate(x, y, corners, open_, n_triangles, points, first, following):
    """Assign each point to an open triangle that holds it; points may lie in rows of equal y."""
    p_x, p_y, _ = points
    order = np.argsort(p_y)
    sorted_y = p_y[order]
    is_placed = np.zeros(p_x.shape[0], np.bool_)
    for t in range(n_triangles):
        if not open_[t]:
            continue
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        low, high = min(x[a], x[b], x[c]), max(x[a], x[b], x[c])
        at = np.searchsorted(sorted_y, min(y[a], y[b], y[c]))
        top = max(y[a], y[b], y[c])
        while at < order.shape[0] and sorted_y[at] <= top:
            point = order[at]
            at += 1
            if is_placed[point] or p_x[point] < low or p_x[point] > high:
                continue
            if _holds(x, y, corners, t, p_x[point], p_y[point]):
                is_placed[point] = True
                following[point] = first[t]
                first[t] = point
