"""Do real clients in a real browser show mountains?"""

import numpy as np
import pytest
from ext.browser import chromium, console, screenshot, served, wait_until
from ext.rasters import hills, write_twz

from terrainwave.ext.serve.app import make_app

BOUNDS = (8.0, 46.0, 8.5, 46.4)


@pytest.fixture(scope="module")
def twz(tmp_path_factory):
    return write_twz(tmp_path_factory.mktemp("hills"), hills(129, 161) * 4, BOUNDS, max_error=8)


@pytest.mark.gl
@pytest.mark.large
def test_the_page_flies_over_the_terrain(twz):
    with served(make_app([str(twz)])) as address, chromium() as driver:
        driver.get(address)
        wait_until(driver, "window.map && map.loaded() && map.areTilesLoaded()")
        assert "± 8 m" in driver.find_element("id", "about").text
        height = driver.execute_script("return map.queryTerrainElevation([8.25, 46.2])")
        assert 400 < height < 2600
        still = screenshot(driver)
        # Slopes in light and shade below the sky.
        ground = still[300:, 260:].astype(float)
        assert ground.mean(axis=2).std() > 8
        assert len(np.unique(ground.reshape(-1, 3), axis=0)) > 2000
        driver.find_element("id", "fly").click()
        wait_until(driver, "Math.abs(map.getBearing()) > 3")
        driver.find_element("id", "fly").click()
        wait_until(driver, "map.areTilesLoaded()")
        assert (screenshot(driver) != still).mean() > 0.2
        driver.find_element("id", "map").click()
        wait_until(driver, "document.getElementById('place').textContent.includes('(± 8')")
        assert not console(driver)
