"""Where compiled kernels are kept, and where they are read from.

Numba keeps what it compiles of a function in one folder, and uses that only where it can be
written. Here a kernel has up to two: the usual one (NUMBA_CACHE_DIR, or ``__pycache__`` beside its
source), which another user may have filled, and, where that cannot be written, a private one.
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

from numba.core import config

from terrainwave.errors import TerrainwaveWarning

# What a user can do where kernels are not kept.
ADVICE = "set NUMBA_CACHE_DIR to a folder that you can write"


class KernelPlace(NamedTuple):
    """Where the kernels of a file of sources are."""

    # What has been compiled is looked for in these, in turn; if any is kept, in the last of them.
    folders: tuple[str, ...]
    # What people know that one by, and which folder cannot be written if it is not the usual one.
    kept_in: str | None = None
    instead_of: str = ""
    # Why none is kept, and what to do.
    reason: str = ""


def place_of(source: str) -> KernelPlace:
    """Return where the kernels of a file are."""
    folder = os.path.dirname(os.path.abspath(source))
    # As numba names it: one for each folder of sources, so that installations don't meet.
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
        # As numba does: rights alone don't tell, of a system that can only be read for one.
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return error.strerror or str(error)
    return ""


@lru_cache(None)
def _private_folder() -> str | None:
    """Return a folder that nobody else can write: what is loaded from it is run."""
    for folder in _folders_of_the_user():
        with suppress(OSError):
            with suppress(FileExistsError):
                os.mkdir(folder, 0o700)
            if _is_private(folder) and not _why_not_written(folder):
                return folder
    return None


def _folders_of_the_user() -> Iterator[str]:
    """Yield what may become a private folder: below the user's cache, then a temporary one.

    Never below the working directory, which is where a temporary one may end up at last.
    """
    cache = os.path.join(_user_cache(), "terrainwave")
    if os.path.isabs(cache):  # there may be no home
        with suppress(OSError):
            os.makedirs(cache, 0o700, exist_ok=True)
        yield os.path.join(cache, "kernels")
    if sys.platform == "win32":
        yield os.path.join(tempfile.gettempdir(), "terrainwave-kernels")  # each user has their own
        return
    named = [os.environ.get(name, "") for name in ("TMPDIR", "TEMP", "TMP")]
    for folder in dict.fromkeys((*named, "/tmp", "/var/tmp")):
        if os.path.isabs(folder):
            yield os.path.join(folder, f"terrainwave-kernels-{os.geteuid()}")


def _user_cache() -> str:
    """Return where programs of the user keep what can be made again."""
    if sys.platform == "win32":
        return os.environ.get("LOCALAPPDATA", "")
    if sys.platform == "darwin":
        return os.path.expanduser("~/Library/Caches")
    named = os.environ.get("XDG_CACHE_HOME", "")
    return named if os.path.isabs(named) else os.path.expanduser("~/.cache")


def _is_private(folder: str) -> bool:
    """Say whether no other user (but root) can change what lies in a folder, or replace it."""
    if sys.platform == "win32":
        return True  # folders of a user are, and there are no modes
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
        is_sticky = status.st_mode & 0o1000  # only owners rename what is theirs
        if status.st_uid not in (0, os.geteuid()) or (others_write and not is_sticky):
            return False
    return True


def _is_group_of_user(group: int) -> bool:
    """Say whether a group is the one of the user's own name, which has no other member."""
    import grp
    import pwd

    try:
        found = grp.getgrgid(group)
        name = pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return False
    return found.gr_name == name and set(found.gr_mem) <= {name}


class _State:
    """What became of the kernels that this process has compiled."""

    n_kept = 0
    n_lost = 0
    reason = ""


def kept() -> tuple[int, int, str]:
    """Return how many kernels this process has kept and not kept, and why not."""
    return _State.n_kept, _State.n_lost, _State.reason


def keep() -> None:
    """Count a kernel that is kept."""
    _State.n_kept += 1


def lose(reason: str) -> None:
    """Count a kernel that is not kept, and say so once."""
    _State.n_lost += 1
    if not _State.reason:
        _State.reason = reason
        warnings.warn(
            "compiled kernels are not kept, and every run compiles them again, which takes some"
            f" seconds: {reason}",
            TerrainwaveWarning,
            stacklevel=2,
        )
