"""Byte sources: ranges of a file, of memory or of a URL, from any number of threads."""

import io
import os
import threading
from collections.abc import Sequence
from typing import Any, BinaryIO

from terrainwave.container.sources.ranges import ByteRange, RoundReader
from terrainwave.errors import StorageError, TruncatedStreamError
from terrainwave.forks import renew_after_fork

# Files up to this size are read whole from servers, or out of archives, without ranges.
MAX_WHOLE = 64 << 20


class ByteSource:
    """Random access to a known number of bytes; thread-safe. Ranges outside them raise.

    A source of a path or URL can be pickled; unpickling opens it again. `is_local` means that a
    request costs little. `_read` may return less only at the end of the source.
    """

    is_local = False
    name: str
    size: int

    def read(self, offset: int, length: int) -> bytes:
        """Return exactly these bytes; raise `TruncatedStreamError` if there are fewer."""
        self._check_range(offset, length)
        data = self._read(offset, length) if length else b""
        self._check_length(ByteRange(offset, length), data)
        return data

    def read_many(self, ranges: Sequence[ByteRange]) -> list[bytes]:
        """Return the bytes of each range, in the given order; near ones in one request."""
        for wanted in ranges:
            self._check_range(*wanted)
        reader = RoundReader(self)
        reader.fetch(ranges)
        return [reader.take(wanted) for wanted in ranges]

    def read_spans(self, spans: Sequence[ByteRange]) -> list[bytes]:
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
        """Raise `StorageError` if the bytes are known to have changed since the opening."""

    @property
    def version(self) -> str:
        return ""

    def close(self) -> None:
        """Close files and connections; reading afterwards raises `StorageError`."""


class BufferSource(ByteSource):
    """Bytes in memory, or a seekable binary file object, which the caller closes."""

    def __init__(self, buffer: bytes | BinaryIO) -> None:
        self.name = getattr(buffer, "name", None) or "the buffer"
        self._bytes: bytes | None = None
        if isinstance(buffer, bytes | bytearray | memoryview):
            self._bytes = bytes(buffer)
            buffer = io.BytesIO(self._bytes)
        try:
            self._begin(buffer)
        except (OSError, ValueError) as error:
            raise StorageError(f"cannot seek in {self.name}: {error}") from error

    def _begin(self, file: BinaryIO) -> None:
        self._file: BinaryIO | None = file
        self.renew()
        renew_after_fork(self)
        self.size = file.seek(0, os.SEEK_END)

    def renew(self) -> None:
        """Reset after a fork. The parent still shares a file object's position."""
        self._lock = threading.Lock()

    def _read(self, offset: int, length: int) -> bytes:
        file, parts = self._file, []
        if file is None:
            raise StorageError(f"{self.name} is closed")
        try:
            while length:
                part = self._some(file, offset, length)
                if not part:
                    break
                parts.append(part)
                offset += len(part)
                length -= len(part)
        except (OSError, ValueError) as error:  # ValueError: closed by another thread
            raise StorageError(f"cannot read {self.name}: {error}") from error
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def _some(self, file: BinaryIO, offset: int, length: int) -> bytes:
        with self._lock:
            file.seek(offset)
            return file.read(length)

    def close(self) -> None:
        self._file = None

    def __reduce__(self) -> tuple[Any, ...]:
        if self._bytes is None:
            raise TypeError(f"{self.name}: a file object cannot be pickled; open it by its path")
        return BufferSource, (self._bytes,)


class FileSource(BufferSource):
    """A local file."""

    is_local = True

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.name = os.fspath(path)
        try:
            self._begin(open(self.name, "rb", buffering=0))
        except IsADirectoryError as error:
            raise StorageError(f"{self.name} is a directory; expected a .twz file") from error
        except OSError as error:
            raise StorageError(f"cannot read {self.name}: {error.strerror or error}") from error

    @property
    def version(self) -> str:
        if self._file is None:
            return ""
        found = os.fstat(self._file.fileno())
        return f"{found.st_dev}-{found.st_ino}-{found.st_mtime_ns}-{found.st_ctime_ns}"

    def _some(self, file: BinaryIO, offset: int, length: int) -> bytes:
        if hasattr(os, "pread"):
            return os.pread(file.fileno(), length, offset)
        return super()._some(file, offset, length)

    def close(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def __reduce__(self) -> tuple[Any, ...]:
        return FileSource, (os.path.abspath(self.name),)
