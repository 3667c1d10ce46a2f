"""The native library beside the package, as an editable installation has it; tests that turn it on.

Fixtures, which conftest.py imports: `library`, the path of one that fits; `with_library`.
"""

import runpy
import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest

from terrainwave import native_sources
from terrainwave.coding import native_library
from terrainwave.read import native

ROOT = Path(__file__).parents[1]
PROJECT = ROOT / "native" / "python"


def forget_library():
    """Have the package look for the library again."""
    native_library.is_used.cache_clear()
    native_library.loaded.cache_clear()
    native.installed.cache_clear()


def is_built() -> bool:
    """Return whether there is a library, of these sources."""
    try:
        return native_library.find_library() is not None
    except (native_library.MissingLibraryError, OSError):
        return False


def can_build() -> bool:
    """Return whether the programs are here that build it."""
    return all(map(shutil.which, ("cmake", "cc")))


@contextmanager
def found_at(path):
    """Let terrainwave find its library at another path, where there may be none."""
    forget_library()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(native_library.SWITCH, "1")
        patch.setattr(native_sources, "LIBRARY", path)
        yield
    forget_library()


@pytest.fixture(scope="session")
def library():
    """Return the path of the library beside the package, built if that is not done."""
    if not is_built():
        import fcntl

        lock = ROOT / "build" / "native" / "lock"
        lock.parent.mkdir(parents=True, exist_ok=True)
        with open(lock, "w", encoding="utf-8") as file, pytest.MonkeyPatch.context() as patch:
            fcntl.flock(file, fcntl.LOCK_EX)  # one of several workers builds
            patch.setenv("TERRAINWAVE_BUILD", "require")
            if not is_built():
                runpy.run_path(str(PROJECT / "hatch_build.py"))["put_beside_package"]()
    return native_sources.LIBRARY


@pytest.fixture
def with_library(library):
    with found_at(library):
        yield


@pytest.fixture
def way(request):
    """Let a test run without the library ("numba") or with it ("c"): `conftest.BOTH_WAYS`."""
    if request.param == "c":
        request.getfixturevalue("with_library")
