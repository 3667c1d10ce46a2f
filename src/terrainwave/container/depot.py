"""Entries on storage shared by several machines, until the file is assembled.

An object store needs only put, get, head and delete of known names. Failed puts are repeated, and
missing objects are requested again, so the store may show them late.
"""

import io
import logging
import os
import secrets
import time
import zlib
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.container.sources.addresses import display_name
from terrainwave.container.sources.opening import open_source
from terrainwave.container.spool import storage_errors
from terrainwave.container.targets.upload import filesystem_errors, put_whole
from terrainwave.errors import CorruptStreamError, StorageError
from terrainwave.extras import need

_log = logging.getLogger(__name__)

_NAMES_AT_A_TIME = 1000  # limit of S3's delete request
_ADVICE = "; free space there, or name another directory or URL with `temp_dir`"
_CRC_BYTES = 4  # CRC-32 of an entry, behind it
# Seconds before a retry: stores may show new objects late.
_DELAYS = (0.2, 1.0, 5.0, 15.0)

Result = TypeVar("Result")


@dataclass(frozen=True)
class Depot:
    """A directory that all machines of a run see: a path, or a URL that fsspec can write to.

    Entries appear whole or not at all, so a task can run again, or twice at a time.
    """

    root: str

    def put(self, name: str, data: bytes) -> None:
        """Store bytes under a name; raise `StorageError` if they cannot be written."""
        data += zlib.crc32(data).to_bytes(_CRC_BYTES, "little")
        where = display_name(self._path(name))
        filesystem, root = _filesystem(self.root)
        target = f"{root}/{name}"
        if "file" in filesystem.protocol:
            _put_in_place(target, data, where)
            return

        def put() -> None:
            with filesystem_errors(f"cannot write {where}"):
                put_whole(filesystem, lambda path: filesystem.pipe_file(path, data), target)

        _repeated(f"writing {where}", put)

    def get(self, name: str) -> bytes:
        """Return an entry; raise `StorageError` if missing, `CorruptStreamError` if damaged."""
        data = self._read(name, 0, None)
        end = max(len(data) - _CRC_BYTES, 0)
        if zlib.crc32(data[:end]) != int.from_bytes(data[end:], "little"):
            raise CorruptStreamError(
                f"{display_name(self._path(name))} is damaged: found {len(data):,} bytes that are"
                " not what a worker stored there"
            )
        return data[:end]

    def part(self, name: str, offset: int, length: int) -> bytes:
        return self._read(name, offset, length) if length else b""

    def _path(self, name: str) -> str:
        return f"{self.root}/{name}"

    def _read(self, name: str, offset: int, length: int | None) -> bytes:
        def read() -> bytes:
            with closing(open_source(self._path(name))) as source:
                return source.read(offset, source.size if length is None else length)

        return _repeated(f"reading {display_name(self._path(name))}", read)

    def save(self, name: str, **arrays: Any) -> None:
        file = io.BytesIO()
        np.savez(file, **arrays)
        self.put(name, file.getvalue())

    def load(self, name: str) -> dict[str, NDArray[Any]]:
        with np.load(io.BytesIO(self.get(name)), allow_pickle=False) as arrays:
            return dict(arrays)

    def remove(self, names: Iterable[str] = ()) -> None:
        """Delete `names` and all entries that the depot lists, or raise `StorageError`."""
        with filesystem_errors(f"cannot remove temporary data in {display_name(self.root)}"):
            filesystem, path = _filesystem(self.root)
            if "file" not in filesystem.protocol:
                known = [f"{path}/{name}" for name in dict.fromkeys(names)]
                for start in range(0, len(known), _NAMES_AT_A_TIME):
                    _delete(filesystem, known[start : start + _NAMES_AT_A_TIME])
                filesystem.invalidate_cache()
            with suppress(FileNotFoundError):
                if filesystem.exists(path):
                    filesystem.rm(path, recursive=True)


def _put_in_place(target: str, data: bytes, where: str) -> None:
    unfinished = Path(f"{target}.{secrets.token_hex(8)}")
    with storage_errors(f"cannot write {where}", advice=_ADVICE):
        try:
            unfinished.write_bytes(data)
            os.replace(unfinished, target)
        except BaseException:
            with suppress(OSError):
                unfinished.unlink()
            raise


def _repeated(what: str, call: Callable[[], Result]) -> Result:
    for delay in _DELAYS:
        try:
            return call()
        except (StorageError, OSError) as error:
            _log.info("%s: %s, again in %g s", what, type(error).__name__, delay)
            time.sleep(delay)
    return call()


def _delete(filesystem: Any, paths: list[str]) -> None:
    try:
        filesystem.rm(paths)
    except FileNotFoundError:  # unknown which: delete one after the other
        for path in paths:
            with suppress(FileNotFoundError):
                filesystem.rm_file(path)


def _filesystem(root: str) -> tuple[Any, str]:
    fsspec = need("fsspec.core", extra="distributed", purpose="a cluster")
    with filesystem_errors(f"cannot use {display_name(root)}"):
        filesystem, path = fsspec.url_to_fs(root)
    return filesystem, path
