"""Collapses beside vertices with very many triangles."""

import numpy as np

from terrainwave.tri.block_mesh import BlockMesh
from terrainwave.tri.halves.simplify import simplify


def wheel(n_spokes, radius=24):
    """Return a flat mesh: a hub with `n_spokes` triangles, a ring of inner vertices, a square.

    Vertices of the ring are inner ones with few triangles: they may collapse onto the hub.
    """
    angles = np.arange(n_spokes) / n_spokes * 2 * np.pi
    ring = np.rint(radius * np.stack([np.sin(angles), np.cos(angles)], axis=-1)).astype(int)
    far = np.rint(3 * radius * np.stack([np.sin(angles), np.cos(angles)], axis=-1)).astype(int)
    points = np.concatenate([[[0, 0]], ring, far])
    number = np.arange(n_spokes)
    following = (number + 1) % n_spokes
    hub = np.zeros(n_spokes, dtype=int)
    inner, outer = 1 + number, 1 + n_spokes + number
    next_inner, next_outer = 1 + following, 1 + n_spokes + following
    triangles = np.concatenate(
        [
            np.stack([hub, inner, next_inner], axis=-1),
            np.stack([inner, outer, next_outer], axis=-1),
            np.stack([inner, next_outer, next_inner], axis=-1),
        ]
    )
    points += 4 * radius
    # (c1 − c0)(r2 − r0) − (c2 − c0)(r1 − r0) > 0
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    area = (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]) - (c[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    triangles[area < 0] = triangles[area < 0][:, ::-1]
    assert (area != 0).all()
    side = 4 * radius + 1
    mesh = BlockMesh(
        points[:, 0].astype(np.int32),
        points[:, 1].astype(np.int32),
        np.zeros(len(points), dtype=np.int64),
        triangles.astype(np.int32),
    )
    return mesh, np.zeros((side, side), dtype=np.int32)


def total_area(mesh):
    rows, cols = mesh.rows.astype(int), mesh.cols.astype(int)
    a, b, c = mesh.triangles.T
    areas = (cols[b] - cols[a]) * (rows[c] - rows[a]) - (cols[c] - cols[a]) * (rows[b] - rows[a])
    assert (areas > 0).all()
    return areas.sum()


def check(n_spokes):
    mesh, heights = wheel(n_spokes)
    mask = np.ones(heights.shape, dtype=bool)
    found = simplify(mesh, heights, mask, 16, 3, min_thickness=0.0)
    assert total_area(found) == total_area(mesh)
    edges = np.sort(
        np.concatenate(
            [found.triangles[:, [0, 1]], found.triangles[:, [1, 2]], found.triangles[:, [2, 0]]]
        )
    )
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert set(counts.tolist()) <= {1, 2}


def test_collapses_beside_a_full_hub_keep_the_surface_whole():
    for n_spokes in (20, 24, 25, 26):
        check(n_spokes)
