"""What `predictive`, `rapid` and `cdf97` have in common: the bound, borders, voids, damage."""

import contextlib
import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

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

from terrainwave.codec.cdf97.refiner import Cdf97Refiner
from terrainwave.codec.predictive.refiner import PredictiveRefiner
from terrainwave.codec.rapid.refiner import RapidRefiner
from terrainwave.codec.refiner import Sides
from terrainwave.coding.filters import lowpass_analysis
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Grid


class Kind(NamedTuple):
    """A refiner, its parents of a unit's heights, and how much a plane and noise may take."""

    refiner: type
    parent_of: Callable
    most_of_plane: float
    most_of_noise: float
    is_faithful: bool = False

    def spec(self, *arguments, **options):
        spec = lone_spec(*arguments, **options)
        coarse = self.is_faithful and spec.step > 1
        return replace(spec, is_faithful=self.is_faithful, has_coarse_residuals=coarse)

    def check(self, spec, parent, target, mask=None):
        """Check everything promised; return the payload and the heights."""
        payload, heights, labels = check_refiner(self.refiner(), spec, parent, target, mask)
        assert labels is None or self.refiner is Cdf97Refiner
        assert labels is None or parent is None or labels.shape == parent.shape
        return payload, heights


def lowpass_of(target, _step):
    shape = (target.shape[0] + 1) // 2, (target.shape[1] + 1) // 2
    return lowpass_analysis(target, (0, 0), target.shape, (0, 0), shape)


# Trained frequencies of `rapid` fall off like those of details of terrain, noise has all alike:
# 1.55. Compiling its kernels for lone units takes a minute: `make test-all`.
KINDS = [
    pytest.param(Kind(PredictiveRefiner, coarse_of, 60, 1.07), id="predictive"),
    pytest.param(Kind(Cdf97Refiner, lowpass_of, 3, 1.01), id="cdf97"),
    pytest.param(Kind(Cdf97Refiner, lowpass_of, np.inf, np.inf, True), id="faithful"),
    pytest.param(
        Kind(RapidRefiner, coarse_of, 129 * 129 // 30, 1.6), id="rapid", marks=pytest.mark.full
    ),
]
each_kind = pytest.mark.parametrize("kind", KINDS)
nested_kind = pytest.mark.parametrize("kind", [KINDS[0], KINDS[3]])


@pytest.mark.few(18)
@pytest.mark.parametrize(
    ("kind", "effort"),
    [
        pytest.param(
            *each.values,
            effort,
            id=f"{each.id}-{effort}",
            marks=[*each.marks, *[pytest.mark.full] * (effort == 0)],
        )
        for each in KINDS
        for effort in (range(3) if each.id in ("predictive", "cdf97") else (1,))
    ],
)
@pytest.mark.parametrize("name", list(hard_rasters((2, 2), 1)))
@pytest.mark.parametrize("step", [1, 3, 21, (1 << 28) + 1])
def test_bound_holds_on(kind, name, step, effort):
    target = hard_rasters((17, 16), BIG)[name]
    mask = np.random.default_rng(1).random(target.shape) < 0.9 if kind.is_faithful else None
    for shared in (NOT_SHARED, Sides(True, False, True, True)):
        spec = kind.spec(target.shape, step, effort, shared)
        kind.check(spec, kind.parent_of(target, step), target, mask)
        spec = kind.spec(target.shape, step, effort, shared, parent=False)
        kind.check(spec, None, target, mask)


@pytest.mark.few(18)
@each_kind
@pytest.mark.parametrize(
    "shape",
    [(1, 1), (1, 2), (2, 1), (1, 9), (8, 1), (2, 2), (3, 3), (5, 2), (1, 33), (33, 3), (12, 40)],
)
@pytest.mark.parametrize("shared", [NOT_SHARED, ALL_SHARED])
@pytest.mark.parametrize("has_parent", [False, True])
def test_tiny_regions_work(kind, shape, shared, has_parent):
    if shared.top and min(shape) < 2:
        shared = Sides(True, True, False, False)
    target = terrain(shape)
    spec = kind.spec(shape, 3, 1, shared, has_parent)
    kind.check(spec, kind.parent_of(target, 3) if has_parent else None, target)


@each_kind
@pytest.mark.parametrize("has_parent", [False, True])
def test_void_samples_promise_nothing(kind, has_parent):
    target = terrain((33, 33))
    mask = np.random.default_rng(1).random(target.shape) < 0.5
    spec = kind.spec(target.shape, 3, 1, ALL_SHARED, has_parent)
    parent = kind.parent_of(target, 3) if has_parent else None
    kind.check(spec, parent, target, mask)
    kind.check(spec, parent, np.where(mask, target, 77_777).astype(np.int32), mask)
    kind.check(spec, parent, target, np.zeros_like(mask))


@nested_kind
def test_even_samples_are_the_parents(kind):
    target = terrain((33, 29))
    parent = coarse_of(target, 9)
    _, heights = kind.check(kind.spec(target.shape, 9, 1, ALL_SHARED), parent, target)
    np.testing.assert_array_equal(heights[::2, ::2], parent)


@each_kind
def test_wrong_parent_still_gives_the_bound_elsewhere(kind):
    target = terrain((33, 33))
    spec = kind.spec(target.shape, 5)
    parent = -kind.parent_of(target, 5) - 100_000
    mask = np.ones(target.shape, dtype=bool)
    _, heights, _ = kind.refiner().encode(spec, parent, target, mask)
    error = np.abs(heights.astype(np.int64) - target)
    if kind.parent_of is coarse_of:
        error[::2, ::2] = 0
    assert error.max() <= 2


@each_kind
def test_a_plane_costs_next_to_nothing(kind):
    rows, cols = np.mgrid[:129, :129]
    plane = (6 * rows - 4 * cols).astype(np.int32)
    parent = np.ascontiguousarray(plane[::2, ::2])
    payload, _ = kind.check(kind.spec(plane.shape, 3), parent, plane)
    assert len(payload) <= kind.most_of_plane


@each_kind
@pytest.mark.parametrize("step", [1, 3])
def test_noise_costs_little_more_than_plain_bits(kind, step):
    rng = np.random.default_rng(5)
    target = rng.integers(0, step << 13, (65, 65), dtype=np.int32)
    payload, _ = kind.check(kind.spec(target.shape, step, parent=False), None, target)
    assert len(payload) <= kind.most_of_noise * 13 * target.size / 8 + 8


@pytest.mark.few(16)
@pytest.mark.large
@pytest.mark.parametrize(
    ("kind", "rings"),  # the default has no rings
    [
        pytest.param(*each.values, n, id=f"{each.id}-{n}", marks=each.marks)
        for each in KINDS
        for n in ((1,) if each.id == "rapid" else (1, 3))
    ],
)
@pytest.mark.parametrize("has_voids", [False, True])
@pytest.mark.parametrize(
    "size", [(33, 33), (49, 65), (34, 50), (18, 41), (65, 66), (3, 70), (1, 40), (131, 131)]
)
def test_neighbours_decode_the_same_bits_in_any_order(kind, size, rings, has_voids):
    grid = Grid(*size, 8)
    levels = [terrain(size, seed=7)]
    for level in range(grid.k_max - 1, -1, -1):
        fine = levels[-1]
        if kind.parent_of is coarse_of:
            levels.append(np.ascontiguousarray(fine[::2, ::2]))
        else:
            shape = grid.level_shape(level)
            levels.append(lowpass_analysis(fine, (0, 0), fine.shape, (0, 0), shape))
    levels.reverse()
    rng = np.random.default_rng(11)
    masks = [rng.random(level.shape) < (0.7 if has_voids else 2) for level in levels]
    if kind.parent_of is coarse_of:
        for above, mask in itertools.pairwise(masks):
            mask[::2, ::2] &= above  # a sample valid here was valid there
    check_neighbours(kind.refiner(), grid, levels, rings, 1, masks, is_faithful=kind.is_faithful)


@cache
def small_payload(kind):
    target = terrain((21, 18))
    spec = kind.spec(target.shape, 5, 1, Sides(True, False, False, True))
    parent, mask = kind.parent_of(target, 5), np.ones(target.shape, dtype=bool)
    payload, _, _ = kind.refiner().encode(spec, parent, target, mask)
    return spec, parent, mask, payload


@each_kind
def test_every_prefix_is_rejected(kind):
    """Of `cdf97` nothing but a checksum can tell all: one may by chance need just its bytes."""
    spec, parent, mask, payload = small_payload(kind)
    n_accepted = 0
    for length in range(len(payload)):
        with contextlib.suppress(CorruptStreamError):
            kind.refiner().decode(spec, parent, mask, payload[:length])
            n_accepted += 1
    assert n_accepted <= (kind.refiner is Cdf97Refiner)


@each_kind
def test_an_extra_byte_is_rejected(kind):
    spec, parent, mask, payload = small_payload(kind)
    with pytest.raises(CorruptStreamError):
        kind.refiner().decode(spec, parent, mask, payload + b"\0")


@each_kind
def test_every_flipped_byte_gives_heights_or_our_own_error(kind):
    spec, parent, mask, payload = small_payload(kind)
    for pos, change in itertools.product(range(len(payload)), (1, 128, 255)):
        broken = bytearray(payload)
        broken[pos] ^= change
        check_damaged(kind.refiner(), spec, parent, mask, bytes(broken))


@nested_kind
@pytest.mark.large
@pytest.mark.parametrize("z_max", [5000, BIG])
def test_flipped_bytes_in_a_large_unit_give_heights_or_our_own_error(kind, z_max):
    target = terrain((135, 140))
    spec = replace(lone_spec(target.shape, 3), z_min=-z_max, z_max=z_max)
    parent, mask = coarse_of(target, 3), np.ones(target.shape, dtype=bool)
    payload, _, _ = kind.refiner().encode(spec, parent, target, mask)
    for pos in range(0, len(payload), 11):
        broken = bytearray(payload)
        broken[pos] ^= 255
        check_damaged(kind.refiner(), spec, parent, mask, bytes(broken))


@each_kind
@given(
    st.binary(max_size=80),
    st.booleans(),
    st.sampled_from([1, 3, 1001, (1 << 29) + 1]),
    st.booleans(),
)
def test_any_bytes_give_heights_or_our_own_error(kind, payload, has_parent, step, has_header):
    spec, parent, mask, _ = small_payload(kind)
    spec = replace(spec, step=step, has_coarse_residuals=kind.is_faithful and step > 1)
    if not has_parent:
        spec, parent = replace(spec, parent_region=None), None
    if has_header:  # of `rapid`: a single state, no words: all the rest are raw bits
        n_raw = max(len(payload) - 4, 0)
        payload = bytes([is_narrow := step < 1000, *([] if is_narrow else [9]), 0, n_raw]) + payload
    check_damaged(kind.refiner(), spec, parent, mask, payload)
