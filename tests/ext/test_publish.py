"""Does the folder of `terrainwave publish` show from any web server what `serve` shows?"""

import base64
import io
import json
import math
import os
import re
import shutil

import numpy as np
import pytest
from commands import run
from crs_texts import sphere
from ext.browser import console, screenshot, wait_until
from ext.rasters import BOUNDS, hills, write_raster, write_twz
from ext.static_server import static_server
from ext.test_javascript import node
from PIL import Image
from rasterio.warp import transform
from scipy.ndimage import gaussian_filter
from selenium.webdriver import ActionChains

import terrainwave
from terrainwave.ext.publish import publish_site
from terrainwave.globe import terrain_rgb as tiling
from terrainwave.globe.lonlat import Globe

RIM = 4


def with_hole(heights):
    heights = heights.copy()
    heights[30:60, 40:90] = -9999
    return heights


@pytest.fixture(scope="module")
def twz(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hills")
    return write_twz(folder, with_hole(hills(300, 341) * 4), BOUNDS, max_error=8, nodata=-9999)


@pytest.fixture(scope="module")
def site(twz, tmp_path_factory):
    folder = tmp_path_factory.mktemp("site") / "site"
    publish_site([str(twz)], folder)
    return folder


def test_the_folder_is_whole_and_replaced_only_if_told(twz, tmp_path):
    target = tmp_path / "site"
    result = run("publish", twz, target, "--json")
    assert result.exit_code == 0, result.output
    (told,) = json.loads(result.stdout)["terrains"]
    assert told["place_error"] < 1e-4
    assert (target / told["file"]).read_bytes() == twz.read_bytes()
    (described,) = json.loads((target / "terrains.json").read_text())
    assert str(twz.parent) not in json.dumps(described)
    # All that the page and the modules import is there, and nothing is fetched from elsewhere.
    for module in (path for path in target.rglob("*js") if path.parent.name != "maplibre"):
        text = module.read_text(encoding="utf-8")
        for name in re.findall(r'(?:from|import\(?|URL\()\s*"(\.[^"]+js)"', text):
            assert (module.parent / name).is_file(), (module, name)
        assert not re.search(r"https?://(?!www\.w3\.org)", text)
    # The page names all modules that it imports, so that no browser finds them one after another.
    page = (target / "index.html").read_text(encoding="utf-8")
    named = re.findall(r'rel="modulepreload" href="([^"]+)"', page)
    imported = set()
    for name in named:
        text = (target / name).read_text(encoding="utf-8")
        for other in re.findall(r'^import [^;]*"(\.[^"]+)";', text, re.MULTILINE):
            imported.add(os.path.relpath((target / name).parent / other, target))
    assert imported < set(named)
    assert "static/published.js" in page.partition("</head>")[0]
    again = run("publish", twz, target)
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr
    (target / "more").touch()
    assert run("publish", twz, target, "--overwrite", "-q").exit_code == 0
    assert not (target / "more").exists()


def test_the_folder_of_the_site_has_a_page_and_three_small_samples(tmp_path):
    target = tmp_path / "site"
    result = run("site", target, "--json")
    assert result.exit_code == 0, result.output
    samples = json.loads(result.stdout)["samples"]
    assert [sample["name"] for sample in samples] == ["aconcagua", "jacksboro", "san-joaquin"]
    assert all(sample["n_bytes"] <= 300_000 for sample in samples)
    for sample in samples:
        with terrainwave.open(target / sample["file"]) as terrain:
            assert "public domain" in terrain.info().tags["lic"]
    described = json.loads((target / "terrains.json").read_text())
    assert {one["ramp"] for one in described} == {"cividis"}
    endings = {path.suffix for path in target.rglob("*") if path.is_file()}
    assert endings <= {".html", ".js", ".css", ".json", ".twz", ".txt", ""}
    page = (target / "index.html").read_text(encoding="utf-8")
    assert page.index("Content-Security-Policy") < page.index('<link rel="preload"')
    assert not re.search(r"<script(?![^>]*src=)|<style|\sstyle=|\son\w+=", page)  # the policy
    names = re.findall(r'(?:src|href)="([^"#:]+)"', page)
    assert all((target / name).is_file() for name in names)
    assert run("site", target).exit_code == 1
    assert run("site", target, "--overwrite", "-q").exit_code == 0


@pytest.mark.parametrize(
    ("crs", "line"),
    [
        (None, "it has no place on a globe"),
        # Goode's homolosine is cut between the continents.
        ("ESRI:54052", "not smooth enough to be told by polynomials"),
    ],
)
def test_what_browsers_cannot_show_leaves_no_folder(tmp_path, crs, line):
    source = write_raster(tmp_path / "a.tif", hills(40, 90), (-18e6, -8e6, 18e6, 8e6), crs)
    options = {"max_error": 1, "block": 32, "mesh": "none", "method": "store"}
    terrainwave.compress(source, tmp_path / "a.twz", **options)
    source.unlink()
    result = run("publish", tmp_path / "a.twz", tmp_path / "site")
    assert result.exit_code == 1
    assert line in result.stderr
    assert os.listdir(tmp_path) == ["a.twz"]


RASTERS = {
    "degrees": ("EPSG:4326", BOUNDS),
    "strait": ("EPSG:4326", (179.6, -17.0, 180.2, -16.6)),
    "turn": ("EPSG:4326", (0.0, -90.0, 360.0, 90.0)),
    "utm": ("EPSG:32633", (250000, 6990000, 259000, 6999000)),
    "pole": ("EPSG:3031", (-2e6, -2e6, 2e6, 2e6)),
}


def tiles_of(globe):
    """Return a tile of a low, a middle and the highest zoom that have terrain, as z, x, y."""
    west, south, east, north = globe.extent
    last = tiling.max_zoom(globe)
    lat = south + 0.6 * (north - south) if north < 80 else 20.0
    places = [(z, west + 0.4 * (east - west), lat) for z in (max(last - 4, 0), last - 1, last)]
    if globe.extent.south < -80:
        places = [(z, lon, -80.0) for z, lon, _ in places]
    return [
        (z, int(tiling.column_of(z, lon)) % 2**z, int(tiling.row_of(z, lat)))
        for z, lon, lat in places
    ]


def decoded(text, dtype=np.uint8):
    return np.frombuffer(base64.b64decode(text), dtype)


def codes(pixels):
    pixels = pixels.astype(np.int64)
    return pixels[..., 0] << 16 | pixels[..., 1] << 8 | pixels[..., 2]


@pytest.mark.full
@pytest.mark.parametrize("name", RASTERS)
def test_tiles_made_in_javascript_are_those_of_the_server(tmp_path, name):
    crs, bounds = RASTERS[name]
    heights = with_hole(hills(200, 220) * 3)
    twz = write_twz(tmp_path, heights, bounds, crs, max_error=2, name=name, nodata=-9999)
    publish_site([str(twz)], tmp_path / "site")
    with terrainwave.open(twz) as terrain:
        globe = Globe(terrain)
        places = {f"rgb/{z}/{x}/{y}": (z, x, y) for z, x, y in tiles_of(globe)}
        found = json.loads(node("testing/tiles.js", tmp_path / "site", name, RIM, *places))
        for place, at in places.items():
            expected, tile = tiling.rgb_tile(globe, *at, RIM), found[place]
            with Image.open(io.BytesIO(expected.image)) as image:
                difference = np.abs(
                    codes(np.asarray(image)) - codes(decoded(tile["pixels"]).reshape(256, 256, 4))
                )
            # Steps of 0.1 m: a place that is 1e-5 samples off may fall on the other side of one.
            assert difference.max() <= 1, place
            assert (difference != 0).mean() < 0.001, place
            voids = decoded(tile["voids"]).reshape(256, 256).astype(int)
            assert (np.abs(voids - expected.voids) > 1).mean() < 0.001, place
            assert not (tile["isWhole"] and expected.voids.any())
            assert tile["level"] == expected.level
            assert tile["error"] == pytest.approx(expected.error, abs=0.02)
            assert tile["terrainError"] == pytest.approx(expected.terrain_error)


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:the numbers are radii")
@pytest.mark.filterwarnings("ignore:the file says that its numbers are depths")
@pytest.mark.parametrize(
    ("crs", "offset", "asked"),
    [
        ("EPSG:4326", 0, "depth"),
        (sphere(1_737_400), 1_737_400, "radius"),
        (sphere(3_396_190, 169.89), 3_380_000, "radius"),
    ],
)
def test_tiles_of_depths_and_radii_made_in_javascript_are_those_of_the_server(
    tmp_path, crs, offset, asked
):
    heights = hills(90, 100).astype(np.float32) + np.float32(offset)
    source = write_raster(tmp_path / "it.tif", heights, (10, 44, 12, 46), crs)
    twz = tmp_path / "it.twz"
    terrainwave.compress(source, twz, max_error=0.5, block=32, threads=1, heights_are=asked)
    publish_site([str(twz)], tmp_path / "site")
    with terrainwave.open(twz) as terrain:
        globe = Globe(terrain)
        z, x, y = tiles_of(globe)[-1]
        found = json.loads(
            node("testing/tiles.js", tmp_path / "site", "it", RIM, f"rgb/{z}/{x}/{y}")
        )
        expected, tile = tiling.rgb_tile(globe, z, x, y, RIM), found[f"rgb/{z}/{x}/{y}"]
    with Image.open(io.BytesIO(expected.image)) as image:
        own, other = codes(np.asarray(image)), codes(decoded(tile["pixels"]).reshape(256, 256, 4))
    # Steps of 0.1 m. In the outermost half pixel heights of an ellipsoid go on (Python), or radii.
    assert (np.abs(own - other) > 1).mean() < (0.02 if "169" in crs else 1e-6)
    assert np.abs(own - other).max() <= 20
    metres = own / 10 - 10_000
    if asked == "depth":
        assert -heights.max() - 1 <= metres.min() < metres.max() <= -heights.min() + 1
    assert abs(metres).max() < 20_000


@pytest.mark.full
def test_tiles_made_in_javascript_have_the_other_encoding_and_transparent_voids(tmp_path):
    twz = write_twz(tmp_path, with_hole(hills(200, 220) * 3), BOUNDS, max_error=2, nodata=-9999)
    publish_site([str(twz)], tmp_path / "site", encoding="terrarium")
    opacities = set()
    with terrainwave.open(twz) as terrain:
        globe = Globe(terrain)
        for at in tiles_of(globe):
            place = "terrarium/{}/{}/{}".format(*at)
            found = json.loads(node("testing/tiles.js", tmp_path / "site", "hills", RIM, place))
            tile = tiling.rgb_tile(globe, *at, RIM, tiling.Look("terrarium", True))
            expected = np.asarray(Image.open(io.BytesIO(tile.image)))
            pixels = decoded(found[place]["pixels"]).reshape(256, 256, 4)
            # Steps of 1/256 m are 26 times finer than 0.1 m: so many more places cross one.
            difference = np.abs(codes(expected) - codes(pixels))
            assert difference.max() <= 2
            assert (difference != 0).mean() < 0.026
            assert (expected[..., 3] != pixels[..., 3]).mean() < 0.001
            opacities |= set(np.unique(pixels[..., 3]).tolist())
    assert opacities == {0, 255}


@pytest.mark.full
def test_height_maps_state_their_errors(twz, site):
    """The place of a height map in longitude and latitude, its heights and what it states."""
    z, size = 9, 180 / 2**9
    x, y = int((8.25 + 180) / size), int((90 - 46.2) / size)
    found = json.loads(node("testing/tiles.js", site, "hills", 0, f"map/{z}/{x}/{y}"))
    tile = found[f"map/{z}/{x}/{y}"]
    heights = decoded(tile["heights"], "<f4").reshape(65, 65)
    west, north = x * size - 180, 90 - y * size
    with terrainwave.open(twz) as terrain:
        globe = Globe(terrain)
        level = globe.level_for(math.radians(size / 64) * globe.ellipsoid.axis)
        at = np.linspace(0, size, 65)
        lon, lat = np.meshgrid(west + at, north - at)
        rows, cols = globe.to_samples(lon.ravel(), lat.ravel())
        expected, window = globe.heights_at(rows, cols, level)
        known = np.isfinite(expected)
        assert known.any()
        assert np.abs(heights.ravel() - expected)[known].max() < 0.01
        assert (heights.ravel()[~known] == np.float32(globe.height_range[0] - 1)).all()
        holes = np.isfinite(rows) & ~known
        assert 0 < holes.sum() < (~known).sum()
        assert (decoded(tile["holes"]) == holes).all()
        assert tile["terrainError"] == pytest.approx(globe.heights_error(window))
    assert 0 < tile["error"] < 200


def show(driver, server, state="complete", hash_=""):
    driver.get("about:blank")
    driver.execute_cdp_cmd("Network.clearBrowserCache", {})
    console(driver)
    driver.get(f"{server.address}/#{hash_}")
    wait_until(driver, f"document.body.dataset.state === '{state}'")
    return driver


def asked_of_files(server):
    return [span for path, span in server.asked if path.endswith(".twz")]


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """Return a file of many blocks of 128 KiB, on UTM."""
    folder = tmp_path_factory.mktemp("large")
    square = (250000, 5090000, 280000, 5120000)
    source = write_raster(folder / "large.tif", hills(1500, 1500) * 4, square, "EPSG:32633")
    terrainwave.compress(source, folder / "large.twz", max_error=0, method="store", mesh="none")
    return folder / "large.twz"


@pytest.mark.full
@pytest.mark.gl
def test_the_first_picture_takes_few_requests(large, browser, tmp_path):
    publish_site([str(large)], tmp_path / "site")
    with static_server(tmp_path / "site") as server:
        driver = show(browser, server)
        spans = asked_of_files(server)
        assert 1 <= len(spans) <= 12
        assert all(spans)
        n_bytes = sum(last + 1 - first for first, last in spans)
        assert n_bytes < 0.7 * large.stat().st_size
        assert len(set(spans)) == len(spans)
        asked = [path.partition("?")[0] for path, _ in server.asked]
        assert asked.count("/terrains.json") == 1
        # The worker is on its way before the map's own.
        of_map = next(i for i, path in enumerate(asked) if "maplibre-gl-worker" in path)
        assert asked.index("/terrainwave/map/worker.js") < of_map
        picture = screenshot(driver)[200:, 280:]
        assert picture.astype(float).mean(axis=2).std() > 8
        with terrainwave.open(large) as terrain:
            x, y = transform("EPSG:4326", terrain.crs, [12.0], [46.1])
            height = terrain.sample([(x[0], y[0])])[0]
        drawn = driver.execute_script("return terrainMap.queryTerrainElevation([12.0, 46.1])")
        assert drawn == pytest.approx(height, abs=150)
        assert not console(driver)


@pytest.mark.full
@pytest.mark.gl
def test_a_server_without_ranges_sends_the_file_once(site, browser):
    with static_server(site, has_ranges=False) as server:
        driver = show(browser, server)
        assert len(asked_of_files(server)) == 1
        assert screenshot(driver)[200:, 280:].astype(float).mean(axis=2).std() > 8
        assert not console(driver)


@pytest.mark.full
@pytest.mark.gl
@pytest.mark.parametrize(
    ("gone", "line"),
    [("hills.twz", "HTTP status 404"), ("terrainwave/map/worker.js", "module of the worker")],
)
def test_what_is_gone_is_said(site, browser, tmp_path, gone, line):
    shutil.copytree(site, tmp_path / "site")
    (tmp_path / "site" / gone).unlink()
    with static_server(tmp_path / "site") as server:
        driver = show(browser, server, "failed")
        assert line in driver.find_element("id", "message").text


# Keeps the first still, and the corners of its rectangle in the window.
KEEP_STILL = """
    new MutationObserver(() => {
      const still = document.getElementById("still");
      if (!still || globalThis.keptStill) return;
      globalThis.keptStill = still;
      const { left, top, right, bottom } = still.firstChild.getBoundingClientRect();
      globalThis.boxOfStill = [left, top, right, bottom];
    }).observe(document, { subtree: true, childList: true });
"""
BOX_OF_THE_MAP = """
    const [west, south, east, north] = arguments;
    const corners = [[west, north], [east, north], [east, south], [west, south]]
      .map((place) => terrainMap.project(place));
    const [x, y] = [corners.map(({ x }) => x), corners.map(({ y }) => y)];
    return [Math.min(...x), Math.min(...y), Math.max(...x), Math.max(...y)];
"""


@pytest.fixture
def keeping_stills(browser):
    command = "Page.addScriptToEvaluateOnNewDocument"
    added = browser.execute_cdp_cmd(command, {"source": KEEP_STILL})
    yield browser
    browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)


@pytest.mark.full
@pytest.mark.gl
@pytest.mark.parametrize("hash_", ["", "view=46.2,8.25,9.3,30,50&colours=cividis&shaded=0"])
def test_the_still_is_the_map_to_come_and_goes_when_it_has(site, keeping_stills, hash_):
    with static_server(site) as server:
        driver = show(keeping_stills, server, hash_=hash_)
        assert driver.execute_script("return document.getElementById('still')") is None
        box = driver.execute_script("return globalThis.boxOfStill")
        expected = driver.execute_script(BOX_OF_THE_MAP, *BOUNDS)
        width = expected[2] - expected[0]
        # Corners of the map lie up to 600 m of some 40 km above or below its middle.
        assert np.abs(np.subtract(box, expected)).max() < 0.01 * width
        drawn = screenshot(driver)
        driver.execute_script("document.body.append(globalThis.keptStill)")
        still = screenshot(driver)
        x0, y0, x1, y1 = np.clip(box, 0, [still.shape[1], still.shape[0]] * 2).astype(int)
        inside = np.s_[max(y0, 60) : y1, max(x0, 300) : x1]
        assert (still[inside] != drawn[inside]).mean() > 0.1
        # The same hills, in the same light and colours: not as if moved by half a hill.
        one, other = (gaussian_filter(image[inside].mean(axis=2), 2) for image in (still, drawn))
        assert np.corrcoef(one.ravel(), other.ravel())[0, 1] > 0.85
        assert np.abs(still[inside].mean(axis=(0, 1)) - drawn[inside].mean(axis=(0, 1))).max() < 20
        assert not console(driver)


@pytest.mark.full
@pytest.mark.gl
def test_a_still_is_gone_when_a_user_moves_the_map(site, browser):
    """Without the map's tiles, the still stays until somebody does something."""
    with static_server(site) as server:
        browser.get("about:blank")
        browser.execute_cdp_cmd("Network.clearBrowserCache", {})
        console(browser)
        browser.execute_cdp_cmd("Network.enable", {})
        browser.execute_cdp_cmd("Network.setBlockedURLs", {"urls": ["*maplibre-gl-worker*"]})
        try:
            browser.get(f"{server.address}/")
            wait_until(browser, "document.getElementById('still') && !!window.terrainMap")
            ActionChains(browser).move_by_offset(500, 300).click().perform()
            assert browser.execute_script("return document.getElementById('still')") is None
        finally:
            browser.execute_cdp_cmd("Network.setBlockedURLs", {"urls": []})
