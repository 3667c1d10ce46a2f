"""A file that ends too early, presented in its full size."""

from collections.abc import Sequence

from terrainwave.container.sources.byte_source import ByteSource
from terrainwave.container.sources.ranges import ByteRange
from terrainwave.container.sources.zip_member import MemberSource


class CutFile(MemberSource):
    """The bytes of a truncated file, followed by zeros, for which no checksum holds.

    Parameters
    ----------
    source : ByteSource
        The existing bytes; closed by `close`.
    size : int
        Bytes of the whole file.
    """

    def __init__(self, source: ByteSource, size: int) -> None:
        super().__init__(source.name, source, 0, size)

    def _read_spans(self, spans: Sequence[ByteRange]) -> list[bytes]:
        n_there = self._archive.size
        there = [
            ByteRange(min(span.offset, n_there), max(min(span.end, n_there) - span.offset, 0))
            for span in spans
        ]
        found = super()._read_spans(there)
        return [
            data + bytes(span.length - len(data)) for span, data in zip(spans, found, strict=True)
        ]

    def _read(self, offset: int, length: int) -> bytes:
        return self._read_spans([ByteRange(offset, length)])[0]
