"""Integer 9/7 filters against slow float64 references, and the proof that nothing overflows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.codec.cdf97.refiner import MAX_COEFF
from terrainwave.coding.filters import (
    BAND_GAINS,
    MAX_HEIGHT,
    forward_transform,
    inverse_transform,
    lowpass_analysis,
    n_transforms,
    synthesise,
)

# Cohen, Daubechies, Feauveau 9/7 with DC gain 1 (analysis) and 2 (synthesis); Daubechies and
# Sweldens 1998 print the lifting weights these follow from.
LOWPASS = [0.026748757, -0.016864118, -0.078223267, 0.266864118, 0.602949018]
LOWPASS += LOWPASS[-2::-1]
SYNTHESIS = np.array([-0.091271763, -0.057543526, 0.591271763, 1.115087052])
SYNTHESIS = np.append(SYNTHESIS, SYNTHESIS[-2::-1])
LIFTING = (-1.586134342, -0.052980119, 0.882911076, 0.443506852)


def reference_analysis(line):
    padded = np.pad(line, 4, mode="reflect")
    return np.array([np.dot(LOWPASS, padded[i : i + 9]) for i in range(0, len(line), 2)])


def forward(heights):
    field = heights.astype(np.int64)
    scratch = np.zeros((2, heights.shape[1] // 2 + 4), dtype=np.int64)
    forward_transform(field, scratch[0], scratch[1])
    return field


def inverse(field):
    field = field.copy()
    scratch = np.zeros((2, field.shape[1] // 2 + 4), dtype=np.int64)
    inverse_transform(field, scratch[0], scratch[1])
    return field


def synthesised(parent, shape, offset=(0, 0)):
    out = np.zeros(shape, dtype=np.int32)
    line = np.zeros(parent.shape[1] + 4, dtype=np.int64)
    rows = np.zeros((parent.shape[0] + 4, shape[1]), dtype=np.int64)
    synthesise(parent, *offset, line, rows, out)
    return out


shapes = st.tuples(st.integers(1, 20), st.integers(1, 20))


@given(shapes, st.integers(0, 2**32 - 1))
def test_transform_is_reversible(shape, seed):
    heights = np.random.default_rng(seed).integers(-(1 << 37), 1 << 37, shape)
    np.testing.assert_array_equal(inverse(forward(heights)), heights)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 9, 16, 33])
def test_analysis_matches_the_slow_reference(n):
    heights = np.random.default_rng(n).integers(-5000, 5000, (n, 7)).astype(np.int32)
    expected = np.apply_along_axis(reference_analysis, 1, heights.astype(float))
    expected = np.apply_along_axis(reference_analysis, 0, expected)
    found = lowpass_analysis(heights, (0, 0), heights.shape, (0, 0), expected.shape)
    # Taps are rounded to 1/16384: up to 5000 * 14 / 32768 off, and the result to 1/2.
    assert np.abs(found - expected).max() <= 0.5 + 5000 * 14 / 32768


def test_windows_give_the_samples_of_the_whole():
    heights = np.random.default_rng(1).integers(-(1 << 30), 1 << 30, (41, 38)).astype(np.int32)
    whole = lowpass_analysis(heights, (0, 0), heights.shape, (0, 0), (21, 19))
    part = lowpass_analysis(heights[6:31, 12:38], (6, 12), heights.shape, (5, 8), (8, 11))
    np.testing.assert_array_equal(part, whole[5:13, 8:19])


@given(shapes, st.integers(-1000, 1000), st.integers(-1000, 1000), st.sampled_from([0, 1]))
def test_a_plane_stays_a_plane(shape, slope, other, offset):
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    parent = (2 * slope * rows + 2 * other * cols + 3).astype(np.int32)
    child = synthesised(parent, (2 * shape[0] - offset, 2 * shape[1] - offset), (offset, offset))
    rows, cols = np.mgrid[: child.shape[0], : child.shape[1]] + offset
    # One sample says nothing about slopes.
    slope, other = slope * (shape[0] > 1), other * (shape[1] > 1)
    np.testing.assert_array_equal(child, slope * rows + other * cols + 3)


def test_synthesis_matches_the_slow_reference_inside():
    parent = np.random.default_rng(2).integers(-5000, 5000, (12, 13)).astype(np.int32)
    spread = np.zeros((23, 25))
    spread[::2, ::2] = parent
    for axis in (0, 1):
        spread = np.apply_along_axis(np.convolve, axis, spread, SYNTHESIS, mode="same")
    found = synthesised(parent, (23, 25))
    difference = np.abs(found - spread)[4:-4, 4:-4]
    assert difference.max() <= 0.5 + 5000 * 14 / 32768


def test_synthesis_survives_extremes():
    for parent in ([[MAX_HEIGHT, -MAX_HEIGHT]], [[MAX_HEIGHT], [-MAX_HEIGHT]]):
        parent = np.array(parent, dtype=np.int32)
        child = synthesised(parent, (2 * parent.shape[0], 2 * parent.shape[1]))
        assert np.abs(child.astype(np.int64)).max() <= MAX_HEIGHT
    worst = np.where(np.indices((2, 2)).sum(0) & 1, -MAX_HEIGHT, MAX_HEIGHT).astype(np.int32)
    child = synthesised(worst, (4, 4)).astype(object)
    assert child[0, 0] == MAX_HEIGHT
    assert child[3, 3] == MAX_HEIGHT
    assert child[3, 0] == -MAX_HEIGHT


def unlifted(low, high):
    """Return every stage of one inverse transform, in float64."""
    stages = []
    for k, weight in reversed(list(enumerate(LIFTING))):
        if k % 2 == 0:
            right = np.append(low[1:], low[-1:], axis=0)[: len(high)]
            high = high - weight * (low[: len(high)] + right)
        else:
            left = np.append(high[:1], high, axis=0)[: len(low)]
            low = low - weight * (left + np.append(high, high[-1:], axis=0)[: len(low)])
        stages.append(np.concatenate([low, high]))
    return stages


def synthesis_growth(n, count):
    """Return, per transform, the largest sums of |weights| of its low and high bands in any stage.

    Entry [t] is (gain of LOW of transform t, gain of HIGH of transform t) on the way down to the
    full line; LOW counts for the last transform only.
    """
    sizes = [n]
    for _ in range(count):
        sizes.append((sizes[-1] + 1) // 2)
    gains = []
    for first in range(count):
        per_band = []
        for kind in (0, 1):
            low = np.eye(sizes[first + 1]) if kind == 0 else None
            n_high = sizes[first] // 2
            high = np.eye(n_high) if kind == 1 else np.zeros((n_high, sizes[first + 1]))
            if low is None:
                low = np.zeros((sizes[first + 1], n_high))
            worst = 0.0
            for t in range(first, -1, -1):
                n_high = sizes[t] // 2
                if t < first:
                    high = np.zeros((n_high, low.shape[1]))
                if n_high == 0:
                    continue
                for stage in unlifted(low, high):
                    worst = max(worst, np.abs(stage).sum(axis=1).max(initial=0))
                whole = np.empty((sizes[t], low.shape[1]))
                whole[0::2], whole[1::2] = stage[: sizes[t + 1]], stage[sizes[t + 1] :]
                low = whole
            per_band.append(max(worst, 1.0))
        gains.append(per_band)
    return gains


@pytest.mark.large
def test_no_stream_can_overflow_the_inverse_transform():
    # Coefficients are at most 2**40 (cdf97.MAX_COEFF) plus a step of at most as much. A lifting
    # step multiplies a sum of two values by at most 6497; a group of 2049 samples a side (the
    # largest, block 1024) has 12 transforms, whose growth has settled after a few.
    growth = np.array(synthesis_growth(257, 8))
    low, high = growth.max(axis=0)
    # LH, HL, HH of each transform and the root's LL, at their worst in any stage of either pass.
    total = 12 * (2 * low * high + high * high) + low * low
    assert 2 * MAX_COEFF * total * 2 * 6497 < 2**63


@pytest.mark.large
@pytest.mark.parametrize("n", [17, 64, 129])
def test_forward_gains_are_far_below_the_limit(n):
    rng = np.random.default_rng(n)
    for _ in range(20):
        signs = np.where(rng.random((n, n)) < 0.5, -1, 1) << 37
        # The forward transform multiplies a sum of two values by at most 6497 < 2**12.7.
        assert np.abs(forward(signs)).max() < 1 << 48


def test_band_gains_are_the_norms_of_basis_functions():
    n, t_last = 257, 4
    for t in range(t_last):
        for band in (1, 2, 3):
            field = np.zeros((n, n), dtype=np.int64)
            row = ((n // 2 >> t + 1) * 2 + (band >> 1)) << t
            n_low = ((n - 1) >> (t + 1)) + 1
            col = (n // 2 >> t + 1) + (n_low if band & 1 else 0)
            field[row, col] = 1 << 30
            norm = np.sqrt((inverse(field).astype(float) ** 2).sum()) / 2**30
            assert abs(BAND_GAINS[t, band] * norm / 4096 - 1) < 0.01


def test_transform_counts():
    assert [n_transforms(n, 1) for n in (1, 2, 3, 5, 9, 513)] == [1, 1, 2, 3, 4, 10]
