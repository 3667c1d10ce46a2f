"""Deflate and inflate short sections with a limit that applies while inflating (FORMAT.md §1.3)."""

import zlib

from terrainwave.errors import CorruptStreamError

_RAW = -zlib.MAX_WBITS


def deflate(data: bytes, dictionary: bytes = b"") -> bytes:
    """Return `data` as a zlib stream, or as a raw one with a preset dictionary, if given."""
    if not dictionary:
        return zlib.compress(data, 9)
    stream = zlib.compressobj(9, wbits=_RAW, memLevel=9, zdict=dictionary)
    return stream.compress(data) + stream.flush()


def inflate(data: bytes, limit: int, name: str, dictionary: bytes = b"") -> bytes:
    """Undo `deflate`; the stream must fill `data` exactly.

    Never holds more than ``limit + 1`` inflated bytes.

    Raises
    ------
    CorruptStreamError
        If `data` is not such a stream, or its content is longer than `limit`.
    """
    stream = zlib.decompressobj(_RAW, dictionary) if dictionary else zlib.decompressobj()
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
