"""A file that ends too early, as one of the size that it ought to have."""

from collections.abc import Sequence

from terrainwave.container.sources.byte_source import ByteSource
from terrainwave.container.sources.ranges import ByteRange


class CutFile:
    """What there is of a file, and zeros after it, for which no checksum holds.

    Parameters
    ----------
    source : ByteSource
        What there is; closed by `close`.
    size : int
        Bytes of the whole file.
    """

    def __init__(self, source: ByteSource, size: int) -> None:
        self._source = source
        self.size = size

    @property
    def is_local(self) -> bool:
        """Say whether a request costs little."""
        return bool(getattr(self._source, "is_local", False))

    def read(self, offset: int, length: int) -> bytes:
        """Return the bytes of a range."""
        return self.read_many([ByteRange(offset, length)])[0]

    def read_many(self, ranges: Sequence[ByteRange]) -> list[bytes]:
        """Return the bytes of each range, in the order asked; near ones in one request."""
        return self._padded(ranges, self._source.read_many([self._there(one) for one in ranges]))

    def read_spans(self, spans: Sequence[ByteRange]) -> list[bytes]:
        """Return the bytes of each range, in the order asked; each is one request."""
        return self._padded(spans, self._source.read_spans([self._there(one) for one in spans]))

    def _there(self, wanted: ByteRange) -> ByteRange:
        """Return the part of a range that is there."""
        offset = min(wanted.offset, self._source.size)
        return ByteRange(offset, min(wanted.length, self._source.size - offset))

    def _padded(self, ranges: Sequence[ByteRange], found: Sequence[bytes]) -> list[bytes]:
        return [
            data + bytes(wanted.length - len(data))
            for wanted, data in zip(ranges, found, strict=True)
        ]

    def check_unchanged(self) -> None:
        """Raise `StorageError` if the bytes are known to be others than when it was opened."""
        self._source.check_unchanged()

    def close(self) -> None:
        """Close what there is."""
        self._source.close()
