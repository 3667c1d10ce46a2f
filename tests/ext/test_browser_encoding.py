"""Do pages show a trench in either encoding, as deep as its tiles can hold, and blue?"""

import warnings

import numpy as np
import pytest
from ext.browser import console, screenshot, served, wait_until
from ext.rasters import write_twz
from ext.static_server import static_server

from terrainwave.errors import TerrainwaveWarning
from terrainwave.ext.publish import publish_site
from terrainwave.ext.serve.app import make_app

pytestmark = [pytest.mark.full, pytest.mark.gl, pytest.mark.large]
BOUNDS = (141.0, 11.0, 141.5, 11.4)
DEPTH = {"mapbox": -10_000, "terrarium": -10_900}


@pytest.fixture(scope="module")
def trench(tmp_path_factory):
    heights = np.full((200, 250), -9000, dtype=np.int16)
    heights[60:140, 60:190] = -10_900
    folder = tmp_path_factory.mktemp("trench")
    return str(write_twz(folder, heights, BOUNDS, max_error=0, name="trench"))


def check_page(driver, address, encoding):
    console(driver)
    driver.get("about:blank")
    driver.get(f"{address}/#terrain=trench&view=11.2,141.25,10,0,0&times=1")
    wait_until(driver, "document.body.dataset.state === 'complete'")
    depth = driver.execute_script("return terrainMap.queryTerrainElevation([141.25, 11.2])")
    assert depth == pytest.approx(DEPTH[encoding], abs=1)
    height, width, _ = (picture := screenshot(driver).astype(int)).shape
    red, _, blue = picture[height // 2, width // 2]
    assert blue > red + 20
    assert not console(driver)


@pytest.mark.parametrize("encoding", DEPTH)
def test_the_page_of_a_server_has_its_encoding(trench, browser, encoding):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        app = make_app([trench], encoding=encoding, transparent_voids=True)
    with served(app) as address:
        check_page(browser, address, encoding)


@pytest.mark.parametrize("encoding", DEPTH)
def test_the_page_of_a_folder_has_its_encoding(tmp_path, trench, browser, encoding):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        publish_site([trench], tmp_path / "site", encoding=encoding)
    with static_server(tmp_path / "site") as server:
        check_page(browser, server.address, encoding)
