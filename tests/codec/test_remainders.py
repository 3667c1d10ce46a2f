"""Sections of remainders: any numbers come back, no other bytes do harm."""

import numpy as np
import pytest

from terrainwave.codec.remainder_planes import decode_remainders, encode_remainders

SHAPE = 3, 5


@pytest.mark.parametrize("dtype", ["int32", "int64"])
@pytest.mark.parametrize("n_bits", [1, 7, 8, 9, 30, 62])
def test_remainders_of_any_size_come_back(dtype, n_bits):
    rng = np.random.default_rng(n_bits)
    rest = rng.integers(-(2**n_bits), 2**n_bits, SHAPE).astype(dtype)
    rest[0, :2] = np.iinfo(dtype).min, np.iinfo(dtype).max
    for own in (rest, rest >> rest.itemsize * 4, np.where(rest & 1, rest, 0)):
        found = decode_remainders(encode_remainders(own), SHAPE, own.itemsize)
        np.testing.assert_array_equal(found, own)
        assert found.dtype == own.dtype


def test_small_remainders_take_few_planes_and_none_no_bytes():
    assert encode_remainders(np.zeros(SHAPE, dtype=np.int64)) == b""
    assert encode_remainders(np.full(SHAPE, -64, dtype=np.int64))[0] == 1
