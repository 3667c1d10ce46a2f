"""Does CesiumJS in a real browser show mountains?"""

from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest
from ext.browser import chromium, console, screenshot, served, wait_until
from ext.rasters import BOUNDS, hills, write_twz
from fastapi import FastAPI
from fastapi.responses import FileResponse
from fastapi.staticfiles import StaticFiles

import terrainwave
from terrainwave.ext.publish import publish_site
from terrainwave.ext.serve.app import make_app

HERE = Path(__file__).parent
CESIUM = HERE / "node_modules" / "cesium" / "Build" / "Cesium"
HOLE = (8.42, 46.32)

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def twz(tmp_path_factory):
    heights = hills(129, 161) * 4
    heights[18:34, 125:146] = -9999  # around HOLE
    return write_twz(tmp_path_factory.mktemp("hills"), heights, BOUNDS, max_error=8, nodata=-9999)


def cesium_app():
    """Return a site of somebody else: CesiumJS from npm and a page."""
    app = FastAPI()

    @app.get("/")
    def page():
        return FileResponse(HERE / "cesium.html")

    app.mount("/cesium", StaticFiles(directory=CESIUM))
    return app


def asked_of(twz):
    """Return what the page is told of a file: where it is and how high."""
    west, south, east, north = BOUNDS
    with terrainwave.open(twz) as terrain:
        low, high = terrain.info().minimum, terrain.info().maximum
    return {
        "west": west, "south": south, "east": east, "north": north, "low": low, "high": high,
        "range": 30000,
    }  # fmt: skip


def check_the_mountains(driver, twz):
    """Compare heights on the globe with the file's, and look at light and shade."""
    wait_until(driver, "window.widget && window.waiting === 0")
    points = [(8.25, 46.2), (8.2, 46.22), (8.3, 46.18)]
    # Which zoom is drawn is Cesium's choice: hundreds of metres of relief, tens of error.
    with terrainwave.open(twz) as terrain:
        for (longitude, latitude), height in zip(points, terrain.sample(points), strict=True):
            wait_until(driver, f"Math.abs(heightAt({longitude}, {latitude}) - {height}) < 80")
    wait_until(driver, "widget.scene.globe.tilesLoaded")
    assert driver.execute_script(f"return heightAt{HOLE}") is None
    ground = screenshot(driver)[150:450, 200:600].astype(float)
    assert ground.mean(axis=2).std() > 8
    assert len(np.unique(ground.reshape(-1, 3), axis=0)) > 500
    assert not console(driver)


@pytest.mark.gl
@pytest.mark.large
def test_cesium_draws_the_mesh_tiles(twz):
    """Across origins, as most pages will."""
    with (
        served(make_app([str(twz)], cors=True)) as tiles,
        served(cesium_app()) as site,
        chromium() as driver,
    ):
        driver.get(f"{site}/?{urlencode({'terrain': f'{tiles}/hills/mesh'} | asked_of(twz))}")
        check_the_mountains(driver, twz)


@pytest.mark.gl
@pytest.mark.large
def test_cesium_draws_height_maps_made_in_the_browser(twz, tmp_path):
    publish_site([str(twz)], tmp_path / "site")
    app = cesium_app()
    app.mount("/site", StaticFiles(directory=tmp_path / "site"))
    with served(app) as address, chromium() as driver:
        driver.get(f"{address}/?{urlencode({'site': 'site'} | asked_of(twz))}")
        check_the_mountains(driver, twz)
        errors = driver.execute_script(
            "const { terrainProvider: provider } = widget; return provider.tileErrors(9, 535, 124)"
        )
        assert errors["terrainError"] >= 8
        assert 0 < errors["error"] < 100
