"""Temporary store of payloads until their order in the file is known."""

import errno
import os
import struct
import tempfile
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO, NamedTuple

from terrainwave.container.page import MAX_PAYLOAD
from terrainwave.errors import StorageError, TerrainwaveError
from terrainwave.grid.quadtree import Block

_BUFFER = 1 << 20
_PLACE = struct.Struct("<QQ")  # of a section: offset and length


@contextmanager
def storage_errors(action: str, *, advice: str = "") -> Iterator[None]:
    """Turn an `OSError` into a `StorageError`: `action`, reason, and `advice` for a full disk."""
    try:
        yield
    except OSError as error:
        if isinstance(error, TerrainwaveError):
            raise
        raise _storage_error(action, error, advice) from error


@contextmanager
def naming_full_disk(action: str) -> Iterator[None]:
    """Turn an error of a full disk that names no file into a `StorageError`."""
    try:
        yield
    except OSError as error:
        is_named = isinstance(error, TerrainwaveError) or error.filename is not None
        if is_named or error.errno not in (*_DISK_FULL, errno.EFBIG):
            raise
        raise _storage_error(action, error, "") from error


def cannot_write(
    path: str | os.PathLike[str], error: BaseException | str, *, advice: str = ""
) -> StorageError:
    """Return the error of a file, or temporary files in a directory, that cannot be written."""
    what = f"temporary files in {path}" if os.path.isdir(path) else os.fspath(path)
    return _storage_error(f"cannot write {what}", error, advice)


def _storage_error(action: str, error: BaseException | str, advice: str) -> StorageError:
    is_full = getattr(error, "errno", None) in _DISK_FULL
    if is_full or os.strerror(errno.ENOSPC).lower() in str(error).lower():
        return StorageError(f"{action}: the disk is full{advice}")
    return StorageError(f"{action}: {getattr(error, 'strerror', None) or error}")


# Large temporary files may lie on another disk than the file itself.
TEMPORARY_ADVICE = "; free space there, or name another directory with `temp_dir`"
_DISK_FULL = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)}


class Section(NamedTuple):
    """Position of a payload or a mesh in a `SectionFile`, and its checksum."""

    offset: int = 0
    length: int = 0
    crc: int = 0


class LikeSegment(NamedTuple):
    """A segment with the payloads and codes of another one of its level, that of `head`."""

    head: Block

    def key_there(self, key: Block, head: Block) -> Block:
        depth = key.level - head.level
        row, col = self.head.row - head.row << depth, self.head.col - head.col << depth
        return Block(key.level, key.row + row, key.col + col)


class SectionFile:
    """Temporary file of payloads and meshes in any order, in memory up to 1 MiB; thread-safe."""

    def __init__(
        self, directory: str | os.PathLike[str], *, advice: str = TEMPORARY_ADVICE
    ) -> None:
        self._directory, self._advice = os.fspath(directory), advice
        self._file: BinaryIO | None = None
        self._n_written = 0
        self._buffer = bytearray()
        self._lock = threading.Lock()

    def append(self, data: bytes) -> int:
        with self._lock:
            offset = self._n_written + len(self._buffer)
            self._buffer += data
            if len(self._buffer) > _BUFFER:
                self._write()
        return offset

    def read(self, offset: int, length: int) -> bytes:
        with self._lock:
            if self._file is None or offset >= self._n_written:
                first = offset - self._n_written
                return bytes(self._buffer[first : first + length])
            with storage_errors(f"cannot read temporary files in {self._directory}"):
                self._file.seek(offset)
                return self._file.read(length)

    def close(self) -> None:
        with self._lock:
            if self._file is not None:
                self._file.close()
            self._file, self._buffer = None, bytearray()

    __del__ = close  # after an exception

    def _write(self) -> None:
        action = f"cannot write temporary files in {self._directory}"
        with storage_errors(action, advice=self._advice):
            if self._file is None:
                self._file = tempfile.TemporaryFile(buffering=0, dir=self._directory)
            # After a failed write, the next one begins after the good bytes.
            self._file.seek(self._n_written)
            # A copy: the frames of an error keep a view, and its array cannot grow.
            write_all(self._file, bytes(self._buffer))
        self._n_written += len(self._buffer)
        self._buffer = bytearray()


def write_all(file: BinaryIO, data: bytes | bytearray) -> None:
    """Write all of `data` to an unbuffered file, which may accept less at a time."""
    view = memoryview(data)
    while view:
        view = view[file.write(view) :]


class StoredSegment(NamedTuple):
    """A segment without children whose page and places of sections are in a file."""

    file: SectionFile
    offset: int
    page_length: int
    n_sections: int
    n_bytes: int

    def page(self) -> bytes:
        return self.file.read(self.offset, self.page_length)

    def sections(self) -> Iterator[bytes]:
        places = self.file.read(self.offset + self.page_length, _PLACE.size * self.n_sections)
        for place in _PLACE.iter_unpack(places):
            yield self.file.read(*place)


class SegmentSpool:
    """Stores the payloads of one segment in any order; `assemble` writes them in page order.

    A key is the parent of a group, or one of `Grid.root_keys`. `codes` of a key are four bytes for
    each block of its payload, in Morton order.
    """

    def __init__(self, file: SectionFile) -> None:
        self._file = file
        self.payloads: dict[Block, Section] = {}
        self.meshes: dict[Block, Section] = {}
        self.codes: dict[Block, bytes] = {}

    def add(self, key: Block, payload: bytes) -> None:
        self.payloads[key] = self._stored(payload)

    def set_mesh(self, key: Block, mesh: bytes) -> None:
        self.meshes[key] = self._stored(mesh)

    def _stored(self, data: bytes) -> Section:
        if len(data) > MAX_PAYLOAD:
            raise ValueError(f"a payload or mesh of {len(data)} bytes is too long")
        return Section(self._file.append(data), len(data), zlib.crc32(data))

    def chunks(self, keys: list[Block]) -> Iterator[bytes]:
        """Yield payload and mesh of each key, or raise `StorageError` for damage."""
        for offset, length, crc in self._sections(keys):
            data = self._file.read(offset, length)
            if len(data) != length or zlib.crc32(data) != crc:
                raise StorageError("a file of temporary data is damaged")
            yield data

    def _sections(self, keys: list[Block]) -> Iterator[Section]:
        for key in keys:
            yield self.payloads[key]
            if key in self.meshes:
                yield self.meshes[key]

    def stored(self, page: bytes, keys: list[Block]) -> StoredSegment:
        places = [one[:2] for one in self._sections(keys) if page and one.length]
        data = page + b"".join(_PLACE.pack(*place) for place in places)
        n_bytes = sum(length for _, length in places)
        return StoredSegment(self._file, self._file.append(data), len(page), len(places), n_bytes)
