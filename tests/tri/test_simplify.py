"""Do collapses keep the bound, the area and their hands off others' memory?"""

import numpy as np

from terrainwave.tri.block_mesh import BlockMesh
from terrainwave.tri.halves.simplify import simplify
from terrainwave.verification.checks import WHOLE, CheckedMesh, deviation, problems_of


def fan(n_spokes):
    """Return a flat mesh of two rows of quads whose upper left vertex has `n_spokes` triangles.

    The middle line's vertices can all be collapsed.
    """
    cols = 2 * np.arange(n_spokes + 1)
    rows = np.concatenate([[0, 0], np.full(n_spokes + 1, 2), np.full(n_spokes + 1, 4)])
    places = np.concatenate([[0, 2 * n_spokes], cols, cols])
    middle, below = 2, 2 + n_spokes + 1
    triangles = [[0, 1, middle + n_spokes]]
    for k in range(n_spokes):
        triangles.append([0, middle + k + 1, middle + k])
        triangles.append([middle + k, middle + k + 1, below + k + 1])
        triangles.append([middle + k, below + k + 1, below + k])
    return BlockMesh(
        rows.astype(np.int32), places.astype(np.int32), np.zeros(len(rows), np.int64),
        np.array(triangles, np.int32),
    )  # fmt: skip


def surface(mesh):
    return CheckedMesh(
        mesh.rows.astype(np.int64), mesh.cols.astype(np.int64), mesh.heights, mesh.triangles
    )


def test_a_vertex_of_many_triangles_leaves_its_neighbours_stars_alone():
    """Its star is not listed: taking a triangle out of it wrote into the next vertex's."""
    for n_spokes in (20, 23, 24, 25, 40, 90):
        mesh, shape = fan(n_spokes), (3, n_spokes + 1)
        heights, mask = np.zeros(shape, np.int32), np.ones(shape, bool)
        whole = np.full((2, n_spokes), WHOLE, np.uint8)
        assert not list(problems_of(surface(mesh), shape, whole))
        found = simplify(mesh, heights, mask, 16, 8)
        assert list(problems_of(surface(found), shape, whole)) == []
        assert len(found.triangles) < len(mesh.triangles)
        assert deviation(surface(found), np.zeros(shape, np.int64), mask, 16).n_beyond == 0


def test_a_straight_outline_of_a_void_loses_its_vertices_and_keeps_its_place():
    """A square hole in a plain: its corners stay, the samples between them go."""
    mask = np.ones((20, 24), bool)
    mask[6:13, 8:17] = False
    mesh, heights = grid_mesh(mask), np.zeros(mask.shape, np.int32)
    found = simplify(mesh, heights, mask, 16, 8)
    assert areas(found).sum() == areas(mesh).sum()
    assert (areas(found) > 0).all()
    rows, cols = found.rows // 2, found.cols // 2
    on_outline = (5 <= rows) & (rows <= 13) & (7 <= cols) & (cols <= 17)
    corners = {(5, 7), (5, 17), (13, 7), (13, 17)}
    on_hole = set(zip(rows[on_outline].tolist(), cols[on_outline].tolist(), strict=True))
    assert corners <= on_hole
    assert len(on_hole) < 10


def test_a_bent_outline_of_a_void_keeps_what_bends():
    """Heights along it are no straight line: those beyond the tolerance stay vertices."""
    mask = np.ones((20, 24), bool)
    mask[6:13, 8:17] = False
    heights = np.zeros(mask.shape, np.int32)
    heights[5, 11] = 100
    found = simplify(grid_mesh(mask, heights), heights, mask, 16, 8)
    assert deviation(surface(found), heights.astype(np.int64) << 4, mask, 16).n_beyond == 0
    assert (5, 11) in set(zip((found.rows // 2).tolist(), (found.cols // 2).tolist(), strict=True))


def grid_mesh(mask, heights=None):
    """Return the mesh of all grid triangles of quads without a void."""
    number = np.arange(mask.size).reshape(mask.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    whole = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, 1:] & mask[1:, :-1]
    triangles = np.concatenate(
        [np.stack([a[whole], b[whole], c[whole]], 1), np.stack([a[whole], c[whole], d[whole]], 1)]
    )
    used, triangles = np.unique(triangles, return_inverse=True)
    rows, cols = np.divmod(used, mask.shape[1])
    values = np.zeros(len(used), np.int64)
    if heights is not None:
        values = heights.ravel()[used].astype(np.int64) << 4
    return BlockMesh(
        (2 * rows).astype(np.int32), (2 * cols).astype(np.int32), values,
        triangles.reshape(-1, 3).astype(np.int32),
    )  # fmt: skip


def areas(mesh):
    rows, cols = mesh.rows.astype(int), mesh.cols.astype(int)
    a, b, c = mesh.triangles.T
    return (cols[b] - cols[a]) * (rows[c] - rows[a]) - (cols[c] - cols[a]) * (rows[b] - rows[a])
