"""Does `terrain.explore()` show a map in JupyterLab that tells what is seen and drawn?"""

import ast
import re
import time

import numpy as np
import pytest
from ext.browser import PATIENCE, chromium, screenshot, wait_until
from ext.jupyter import Notebook, jupyter_lab, set_up
from ext.rasters import BOUNDS, hills, write_raster, write_twz
from selenium.webdriver import ActionChains

import terrainwave

SHOWN = "document.body.dataset.state === 'complete'"

pytestmark = [pytest.mark.full, pytest.mark.gl, pytest.mark.large]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("lab")
    write_twz(made, hills(300, 341) * 4, BOUNDS, max_error=8)
    # Of many blocks of 128 KiB, which come when they are looked at.
    source = write_raster(
        made / "large.tif", hills(1500, 1500) * 4, (250000, 5090000, 280000, 5120000), "EPSG:32633"
    )
    terrainwave.compress(source, made / "large.twz", max_error=0, method="store", mesh="none")
    return made


@pytest.fixture(scope="module")
def lab(folder):
    """Yield a function that opens a notebook of some cells.

    By default messages of widgets wait for the cell that runs, as in most notebooks; newer ones
    have threads for them (`subshells`).
    """
    with jupyter_lab(folder) as address, chromium() as driver:
        driver.set_window_size(1200, 900)

        def opened(name, *cells, subshells=False):
            way = "perCommTarget" if subshells else "disabled"
            set_up(folder, "kernels-settings", {"commsOverSubshells": way})
            driver.switch_to.default_content()
            driver.get("about:blank")
            driver.get_log("browser")
            return Notebook(driver, address, folder / f"{name}.ipynb", cells)

        opened.address = address
        yield opened


def first_cell(path, more=""):
    return (
        f"import terrainwave as tw\nterrain = tw.open({path!r})\n"
        f"widget = terrain.explore({more})\nwidget"
    )


def printed(notebook, number):
    """Return the value that a cell prints."""
    return ast.literal_eval(notebook.run(number))


def eventually(is_so):
    end = time.monotonic() + PATIENCE
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.25)


def severe(driver):
    return [entry for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]


def test_what_is_seen_and_drawn_comes_back(lab, folder):
    notebook = lab(
        "drawn",
        first_cell("hills.twz"),
        "print((tuple(widget.window), terrain.read(window=widget.window).shape))",
        "widget.camera = {'lon': 8.3, 'lat': 46.1, 'zoom': 11, 'pitch': 30, 'bearing': 45}",
        "print(widget.camera)",
        "widget.window = (0, 0, 100, 50)",
    )
    driver = notebook.driver
    assert notebook.run(0) == ""
    notebook.frame()
    wait_until(driver, SHOWN)
    picture = screenshot(driver)[300:600, 550:1000]
    assert picture.astype(float).mean(axis=2).std() > 8

    # The height under the cursor.
    canvas = driver.find_element("css selector", "canvas.maplibregl-canvas")
    ActionChains(driver).move_to_element_with_offset(canvas, 120, 60).perform()
    wait_until(driver, "document.getElementById('place').textContent.includes('(± 8 m)')")
    told = driver.find_element("id", "place").text
    latitude, longitude, height = map(
        float, re.fullmatch(r"(\S+)° N, (\S+)° E: (\S+) m \(± 8 m\)", told).groups()
    )
    with terrainwave.open(folder / "hills.twz") as terrain:
        assert terrain.sample([(longitude, latitude)])[0] == pytest.approx(height, abs=0.2)

    # A window.
    driver.find_element("id", "draw").click()
    box = [
        driver.execute_script(
            f"const {{ lng, lat }} = terrainMap.unproject([{x}, {y}]); return [lng, lat]"
        )
        for x, y in ((500, 290), (620, 330))
    ]
    left, top = (
        driver.execute_script(
            f"return document.querySelector('canvas').getBoundingClientRect().{e}"
        )
        for e in ("left", "top")
    )
    mouse = ActionChains(driver, duration=20)
    centre = canvas.size["width"] // 2 - int(left), canvas.size["height"] // 2 - int(top)
    mouse.move_to_element_with_offset(canvas, 500 - centre[0], 290 - centre[1]).click_and_hold()
    mouse.move_by_offset(60, 20).move_by_offset(60, 20).release().perform()
    wait_until(driver, "document.getElementById('window').textContent.startsWith('Window:')")
    assert driver.execute_script("return terrainMap.querySourceFeatures('window').length")
    notebook.top()
    window, shape = printed(notebook, 1)
    assert shape == window[2:]
    (west, north), (east, south) = box
    with terrainwave.open(folder / "hills.twz") as terrain:
        expected = terrain.region(bounds=(west, south, east, north))
    assert np.abs(np.subtract(window, expected)).max() <= 2
    assert min(shape) > 5

    # The camera, from Python and from the map.
    notebook.run(2)
    notebook.frame()
    wait_until(driver, "Math.abs(terrainMap.getZoom() - 11) < 1e-3")
    where = driver.execute_script(
        "const { lng, lat } = terrainMap.getCenter();"
        "return [lng, lat, terrainMap.getPitch(), terrainMap.getBearing()]"
    )
    assert where == pytest.approx([8.3, 46.1, 30, 45], abs=1e-3)
    driver.execute_script("terrainMap.jumpTo({ center: [8.2, 46.2], zoom: 9.5, bearing: -90 })")
    notebook.top()
    eventually(lambda: printed(notebook, 3)["zoom"] == 9.5)
    expected = {"lon": 8.2, "lat": 46.2, "zoom": 9.5, "pitch": 30, "bearing": -90}
    assert printed(notebook, 3) == pytest.approx(expected, abs=1e-3)

    # A window from Python.
    notebook.run(4)
    notebook.frame()
    wait_until(
        driver,
        "document.getElementById('window').textContent.includes('100 × 50 samples from row 0')",
    )

    # A page that a notebook takes out and puts back shows the same.
    notebook.top()
    frame = "document.querySelector('iframe[title=Terrain]')"
    driver.execute_script(f"const frame = {frame}; frame.parentNode.prepend(frame)")
    notebook.frame()
    wait_until(driver, SHOWN)
    wait_until(driver, "document.getElementById('window').textContent.includes('100 × 50 samples')")
    assert driver.execute_script("return terrainMap.getZoom()") == pytest.approx(9.5, abs=1e-3)

    # All came from the kernel: nothing is asked of anybody else.
    names = "performance.getEntriesByType('resource').map(({ name }) => name)"
    asked = driver.execute_script(f"return {names}")
    notebook.top()
    asked += driver.execute_script(f"return {names}")
    own = (lab.address, "blob:", "data:", "twz:")
    assert [name for name in asked if not name.startswith(own)] == []
    assert not severe(driver)
