"""Zero trees of difference layers: what is significant, and what voids do."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.tri.zerotree.layer_trees import layer_trees

pytestmark = pytest.mark.slow_compile


def trees_of(heights, finer, tolerance, mask=None, finer_mask=None):
    mask = np.ones(heights.shape, bool) if mask is None else mask
    finer_mask = np.ones(finer.shape, bool) if finer_mask is None else finer_mask
    return layer_trees(heights, mask, finer, finer_mask, tolerance)


def ramp(n_rows, n_cols, stride):
    row, col = np.indices((n_rows, n_cols), dtype=np.int32)
    return (7 * row + 12 * col) * stride


@pytest.mark.parametrize("shape", [(17, 17), (9, 6), (2, 2)])
@pytest.mark.parametrize("odd", [0, 1])
def test_a_plane_has_one_zero_tree(shape, odd):
    finer = ramp(2 * shape[0] - 1 + odd, 2 * shape[1] - 1 + odd, 1)
    trees = trees_of(ramp(*shape, 2), finer, 16)
    assert len(np.unique(trees)) == 1
    assert trees.min() >= 1


def test_a_spike_is_significant_at_its_node_and_above():
    heights, finer = ramp(17, 17, 2), ramp(33, 33, 1)
    finer[13, 21] += 100
    trees = trees_of(heights, finer, 16 * 40)
    assert trees[6, 10] == 0
    # Every node above holds it; far from it there are trees as large as they can be.
    assert all(trees[6 >> h << h, 10 >> h << h] <= h for h in range(5))
    assert trees[0, 0] == trees[15, 0] == 4
    assert trees_of(heights, finer, 16 * 400).min() >= 1


@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(1, 20), cols=st.integers(1, 20))
def test_a_larger_tolerance_gives_larger_trees(seed, rows, cols):
    rng = np.random.default_rng(seed)
    finer = rng.integers(-50, 50, (2 * rows, 2 * cols)).astype(np.int32)
    small, large = (trees_of(finer[::2, ::2], finer, tolerance) for tolerance in (100, 400))
    assert (small <= large).all()


def test_voids_hold_nothing_and_hide_what_is_predicted_from_them():
    heights, finer = ramp(17, 17, 2), ramp(33, 33, 1)
    mask, finer_mask = np.ones((17, 17), bool), np.ones((33, 33), bool)
    mask[8, 8] = False
    finer_mask[15:18, 15:18] = False
    heights[8, 8] = finer[16, 16] = -(1 << 30)
    finer[15, 16] = 1 << 30
    trees = trees_of(heights, finer, 1, mask, finer_mask)
    assert trees.min() >= 1


def test_heights_at_their_limits_are_taken():
    heights = np.where(np.indices((9, 9)).sum(0) % 2, 1 << 30, -(1 << 30)).astype(np.int32)
    finer = -heights.repeat(2, 0).repeat(2, 1)
    assert trees_of(heights, finer, 0).max() == 0
    assert trees_of(heights, finer, 1 << 40).min() >= 1
