"""The `cdf97` refiner: the bound, the borders, damage."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.codec.cdf97 import Cdf97
from terrainwave.codec.refiner import GroupSpec, Sides
from terrainwave.codec.zerotree import mark_labels, node_offsets
from terrainwave.coding.filters import lowpass_analysis
from terrainwave.coding.zerotrees import map_of_labels
from terrainwave.errors import CorruptStreamError
from terrainwave.quadtree import Grid, Region

NOT_SHARED = Sides(False, False, False, False)


def lone_spec(shape, step=3, effort=0, shared=NOT_SHARED, parent=True):
    core = Region(0, 0, *shape)
    above = Region(0, 0, (shape[0] + 1) // 2, (shape[1] + 1) // 2) if parent else None
    big = 1 << 30
    return GroupSpec(1, core, core, above, shared, step, -big, big, (1, 0), 1, effort)


def check(spec, parent, target, mask=None):
    """Encode, decode, check everything promised; return the payload and the labels."""
    mask = np.ones(target.shape, dtype=bool) if mask is None else mask
    refiner = Cdf97()
    payload, heights, labels = refiner.encode(spec, parent, target, mask)
    back, back_labels = refiner.decode(spec, parent, mask, payload)
    assert back.dtype == np.int32
    np.testing.assert_array_equal(back, heights)
    error = np.abs(back.astype(np.int64) - target)[mask]
    assert error.max(initial=0) <= spec.half
    assert (labels is None) == (back_labels is None)
    if labels is not None:
        np.testing.assert_array_equal(labels, back_labels)
    return payload, labels


def parent_of(target):
    shape = ((target.shape[0] + 1) // 2, (target.shape[1] + 1) // 2)
    return lowpass_analysis(target, (0, 0), target.shape, (0, 0), shape)


def terrain(shape, seed=0, relief=400):
    """Return smooth random heights with some noise, the same for every machine."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    heights = np.zeros(shape)
    for wave in (3.0, 7.0, 19.0, 53.0):
        a, b, c = rng.uniform(0, 6.28, 3)
        heights += (
            relief * wave / 53 * np.sin(rows / wave + a) * np.cos(cols / wave * np.sin(c) + b)
        )
    return np.rint(heights + rng.normal(0, 1, shape)).astype(np.int32)


def hard_rasters(shape):
    rng = np.random.default_rng(3)
    spike = np.zeros(shape, dtype=np.int32)
    spike[shape[0] // 2, shape[1] // 3] = 1 << 29
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    return {
        "constant": np.full(shape, 1234, dtype=np.int32),
        "lowest": np.full(shape, -(1 << 29), dtype=np.int32),
        "spike": spike,
        "checkerboard": np.where((rows + cols) & 1, 1 << 29, -(1 << 29)).astype(np.int32),
        "stripes": np.where(rows & 1, 1 << 29, -(1 << 29)).astype(np.int32),
        "noise": rng.integers(-(1 << 29), 1 << 29, shape, dtype=np.int32),
        "mild noise": rng.integers(-9, 9, shape, dtype=np.int32),
        "ramp": (17 * rows - 5 * cols).astype(np.int32),
        "terrain": terrain(shape),
    }


@pytest.mark.parametrize("name", list(hard_rasters((2, 2))))
@pytest.mark.parametrize("step", [1, 3, 21, (1 << 28) + 1])
def test_bound_holds_on(name, step):
    target = hard_rasters((17, 16))[name]
    for shared in (NOT_SHARED, Sides(True, False, True, True)):
        check(lone_spec(target.shape, step, 2, shared), parent_of(target), target)
        check(lone_spec(target.shape, step, 0, shared, parent=False), None, target)


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (1, 9), (8, 1), (2, 2), (3, 3), (5, 2)])
@pytest.mark.parametrize("shared", [NOT_SHARED, Sides(True, True, True, True)])
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
    spec = lone_spec(target.shape, 3, 0, Sides(True, True, True, True), has_parent)
    check(spec, parent_of(target) if has_parent else None, target, mask)
    check(spec, parent_of(target) if has_parent else None, target, np.zeros_like(mask))


def test_wrong_parent_still_gives_the_bound():
    target = terrain((33, 33))
    check(lone_spec(target.shape, 5), -parent_of(target) - 100_000, target)


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


# Groups next to each other ---------------------------------------------------------------------


def arrangement(n_rows, n_cols, block, rings, step):
    """Return the grid, its pyramid and a maker of specs for all units."""
    grid = Grid(n_rows, n_cols, block)
    levels = [terrain((n_rows, n_cols), seed=7)]
    for level in range(grid.k_max - 1, -1, -1):
        fine = levels[-1]
        levels.append(lowpass_analysis(fine, (0, 0), fine.shape, (0, 0), grid.level_shape(level)))
    levels.reverse()

    def spec_of(level, block_):
        apron = rings >> 1
        if level == 0:
            core, region = grid.block_region(block_), grid.block_region(block_, apron)
            above = None
        else:
            core, region = grid.group_region(block_), grid.group_region(block_, apron)
            above = grid.block_region(block_, apron)
        rows, cols = grid.level_blocks(block_.level)
        shared = Sides(block_.row > 0, block_.col > 0, block_.row + 1 < rows, block_.col + 1 < cols)
        big = 1 << 30
        return GroupSpec(level, core, region, above, shared, step, -big, big, (1, 0), rings, 0)

    return grid, levels, spec_of


@pytest.mark.large
@pytest.mark.parametrize("rings", [1, 3])
@pytest.mark.parametrize("has_voids", [False, True])
@pytest.mark.parametrize(
    "size", [(33, 33), (49, 65), (34, 50), (18, 41), (65, 66), (3, 70), (1, 40), (131, 131)]
)
def test_neighbours_decode_the_same_bits_in_any_order(size, rings, has_voids):
    grid, levels, spec_of = arrangement(*size, 8, rings, 5)
    rng = np.random.default_rng(11)
    above = None
    for level in range(grid.k_max + 1):
        target = levels[level]
        mask = rng.random(target.shape) < 0.7 if has_voids else np.ones(target.shape, dtype=bool)
        whole = Region(0, 0, *target.shape)
        decoded = np.zeros(target.shape, dtype=np.int32)
        writers = np.zeros(target.shape, dtype=np.int64)
        units = grid.blocks(max(level - 1, 0))
        for index in rng.permutation(len(units)):
            spec = spec_of(level, units[index])
            at = spec.region.slices_in(whole)
            parent = None
            if level > 0:
                parent = above[spec.parent_region.slices_in(Region(0, 0, *above.shape))]
            refiner = Cdf97()
            payload, heights, _ = refiner.encode(spec, parent, target[at], mask[at])
            back, _ = refiner.decode(spec, parent, mask[at], payload)
            np.testing.assert_array_equal(back, heights)
            seen = writers[at] > 0
            np.testing.assert_array_equal(decoded[at][seen], heights[seen])
            decoded[at] = heights
            writers[at] += 1
        assert (writers > 0).all()
        if len(units) > 1:
            assert (writers > 1).any()
        assert np.abs(decoded.astype(np.int64) - target)[mask].max(initial=0) <= 2
        above = decoded


# Damage ----------------------------------------------------------------------------------------


def damaged(spec, parent, mask, payload):
    try:
        heights, _ = Cdf97().decode(spec, parent, mask, payload)
    except CorruptStreamError:
        return
    assert heights.shape == spec.region.shape
    assert np.abs(heights.astype(np.int64)).max() <= 1 << 30


def small_payload():
    target = terrain((21, 18))
    spec = lone_spec(target.shape, 5, 0, Sides(True, False, False, True))
    parent, mask = parent_of(target), np.ones(target.shape, dtype=bool)
    payload, _, _ = Cdf97().encode(spec, parent, target, mask)
    return spec, parent, mask, payload


def test_every_prefix_is_rejected():
    spec, parent, mask, payload = small_payload()
    for length in range(len(payload)):
        with pytest.raises(CorruptStreamError):
            Cdf97().decode(spec, parent, mask, payload[:length])


def test_an_extra_byte_is_rejected():
    spec, parent, mask, payload = small_payload()
    with pytest.raises(CorruptStreamError):
        Cdf97().decode(spec, parent, mask, payload + b"\0")


def test_every_flipped_byte_gives_heights_or_our_own_error():
    spec, parent, mask, payload = small_payload()
    for pos in range(len(payload)):
        for change in (1, 128, 255):
            broken = bytearray(payload)
            broken[pos] ^= change
            damaged(spec, parent, mask, bytes(broken))


@given(st.binary(max_size=80), st.booleans(), st.sampled_from([1, 3, 1001, (1 << 29) + 1]))
def test_any_bytes_give_heights_or_our_own_error(payload, has_parent, step):
    spec, parent, mask, _ = SMALL
    spec = dataclasses.replace(spec, step=step)
    if not has_parent:
        spec, parent = dataclasses.replace(spec, parent_region=None), None
    damaged(spec, parent, mask, payload)


SMALL = small_payload()
