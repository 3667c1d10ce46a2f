"""The page of `terrainwave site` opens and proves what its visitors have, wherever it lies."""

import re

import numpy as np
import pytest
import rasterio
from ext.browser import console, screenshot, wait_until
from ext.rasters import BOUNDS, hills, write_raster, write_twz
from ext.static_server import static_server
from PIL import Image
from selenium.webdriver import ActionChains, Keys
from selenium.webdriver.support.select import Select

import terrainwave
from terrainwave.ext.publish import write_site

# A policy that hosts may send: stricter than the page's own, as no other host is asked.
POLICY = (
    "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self';"
    " img-src 'self' data: blob:; connect-src 'self' data:"
)
pytestmark = [pytest.mark.full, pytest.mark.gl]

UTM = (250000, 5090000, 259000, 5096000)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site") / "site"
    write_site(folder)
    return folder


@pytest.fixture(scope="module")
def rasters(tmp_path_factory):
    """Return a folder of hills.twz and bare.twz (on UTM), with their originals."""
    folder = tmp_path_factory.mktemp("rasters")
    heights = hills(300, 341) * 4
    heights[30:60, 40:90] = -9999
    write_twz(folder, heights, BOUNDS, max_error=8, nodata=-9999)
    write_twz(folder, hills(129, 161), UTM, "EPSG:32633", max_error=1, name="bare")
    return folder


@pytest.fixture
def page(site, browser):
    """Open the page, anew, under a strict policy; nothing was refused by it in the end."""
    with static_server(site, headers={"Content-Security-Policy": POLICY}) as server:
        script = browser.execute_cdp_cmd(
            "Page.addScriptToEvaluateOnNewDocument",
            {
                "source": "window.refused = []; addEventListener('securitypolicyviolation',"
                " (event) => refused.push(`${event.violatedDirective} ${event.blockedURI}`))"
            },
        )
        browser.get("about:blank")
        console(browser)
        browser.get(f"{server.address}#terrain=jacksboro")  # the smallest sample
        begin(browser)
        yield browser
        assert browser.execute_script("return refused") == []
        names = "performance.getEntriesByType('resource').map(({name}) => name)"
        own = (server.address, "data:", "blob:")
        assert all(name.startswith(own) for name in browser.execute_script(f"return {names}"))
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
        browser.get("about:blank")


def begin(driver):
    complete(driver)
    wait_until(driver, "document.getElementById('samples').children.length")
    wait_until(driver, "document.getElementById('info').children.length")


def complete(driver):
    wait_until(driver, "document.body.dataset.state === 'complete'")


def text(driver, name):
    return driver.execute_script(f"return document.getElementById('{name}').textContent")


def unfold(driver, name):
    driver.execute_script(f"document.getElementById('{name}').open = true")


def drop(driver, *paths):
    """Drop files on the page, by an input that a script takes them from."""
    driver.execute_script(
        "const input = document.createElement('input'); document.body.append(input);"
        "Object.assign(input, {type: 'file', multiple: true, id: 'dropped'})"
    )
    driver.find_element("id", "dropped").send_keys("\n".join(map(str, paths)))
    driver.execute_script(
        "const dataTransfer = new DataTransfer(); const input = document.getElementById('dropped');"
        "for (const file of input.files) dataTransfer.items.add(file); input.remove();"
        "document.body.dispatchEvent(new DragEvent('drop', {dataTransfer, bubbles: true}))"
    )


def shown(driver, name):
    wait_until(driver, f"document.getElementById('terrain').value === '{name}'")
    complete(driver)


def proved(driver):
    wait_until(driver, "/proved/i.test(document.getElementById('proved').textContent)")
    return text(driver, "proved")


def test_a_dropped_file_is_shown_with_what_it_says(page, rasters):
    drop(page, rasters / "hills.twz")
    shown(page, "hills")
    assert "± 8 m" in text(page, "about")
    assert screenshot(page)[200:, 350:].astype(float).mean(axis=2).std() > 5
    height = page.execute_script("return terrainMap.queryTerrainElevation([8.3, 46.1])")
    with terrainwave.open(rasters / "hills.twz") as terrain:
        assert height == pytest.approx(terrain.sample([(8.3, 46.1)])[0], abs=60)
        told = {
            term.text: term.find_element("xpath", "following-sibling::dd").text
            for unfolded in [unfold(page, "facts")]
            for term in page.find_elements("css selector", "#info dt")
        }
        assert told["Size"] == "300 rows × 341 columns, int16"
        assert told["Largest error"] == "asked 8 m, holds 8 m"
        assert told["Root of heights"] == terrain.digest()
        assert told["CRS"] == "EPSG:4326"
    page.execute_script("terrainMap.jumpTo({center: [8.3, 46.1], zoom: 12, pitch: 0})")
    complete(page)
    page.execute_script("terrainMap.fire('click', {lngLat: terrainMap.getCenter()})")
    wait_until(page, "document.getElementById('place').textContent.includes('(± 8 m)')")
    assert text(page, "place").startswith("46.10000° N, 8.30000° E: ")
    assert not console(page)


def test_a_raster_on_another_crs_lies_on_a_plane(page, rasters):
    page.find_element("id", "file").send_keys(str(rasters / "bare.twz"))
    shown(page, "bare")
    assert "on a plane" in text(page, "said")
    page.execute_script("terrainMap.fire('click', {lngLat: terrainMap.getCenter()})")
    wait_until(page, "document.getElementById('place').textContent.includes('(± 1 m)')")
    x, y, height = map(float, re.findall(r"-?\d+\.\d+", text(page, "place")))
    with terrainwave.open(rasters / "bare.twz") as terrain:
        assert terrain.sample([(x, y)])[0] == pytest.approx(height, abs=0.3)
    # A pixel is as wide on the map as on the ground.
    assert (x, y) == pytest.approx((254500, 5093000), abs=100)


def test_a_file_with_its_original_is_proved(page, rasters):
    drop(page, rasters / "hills.twz", rasters / "hills.tif")
    assert "all 100,800 samples are within 8 m" in proved(page)
    expected = terrainwave.verify(rasters / "hills.twz", rasters / "hills.tif")
    proof = text(page, "proof")
    errors = expected.errors
    assert f"{errors.max_error:g} m at row {errors.worst_row}, column {errors.worst_col}" in proof
    assert f"{expected.root}Root that the file statesthe same" in proof
    assert len(page.find_elements("css selector", "#bars rect")) == 17
    page.find_element("id", "where").click()
    complete(page)
    place = page.execute_script(
        "const {lng, lat} = terrainMap.getCenter(); return [lng, lat, terrainMap.getZoom()]"
    )
    x = 8 + (errors.worst_col + 0.5) * 0.5 / 341
    y = 46.4 - (errors.worst_row + 0.5) * 0.4 / 300
    assert place[:2] == pytest.approx([x, y], abs=2e-5)
    color = np.array((0xD4, 0x3D, 0x1A))
    wait_until(page, "terrainMap.loaded()")
    assert (np.abs(screenshot(page).astype(int) - color).max(axis=2) < 12).sum() > 50
    assert not console(page)


def test_a_changed_sample_another_raster_and_other_files_are_told_in_words(page, rasters, tmp_path):
    with rasterio.open(rasters / "hills.tif") as raster:
        heights = raster.read(1)
    with terrainwave.open(rasters / "hills.twz") as terrain:
        heights[222, 111] = terrain.read()[222, 111] - 9  # one step beyond the bound
    changed = write_raster(tmp_path / "changed.tif", heights, BOUNDS, nodata=-9999)
    drop(page, rasters / "hills.twz", changed)
    assert proved(page).startswith("Not proved")
    line = "1 sample is further from the original than 8; the worst, at row 222, column 111, by 9"
    assert text(page, "problems") == line
    unfold(page, "proving")
    for name, expected in {
        "bare.tif": "found a GeoTIFF of 129 rows x 161 columns, expected 300 rows x 341 columns",
        "bare.twz": "found a file that is no TIFF (bare.twz), expected a GeoTIFF: choose",
    }.items():
        page.find_element("id", "original").send_keys(str(rasters / name))
        page.find_element("id", "prove").click()
        wait_until(page, f"document.getElementById('proved').textContent.startsWith({expected!r})")
        assert text(page, "problems") == text(page, "proof") == ""
    data = bytearray((rasters / "hills.twz").read_bytes())
    data[-3000] ^= 1
    (tmp_path / "damaged.twz").write_bytes(data)
    drop(page, tmp_path / "damaged.twz", rasters / "hills.tif")
    wait_until(page, "/cannot be read/.test(document.getElementById('proved').textContent)")
    (tmp_path / "notes.txt").write_text("heights", encoding="ascii")
    drop(page, tmp_path / "notes.txt")
    wait_until(page, "document.getElementById('said').classList.contains('bad')")
    assert text(page, "said").startswith("notes.txt cannot be opened as a .twz file: a file of 7")


def test_a_proof_that_was_cancelled_is_begun_again_and_says_nothing_of_the_next_one(page, rasters):
    drop(page, rasters / "hills.twz")
    shown(page, "hills")
    unfold(page, "proving")
    page.find_element("id", "original").send_keys(str(rasters / "hills.tif"))
    page.execute_script("for (const id of ['prove', 'cancel']) document.getElementById(id).click()")
    wait_until(page, "document.getElementById('proved').textContent === 'Cancelled.'")
    assert not page.find_element("id", "progress").is_displayed()
    page.execute_script(
        "window.said = []; const proved = document.getElementById('proved');"
        "new MutationObserver(() => said.push(proved.textContent))"
        ".observe(proved, {childList: true});"
        "for (const id of ['prove', 'cancel', 'prove']) document.getElementById(id).click()"
    )
    assert proved(page).startswith("Proved")
    assert "Cancelled." not in page.execute_script("return said")
    assert not console(page)


def test_odd_files_are_opened_one_after_another(page, rasters, tmp_path):
    """Flat terrain, nothing but voids, an address that is none; older terrains open anew."""
    write_twz(tmp_path, hills(129, 161) * 0, BOUNDS, max_error=0, name="flat")
    write_twz(tmp_path, hills(129, 161) * 0 - 9999, BOUNDS, name="void", nodata=-9999)
    for path in (rasters / "hills.twz", tmp_path / "flat.twz"):
        drop(page, path)
        shown(page, path.stem)
    assert "undefined" not in page.execute_script(
        "return [...document.querySelectorAll('#addresses input')].map(({value}) => value).join()"
    )
    unfold(page, "meshing")
    wait_until(page, "/triangles, at most/.test(document.getElementById('meshed').textContent)")
    assert text(page, "meshed").startswith("2 triangles, at most 0 m from")
    assert text(page, "tolerance") == "0.001 m"
    drop(page, tmp_path / "void.twz", tmp_path / "void.tif")
    assert proved(page) == "Proved: all samples are void in both."
    assert "Heightsnone: all samples are void" in text(page, "info")
    page.find_element("id", "meshing")
    wait_until(page, "/^No triangle/.test(document.getElementById('meshed').textContent)")
    Select(page.find_element("id", "terrain")).select_by_visible_text("hills")
    wait_until(page, "document.getElementById('info').textContent.includes('300 rows')")
    page.find_element("id", "original").send_keys(str(rasters / "hills.tif"))
    unfold(page, "proving")
    page.find_element("id", "prove").click()
    assert "all 100,800 samples are within 8 m" in proved(page)
    assert not console(page)


def test_the_part_in_view_is_saved(page, rasters, tmp_path):
    page.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)}
    )
    drop(page, rasters / "hills.twz")
    shown(page, "hills")
    page.execute_script("terrainMap.jumpTo({center: [8.1, 46.3], zoom: 11.5, pitch: 0})")
    complete(page)
    unfold(page, "saving")
    for level, format_ in ((-1, "tif"), (-2, "tif"), (-1, "png")):
        with terrainwave.open(rasters / "hills.twz") as terrain:
            level %= terrain.n_levels
        Select(page.find_element("id", "level")).select_by_value(str(level))
        Select(page.find_element("id", "format")).select_by_value(format_)
        page.find_element("id", "save").click()
        target = tmp_path / f"hills.{format_}"
        wait_until(page, "document.getElementById('saved').textContent.includes('samples')")
        wait_for_file(page, target)
        compare_saved(rasters / "hills.twz", level, target)
        target.unlink()
        page.execute_script("document.getElementById('saved').textContent = ''")
    assert not console(page)


def wait_for_file(driver, path):
    driver.set_script_timeout(120)
    wait_until(driver, "true")
    for _ in range(400):
        if path.exists():
            return
        driver.execute_async_script("setTimeout(arguments[0], 50)")
    raise AssertionError(f"{path} did not come")


def compare_saved(twz, level, path):
    with terrainwave.open(twz) as terrain:
        whole = terrain.read(level=level)
        if path.suffix == ".png":
            with Image.open(path) as image:
                codes, told = np.asarray(image).astype(int), image.info["Description"]
            low, step = map(
                float, re.match(r"height = (\S+) \+ \(code - 1\) \* (\S+);", told).groups()
            )
            heights = np.ma.masked_where(codes == 0, low + (codes - 1) * step)
            assert any(
                np.ma.allequal(heights, whole[row : row + len(codes), col : col + codes.shape[1]])
                for row in range(0, 300 - len(codes) + 1)
                for col in range(0, 341 - codes.shape[1] + 1)
            )
            return
        with rasterio.open(path) as raster:
            assert raster.crs.to_epsg() == 4326
            assert raster.nodata == -9999
            x, y = raster.transform @ (0, 0)
            col, row = (round(value) for value in ~terrain.transform_of(level) @ (x, y))
            n_rows, n_cols = raster.shape
            assert min(n_rows, n_cols) > 20
            part = np.ma.filled(whole, -9999)[row : row + n_rows, col : col + n_cols]
            assert (raster.read(1) == part).all()


def test_the_mesh_follows_the_tolerance_and_states_its_error(page, rasters):
    drop(page, rasters / "hills.twz")
    shown(page, "hills")
    unfold(page, "meshing")
    found = []
    for place in (60, 80, 100):
        page.execute_script(
            "const slider = document.getElementById('coarseness'); slider.value = arguments[0];"
            "document.getElementById('meshed').textContent = '';"
            "slider.dispatchEvent(new Event('input'))",
            place,
        )
        wait_until(page, "/triangles, at most/.test(document.getElementById('meshed').textContent)")
        assert "original" not in text(page, "meshed")
        numbers = re.findall(r"([\d.,]+) (?:m|triangles)", text(page, "meshed"))
        tolerance = text(page, "tolerance").removesuffix(" m")
        found.append([float(number.replace(",", "")) for number in [*numbers, tolerance]])
    n_triangles, from_samples, tolerance = np.array(found).T
    assert (from_samples <= tolerance * 1.01).all()
    assert n_triangles[0] > 3 * n_triangles[1] > 9 * n_triangles[2] > 0
    assert (np.diff(from_samples) > 0).all()
    complete(page)
    with_lines = screenshot(page)
    page.execute_script("document.getElementById('meshing').open = false")
    wait_until(page, "terrainMap.loaded()")
    wait_until(page, "terrainMap.getSource('mesh') === undefined || terrainMap.loaded()")
    assert (screenshot(page)[200:, 350:] != with_lines[200:, 350:]).any()


def test_a_file_on_another_host_is_opened_by_its_url(site, browser, rasters):
    allowed = {
        "Access-Control-Allow-Origin": "*", "Access-Control-Allow-Headers": "Range",
        "Access-Control-Expose-Headers": "Content-Range, ETag",
    }  # fmt: skip
    with static_server(site) as server, static_server(rasters, headers=allowed) as other:
        browser.get(server.address)
        begin(browser)
        field = browser.find_element("id", "url")
        field.send_keys(f"{other.address}/hills.twz", Keys.ENTER)
        shown(browser, "hills")
        assert "± 8 m" in text(browser, "about")
        field.clear()
        for name in ("none", "50%"):
            field.clear()
            field.send_keys(f"{other.address}/{name}.twz", Keys.ENTER)
            wait_until(
                browser,
                f"document.getElementById('said').textContent.startsWith('{name}.twz cannot')",
            )
            assert "404" in text(browser, "said")
    browser.get("about:blank")


def test_it_fits_a_phone_in_light_and_dark(page):
    page.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": 360, "height": 740, "deviceScaleFactor": 1, "mobile": True},
    )
    page.refresh()
    begin(page)
    assert page.execute_script("return document.documentElement.scrollWidth") <= 360
    page.execute_script("for (const one of document.querySelectorAll('details')) one.open = true")
    for name in ("panel", "file", "url", "coarseness", "save", "original", "bars", "place"):
        box = page.execute_script(
            f"const it = document.getElementById('{name}'); it.scrollIntoView();"
            "const {left, right} = it.getBoundingClientRect(); return [left, right]"
        )
        assert 0 <= box[0] <= box[1] <= 360, name
    for scheme in ("light", "dark"):
        page.execute_cdp_cmd(
            "Emulation.setEmulatedMedia",
            {"features": [{"name": "prefers-color-scheme", "value": scheme}]},
        )
        # WCAG 2.2: contrast of text.
        colors = page.execute_script(
            "const look = (id) => getComputedStyle(document.getElementById(id));"
            "return [look('controls').color, look('scale').color, look('panel').backgroundColor]"
        )
        *texts, ground = (luminance(color) for color in colors)
        assert (ground > 0.5) == (scheme == "light")
        for one in texts:
            assert (max(one, ground) + 0.05) / (min(one, ground) + 0.05) > 4.5


def luminance(color):
    """Return the relative luminance of a CSS colour."""
    rgb = np.array([float(number) for number in re.findall(r"[\d.]+", color)[:3]]) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def test_all_can_be_reached_by_keys_and_has_a_name(page):
    for name in ("facts", "meshing", "saving", "proving"):
        unfold(page, name)
    page.execute_script("document.activeElement.blur(); document.getElementById('panel').focus()")
    order = []
    for _ in range(40):
        ActionChains(page).send_keys(Keys.TAB).perform()
        order.append(page.execute_script("return document.activeElement.id"))
    wanted = ["file", "url", "terrain", "coarseness", "level", "format", "save", "original", "band"]
    places = [order.index(name) for name in wanted]
    assert places == sorted(places)
    roles = {"button", "textbox", "slider", "combobox", "spinbutton", "checkbox", "image"}
    nodes = page.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    controls = [node for node in nodes if node.get("role", {}).get("value") in roles]
    assert len(controls) > 15
    unnamed = [node for node in controls if not node["name"]["value"].strip()]
    assert [(node["role"], node.get("properties")) for node in unnamed] == []
    sample = page.find_element("css selector", "#samples [value=san-joaquin]")
    sample.send_keys(Keys.ENTER)
    shown(page, "san-joaquin")
    assert sample.get_attribute("aria-pressed") == "true"


@pytest.mark.firefox
def test_firefox_opens_and_proves_too(site, rasters):
    from ext.firefox import firefox

    with (
        static_server(site, headers={"Content-Security-Policy": POLICY}) as server,
        firefox() as driver,
    ):
        driver.get(server.address)
        begin(driver)
        driver.give("file", rasters / "hills.twz", rasters / "hills.tif")
        shown(driver, "hills")
        assert "all 100,800 samples are within 8 m" in proved(driver)
        expected = terrainwave.verify(rasters / "hills.twz", rasters / "hills.tif")
        assert f"{expected.root}Root that the file statesthe same" in text(driver, "proof")
        assert driver.screenshot()[200:, 350:].astype(float).mean(axis=2).std() > 5
        assert not driver.log
