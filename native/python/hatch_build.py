"""Build the shared library by CMake, and name the wheel after what it needs of the system."""

import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

HERE = Path(__file__).resolve().parent
NAMES = {"win32": "terrainwave.dll", "darwin": "libterrainwave.dylib"}


def build_library(directory: Path) -> Path:
    """Build the library in a directory, with what is there from the last time; return its path."""
    try:
        from cmake import CMAKE_BIN_DIR  # the package that pip installs for a build

        cmake = shutil.which("cmake", path=CMAKE_BIN_DIR)
    except ImportError:
        cmake = shutil.which("cmake")
    if cmake is None:
        raise RuntimeError("found no cmake, expected one on the PATH: pip install cmake")
    subprocess.run(
        [cmake, "-S", HERE, "-B", directory, "-DCMAKE_BUILD_TYPE=Release"],
        check=True,
        stdout=sys.stderr,
    )
    subprocess.run(
        [cmake, "--build", directory, "--config", "Release", "--target", "terrainwave"],
        check=True,
        stdout=sys.stderr,
    )
    name = NAMES.get(sys.platform, "libterrainwave.so")
    return next(path for path in sorted(directory.rglob(name)) if path.is_file())


def platform_tag(library: Path) -> str:
    """Return the platform of the wheel: on Linux the oldest glibc that has all symbols needed."""
    platform = re.sub(r"[-.]", "_", sysconfig.get_platform())
    minors = [int(minor) for minor in re.findall(rb"GLIBC_2\.(\d+)", library.read_bytes())]
    if platform.startswith("linux_") and minors:
        # The format knows no older one than 2.5.
        return platform.replace("linux", f"manylinux_2_{max([*minors, 5])}", 1)
    return platform


try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # tests build the library alone
    pass
else:

    class LibraryHook(BuildHookInterface):
        """Puts the library into the wheel."""

        def initialize(self, version, build_data):
            """Build it first."""
            library = build_library(Path(self.directory).resolve() / "native")
            name = "libterrainwave" + library.suffix
            build_data["force_include"][str(library)] = f"terrainwave_native/{name}"
            build_data["pure_python"] = False
            build_data["tag"] = f"py3-none-{platform_tag(library)}"
