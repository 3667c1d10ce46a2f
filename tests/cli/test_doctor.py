"""`terrainwave doctor`, with programs that answer as GDAL's do, and with the system's own."""

import json
import os
import re
import sys

import pytest
from commands import run

from terrainwave import native_sources
from terrainwave.coding.native_library import SWITCH

KNOWS = "Format Details:\n  Short Name: TWZ\n  Long Name: terrainwave (.twz)"
UNKNOWN = "ERROR 1: --format option given with format 'TWZ', but that format not\nrecognised."

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="scripts stand for programs")


@pytest.fixture(autouse=True)
def _without_plugins(monkeypatch):
    monkeypatch.delenv("GDAL_DRIVER_PATH", raising=False)


@pytest.fixture
def gdal(tmp_path, monkeypatch):
    """Put a `gdalinfo` that tells this version and this of the format on the PATH, alone."""

    def put(version, described, status=0):
        program = tmp_path / "gdalinfo"
        program.write_text(
            f"#!/bin/sh\ncase $1 in\n--version) echo {version!r};;\n"
            f"*) printf '%s\\n' \"$TEXT\"; exit {status};;\nesac\n"
        )
        program.chmod(0o755)
        monkeypatch.setenv("TEXT", described)
        monkeypatch.setenv("PATH", os.pathsep.join([str(tmp_path), "/bin"]))
        return program

    return put


def test_a_gdal_with_the_driver_is_good_news_and_status_0(gdal):
    program = gdal("GDAL 3.6.2, released 2023/01/02", KNOWS)
    result = run("doctor")
    assert result.exit_code == 0
    assert f"GDAL 3.6.2 ({program}) reads .twz files" in result.stdout.splitlines()
    assert "install" not in result.stdout


@pytest.mark.parametrize("minor", ["3.6", "3.10"])
def test_a_gdal_without_it_is_status_1_and_names_the_package_and_the_folder(gdal, minor):
    gdal(f"GDAL {minor}.3, released 2025/04/01", UNKNOWN, status=1)
    result = run("doctor")
    assert result.exit_code == 1
    assert re.search(rf"^GDAL {minor}\.3 \(.*\) does not read .twz files$", result.stdout, re.M)
    assert f"install the driver for GDAL {minor}: the package libgdal-twz" in result.stdout
    assert "GDAL_DRIVER_PATH" in result.stdout


def test_no_gdal_at_all_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    result = run("doctor")
    assert result.exit_code == 1
    assert "found no gdalinfo on the PATH: install GDAL's commands" in result.stdout


def test_what_was_found_is_json_too(gdal):
    program = gdal("GDAL 3.6.2, released 2023/01/02", KNOWS)
    found = json.loads(run("doctor", "--json").stdout)
    assert (found["gdal"], found["command"], found["reads_twz"]) == ("3.6.2", str(program), True)
    assert found["advice"] == []
    assert found["rasterio_reads_twz"] is False


@pytest.mark.native
def test_a_native_library_that_is_used_is_named(gdal, library, monkeypatch):
    gdal("GDAL 3.6.2, released 2023/01/02", KNOWS)
    monkeypatch.setenv(SWITCH, "1")
    assert f"the native library is used ({library})" in run("doctor").stdout.splitlines()
    found = json.loads(run("doctor", "--json").stdout)
    assert (found["native"], found["native_advice"]) == (str(library), "")


@pytest.mark.parametrize(
    ("note", "is_clone", "told"),
    [
        ('{"missing": "found no C compiler (cc) on the PATH"}', True,
         r"found no C compiler \(cc\) on the PATH; with a C compiler installed: pip install"
         r" --editable /"),
        ('{"missing": "it was built for any platform"}', False, "it was built for any platform$"),
        ("", False, "nothing has built it so far$"),
    ],
)  # fmt: skip
def test_a_native_library_that_is_missing_is_told_with_the_reason(
    gdal, monkeypatch, tmp_path, note, is_clone, told
):
    gdal("GDAL 3.6.2, released 2023/01/02", KNOWS)
    (tmp_path / "native.json").write_text(note)
    monkeypatch.setenv(SWITCH, "1")
    monkeypatch.setattr(native_sources, "NOTE", tmp_path / "native.json")
    monkeypatch.setattr(native_sources, "LIBRARY", tmp_path / "none.so")
    if not is_clone:
        monkeypatch.setattr(native_sources, "clone", lambda: None)
    result = run("doctor")
    assert result.exit_code == 0
    line = result.stdout.splitlines()[1]
    assert re.search(
        f"^the native library is not used: .*found no library in the package: {told}", line
    )


def test_what_programs_print_cannot_reach_the_terminal(gdal):
    gdal("GDAL 3.6.2\x1b[31m, released", KNOWS)
    assert "\x1b" not in run("doctor").stdout


@pytest.mark.parametrize("has_plugin", [True, False])
def test_folders_that_the_variable_names_are_looked_into(gdal, tmp_path, monkeypatch, has_plugin):
    gdal("GDAL 3.6.2, released 2023/01/02", UNKNOWN, status=1)
    folder = tmp_path / "plugins"
    (folder / "3.6").mkdir(parents=True)
    # GDAL takes the subfolder of its minor version instead of the folder.
    (folder / "gdal_TWZ.so").touch()
    if has_plugin:
        (folder / "3.6" / "gdal_TWZ.so").touch()
    monkeypatch.setenv("GDAL_DRIVER_PATH", str(folder))
    told = run("doctor").stdout
    assert (f"the driver lies in {folder}, but GDAL does not load it" in told) is has_plugin
    assert ("where no gdal_TWZ is" in told) is not has_plugin


OTHER = "ERROR 1: TWZ driver was compiled against GDAL 3.6, but the current library version is 3.10"


def test_a_driver_of_another_minor_version_is_told_in_gdals_words(gdal):
    gdal("GDAL 3.10.3, released 2025/04/01", f"{OTHER}\n{UNKNOWN}", status=1)
    result = run("doctor")
    assert result.exit_code == 1
    assert f"GDAL says: {OTHER}" in result.stdout
    assert "install the driver that is built for GDAL 3.10" in result.stdout
