"""Deflate and inflate short sections with a limit that holds while inflating (FORMAT.md §1.3)."""

import zlib

from terrainwave.errors import CorruptStreamError


def deflate(data: bytes) -> bytes:
    """Return `data` as a zlib stream."""
    return zlib.compress(data, 9)


def inflate(data: bytes, limit: int, name: str) -> bytes:
    """Return the content of a zlib stream that fills `data` exactly.

    Never holds more than ``limit + 1`` inflated bytes.

    Raises
    ------
    CorruptStreamError
        If `data` is no such stream, or its content is longer than `limit`.
    """
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(data, limit + 1)
    except zlib.error as error:
        raise CorruptStreamError(f"{name} cannot be inflated: {error}") from None
    if len(content) > limit:
        raise CorruptStreamError(f"{name} inflates to more than {limit} bytes")
    if not stream.eof:
        raise CorruptStreamError(f"{name} is a deflate stream without an end")
    if stream.unused_data:
        raise CorruptStreamError(f"{name} has {len(stream.unused_data)} bytes left over")
    return content
