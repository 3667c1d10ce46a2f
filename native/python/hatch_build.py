"""Build hook: puts the native library into the package if it can be built, and names the wheel.

TERRAINWAVE_BUILD says what a build does: `require` fails without the library, `none` makes the
wheel for any platform, `auto` (the default) has the library where a C compiler is. Releases use
`require` and `none`.
"""

import json
import os
import re
import runpy
import shutil
import struct
import subprocess
import sys
import sysconfig
import tempfile
import zlib
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sources = runpy.run_path(str(ROOT / "src" / "terrainwave" / "native_sources.py"))

SWITCH = "TERRAINWAVE_BUILD"
MODES = ("auto", "require", "none")
# Variables that choose the compiler and its options: a build folder serves one choice.
CHOICES = ("CC", "CFLAGS", "LDFLAGS", "CMAKE_TOOLCHAIN_FILE", "CMAKE_ARGS", "CMAKE_GENERATOR")
ON_WINDOWS = sys.platform == "win32"


class CannotBuildError(Exception):
    """The library cannot be built here; the message says why."""


def mode():
    """Return what the environment asks for; end with one line if that is unknown."""
    word = os.environ.get(SWITCH) or "auto"
    if word not in MODES:
        raise SystemExit(f"found {SWITCH}={word}, expected one of {', '.join(MODES)}")
    return word


def compiler():
    """Return the C compiler that CMake will take; None if there is none.

    Windows has none on the PATH: CMake finds it.
    """
    if ON_WINDOWS or "CMAKE_TOOLCHAIN_FILE" in os.environ:
        return "cmake's"
    named = os.environ.get("CC", "").split()
    names = named[:1] or ["cc", "gcc", "clang"]
    return next(filter(None, map(shutil.which, names)), None)


def has_make():
    """Return whether CMake finds a program that builds."""
    return ON_WINDOWS or "CMAKE_GENERATOR" in os.environ or shutil.which("make") is not None


def packages_needed():
    """Return what pip has to install for a build of the library: what the PATH lacks."""
    if mode() == "none" or compiler() is None:
        return []
    return ["cmake>=3.18"] * (shutil.which("cmake") is None) + ["ninja"] * (not has_make())


def build_library(directory):
    """Build the library in a folder, with what is there from the last time; return its path.

    Raises
    ------
    CannotBuildError
        If a program is missing or fails.
    """
    if compiler() is None:
        named = os.environ.get("CC")
        raise CannotBuildError(f"found no C compiler ({named or 'cc, gcc or clang'}) on the PATH")
    cmake = shutil.which("cmake")
    if cmake is None:
        raise CannotBuildError("found no cmake on the PATH")
    words = ["-DCMAKE_BUILD_TYPE=Release"]
    if not has_make():
        words += ["-G", "Ninja", f"-DCMAKE_MAKE_PROGRAM={shutil.which('ninja')}"]
    words += os.environ.get("CMAKE_ARGS", "").split()
    words.append(f"-DTWZ_SOURCES={sources['digest_of'](ROOT)}")
    for command in (
        ["-S", HERE, "-B", directory, *words],
        ["--build", directory, "--config", "Release", "--target", "terrainwave", "--parallel"],
    ):
        run = subprocess.run(
            [cmake, *command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            errors="replace", check=False,
        )  # fmt: skip
        sys.stderr.write(run.stdout)
        if run.returncode:
            raise CannotBuildError(f"the library could not be compiled: {_first_error(run.stdout)}")
    names = {"libterrainwave.so", "libterrainwave.dylib", "terrainwave.dll"}
    return next(path for path in sorted(directory.rglob("*")) if path.name in names)


def _first_error(told):
    """Return the first error that a program has printed and the two lines after it."""
    lines = [line.strip() for line in told.splitlines() if line.strip()]
    at = (i for i, line in enumerate(lines) if re.search("error", line, re.IGNORECASE))
    first = next(at, len(lines) - 1)
    return " ".join(lines[first : first + 3])


def platform_tag(library):
    """Return the platform of a wheel: read from its library, not from this machine.

    On Linux it names the processor only, which a registry refuses: `auditwheel` finds out which
    glibc the library needs, and names the wheel of a release after it.
    """
    data = library.read_bytes()
    if data[:4] == b"\x7fELF":
        (machine,) = struct.unpack_from("<H" if data[5] == 1 else ">H", data, 18)
        names = {3: "i686", 40: "armv7l", 62: "x86_64", 183: "aarch64"}
        if machine in names:
            return f"linux_{names[machine]}"
    elif data[:4] == b"\xcf\xfa\xed\xfe":  # Mach-O of 64 bits
        processor, n_commands = struct.unpack_from("<I8xI", data, 4)
        names, at = {0x1000007: "x86_64", 0x100000C: "arm64"}, 32
        for _ in range(n_commands if processor in names else 0):
            command, size, *words = struct.unpack_from("<4I", data, at)
            if command in (0x24, 0x32):  # LC_VERSION_MIN_MACOSX, LC_BUILD_VERSION
                oldest = words[command == 0x32]
                # From 11 on wheels are named after the major version.
                major, minor = oldest >> 16, oldest >> 8 & 255
                return f"macosx_{major}_{minor if major < 11 else 0}_{names[processor]}"
            at += size
    elif data[:2] == b"MZ":
        (machine,) = struct.unpack_from("<H", data, struct.unpack_from("<I", data, 0x3C)[0] + 4)
        names = {0x14C: "win32", 0x8664: "win_amd64", 0xAA64: "win_arm64"}
        if machine in names:
            return names[machine]
    return re.sub(r"[-.]", "_", sysconfig.get_platform())


def put_beside_package():
    """Build the library, or note why not, beside the package of a clone; ignored by git."""
    chosen = repr([HERE, *map(os.environ.get, CHOICES)]).encode()
    library, note = _library_and_note(
        ROOT / "build" / "native" / f"python-{zlib.crc32(chosen):08x}"
    )
    if library is None:
        sources["LIBRARY"].unlink(missing_ok=True)
    else:
        # Programs that have loaded the old one keep it.
        shutil.copy(library, new := sources["LIBRARY"].with_suffix(f".{os.getpid()}"))
        os.replace(new, sources["LIBRARY"])
    sources["NOTE"].write_text(note, encoding="utf-8")


def _library_and_note(directory):
    """Return the library, None if it is not wanted or cannot be built, and the note beside it."""
    missing = (
        f"it was built for any platform ({SWITCH}=none), which pip installs where no other wheel"
        " fits this processor and C library"
    )
    if mode() != "none":
        try:
            library = build_library(directory)
        except (CannotBuildError, OSError) as error:
            if mode() == "require":
                raise SystemExit(
                    f"{error}, expected the native library ({SWITCH}=require)"
                ) from None
            missing = str(error)
            print(f"terrainwave without its native library: {missing}", file=sys.stderr)
        else:
            return library, json.dumps({"sources": sources["digest_of"](ROOT)}) + "\n"
    return None, json.dumps({"missing": missing}) + "\n"


try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # tests build the library alone
    pass
else:

    class LibraryHook(BuildHookInterface):
        """Puts the library into a wheel, or beside the package that is installed as editable."""

        def dependencies(self):
            """Return what pip installs before a build."""
            return packages_needed()

        def initialize(self, version, build_data):
            """Build the library first."""
            if version == "editable":
                put_beside_package()
                return
            self.folder = tempfile.TemporaryDirectory()
            folder = Path(self.folder.name)
            library, note = _library_and_note(folder / "build")
            (folder / sources["NOTE"].name).write_text(note, encoding="utf-8")
            build_data["force_include"][str(folder / sources["NOTE"].name)] = (
                "terrainwave/native.json"
            )
            if library is not None:
                build_data["force_include"][str(library)] = f"terrainwave/{library.name}"
                build_data["pure_python"] = False
                build_data["tag"] = f"py3-none-{platform_tag(library)}"

        def finalize(self, version, build_data, artifact_path):
            """Remove the folder of the build."""
            if version != "editable":
                self.folder.cleanup()


if __name__ == "__main__":
    put_beside_package()
