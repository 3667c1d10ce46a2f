"""Checksums that always match, so that changed bytes reach what lies behind them."""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

from terrainwave.codec.cdf53 import refiner as cdf53
from terrainwave.container import header, page, reader


class _Matching(int):
    """A CRC-32 that equals whatever it is compared with."""

    def __eq__(self, other: object) -> bool:
        return True

    def __ne__(self, other: object) -> bool:
        return False

    __hash__ = int.__hash__


@contextmanager
def ignored() -> Iterator[None]:
    """Let every checksum of a file match within the `with` block."""
    lenient = SimpleNamespace(**vars(zlib))
    lenient.crc32 = lambda data, value=0: _Matching(zlib.crc32(data, value))
    modules = (cdf53, header, page, reader)
    try:
        for module in modules:
            module.zlib = lenient  # type: ignore[attr-defined]
        yield
    finally:
        for module in modules:
            module.zlib = zlib  # type: ignore[attr-defined]
