"""Maps of zero trees against the definition, node by node."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.coding.zerotrees import JS, JZTC, JZTR, grow_zero_trees, map_of_labels, tree_height


def slow_map(significant):
    """Grow maximal trees by looking at all descendants of each node, from the coarsest grid."""
    n_rows, n_cols = significant.shape
    top = 0
    while max(n_rows, n_cols) > 1 << top:
        top += 1
    trees = np.zeros(significant.shape, dtype=np.uint8)
    for height in range(top, -1, -1):
        size = 1 << height
        for row in range(0, n_rows, size):
            for col in range(0, n_cols, size):
                at = np.s_[row : row + size, col : col + size]
                if trees[row, col] == 0 and not significant[at].any():
                    trees[at] = height + 1
    return trees


@st.composite
def flags(draw):
    shape = draw(st.integers(1, 33)), draw(st.integers(1, 33))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return (rng.random(shape) < draw(st.sampled_from([0, 0.01, 0.1, 0.7, 1]))).astype(np.uint8)


@given(significant=flags())
def test_growing_matches_the_definition(significant):
    trees = significant.copy()
    grow_zero_trees(trees)
    np.testing.assert_array_equal(trees, slow_map(significant))


@pytest.mark.parametrize(
    ("shape", "height"), [((1, 1), 0), ((1, 2), 1), ((3, 1), 2), ((257, 2), 9), ((256, 256), 8)]
)
def test_tree_height_is_that_of_the_one_node_grid(shape, height):
    assert tree_height(*shape) == height


@given(significant=flags())
def test_labels_of_all_grids_make_the_same_map(significant):
    trees = slow_map(significant)
    n_rows, n_cols = significant.shape
    # The codec's trees have at least one transform, but any number of grids will do.
    count = int(tree_height(n_rows, n_cols)) + 1
    grids = []
    for height in range(count - 1, -1, -1):
        first = trees[:: 1 << height, :: 1 << height]
        grid = np.where(first <= height, JS, np.where(first == height + 1, JZTR, JZTC))
        grids.append(grid.astype(np.uint8).ravel())
    offsets = np.cumsum([0, *(grid.size for grid in grids)])
    back = np.empty_like(trees)
    map_of_labels(np.concatenate(grids), offsets, count, back)
    np.testing.assert_array_equal(back, trees)
