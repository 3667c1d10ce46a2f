"""The restricted quadtree: hand-worked selections, the bound, conformity on any size."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tri import slow
from tri.rasterise import check_mesh

from terrainwave.tri.rqt.stored import rqt_mesh, select_vertices, vertices_of, virtual_places

pytestmark = pytest.mark.slow_compile


@given(terrain=slow.terrains(max_side=40), seed=st.none() | st.integers(0, 99))
def test_a_mesh_conforms_and_holds_the_tolerance_but_by_coefficients(terrain, seed):
    heights, mask, tolerance = terrain
    coefficients = None
    if seed is not None:
        coefficients = np.random.default_rng(seed).geometric(0.02, heights.shape) - 1
    selection = select_vertices(heights, mask, tolerance, coefficients=coefficients)
    mesh = rqt_mesh(heights, mask, selection)
    check_mesh(mesh, heights, mask, tolerance if seed is None else None)
    places = set(zip((mesh.rows // 2).tolist(), (mesh.cols // 2).tolist(), strict=True))
    on_grid = {tuple(p) for p in np.argwhere(vertices_of(selection, mask.shape)).tolist()}
    # Selected samples in voids have no triangle; all others are the mesh's vertices.
    assert places == on_grid & {p for t in slow.full_grid(mask) for p in t}


@pytest.mark.parametrize("shape", [(2, 2), (33, 33), (20, 33), (7, 30), (33, 2)])
def test_a_plane_is_two_triangles(shape):
    rows, cols = np.indices(shape)
    heights = (3 * rows - 2 * cols).astype(np.int32)
    mask = np.ones(shape, dtype=bool)
    mesh = rqt_mesh(heights, mask, select_vertices(heights, mask, 16 * 70))
    assert len(mesh.triangles) == 2


def test_a_vertex_brings_what_it_depends_on():
    # 5 x 5, the spike at (1, 0), middle of a left edge of stride 1: by hand, it depends on the
    # centre (1, 1), that on (0, 2)... no: on the ends of its cell's other diagonal, (2, 0) and
    # (0, 2), and these on the root's centre (2, 2).
    heights = np.zeros((5, 5), dtype=np.int32)
    mask = np.ones((5, 5), dtype=bool)
    keep = np.zeros((5, 5), dtype=bool)
    keep[1, 0] = True
    selection = select_vertices(heights, mask, 0, keep=keep)
    assert np.argwhere(selection).tolist() == [
        [0, 0], [0, 2], [0, 4], [1, 0], [1, 1], [2, 0], [2, 2], [4, 0], [4, 4],
    ]  # fmt: skip
    check_mesh(rqt_mesh(heights, mask, selection), heights, mask, 0)


@pytest.mark.parametrize("shape", [(1, 1), (2, 9), (20, 33), (100, 257), (257, 257)])
def test_virtual_rows_cover_all_samples_in_order(shape):
    for places, n in zip(virtual_places(shape), shape, strict=True):
        assert places[0] == 0
        assert places[-1] == n - 1
        assert set(np.diff(places).tolist()) <= {0, 1}
        if shape == (257, 257):
            assert places.tolist() == list(range(257))


def test_by_coefficients_only_those_above_the_tolerance_are_selected_and_what_they_depend_on():
    """The heights don't matter: a spike without a coefficient stays away. By hand as above."""
    heights = np.zeros((5, 5), dtype=np.int32)
    heights[3, 3] = 1000
    mask, coefficients = np.ones((5, 5), dtype=bool), np.zeros((5, 5), dtype=np.int64)
    coefficients[1, 0] = 3
    for tolerance, n_selected in ((47, 9), (48, 4)):  # 3 quanta are 48 sixteenths
        selection = select_vertices(heights, mask, tolerance, coefficients=coefficients)
        assert np.count_nonzero(selection) == n_selected
