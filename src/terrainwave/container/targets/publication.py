"""Atomic publication: a file appears complete under its name, or not at all.

The next run removes files left by a killed one, once their lock is free.
"""

import logging
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from terrainwave import interrupts
from terrainwave.arguments import check_flags, check_local
from terrainwave.container.spool import naming_full_disk, storage_errors
from terrainwave.container.targets.unfinished import (
    CAN_RENAME_OPEN_FILES,
    RETRIES,
    Part,
    create_locked,
    dispose,
    leftovers,
    listed,
    taken,
)
from terrainwave.errors import StorageError

_log = logging.getLogger(__name__)

SUFFIX = ".twz-part"
SCRATCH_SUFFIX = ".twz-scratch"
LOCK_SUFFIX = ".twz-lock"
# GDAL's files next to a raster: statistics and other metadata, overviews, a mask.
OF_GDAL = (".aux.xml", ".ovr", ".msk")

_ON_WINDOWS = os.name == "nt"
_FIRST_DELAY = 0.05  # seconds; doubles. On Windows virus scanners briefly hold a new file


@contextmanager
def publish(
    target: str | os.PathLike[str], overwrite: bool = False, *, is_update: bool = False
) -> Iterator[Part]:
    """Yield a file to write; it gets the name `target` when the block ends without exception.

    After an exception the unfinished file is removed and the target is unchanged. Parts that killed
    runs have left next to the target are removed, unless a living process holds their lock. GDAL's
    files next to the target describe another raster and are removed at the end, unless `is_update`.
    A symbolic link is followed; `overwrite` replaces a file and keeps its permissions.

    Raises `InvalidArgumentError` or `StorageError` before the block if the target may not be
    written, after it if the disk is full, or a file cannot be replaced or removed.
    """
    check_flags(overwrite=overwrite)
    check_local(target)
    final = Path(os.path.realpath(target))
    _check_target(final, overwrite)
    remove_stale_parts(final)
    created: list[Path] = []
    part = None
    is_published = False
    try:
        part = create_locked(final, SUFFIX, created, f"cannot write {final}")
        with naming_full_disk(f"cannot write {target}"):
            yield part
        with storage_errors(f"cannot write {target}"):
            part.file.flush()
            os.fsync(part.file.fileno())
            with suppress(FileNotFoundError):
                os.chmod(part.path, stat.S_IMODE(os.stat(final).st_mode))
        _check_target(final, overwrite)
        if not CAN_RENAME_OPEN_FILES:
            part.file.close()
        with interrupts.publishing(os.fspath(target)):
            _replace(part.path, final)
            is_published = True
        _log.debug("wrote %s", final)
        if not is_update:
            remove_of_gdal(target, *OF_GDAL)
        # The new name survives a power cut, if the system can open directories.
        with suppress(OSError):
            handle = os.open(final.parent, os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
    finally:
        dispose(part, [] if is_published else created)


def remove_of_gdal(target: str | os.PathLike[str], *suffixes: str) -> None:
    """Remove GDAL's files next to a raster, also next to the target of a symbolic link."""
    for name in {os.path.realpath(target), os.path.abspath(target)}:
        for path in (Path(f"{name}{suffix}") for suffix in suffixes):
            # Names of the greatest length have none.
            if os.path.lexists(path):
                with storage_errors(f"cannot remove {path}, which describes an earlier raster"):
                    path.unlink(missing_ok=True)


def check_target(target: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Raise the `StorageError` of a later `publish` now, before long work."""
    _check_target(Path(os.path.realpath(target)), overwrite)


def refuse_own_source(
    source: object,
    target: str | os.PathLike[str],
    *,
    problem: str = "is the file to be read; expected another name for the result",
) -> None:
    """Raise `StorageError` if `target` is a file of `source`: replacing would destroy it.

    `source`: a path, or an open object with a path as `name`, or a list of these.
    """
    if isinstance(source, list | tuple):
        for one in source:
            refuse_own_source(one, target, problem=problem)
        return
    path = source if isinstance(source, str | os.PathLike) else getattr(source, "name", None)
    if not isinstance(path, str | os.PathLike):
        return
    try:
        is_same = os.path.samefile(path, target)
    except (OSError, ValueError):  # one is missing, or is not a path but a URL
        is_same = "://" in os.fspath(target) and os.fspath(path) == os.fspath(target)
    if is_same:
        raise StorageError(f"{os.fspath(target)} {problem}")


@contextmanager
def scratch(target: str | os.PathLike[str]) -> Iterator[Part]:
    """Yield a file next to `target` for an intermediate result, removed when the block ends."""
    created: list[Path] = []
    part = None
    try:
        final = Path(os.path.realpath(target))
        part = create_locked(final, SUFFIX, created, f"cannot write {final}")
        yield part
    finally:
        dispose(part, created)


@contextmanager
def scratch_directory(parent: str | os.PathLike[str], name: str) -> Iterator[Path]:
    """Yield a directory for temporary files that is removed when the block ends.

    It is called ``.name.random.twz-scratch``; next to it lies a locked file, ``.twz-lock``. Those
    that killed runs with the same `name` have left in `parent` are removed first.
    """
    parent = Path(parent)
    for stale in leftovers(parent, name, LOCK_SUFFIX):
        with taken(stale) as file:
            if file is not None:
                _remove_scratch(stale, file)
    created: list[Path] = []
    lock = None
    try:
        action = f"cannot make a temporary directory in {parent}"
        lock = create_locked(parent / name, LOCK_SUFFIX, created, action)
        path = lock.path.with_suffix(SCRATCH_SUFFIX)
        with storage_errors(action):
            path.mkdir(mode=0o700)
        yield path
    finally:
        if lock is None:
            dispose(None, created)
        else:
            _remove_scratch(lock.path, lock.file)


def system_scratch() -> AbstractContextManager[Path]:
    return scratch_directory(tempfile.gettempdir(), "terrainwave")


def _remove_scratch(lock_path: Path, lock: BinaryIO) -> None:
    directory = lock_path.with_suffix(SCRATCH_SUFFIX)
    shutil.rmtree(directory, ignore_errors=True)
    dispose(Part(lock_path, lock), [] if directory.exists() else [lock_path])


@contextmanager
def publish_directory(
    target: str | os.PathLike[str], marker: str, overwrite: bool = False
) -> Iterator[Path]:
    """Yield a directory to fill; it gets the name `target` when the block ends without exception.

    After an exception it is removed and the target is unchanged. Only an empty directory, or with
    `overwrite` one that has the file `marker`, is replaced. Errors are those of `publish`.
    """
    check_flags(overwrite=overwrite)
    check_local(target)
    final = Path(os.path.realpath(target))
    _check_directory(final, marker, overwrite)
    with scratch_directory(final.parent, final.name) as scratch:
        new, old = scratch / "new", scratch / "old"
        with storage_errors(f"cannot write {target}"):
            new.mkdir()
        with naming_full_disk(f"cannot write {target}"):
            yield new
        _check_directory(final, marker, overwrite)
        with interrupts.publishing(os.fspath(target)), storage_errors(f"cannot write {target}"):
            if final.exists():
                os.replace(final, old)
            try:
                os.replace(new, final)
            except OSError:
                if old.exists():
                    os.replace(old, final)
                raise


def _check_directory(final: Path, marker: str, overwrite: bool) -> None:
    with storage_errors(f"cannot write {final}"):
        if not final.parent.is_dir():
            raise StorageError(f"cannot write {final}: there is no directory {final.parent}")
        if not final.exists():
            return
        if not final.is_dir():
            raise StorageError(f"cannot write {final}: it is not a directory")
        if not any(final.iterdir()):
            return
        if not (final / marker).is_file():
            raise StorageError(
                f"cannot write {final}: it is not empty and has no {marker}; expected a new"
                " directory"
            )
    if not overwrite:
        raise StorageError(f"{final} already exists and is left as it is; `overwrite` replaces it")


def _check_target(final: Path, overwrite: bool) -> None:
    with storage_errors(f"cannot write {final}"):
        try:
            mode = os.stat(final).st_mode
        except FileNotFoundError:
            if not final.parent.is_dir():
                raise StorageError(
                    f"cannot write {final}: there is no directory {final.parent}"
                ) from None
            return
    if not stat.S_ISREG(mode):
        raise StorageError(f"cannot write {final}: it is not a regular file")
    if not overwrite:
        raise StorageError(f"{final} already exists and is left as it is; `overwrite` replaces it")


def remove_stale_parts(final: Path) -> list[Path]:
    """Remove unlocked files that killed runs left next to `final`; return the removed paths."""
    removed: list[Path] = []
    for path in leftovers(final.parent, final.name, SUFFIX):
        with taken(path) as file:
            if file is not None:
                # GDAL's files go first: without the part, nothing would lead to them.
                paths = [*beside(path), path]
                dispose(Part(path, file), paths)
                removed += paths
    return removed


def beside(part: Path) -> list[Path]:
    prefix = f"{part.name}."
    return [part.with_name(name) for name in listed(part.parent) if name.startswith(prefix)]


def _replace(part: Path, final: Path) -> None:
    delay = _FIRST_DELAY
    with storage_errors(f"cannot write {final}"):
        for _ in range(RETRIES - 1):
            try:
                return os.replace(part, final)
            except PermissionError:
                if not _ON_WINDOWS:
                    raise
                _log.info("%s is in use, trying again in %g s", final, delay)
                time.sleep(delay)
                delay = min(2 * delay, 1.0)
        os.replace(part, final)
