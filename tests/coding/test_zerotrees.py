"""Maps of zero trees against the definition, node by node."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.coding.filters import n_transforms
from terrainwave.coding.zerotrees import (
    JS,
    JZTC,
    JZTR,
    map_of_labels,
    mark_zero_trees,
    tree_height,
)


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


@given(shape=st.tuples(st.integers(1, 40), st.integers(1, 40)), seed=st.integers(0, 2**32 - 1))
def test_coefficients_mark_their_nodes_and_all_above(shape, seed):
    rng = np.random.default_rng(seed)
    field = np.zeros(shape, dtype=np.int64)
    count = int(n_transforms(*shape))
    thresholds = rng.integers(2, 9, (count, 4))
    significant = []
    for t in range(count):
        n_rows, n_cols = ((side - 1 >> t) + 1 for side in shape)
        nodes = np.zeros(((n_rows + 1) // 2, (n_cols + 1) // 2), dtype=bool)
        for i, j in np.ndindex(nodes.shape):
            # Low-pass columns are in front; rows stay where they are.
            places = {
                1: (2 * i, nodes.shape[1] + j),
                2: (2 * i + 1, j),
                3: (2 * i + 1, nodes.shape[1] + j),
            }
            for band, (row, col) in places.items():
                if row < n_rows and col < n_cols and rng.random() < 0.1:
                    size = thresholds[t, band] - rng.integers(0, 2)
                    field[row << t, col] = rng.choice([-1, 1]) * size
                    nodes[i, j] |= size == thresholds[t, band]
        significant.append(nodes)
    trees = np.empty(significant[0].shape, dtype=np.uint8)
    mark_zero_trees(field, thresholds, trees)
    is_js = significant[0]
    for height in range(count):
        if height:
            below = np.pad(is_js, [(0, side % 2) for side in is_js.shape])
            is_js = significant[height] | below.reshape(
                below.shape[0] // 2, 2, below.shape[1] // 2, 2
            ).any((1, 3))
        step = 1 << height
        np.testing.assert_array_equal(trees[::step, ::step] <= height, is_js)
