"""Targets by URL: a file is made and proved locally, then uploaded as a whole."""

import logging
import os
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from terrainwave import interrupts
from terrainwave.arguments import check_flags, in_one_line
from terrainwave.container.sources.addresses import display_name, without_secrets
from terrainwave.container.spool import storage_errors
from terrainwave.container.targets.publication import OF_GDAL, scratch_directory
from terrainwave.container.targets.unfinished import Part
from terrainwave.errors import InvalidArgumentError, StorageError, TerrainwaveError
from terrainwave.extras import need

_log = logging.getLogger(__name__)

# These show a file only once it is complete; elsewhere it is renamed at the end.
_OBJECT_STORES = {"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oss", "oci", "r2"}
_READ_ONLY = {"http", "https", "zip", "tar", "github", "reference"}


@contextmanager
def uploaded(
    url: str, *, overwrite: bool = False, temp_dir: str | os.PathLike[str] | None = None
) -> Iterator[Part]:
    """Yield a file to write; it appears at a URL when the block ends without exception.

    Parameters
    ----------
    url : str
        A URL that fsspec can write to.
    overwrite : bool
        Replace an existing file.
    temp_dir : path, optional
        Directory of the local file; by default the system's directory for temporary files.

    Raises
    ------
    InvalidArgumentError
        If URLs of this kind are not writable.
    StorageError
        Before the block: if the file exists and `overwrite` is false, or its storage cannot be
        reached. After it: if it cannot be uploaded; the finished file then stays on this machine,
        and the message names it.
    """
    check_flags(overwrite=overwrite)
    target = _Target(url)
    if not overwrite and target.exists():
        raise StorageError(
            f"{target.name} already exists and is left as it is; `overwrite` replaces it"
        )
    parent = Path(temp_dir or tempfile.gettempdir())
    with scratch_directory(parent, "terrainwave") as directory:
        path = directory / "upload.twz"
        with storage_errors(f"cannot write {path}"), path.open("w+b") as file:
            yield Part(path, file)
            file.flush()
        try:
            target.put(path)
            interrupts.note_complete(target.name)
        except TerrainwaveError as error:
            kept = parent / f"{Path(target.path).stem}-{secrets.token_hex(4)}.twz"
            with storage_errors(f"cannot write {kept}"):
                shutil.move(path, kept)
            raise StorageError(f"{error}; the finished file is {kept}: upload it") from error


class _Target:
    """A future file in one of fsspec's file systems."""

    def __init__(self, url: str) -> None:
        self.name = display_name(url)
        scheme = url.partition("://")[0].lower()
        if scheme in _READ_ONLY or "::" in url:
            raise InvalidArgumentError(
                f"found {self.name}, expected a path, or the URL of storage that takes files, such"
                " as s3://, gs://, az:// or sftp://"
            )
        fsspec = need("fsspec.core", extra="remote", purpose=f"writing {self.name}")
        self._fs, self.path = self._call(fsspec.url_to_fs, url)

    def exists(self) -> bool:
        return bool(self._call(self._fs.exists, self.path))

    def put(self, path: Path) -> None:
        """Upload a file: all of it appears, or nothing."""
        put = partial(self._fs.put_file, os.fspath(path))
        self._call(put_whole, self._fs, put, self.path)
        self._fs.invalidate_cache()
        _log.info("uploaded %s", self.name)
        found, expected = self._call(self._fs.size, self.path), path.stat().st_size
        if found != expected:
            raise StorageError(
                f"cannot write {self.name}: found {found} bytes there, expected {expected}"
            )
        for old in (f"{self.path}{suffix}" for suffix in OF_GDAL):
            # The upload is done. Storage may forbid listing or removing, and GDAL's driver ignores
            # old statistics.
            with suppress(Exception):
                if self._fs.exists(old):
                    self._fs.rm_file(old)

    def _call(self, function: Callable[..., Any], *args: Any) -> Any:
        # File systems raise errors of their libraries, most of which are not OSErrors.
        try:
            return function(*args)
        except TerrainwaveError:
            raise
        except Exception as error:
            reason = without_secrets(in_one_line(error)) or type(error).__name__
            raise StorageError(f"cannot write {self.name}: {reason}") from error


def put_whole(filesystem: Any, put: Callable[[str], None], target: str) -> None:
    """Write a file of one of fsspec's file systems: all of it appears, or nothing.

    `put` writes it under a name. Raises any error of the file system.
    """
    protocols = filesystem.protocol
    if not _OBJECT_STORES.isdisjoint([protocols] if isinstance(protocols, str) else protocols):
        put(target)
        return
    unfinished = f"{target}.{secrets.token_hex(8)}.twz-part"
    try:
        put(unfinished)
        filesystem.mv(unfinished, target)
    except BaseException:
        with suppress(Exception):  # it may not exist
            filesystem.rm_file(unfinished)
        raise
