"""Unsigned integers of variable length: LEB128 (FORMAT.md §5.1)."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.codec.varint import decode_varint, encode_varint
from terrainwave.errors import CorruptStreamError, TruncatedStreamError

# 300 = 0b10_0101100: the low seven bits first, with the flag "more follows".
EXAMPLES = {0: "00", 1: "01", 127: "7f", 128: "8001", 300: "ac02", 2**35 - 1: "ffffffff7f"}


@pytest.mark.parametrize(("value", "hexadecimal"), EXAMPLES.items())
def test_examples_of_the_format_are_encoded(value, hexadecimal):
    assert encode_varint(value).hex() == hexadecimal


@pytest.mark.parametrize(("value", "hexadecimal"), EXAMPLES.items())
def test_examples_of_the_format_are_decoded(value, hexadecimal):
    data = bytes.fromhex(hexadecimal)
    assert decode_varint(data, 0) == (value, len(data))


@given(st.integers(0, 2**35 - 1))
def test_every_prefix_is_truncated(value):
    data = encode_varint(value)
    for length in range(len(data)):
        with pytest.raises(TruncatedStreamError):
            decode_varint(data[:length], 0)


@given(st.binary(max_size=8), st.integers(0, 9))
def test_any_bytes_give_a_number_or_our_own_error(data, byte_pos):
    try:
        value, end = decode_varint(data, byte_pos)
    except CorruptStreamError:
        return
    assert data[byte_pos:end] == encode_varint(value)
