"""Remainders give back every bit, whatever the decoded heights are."""

import numpy as np
import pytest

from terrainwave.grid.remainders import remainders, restored

TYPES = ["float32", "float64", "int32"]


def any_heights(dtype, seed):
    """Return heights of any finite bits, the least and largest ones and both zeros among them."""
    dtype = np.dtype(dtype)
    rng = np.random.default_rng(seed)
    bits = rng.integers(-(2**31), 2**31, (9, 8), dtype=np.int64).astype(f"i{dtype.itemsize}")
    if dtype.itemsize == 8:
        bits <<= 32
    heights = bits.view(dtype)
    if dtype.kind == "f":
        heights[~np.isfinite(heights)] = 0
        ends = np.finfo(dtype)
        heights[0, :4] = ends.min, ends.max, -0.0, ends.smallest_subnormal
    else:
        heights[0, :2] = np.iinfo(dtype).min, np.iinfo(dtype).max
    return heights


def bits(heights):
    return heights.view(f"i{heights.dtype.itemsize}")


@pytest.mark.parametrize("dtype", TYPES)
def test_every_bit_comes_back_from_any_other_height(dtype):
    raw, decoded = any_heights(dtype, 1), any_heights(dtype, 2)
    valid = np.ones(raw.shape, dtype=bool)
    np.testing.assert_array_equal(
        bits(restored(decoded, remainders(raw, valid, decoded))), bits(raw)
    )


@pytest.mark.parametrize("dtype", TYPES)
def test_nothing_is_said_of_voids(dtype):
    raw, decoded = any_heights(dtype, 1), any_heights(dtype, 2)
    assert not remainders(raw, np.zeros(raw.shape, dtype=bool), decoded).any()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_neighbouring_floats_are_one_apart_across_zero_too(dtype):
    dtype = np.dtype(dtype)
    least = np.finfo(dtype).smallest_subnormal
    one = dtype.type(1)
    order = np.array([[-least, -0.0, 0.0, least, one, np.nextafter(one, dtype.type(2))]], dtype)
    steps = remainders(order[:, 1:], np.ones((1, 5), dtype=bool), order[:, :-1])
    np.testing.assert_array_equal(np.delete(steps, 3), 1)
