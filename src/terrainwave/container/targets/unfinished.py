"""Unfinished files: locked while their maker lives, so that a later run may remove what is left.

They are called ``.name.random`` and a suffix, beside what they will become.
"""

import hashlib
import os
import re
import secrets
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
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
RUN_SUFFIX = ".twz-run"
# As bytes, and no symbolic link, where systems know that.
_PLAIN = getattr(os, "O_BINARY", 0) | getattr(os, "O_NOFOLLOW", 0)
_LOCKED_BYTE = 2**40  # msvcrt locks forbid reading what they cover: far behind any content
# Bytes of a name's beginning in those of temporary files: systems take 255, of which the rest, and
# what GDAL adds for overviews, take 60.
_LONGEST_NAME = 180
_RANDOM_PART = re.compile("[0-9a-f]{16}")


@dataclass(frozen=True)
class Part:
    """The unfinished file: write to `file`, read it back by `path` after a flush."""

    path: Path
    file: BinaryIO


def can_rename_open_files() -> bool:
    """Say whether this system renames open files, as Windows does not."""
    return fcntl is not None


def leftovers(directory: Path, name: str, suffix: str) -> Iterator[Path]:
    """Yield the paths in `directory` that look like ``.name.random`` and the suffix."""
    prefix = f".{_short(name)}."
    for entry in listed(directory):
        if entry.startswith(prefix) and entry.endswith(suffix):
            if _RANDOM_PART.fullmatch(entry[len(prefix) : -len(suffix)]):
                yield directory / entry


def _short(name: str) -> str:
    """Return a name to which a suffix can be added; of a long one its beginning and a checksum."""
    encoded = os.fsencode(name)
    if len(encoded) <= _LONGEST_NAME:
        return name
    # Cut between characters: some systems refuse names that are no text.
    kept = encoded[:_LONGEST_NAME].decode(errors="ignore")
    return f"{kept}~{zlib.crc32(encoded):08x}"


def listed(directory: Path) -> list[str]:
    """Return the names in a directory, none if it cannot be read."""
    try:
        return sorted(os.listdir(directory))
    except OSError:
        return []


@contextmanager
def taken(path: Path) -> Iterator[BinaryIO | None]:
    """Give a left-over file, locked; None if it is gone or not for us to take."""
    try:
        file = open(path, "r+b")
    except OSError:
        yield None
        return
    with file:
        is_ours = _try_lock(file) is _Lock.TAKEN and _is_still_there(path, file)
        yield file if is_ours else None


def create_locked(final: Path, suffix: str, created: list[Path], action: str) -> Part:
    """Create and lock a new file beside `final`, as mkstemp does but with the umask's mode.

    Its name is in `created` before the file exists: an interruption at any moment leaves nothing.
    Errors begin with `action`.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | _PLAIN
    for _ in range(RETRIES):
        path = final.parent / f".{_short(final.name)}.{secrets.token_hex(8)}{suffix}"
        created.append(path)
        with storage_errors(action):
            file = _opened(path, flags, "w+b", final)
        try:
            # Another run may have taken it for a left-over before it was locked.
            if _try_lock(file) is not _Lock.HELD_BY_OTHER and _is_still_there(path, file):
                return Part(path, file)
        except BaseException:
            file.close()
            raise
        file.close()
        with suppress(OSError):
            os.unlink(path)
    raise StorageError(f"{action}: its unfinished file cannot be locked")


def _opened(path: Path, flags: int, mode: str, name: Path) -> BinaryIO:
    """Open a file by flags of the system; errors name it by `name`, not by its descriptor."""
    return cast(BinaryIO, open(name, mode, opener=lambda *_: os.open(path, flags, 0o666)))


@contextmanager
def only_writer(target: Path, beside: Path, shown: str) -> Iterator[None]:
    """Let nobody else write `target` while the block runs: the lock of a file in `beside` is ours.

    Raises
    ------
    StorageError
        If another run has it, or the file cannot be made.
    """
    path = own_path(target, beside, RUN_SUFFIX)
    file = None
    while file is None:
        with storage_errors(f"cannot write {shown}"):
            file = _opened(path, os.O_RDWR | os.O_CREAT | _PLAIN, "r+b", path)
        if _try_lock(file) is _Lock.HELD_BY_OTHER:
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
    """Return ``.name.digits`` and a suffix in a directory, with digits that only `target` has."""
    digits = hashlib.sha256(os.fsencode(target)).hexdigest()[:16]
    return beside / f".{_short(target.name)}.{digits}{suffix}"


def _is_still_there(path: Path, file: BinaryIO) -> bool:
    try:
        return os.path.samestat(os.stat(path), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


class _Lock(Enum):
    TAKEN = 0
    HELD_BY_OTHER = 1
    NOT_POSSIBLE = 2  # no such call, or a file system without locks


def _try_lock(file: BinaryIO) -> _Lock:
    """Try to take the lock on `file` without waiting."""
    try:
        if fcntl is not None:
            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            return _Lock.TAKEN
        if msvcrt is not None:
            file.seek(_LOCKED_BYTE)
            try:
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            finally:
                file.seek(0)
            return _Lock.TAKEN
    except (BlockingIOError, PermissionError):
        return _Lock.HELD_BY_OTHER
    except OSError:
        pass
    return _Lock.NOT_POSSIBLE


def dispose(part: Part | None, paths: list[Path]) -> None:
    """Close the part and remove the files of `paths`."""
    # Before the lock goes with the closed file, so that nobody else can take the name; where an
    # open file cannot be removed, after it.
    for path in paths:
        with suppress(OSError):
            os.unlink(path)
    if part is not None:
        with suppress(OSError):
            part.file.close()
    for path in paths:
        with suppress(OSError):
            os.unlink(path)
