"""The non-guaranteed triangulation: the collapse rule, folds, its true error."""

from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tri import slow
from tri.rasterise import check_mesh

from terrainwave.tri.quads import void_edges
from terrainwave.tri.zerotree.connect import loose_mesh, mesh_of_cut
from terrainwave.tri.zerotree.labels import zero_tree_cut


def triangles_of(mesh):
    places = list(zip((mesh.rows // 2).tolist(), (mesh.cols // 2).tolist(), strict=True))
    return [tuple(places[v] for v in t) for t in mesh.triangles.tolist()]


def turned(triangle):
    """Start at the smallest corner, keeping the way round."""
    k = triangle.index(min(triangle))
    return triangle[k:] + triangle[:k]


@given(terrain=slow.terrains(max_side=18), data=st.data())
def test_mesh_is_the_full_grid_with_roots_substituted(terrain, data):
    heights, mask, _ = terrain
    trees = data.draw(slow.zero_trees(mask.shape))
    if trees is None:
        return
    cut = zero_tree_cut(trees, void_edges(mask))
    root = {}
    for height in range(slow.top_height(mask.shape) + 1):
        for row, col, samples in slow.nodes(mask.shape, height):
            if cut[row, col] == height:
                root |= dict.fromkeys(samples, (row, col))
    expected = slow.collapsed(slow.full_grid(mask), root)
    mesh = mesh_of_cut(heights, mask, cut)
    found = Counter(map(turned, triangles_of(mesh)))
    assert found == Counter(map(turned, expected))


@given(terrain=slow.terrains(max_side=24), data=st.data())
def test_loose_mesh_covers_the_block_once_and_tells_its_error(terrain, data):
    heights, mask, _ = terrain
    trees = data.draw(slow.zero_trees(mask.shape))
    if trees is None:
        return
    found = loose_mesh(heights, mask, trees)
    worst = check_mesh(found.mesh, heights, mask)
    assert found.error == -(-worst.numerator // worst.denominator)
    before = triangles_of(mesh_of_cut(heights, mask, zero_tree_cut(trees, void_edges(mask))))
    n_bad = sum(slow.area(t) <= 0 for t in before)
    assert (found.n_folded > 0) == (n_bad > 0)


def test_one_significant_corner_of_a_hand_worked_block():
    # 3 x 3: the quad of samples 0-1 is split into four, the rest is as it was. By hand: samples
    # (0,0) (0,1) (1,0) (1,1) stay, (0,2) (1,2) -> (0,2), (2,0) (2,1) -> (2,0), (2,2) stays.
    trees = np.array([[0, 1, 2], [1, 1, 2], [2, 2, 2]], dtype=np.uint8)
    heights = np.arange(9, dtype=np.int32).reshape(3, 3)
    mask = np.ones((3, 3), dtype=bool)
    mesh = mesh_of_cut(heights, mask, zero_tree_cut(trees, ~mask))
    assert Counter(map(turned, triangles_of(mesh))) == Counter(
        [
            ((0, 0), (0, 1), (1, 1)), ((0, 0), (1, 1), (1, 0)),  # the quad itself
            ((0, 1), (0, 2), (1, 1)),  # (0,1) (1,2) (1,1); its other half is degenerate
            ((1, 0), (1, 1), (2, 0)),  # (1,0) (1,1) (2,1)
            ((0, 2), (2, 2), (1, 1)), ((1, 1), (2, 2), (2, 0)),
        ]
    )  # fmt: skip


def test_a_quad_with_one_void_corner_keeps_one_triangle():
    heights = np.zeros((2, 2), dtype=np.int32)
    for void in [(0, 0), (0, 1), (1, 0), (1, 1)]:
        mask = np.ones((2, 2), dtype=bool)
        mask[void] = False
        mesh = mesh_of_cut(heights, mask, np.zeros((2, 2), dtype=np.uint8))
        assert len(mesh.triangles) == 1
        check_mesh(mesh, heights, mask, 0)
