"""One mesh of the meshes of blocks, and the part of it inside an area."""

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Block, Grid
from terrainwave.mesh.mesh_data import used_only
from terrainwave.tri.block_mesh import BlockMesh

# Half samples; edges are shorter than its inverse.
_NEAR = 2.0**-20


def joined(
    grid: Grid, blocks: list[Block], meshes: list[BlockMesh]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the vertices and triangles of all blocks; vertices shared by blocks are merged.

    A vertex is (row, column, height), in half samples of the full grid and 1/16 quanta.
    """
    places, heights, is_border = [], [], []
    for block, mesh in zip(blocks, meshes, strict=True):
        stride, side = grid.stride(block.level), 2 * grid.block
        rows = (block.row * side + mesh.rows.astype(np.int64)) * stride
        cols = (block.col * side + mesh.cols.astype(np.int64)) * stride
        last_row, last_col = mesh.rows.max(initial=0), mesh.cols.max(initial=0)
        is_border.append(
            (mesh.rows == 0) | (mesh.rows == last_row) | (mesh.cols == 0) | (mesh.cols == last_col)
        )
        places.append(rows << 32 | cols)
        heights.append(mesh.heights)
    if not blocks:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.int32)
    place, height = np.concatenate(places), np.concatenate(heights)
    number = np.arange(len(place))
    on_border = np.flatnonzero(np.concatenate(is_border))
    _, first, same = np.unique(place[on_border], return_index=True, return_inverse=True)
    number[on_border] = on_border[first][same.reshape(-1)]
    is_kept = number == np.arange(len(place))
    renumbered = (np.cumsum(is_kept, dtype=np.int32) - 1)[number]
    triangles = np.empty((sum(len(mesh.triangles) for mesh in meshes), 3), dtype=np.int32)
    n_vertices = n_triangles = 0
    for mesh in meshes:
        beyond = n_triangles + len(mesh.triangles)
        own = renumbered[n_vertices : n_vertices + len(mesh.rows)]
        triangles[n_triangles:beyond] = own[mesh.triangles]
        n_vertices, n_triangles = n_vertices + len(mesh.rows), beyond
    place, height = place[is_kept], height[is_kept]
    vertices = np.stack([place >> 32, place & 0xFFFFFFFF, height], 1).astype(np.float64)
    return vertices, triangles


def clipped(
    vertices: NDArray[np.float64], triangles: NDArray[np.int32], limits: tuple[int, int, int, int]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the part of a mesh inside (first row, last row, first column, last column)."""
    whole = triangles
    for axis, limit, sign in (
        (0, limits[0], 1.0), (0, limits[1], -1.0), (1, limits[2], 1.0), (1, limits[3], -1.0),
    ):  # fmt: skip
        vertices, triangles = _cut_off(vertices, triangles, sign * (vertices[:, axis] - limit))
    if triangles is whole:
        return vertices, triangles
    return used_only(vertices, triangles)


def _cut_off(
    vertices: NDArray[np.float64], triangles: NDArray[np.int32], inside: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Keep the part where `inside`, linear over the plane, is >= 0.

    An edge that crosses the line gets one new vertex, the same in both its triangles.
    """
    if (inside >= 0).all():
        return vertices, triangles
    is_in = inside[triangles] >= 0
    n_in = is_in.sum(axis=1)
    kept = [triangles[n_in == 3]]
    edges: list[NDArray[np.int64]] = []
    # Rotated so that the odd one out comes first: one inside, or one outside.
    for n, odd in ((1, True), (2, False)):
        rows = np.flatnonzero(n_in == n)
        first = np.argmax(is_in[rows] == odd, axis=1)
        turned = triangles[rows[:, None], (first[:, None] + np.arange(3)) % 3].astype(np.int64)
        edges.append(np.stack([turned[:, [0, 1]], turned[:, [0, 2]]], 1))
    both = np.sort(np.concatenate(edges).reshape(-1, 2), axis=1)
    unique, number = np.unique(both, axis=0, return_inverse=True)
    a, b = unique[:, 0], unique[:, 1]
    share = inside[a] / (inside[a] - inside[b])
    crossing = vertices[a] + share[:, None] * (vertices[b] - vertices[a])
    # Rounding must not move a crossing off a half sample it lies on, such as the area's corner: no
    # other one is so near, as denominators are lengths of edges.
    whole = np.rint(crossing[:, :2])
    is_near = np.abs(crossing[:, :2] - whole) < _NEAR
    crossing[:, :2] = np.where(is_near, whole, crossing[:, :2])
    # A vertex on the line is its own crossing.
    ends = len(vertices) + np.arange(len(unique))
    ends = np.where(inside[a] == 0, a, np.where(inside[b] == 0, b, ends))
    new = ends[number.reshape(-1, 2)]
    n_one = len(edges[0])
    one, two = edges[0][:, 0, 0], edges[1][:, :, 1]
    ends_one, ends_two = new[:n_one], new[n_one:]
    kept.append(np.stack([one, ends_one[:, 0], ends_one[:, 1]], 1).astype(np.int32))
    # The quad without the outside corner: new 1, corner 1, corner 2, new 2.
    kept.append(np.stack([ends_two[:, 0], two[:, 0], two[:, 1]], 1).astype(np.int32))
    kept.append(np.stack([ends_two[:, 0], two[:, 1], ends_two[:, 1]], 1).astype(np.int32))
    vertices = np.concatenate([vertices, crossing])
    triangles = np.concatenate(kept)
    return vertices, triangles[_has_area(vertices, triangles)]


def _has_area(vertices: NDArray[np.float64], triangles: NDArray[np.int32]) -> NDArray[np.bool_]:
    a, b, c = (vertices[triangles[:, k], :2] for k in range(3))
    area = (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) - (c[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    is_positive: NDArray[np.bool_] = area > 0
    return is_positive
