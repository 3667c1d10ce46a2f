"""Does the native library make the quanta, fills and errors that numba's kernels make?"""

import numpy as np
import pytest

from terrainwave.grid import block_stats, convert, convert_in_c

pytestmark = [pytest.mark.native, pytest.mark.full]
INTEGERS = "i1 u1 i2 u2 i4 u4 i8".split()


def by_both(name, *arguments, out):
    """Return what a function fills by numba and by C, as bytes."""
    found = []
    for function in (getattr(convert, name).__wrapped__, getattr(convert_in_c, name)):
        filled = [array.copy() for array in out]
        function(*arguments, *filled)
        found.append([array.tobytes() for array in filled])
    return found


def raw_heights(rng, dtype, shape):
    """Return heights of all the range of a type, its limits among them."""
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        raw = rng.integers(limits.min, limits.max, shape, dtype=dtype, endpoint=True)
        raw.flat[:2] = limits.min, limits.max
        return raw
    raw = (rng.normal(size=shape) * 10.0 ** rng.integers(-3, 6)).astype(dtype)
    raw.flat[:4] = np.nan, -np.inf, np.finfo(dtype).smallest_subnormal, -0.0
    return raw


@pytest.mark.parametrize("dtype", [*INTEGERS, "f4", "f8"])
def test_quanta_are_the_same(dtype, with_library):
    rng = np.random.default_rng(1)
    for shape in ((1, 1), (7, 31), (64, 65)):
        raw = raw_heights(rng, np.dtype(dtype), (max(shape[0], 2), max(shape[1], 2)))
        valid = (rng.random(raw.shape) < 0.9) & np.isfinite(raw)
        quanta = np.empty(raw.shape, dtype=np.int32)
        for numerator, base in ((1, 0), (3, -7), (1000, 5), (2**31 - 1, 1 << 40)):
            if np.dtype(dtype).kind in "iu":
                by_numba, in_c = by_both(
                    "quantize_integers", raw, valid, numerator, base, out=[quanta]
                )
                assert by_numba == in_c
            for denominator in (1, 2, 100, 1 << 30):
                most = 2.0**60 * numerator / denominator
                some = valid & (np.abs(np.where(valid, raw, 0).astype(np.float64)) < most)
                scale = numerator, denominator, base
                by_numba, in_c = by_both("quantize_floats", raw, some, *scale, out=[quanta])
                assert by_numba == in_c


VIEWS = {
    "rows of an odd number of bytes": {"offset": 0, "strides": (2 * 9 + 1, 2)},
    "not aligned": {"offset": 1, "strides": (2 * 9, 2)},
    "backwards": {"offset": 2 * 9 * 7, "strides": (-2 * 9, 2)},
    "by columns": {"offset": 0, "strides": (2, 2 * 8)},
}


@pytest.mark.parametrize("view", VIEWS)
def test_quanta_of_any_view_are_the_same(view, with_library):
    raw = np.ndarray((8, 9), np.int16, np.zeros(200, np.uint8), **VIEWS[view])
    raw[...] = np.arange(72).reshape(8, 9) - 30
    valid = raw % 7 > 0
    quanta = np.empty(raw.shape, dtype=np.int32)
    by_numba, in_c = by_both("quantize_integers", raw, valid, 3, -7, out=[quanta])
    assert by_numba == in_c


def test_ties_go_to_even(with_library):
    raw = np.array([[0.5, 1.5, 2.5, -0.5, -1.5, 2.0**52 + 1, 2.0**51 + 0.5, -(2.0**51) - 1.5]])
    quanta = np.empty(raw.shape, dtype=np.int32)
    convert_in_c.quantize_floats(raw, np.ones(raw.shape, dtype=bool), 1, 1, 0, quanta)
    # Python's own rounding, modulo 2**32.
    assert quanta[0].tolist() == [
        (round(height) + 2**31) % 2**32 - 2**31 for height in raw[0].tolist()
    ]


def test_averages_and_fills_are_the_same(with_library):
    rng = np.random.default_rng(2)
    for _ in range(200):
        shape = tuple(int(n) for n in rng.integers(1, 24, 2))
        first = tuple(int(rng.integers(0, min(2, n))) for n in shape)
        fine = rng.integers(-(1 << 30), 1 << 30, shape).astype(np.int32)
        fine[rng.random(shape) < rng.choice([0.0, 0.3, 0.9, 1.0])] = convert.UNKNOWN
        above = tuple((n - at + 1) // 2 for n, at in zip(shape, first, strict=True))
        values, known = np.empty(above, dtype=np.int32), np.empty(above, dtype=np.bool_)
        lines = np.empty((2, shape[1]), dtype=np.int64)
        by_numba, in_c = by_both("push", fine, *first, lines, out=[values, known])
        assert by_numba == in_c
        below = tuple(int(rng.integers(1, 2 * n)) for n in shape)
        is_known = rng.random(below) < rng.random()
        by_numba, in_c = by_both(
            "pull", fine, *first, is_known, out=[rng.integers(-9, 9, below).astype(np.int32)]
        )
        assert by_numba == in_c


@pytest.mark.parametrize("dtype", [*INTEGERS, "f4", "f8"])
def test_heights_are_the_same(dtype, with_library):
    rng = np.random.default_rng(3)
    quanta = rng.integers(-(1 << 31), 1 << 31, (9, 14)).astype(np.int32)
    for numerator, denominator, base in (
        (1, 1, 0),
        (3, 2, -7),
        (1000, 7, 1 << 40),
        (1, 1 << 30, 5),
    ):
        scale = numerator, denominator, base
        name = "dequantize_floats"
        if np.dtype(dtype).kind in "iu":
            limits = np.iinfo(dtype)
            name, scale = "dequantize_integers", (*scale, limits.min, limits.max)
        wide = np.zeros((12, 40), dtype=dtype)
        for out in (wide[:9, :14].copy(), wide[:9, 3:17]):
            in_c, by_numba = out.copy(), out.copy()
            getattr(convert, name).__wrapped__(quanta, *scale, by_numba)
            out[:] = 0
            getattr(convert_in_c, name)(quanta, *scale, out)
            assert out.tobytes() == by_numba.tobytes()
            assert in_c.shape == out.shape
        assert not wide[9:].any()
        assert not wide[:, 17:].any()


def test_ranges_and_errors_are_the_same(with_library):
    rng = np.random.default_rng(4)
    for _ in range(100):
        shape = tuple(int(n) for n in rng.integers(1, 40, 2))
        originals, decoded = rng.integers(-(1 << 31), 1 << 31, (2, *shape)).astype(np.int32)
        mask = rng.random(shape) < rng.choice([0.0, 0.5, 1.0])
        if rng.random() < 0.5:  # larger ones beside
            decoded = np.pad(decoded, ((0, 2), (0, 5)))
        first = [int(rng.integers(0, n)) for n in shape]
        at = *first, *(int(rng.integers(1, n - f + 1)) for n, f in zip(shape, first, strict=True))
        by_numba = block_stats.range_and_error.__wrapped__(originals, mask, decoded, *at)
        assert convert_in_c.range_and_error(originals, mask, decoded, *at) == by_numba


def test_deviations_from_surfaces_are_the_same(with_library, monkeypatch):
    rng, kinds = np.random.default_rng(5), set()
    own = block_stats.largest_deviation.__wrapped__
    for number in range(120):
        shift = int(rng.integers(0, 6))
        cells = tuple(int(n) for n in rng.integers(1, 9, 2))
        first = tuple(int(rng.integers(0, n << shift)) for n in cells)
        shape = tuple(
            int(rng.integers(1, (n << shift) - at + 2)) for n, at in zip(cells, first, strict=True)
        )
        relief = 1 << int(rng.choice([3, 12, 29]))
        heights = rng.integers(-relief, relief, (cells[0] + 1, cells[1] + 1)).astype(np.int32)
        # What lies beyond the window is in no range.
        rows, cols = (-(-(at + n - 1) >> shift) + 1 for at, n in zip(first, shape, strict=True))
        heights[rows:], heights[:, cols:] = 1 << 30, -(1 << 30)
        originals = rng.integers(-relief, relief, shape).astype(np.int32)
        mask = rng.random(shape) < 0.8
        originals[~mask] = rng.integers(-(1 << 31), 1 << 31, np.count_nonzero(~mask))
        limits = (-relief, relief) if number % 2 else None
        found = []
        for function in (own, convert_in_c.largest_deviation):

            def noted(*given, function=function):
                kinds.add(given[-2].dtype)
                return function(*given)

            monkeypatch.setattr(block_stats, "largest_deviation", noted)
            found.append(
                block_stats.measure_block(heights, 1 << shift, originals, mask, *first, limits)
            )
        assert found[0] == found[1]
    assert len(kinds) == 2
