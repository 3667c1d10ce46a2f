"""Unsigned integers of variable length, seven bits a byte, the lowest first (FORMAT.md §1.4)."""

from terrainwave.errors import CorruptStreamError, TruncatedStreamError

_MAX_BYTES = 5


def encode_varint(value: int) -> bytes:
    """Return `value` (0 … 2^35 - 1) in the fewest bytes."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def decode_varint(data: bytes, byte_pos: int) -> tuple[int, int]:
    """Return the value at `byte_pos` and the position after it."""
    value = 0
    for n_bytes in range(_MAX_BYTES):
        if byte_pos + n_bytes >= len(data):
            raise TruncatedStreamError(f"a number is cut short (byte {byte_pos})")
        byte = data[byte_pos + n_bytes]
        value |= (byte & 0x7F) << 7 * n_bytes
        if byte < 0x80:
            if byte == 0 and n_bytes:
                raise CorruptStreamError(
                    f"a number is longer than it needs to be (byte {byte_pos})"
                )
            return value, byte_pos + n_bytes + 1
    raise CorruptStreamError(f"a number is longer than {_MAX_BYTES} bytes (byte {byte_pos})")
