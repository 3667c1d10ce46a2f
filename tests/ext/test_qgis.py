"""The plugin in QGIS's own Python, without a window; `qgis_session.py` is what runs there."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import rasterio
from ext.rasters import hills, write_raster

import terrainwave

ROOT = Path(__file__).parents[2]
SESSION = Path(__file__).with_name("qgis_session.py")
BOUND = 2
OF_THIS_PYTHON = {"PYTHONPATH", "PYTHONHOME", "LD_LIBRARY_PATH", "PYTHONWARNINGS"}
pytestmark = [pytest.mark.full, pytest.mark.qgis]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("qgis")


@pytest.fixture(scope="module")
def raster(folder):
    heights = hills(300, 420)
    heights[40:90, 60:200] = -32768
    bounds = (400_000, 5_100_000, 412_600, 5_109_000)
    return write_raster(folder / "dem.tif", heights, bounds, "EPSG:32632", nodata=-32768)


@pytest.fixture(scope="module")
def plugins(folder):
    """The folder with the plugin as it comes out of the zip."""
    archive = folder / "terrainwave_plugin.zip"
    tool = ROOT / "tools" / "make_qgis_zip.py"
    subprocess.run([sys.executable, tool, archive], check=True, capture_output=True)
    with zipfile.ZipFile(archive) as packed:
        packed.extractall(folder / "plugins")
    return folder / "plugins"


@pytest.fixture(scope="module")
def found(folder, raster, plugins):
    """What the session in QGIS's Python found."""
    command = folder / "bin" / "terrainwave"
    command.parent.mkdir()
    command.write_text(
        f"#!{sys.executable}\nimport sys\nsys.path.insert(0, {str(ROOT / 'src')!r})\n"
        "from terrainwave.cli import main\nmain(prog_name='terrainwave')\n"
    )
    command.chmod(0o755)
    (folder / "home").mkdir(mode=0o700)
    (folder / "out").mkdir()
    variables = {
        "PATH": f"{command.parent}{os.pathsep}{os.environ['PATH']}",
        "HOME": str(folder / "home"),
        "XDG_RUNTIME_DIR": str(folder / "home"),
        "QT_QPA_PLATFORM": "offscreen",
        # With GDAL's driver the plugin would leave files to QGIS.
        "GDAL_SKIP": "TWZ",
    }
    ended = subprocess.run(
        ["/usr/bin/python3", SESSION, plugins, raster, folder / "out"],
        env={name: value for name, value in os.environ.items() if name not in OF_THIS_PYTHON}
        | variables,
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def decoded(found, folder):
    with terrainwave.open(folder / "out" / "packed.twz") as terrain:
        return terrain.read(masked=True)


@pytest.mark.parametrize("when", ["", " by address", " after a crash", " of a project"])
def test_statistics_of_a_layer_are_those_of_decoded_heights(found, decoded, when):
    lowest, highest, mean, n_heights = found[f"statistics{when}"]
    assert (lowest, highest, n_heights) == (decoded.min(), decoded.max(), decoded.count())
    assert mean == pytest.approx(decoded.mean(dtype=float), rel=1e-12)


def test_heights_of_a_layer_are_the_decoded_ones(found, decoded, folder):
    heights = np.fromfile(folder / "out" / "heights", dtype=np.int16).reshape(decoded.shape)
    np.testing.assert_array_equal(heights, decoded.data)
    assert found["crs"] == "EPSG:32632"
    assert found["name"] == "packed"


def test_metadata_of_a_layer_show_the_bound(found):
    assert "Every height is within 2 m of the original" in found["metadata"]
    assert "Every height is within 2 m of the original" in found["shown metadata"]


def test_drops_are_taken_where_they_are_ours_and_do_not_wait(found):
    assert found["file is taken"]
    assert found["address is taken"]
    assert not found["other files are taken"]
    assert found["seconds that a drop blocks"] < 0.5


def test_canvas_is_drawn(found):
    # On the folder's canvas.png: terrain in grey, its void in the background's blue.
    assert found["colours"] > 100


def test_style_of_a_layer_comes_back_with_its_project(found, decoded):
    assert found["renderer of a project"] == decoded.max()


def test_processing_compresses_within_the_bound_and_verifies(found, raster):
    assert found["compress"]["MEASURED_ERROR"] <= found["compress"]["BOUND"] == BOUND
    assert found["verify"]["MEASURED_ERROR"] == found["compress"]["MEASURED_ERROR"]
    with rasterio.open(raster) as dataset:
        n_valid = int(np.count_nonzero(dataset.read_masks(1)))
    assert found["verify"]["N_VALID"] == n_valid
    assert "further from the original than 0.5" in found["too strict"]


def test_processing_decompresses_and_meshes(found, decoded, folder):
    with rasterio.open(folder / "out" / "back.tif") as dataset:
        np.testing.assert_array_equal(dataset.read(1), decoded.data)
    assert found["mesh"]["ERROR"] <= 20
    assert (folder / "out" / "mesh.ply").read_bytes().startswith(b"ply")


def test_processing_tells_progress_of_each_stage(found):
    assert {"scanning", "encoding", "proving"} <= set(found["stages"])
    assert found["percents"][-1] == 100
    assert "meshing" in found["stages of mesh"]


def test_cancelled_algorithm_leaves_nothing_behind(found):
    assert "cancelled" in found["cancelled"]
    assert found["left behind"] == []


def test_what_goes_wrong_is_one_line(found, folder):
    assert found["missing"] == (
        f"cannot read {folder / 'out' / 'missing.twz'}: No such file or directory"
    )
    assert found["crash"].startswith("its server ended: ")
    assert found["no command"].startswith(f"no terrainwave command at {folder / 'out'}: ")
    assert all("\n" not in found[name] for name in ("missing", "crash", "no command"))


def test_nothing_is_left_after_unload(found):
    assert found["entries after unload"] == 0
    assert found["server after unload"] == "gone"
