"""The `cdf97` refiner: the bound, the borders, damage."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lone_units import (
    ALL_SHARED,
    NOT_SHARED,
    check_damaged,
    check_neighbours,
    check_refiner,
    hard_rasters,
    lone_spec,
    terrain,
)

from terrainwave.codec.cdf97.refiner import _HAS_COEFFS, Cdf97Refiner, _read_header
from terrainwave.codec.cdf97.zerotree import mark_labels, node_offsets
from terrainwave.codec.refiner import Sides
from terrainwave.coding.filters import lowpass_analysis
from terrainwave.coding.zerotrees import map_of_labels
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Grid


def check(spec, parent, target, mask=None):
    """Check everything promised; return the payload and the labels."""
    payload, _, labels = check_refiner(Cdf97Refiner(), spec, parent, target, mask)
    return payload, labels


def parent_of(target):
    shape = ((target.shape[0] + 1) // 2, (target.shape[1] + 1) // 2)
    return lowpass_analysis(target, (0, 0), target.shape, (0, 0), shape)


@pytest.mark.few(9)
@pytest.mark.parametrize("name", list(hard_rasters((2, 2), 1)))
@pytest.mark.parametrize("step", [1, 3, 21, (1 << 28) + 1])
def test_bound_holds_on(name, step):
    target = hard_rasters((17, 16), 1 << 29)[name]
    for shared in (NOT_SHARED, Sides(True, False, True, True)):
        check(lone_spec(target.shape, step, 2, shared), parent_of(target), target)
        check(lone_spec(target.shape, step, 0, shared, parent=False), None, target)


@pytest.mark.few(9)
@pytest.mark.parametrize("name", list(hard_rasters((2, 2), 1)))
@pytest.mark.parametrize("step", [1, 3, (1 << 28) + 1])
def test_bound_holds_in_faithful_files_on(name, step):
    target = hard_rasters((17, 16), 1 << 29)[name]
    mask = np.random.default_rng(1).random(target.shape) < 0.9
    for spec, parent in (
        (lone_spec(target.shape, step, shared=ALL_SHARED), parent_of(target)),
        (lone_spec(target.shape, step, parent=False), None),
    ):
        check(faithful(spec), parent, target, mask)


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


@pytest.mark.few(8)
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (1, 9), (8, 1), (2, 2), (3, 3), (5, 2)])
@pytest.mark.parametrize("shared", [NOT_SHARED, ALL_SHARED])
@pytest.mark.parametrize("has_parent", [False, True])
def test_tiny_regions_work(shape, shared, has_parent):
    if shared.top and min(shape) < 2:
        shared = Sides(True, True, False, False)
    target = terrain(shape)
    spec = lone_spec(shape, 3, 1, shared, has_parent)
    check(spec, parent_of(target) if has_parent else None, target)


@pytest.mark.parametrize("has_parent", [False, True])
def test_void_samples_promise_nothing_and_cost_no_residual(has_parent):
    target = terrain((33, 33))
    mask = np.random.default_rng(1).random(target.shape) < 0.5
    spec = lone_spec(target.shape, 3, 0, ALL_SHARED, has_parent)
    check(spec, parent_of(target) if has_parent else None, target, mask)
    check(spec, parent_of(target) if has_parent else None, target, np.zeros_like(mask))


def test_wrong_parent_still_gives_the_bound():
    target = terrain((33, 33))
    check(lone_spec(target.shape, 5), -parent_of(target) - 100_000, target)


@pytest.mark.large
@pytest.mark.parametrize("step", [1, 3])
def test_noise_costs_at_most_one_percent_more_than_plain_bits(step):
    rng = np.random.default_rng(5)
    target = rng.integers(0, step << 13, (65, 65), dtype=np.int32)
    payload, _ = check(lone_spec(target.shape, step, parent=False), None, target)
    assert len(payload) <= 1.01 * 13 * target.size / 8 + 8


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


@pytest.mark.few(8)
@pytest.mark.large
@pytest.mark.parametrize("rings", [1, 3])
@pytest.mark.parametrize("has_voids", [False, True])
@pytest.mark.parametrize(
    "size", [(33, 33), (49, 65), (34, 50), (18, 41), (65, 66), (3, 70), (1, 40), (131, 131)]
)
def test_neighbours_decode_the_same_bits_in_any_order(size, rings, has_voids):
    grid = Grid(*size, 8)
    levels = [terrain(size, seed=7)]
    for level in range(grid.k_max - 1, -1, -1):
        fine = levels[-1]
        levels.append(lowpass_analysis(fine, (0, 0), fine.shape, (0, 0), grid.level_shape(level)))
    levels.reverse()
    rng = np.random.default_rng(11)
    masks = [rng.random(level.shape) < (0.7 if has_voids else 2) for level in levels]
    # In faithful files, those with a void of the file.
    check_neighbours(Cdf97Refiner(), grid, levels, rings, 0, masks, is_faithful=has_voids)


@cache
def small_payload(*, is_faithful=False):
    target = terrain((21, 18))
    spec = lone_spec(target.shape, 5, 0, Sides(True, False, False, True))
    spec = faithful(spec) if is_faithful else spec
    parent, mask = parent_of(target), np.ones(target.shape, dtype=bool)
    payload, _, _ = Cdf97Refiner().encode(spec, parent, target, mask)
    return spec, parent, mask, payload


def test_prefixes_are_rejected():
    # Nothing but a checksum (the container's) can tell all: decoding a prefix may by chance need
    # exactly its bytes.
    spec, parent, mask, payload = small_payload()
    n_accepted = 0
    for length in range(len(payload)):
        try:
            Cdf97Refiner().decode(spec, parent, mask, payload[:length])
        except CorruptStreamError:
            continue
        n_accepted += 1
    assert n_accepted <= 1


def test_an_extra_byte_is_rejected():
    spec, parent, mask, payload = small_payload()
    with pytest.raises(CorruptStreamError):
        Cdf97Refiner().decode(spec, parent, mask, payload + b"\0")


@pytest.mark.parametrize("is_faithful", [False, True])
def test_every_flipped_byte_gives_heights_or_our_own_error(is_faithful):
    spec, parent, mask, payload = small_payload(is_faithful=is_faithful)
    for pos in range(len(payload)):
        for change in (1, 128, 255):
            broken = bytearray(payload)
            broken[pos] ^= change
            check_damaged(Cdf97Refiner(), spec, parent, mask, bytes(broken))


@given(
    st.binary(max_size=80),
    st.booleans(),
    st.sampled_from([1, 3, 1001, (1 << 29) + 1]),
    st.booleans(),
)
def test_any_bytes_give_heights_or_our_own_error(payload, has_parent, step, is_faithful):
    spec, parent, mask, _ = small_payload()
    spec = dataclasses.replace(spec, step=step)
    spec = faithful(spec) if is_faithful else spec
    if not has_parent:
        spec, parent = dataclasses.replace(spec, parent_region=None), None
    check_damaged(Cdf97Refiner(), spec, parent, mask, payload)
