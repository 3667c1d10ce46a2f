"""Commands that are run by who cannot write what these tests have made."""

import functools
import os
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

NOBODY = 65534
_IDS = ["--reuid", str(NOBODY), "--regid", str(NOBODY), "--clear-groups"]


def _with_rights(rights):
    return [option for name in ("inh", "ambient") for option in (f"--{name}-caps", rights)] + [
        "--bounding-set",
        rights,
    ]


@contextmanager
def visible_folder():
    """Give a folder that others can look into, as those of pytest are not."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


@functools.cache
def _as_nobody():
    """Return how root becomes another user that can run this Python; None if there is no way.

    It may lie in root's home, which others cannot look into without the right to; and containers
    may lack that.
    """
    for rights in ("-all,+dac_read_search", "-all"):
        command = ["setpriv", *_IDS, *_with_rights(rights)]
        tried = [*command, sys.executable, "-c", "import numba, rasterio"]
        if subprocess.run(tried, capture_output=True, check=False).returncode == 0:
            return command
    return None


def as_stranger(command):
    """Return a command as another user would run it."""
    return [*(_as_nobody() or _without_rights()), *command] if os.geteuid() == 0 else [*command]


def as_root_without_rights(command):
    """Return a command as root would run it who may not write what modes forbid."""
    return [*_without_rights(), *command] if os.geteuid() == 0 else [*command]


def _without_rights():
    return ["setpriv", "--bounding-set", "-dac_override,-dac_read_search"]


def is_other_user():
    """Say whether a stranger has another number than the user of these tests."""
    return os.geteuid() == 0 and _as_nobody() is not None


def forbid_writing(folder):
    """Let no one write a folder and what is in it, but all read."""
    for path in (folder, *folder.rglob("*")):
        path.chmod(path.stat().st_mode & ~0o222 | 0o444)


def own_folder(path, by=as_stranger):
    """Make a folder that belongs to who runs commands by one of these functions."""
    path.mkdir()
    if by is as_stranger and is_other_user():
        os.chown(path, NOBODY, NOBODY)
    return path
