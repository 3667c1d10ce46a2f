"""The native library as the wheel terrainwave-native has it: built once, and found by the package.

Fixtures, which conftest.py imports: `site`, a folder with the package; `with_library`.
"""

import shutil
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from terrainwave.coding import native_library
from terrainwave.read import native

ROOT = Path(__file__).parents[1]
PROJECT = ROOT / "native" / "python"


def forget_library():
    """Have the package look for the library again."""
    native_library.loaded.cache_clear()
    native.installed.cache_clear()


@contextmanager
def found_at(folder):
    """Let terrainwave find the package in a folder, as if it were installed; None: nowhere."""
    forget_library()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(native_library.SWITCH, "1")
        patch.delitem(sys.modules, native_library.PACKAGE, raising=False)
        if folder is None:
            patch.setitem(sys.modules, native_library.PACKAGE, None)
        else:
            patch.syspath_prepend(folder)
        yield
        sys.modules.pop(native_library.PACKAGE, None)
    forget_library()


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """Return a folder with the package terrainwave_native in it."""
    import fcntl

    sys.path.append(str(PROJECT))
    import hatch_build

    build = ROOT / "build" / "native" / "wheel"
    build.mkdir(parents=True, exist_ok=True)
    with open(build / "lock", "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # one of several workers builds
        library = hatch_build.build_library(build)
    folder = tmp_path_factory.mktemp("site")
    package = shutil.copytree(
        PROJECT / "src" / native_library.PACKAGE, folder / native_library.PACKAGE
    )
    shutil.copy(library, package / f"libterrainwave{library.suffix}")
    return folder


@pytest.fixture
def with_library(site):
    with found_at(site):
        yield
