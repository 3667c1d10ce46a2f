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
from terrainwave.container.targets.publication import OF_GDAL, Part, scratch_directory
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

    Raises `InvalidArgumentError` if URLs of this kind are not writable. Raises `StorageError`
    before the block if the file exists, without `overwrite`, or its storage cannot be reached;
    after it if it cannot be uploaded: the finished file then stays on this machine, and the message
    names it.
    """
    check_flags(overwrite=overwrite)
    name = display_name(url)
    if url.partition("://")[0].lower() in _READ_ONLY or "::" in url:
        raise InvalidArgumentError(
            f"found {name}, expected a path, or the URL of storage that takes files, such as s3://,"
            " gs://, az:// or sftp://"
        )
    fsspec = need("fsspec.core", extra="remote", purpose=f"writing {name}")
    with filesystem_errors(f"cannot write {name}"):
        filesystem, target = fsspec.url_to_fs(url)
        if not overwrite and filesystem.exists(target):
            raise StorageError(
                f"{name} already exists and is left as it is; `overwrite` replaces it"
            )
    parent = Path(temp_dir or tempfile.gettempdir())
    with scratch_directory(parent, "terrainwave") as directory:
        path = directory / "upload.twz"
        with storage_errors(f"cannot write {path}"), path.open("w+b") as file:
            yield Part(path, file)
            file.flush()
        try:
            with filesystem_errors(f"cannot write {name}"):
                _put(filesystem, path, target, name)
            interrupts.note_complete(name)
        except TerrainwaveError as error:
            kept = parent / f"{Path(target).stem}-{secrets.token_hex(4)}.twz"
            with storage_errors(f"cannot write {kept}"):
                shutil.move(path, kept)
            raise StorageError(f"{error}; the finished file is {kept}: upload it") from error


def _put(filesystem: Any, path: Path, target: str, name: str) -> None:
    put_whole(filesystem, partial(filesystem.put_file, os.fspath(path)), target)
    filesystem.invalidate_cache()
    _log.info("uploaded %s", name)
    found, expected = filesystem.size(target), path.stat().st_size
    if found != expected:
        raise StorageError(f"cannot write {name}: found {found} bytes there, expected {expected}")
    for old in (f"{target}{suffix}" for suffix in OF_GDAL):
        # The upload is done. Storage may forbid listing or removing, and GDAL's driver ignores old
        # statistics.
        with suppress(Exception):
            if filesystem.exists(old):
                filesystem.rm_file(old)


@contextmanager
def filesystem_errors(action: str) -> Iterator[None]:
    """Turn any errors of fsspec's file systems into a `StorageError` that begins with `action`."""
    try:
        yield
    except TerrainwaveError:
        raise
    except Exception as error:
        reason = without_secrets(in_one_line(error)) or type(error).__name__
        raise StorageError(f"{action}: {reason}") from error


def put_whole(filesystem: Any, put: Callable[[str], None], target: str) -> None:
    """Let `put` write a file of a file system under a name: all of it appears, or nothing."""
    protocols = filesystem.protocol
    if not _OBJECT_STORES.isdisjoint([protocols] if isinstance(protocols, str) else protocols):
        put(target)
        return
    unfinished = f"{target}.{secrets.token_hex(8)}.twz-part"
    filesystem.makedirs(target.rpartition("/")[0], exist_ok=True)
    try:
        put(unfinished)
        filesystem.mv(unfinished, target)
    except BaseException:
        with suppress(Exception):  # it may not exist
            filesystem.rm_file(unfinished)
        raise
