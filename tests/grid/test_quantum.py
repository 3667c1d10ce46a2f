"""The vertical quantum: detection, the step, and what rounding may cost."""

import re
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import heights_arrays

from terrainwave.errors import InvalidHeightsError
from terrainwave.grid.quantum import HeightScan, Quantizer, as_fraction

TENTH = Fraction(1, 10)
WHOLE = np.array([[-3, 0, 7, 11]])


def scan_of(*windows, valid=None):
    scan = HeightScan(windows[0].dtype.name)
    for window in windows:
        scan.update(window, np.ones(window.shape, dtype=bool) if valid is None else valid)
    return scan


def quantizer_of(heights, max_error):
    return scan_of(heights).quantizer(as_fraction(max_error))


def all_valid(heights):
    return np.ones(heights.shape, dtype=bool)


def there_and_back(quantizer, heights, error=0):
    """Quantize, move by `error` quanta within the range, dequantize."""
    quanta = quantizer.quantize(heights, all_valid(heights)).astype(np.int64) + error
    quanta = np.clip(quanta, quantizer.z_min, quantizer.z_max).astype(np.int32)
    return quantizer.dequantize(quanta)


def exact_errors(a, b):
    """Return the differences as rationals: float64 would round them."""
    return [abs(Fraction(float(x)) - Fraction(float(y))) for x, y in zip(a.flat, b.flat)]


def grid_of(p, dtype, count=200):
    """Return neighbouring multiples of p, each the float nearest to the number."""
    multiples = [k * p for k in range(-count // 2, count // 2)]
    return np.array([[float(m) for m in multiples]]).astype(dtype)


@pytest.mark.parametrize("dtype", ["int16", "int32", "uint16"])
def test_integers_with_a_common_factor_have_it_as_quantum(dtype):
    assert scan_of(np.array([[30, 0, 45]], dtype=dtype)).true_quantum() == 15


def test_the_common_factor_is_that_of_all_windows():
    windows = np.array([[12, 24]], dtype="int16"), np.array([[-18]], dtype="int16")
    assert scan_of(*windows).true_quantum() == 6


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(
    "p",
    [
        Fraction(1),
        TENTH,
        Fraction(1, 100),
        Fraction(1, 1000),
        Fraction(3048, 10000),
        Fraction(3048, 100000),
        Fraction(1, 4),
        Fraction(1, 128),
        Fraction(1, 1024),
    ],
    ids=str,
)
def test_floats_on_a_grid_have_it_as_quantum(p, dtype):
    assert scan_of(grid_of(p, dtype)).true_quantum() == p


def test_decimals_far_from_zero_are_recognised_as_long_as_floats_tell_them_apart():
    heights = np.array([[8848.1, 8848.2, 8000.7]], dtype="float32")
    assert scan_of(heights).true_quantum() == TENTH


def test_one_sample_off_the_grid_in_a_later_window_means_none():
    heights = grid_of(TENTH, "float64")
    assert scan_of(heights, np.array([[np.pi]])).true_quantum() is None


def test_void_samples_do_not_count():
    heights = grid_of(TENTH, "float64", 4)
    heights[0, 1] = np.pi
    valid = np.array([[True, False, True, True]])
    assert scan_of(heights, valid=valid).true_quantum() == TENTH


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_continuous_floats_have_no_quantum(dtype):
    heights = np.random.default_rng(1).uniform(0, 100, (20, 20)).astype(dtype)
    assert scan_of(heights).true_quantum() is None


def test_a_decimal_grid_as_fine_as_the_floats_themselves_is_none():
    # Around 3000 float32's lie 1/4096 apart: any of them is the nearest to a multiple of 10^-6.
    heights = np.array([[3000.0002, 10.333333, 2999.7773]], dtype="float32")
    assert scan_of(heights).true_quantum() is None


@pytest.mark.parametrize(
    ("max_error", "step", "effective"),
    [
        (0, 1, 0),
        (0.05, 1, 0),  # half a quantum on a grid of 0.1: lossless
        (0.1, 3, 0.1),
        (0.25, 5, 0.2),  # 2 delta / p = 5 is odd
        (0.3, 7, 0.3),
        (0.35, 7, 0.3),
    ],
)
def test_the_step_on_a_grid_of_a_tenth(max_error, step, effective):
    # n = 2 floor((delta - rho) / p) + 1
    quantizer = quantizer_of(grid_of(TENTH, "float64"), max_error)
    assert (quantizer.step, quantizer.rho) == (step, 0)
    assert quantizer.effective_error == pytest.approx(effective, abs=1e-12)


def test_a_bound_beyond_the_range_keeps_the_step_within_its_field():
    quantizer = quantizer_of(WHOLE.astype("int16"), 1e300)
    assert quantizer.step <= 2**31 - 1
    assert quantizer.step >> 1 >= 14  # the range itself


continuous = st.tuples(
    st.sampled_from(["float32", "float64"]),
    st.integers(0, 2**32 - 1),
    st.sampled_from([1e-3, 1.0, 300.0, 9000.0]),
    st.sampled_from([0.0, -500.0, 1e5, 1e7]),
    st.floats(1e-4, 1e4),
)


@given(continuous, st.booleans())
def test_rounding_costs_at_most_rho_and_half_a_step_more_keeps_the_bound(case, upward):
    dtype, seed, spread, offset, max_error = case
    heights = (np.random.default_rng(seed).uniform(0, spread, (4, 9)) + offset).astype(dtype)
    try:
        quantizer = quantizer_of(heights, max_error)
    except InvalidHeightsError:
        assume(False)
    errors = exact_errors(there_and_back(quantizer, heights), heights)
    assert max(errors) <= Fraction(quantizer.rho)
    half = quantizer.step >> 1
    back = there_and_back(quantizer, heights, half if upward else -half)
    on_grid = quantizer.rho == 0  # then the bound is one of the numbers, not of their floats
    slack = Fraction(float(np.spacing(np.abs(heights).max()))) if on_grid else 0
    assert max(exact_errors(back, heights)) <= Fraction(quantizer.effective_error) + slack


@given(heights_arrays(max_side=8), st.just(0) | st.floats(1e-3, 1e6))
def test_the_step_is_odd_and_the_effective_bound_at_most_the_one_asked_for(heights, max_error):
    try:
        quantizer = quantizer_of(heights, max_error)
    except InvalidHeightsError:
        return
    assert quantizer.step % 2 == 1
    asked = as_fraction(max_error)
    p = Fraction(quantizer.numerator, quantizer.denominator)
    assert (quantizer.step >> 1) * p + Fraction(quantizer.rho) <= asked * (1 + Fraction(1, 10**12))


def test_continuous_floats_get_a_quantum_of_at_most_a_32nd_of_the_bound():
    heights = np.random.default_rng(2).uniform(0, 100, (20, 20))
    quantizer = quantizer_of(heights, 0.3)
    assert quantizer.quantum <= 0.3 / 32


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(
    "p", [TENTH, Fraction(1, 100), Fraction(3048, 10000), Fraction(1, 64)], ids=str
)
def test_zero_error_on_a_true_grid_gives_the_same_bits(p, dtype):
    for heights in (grid_of(p, dtype), (1e7 + np.arange(20)).reshape(4, 5).astype(dtype)):
        assert there_and_back(quantizer_of(heights, 0), heights).tobytes() == heights.tobytes()


def test_zero_error_works_on_decimals_ten_million_up():
    heights = np.array([[10_000_000.1, 10_000_000.2, 10_000_037.9]])
    quantizer = quantizer_of(heights, 0)
    assert Fraction(quantizer.numerator, quantizer.denominator) == TENTH
    assert there_and_back(quantizer, heights).tolist() == heights.tolist()


OFF_GRID = {
    "float32": np.array([[0.123456, 1.0, 99.87654]], dtype="float32"),
    "float64": np.array([[np.pi, 1.0, 7e3]]),
    "seventh": np.array([[1 / 7, 1.0, 1e7]]),
    "constant": np.full((2, 2), np.pi),
    "int32 extremes": np.array([[-(2**31), 0, 2**31 - 1]], dtype="int32"),
}


def advised_bound(heights):
    with pytest.raises(InvalidHeightsError) as caught:
        quantizer_of(heights, 0)
    return float(re.search(r"at least ([0-9.e+-]+)", str(caught.value)).group(1))


@pytest.mark.parametrize("name", OFF_GRID)
def test_zero_error_off_the_grid_is_refused_with_a_bound_that_works(name):
    quantizer_of(OFF_GRID[name], advised_bound(OFF_GRID[name]))


@pytest.mark.parametrize("max_error", [256, 259.5, 260, 1000, 12345])
def test_int32_extremes_keep_the_effective_bound(max_error):
    low = np.arange(-(2**31), -(2**31) + 40, dtype="int64")
    heights = np.concatenate([low, low + 2**31, 2**31 - 40 + np.arange(40)])
    heights = heights.reshape(3, 40).astype("int32")
    quantizer = quantizer_of(heights, max_error)
    assert quantizer.effective_error <= max_error
    for error in (-(quantizer.step >> 1), quantizer.step >> 1):
        back = there_and_back(quantizer, heights, error)
        assert np.abs(back.astype("int64") - heights).max() <= quantizer.effective_error


def test_the_widest_range_fits_thirty_bits():
    heights = np.array([[-(2**31), 2**31 - 1]], dtype="int32")
    quantizer = quantizer_of(heights, advised_bound(heights))
    assert quantizer.z_max - quantizer.z_min < 2**30  # FORMAT.md §4.1


WIDE = np.array([[1e17, 0.0, 3.3e16, -5e15 - 1]])
SMALL = np.array([[3.3e-20, 0.0, 1e-21]])


@pytest.mark.parametrize(
    ("heights", "max_error"),
    [(WIDE, 1e10), (WIDE, 1e300), (SMALL, 1e-9), (OFF_GRID["float64"], 1e300), (SMALL, 1e300)],
)
def test_floats_of_any_size_keep_the_bound(heights, max_error):
    quantizer = quantizer_of(heights, max_error)
    half = quantizer.step >> 1
    errors = exact_errors(there_and_back(quantizer, heights, half), heights)
    assert max(errors) <= Fraction(quantizer.effective_error) <= as_fraction(max_error)


@pytest.mark.parametrize("heights", [WIDE, SMALL, OFF_GRID["float64"]])
@pytest.mark.parametrize("max_error", [1e-9, 1e10, 1e300])
def test_the_quantum_is_within_the_limits_of_the_header(heights, max_error):
    max_error = max(max_error, advised_bound(heights))
    quantizer = quantizer_of(heights, max_error)
    assert max(quantizer.numerator, quantizer.denominator) < 2**63  # FORMAT.md §4.1
    assert (abs(quantizer.base) + 2**31) * quantizer.numerator < 2**63


def test_heights_that_can_only_be_nodata_are_refused_with_that_advice():
    heights = np.array([[-3.4028234663852886e38, 812.4]], dtype="float32")
    with pytest.raises(InvalidHeightsError, match="nodata"):
        quantizer_of(heights, 1)


def test_dequantized_heights_stay_in_the_type():
    heights = np.array([[-(2**31), 2**31 - 1]], dtype="int32")
    quantizer = quantizer_of(heights, 300)
    beyond = np.array([[quantizer.z_min - 50, quantizer.z_max + 50]], dtype=np.int32)
    assert quantizer.dequantize(beyond).tolist() == heights.tolist()


def interval(quantizer, value):
    """Return the raw heights at the ends of the quanta that give `value`, and just outside."""
    low, high = quantizer.quanta_of_value(value)
    quanta = np.array([[low - 1, low, high, high + 1]], dtype=np.int32)
    return quantizer.dequantize(quanta)[0].tolist()


def test_on_a_true_grid_one_quantum_gives_the_nodata_value():
    quantizer = quantizer_of(np.array([[-10, 20]], dtype="int16"), 1)  # p = 10
    assert interval(quantizer, 0) == [-10, 0, 0, 10]


@pytest.mark.parametrize("value", [None, np.nan, np.inf, -32768, 21, 5, 1e300])
def test_a_value_that_no_height_can_take_has_no_quanta(value):
    quantizer = quantizer_of(np.array([[-10, 20]], dtype="int16"), 1)
    low, high = quantizer.quanta_of_value(value)
    assert low > high


def test_all_quanta_that_round_to_the_nodata_value_are_found():
    # float32's near 10^7 are 1 apart and p is 1/64: 9999999 takes 31 quanta on each side (the
    # halves are ties and go to even neighbours).
    heights = np.array([[0.1234567, 1e7]], dtype="float32")
    quantizer = quantizer_of(heights, 3)
    assert quantizer.quantum == 1 / 64
    low, high = quantizer.quanta_of_value(9_999_999.0)
    assert high - low + 1 == 63
    assert interval(quantizer, 9_999_999.0) == [9_999_998, 9_999_999, 9_999_999, 10_000_000]


def test_nodata_that_is_not_a_float32_is_found_as_the_float32_it_becomes():
    heights = grid_of(TENTH, "float32")
    quantizer = quantizer_of(heights, 0.1)
    nearest = float(np.float32(0.1))
    assert interval(quantizer, 0.1)[1:3] == [nearest, nearest]


def test_a_header_that_gives_one_height_to_all_quanta_is_no_trap():
    quantizer = Quantizer("int16", 1, 2**40, 0, 1, 0.0, -(2**29), 2**29)
    assert quantizer.quanta_of_value(0) == (-(2**29), 2**29)


def test_quanta_beyond_the_range_of_the_type_give_its_last_value():
    heights = np.array([[-(2**31), 2**31 - 1]], dtype="int32")
    quantizer = quantizer_of(heights, 1000)  # p is 8, and the last quantum 2^31: it is clipped
    assert quantizer.quanta_of_value(2**31 - 1) == (quantizer.z_max, quantizer.z_max)


@pytest.mark.parametrize(
    ("dtype", "denominator", "base", "value", "expected"),
    [
        ("uint8", 1, 0, 255, (255, 2**30 - 1)),  # beyond the type every quantum gives its last
        ("float32", 1, 2**61, 2.0**61, (-(2**29), 2**30 - 1)),  # floats there are 2^37, 2^38 apart
        ("int16", 2**62, 0, 0, (-(2**29), 2**30 - 1)),  # all round to 0
    ],
)
def test_a_billion_quanta_that_give_the_nodata_value_are_not_counted_one_by_one(
    monkeypatch, dtype, denominator, base, value, expected
):
    # Legal fields of a hostile header: one by one this takes hours.
    quantizer = Quantizer(dtype, 1, denominator, base, 1, 0.0, -(2**29), 2**30 - 1)
    n_calls = 0
    height_of = Quantizer.height_of

    def counted(self, quantum):
        nonlocal n_calls
        n_calls += 1
        if n_calls > 200:
            raise AssertionError("more than 200 quanta were tried")
        return height_of(self, quantum)

    monkeypatch.setattr(Quantizer, "height_of", counted)
    assert quantizer.quanta_of_value(value) == expected


@given(
    st.sampled_from(["float32", "float64"]),
    st.sampled_from([TENTH, Fraction(1, 100), Fraction(3048, 10000), Fraction(1, 4), None]),
    st.floats(0.001, 30) | st.sampled_from([0.1, 0.3, 0.5, 0.7, 1.0, 2.5, 10.0]),
    st.integers(0, 2**32 - 1),
)
def test_a_strict_bound_holds_for_stored_floats(dtype, p, max_error, seed):
    rng = np.random.default_rng(seed)
    heights = rng.integers(-300, 300, (1, 60)) + rng.choice([0, 90_000]) * rng.integers(0, 2)
    heights = (rng.uniform(0, 900, (1, 60)) if p is None else grid_numbers(heights, p)).astype(
        dtype
    )
    quantizer = scan_of(heights).quantizer(as_fraction(max_error), is_strict=True)
    assert quantizer.is_strict(max_error)
    half = quantizer.step >> 1
    for error in (-half, half):
        decoded = there_and_back(quantizer, heights, error)
        assert max(exact_errors(decoded, heights)) <= max_error
        assert float(np.abs(decoded - heights).max()) <= max_error


def grid_numbers(counts, p):
    return np.array([[float(int(k) * p) for k in counts.flat]])


@pytest.mark.parametrize(
    ("p", "max_error", "quanta"),
    [
        (Fraction(1, 4), 1.0, 4),  # every multiple is a float: nothing to keep away from
        (TENTH, 1.05, 10),  # room for a spacing
        (TENTH, 0.05, 0),  # lossless
    ],
)
def test_a_strict_bound_costs_nothing_where_there_is_room(p, max_error, quanta):
    scan = scan_of(grid_of(p, "float32"))
    strict = scan.quantizer(as_fraction(max_error), is_strict=True)
    assert strict == scan.quantizer(as_fraction(max_error))
    assert (strict.step, strict.rho) == (2 * quanta + 1, 0)


@pytest.mark.parametrize("max_error", [0.1, 1.0, 10.0])
def test_a_strict_bound_loses_at_most_a_quantum_of_a_bin(max_error):
    scan = scan_of(grid_of(TENTH, "float32"))
    plain, strict = (scan.quantizer(as_fraction(max_error), is_strict=k) for k in (False, True))
    assert not plain.is_strict(max_error)
    assert plain.step * plain.quantum > strict.step * strict.quantum
    assert strict.step * strict.quantum > 0.99 * (plain.step - 1) * plain.quantum


def test_a_strict_bound_counts_the_rounding_of_binary_steps_finer_than_floats():
    # Floats around 90,000 lie 8/1024 apart: decoded 5/1024 lower, 90,000 would be 8/1024 off.
    heights = np.array([[0.0, 1 / 1024, 0.5, 90_000.0]], dtype="float32")
    scan, bound = scan_of(heights), Fraction(5, 1024)
    plain, strict = (scan.quantizer(bound, is_strict=is_strict) for is_strict in (False, True))
    assert max(exact_errors(there_and_back(plain, heights, -5), heights)) > bound
    assert not plain.is_strict(float(bound))
    half = strict.step >> 1
    assert max(exact_errors(there_and_back(strict, heights, -half), heights)) <= bound


def test_a_raster_without_valid_samples_has_a_quantum():
    scan = HeightScan("float32")
    scan.update(np.full((2, 2), np.nan, dtype="float32"), np.zeros((2, 2), dtype=bool))
    assert scan.true_quantum() == 1
