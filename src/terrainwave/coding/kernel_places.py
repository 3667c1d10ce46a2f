"""Folders of compiled kernels, for reading and for writing.

Numba caches a function in one folder, and uses it only if it is writable. Here a kernel has up to
two folders: the usual one (NUMBA_CACHE_DIR, or ``__pycache__`` next to its source), which another
user may have filled, and, if that is not writable, a private one.
"""

import hashlib
import os
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from typing import NamedTuple

from terrainwave.errors import TerrainwaveWarning

# Advice if kernels are not cached.
ADVICE = "set NUMBA_CACHE_DIR to a folder that you can write"


class KernelPlace(NamedTuple):
    """Cache folders of a source file's kernels."""

    # Searched in this order; new kernels, if cached at all, go to the last one.
    folders: tuple[str, ...]
    # Display name of that folder, and of the unwritable usual folder that it replaces.
    kept_in: str | None = None
    instead_of: str = ""
    # Reason why nothing is cached, with advice.
    reason: str = ""


def place_of(source: str) -> KernelPlace:
    """Return the cache folders of a file's kernels."""
    from numba.core import config

    folder = os.path.dirname(os.path.abspath(source))
    # As numba names it: one for each folder of sources, so that installations do not collide.
    subfolder = f"{os.path.basename(folder)}_{hashlib.sha1(folder.encode()).hexdigest()}"
    if config.CACHE_DIR:
        named = os.path.abspath(config.CACHE_DIR)
        usual = os.path.join(named, subfolder)
    else:
        named = usual = os.path.join(folder, "__pycache__")
    why = _why_not_written(usual)
    if not why:
        return KernelPlace((usual,), named)
    private = _private_folder()
    if private is None:
        reason = f"{named} cannot be written ({why}), nor any private folder instead; {ADVICE}"
        return KernelPlace((usual,), reason=reason)
    return KernelPlace((usual, os.path.join(private, subfolder)), private, named)


@lru_cache(None)
def _why_not_written(folder: str) -> str:
    """Return why a folder cannot be made or written; empty if it can."""
    try:
        os.makedirs(folder, exist_ok=True)
        # As numba does: permissions do not reveal a read-only file system, for example.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return error.strerror or str(error)
    return ""


@lru_cache(None)
def _private_folder() -> str | None:
    """Return a folder that nobody else can write, because code loaded from it is run."""
    for folder in _folders_of_the_user():
        with suppress(OSError):
            with suppress(FileExistsError):
                os.mkdir(folder, 0o700)
            if _is_private(folder) and not _why_not_written(folder):
                return folder
    return None


def _folders_of_the_user() -> Iterator[str]:
    """Yield candidates for a private folder: below the user's cache, then a temporary one.

    Never below the working directory, the last resort of temporary folders.
    """
    cache = os.path.join(_user_cache(), "terrainwave")
    if os.path.isabs(cache):  # there may be no home
        with suppress(OSError):
            os.makedirs(cache, 0o700, exist_ok=True)
        yield os.path.join(cache, "kernels")
    if sys.platform == "win32":
        yield os.path.join(tempfile.gettempdir(), "terrainwave-kernels")  # one for each user
        return
    named = [os.environ.get(name, "") for name in ("TMPDIR", "TEMP", "TMP")]
    for folder in dict.fromkeys((*named, "/tmp", "/var/tmp")):
        if os.path.isabs(folder):
            yield os.path.join(folder, f"terrainwave-kernels-{os.geteuid()}")


def _user_cache() -> str:
    """Return the folder for the user's caches."""
    if sys.platform == "win32":
        return os.environ.get("LOCALAPPDATA", "")
    if sys.platform == "darwin":
        return os.path.expanduser("~/Library/Caches")
    named = os.environ.get("XDG_CACHE_HOME", "")
    return named if os.path.isabs(named) else os.path.expanduser("~/.cache")


def _is_private(folder: str) -> bool:
    """Return whether no other user (but root) can change or replace the contents of a folder."""
    if sys.platform == "win32":
        return True  # the user's folders are private, and there are no modes
    status = os.lstat(folder)
    if not os.path.isdir(folder) or os.path.islink(folder) or status.st_uid != os.geteuid():
        return False
    if status.st_mode & 0o022:
        return False
    folder = os.path.realpath(folder)
    while folder != os.path.dirname(folder):
        folder = os.path.dirname(folder)
        status = os.stat(folder)
        others_write = status.st_mode & (0o002 if _is_group_of_user(status.st_gid) else 0o022)
        is_sticky = status.st_mode & 0o1000  # only owners can rename their files
        if status.st_uid not in (0, os.geteuid()) or (others_write and not is_sticky):
            return False
    return True


def _is_group_of_user(group: int) -> bool:
    """Return whether a group has the user's own name, and so no other member."""
    import grp
    import pwd

    try:
        found = grp.getgrgid(group)
        name = pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return False
    return found.gr_name == name and set(found.gr_mem) <= {name}


class _State:
    """Counts of the kernels that this process has compiled."""

    n_kept = 0
    n_lost = 0
    reason = ""


def kept() -> tuple[int, int, str]:
    """Return the numbers of kernels cached and not cached by this process, and the reason."""
    return _State.n_kept, _State.n_lost, _State.reason


def keep() -> None:
    """Count a cached kernel."""
    _State.n_kept += 1


def lose(reason: str) -> None:
    """Count a kernel that is not cached; warn once."""
    _State.n_lost += 1
    if not _State.reason:
        _State.reason = reason
        warnings.warn(
            "compiled kernels are not kept, and every run compiles them again, which takes some"
            f" seconds: {reason}",
            TerrainwaveWarning,
            stacklevel=2,
        )
