"""What `predictive` and `rapid` have in common: the bound, the borders, voids, damage."""

import dataclasses
import itertools
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lone_units import (
    ALL_SHARED,
    BIG,
    NOT_SHARED,
    check_damaged,
    check_neighbours,
    check_refiner,
    coarse_of,
    hard_rasters,
    lone_spec,
    terrain,
)

from terrainwave.codec.predictive.refiner import PredictiveRefiner
from terrainwave.codec.rapid.refiner import RapidRefiner
from terrainwave.codec.refiner import Sides
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Grid

# Compiling the kernels of `rapid` for lone units takes a minute: `make test-all`.
REFINERS = [
    pytest.param(PredictiveRefiner, id="predictive"),
    pytest.param(RapidRefiner, id="rapid", marks=pytest.mark.full),
]
each_refiner = pytest.mark.parametrize("refiner", REFINERS)


def check(refiner, spec, parent, target, mask=None):
    """Check everything promised; return the payload and the heights."""
    payload, heights, labels = check_refiner(refiner(), spec, parent, target, mask)
    if refiner is RapidRefiner:
        assert labels is None
    else:
        assert (labels is None) == (parent is None)
        assert labels is None or labels.shape == parent.shape
    return payload, heights


@pytest.mark.few(9)
@each_refiner
@pytest.mark.parametrize("name", list(hard_rasters((2, 2), 1)))
@pytest.mark.parametrize("step", [1, 3, 21, (1 << 28) + 1])
@pytest.mark.parametrize("effort", [pytest.param(0, marks=pytest.mark.full), 1])
def test_bound_holds_on(refiner, name, step, effort):
    target = hard_rasters((17, 16), BIG)[name]
    for shared in (NOT_SHARED, Sides(True, False, True, True)):
        check(
            refiner, lone_spec(target.shape, step, effort, shared), coarse_of(target, step), target
        )
        check(refiner, lone_spec(target.shape, step, effort, shared, parent=False), None, target)


@pytest.mark.few(11)
@each_refiner
@pytest.mark.parametrize(
    "shape",
    [(1, 1), (1, 2), (2, 1), (1, 9), (8, 1), (2, 2), (3, 3), (5, 2), (1, 33), (33, 3), (12, 40)],
)
@pytest.mark.parametrize("shared", [NOT_SHARED, ALL_SHARED])
@pytest.mark.parametrize("has_parent", [False, True])
def test_tiny_regions_work(refiner, shape, shared, has_parent):
    if shared.top and min(shape) < 2:
        shared = Sides(True, True, False, False)
    target = terrain(shape)
    spec = lone_spec(shape, 3, 1, shared, has_parent)
    check(refiner, spec, coarse_of(target, 3) if has_parent else None, target)


@each_refiner
@pytest.mark.parametrize("has_parent", [False, True])
def test_void_samples_promise_nothing(refiner, has_parent):
    target = terrain((33, 33))
    mask = np.random.default_rng(1).random(target.shape) < 0.5
    spec = lone_spec(target.shape, 3, 1, ALL_SHARED, has_parent)
    parent = coarse_of(target, 3) if has_parent else None
    check(refiner, spec, parent, target, mask)
    check(refiner, spec, parent, np.where(mask, target, 77_777).astype(np.int32), mask)
    check(refiner, spec, parent, target, np.zeros_like(mask))


@each_refiner
def test_even_samples_are_the_parents(refiner):
    target = terrain((33, 29))
    parent = coarse_of(target, 9)
    _, heights = check(refiner, lone_spec(target.shape, 9, 1, ALL_SHARED), parent, target)
    np.testing.assert_array_equal(heights[::2, ::2], parent)


@each_refiner
def test_wrong_parent_still_gives_the_bound_elsewhere(refiner):
    target = terrain((33, 33))
    spec = lone_spec(target.shape, 5)
    parent = -coarse_of(target, 5) - 100_000
    mask = np.ones(target.shape, dtype=bool)
    _, heights, _ = refiner().encode(spec, parent, target, mask)
    error = np.abs(heights.astype(np.int64) - target)
    error[::2, ::2] = 0
    assert error.max() <= 2


@each_refiner
def test_a_plane_costs_next_to_nothing(refiner):
    rows, cols = np.mgrid[:129, :129]
    plane = (6 * rows - 4 * cols).astype(np.int32)
    parent = np.ascontiguousarray(plane[::2, ::2])
    payload, _ = check(refiner, lone_spec(plane.shape, 3), parent, plane)
    assert len(payload) <= (60 if refiner is PredictiveRefiner else 129 * 129 // 30)


@each_refiner
@pytest.mark.parametrize("step", [1, 3])
def test_noise_costs_little_more_than_plain_bits(refiner, step):
    rng = np.random.default_rng(5)
    target = rng.integers(0, step << 13, (65, 65), dtype=np.int32)
    payload, _ = check(refiner, lone_spec(target.shape, step, parent=False), None, target)
    # Trained frequencies of `rapid` fall off like those of details of terrain, noise has all alike:
    # 1.55.
    most = 1.07 if refiner is PredictiveRefiner else 1.6
    assert len(payload) <= most * 13 * target.size / 8 + 8


@pytest.mark.few(8)
@pytest.mark.large
@pytest.mark.parametrize(
    ("refiner", "rings"),  # the default has no rings
    [
        pytest.param(*each.values, n, id=f"{each.id}-{n}", marks=each.marks)
        for each in REFINERS
        for n in ((1,) if each.id == "rapid" else (1, 3))
    ],
)
@pytest.mark.parametrize("has_voids", [False, True])
@pytest.mark.parametrize(
    "size", [(33, 33), (49, 65), (34, 50), (18, 41), (65, 66), (3, 70), (1, 40), (131, 131)]
)
def test_neighbours_decode_the_same_bits_in_any_order(refiner, size, rings, has_voids):
    grid = Grid(*size, 8)
    levels = [terrain(size, seed=7)]
    for _ in range(grid.k_max):
        levels.append(np.ascontiguousarray(levels[-1][::2, ::2]))
    levels.reverse()
    rng = np.random.default_rng(11)
    masks = [rng.random(level.shape) < (0.7 if has_voids else 2) for level in levels]
    for above, mask in itertools.pairwise(masks):
        mask[::2, ::2] &= above  # a sample valid here was valid there
    check_neighbours(refiner(), grid, levels, rings, 1, masks)


@cache
def small_payload(refiner):
    target = terrain((21, 18))
    spec = lone_spec(target.shape, 5, 1, Sides(True, False, False, True))
    parent, mask = coarse_of(target, 5), np.ones(target.shape, dtype=bool)
    payload, _, _ = refiner().encode(spec, parent, target, mask)
    return spec, parent, mask, payload


@each_refiner
def test_every_prefix_is_rejected(refiner):
    spec, parent, mask, payload = small_payload(refiner)
    for length in range(len(payload)):
        with pytest.raises(CorruptStreamError):
            refiner().decode(spec, parent, mask, payload[:length])


@each_refiner
def test_an_extra_byte_is_rejected(refiner):
    spec, parent, mask, payload = small_payload(refiner)
    with pytest.raises(CorruptStreamError):
        refiner().decode(spec, parent, mask, payload + b"\0")


@each_refiner
def test_every_flipped_byte_gives_heights_or_our_own_error(refiner):
    spec, parent, mask, payload = small_payload(refiner)
    for pos in range(len(payload)):
        for change in (1, 128, 255):
            broken = bytearray(payload)
            broken[pos] ^= change
            check_damaged(refiner(), spec, parent, mask, bytes(broken))


@each_refiner
@pytest.mark.large
@pytest.mark.parametrize("z_max", [5000, BIG])
def test_flipped_bytes_in_a_large_unit_give_heights_or_our_own_error(refiner, z_max):
    target = terrain((135, 140))
    spec = dataclasses.replace(lone_spec(target.shape, 3), z_min=-z_max, z_max=z_max)
    parent, mask = coarse_of(target, 3), np.ones(target.shape, dtype=bool)
    payload, _, _ = refiner().encode(spec, parent, target, mask)
    for pos in range(0, len(payload), 11):
        broken = bytearray(payload)
        broken[pos] ^= 255
        check_damaged(refiner(), spec, parent, mask, bytes(broken))


@each_refiner
@given(
    st.binary(max_size=80),
    st.booleans(),
    st.sampled_from([1, 3, 1001, (1 << 29) + 1]),
    st.booleans(),
)
def test_any_bytes_give_heights_or_our_own_error(refiner, payload, has_parent, step, has_header):
    spec, parent, mask, _ = small_payload(refiner)
    spec = dataclasses.replace(spec, step=step)
    if not has_parent:
        spec, parent = dataclasses.replace(spec, parent_region=None), None
    if has_header:  # of `rapid`: a single state, no words: all the rest are raw bits
        n_raw = max(len(payload) - 4, 0)
        payload = bytes([is_narrow := step < 1000, *([] if is_narrow else [9]), 0, n_raw]) + payload
    check_damaged(refiner(), spec, parent, mask, payload)
