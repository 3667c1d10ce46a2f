"""A file that ends too early, presented in its full size."""

from collections.abc import Sequence

from terrainwave.container.sources.byte_source import ByteSource
from terrainwave.container.sources.ranges import ByteRange


class CutFile:
    """The bytes of a truncated file, followed by zeros, for which no checksum holds.

    Parameters
    ----------
    source : ByteSource
        The existing bytes; closed by `close`.
    size : int
        Bytes of the whole file.
    """

    def __init__(self, source: ByteSource, size: int) -> None:
        self._source = source
        self.size = size

    @property
    def is_local(self) -> bool:
        return bool(getattr(self._source, "is_local", False))

    def read(self, offset: int, length: int) -> bytes:
        return self.read_many([ByteRange(offset, length)])[0]

    def read_many(self, ranges: Sequence[ByteRange]) -> list[bytes]:
        return self._padded(ranges, self._source.read_many([self._there(one) for one in ranges]))

    def read_spans(self, spans: Sequence[ByteRange]) -> list[bytes]:
        return self._padded(spans, self._source.read_spans([self._there(one) for one in spans]))

    def _there(self, wanted: ByteRange) -> ByteRange:
        """Return the existing part of a range."""
        offset = min(wanted.offset, self._source.size)
        return ByteRange(offset, min(wanted.length, self._source.size - offset))

    def _padded(self, ranges: Sequence[ByteRange], found: Sequence[bytes]) -> list[bytes]:
        return [
            data + bytes(wanted.length - len(data))
            for wanted, data in zip(ranges, found, strict=True)
        ]

    def check_unchanged(self) -> None:
        self._source.check_unchanged()

    def close(self) -> None:
        self._source.close()
