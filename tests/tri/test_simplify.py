"""Do collapses keep the bound, the area and their hands off others' memory?"""

import numpy as np

from terrainwave.tri.mesh import BlockMesh
from terrainwave.tri.simplify import simplify
from terrainwave.verification.checks import WHOLE, Surface, deviation, problems_of


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
    return Surface(
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
