"""Parts that all modules share: errors, numbers, deflate (§1), annexes (§15)."""

import struct
import zlib
from math import prod
from pathlib import Path


def annex(name):
    """Return the bytes of an annex (§15)."""
    return (Path(__file__).parents[1] / "annexes" / name).read_bytes()


def tables(name, *layout):
    """Return the tables of an annex as nested lists; `layout` has kind and shape of each."""
    data, at, found = annex(name), 0, []
    for kind, *shape in layout:
        code = f"<{prod(shape)}{kind}"
        numbers = list(struct.unpack_from(code, data, at))
        at += struct.calcsize(code)
        for size in reversed(shape[1:]):
            numbers = [numbers[i : i + size] for i in range(0, len(numbers), size)]
        found.append(numbers)
    assert at == len(data), name
    return found


class CorruptError(Exception):
    """The bytes contradict the document (§1.2)."""


class UnsupportedError(CorruptError):
    """The bytes follow rules of a later version (§1.2)."""


def require(condition, message, error=CorruptError):
    if not condition:
        raise error(message)


def clamp(x, low, high):
    return min(max(x, low), high)


def corrected(unit, place, height, low, high):
    """§5.5."""
    if not unit.corrections:
        return height
    return clamp(height + unit.corrections[place[0]][place[1]], low, high)


def ceil_div(a, b):
    return -(-a // b)


def at_or_zero(grid, i, j):
    return grid[i][j] if 0 <= i < len(grid) and 0 <= j < len(grid[0]) else 0


def zeros(n_rows, n_cols):
    return [[0] * n_cols for _ in range(n_rows)]


def inflate(data, limit, dictionary=None):
    """Inflate one zlib stream that fills `data` exactly; a raw one with a preset dictionary."""
    stream = zlib.decompressobj(-15, dictionary) if dictionary else zlib.decompressobj()
    try:
        content = stream.decompress(data, limit + 1)
    except zlib.error as error:
        raise CorruptError(str(error)) from None
    require(len(content) <= limit, "inflates to more than its limit")
    require(stream.eof, "deflated section ends early")
    require(not stream.unused_data, "bytes after a deflated section")
    return content


def read_varint(data, at):
    """Return a varint and the place after it."""
    value = 0
    for i in range(5):
        require(at + i < len(data), "varint is cut off")
        byte = data[at + i]
        value |= (byte & 127) << (7 * i)
        if byte < 128:
            require(byte > 0 or i == 0, "varint is longer than it must be")
            return value, at + i + 1
    raise CorruptError("varint has a sixth byte")


def fold(i, n):
    """Whole-sample symmetry about 0 and n - 1, repeated until inside."""
    if n == 1:
        return 0
    i %= 2 * (n - 1)
    return min(i, 2 * (n - 1) - i)
