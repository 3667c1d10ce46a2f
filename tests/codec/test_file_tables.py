"""Tables that a file brings along: their bytes, damage, what they are fitted to."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lone_units import rough

from terrainwave.codec.planes import CORES, TAPS
from terrainwave.codec.predictive import file_tables as parameters_module
from terrainwave.codec.predictive.file_tables import (
    MAX_SETS,
    NO_TABLES,
    PLANES,
    FileStencil,
    FileTables,
    all_tables,
    missing_tap,
    pack_file_tables,
    parse_file_tables,
    weights_of,
)
from terrainwave.codec.predictive.fit import fit_non_negative, fit_tables, fit_weights
from terrainwave.codec.predictive.passes import N_FEATURES
from terrainwave.codec.predictive.refiner import PredictiveRefiner
from terrainwave.codec.predictive.trained import E_WEIGHTS, STENCILS
from terrainwave.codec.refiner import GroupSpec
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Grid, Region


def stencil(plane, base=2, shift=3, seed=1):
    deltas = np.random.default_rng(seed).integers(-40, 40, len(TAPS[plane]))
    deltas[missing_tap(plane)] = 0
    return FileStencil(base, shift, tuple(int(delta) for delta in deltas))


def some_tables():
    return FileTables(
        {1: [stencil(1), stencil(1, 0, 0, seed=4)], 2: [], 3: [stencil(3, 7, 5)]},
        {1: None, 2: np.arange(N_FEATURES, dtype=np.int64) * 200, 3: None},
    )


def test_tables_survive():
    added = some_tables()
    back = parse_file_tables(pack_file_tables(added))
    assert back.stencils == added.stencils
    for plane in PLANES:
        np.testing.assert_array_equal(back.e_weights[plane], added.e_weights[plane])


def test_no_tables_are_no_bytes():
    assert pack_file_tables(NO_TABLES) == b""
    found = all_tables(parse_file_tables(b""))
    for plane in PLANES:
        np.testing.assert_array_equal(found.stencils[plane], STENCILS[plane])
        np.testing.assert_array_equal(found.e_weights[plane], E_WEIGHTS[plane])


def test_file_stencils_follow_the_trained_ones_and_keep_a_constant():
    found = all_tables(some_tables())
    assert [len(found.stencils[p]) - len(STENCILS[p]) for p in PLANES] == [2, 0, 1]
    assert [len(found.e_weights[p]) for p in PLANES] == [3, 4, 3]
    assert all((found.stencils[plane].sum(1) == 4096).all() for plane in PLANES)


def test_every_prefix_and_an_extra_byte_are_rejected():
    section = pack_file_tables(some_tables())
    for length in range(1, len(section)):
        with pytest.raises(CorruptStreamError):
            parse_file_tables(section[:length])
    with pytest.raises(CorruptStreamError):
        parse_file_tables(section + b"\0")


@pytest.mark.parametrize(
    "change",
    [
        {"base": 8},
        {"deltas": (1 << 15, *(0,) * 19)},
        {"deltas": (-(1 << 13),) * 2 + (0,) * 18},
        {"deltas": (70_000, *(0,) * 19), "shift": 0},
    ],
)
def test_a_stencil_out_of_range_is_rejected(change):
    bad = stencil(1)._replace(**change)
    added = FileTables({1: [bad], 2: [], 3: []}, dict.fromkeys(PLANES))
    with pytest.raises(CorruptStreamError):
        parse_file_tables(pack_file_tables(added))


def test_feature_weights_out_of_range_are_rejected():
    weights = np.zeros(N_FEATURES, dtype=np.int64)
    weights[3] = parameters_module.MAX_FEATURE_WEIGHT + 1
    added = NO_TABLES._replace(e_weights={1: weights, 2: None, 3: None})
    with pytest.raises(CorruptStreamError):
        parse_file_tables(pack_file_tables(added))


@given(st.binary(max_size=200))
def test_any_bytes_give_tables_within_their_limits_or_our_own_error(data):
    try:
        found = all_tables(parse_file_tables(b"\x01" + data))
    except CorruptStreamError:
        return
    for plane in PLANES:
        assert len(found.stencils[plane]) <= MAX_SETS
        assert np.abs(found.stencils[plane]).max() < 1 << 15
        assert (found.stencils[plane].sum(1) == 4096).all()
        assert 3 <= len(found.e_weights[plane]) <= 4


def fitted_to(heights, step):
    grid = Grid(*heights.shape, 256)

    def read(level, region):
        stride = grid.stride(level)
        return np.ascontiguousarray(
            heights[::stride, ::stride][region.slices_in(Region(0, 0, 1 << 30, 1 << 30))]
        )

    def valid(level, region):
        return np.ones(region.shape, dtype=bool)

    return PredictiveRefiner().fitted(grid, step, read, valid), fit_tables(grid, step, read, valid)


def unit(shape, step):
    core = Region(0, 0, *shape)
    above = Region(0, 0, (shape[0] + 1) // 2, (shape[1] + 1) // 2)
    return GroupSpec.alone(core, step, -5000, 5000, parent_region=above, effort=1)


@pytest.mark.large
@pytest.mark.parametrize("step", [1, 9])
def test_fitted_tables_make_a_strange_surface_smaller_within_the_bound(step):
    heights = rough((401, 401))
    refiner, added = fitted_to(heights, step)
    assert any(added.stencils.values())
    assert refiner.file_tables
    spec, mask = unit((257, 257), step), np.ones((257, 257), dtype=bool)
    target = np.ascontiguousarray(heights[:257, :257])
    parent = np.ascontiguousarray(target[::2, ::2])
    payload, decoded, _ = refiner.encode(spec, parent, target, mask)
    plain, _, _ = PredictiveRefiner().encode(spec, parent, target, mask)
    assert len(payload) < (0.98 if step == 1 else 0.95) * len(plain)
    back, _ = PredictiveRefiner(refiner.file_tables).decode(spec, parent, mask, payload)
    np.testing.assert_array_equal(back, decoded)
    assert np.abs(back.astype(np.int64) - target).max() <= spec.half
    # Without its tables the stream means something else, or nothing.
    try:
        other, _ = PredictiveRefiner().decode(spec, parent, mask, payload)
    except CorruptStreamError:
        return
    assert not np.array_equal(other, decoded)


def test_extreme_file_tables_cannot_overflow():
    shape = (64, 64)
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    big = 1 << 30
    target = np.where((rows + cols) & 1, big, -big).astype(np.int32)
    parent = np.ascontiguousarray(target[::2, ::2])
    deltas = [8000, -8000] * 10
    deltas[missing_tap(1)] = 0
    weights = np.full(N_FEATURES, parameters_module.MAX_FEATURE_WEIGHT)
    added = FileTables(
        {1: [FileStencil(0, 1, tuple(deltas))], 2: [], 3: []},
        {plane: weights for plane in PLANES},
    )
    assert abs(weights_of(1, added.stencils[1][0])).max() > 15_000
    refiner = PredictiveRefiner(pack_file_tables(added))
    spec = dataclasses.replace(unit(shape, 3), z_min=-big, z_max=big)
    mask = np.ones(shape, dtype=bool)
    payload, decoded, _ = refiner.encode(spec, parent, target, mask)
    back, _ = refiner.decode(spec, parent, mask, payload)
    np.testing.assert_array_equal(back, decoded)
    assert np.abs(back.astype(np.int64) - target).max() <= 1


def test_least_squares_find_the_weights_that_made_the_data():
    rng = np.random.default_rng(8)
    taps = rng.normal(0, 9, (2000, len(TAPS[1])))
    weights = rng.normal(0, 1, taps.shape[1])
    is_core = np.array([tuple(tap) in {tuple(c) for c in CORES[1]} for tap in TAPS[1]]) * 1.0
    solution = np.zeros(taps.shape[1])
    assert fit_weights(taps, taps @ weights, is_core, 0.0, 3, solution)
    np.testing.assert_allclose(solution, weights, atol=1e-4)


def test_non_negative_fit_agrees_with_scipy():
    optimize = pytest.importorskip("scipy.optimize")
    rng = np.random.default_rng(9)
    features = rng.gamma(2, 1, (500, N_FEATURES))
    truth = np.maximum(rng.normal(0, 1, N_FEATURES), 0)
    details = features @ truth + rng.normal(0, 0.1, 500)
    solution = np.zeros(N_FEATURES)
    fit_non_negative(features, details, solution)
    influence = 1 / (features @ solution + 0.1)
    expected, _ = optimize.nnls(features * influence[:, None], details * influence)
    np.testing.assert_allclose(solution, expected, atol=0.02)
