"""Targets by URL: a file is made and proved on this machine, then uploaded as a whole."""

import logging
import os
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
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

# They show a file only once all of it is there; elsewhere it is renamed at the end.
_OBJECT_STORES = {"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oss", "oci", "r2"}
_READ_ONLY = {"http", "https", "zip", "tar", "github", "reference"}


@contextmanager
def uploaded(
    url: str, *, overwrite: bool = False, temp_dir: str | os.PathLike[str] | None = None
) -> Iterator[Part]:
    """Give a file to write that appears at a URL when the block ends without exception.

    Parameters
    ----------
    url : str
        Where fsspec can write.
    overwrite : bool
        Whether a file that is there may be replaced.
    temp_dir : path, optional
        Where the file is made; by default among the system's temporary files.

    Raises
    ------
    InvalidArgumentError
        If nothing can be written to URLs of this kind.
    StorageError
        Before the block: if the file exists and `overwrite` is false, or its storage cannot be
        reached. After it: if it cannot be uploaded; the finished file then stays on this machine,
        and the message says where.
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
    """A file that is not there yet, in one of fsspec's file systems."""

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
        """Say whether there is a file of this name."""
        return bool(self._call(self._fs.exists, self.path))

    def put(self, path: Path) -> None:
        """Upload a file: all of it appears, or nothing."""
        self._call(put_whole, self._fs, os.fspath(path), self.path)
        self._fs.invalidate_cache()
        _log.info("uploaded %s", self.name)
        found, expected = self._call(self._fs.size, self.path), path.stat().st_size
        if found != expected:
            raise StorageError(
                f"cannot write {self.name}: found {found} bytes there, expected {expected}"
            )
        for old in (f"{self.path}{suffix}" for suffix in OF_GDAL):
            # The file is there, which is what was asked for. Storage may forbid to look or to
            # remove, and GDAL's driver ignores old statistics.
            with suppress(Exception):
                if self._fs.exists(old):
                    self._fs.rm_file(old)

    def _call(self, function: Callable[..., Any], *args: Any) -> Any:
        # File systems raise what their libraries raise; few of those are OSErrors.
        try:
            return function(*args)
        except TerrainwaveError:
            raise
        except Exception as error:
            reason = without_secrets(in_one_line(error)) or type(error).__name__
            raise StorageError(f"cannot write {self.name}: {reason}") from error


def put_whole(filesystem: Any, path: str, target: str) -> None:
    """Copy a file of this machine into one of fsspec's file systems: all of it appears, or nothing.

    Raises whatever the file system does.
    """
    protocols = filesystem.protocol
    if not _OBJECT_STORES.isdisjoint([protocols] if isinstance(protocols, str) else protocols):
        filesystem.put_file(path, target)
        return
    unfinished = f"{target}.{secrets.token_hex(8)}.twz-part"
    try:
        filesystem.put_file(path, unfinished)
        filesystem.mv(unfinished, target)
    except BaseException:
        with suppress(Exception):  # it may not be there
            filesystem.rm_file(unfinished)
        raise
