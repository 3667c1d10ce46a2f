"""A file inside a zip at any address: ``zip://dem.twz::https://example.org/all.zip``.

A stored member is read in place, by ranges of the archive. A deflated one has no ranges: a small
one is read whole, with a warning, a large one refused.
"""

import io
import struct
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from typing import IO, cast

from terrainwave.arguments import size_of
from terrainwave.container.sources.byte_source import (
    MAX_WHOLE,
    BufferSource,
    ByteSource,
)
from terrainwave.container.sources.ranges import ByteRange
from terrainwave.errors import StorageError, TerrainwaveWarning, TruncatedStreamError

_TAIL = 1 << 16  # directory of small archives, and the longest comment after it
_LOCAL_HEADER = 30
# zipfile's errors for bytes that are not an archive, or an unsupported one.
_DAMAGE = (zipfile.BadZipFile, NotImplementedError, EOFError, ValueError, zlib.error, struct.error)


class MemberSource(ByteSource):
    """Bytes `start` to `start + size` of another source."""

    def __init__(self, name: str, archive: ByteSource, start: int, size: int) -> None:
        self.name, self._archive, self._start, self.size = name, archive, start, size
        self.is_local = archive.is_local

    @property
    def n_replies(self) -> int:
        return int(getattr(self._archive, "n_replies", 0))

    def _read_spans(self, spans: Sequence[ByteRange]) -> list[bytes]:
        return self._archive.read_spans(
            [ByteRange(self._start + span.offset, span.length) for span in spans]
        )

    def _read(self, offset: int, length: int) -> bytes:
        return self._archive.read(self._start + offset, length)

    def check_unchanged(self) -> None:
        self._archive.check_unchanged()

    def close(self) -> None:
        self._archive.close()

    def __reduce__(self) -> tuple[type["MemberSource"], tuple[str, ByteSource, int, int]]:
        return MemberSource, (self.name, self._archive, self._start, self.size)


class CutFile(MemberSource):
    """A truncated file of `size` bytes, whose end is zeros, for which no checksum holds."""

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


def open_member(path: str, source: ByteSource) -> ByteSource:
    """Return the source of the file `path` in a zip; close the zip's on failure."""
    try:
        return _member(path.lstrip("/"), source)
    except BaseException:
        source.close()
        raise


def _member(path: str, source: ByteSource) -> ByteSource:
    at = source.name
    name = f"zip://{path}::{at}"
    try:
        with zipfile.ZipFile(cast(IO[bytes], _AsFile(source))) as archive:
            names = [info.filename for info in archive.infolist() if not info.is_dir()]
            if path not in names:
                found = ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
                raise StorageError(f"{at} has no file {path}; found {found or 'none'}")
            info = archive.getinfo(path)
            if info.flag_bits & 1:
                raise StorageError(f"{name} is encrypted; unpack the archive and open the file")
            if info.compress_type == zipfile.ZIP_STORED:
                return MemberSource(name, source, *_place(info, source))
            if info.compress_type != zipfile.ZIP_DEFLATED:
                raise StorageError(
                    f"{name} is compressed by method {info.compress_type} of zip; store it without"
                    " compression (zip -0)"
                )
            if max(info.file_size, info.compress_size) > MAX_WHOLE:
                raise StorageError(
                    f"{name} is compressed in its archive, so that no parts of it can be read;"
                    f" files of more than {MAX_WHOLE >> 20} MiB are not taken whole: store it"
                    " without compression (zip -0), or unpack it"
                )
            with archive.open(info) as file:
                data = file.read(MAX_WHOLE + 1)
    except (*_DAMAGE, TruncatedStreamError) as error:
        raise StorageError(f"cannot read {name}: {error}") from error
    warnings.warn(
        f"{name} is compressed in its archive, so all of it was read, {size_of(len(data))}",
        TerrainwaveWarning,
        stacklevel=2,
    )
    source.close()
    whole = BufferSource(data)
    whole.name = name
    return whole


def _place(info: zipfile.ZipInfo, source: ByteSource) -> tuple[int, int]:
    head = source.read(info.header_offset, _LOCAL_HEADER)
    lengths = int.from_bytes(head[26:28], "little"), int.from_bytes(head[28:30], "little")
    start = info.header_offset + _LOCAL_HEADER + sum(lengths)
    if head[:4] != b"PK\x03\x04" or start + info.file_size > source.size:
        raise zipfile.BadZipFile("the archive's directory names a place where no file is")
    return start, info.file_size


class _AsFile:
    """A source as the file that `zipfile` reads; its end, with the directory, is read at once."""

    def __init__(self, source: ByteSource) -> None:
        self._source, self._at = source, 0
        self._tail_at = max(source.size - _TAIL, 0)
        self._tail = source.read(self._tail_at, source.size - self._tail_at)

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = max(offset + {0: 0, 1: self._at, 2: self._source.size}[whence], 0)
        return self._at

    def tell(self) -> int:
        return self._at

    def read(self, n: int = -1) -> bytes:
        """Return the next `n` bytes, or fewer at the end."""
        end = self._source.size if n < 0 else min(self._at + n, self._source.size)
        length = max(end - self._at, 0)
        if length > MAX_WHOLE:
            raise zipfile.BadZipFile(f"its directory claims {length:,} bytes")
        inside = self._at - self._tail_at
        if inside >= 0:
            data = self._tail[inside : inside + length]
        else:
            data = self._source.read(self._at, length) if length else b""
        self._at += length
        return data
