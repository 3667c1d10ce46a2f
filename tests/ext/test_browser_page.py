"""Does the page of `terrainwave serve` show mountains, say what it lacks, and never mix two?"""

import re

import numpy as np
import pytest
from ext.browser import console, screenshot, served, wait_until
from ext.gate import Gate
from ext.rasters import BOUNDS, hills, write_twz
from rasterio import open as open_raster
from scipy.ndimage import label
from scipy.spatial import ConvexHull
from selenium.webdriver import ActionChains, Keys
from selenium.webdriver.support.select import Select

import terrainwave
from terrainwave.ext.serve.app import make_app

HTML = '<img src=x onerror="window.pwned = 1">'

pytestmark = [pytest.mark.full, pytest.mark.gl, pytest.mark.large]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return where files are; `slope` is a plane and askew."""
    folder = tmp_path_factory.mktemp("page")
    write_twz(folder, hills(129, 161) * 4, BOUNDS, max_error=8)
    source = write_twz(folder, hills(97, 97) - 500, (7, 45, 7.4, 45.3), max_error=3, name="moor")
    with open_raster(source.with_suffix(".tif"), "r+") as raster:
        raster.update_tags(LICENSE=HTML, source="a survey")
    terrainwave.compress(source.with_suffix(".tif"), source, max_error=3, block=32, overwrite=True)
    slope = np.repeat(3000 - 9 * np.arange(300, dtype=np.int16)[:, None], 300, axis=1)
    square = (250000, 6990000, 259000, 6999000)
    write_twz(folder, slope, square, crs="EPSG:32633", max_error=0, name="slope")
    return folder


@pytest.fixture(scope="module")
def gate(folder):
    return Gate(make_app([str(folder / f"{name}.twz") for name in ("hills", "moor", "slope")]))


@pytest.fixture(scope="module")
def address(gate):
    with served(gate) as address:
        yield address


@pytest.fixture
def page(gate, address, browser):
    """Open an address with a hash, anew; nothing is on its way afterwards."""

    def open_page(hash_="", *, complete=True):
        browser.get("about:blank")
        browser.execute_cdp_cmd("Network.clearBrowserCache", {})  # tiles may be kept for an hour
        browser.get(f"{address}/#{hash_}")
        if complete:
            wait_for(browser, "complete")
        return browser

    console(browser)
    yield open_page
    gate.open()
    browser.get("about:blank")


def wait_for(driver, state):
    wait_until(driver, f"document.body.dataset.state === '{state}'")


def text(driver, name):
    return driver.find_element("id", name).text


def slide(driver, times):
    driver.execute_script(
        "const slider = document.getElementById('times'); slider.value = arguments[0];"
        "slider.dispatchEvent(new Event('input'))",
        times,
    )


def choose(driver, name, value):
    Select(driver.find_element("id", name)).select_by_value(value)


def test_the_page_flies_over_the_terrain(page):
    driver = page("terrain=hills")
    assert "± 8 m" in text(driver, "about")
    still = screenshot(driver)[200:, 280:]
    # Slopes in light and shade.
    assert still.astype(float).mean(axis=2).std() > 8
    assert len(np.unique(still.reshape(-1, 3), axis=0)) > 2000
    driver.find_element("id", "fly").click()
    wait_until(driver, "Math.abs(terrainMap.getBearing()) > 3")
    driver.find_element("id", "fly").click()
    wait_for(driver, "complete")
    assert (screenshot(driver)[200:, 280:] != still).mean() > 0.2
    driver.find_element("id", "home").click()
    wait_until(driver, "terrainMap.getBearing() === 0")
    assert not console(driver)


def test_the_page_waits_until_the_terrain_is_complete(gate, page):
    gate.held = ("/hills/rgb",)
    driver = page("terrain=hills", complete=False)
    wait_until(driver, "window.terrainMap && terrainMap.isStyleLoaded() !== undefined")
    assert driver.find_element("id", "spinner").is_displayed()
    assert text(driver, "message") == "Loading terrain …"
    assert driver.find_element("id", "map").get_attribute("aria-busy") == "true"
    gate.open()
    wait_for(driver, "complete")
    assert not driver.find_element("id", "status").is_displayed()
    height = driver.execute_script("return terrainMap.queryTerrainElevation([8.25, 46.2])")
    assert 400 < height < 2600
    # What comes into view later is waited for too.
    gate.held = ("/hills/rgb",)
    driver.execute_script("terrainMap.jumpTo({center: [8.3, 46.3], zoom: 12.5})")
    wait_for(driver, "waiting")
    gate.open()
    wait_for(driver, "complete")
    assert not console(driver)


def test_what_could_not_be_loaded_is_said_and_tried_again(gate, page):
    gate.broken = ("/hills/rgb",)
    driver = page("terrain=hills", complete=False)
    wait_for(driver, "failed")
    assert "the server answered 500" in text(driver, "message")
    gate.open()
    driver.find_element("id", "again").click()
    wait_for(driver, "complete")
    assert not driver.find_element("id", "status").is_displayed()


def test_late_answers_for_another_terrain_change_nothing(gate, page):
    """Terrain, slider and colours change while answers for two terrains are on their way."""
    driver = page("terrain=hills")
    gate.held = ("/moor/", "/hills/height")
    driver.find_element("id", "map").click()
    choose(driver, "terrain", "moor")
    slide(driver, 2.5)
    driver.find_element("id", "map").click()
    choose(driver, "terrain", "hills")
    slide(driver, 3)
    choose(driver, "colours", "mars")
    choose(driver, "terrain", "moor")
    choose(driver, "terrain", "hills")
    slide(driver, 3.5)
    assert gate.n_waiting
    gate.open()
    wait_for(driver, "complete")
    wait_until(driver, "location.hash.includes('times=3.5')")
    assert "times=3.5&colours=mars" in driver.execute_script("return location.hash")
    assert "terrain=hills" in driver.execute_script("return location.hash")
    style = driver.execute_script("return terrainMap.getStyle()")
    assert all("/hills/" in source["tiles"][0] for source in style["sources"].values())
    assert style["terrain"]["exaggeration"] == 3.5
    relief = next(layer for layer in style["layers"] if layer["id"] == "tints")["paint"]
    assert "#482a22" in relief["color-relief-color"]
    assert "161 × 129" in text(driver, "about")
    assert text(driver, "place").startswith("Point at")
    assert Select(driver.find_element("id", "terrain")).first_selected_option.text == "hills"
    assert not console(driver)


def test_the_height_under_the_cursor_is_the_terrains(folder, page):
    driver = page("terrain=hills&view=46.2,8.25,11,0,40&times=2")
    for dx in (0, 60):
        ActionChains(driver).move_to_element_with_offset(
            driver.find_element("id", "map"), dx, 30
        ).perform()
        wait_until(driver, "document.getElementById('place').textContent.includes('(± 8 m)')")
        found = re.fullmatch(r"(\S+)° N, (\S+)° E: (\S+) m \(± 8 m\)", text(driver, "place"))
        latitude, longitude, height = map(float, found.groups())
        with terrainwave.open(folder / "hills.twz") as terrain:
            assert terrain.sample([(longitude, latitude)])[0] == pytest.approx(height, abs=0.2)
        driver.execute_script("document.getElementById('place').textContent = ''")
    canvas = driver.find_element("css selector", "canvas")
    canvas.send_keys(Keys.ARROW_UP)
    wait_until(driver, "document.getElementById('place').textContent.startsWith('Middle: 46.')")


def test_an_address_brings_the_view_back(page):
    told = "terrain=moor&view=45.150000,7.200000,10.500,30.0,45.0&times=1.5&colours=grey&shaded=0"
    driver = page(told)
    view = driver.execute_script(
        "return [terrainMap.getCenter().lat, terrainMap.getCenter().lng, terrainMap.getZoom(),"
        "terrainMap.getBearing(), terrainMap.getPitch()]"
    )
    assert view == pytest.approx([45.15, 7.2, 10.5, 30, 45], abs=1e-3)
    assert "97 × 97" in text(driver, "about")
    assert text(driver, "factor") == "1.5"
    assert not driver.find_element("id", "shaded").is_selected()
    wait_until(driver, f"location.hash === '#{told}'")
    slide(driver, 2)
    wait_until(driver, "location.hash.includes('times=2&')")
    driver.execute_script("location.hash = 'terrain=hills&times=3'")
    wait_until(driver, "document.getElementById('about').textContent.includes('161')")
    wait_for(driver, "complete")
    assert text(driver, "factor") == "3.0"


def test_what_a_file_says_of_its_origin_is_text(page):
    driver = page("terrain=moor")
    terms = [term.text for term in driver.find_elements("css selector", "#tags dt")]
    told = [term.text for term in driver.find_elements("css selector", "#tags dd")]
    assert dict(zip(terms, told, strict=True)) == {"LICENSE": HTML, "source": "a survey"}
    assert driver.execute_script("return window.pwned") is None
    choose(driver, "terrain", "hills")
    assert not driver.find_element("id", "origin").is_displayed()


@pytest.mark.parametrize("pitch", [0, 62])
def test_edges_have_no_curtains_and_no_steps(page, pitch):
    """A slope whose sides are askew: one colour, since light falls on it evenly, straight sides."""
    driver = page(f"terrain=slope&colours=none&view=63.0,10.13,9.8,20,{pitch}")
    driver.execute_script(
        "for (const part of document.querySelectorAll("
        "'#panel, #place, .maplibregl-control-container')) part.style.display = 'none'"
    )
    wait_until(driver, "terrainMap.loaded()")
    picture, ground = screenshot(driver).astype(int), np.array((0xDB, 0xE4, 0xE8))
    is_terrain = (np.abs(picture - ground) > 12).any(axis=2)
    assert 0.03 < is_terrain.mean() < 0.9
    assert not (is_terrain[0] | is_terrain[-1]).any()
    assert not (is_terrain[:, 0] | is_terrain[:, -1]).any()
    color = np.median(picture[is_terrain], axis=0)
    # What is neither is a mixture on the edge; a curtain is darker.
    lowest, highest = np.minimum(color, ground) - 12, np.maximum(color, ground) + 12
    assert ((picture >= lowest) & (picture <= highest)).all()
    # Where tiles meet, the map lets single pixels of the covered surface through.
    parts, _ = label(is_terrain)
    sizes = np.bincount(parts.ravel())[1:]
    assert np.sort(sizes)[:-1].sum() < 10
    rows, cols = np.nonzero(parts == 1 + sizes.argmax())
    hull = ConvexHull(np.column_stack([rows, cols])).volume
    assert len(rows) > 0.985 * hull  # steps of n pixels leave n / 2 pixels along each side
