"""Fixed steps: within the bound, the same again, whatever stands beside."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import RASTER_DTYPES

from terrainwave.grid.quantum import HeightScan, as_fraction
from terrainwave.grid.steps import FixedSteps

BOUNDS = [1e-5, 0.004, 0.01, 0.1, 0.5, 1, 3, 3.7, 6, 250, 4e4, 1e12]


def bits(heights):
    return heights.view(f"u{heights.itemsize}")


def any_heights(dtype, seed):
    """Return heights of all sizes, both ends of whole numbers, zeros and a denormal number."""
    rng = np.random.default_rng(seed)
    dtype = np.dtype(dtype)
    if dtype.kind == "f":
        sizes = 10.0 ** rng.uniform(-4, 9, 500)
        least = np.finfo(dtype).smallest_subnormal
        return np.r_[(rng.normal(size=500) * sizes).astype(dtype), least, -least, -0.0, np.nan]
    limits = np.iinfo(dtype)
    return np.r_[
        rng.integers(limits.min, limits.max, 500, endpoint=True),
        np.arange(limits.min, limits.min + 90), np.arange(limits.max - 89, limits.max + 1),
    ].astype(dtype)  # fmt: skip


def halves(steps, dtype):
    """Return heights between two steps, and the floats next to them: where rounding is hardest."""
    counts = np.arange(-300, 300) * 37 + 0.5
    # Small ones, and around the largest multiples that are floats, of either type.
    far = [counts + 2.0**power for power in (17, 19, 21, 23, 38, 40, 45, 48, 51)]
    own = (np.r_[(counts, *far)] * float(steps.step)).astype(dtype)
    return np.r_[own, np.nextafter(own, own - own), np.nextafter(own, own + own)]


@given(st.sampled_from(RASTER_DTYPES), st.sampled_from(BOUNDS), st.integers(0, 2**32 - 1))
def test_rounded_heights_are_within_the_bound_and_stay(dtype, bound, seed):
    steps = FixedSteps.of(as_fraction(bound), dtype)
    if steps is None:
        assert bound < 1  # each whole number counts
        assert np.dtype(dtype).kind in "iu"
        return
    heights = any_heights(dtype, seed)
    if np.dtype(dtype).kind == "f":
        heights = np.r_[heights, halves(steps, dtype)]
    rounded = steps.rounded(heights)
    assert rounded.dtype == heights.dtype
    for own, found in zip(heights.tolist(), rounded.tolist(), strict=True):
        assert own != own or abs(Fraction(own) - Fraction(found)) <= as_fraction(bound)
    np.testing.assert_array_equal(bits(steps.rounded(rounded)), bits(rounded))
    alone = [steps.rounded(heights[at : at + 1])[0] for at in range(0, heights.size, 97)]
    np.testing.assert_array_equal(alone, rounded[::97])


@pytest.mark.parametrize(
    ("bound", "dtype", "step"),
    [
        (0.5, "float32", 1),
        (3, "float32", 6),
        (0.25, "float64", Fraction(1, 2)),
        (0.1, "float32", Fraction(25, 128)),  # 0.1953: the largest of 5 bits that is <= 0.2
        (0.1, "float64", Fraction(819, 4096)),  # 0.19995, of 12 bits
        (3.7, "int16", 7),
        (1, "uint8", 3),
    ],
)
def test_steps_are_the_widest_that_keep_the_bound(bound, dtype, step):
    assert FixedSteps.of(as_fraction(bound), dtype).step == step


@pytest.mark.parametrize(("bound", "dtype"), [(0.9, "int32"), (0, "float32"), (1e-20, "float64")])
def test_bounds_without_room_for_steps_have_none(bound, dtype):
    assert FixedSteps.of(as_fraction(bound), dtype) is None


def test_voids_and_heights_beside_them_stay():
    steps = FixedSteps.of(Fraction(1, 2), "float32", -9999)
    heights = np.array([-9999, -9998.7, -9998.4, np.nan, 2.3], "f4")
    expected = np.array([-9999, -9998.7, -9998, np.nan, 2], "f4")
    np.testing.assert_array_equal(steps.rounded(heights), expected)
    assert not steps.hold(heights[1:3])
    assert steps.hold(heights[2:3])


def test_float32_reaches_the_highest_peaks_at_a_centimetre():
    heights = np.linspace(-11000, 9000, 999, dtype="f4")
    assert FixedSteps.of(as_fraction(0.01), "float32").hold(heights)


def test_scans_of_parts_know_whether_all_heights_have_a_step():
    steps = FixedSteps.of(Fraction(1, 2), "float32")
    near, far = np.array([[1.2, 7.9]], "f4"), np.array([[3e9, 0]], "f4")
    valid = np.ones((1, 2), bool)

    def scan_of(*parts):
        whole = HeightScan("float32", steps)
        for part in parts:
            scan = HeightScan("float32", steps)
            scan.update(part, valid)
            whole.merge(scan)
        return whole

    found = scan_of(near, near + 10).quantizer(Fraction(0), may_have_remainders=True)
    assert (found.step, found.quantum, found.rho, found.remainder_bytes) == (1, 1, 0.5, 0)
    np.testing.assert_array_equal(found.dequantize(found.quantize(near, valid)), [[1, 8]])
    for parts in ((near, far), (far, near)):
        found = scan_of(*parts).quantizer(Fraction(0), may_have_remainders=True)
        assert (found.step, found.remainder_bytes) == (1, 4)
