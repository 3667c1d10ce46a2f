"""Atomic publication: a file appears complete under its name, or not at all.

The next run removes files left by a killed one, once their lock is free.
"""

import hashlib
import logging
import os
import re
import secrets
import shutil
import stat
import tempfile
import time
import zlib
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

from terrainwave import interrupts
from terrainwave.arguments import check_flags, check_local
from terrainwave.container.spool import naming_full_disk, storage_errors
from terrainwave.errors import StorageError

try:
    import fcntl
except ImportError:
    fcntl = None  # type: ignore[assignment]
try:
    import msvcrt
except ImportError:
    msvcrt = None  # type: ignore[assignment]

RETRIES = 10
CAN_RENAME_OPEN_FILES = fcntl is not None  # Windows cannot
RUN_SUFFIX = ".twz-run"
# Binary mode, and no symbolic links, if the system supports these flags.
_PLAIN = getattr(os, "O_BINARY", 0) | getattr(os, "O_NOFOLLOW", 0)
_LOCKED_BYTE = 2**40  # msvcrt locks forbid reading the locked bytes: far beyond any content
# Bytes of a name used in temporary names: systems allow 255, and the rest, with GDAL's endings for
# overviews, takes 60.
_LONGEST_NAME = 180
_RANDOM_PART = re.compile("[0-9a-f]{16}")


@dataclass(frozen=True)
class Part:
    """Unfinished file: write to `file`, read it back by `path` after a flush."""

    path: Path
    file: BinaryIO


def leftovers(directory: Path, name: str, suffix: str) -> Iterator[Path]:
    prefix = f".{_short(name)}."
    for entry in listed(directory):
        if entry.startswith(prefix) and entry.endswith(suffix):
            if _RANDOM_PART.fullmatch(entry[len(prefix) : -len(suffix)]):
                yield directory / entry


def _short(name: str) -> str:
    """Return a name with room for a suffix; of a long one its beginning and a checksum."""
    encoded = os.fsencode(name)
    if len(encoded) <= _LONGEST_NAME:
        return name
    # Cut between characters: some systems refuse names that are not valid text.
    kept = encoded[:_LONGEST_NAME].decode(errors="ignore")
    return f"{kept}~{zlib.crc32(encoded):08x}"


def listed(directory: Path) -> list[str]:
    try:
        return sorted(os.listdir(directory))
    except OSError:
        return []


@contextmanager
def taken(path: Path) -> Iterator[BinaryIO | None]:
    """Yield a leftover file, locked; None if it is gone or in use."""
    try:
        file = open(path, "r+b")
    except OSError:
        yield None
        return
    with file:
        is_ours = _try_lock(file) is True and _is_still_there(path, file)
        yield file if is_ours else None


def create_locked(final: Path, suffix: str, created: list[Path], action: str) -> Part:
    """Create and lock a new file next to `final`, like mkstemp but with the umask's mode.

    `created` gets its name before the file exists, so an interruption leaves nothing.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | _PLAIN
    for _ in range(RETRIES):
        path = final.parent / f".{_short(final.name)}.{secrets.token_hex(8)}{suffix}"
        created.append(path)
        with storage_errors(action):
            file = _opened(path, flags, "w+b", final)
        try:
            # Another run may have removed it as a leftover before it was locked.
            if _try_lock(file) is not False and _is_still_there(path, file):
                return Part(path, file)
        except BaseException:
            file.close()
            raise
        file.close()
        with suppress(OSError):
            os.unlink(path)
    raise StorageError(f"{action}: its unfinished file cannot be locked")


def _opened(path: Path, flags: int, mode: str, name: Path) -> BinaryIO:
    """Open a file with system flags; errors name it by `name`, not by its descriptor."""
    return cast(BinaryIO, open(name, mode, opener=lambda *_: os.open(path, flags, 0o666)))


@contextmanager
def only_writer(target: Path, beside: Path, shown: str) -> Iterator[None]:
    """Exclude other writers of `target` while the block runs, by locking a file in `beside`."""
    path = own_path(target, beside, RUN_SUFFIX)
    file = None
    while file is None:
        with storage_errors(f"cannot write {shown}"):
            file = _opened(path, os.O_RDWR | os.O_CREAT | _PLAIN, "r+b", path)
        if _try_lock(file) is False:
            number = file.read(_LONGEST_NAME).decode(errors="replace").strip()
            file.close()
            raise StorageError(
                f"another run is writing {shown}{f' (process {number})' * number.isdecimal()}:"
                " expected only one; wait until it ends, or name another target"
            )
        if not _is_still_there(path, file):  # the other run has just ended, and removed it
            file.close()
            file = None
    try:
        with storage_errors(f"cannot write {shown}"):
            file.truncate(0)
            file.write(str(os.getpid()).encode())
            file.flush()
        yield
    finally:
        dispose(Part(path, file), [path])


def own_path(target: Path, beside: Path, suffix: str) -> Path:
    """Return ``.name.digits`` plus a suffix in a directory, with digits unique to `target`."""
    digits = hashlib.sha256(os.fsencode(target)).hexdigest()[:16]
    return beside / f".{_short(target.name)}.{digits}{suffix}"


def _is_still_there(path: Path, file: BinaryIO) -> bool:
    try:
        return os.path.samestat(os.stat(path), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def _try_lock(file: BinaryIO) -> bool | None:
    """Take the lock on `file` without waiting; False if another process holds it.

    None if that is not possible: no such call, or a file system without locks.
    """
    try:
        if fcntl is not None:
            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        if msvcrt is not None:
            file.seek(_LOCKED_BYTE)
            try:
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            finally:
                file.seek(0)
            return True
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        pass
    return None


def dispose(part: Part | None, paths: list[Path]) -> None:
    # Removed before the file is closed and unlocked, so that nobody else can take the name; after
    # it, where open files cannot be removed.
    for path in paths:
        with suppress(OSError):
            os.unlink(path)
    if part is not None:
        with suppress(OSError):
            part.file.close()
    for path in paths:
        with suppress(OSError):
            os.unlink(path)


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
