"""Do the pages of examples/web draw the terrain, from a published folder and npm's packages?"""

import shutil
from pathlib import Path

import numpy as np
import pytest
from ext.browser import console, screenshot, wait_until
from ext.rasters import BOUNDS, hills, write_twz
from ext.static_server import KNOWN, static_server
from globe.test_archive import read_archive
from globe.test_encodings import heights_in

import terrainwave
from terrainwave.ext.publish import publish_site
from terrainwave.globe.archive import write_pmtiles

HERE = Path(__file__).parent
EXAMPLES = HERE.parents[1] / "examples" / "web"
MODULES = KNOWN | {".mjs": "text/javascript"}
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


# Codes of the pixels of all tiles that the map has, as it reads them, and the lines that it shows.
TILES_OF_THE_MAP = """
    const { dem } = map.style.tileManagers;
    return dem.getIds().map((id) => dem.getTileByID(id)).map(({ dem, tileID: { canonical } }) => {
      const line = Array.from({ length: dem.dim }, (_, i) => i);
      const heights = line.map((y) => line.map((x) => dem.get(x, y)));
      return [[canonical.z, canonical.x, canonical.y], heights];
    });
"""
LINES_OF_THE_MAP = """
    return map.queryRenderedFeatures({ layers: ["contours"] }).flatMap(
      ({ geometry: { type, coordinates }, properties: { ele } }) =>
        (type === "LineString" ? [coordinates] : coordinates).map((line) => [ele, line]));
"""


@pytest.mark.parametrize(
    "options",
    [{}, {"encoding": "terrarium", "tile_size": 512, "round_by_zoom": True, "image": "png"}],
)
def test_contours_are_drawn_of_an_archive_whose_heights_a_map_reads_exactly(
    folder, browser, tmp_path, options
):
    """A void has no contours, and none run along its edge."""
    heights = hills(129, 161) * 4
    heights[30:50, 100:120] = -9999
    twz = write_twz(tmp_path, heights, BOUNDS, max_error=1, nodata=-9999, name="void")
    look = {"transparent_voids": True, "rim": 4, "overwrite": True, **options}
    with terrainwave.open(twz) as terrain:
        write_pmtiles(terrain, folder / "dem.pmtiles", **look)
    found, _, metadata = read_archive(folder / "dem.pmtiles")
    with static_server(folder, types=MODULES) as server:
        shown(browser, server, "contours")
        wait_until(browser, "globalThis.map?.loaded?.() && map.areTilesLoaded()")
        assert browser.execute_script("return map.queryRenderedFeatures().length") > 20
        read = browser.execute_script(TILES_OF_THE_MAP)
        assert read
        for place, drawn in read:
            expected = heights_in(found[tuple(place)], metadata["encoding"])
            drawn, is_known = np.array(drawn), np.isfinite(expected)
            assert drawn.shape == (metadata["tileSize"],) * 2
            assert np.abs(drawn - expected)[is_known].max() < 1e-6
            assert is_known.any()
        lines = browser.execute_script(LINES_OF_THE_MAP)
        assert len({height for height, _ in lines}) > 5
        with terrainwave.open(twz) as terrain:
            for height, line in lines:
                places = [(x, y) for x, y in line if 8.02 < x < 8.48 and 46.02 < y < 46.38]
                here = np.array([terrain.sample([place])[0] for place in places], dtype=float)
                # Lines are smoothed over four pixels of a map; slopes fall by some 60 m in one.
                assert np.nanmax(np.abs(here - height), initial=0) < 70
        check_picture(browser)
