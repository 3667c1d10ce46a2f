"""Algorithm I against its slow version and the rasteriser."""

import numpy as np
import pytest
from cases import some
from hypothesis import given, settings
from hypothesis import strategies as st
from tri import slow
from tri.rasterise import check_mesh

from terrainwave.tri.zerotree.connect import mesh_error, mesh_of_cut
from terrainwave.tri.zerotree.guarantee import guaranteed_cut


def whole(shape):
    return np.ones(shape, dtype=bool)


@given(terrain=slow.terrains(max_side=11), data=st.data())
@settings(max_examples=150)
def test_cut_is_that_of_the_slow_version(terrain, data):
    heights, mask, tolerance = terrain
    trees = data.draw(slow.zero_trees(mask.shape))
    keep = None
    if data.draw(st.booleans()):
        keep = np.random.default_rng(mask.size).random(mask.shape) < 0.05
    cut = guaranteed_cut(heights, mask, tolerance, trees, keep)
    expected = slow.algorithm_1(heights, mask, tolerance, trees, keep)
    np.testing.assert_array_equal(cut, expected)


@given(terrain=slow.terrains(max_side=40))
def test_mesh_holds_the_tolerance_and_covers_the_block_once(terrain):
    heights, mask, tolerance = terrain
    cut = guaranteed_cut(heights, mask, tolerance)
    mesh = mesh_of_cut(heights, mask, cut)
    worst = check_mesh(mesh, heights, mask, tolerance)
    assert mesh_error(heights, mesh) == -(-worst.numerator // worst.denominator)


def test_flat_block_is_two_triangles():
    heights = np.full((33, 33), 9, dtype=np.int32)
    mesh = mesh_of_cut(heights, whole(heights.shape), guaranteed_cut(heights, heights == 9, 0))
    assert len(mesh.triangles) == 2
    assert sorted(zip(mesh.rows.tolist(), mesh.cols.tolist(), strict=True)) == [
        (0, 0), (0, 64), (64, 0), (64, 64),
    ]  # fmt: skip
    assert (mesh.heights == 9 * 16).all()


def test_bound_is_closed_and_exact():
    # The spike at (1, 1) is on the diagonal, whose ends are 0: it deviates by exactly 5.
    heights = np.zeros((3, 3), dtype=np.int32)
    heights[1, 1] = 5
    mask = whole(heights.shape)
    assert guaranteed_cut(heights, mask, 5 * 16).min() == 1
    assert guaranteed_cut(heights, mask, 5 * 16 - 1)[0, 0] == 0


def test_a_significant_node_is_not_merged():
    # One JS node of height 1 in the middle of a flat block: Algorithm I, step 2.1.1.
    heights = np.zeros((9, 9), dtype=np.int32)
    trees = np.full((9, 9), 4, dtype=np.uint8)
    trees[:8, :8] = 3
    trees[:4, :4] = 2
    trees[2:4, 2:4] = [[0, 1], [1, 1]]
    cut = guaranteed_cut(heights, whole((9, 9)), 0, trees)
    assert cut[2:4, 2:4].tolist() == [[0, 0], [0, 0]]
    assert cut[0, 0] == cut[0, 2] == cut[2, 0] == 1
    assert cut[0, 4] == cut[4, 0] == cut[4, 4] == 2


def test_kept_samples_are_vertices():
    heights = np.zeros((17, 17), dtype=np.int32)
    keep = np.zeros((17, 17), dtype=bool)
    keep[0, 5] = keep[16, 9] = keep[7, 11] = True
    mesh = mesh_of_cut(
        heights, whole(keep.shape), guaranteed_cut(heights, keep | True, 0, None, keep)
    )
    places = set(zip((mesh.rows // 2).tolist(), (mesh.cols // 2).tolist(), strict=True))
    assert {(0, 5), (16, 9), (7, 11)} <= places
    check_mesh(mesh, heights, whole(keep.shape), 0)


@pytest.mark.parametrize("value", [-(1 << 30), 1 << 30])
def test_heights_in_voids_do_not_matter(value):
    rng = np.random.default_rng(1)
    heights = rng.integers(-5, 5, (33, 21)).astype(np.int32)
    mask = rng.random(heights.shape) > 0.05
    expected = guaranteed_cut(heights, mask, 40)
    heights[~mask] = value
    np.testing.assert_array_equal(guaranteed_cut(heights, mask, 40), expected)


@pytest.mark.large
@pytest.mark.parametrize("side", some([65, 33, 129], 3))
def test_extreme_heights_at_block_sides_do_not_overflow(side):
    rng = np.random.default_rng(side)
    heights = rng.choice([-(1 << 30), 1 << 30], (side, side)).astype(np.int32)
    heights[: side // 2] = 1 << 30
    mask = whole(heights.shape)
    mesh = mesh_of_cut(heights, mask, guaranteed_cut(heights, mask, 1 << 33))
    check_mesh(mesh, heights, mask, 1 << 33)
