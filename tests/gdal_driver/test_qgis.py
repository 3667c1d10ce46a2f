"""QGIS opens a dropped file by the driver alone; `qgis_session.py` runs in QGIS's Python."""

import json
from pathlib import Path

import numpy as np
import pytest
from gdal_driver.built import ROOT, SYSTEM_PYTHON, build, run
from gdal_driver.files import TRANSFORM, centre, write_kind
from PIL import Image

import terrainwave

SESSION = Path(__file__).with_name("qgis_session.py")
PLACE = 700, 800  # row, column
pytestmark = [pytest.mark.full, pytest.mark.gdal, pytest.mark.qgis]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("qgis_driver")


@pytest.fixture(scope="module")
def path(folder):
    (folder / "files").mkdir()
    return write_kind(folder / "files", "int16-nodata")


@pytest.fixture(scope="module")
def found(folder, path):
    """What the session in QGIS's Python found."""
    build()
    path.with_suffix(".tif").unlink()
    (folder / "home").mkdir(mode=0o700)
    variables = {
        "HOME": str(folder / "home"),
        "XDG_RUNTIME_DIR": str(folder / "home"),
        "QT_QPA_PLATFORM": "offscreen",
        "PLUGIN": str(ROOT / "qgis"),
        "PLACE": json.dumps(centre(TRANSFORM, *PLACE)),
    }
    ended = run(SYSTEM_PYTHON, SESSION, path, "", folder, **variables)
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def decoded(path):
    with terrainwave.open(path) as terrain:
        return terrain.read(masked=True)


def test_a_dropped_file_is_one_layer_and_needs_no_dialog(found, path):
    assert found["sublayers"] == [["gdal", "int16-nodata", str(path)]]
    assert found["subLayers"] == []
    assert found["is in the filter of files"]


def test_the_plugin_leaves_files_to_a_gdal_that_reads_them(found):
    assert found["taken by the plugin"] == [False, []]


def test_the_layer_is_valid_and_gdals(found, decoded):
    assert (found["valid"], found["provider"], found["crs"]) == (True, "gdal", "EPSG:32632")
    assert found["size"] == list(decoded.shape[::-1])


def test_heights_statistics_and_identified_values_are_the_decoded_ones(found, decoded, folder):
    heights = np.fromfile(folder / "heights", dtype=np.int16).reshape(decoded.shape)
    np.testing.assert_array_equal(heights, decoded.data)
    lowest, highest, mean, n_heights = found["statistics"]
    assert (lowest, highest, n_heights) == (decoded.min(), decoded.max(), decoded.count())
    assert mean == pytest.approx(decoded.mean(dtype=float), rel=1e-12)
    assert found["identified"] == decoded[PLACE]
    assert found["is void"]


@pytest.mark.parametrize(("name", "n_colours"), [("canvas.png", 80), ("window.png", 80)])
def test_the_canvas_shows_hills_and_a_hole(found, folder, name, n_colours):
    picture = np.asarray(Image.open(folder / name).convert("RGB")).astype(int)
    inside = picture[:, picture.shape[1] // 3 : -picture.shape[1] // 3]
    assert len(np.unique(inside.reshape(-1, 3), axis=0)) > n_colours
    # Hills are grey; the hole shows what is behind, in its place.
    is_grey = np.ptp(picture, axis=2) == 0
    if name == "canvas.png":
        assert tuple(picture[70, 180]) == tuple(picture[70, 20]) == (0x30, 0x60, 0xC0)
        assert is_grey[200:, 200:400].all()


def test_many_threads_draw_the_same_picture(found):
    assert found["same pictures"]


def test_a_project_finds_its_layer_without_plugin_or_server(found, path):
    assert found["valid in a project"]
    assert found["source in a project"] == str(path)


def test_rough_statistics_leave_nothing_beside_the_file(found, path):
    """Exact ones, which the session asks for, may: QGIS writes them itself if at all."""
    names = {entry.name for entry in path.parent.iterdir()}
    assert names <= {path.name, f"{path.name}.aux.xml"}
