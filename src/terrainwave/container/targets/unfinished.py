"""Unfinished files: locked while their process lives, so that later runs can remove leftovers.

They are called ``.name.random`` plus a suffix, next to the final file.
"""

import hashlib
import os
import re
import secrets
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

from terrainwave.container.spool import storage_errors
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
