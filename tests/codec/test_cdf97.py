"""The `cdf97` refiner: labels and coefficients; what it shares is in `test_refiners`."""

import dataclasses

import numpy as np
import pytest
from lone_units import (
    check_refiner,
    lone_spec,
    terrain,
)

from terrainwave.codec.cdf97.refiner import _HAS_COEFFS, Cdf97Refiner, _read_header
from terrainwave.codec.cdf97.zerotree import mark_labels, node_offsets
from terrainwave.coding.filters import lowpass_analysis
from terrainwave.coding.zerotrees import map_of_labels


def check(spec, parent, target, mask=None):
    """Check everything promised; return the payload and the labels."""
    payload, _, labels = check_refiner(Cdf97Refiner(), spec, parent, target, mask)
    return payload, labels


def parent_of(target):
    shape = ((target.shape[0] + 1) // 2, (target.shape[1] + 1) // 2)
    return lowpass_analysis(target, (0, 0), target.shape, (0, 0), shape)


def faithful(spec, *, is_finest=False):
    is_coarse = not is_finest and spec.step > 1
    return dataclasses.replace(spec, is_faithful=True, has_coarse_residuals=is_coarse)


@pytest.mark.parametrize("parent", [False, True])
@pytest.mark.parametrize("is_finest", [False, True])
def test_faithful_units_have_coefficients_of_one_step_where_others_have_none(parent, is_finest):
    # A plane whose residuals are small: coefficients don't pay, and cdf97 would have none.
    target = terrain((33, 33), relief=1)
    spec = faithful(lone_spec(target.shape, 3, parent=parent), is_finest=is_finest)
    payload, _ = check(spec, parent_of(target) if parent else None, target)
    coding, _ = _read_header(payload)
    assert coding.flags & _HAS_COEFFS
    assert coding.step_code == 36  # 2.25 (delta + p / 2), in 1/16


def test_a_plane_above_costs_a_few_bytes():
    rows, cols = np.mgrid[:129, :129]
    plane = (6 * rows - 4 * cols).astype(np.int32)
    payload, labels = check(lone_spec(plane.shape, 3), np.ascontiguousarray(plane[::2, ::2]), plane)
    assert len(payload) <= 3
    np.testing.assert_array_equal(labels, np.full((65, 65), 7 + 1))


def test_labels_are_those_of_the_coded_trees():
    target = terrain((33, 29), relief=0)
    target[9:20, 3:8] += 500
    _, trees = check(lone_spec(target.shape, 3), parent_of(target), target)
    assert trees.shape == (17, 15)
    assert trees.min() == 0
    assert trees.max() > 1
    # Every node above a significant one is JS (others may be, by a coefficient of their own).
    for height in range(1, 6):
        size = 1 << height
        for row in range(0, 17, size):
            for col in range(0, 15, size):
                below = trees[row : row + size, col : col + size]
                assert trees[row, col] <= height or (below > 0).all()
                assert trees[row, col] <= height or (below == trees[row, col]).all()


def test_a_coefficient_makes_its_node_and_all_above_significant():
    quants = np.zeros((33, 29), dtype=np.int32)
    # Transform 0 keeps 17 low rows, here at even rows, and 15 low columns in front: HL (5, 3).
    quants[2 * 5, 15 + 3] = -2
    offsets = np.zeros(32, dtype=np.int64)
    count = node_offsets(33, 29, offsets)
    labels = np.zeros(offsets[count], dtype=np.uint8)
    assert mark_labels(quants, offsets, labels) == count
    trees = np.empty((17, 15), dtype=np.uint8)
    map_of_labels(labels, offsets, count, trees)
    assert trees[5, 3] == 0
    assert (trees == 0).sum() == 1
    # Beside it on each height a sibling of that height, by hand: node (5, 3) of height 0 lies in
    # (2, 1), (1, 0), (0, 0), (0, 0), (0, 0).
    assert trees[4, 2] == trees[4, 3] == trees[5, 2] == 0 + 1
    assert trees[4, 0] == trees[6, 0] == trees[6, 2] == 1 + 1
    assert trees[0, 0] == trees[0, 4] == trees[4, 4] == 2 + 1
    assert trees[0, 8] == trees[8, 0] == trees[8, 8] == 3 + 1
    assert trees[16, 0] == 4 + 1


@pytest.mark.large
def test_smaller_than_raw_by_far_on_smooth_terrain():
    target = terrain((257, 257), relief=2000)
    payload, _ = check(lone_spec(target.shape, 7, 1), parent_of(target), target)
    assert len(payload) * 8 / target.size < 1.0
