"""What `make native` and `make native-deb` make, and the recipes beside them."""

import os
import re
import subprocess

import pytest
from gdal_driver.built import ROOT, good, turn

from terrainwave import __version__

pytestmark = [pytest.mark.full, pytest.mark.gdal]
FILE = ROOT / "tests" / "golden" / "v2" / "rapid-int16-halves.twz"


def make(*arguments):
    """Run make here; return what it prints."""
    variables = {name: value for name, value in os.environ.items() if "MAKE" not in name}
    ended = subprocess.run(
        ["make", "--no-print-directory", *arguments], cwd=ROOT, env=variables, text=True,
        capture_output=True, check=False,
    )  # fmt: skip
    said = ended.stdout[-2000:] + ended.stderr[-2000:]
    assert ended.returncode == 0, said
    return ended.stdout


def test_the_driver_is_installed_below_a_prefix_and_gdal_finds_it_there(tmp_path):
    make("native-driver", f"PREFIX={tmp_path / 'prefix'}")
    (plugin,) = (tmp_path / "prefix").rglob("gdal_TWZ.so")
    assert plugin.parent.name == "gdalplugins"
    assert "TWZ/terrainwave" in good("gdalinfo", FILE, GDAL_DRIVER_PATH=str(plugin.parent))
    assert (tmp_path / "prefix" / "bin" / "twz").exists()


def test_the_debian_package_puts_the_driver_where_gdal_looks(tmp_path):
    with turn():
        told = make("native-deb")
    (name,) = re.findall(r"^dist/(libgdal-twz_.*\.deb)$", told, re.M)
    version = good("gdal-config", "--version").strip()
    ours = __version__.replace(".dev", "~dev")
    assert name.startswith(f"libgdal-twz_{ours}+gdal{'.'.join(version.split('.')[:2])}_")
    package = ROOT / "dist" / name
    control = good("dpkg-deb", "--info", package)
    assert "libgdal" in next(line for line in control.splitlines() if "Depends:" in line)
    good("dpkg-deb", "--extract", package, tmp_path)
    files = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    (plugin,) = (path for path in files if path.endswith("gdalplugins/gdal_TWZ.so"))
    assert files - {plugin} == {"usr/share/doc/libgdal-twz/copyright"}
    # The folder that is compiled into GDAL, as its library names it.
    folder = f"/{os.path.dirname(plugin)}".encode()
    libraries = re.findall(r"=> (\S*libgdal\.so\S*)", good("ldd", tmp_path / plugin))
    with open(libraries[0], "rb") as file:
        assert folder in file.read()
    assert "TWZ/terrainwave" in good(
        "gdalinfo", FILE, GDAL_DRIVER_PATH=str(tmp_path / os.path.dirname(plugin))
    )
