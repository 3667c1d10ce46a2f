"""Temporary store of one segment's payloads until their order in the file is known."""

import errno
import os
import tempfile
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO, NamedTuple

from terrainwave.container.page import MAX_PAYLOAD, N_CODES
from terrainwave.errors import StorageError, TerrainwaveError
from terrainwave.grid.quadtree import Block

_BUFFER = 64 * 1024  # while payloads arrive
_KEPT = 4 * 1024  # after `finish`: many segments wait at the same time
_CHUNK = 16 << 20  # bytes to copy at a time


@contextmanager
def storage_errors(action: str, *, advice: str = "") -> Iterator[None]:
    """Turn an `OSError` into a `StorageError` of one clear line that begins with `action`.

    If the disk is full, it ends with `advice`.
    """
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
    """Return the error of a file, or of temporary files in a directory, that cannot be written.

    `error` is the system's, or another library's text for one.
    """
    what = f"temporary files in {path}" if os.path.isdir(path) else os.fspath(path)
    return _storage_error(f"cannot write {what}", error, advice)


def _storage_error(action: str, error: BaseException | str, advice: str) -> StorageError:
    if _is_disk_full(error):
        return StorageError(f"{action}: the disk is full{advice}")
    reason = getattr(error, "strerror", None) or error
    return StorageError(f"{action}: {reason}")


def _is_disk_full(error: BaseException | str) -> bool:
    if isinstance(error, OSError) and error.errno in _DISK_FULL:
        return True
    return os.strerror(errno.ENOSPC).lower() in str(error).lower()


# Large temporary files may lie on another disk than the file itself.
TEMPORARY_ADVICE = "; free space there, or name another directory with `temp_dir`"
_DISK_FULL = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)}


class Entry(NamedTuple):
    """Positions of a payload and its mesh in the spool, and their fields of the page."""

    offset: int
    payload_length: int
    payload_crc: int
    mesh_offset: int
    mesh_length: int
    mesh_crc: int
    flags: int


class LikeSegment(NamedTuple):
    """A segment with the payloads and codes of another one of its level, that of `head`."""

    head: Block

    def key_there(self, key: Block, head: Block) -> Block:
        """Return the key there that corresponds to a key in the segment of `head`."""
        depth = key.level - head.level
        row, col = self.head.row - head.row << depth, self.head.col - head.col << depth
        return Block(key.level, key.row + row, key.col + col)


class StoredSegment(NamedTuple):
    """Position of a stored segment without children; an absent one has length 0."""

    path: str
    offset: int
    page_length: int
    length: int

    def page(self) -> bytes:
        return b"".join(self._read(0, self.page_length))

    def sections(self) -> Iterator[bytes]:
        """Yield payloads and meshes, at most 16 MiB in memory at a time."""
        return self._read(self.page_length, self.length)

    def _read(self, first: int, end: int) -> Iterator[bytes]:
        with storage_errors(f"cannot read {self.path}"), open(self.path, "rb") as file:
            file.seek(self.offset + first)
            for start in range(first, end, _CHUNK):
                yield file.read(min(_CHUNK, end - start))


class SegmentSpool:
    """Stores the payloads of one segment in any order; `assemble` writes them in page order.

    Payloads stay in memory up to 64 KiB (4 KiB after `finish`), the rest goes to a temporary file
    in `directory`. No file stays open between calls, so thousands of spools can wait, and a spool
    can be pickled to a process that sees the same directory. Thread-safe. Errors of a full disk end
    with `advice`.
    """

    def __init__(
        self, directory: str | os.PathLike[str], *, advice: str = TEMPORARY_ADVICE
    ) -> None:
        self._directory = os.fspath(directory)
        self._advice = advice
        self._path: str | None = None
        self._spilled = 0
        self._buffer = bytearray()
        self._entries: dict[Block, Entry] = {}
        self._codes: dict[Block, bytes] = {}
        self._lock = threading.Lock()

    def add(
        self,
        key: Block,
        payload: bytes,
        flags: int = 0,
        codes: bytes | None = None,
        mesh: bytes = b"",
    ) -> None:
        """Store the payload of `key`: the parent of a group, or one of `Grid.root_keys`.

        `codes` are four bytes for each block of the payload, in Morton order; they may be set later
        by `set_codes`.
        """
        if max(len(payload), len(mesh)) > MAX_PAYLOAD:
            raise ValueError(f"payload of {len(payload)} and mesh of {len(mesh)} bytes: too long")
        if not 0 <= flags <= 255:
            raise ValueError(f"flags {flags} do not fit a byte")
        with self._lock:
            if key in self._entries:
                raise ValueError(f"{key} has already been added")
            offset = self._spilled + len(self._buffer)
            self._buffer += payload
            self._buffer += mesh
            self._entries[key] = Entry(
                offset,
                len(payload),
                zlib.crc32(payload),
                offset + len(payload),
                len(mesh),
                zlib.crc32(mesh),
                flags,
            )
            if len(self._buffer) > _BUFFER:
                self._spill()
        if codes is not None:
            self.set_codes(key, codes)

    def set_mesh(self, key: Block, mesh: bytes) -> None:
        """Set or replace the mesh of an added key."""
        if len(mesh) > MAX_PAYLOAD:
            raise ValueError(f"mesh of {len(mesh)} bytes: too long")
        with self._lock:
            self._entries[key] = self._entries[key]._replace(
                mesh_offset=self._spilled + len(self._buffer),
                mesh_length=len(mesh),
                mesh_crc=zlib.crc32(mesh),
            )
            self._buffer += mesh
            if len(self._buffer) > _BUFFER:
                self._spill()

    def set_codes(self, key: Block, codes: bytes) -> None:
        """Set or replace the codes of the blocks of the payload of `key`."""
        limit = N_CODES if key.is_root_key else 4 * N_CODES
        if len(codes) % N_CODES or len(codes) > limit:
            raise ValueError(f"{len(codes)} bytes of codes for {key}")
        self._codes[key] = bytes(codes)

    def finish(self) -> None:
        """Release memory; no payload is expected soon."""
        with self._lock:
            if len(self._buffer) > _KEPT:
                self._spill()

    def close(self) -> None:
        with self._lock:
            if self._path is not None:
                with storage_errors(f"cannot remove {self._path}"):
                    os.unlink(self._path)
            self._path, self._buffer, self._entries = None, bytearray(), {}

    def keys(self) -> list[Block]:
        """Return the keys of all entries so far."""
        return list(self._entries)

    def entry(self, key: Block) -> Entry:
        """Return the row of `key`; `KeyError` if it was not added."""
        return self._entries[key]

    def codes(self, key: Block) -> bytes:
        """Return the codes of `key`; `KeyError` if they were not set."""
        return self._codes[key]

    def chunks(self, keys: list[Block]) -> Iterator[bytes]:
        """Yield the payload, then the mesh, of each of `keys`; one payload in memory at a time.

        Raises
        ------
        StorageError
            If the temporary file is gone or damaged.
        """
        with storage_errors(f"cannot read the temporary file {self._path}"):
            file = open(self._path, "rb") if self._path is not None else None
            try:
                for key in keys:
                    yield from self._sections(file, self._entries[key])
            finally:
                if file is not None:
                    file.close()

    def _sections(self, file: BinaryIO | None, entry: Entry) -> Iterator[bytes]:
        for offset, length, crc in (
            (entry.offset, entry.payload_length, entry.payload_crc),
            (entry.mesh_offset, entry.mesh_length, entry.mesh_crc),
        ):
            if file is None or offset >= self._spilled:
                first = offset - self._spilled
                data = bytes(self._buffer[first : first + length])
            else:
                file.seek(offset)
                data = file.read(length)
            if len(data) != length or zlib.crc32(data) != crc:
                raise StorageError(f"the temporary file {self._path} is damaged")
            yield data

    def _spill(self) -> None:
        action = f"cannot write temporary files in {self._directory}"
        with storage_errors(action, advice=self._advice):
            if self._path is None:
                handle, self._path = tempfile.mkstemp(".twz-spool", "segment-", self._directory)
                os.close(handle)
            # Not "ab": after a failed write, the next one begins after the good bytes.
            with open(self._path, "r+b") as file:
                file.seek(self._spilled)
                file.write(self._buffer)
        self._spilled += len(self._buffer)
        self._buffer = bytearray()

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_lock"}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()
