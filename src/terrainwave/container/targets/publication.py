"""Atomic publication: a file appears whole under its name, or not at all.

What a killed run leaves behind is removed by the next one, once its lock is free.
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
    RETRIES,
    Part,
    can_rename_open_files,
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
# What GDAL keeps next to a raster: statistics and other metadata, overviews, a mask.
OF_GDAL = (".aux.xml", ".ovr", ".msk")

_ON_WINDOWS = os.name == "nt"
_FIRST_DELAY = 0.05  # seconds; doubles. Virus scanners hold a new file for a moment on Windows


@contextmanager
def publish(
    target: str | os.PathLike[str], overwrite: bool = False, *, is_update: bool = False
) -> Iterator[Part]:
    """Give a file to write that takes the name `target` when the block ends without exception.

    On any exception the unfinished file is removed and the target is as it was before. Parts that
    killed runs have left beside the target are removed, if no living process holds their lock.
    What GDAL keeps next to a raster of that name describes another raster, and is removed at the
    end, as GDAL does where it makes a raster.

    Parameters
    ----------
    target : path
        A symbolic link is followed.
    overwrite : bool
        Whether an existing file may be replaced; it keeps its permissions.
    is_update : bool
        The file is a new state of the raster that is there: what GDAL keeps of it stays.

    Yields
    ------
    part : Part

    Raises
    ------
    InvalidArgumentError
        If `overwrite` is neither true nor false, or `target` is a URL.
    StorageError
        Before the block: if the target exists and `overwrite` is false, is no regular file, or
        its directory is missing or not writable. After it: if the disk is full or the target
        cannot be replaced; or, once it is, if a file of GDAL's cannot be removed.
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
        part = _create_part(final, created)
        with naming_full_disk(f"cannot write {target}"):
            yield part
        with storage_errors(f"cannot write {target}"):
            part.file.flush()
            os.fsync(part.file.fileno())
            _copy_permissions(final, part.path)
        _check_target(final, overwrite)
        if not can_rename_open_files():
            part.file.close()
        with interrupts.publishing(os.fspath(target)):
            _replace(part.path, final)
            is_published = True
        _log.debug("wrote %s", final)
        if not is_update:
            remove_of_gdal(target, *OF_GDAL)
        _sync_directory(final.parent)
    finally:
        dispose(part, [] if is_published else created)


def remove_of_gdal(target: str | os.PathLike[str], *suffixes: str) -> None:
    """Remove files that GDAL keeps next to a raster, also next to what a symbolic link leads to.

    Raises
    ------
    StorageError
        If one cannot be removed.
    """
    for name in {os.path.realpath(target), os.path.abspath(target)}:
        for path in (Path(f"{name}{suffix}") for suffix in suffixes):
            # Names as long as the system takes have none.
            if os.path.lexists(path):
                with storage_errors(f"cannot remove {path}, which describes an earlier raster"):
                    path.unlink(missing_ok=True)


def check_target(target: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Raise `StorageError` now if `publish` would: for work that takes long before it writes."""
    _check_target(Path(os.path.realpath(target)), overwrite)


def refuse_own_source(
    source: object,
    target: str | os.PathLike[str],
    *,
    problem: str = "is the file to be read; expected another name for the result",
) -> None:
    """Raise `StorageError` if `target` is the file that `source` is, or is read from.

    Replacing it would leave the user without the original.

    Parameters
    ----------
    source : object
        A path, or something opened whose `name` is one, or a list of these; what is no path is no
        file's.
    target : path
    problem : str
        What the message says of `target`.
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
    except (OSError, ValueError):  # one of them is missing, or no path at all: a URL
        is_same = "://" in os.fspath(target) and os.fspath(path) == os.fspath(target)
    if is_same:
        raise StorageError(f"{os.fspath(target)} {problem}")


@contextmanager
def scratch(target: str | os.PathLike[str]) -> Iterator[Part]:
    """Give a file beside `target` for an intermediate result; it is removed when the block ends.

    Killed runs' files are removed as those of `publish` are.
    """
    created: list[Path] = []
    part = None
    try:
        part = _create_part(Path(os.path.realpath(target)), created)
        yield part
    finally:
        dispose(part, created)


@contextmanager
def scratch_directory(parent: str | os.PathLike[str], name: str) -> Iterator[Path]:
    """Give a directory for temporary files that is removed when the block ends.

    It is called ``.name.random.twz-scratch``; beside it lies a locked file, ``.twz-lock``, which is
    there before it and after it. What killed runs with the same `name` have left in `parent` is
    removed first, if no living process holds its lock.

    Raises
    ------
    StorageError
        If `parent` is missing or not writable.
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
    """Give a scratch directory among the system's temporary files."""
    return scratch_directory(tempfile.gettempdir(), "terrainwave")


def _remove_scratch(lock_path: Path, lock: BinaryIO) -> None:
    """Remove a scratch directory, then its lock; what cannot be removed keeps its lock's file."""
    directory = lock_path.with_suffix(SCRATCH_SUFFIX)
    shutil.rmtree(directory, ignore_errors=True)
    dispose(Part(lock_path, lock), [] if directory.exists() else [lock_path])


@contextmanager
def publish_directory(
    target: str | os.PathLike[str], marker: str, overwrite: bool = False
) -> Iterator[Path]:
    """Give a directory to fill that takes the name `target` when the block ends without exception.

    On any exception it is removed and the target is as it was before.

    Parameters
    ----------
    target : path
    marker : str
        Name of a file that every such directory has: no other one is replaced.
    overwrite : bool
        Whether an existing directory with `marker` may be replaced; an empty one always is.

    Raises
    ------
    InvalidArgumentError
        If `overwrite` is neither true nor false, or `target` is a URL.
    StorageError
        Before the block: if the target exists and may not be replaced, or its parent is missing or
        not writable. After it: if the target cannot be replaced.
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
    """Remove what killed runs left beside `final`; return the removed paths.

    A part whose lock is held, or cannot be tried on this system, stays.
    """
    removed: list[Path] = []
    for path in leftovers(final.parent, final.name, SUFFIX):
        with taken(path) as file:
            if file is not None:
                # What GDAL made beside it goes first: nothing would lead there later.
                paths = [*beside(path), path]
                dispose(Part(path, file), paths)
                removed += paths
    return removed


def beside(part: Path) -> list[Path]:
    """Return the files that GDAL made beside an unfinished one, such as overviews of a COG."""
    prefix = f"{part.name}."
    return [part.with_name(name) for name in listed(part.parent) if name.startswith(prefix)]


def _create_part(final: Path, created: list[Path]) -> Part:
    return create_locked(final, SUFFIX, created, f"cannot write {final}")


def _copy_permissions(final: Path, part: Path) -> None:
    with suppress(FileNotFoundError):
        os.chmod(part, stat.S_IMODE(os.stat(final).st_mode))


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


def _sync_directory(directory: Path) -> None:
    """Make the new name itself survive a power cut, where directories can be opened."""
    with suppress(OSError):
        handle = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
