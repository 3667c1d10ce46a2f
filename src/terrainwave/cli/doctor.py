"""Check of the native library and of the system's GDAL for `terrainwave doctor`, and advice."""

import os
import shutil
import subprocess
from dataclasses import dataclass

from terrainwave._version import __version__
from terrainwave.coding.native_library import (
    SWITCH,
    MissingLibraryError,
    find_library,
    is_wanted,
)

_COMMAND = "gdalinfo"
_DRIVER = "TWZ"
_PLUGIN = "gdal_TWZ"
_PATIENCE = 60  # seconds
# First GDAL release that the driver supports.
_OLDEST = (3, 6)


@dataclass(frozen=True)
class Diagnosis:
    """Paths and versions that were found, reasons why not, and steps to take."""

    terrainwave: str
    native: str | None
    native_advice: str
    command: str | None
    gdal: str | None
    reads_twz: bool
    advice: tuple[str, ...]
    rasterio: str
    rasterio_reads_twz: bool

    def lines(self) -> list[str]:
        lines = [f"terrainwave {self.terrainwave}"]
        if self.native:
            lines.append(f"the native library is used ({self.native})")
        else:
            lines.append(
                "the native library is not used: the same files and heights, but compiled when"
                f" first needed; {self.native_advice}"
            )
        if self.gdal:
            knows = "reads .twz files" if self.reads_twz else "does not read .twz files"
            lines.append(f"GDAL {self.gdal} ({self.command}) {knows}")
        lines += self.advice
        if self.rasterio_reads_twz:
            lines.append(f"rasterio of this Python, with GDAL {self.rasterio}, reads .twz files")
        else:
            lines.append(
                f"rasterio of this Python, with GDAL {self.rasterio}, does not read .twz files: it"
                " brings a GDAL of its own, which does not load the system's driver; in Python"
                " rasterio.open(terrain.geotiff()) reads them"
            )
        return lines


def diagnose() -> Diagnosis:
    native, native_advice = _check_native()
    command = shutil.which(_COMMAND)
    version, problems, has_driver = _ask(command) if command else (None, [], False)
    of_rasterio, rasterio_has_driver = _ask_rasterio()
    return Diagnosis(
        terrainwave=__version__,
        native=native,
        native_advice=native_advice,
        command=command,
        gdal=version,
        reads_twz=has_driver,
        advice=() if has_driver else tuple(_advice(command, version, problems)),
        rasterio=of_rasterio,
        rasterio_reads_twz=rasterio_has_driver,
    )


def _check_native() -> tuple[str | None, str]:
    if not is_wanted():
        return None, f"{SWITCH} is 0 in the environment"
    try:
        return find_library().path, ""
    except (MissingLibraryError, OSError) as error:
        return None, str(error)


def _ask(command: str) -> tuple[str | None, list[str], bool]:
    told = _output(command, "--version")
    words = told[0].replace(",", " ").split() if told and told[0].startswith("GDAL ") else []
    described = _output(command, "--format", _DRIVER)
    errors = [line for line in described if line.startswith("ERROR")]
    problems = [line for line in errors if "--format option" not in line]
    has_driver = any(line.split() == ["Short", "Name:", _DRIVER] for line in described)
    return (words[1] if len(words) > 1 else None), problems, has_driver


def _output(*command: str) -> list[str]:
    try:
        ended = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=_PATIENCE,
            check=False, stdin=subprocess.DEVNULL,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return []
    return [line.strip() for line in (ended.stdout + "\n" + ended.stderr).splitlines()]


def _ask_rasterio() -> tuple[str, bool]:
    # Imported here, because the command's help needs no rasterio.
    import rasterio

    with rasterio.Env() as environment:
        return rasterio.__gdal_version__, _DRIVER in environment.drivers()


def _advice(command: str | None, version: str | None, problems: list[str]) -> list[str]:
    if command is None:
        return [
            f"found no {_COMMAND} on the PATH: install GDAL's commands (Debian: gdal-bin), or add"
            " their folder to the PATH, and ask again"
        ]
    if version is None:
        return [f"{command} does not print GDAL's version: run `{_COMMAND} --version` to see why"]
    minor = ".".join(version.split(".")[:2])
    numbers = version.split(".")[:2]
    if all(part.isdigit() for part in numbers) and tuple(map(int, numbers)) < _OLDEST:
        return [
            f"the driver needs GDAL {'.'.join(map(str, _OLDEST))} or newer: install a newer GDAL"
        ]
    if problems:
        return [
            *(f"GDAL says: {line}" for line in problems),
            f"install the driver that is built for GDAL {minor}: each minor version has its own",
        ]
    folders = [
        folder for folder in os.environ.get("GDAL_DRIVER_PATH", "").split(os.pathsep) if folder
    ]
    if not folders:
        return [
            f"install the driver for GDAL {minor}: the package libgdal-twz, or the file {_PLUGIN}"
            " in a folder that the environment variable GDAL_DRIVER_PATH names"
        ]
    with_plugin = [folder for folder in folders if _has_plugin(folder, minor)]
    if with_plugin:
        return [
            f"the driver lies in {with_plugin[0]}, but GDAL does not load it: run"
            f" `{_COMMAND} --debug on --format {_DRIVER}` to see why"
        ]
    return [
        f"GDAL_DRIVER_PATH names {os.pathsep.join(folders)}, where no {_PLUGIN} is: put the driver"
        f" for GDAL {minor} there, or unset the variable to have GDAL search its own folder"
    ]


def _has_plugin(folder: str, minor: str) -> bool:
    own = os.path.join(folder, minor)
    try:
        names = os.listdir(own if os.path.isdir(own) else folder)
    except OSError:
        return False
    return any(name.startswith(f"{_PLUGIN}.") for name in names)
