"""Finished work that outlives a killed run, for the next run of the same command.

It lies in a directory: a *journal* of appended records, each whole or not at all, and arrays in
files of their own, whose filled part the journal states. A record is a name, values and bytes; a
later one of the same name replaces it.

After a kill all writes are there. After a power cut only synchronised ones are: then the journal
counts up to its last mark of synchronisation.
"""

import hashlib
import json
import os
import shutil
import stat
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self, TypeVar

from terrainwave.container.spool import TEMPORARY_ADVICE, cannot_write, storage_errors, write_all
from terrainwave.container.targets.publication import own_path, scratch_directory
from terrainwave.errors import BoundViolationError, InvalidHeightsError, StorageError

KEPT_SUFFIX = ".twz-kept"

_JOURNAL, _ARRAY = "journal", ".array"
# Magic, length of the values as JSON, length of the bytes, CRC-32 of both.
_HEAD = struct.Struct("<4sIQI")
_MAGIC = b"twzK"
# The first record's name is the version of the layout; other versions are not read.
_RUN, _BOOT, _SYNCED = "run 3", "boot", "synced"
# Seconds between two records of work in progress, and between two synchronisations.
TICK, _SYNC = 0.2, 10.0
_CHUNK = 1 << 20  # bytes to read and check at a time

Item = TypeVar("Item")
Result = TypeVar("Result")


class _Record(NamedTuple):
    name: str
    values: dict[str, Any]
    offset: int
    n_bytes: int


class Kept:
    """Finished work of one run in a directory, None to keep nothing; thread-safe.

    `run` is everything that the work depends on, as plain values for JSON. `other` is that of other
    work that was found in the directory and removed, `n_found` the number of an earlier run's
    records. Raises `StorageError` if the directory cannot be used.
    """

    def __init__(self, directory: Path | None = None, run: dict[str, Any] | None = None) -> None:
        self.directory = directory
        self.other: dict[str, Any] | None = None
        self.n_found = 0
        self.run: dict[str, Any] = json.loads(json.dumps(run or {}))  # as it will be read
        self._lock = threading.Lock()
        self._records: dict[str, _Record] = {}
        self._ticked: dict[str, float] = {}
        self._end = 0
        self._file: BinaryIO | None = None
        if directory is not None:
            with storage_errors(f"cannot use {directory}"):
                self._open(directory)

    @property
    def is_on(self) -> bool:
        return self._file is not None

    @property
    def n_bytes(self) -> int:
        return 0 if self.directory is None else sum(map(_on_disk, self._paths(self.directory)))

    @property
    def n_kept(self) -> int:
        return len(self.names())

    def names(self) -> list[str]:
        return [name for name in self._records if name not in (_RUN, _BOOT, _SYNCED)]

    def get(self, name: str) -> dict[str, Any] | None:
        record = self._records.get(name)
        return None if record is None else record.values

    def data(self, name: str) -> bytes:
        assert self._file is not None
        record = self._records[name]
        with self._lock, storage_errors(f"cannot read {self._file.name}"):
            self._file.seek(record.offset)
            return self._file.read(record.n_bytes)

    def put(self, name: str, values: dict[str, Any], data: bytes = b"") -> None:
        if self._file is None:
            return
        with self._lock:
            self._append(name, values, data)
            if time.monotonic() - self._ticked.setdefault(_SYNCED, time.monotonic()) >= _SYNC:
                self._synchronise()
                self._ticked[_SYNCED] = time.monotonic()

    def is_due(self, name: str) -> bool:
        """Return whether a record of work in progress is due; it then counts as stored."""
        now = time.monotonic()
        if self._file is None or now - self._ticked.setdefault(name, now) < TICK:
            return False
        self._ticked[name] = now
        return True

    def path(self, name: str) -> Path | None:
        return None if self.directory is None else self.directory / f"{name}{_ARRAY}"

    def each(
        self,
        name: str,
        items: Iterable[Item],
        do: Callable[[Iterable[Item]], Iterable[Result]],
        *,
        is_there: bool,
        values: Callable[[], dict[str, Any]] = dict,
    ) -> Iterator[Result]:
        """Yield the results of `do` for the items that are not done yet, in order.

        An item is done when the next result is requested; the record then has `values`, too.
        """
        if not is_there and self.get(name) is not None:
            self.put(name, {"done": 0})
        done = (self.get(name) or {}).get("done", 0)
        for result in do(islice(items, done, None)):
            yield result
            done += 1
            if self.is_due(name):
                self.put(name, {"done": done, **values()})
        if not self.is_whole(name):
            self.put(name, {"done": done, "is_whole": True, **values()})

    def is_whole(self, name: str) -> bool:
        return "is_whole" in (self.get(name) or {})

    def clear(self) -> None:
        if self.directory is None:
            return
        self.close()
        with self._lock, storage_errors(f"cannot use {self.directory}"):
            self._remove_all(self.directory)
            self._open(self.directory)

    def close(self) -> None:
        with self._lock:
            if self._file is not None:
                self._file.close()
            self._file, self._records = None, {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _open(self, directory: Path) -> None:
        path = directory / _JOURNAL
        if path.exists() and not self._read(path):
            self._remove_all(directory)
        is_new = not path.exists()
        # Unbuffered: writes survive a kill.
        self._file = open(path, "w+b" if is_new else "r+b", buffering=0)
        self._end = 0 if is_new else self._end
        self._file.truncate(self._end)
        self.n_found = self.n_kept
        if is_new:
            self._append(_RUN, self.run)
        self._append(_BOOT, {"id": _boot()})

    def _read(self, path: Path) -> bool:
        """Read the journal's valid records; return whether it belongs to this run."""
        found: dict[str, _Record] = {}
        end, synced, boot = 0, (found, 0), None
        with open(path, "rb") as file:
            for record in _records(file):
                if not found and (record.name, record.values) != (_RUN, self.run):
                    self.other = record.values if record.name == _RUN else {}
                    return False
                found[record.name] = record
                end = record.offset + record.n_bytes
                if record.name == _BOOT:
                    boot = record.values.get("id")
                if record.name in (_RUN, _SYNCED):
                    synced = found.copy(), end
        if not found:
            self.other = {}
            return False
        self._records, self._end = (found, end) if boot == _boot() else synced
        return True

    def _append(self, name: str, values: dict[str, Any], data: bytes = b"") -> None:
        assert self._file is not None
        text = json.dumps({"name": name, "values": values}).encode()
        head = _HEAD.pack(_MAGIC, len(text), len(data), zlib.crc32(data, zlib.crc32(text)))
        try:
            self._file.seek(self._end)
            write_all(self._file, head + text + data)
        except OSError as error:
            raise cannot_write(self._file.name, error, advice=TEMPORARY_ADVICE) from error
        offset = self._end + len(head) + len(text)
        self._records[name] = _Record(name, values, offset, len(data))
        self._end = offset + len(data)

    def _synchronise(self) -> None:
        assert self._file is not None
        assert self.directory is not None
        with storage_errors(f"cannot write {self.directory}", advice=TEMPORARY_ADVICE):
            for path in self._paths(self.directory):
                with open(path, "r+b") as file:
                    os.fsync(file.fileno())
        self._append(_SYNCED, {})

    def _paths(self, directory: Path) -> list[Path]:
        return [directory / _JOURNAL, *directory.glob(f"*{_ARRAY}")]

    def _remove_all(self, directory: Path) -> None:
        for path in self._paths(directory):
            path.unlink(missing_ok=True)


def _records(file: BinaryIO) -> Iterator[_Record]:
    size = os.fstat(file.fileno()).st_size
    while len(head := file.read(_HEAD.size)) == _HEAD.size:
        magic, n_text, n_data, crc = _HEAD.unpack(head)
        offset = file.tell() + n_text
        if magic != _MAGIC or offset + n_data > size:
            return
        text = file.read(n_text)
        own_crc = zlib.crc32(text)
        for start in range(0, n_data, _CHUNK):
            own_crc = zlib.crc32(file.read(min(_CHUNK, n_data - start)), own_crc)
        if own_crc != crc:
            return
        content = json.loads(text)
        yield _Record(content["name"], content["values"], offset, n_data)


def _boot() -> str:
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return os.urandom(8).hex()


def _on_disk(path: Path) -> int:
    with suppress(OSError):
        found = os.stat(path)
        return getattr(found, "st_blocks", found.st_size // 512) * 512
    return 0


@contextmanager
def kept_directory(
    parent: str | os.PathLike[str], target: Path, run: dict[str, Any] | None, *, fresh: bool
) -> Iterator[tuple[Path, Kept]]:
    """Yield a directory for temporary files, and the work kept in it.

    It is called ``.name.digits.twz-kept``. It is removed at the end of the block, unless the block
    raises an exception after work was kept: then a note of the exception names it. The caller must
    be the only writer of `target` (`publication.only_writer`). `fresh` discards an earlier run's
    work; without `run` nothing is kept. Raises `StorageError` if the directory cannot be used.
    """
    path = own_path(target, Path(parent), KEPT_SUFFIX)
    if fresh or run is None:
        _remove(path)
    if run is None:
        with scratch_directory(parent, target.name) as directory:
            yield directory, Kept()
        return
    with storage_errors(f"cannot make a temporary directory in {parent}"):
        path.mkdir(mode=0o700, exist_ok=True)
        found = os.lstat(path)
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != getattr(os, "geteuid", lambda: 0)():
        raise StorageError(f"{path} belongs to another user: expected no such directory")
    _remove_others(path)
    kept = Kept(path, run)
    is_left = False
    try:
        yield path, kept
    except BaseException as error:
        is_left = kept.n_kept > 0 and not isinstance(error, _FINAL)
        if is_left:
            error.add_note(
                f"finished work is in {path}: run the same command again to go on;"
                " `fresh` starts over"
            )
        raise
    finally:
        kept.close()
        if is_left:
            _remove_others(path)
        else:
            _remove(path)


def digest_of_file(path: str | os.PathLike[str]) -> str:
    with storage_errors(f"cannot read {os.fspath(path)}"), open(path, "rb") as file:
        return hashlib.file_digest(file, "blake2b").hexdigest()[:32]


# Errors that the same command would raise again.
_FINAL = (InvalidHeightsError, BoundViolationError)


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True)


def _remove_others(directory: Path) -> None:
    for path in directory.iterdir():
        if path.name != _JOURNAL and path.suffix != _ARRAY:
            if path.is_dir() and not path.is_symlink():
                _remove(path)
            else:
                with suppress(OSError):
                    path.unlink()
