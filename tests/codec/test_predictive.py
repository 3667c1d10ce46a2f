"""The `predictive` refiner: the bound, the borders, voids, damage."""

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
    hard_rasters,
    lone_spec,
    terrain,
)

from terrainwave.codec import predictive
from terrainwave.codec.detail import (
    LOG8,
    MAX_DETAIL,
    N_DETAIL_MODELS,
    N_E_BINS,
    N_MIXERS,
    code_detail,
    log8,
)
from terrainwave.codec.lattice import PAD, TAPS, fill_frame, merge, plane_sizes, split
from terrainwave.codec.nested import fits_narrow
from terrainwave.codec.predictive import Predictive, _Rows
from terrainwave.codec.refiner import Sides
from terrainwave.codec.tables import E_WEIGHTS, STENCILS, start_models
from terrainwave.coding.rangecoder import (
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
    new_mixers,
    put_back,
    take_out,
)
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Grid


def coarse_of(target, step):
    """Return parent heights within the bound of the target's even samples."""
    rng = np.random.default_rng(2)
    coarse = target[::2, ::2].astype(np.int64)
    half = step >> 1
    return np.clip(coarse + rng.integers(-half, half + 1, coarse.shape), -BIG, BIG).astype(np.int32)


def check(spec, parent, target, mask=None):
    """Check everything promised; return the payload and the heights."""
    payload, heights, labels = check_refiner(Predictive(), spec, parent, target, mask)
    assert (labels is None) == (parent is None)
    if labels is not None:
        assert labels.shape == parent.shape
    return payload, heights


@pytest.mark.parametrize("name", list(hard_rasters((2, 2), 1)))
@pytest.mark.parametrize("step", [1, 3, 21, (1 << 28) + 1])
@pytest.mark.parametrize("effort", [pytest.param(0, marks=pytest.mark.full), 1])
def test_bound_holds_on(name, step, effort):
    target = hard_rasters((17, 16), BIG)[name]
    for shared in (NOT_SHARED, Sides(True, False, True, True)):
        check(lone_spec(target.shape, step, effort, shared), coarse_of(target, step), target)
        check(lone_spec(target.shape, step, effort, shared, parent=False), None, target)


@pytest.mark.parametrize(
    "shape",
    [(1, 1), (1, 2), (2, 1), (1, 9), (8, 1), (2, 2), (3, 3), (5, 2), (1, 33), (33, 3), (12, 40)],
)
@pytest.mark.parametrize("shared", [NOT_SHARED, ALL_SHARED])
@pytest.mark.parametrize("has_parent", [False, True])
def test_tiny_regions_work(shape, shared, has_parent):
    if shared.top and min(shape) < 2:
        shared = Sides(True, True, False, False)
    target = terrain(shape)
    spec = lone_spec(shape, 3, 1, shared, has_parent)
    check(spec, coarse_of(target, 3) if has_parent else None, target)


@pytest.mark.parametrize("has_parent", [False, True])
def test_void_samples_promise_nothing(has_parent):
    target = terrain((33, 33))
    mask = np.random.default_rng(1).random(target.shape) < 0.5
    spec = lone_spec(target.shape, 3, 1, ALL_SHARED, has_parent)
    parent = coarse_of(target, 3) if has_parent else None
    check(spec, parent, target, mask)
    check(spec, parent, np.where(mask, target, 77_777).astype(np.int32), mask)
    check(spec, parent, target, np.zeros_like(mask))


def test_even_samples_are_the_parents():
    target = terrain((33, 29))
    parent = coarse_of(target, 9)
    _, heights = check(lone_spec(target.shape, 9, 1, ALL_SHARED), parent, target)
    np.testing.assert_array_equal(heights[::2, ::2], parent)


def test_wrong_parent_still_gives_the_bound_elsewhere():
    target = terrain((33, 33))
    spec = lone_spec(target.shape, 5)
    parent = -coarse_of(target, 5) - 100_000
    mask = np.ones(target.shape, dtype=bool)
    _, heights, _ = Predictive().encode(spec, parent, target, mask)
    error = np.abs(heights.astype(np.int64) - target)
    error[::2, ::2] = 0
    assert error.max() <= 2


def test_a_plane_costs_next_to_nothing():
    rows, cols = np.mgrid[:129, :129]
    plane = (6 * rows - 4 * cols).astype(np.int32)
    payload, _ = check(lone_spec(plane.shape, 3), np.ascontiguousarray(plane[::2, ::2]), plane)
    assert len(payload) <= 60


@pytest.mark.parametrize("step", [1, 3])
def test_noise_costs_little_more_than_plain_bits(step):
    rng = np.random.default_rng(5)
    target = rng.integers(0, step << 13, (65, 65), dtype=np.int32)
    payload, _ = check(lone_spec(target.shape, step, parent=False), None, target)
    assert len(payload) <= 1.07 * 13 * target.size / 8 + 8


# Parts -----------------------------------------------------------------------------------------


def test_stencils_keep_a_constant():
    for plane, sets in STENCILS.items():
        assert sets.shape[1] == TAPS[plane].shape[0]
        assert (sets.sum(1) == 4096).all()
        assert np.abs(sets).max() < 1 << 15
        assert 1 <= len(sets) <= 64


def test_log8_is_the_logarithm_rounded_down():
    values = np.arange(1, 4096)
    # Exact integers: 2**k <= v**8 < 2**(k + 1).
    for value in values:
        k = int(LOG8[value])
        assert 2**k <= int(value) ** 8 < 2 ** (k + 1)
    assert [log8(np.int64(v)) for v in (0, 1, 2, 4096, 1 << 20, 1 << 30)] == [0, 0, 8, 96, 160, 240]


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (4, 1), (2, 2), (3, 2), (9, 8), (16, 17)])
def test_padding_is_numpys_reflection(shape):
    rng = np.random.default_rng(4)
    lattice = rng.integers(-99, 99, shape).astype(np.int32)
    sizes = plane_sizes(shape)
    planes = np.zeros((4, sizes[0][0] + 2 * PAD, sizes[0][1] + 2 * PAD), dtype=np.int32)
    split(lattice, planes)
    back = np.zeros_like(lattice)
    merge(planes, back)
    np.testing.assert_array_equal(back, lattice)
    padded = np.pad(lattice, 2 * PAD, mode="reflect")
    for plane, (row, col) in enumerate(((0, 0), (1, 1), (0, 1), (1, 0))):
        if 0 in sizes[plane]:
            continue
        fill_frame(planes[plane], row, col, *shape)
        n_rows, n_cols = sizes[plane]
        expected = padded[row::2, col::2][: n_rows + 2 * PAD, : n_cols + 2 * PAD]
        got = planes[plane, : n_rows + 2 * PAD, : n_cols + 2 * PAD]
        np.testing.assert_array_equal(got[: expected.shape[0], : expected.shape[1]], expected)


@pytest.mark.parametrize("mixed", [False, True])
def test_details_of_any_size_survive(mixed):
    rng = np.random.default_rng(6)
    sizes = [1, 2, 5, 14, 15, 100, 10**4, 10**6, (1 << 31) - 1]
    details = [s * sign for s in sizes for sign in (1, -1)]
    contexts = [
        (int(e), *(int(reach) for reach in rng.integers(0, 5000, 2)), rng.integers(-9, 9, 6))
        for e in rng.integers(0, N_E_BINS, len(details))
    ]
    out = np.zeros(10_000, dtype=np.uint8)
    coder, mixers = new_encoder(out, start_models(N_DETAIL_MODELS)), new_mixers(N_MIXERS)
    scale = 100, log8(100)
    at = take_out(coder.state)
    for detail, (e_bin, up, down, spots) in zip(details, contexts, strict=True):
        coded, at = code_detail(
            at,
            *coder,
            mixers,
            e_bin,
            1300,
            1301,
            up,
            down,
            *scale,
            spots if mixed else None,
            detail,
        )
        assert coded == detail
    put_back(at, coder.state, coder.is_encoder)
    data = out[: finish_encoder(coder.state, out)].tobytes()
    coder, mixers = new_decoder(data, start_models(N_DETAIL_MODELS)), new_mixers(N_MIXERS)
    at = take_out(coder.state)
    for detail, (e_bin, up, down, spots) in zip(details, contexts, strict=True):
        coded, at = code_detail(
            at, *coder, mixers, e_bin, 1300, 1301, up, down, *scale, spots if mixed else None, 0
        )
        assert coded == detail
        assert abs(coded) <= MAX_DETAIL + 1
    put_back(at, coder.state, coder.is_encoder)
    assert finish_decoder(coder.state, coder.stream)[0] == 0


@pytest.mark.parametrize(
    "effort",
    [pytest.param(0, marks=pytest.mark.full), 1, pytest.param(2, marks=pytest.mark.large)],
)
@pytest.mark.parametrize("largest", [300, 40_000, 100_000, 200_000])
def test_rows_of_32_bits_give_the_same_bytes_as_rows_of_64(effort, largest, monkeypatch):
    rng = np.random.default_rng(largest)
    target = rng.integers(-largest, largest + 1, (70, 65)).astype(np.int32)
    target[:30] = terrain((30, 65), relief=min(largest, 400) / 2)
    spec = dataclasses.replace(lone_spec(target.shape, 3, effort), z_min=-largest, z_max=largest)
    parent = coarse_of(target, 3).clip(-largest, largest)
    payload, heights = check(spec, parent, target)
    monkeypatch.setattr(_Rows, "of", lambda rows, *_weights: rows.wide)
    wide_payload, wide_heights = check(spec, parent, target)
    assert payload == wide_payload
    np.testing.assert_array_equal(heights, wide_heights)


def test_only_heights_whose_sums_fit_get_32_bits():
    weights, e_weights = STENCILS[1][0], E_WEIGHTS[1][0]
    most = ((1 << 30) - 1) // (int(np.abs(weights).sum()) + 64)
    assert fits_narrow(most, weights, e_weights)
    assert not fits_narrow(most + 1, weights, e_weights)
    steep = e_weights.copy()
    steep[0] = -1
    assert not fits_narrow(300, weights, steep)


# Groups next to each other ---------------------------------------------------------------------


@pytest.mark.large
@pytest.mark.parametrize("rings", [1, 3])
@pytest.mark.parametrize("has_voids", [False, True])
@pytest.mark.parametrize(
    "size", [(33, 33), (49, 65), (34, 50), (18, 41), (65, 66), (3, 70), (1, 40), (131, 131)]
)
def test_neighbours_decode_the_same_bits_in_any_order(size, rings, has_voids):
    grid = Grid(*size, 8)
    levels = [terrain(size, seed=7)]
    for _ in range(grid.k_max):
        levels.append(np.ascontiguousarray(levels[-1][::2, ::2]))
    levels.reverse()
    rng = np.random.default_rng(11)
    masks = [rng.random(level.shape) < (0.7 if has_voids else 2) for level in levels]
    for above, mask in itertools.pairwise(masks):
        mask[::2, ::2] &= above  # a sample valid here was valid there
    check_neighbours(Predictive(), grid, levels, rings, 1, masks)


# Damage ----------------------------------------------------------------------------------------


@cache
def small_payload():
    target = terrain((21, 18))
    spec = lone_spec(target.shape, 5, 1, Sides(True, False, False, True))
    parent, mask = coarse_of(target, 5), np.ones(target.shape, dtype=bool)
    payload, _, _ = Predictive().encode(spec, parent, target, mask)
    return spec, parent, mask, payload


def test_every_prefix_is_rejected():
    spec, parent, mask, payload = small_payload()
    for length in range(len(payload)):
        with pytest.raises(CorruptStreamError):
            Predictive().decode(spec, parent, mask, payload[:length])


def test_an_extra_byte_is_rejected():
    spec, parent, mask, payload = small_payload()
    with pytest.raises(CorruptStreamError):
        Predictive().decode(spec, parent, mask, payload + b"\0")


def test_every_flipped_byte_gives_heights_or_our_own_error():
    spec, parent, mask, payload = small_payload()
    for pos in range(len(payload)):
        for change in (1, 128, 255):
            broken = bytearray(payload)
            broken[pos] ^= change
            check_damaged(Predictive(), spec, parent, mask, bytes(broken))


@pytest.mark.large
def test_flipped_bytes_in_a_large_unit_give_heights_or_our_own_error():
    target = terrain((97, 80))
    spec = lone_spec(target.shape, 3)
    parent, mask = coarse_of(target, 3), np.ones(target.shape, dtype=bool)
    payload, _, _ = Predictive().encode(spec, parent, target, mask)
    for pos in range(0, len(payload), 7):
        broken = bytearray(payload)
        broken[pos] ^= 255
        check_damaged(Predictive(), spec, parent, mask, bytes(broken))


@given(st.binary(max_size=80), st.booleans(), st.sampled_from([1, 3, 1001, (1 << 29) + 1]))
def test_any_bytes_give_heights_or_our_own_error(payload, has_parent, step):
    spec, parent, mask, _ = small_payload()
    spec = dataclasses.replace(spec, step=step)
    if not has_parent:
        spec, parent = dataclasses.replace(spec, parent_region=None), None
    check_damaged(Predictive(), spec, parent, mask, payload)


# Zero trees ------------------------------------------------------------------------------------


def test_a_flat_group_is_one_zero_tree():
    plane = np.full((33, 33), 700, dtype=np.int32)
    _, _, trees = Predictive().encode(
        lone_spec(plane.shape, 3), np.ascontiguousarray(plane[::2, ::2]), plane, plane == plane
    )
    # 17 x 17 nodes: 2**5 is the first power of two above 16.
    np.testing.assert_array_equal(trees, np.full((17, 17), 5 + 1))


@pytest.mark.parametrize(
    ("place", "nodes"),
    [((21, 9), [(10, 4)]), ((20, 9), [(10, 4)]), ((21, 8), [(10, 4)])],
    ids=["HH", "HL", "LH"],
)
def test_a_spike_is_significant_in_the_node_that_holds_its_detail(place, nodes):
    target = np.zeros((65, 65), dtype=np.int32)
    target[place] = 40
    parent = np.zeros((33, 33), dtype=np.int32)
    _, _, trees = Predictive().encode(lone_spec(target.shape, 21), parent, target, target == target)
    # Its neighbours' predictions use it and miss; far from it nothing is significant.
    found = {(int(i), int(j)) for i, j in np.argwhere(trees == 0)}
    assert set(nodes) <= found
    assert max(abs(i - 10) for i, _ in found) <= 2
    assert max(abs(j - 4) for _, j in found) <= 2
    assert trees[16:32, 16:32].min() == 4 + 1


def test_voids_are_never_significant():
    target = terrain((65, 65), seed=4)
    mask = np.ones(target.shape, dtype=bool)
    mask[20:50, 10:40] = False
    parent = coarse_of(target, 1)
    _, _, trees = Predictive().encode(lone_spec(target.shape, 1), parent, target, mask)
    assert (trees[10:24, 5:19] > 0).all()
    assert (trees == 0).any()


def test_labels_are_left_out_where_nobody_wants_them():
    target = terrain((33, 33))
    spec = dataclasses.replace(lone_spec(target.shape), wants_labels=False)
    parent = coarse_of(target, 3)
    payload, heights, labels = Predictive().encode(spec, parent, target, target == target)
    back, back_labels = Predictive().decode(spec, parent, target == target, payload)
    assert labels is None
    assert back_labels is None
    np.testing.assert_array_equal(back, heights)


@pytest.mark.parametrize("shape", [(1, 6), (5, 1), (2, 3), (12, 9)])
def test_what_a_thread_decoded_before_leaves_no_trace(shape):
    target = np.random.default_rng(5).integers(-90, 90, shape).astype(np.int32)
    spec, parent = lone_spec(shape, 3, 1), coarse_of(target, 3)
    mask = np.ones(shape, dtype=bool)
    results = []
    for filling in (0, 1 << 20, -7):
        predictive._WORKSPACE.memory = np.full(20_000, filling, dtype=np.int32)
        payload, _, _ = Predictive().encode(spec, parent, target, mask)
        predictive._WORKSPACE.memory.fill(-filling)
        heights, trees = Predictive().decode(spec, parent, mask, payload)
        results.append((payload, heights.tobytes(), trees.tobytes()))
    assert results[0] == results[1] == results[2]
