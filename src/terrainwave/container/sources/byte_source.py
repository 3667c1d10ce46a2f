"""Byte sources: ranges of a file, of memory or of a URL, from any number of threads."""

import io
import os
import threading
from collections.abc import Callable, Sequence
from typing import BinaryIO, Protocol, runtime_checkable

from terrainwave.container.sources.ranges import ByteRange, merge_ranges, split_merged
from terrainwave.errors import StorageError, TruncatedStreamError
from terrainwave.forks import renew_after_fork

# Files up to this size are taken whole from servers, and out of archives, that give no parts.
MAX_WHOLE = 64 << 20


@runtime_checkable
class ByteSource(Protocol):
    """Random access to bytes whose number is known; thread-safe.

    A source of a path or URL can be pickled; it is opened again where it is loaded.
    """

    @property
    def size(self) -> int:
        """Return the number of bytes."""
        ...

    def read(self, offset: int, length: int) -> bytes:
        """Return exactly these bytes; raise `TruncatedStreamError` if there are fewer."""
        ...

    def read_many(self, ranges: Sequence[ByteRange]) -> list[bytes]:
        """Return the bytes of each range, in the order asked; near ones in one request."""
        ...

    def read_spans(self, spans: Sequence[ByteRange]) -> list[bytes]:
        """Return the bytes of each range, in the order asked; each is one request."""
        ...

    def check_unchanged(self) -> None:
        """Raise `StorageError` if the bytes are known to be others than when it was opened."""
        ...

    def close(self) -> None:
        """Let go of files and connections; reading afterwards raises `StorageError`."""
        ...


class MergingSource:
    """The parts that all sources share; `_read` may return less only where the source ends."""

    name: str
    size: int

    def read(self, offset: int, length: int) -> bytes:
        """Return exactly `length` bytes from `offset`."""
        self._check_range(offset, length)
        data = self._read(offset, length) if length else b""
        self._check_length(ByteRange(offset, length), data)
        return data

    def read_many(self, ranges: Sequence[ByteRange]) -> list[bytes]:
        """Return the bytes of each range, in the order asked."""
        for wanted in ranges:
            self._check_range(*wanted)
        merged = merge_ranges(ranges)
        return split_merged(ranges, merged, self._read_spans([span for span, _ in merged]))

    def read_spans(self, spans: Sequence[ByteRange]) -> list[bytes]:
        """Return the bytes of each range, in the order asked; side by side if they can be."""
        for span in spans:
            self._check_range(*span)
        return self._read_spans(spans)

    def _check_range(self, offset: int, length: int) -> None:
        if offset < 0 or length < 0 or offset + length > self.size:
            raise TruncatedStreamError(
                f"{self.name} has {self.size} bytes; {length} were expected at byte {offset}"
            )

    def _check_length(self, wanted: ByteRange, data: bytes) -> None:
        if len(data) != wanted.length:
            raise TruncatedStreamError(
                f"{self.name} ends at byte {wanted.offset + len(data)}; {wanted.length} bytes "
                f"were expected at byte {wanted.offset}"
            )

    def _read_spans(self, spans: Sequence[ByteRange]) -> list[bytes]:
        return [self.read(*span) for span in spans]

    def _read(self, offset: int, length: int) -> bytes:
        raise NotImplementedError

    def check_unchanged(self) -> None:
        """Raise nothing: files stay what they were opened as, http compares every reply."""

    @property
    def version(self) -> str:
        """Return what tells this version of the bytes from others of the same size, if anything."""
        return ""

    def close(self) -> None:
        """Let go of what the source holds."""


class FileSource(MergingSource):
    """A local file; `is_local` says that a request costs little."""

    is_local = True

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.name = os.fspath(path)
        self.renew()
        renew_after_fork(self)
        try:
            self._file: BinaryIO | None = open(self.name, "rb", buffering=0)
            self.size = self._file.seek(0, os.SEEK_END)
        except IsADirectoryError as error:
            raise StorageError(f"{self.name} is a directory; expected a .twz file") from error
        except OSError as error:
            raise StorageError(f"cannot read {self.name}: {error.strerror or error}") from error

    @property
    def version(self) -> str:
        """Return which file it is, and when it was changed: any program can set the first time."""
        if self._file is None:
            return ""
        found = os.fstat(self._file.fileno())
        return f"{found.st_dev}-{found.st_ino}-{found.st_mtime_ns}-{found.st_ctime_ns}"

    def renew(self) -> None:
        """Begin anew after a fork."""
        self._lock = threading.Lock()

    def _read(self, offset: int, length: int) -> bytes:
        file = self._file
        if file is None:
            raise StorageError(f"{self.name} is closed")
        try:
            if hasattr(os, "pread"):
                return _read_fully(lambda at, n: os.pread(file.fileno(), n, at), offset, length)
            with self._lock:
                return _read_fully(lambda at, n: _seek_read(file, at, n), offset, length)
        except (OSError, ValueError) as error:  # ValueError: closed by another thread
            raise StorageError(f"cannot read {self.name}: {error}") from error

    def close(self) -> None:
        """Close the file."""
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def __reduce__(self) -> tuple[type["FileSource"], tuple[str]]:
        return FileSource, (os.path.abspath(self.name),)


class BufferSource(MergingSource):
    """Bytes in memory, or a seekable binary file object, which stays the caller's to close."""

    def __init__(self, buffer: bytes | BinaryIO) -> None:
        self.name = getattr(buffer, "name", None) or "the buffer"
        self.renew()
        renew_after_fork(self)
        self._bytes: bytes | None = None
        if isinstance(buffer, bytes | bytearray | memoryview):
            self._bytes = bytes(buffer)
            self._file: BinaryIO = io.BytesIO(self._bytes)
        else:
            self._file = buffer
        self._is_closed = False
        try:
            self.size = self._file.seek(0, os.SEEK_END)
        except (OSError, ValueError) as error:
            raise StorageError(f"cannot seek in {self.name}: {error}") from error

    def renew(self) -> None:
        """Begin anew after a fork. A file object's place is still the parent's as well."""
        self._lock = threading.Lock()

    def _read(self, offset: int, length: int) -> bytes:
        if self._is_closed:
            raise StorageError(f"{self.name} is closed")
        try:
            with self._lock:
                return _read_fully(lambda at, n: _seek_read(self._file, at, n), offset, length)
        except (OSError, ValueError) as error:
            raise StorageError(f"cannot read {self.name}: {error}") from error

    def close(self) -> None:
        """Forget the buffer; a file object given by the caller is not closed."""
        self._is_closed = True

    def __reduce__(self) -> tuple[type["BufferSource"], tuple[bytes]]:
        if self._bytes is None:
            raise TypeError(f"{self.name}: a file object cannot be pickled; open it by its path")
        return BufferSource, (self._bytes,)


def _seek_read(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)


def _read_fully(read_at: Callable[[int, int], bytes], offset: int, length: int) -> bytes:
    """Call ``read_at(offset, length)`` until all bytes are there or the file ends."""
    parts = []
    while length:
        part = read_at(offset, length)
        if not part:
            break
        parts.append(part)
        offset += len(part)
        length -= len(part)
    return parts[0] if len(parts) == 1 else b"".join(parts)
