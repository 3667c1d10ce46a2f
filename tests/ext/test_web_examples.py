"""Do the pages of examples/web draw the terrain, from a published folder and npm's packages?"""

import shutil
from pathlib import Path

import numpy as np
import pytest
from ext.browser import console, screenshot, wait_until
from ext.rasters import BOUNDS, hills, write_twz
from ext.static_server import static_server

import terrainwave
from terrainwave.ext.publish import publish_site

HERE = Path(__file__).parent
EXAMPLES = HERE.parents[1] / "examples" / "web"
POINTS = [(8.25, 46.2), (8.2, 46.22), (8.3, 46.18)]

pytestmark = [pytest.mark.full, pytest.mark.gl, pytest.mark.large]


@pytest.fixture(scope="module")
def twz(tmp_path_factory):
    return write_twz(tmp_path_factory.mktemp("hills"), hills(129, 161) * 4, BOUNDS, max_error=8)


@pytest.fixture(scope="module")
def folder(twz, tmp_path_factory):
    """Return a folder as the page on web pages has it made: examples, `site`, `node_modules`."""
    folder = tmp_path_factory.mktemp("web")
    for page in EXAMPLES.glob("*.html"):
        shutil.copy(page, folder)
    publish_site([str(twz)], folder / "site")
    (folder / "node_modules").symlink_to(HERE / "node_modules")
    return folder


def shown(driver, server, page):
    console(driver)
    driver.get(f"{server.address}/{page}.html")


def check_picture(driver):
    """Look at the middle of the page: light and shade of many slopes, no plain colour."""
    ground = screenshot(driver)[200:400, 200:600].astype(float)
    assert ground.mean(axis=2).std() > 8
    assert len(np.unique(ground.reshape(-1, 3), axis=0)) > 150
    # Nor is it noise: neighbours are alike.
    assert np.abs(np.diff(ground.mean(axis=2), axis=1)).mean() < 0.7 * ground.mean(axis=2).std()
    assert not console(driver)


def check_requests(server):
    """The file is read by ranges, and everything comes from this server."""
    spans = [span for path, span in server.asked if path.endswith(".twz")]
    assert spans
    assert all(spans)


def test_deckgl_draws_the_terrain(twz, folder, browser):
    """A picked place is read from the depth that was drawn."""
    with static_server(folder) as server:
        shown(browser, server, "deckgl")
        wait_until(browser, "globalThis.map?.props?.layers[0].isLoaded")
        check_picture(browser)
        check_requests(server)
        # Below zoom 12 deck.gl itself draws heights lower, by the cosine of the latitude.
        browser.execute_script(
            "const [longitude, latitude] = arguments;"
            "map.setProps({ initialViewState: { longitude, latitude, zoom: 12.5, pitch: 40 } });",
            *POINTS[0],
        )
        wait_until(browser, "map.getViewports()[0].zoom === 12.5 && map.props.layers[0].isLoaded")
        with terrainwave.open(twz) as terrain:
            for x, y in [(400, 300), (300, 250), (500, 250)]:
                asked = f"map.pickObject({{ x: {x}, y: {y}, unproject3D: true }})?.coordinate"
                longitude, latitude, height = wait_until(browser, asked)
                found = terrain.sample([(longitude, latitude)])[0]
                assert height == pytest.approx(found, abs=40)
