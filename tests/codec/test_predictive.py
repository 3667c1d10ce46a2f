"""The `predictive` refiner: its parts; what it shares is in `test_refiners`."""

import dataclasses

import numpy as np
import pytest
from lone_units import (
    check_refiner,
    coarse_of,
    lone_spec,
    terrain,
)

from terrainwave.codec.magnitudes import (
    LOG8,
    MAX_DETAIL,
    N_DETAIL_MODELS,
    N_E_BINS,
    N_MIXERS,
    SHIFT_OF_E,
    cell_limits,
    code_detail,
    in_steps,
    log8,
    step_scale,
)
from terrainwave.codec.planes import PAD, fill_frame, merge, plane_sizes, split
from terrainwave.codec.predictive import refiner as predictive
from terrainwave.codec.predictive.passes import fits_narrow
from terrainwave.codec.predictive.refiner import PredictiveRefiner, _Rows
from terrainwave.codec.predictive.trained import E_WEIGHTS, STENCILS, start_models
from terrainwave.coding.rangecoder import (
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
    new_mixers,
    put_back,
    take_out,
)


def check(spec, parent, target, mask=None):
    """Check everything promised; return the payload and the heights."""
    payload, heights, _ = check_refiner(PredictiveRefiner(), spec, parent, target, mask)
    return payload, heights


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


@pytest.mark.parametrize("step", [1, 3, 21, 4097, 200_001, (1 << 30) - 1])
def test_limits_of_cells_are_where_steps_become_more(step):
    shift, inverse = step_scale(np.int64(step))
    limits = cell_limits(step)
    assert len(limits) == SHIFT_OF_E.max() + 1
    for low, line in enumerate(limits):
        for k, limit in enumerate(line):
            if limit > 1 << 32:
                continue  # no two heights are that far apart
            least, below = (
                in_steps(limit + offset + (step >> 1), shift, inverse, 0) for offset in (0, -1)
            )
            # FORMAT.md P.7: t > 0 and (t - 1) >> low >= k.
            assert least > 0
            assert (least - 1) >> low >= k
            assert below <= 0 or (below - 1) >> low < k


@pytest.mark.parametrize("mixed", [False, True])
def test_details_of_any_size_survive(mixed):
    rng = np.random.default_rng(6)
    sizes = [1, 2, 5, 14, 15, 100, 10**4, 10**6, (1 << 31) - 1]
    details = [s * sign for s in sizes for sign in (1, -1)]
    contexts = [
        (int(e), *(int(x) for x in rng.integers(0, 5000, 2)), tuple(rng.integers(-9, 9, 6)))
        for e in rng.integers(0, N_E_BINS, len(details))
    ]
    out = np.zeros(10_000, dtype=np.uint8)
    coder, mixers = new_encoder(out, start_models(N_DETAIL_MODELS)), new_mixers(N_MIXERS)
    scale = 100, log8(100)
    limits = cell_limits(3) if mixed else None
    at = take_out(coder.state)
    for detail, (e_bin, up, down, around) in zip(details, contexts, strict=True):
        coded, at = code_detail(
            at, *coder, mixers, e_bin, 1300, 1301, up, down, *scale, around, limits, detail
        )
        assert coded == detail
    put_back(at, coder.state)
    data = out[: finish_encoder(coder.state, out)].tobytes()
    coder, mixers = new_decoder(data, start_models(N_DETAIL_MODELS)), new_mixers(N_MIXERS)
    at = take_out(coder.state)
    for detail, (e_bin, up, down, around) in zip(details, contexts, strict=True):
        coded, at = code_detail(
            at, *coder, mixers, e_bin, 1300, 1301, up, down, *scale, around, limits, 0
        )
        assert coded == detail
        assert abs(coded) <= MAX_DETAIL + 1
    put_back(at, coder.state)
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


@pytest.mark.parametrize("shape", [(1, 6), (5, 1), (2, 3), (12, 9)])
def test_what_a_thread_decoded_before_leaves_no_trace(shape):
    target = np.random.default_rng(5).integers(-90, 90, shape).astype(np.int32)
    spec, parent = lone_spec(shape, 3, 1), coarse_of(target, 3)
    mask = np.ones(shape, dtype=bool)
    results = []
    for filling in (0, 1 << 20, -7):
        predictive._WORKSPACE.memory = np.full(20_000, filling, dtype=np.int32)
        payload, _, _ = PredictiveRefiner().encode(spec, parent, target, mask)
        predictive._WORKSPACE.memory.fill(-filling)
        heights, _ = PredictiveRefiner().decode(spec, parent, mask, payload)
        results.append((payload, heights.tobytes()))
    assert results[0] == results[1] == results[2]
