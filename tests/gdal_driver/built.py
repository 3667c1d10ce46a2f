"""The driver built from this checkout, and the system's GDAL with it: commands, and Python.

TERRAINWAVE_GDAL_ROOT names the root of another system, whose GDAL is tested instead
(tools/other_gdal.sh).
"""

import json
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]
OTHER_ROOT = os.environ.get("TERRAINWAVE_GDAL_ROOT", "")
# That of `make native-deb`, which then links what is there.
FOLDER = ROOT / "build" / "native" / (f"driver-{Path(OTHER_ROOT).name}" if OTHER_ROOT else "deb")
PLUGIN = FOLDER / "gdal"
# What belongs to the Python that runs the tests, whose rasterio has a GDAL of its own.
OF_THIS_PYTHON = {"PYTHONPATH", "PYTHONHOME", "LD_LIBRARY_PATH", "PYTHONWARNINGS"}
SYSTEM_PYTHON = "/usr/bin/python3"
PRELUDE = """\
import json, sys
import numpy as np
from osgeo import gdal
gdal.UseExceptions()
asked = json.loads(sys.argv[1])
"""


def inside(command, folder=None):
    """Return a command as it runs in the system that is tested, in a folder if one is given."""
    command = [str(part) for part in command]
    if folder is not None:
        command = ["sh", "-c", 'cd "$0" && exec "$@"', str(folder), *command]
    return ["chroot", OTHER_ROOT, *command] if OTHER_ROOT else command


@contextmanager
def turn():
    """Wait until no other worker builds here."""
    import fcntl

    FOLDER.mkdir(parents=True, exist_ok=True)
    with open(FOLDER / "lock", "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def build():
    """Build the driver, or what changed of it."""
    with turn():
        options = ["-DTWZ_GDAL=ON", "-DTWZ_WARNINGS_ARE_ERRORS=ON", "-DBUILD_TESTING=OFF"]
        options += ["-DCMAKE_INSTALL_PREFIX=/usr"]
        compilers = ["-DCMAKE_C_COMPILER=clang", "-DCMAKE_CXX_COMPILER=clang++"]
        for command in (
            ["cmake", "-S", ROOT / "native", "-B", FOLDER, *options, *compilers],
            ["cmake", "--build", FOLDER, "--target", "gdal_TWZ", "-j", "2"],
        ):
            ended = subprocess.run(inside(command), capture_output=True, text=True, check=False)
            assert ended.returncode == 0, ended.stdout + ended.stderr
    return PLUGIN


def environment(**variables):
    """Return the variables of a program that shall find the driver and the system's Python."""
    kept = {name: value for name, value in os.environ.items() if name not in OF_THIS_PYTHON}
    return kept | {"GDAL_DRIVER_PATH": str(PLUGIN)} | variables


def run(*command, folder=None, **variables):
    """Run one of GDAL's commands, in a folder if one is given; return what came of it."""
    return subprocess.run(
        inside(command, folder), env=environment(**variables), capture_output=True, text=True,
        timeout=300, check=False,
    )  # fmt: skip


def good(*command, folder=None, **variables):
    """Run one of GDAL's commands, which must succeed in silence; return its output."""
    ended = run(*command, folder=folder, **variables)
    assert (ended.returncode, ended.stderr) == (0, ""), ended
    return ended.stdout


def by_python(code, asked=None, **variables):
    """Run code in the system's Python with GDAL; return what it prints last, as JSON.

    `asked` is there as a variable of that name, and must be plain values.
    """
    ended = run(SYSTEM_PYTHON, "-c", PRELUDE + code, json.dumps(asked), **variables)
    said = ended.stdout[-2000:] + ended.stderr[-4000:]
    assert ended.returncode == 0, said
    return json.loads(ended.stdout.splitlines()[-1])


def error_lines(ended):
    """Return the lines in which a command told errors of GDAL's."""
    return [line for line in ended.stderr.splitlines() if line.startswith("ERROR")]


if __name__ == "__main__":
    sys.stdout.write(f"{build()}\n")
