"""Nodes, labels and cuts, against hand-worked blocks and slow versions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tri import slow

from terrainwave.tri.quads import void_edges
from terrainwave.tri.zerotree import labels


@pytest.mark.parametrize(
    ("n", "height", "starts"),
    [
        (1, 0, [0]),
        (1, 3, [0]),
        (2, 0, [0, 1]),
        (5, 0, [0, 1, 2, 3, 4]),
        (5, 1, [0, 2, 4]),
        (5, 2, [0, 4]),
        # Clipped: samples 4 and 5 are a node, the last, 6, is another.
        (7, 1, [0, 2, 4, 6]),
        (7, 2, [0, 4, 6]),
        (6, 1, [0, 2, 4, 5]),
        (6, 2, [0, 4, 5]),
        (6, 3, [0, 5]),
    ],
)
def test_last_sample_is_a_node_of_its_own(n, height, starts):
    count = labels.axis_nodes(n, height)
    assert [labels.first_sample(i, n, height) for i in range(count)] == starts
    ends = [labels.end_sample(first, n, height) for first in starts]
    assert ends == [*starts[1:], n]
    for first, end in zip(starts, ends, strict=True):
        assert {labels.root_along(k, n, height) for k in range(first, end)} == {first}


@pytest.mark.parametrize(
    ("shape", "height"), [((1, 1), 0), ((2, 2), 0), ((3, 2), 1), ((257, 257), 8), ((258, 3), 9)]
)
def test_merging_stops_at_two_by_two(shape, height):
    assert labels.top_height(*shape) == height == slow.top_height(shape)


def test_the_cut_at_the_zero_trees_of_a_hand_worked_block():
    # 5 x 5 samples as Y10 figure 6: one significant finest node, (1, 2); all others as large as
    # they get. Height 1 pairs rows and columns (0 1)(2 3)(4), height 2 (0-3)(4).
    trees = np.array(
        [
            [2, 2, 1, 1, 3],
            [2, 2, 0, 1, 3],
            [2, 2, 2, 2, 3],
            [2, 2, 2, 2, 3],
            [3, 3, 3, 3, 3],
        ],
        dtype=np.uint8,
    )
    cut = labels.zero_tree_cut(trees, np.zeros((5, 5), dtype=bool))
    assert cut.tolist() == [
        [1, 1, 0, 0, 2],
        [1, 1, 0, 0, 2],
        [1, 1, 1, 1, 2],
        [1, 1, 1, 1, 2],
        [2, 2, 2, 2, 2],
    ]


@given(terrain=slow.terrains(), data=st.data())
def test_refining_gives_the_coarsest_cut_that_has_the_vertices(terrain, data):
    _, mask, _ = terrain
    trees = data.draw(slow.zero_trees(mask.shape))
    if trees is None:
        return
    rng = np.random.default_rng(mask.size)
    keep = rng.random(mask.shape) < data.draw(st.sampled_from([0, 0.02, 0.3]))
    free = labels.zero_tree_cut(trees, np.zeros_like(keep))
    cut = labels.refine(free, keep)
    # By definition, from the top: a node is taken where the free cut allows it and no sample but
    # its first is kept.
    expected = np.full(mask.shape, 255, dtype=np.uint8)
    for height in range(slow.top_height(mask.shape), -1, -1):
        for row, col, samples in slow.nodes(mask.shape, height):
            if expected[row, col] != 255 or any(free[p] < height for p in samples):
                continue
            if not any(keep[p] for p in samples if p != (row, col)):
                for p in samples:
                    expected[p] = height
    np.testing.assert_array_equal(cut, expected)
    assert (cut <= free).all()
    np.testing.assert_array_equal(labels.refine(cut, keep), cut)


@given(terrain=slow.terrains())
def test_void_edges_are_what_touches_a_missing_triangle(terrain):
    _, mask, _ = terrain
    expected = np.zeros(mask.shape, dtype=bool)
    for p in slow.at_void(mask):
        expected[p] = True
    np.testing.assert_array_equal(void_edges(mask), expected)
