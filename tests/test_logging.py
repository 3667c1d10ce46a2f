"""The library's logs: named after its modules, and silent until somebody asks for them."""

import logging
from importlib.util import find_spec

import numpy as np
import pytest
from commands import python
from ext.static_server import static_server
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.ext.publish import publish_site
from terrainwave.globe.archive import write_pmtiles
from terrainwave.globe.cesium import write_tiles

TRANSFORM = Affine(0.01, 0, 8, 0, -0.01, 46)


@pytest.fixture(scope="module")
def twz(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    write_geotiff(
        folder / "dem.tif", terrain_like(40, 50), units=("m",), crs="EPSG:4326",
        transform=TRANSFORM,
    )  # fmt: skip
    terrainwave.compress(folder / "dem.tif", folder / "dem.twz", max_error=1, block=32)
    return folder / "dem.twz"


def mended(folder, twz):
    """Return a copy to patch, and what to patch it with."""
    heights = terrain_like(40, 50)
    heights[3, 4] += 2
    copy, newer = folder / "copy.twz", folder / "newer.tif"
    copy.write_bytes(twz.read_bytes())
    write_geotiff(newer, heights, units=("m",), crs="EPSG:4326", transform=TRANSFORM)
    return copy, newer


def over_http(twz, folder):
    (folder / "site").mkdir()
    (folder / "site" / "dem.twz").write_bytes(twz.read_bytes())
    with static_server(folder / "site") as server:
        opened(f"{server.address}/dem.twz", lambda terrain: terrain.read())


def opened(twz, do):
    with terrainwave.open(twz, native=False) as terrain:
        return do(terrain)


WHAT = {
    "compress": (
        lambda twz, folder: terrainwave.compress(
            np.arange(1600.0).reshape(40, 40), folder / "a.twz", max_error=1
        ),
        {"write.compress", "container.targets.publication"},
    ),
    "read": (
        lambda twz, folder: opened(twz, lambda terrain: terrain.read()),
        {"read.window_reader", "container.reader"},
    ),
    "patch": (
        lambda twz, folder: terrainwave.patch(*mended(folder, twz)),
        {"write.patch", "container.targets.publication"},
    ),
    "store": (
        lambda twz, folder: terrainwave.store_meshes(twz, folder / "b.twz"),
        {"write.meshes"},
    ),
    "lods": (
        lambda twz, folder: terrainwave.save_lods(twz, folder / "a.obj", 2, max_error=4),
        {"lods", "mesh.area", "export.mesh_files"},
    ),
    "tiles": (
        lambda twz, folder: opened(twz, lambda it: write_tiles(it, folder / "tiles", max_zoom=1)),
        {"globe.cesium"},
    ),
    "archive": (
        lambda twz, folder: opened(twz, lambda it: write_pmtiles(it, folder / "a.pmtiles")),
        {"globe.archive"},
    ),
    "publish": (lambda twz, folder: publish_site([str(twz)], folder / "out"), {"ext.publish"}),
    "http": (over_http, {"container.sources.url"}),
}


@pytest.mark.filterwarnings("ignore::terrainwave.TerrainwaveWarning")
@pytest.mark.parametrize("what", WHAT)
def test_what_happens_is_logged_by_the_module_it_happens_in(caplog, tmp_path, twz, what):
    do, expected = WHAT[what]
    with caplog.at_level(logging.DEBUG, logger="terrainwave"):
        do(twz, tmp_path)
    names = {record.name for record in caplog.records}
    assert {f"terrainwave.{name}" for name in expected} <= names
    assert all(find_spec(name) is not None for name in names)
    assert all("\n" not in record.getMessage() for record in caplog.records)
    assert {record.levelno for record in caplog.records} <= {logging.DEBUG, logging.INFO}


def run(code, *words):
    return python(code, *words, check=True)


READ = """
import sys, logging
CONFIGURE
import terrainwave
with terrainwave.open(sys.argv[1], native=False) as terrain:
    terrain.read()
logging.getLogger("terrainwave.ext.serve.app").warning("a warning")
"""


def test_nothing_is_printed_and_nothing_changed_unless_asked(twz):
    check = "before = logging.root.handlers[:], logging.root.level"
    after = "assert before == (logging.root.handlers, logging.root.level)"
    level = 'assert logging.getLogger("terrainwave").level == logging.NOTSET'
    done = run(READ.replace("CONFIGURE", check) + f"{after}\n{level}\n", twz)
    assert (done.stdout, done.stderr) == ("", "")
