"""Does the native library make the quanta and fills that numba's kernels make?"""

import numpy as np
import pytest

from terrainwave.grid import convert, convert_in_c

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
