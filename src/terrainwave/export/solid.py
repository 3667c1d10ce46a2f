"""Walls below a surface: a closed body with a flat base, for printing, or skirts."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError, InvalidHeightsError
from terrainwave.mesh.mesh_data import MeshData, used_only, walls_below

# Distance by which a vertex that joins two corners is moved into each of them, as a share of the
# way to the middle of a triangle there; halved while a triangle would turn over.
_FIRST_SHARE = 1 / 1024
_HALVINGS = 20


def solidify(mesh: MeshData, base: float) -> MeshData:
    """Close the mesh with walls along all its borders, those of voids too, and a flat base.

    The base, at a height below the lowest vertex, has the triangles of the surface, turned over.
    Where two parts of the surface touch only in one vertex, the vertex is doubled and moved a
    little into each: otherwise the vertical edge below it would belong to four walls.
    ``attributes["solid"]`` holds ``base``, ``n_triangles`` (of the surface, which come first), and
    ``moved``, the largest shift of a doubled vertex in units of the CRS.
    """
    if not mesh.n_triangles:
        raise InvalidHeightsError("the mesh is empty: there are no valid heights under it")
    lowest = float(mesh.points[mesh.triangles.ravel(), 2].min())
    if base >= lowest:
        raise InvalidArgumentError(
            f"found `solid` {base:g}, expected less than the mesh's lowest height {lowest:g}"
        )
    vertices, triangles = used_only(mesh.vertices, mesh.triangles)
    vertices, triangles, moved = _split_joints(vertices, triangles)
    n_top = len(vertices)
    below = vertices.copy()
    below[:, 2] = base - mesh.origin[2]
    starts, ends = border_edges(triangles).T
    walls = walls_below(starts, ends, starts + n_top, ends + n_top)
    bottom = triangles[:, ::-1] + n_top
    about = {"base": float(base), "n_triangles": len(triangles), "moved": moved}
    return replace(
        mesh,
        vertices=np.concatenate([vertices, below]),
        triangles=np.concatenate([triangles, walls, bottom]).astype(np.int32),
        attributes=mesh.attributes | {"solid": about},
    )


class Skirts(NamedTuple):
    """Skirts of a mesh: its last vertices lie below those listed in `above`.

    Its first `n_triangles` triangles are the surface.
    """

    above: NDArray[np.int64]
    n_triangles: int


def add_skirts(mesh: MeshData, depth: float, *, is_downward: bool = False) -> MeshData:
    """Hang walls from all borders of a mesh, those of voids too: they hide gaps to other meshes.

    Heights that are depths (`is_downward`) are larger at lower points. ``attributes["skirts"]``
    holds its `Skirts`.
    """
    starts, ends = border_edges(mesh.triangles).T
    above, places = np.unique(np.concatenate([starts, ends]), return_inverse=True)
    below = mesh.vertices[above].copy()
    below[:, 2] += depth if is_downward else -depth
    lower = mesh.n_vertices + places.reshape(2, -1)
    walls = walls_below(starts, ends, *lower)
    return replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, below]),
        triangles=np.concatenate([mesh.triangles, walls]).astype(np.int32),
        attributes=mesh.attributes | {"skirts": Skirts(above, mesh.n_triangles)},
    )


def border_edges(triangles: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the edges (start, end) that belong to one triangle only, in its direction."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges = edges.astype(np.int64)
    size = int(edges.max()) + 1
    forward, backward = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    return edges[~np.isin(forward, backward)]


def _split_joints(
    vertices: NDArray[np.float64], triangles: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int32], float]:
    """Double the vertices where several fans of triangles meet, and pull the fans apart."""
    # On a surface whose borders don't touch, each vertex starts at most one border edge.
    starts, counts = np.unique(border_edges(triangles)[:, 0], return_counts=True)
    joints = starts[counts > 1]
    if not joints.size:
        return vertices, triangles, 0.0
    triangles = triangles.copy()
    around: dict[int, list[int]] = {int(joint): [] for joint in joints}
    for index in np.flatnonzero(np.isin(triangles, joints).any(axis=1)):
        for corner in triangles[index]:
            if int(corner) in around:
                around[int(corner)].append(int(index))
    added: list[NDArray[np.float64]] = []
    fans: list[tuple[int, list[int]]] = []
    for joint, incident in around.items():
        for number, fan in enumerate(_fans(triangles, joint, incident)):
            vertex = int(joint)
            if number:
                vertex = len(vertices) + len(added)
                added.append(vertices[joint])
                for part in fan:
                    triangles[part][triangles[part] == joint] = vertex
            fans.append((vertex, fan))
    vertices = np.concatenate([vertices, np.array(added).reshape(-1, 3)])
    moved = [_pull_in(vertices, triangles, vertex, fan) for vertex, fan in fans]
    return vertices, triangles, max(moved)


def _fans(triangles: NDArray[np.int32], joint: int, incident: list[int]) -> list[list[int]]:
    """Group the triangles around a vertex into fans connected by edges."""
    following: dict[int, tuple[int, int]] = {}
    for index in incident:
        a, b, c = (int(corner) for corner in triangles[index])
        start, end = {a: (b, c), b: (c, a), c: (a, b)}[joint]
        following[start] = (end, index)
    ends = {end for end, _ in following.values()}
    fans = []
    for start in following:
        if start in ends:
            continue
        fan: list[int] = []
        at = start
        while at in following:
            at, index = following[at]
            fan.append(index)
        fans.append(fan)
    return fans


def _pull_in(
    vertices: NDArray[np.float64], triangles: NDArray[np.int32], vertex: int, fan: list[int]
) -> float:
    """Move a vertex horizontally into the middle triangle of its fan; return the distance.

    No triangle may turn over.
    """
    old = vertices[vertex, :2].copy()
    middle = vertices[triangles[fan[len(fan) // 2]], :2].mean(axis=0)
    share = _FIRST_SHARE
    for _ in range(_HALVINGS):
        vertices[vertex, :2] = old + share * (middle - old)
        corners = vertices[triangles[fan], :2]
        along, across = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        if (along[:, 0] * across[:, 1] > along[:, 1] * across[:, 0]).all():
            return float(np.abs(vertices[vertex, :2] - old).max())
        share /= 2
    vertices[vertex, :2] = old
    return 0.0
