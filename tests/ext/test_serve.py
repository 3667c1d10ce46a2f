"""Are tiles and heights of `terrainwave serve` right, and are wrong requests refused?"""

import io
import json
import re
import signal
import subprocess
import sys
import threading
import urllib.request
from unittest.mock import Mock

import numpy as np
import pytest
import rasterio
from commands import start
from ext.browser import served
from ext.rasters import BOUNDS, hills, write_twz
from fastapi.testclient import TestClient
from PIL import Image
from rasterio.warp import transform
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import minimum_filter

import terrainwave
from terrainwave.errors import InvalidHeightsError, TerrainwaveWarning
from terrainwave.ext.serve import sending
from terrainwave.ext.serve.app import make_app
from terrainwave.globe import cesium as tile_pyramid
from terrainwave.globe import terrain_rgb as tiling
from terrainwave.globe.lonlat import Globe


def client_of(*paths, host="http://127.0.0.1", **options):
    return TestClient(
        make_app([str(path) for path in paths], **options), host, raise_server_exceptions=False
    )


def heights_of(png):
    pixels = np.asarray(Image.open(io.BytesIO(png)))
    assert pixels.shape == (tiling.TILE_SIZE, tiling.TILE_SIZE, 3)
    return pixels @ np.array([6553.6, 25.6, 0.1]) - 10000


def pixel_centres(z, x, y, step=1):
    """Return longitudes and latitudes of a tile, written without the code that is tested."""
    at = (np.arange(0, tiling.TILE_SIZE, step) + 0.5) / tiling.TILE_SIZE
    longitudes = (x + at) / 2**z * 360 - 180
    mercator = np.pi - 2 * np.pi * (y + at) / 2**z
    latitudes = np.degrees(2 * np.arctan(np.exp(mercator)) - np.pi / 2)
    return np.meshgrid(longitudes, latitudes)


def tile_at(z, longitude, latitude):
    return int(tiling.column_of(z, longitude)), int(tiling.row_of(z, latitude))


@pytest.fixture(scope="module")
def slope(tmp_path_factory):
    """Heights that are exactly linear in longitude and latitude."""
    rows, cols = np.mgrid[0:65, 0:97]
    return write_twz(
        tmp_path_factory.mktemp("slope"),
        (2 * cols + 3 * rows).astype(np.int16),
        BOUNDS,
        max_error=0,
    )


@pytest.mark.parametrize("z", [9, 10, 11])
def test_a_pixel_holds_the_height_at_its_centre(slope, z):
    x, y = tile_at(z, 8.25, 46.2)
    with client_of(slope) as client:
        answer = client.get(f"/hills/rgb/{z}/{x}/{y}.png")
    assert answer.status_code == 200
    longitudes, latitudes = pixel_centres(z, x, y)
    cols = (longitudes - 8.0) / (0.5 / 97) - 0.5
    rows = (46.4 - latitudes) / (0.4 / 65) - 0.5
    inside = (cols > 0) & (cols < 96) & (rows > 0) & (rows < 64)
    assert inside.any()
    distance = np.abs(heights_of(answer.content) - (2 * cols + 3 * rows))
    assert distance[inside].max() <= 0.05 + 1e-6
    far = (cols < -0.6) | (cols > 96.6) | (rows < -0.6) | (rows > 64.6)
    assert (heights_of(answer.content)[far] == -tiling.VOID_DEPTH).all()


def test_the_stated_error_is_the_largest_distance_from_the_decoded_surface(hilly):
    z = 10
    x, y = tile_at(z, 8.25, 46.2)
    with terrainwave.open(hilly) as terrain:
        tile = tiling.rgb_tile(Globe(terrain), z, x, y)
        surface = RegularGridInterpolator((np.arange(65), np.arange(97)), terrain.read())
    longitudes, latitudes = pixel_centres(z, x, y)
    drawn = heights_of(tile.image)
    # Halfway between neighbours in a row; the mean of latitudes is not the middle's latitude.
    middles = (longitudes[:, :-1] + longitudes[:, 1:]) / 2, latitudes[:, 1:]
    means = (drawn[:, :-1] + drawn[:, 1:]) / 2
    largest = 0.0
    for (lon, lat), heights in ((middles, means), ((longitudes, latitudes), drawn)):
        places = np.stack([(46.4 - lat) / (0.4 / 65) - 0.5, (lon - 8) / (0.5 / 97) - 0.5], axis=-1)
        inside = ((places > 0.01) & (places < (63.99, 95.99))).all(axis=-1)
        largest = max(largest, np.abs(heights[inside] - surface(places[inside])).max())
    assert 0.04 < largest <= tile.error + 1e-6
    assert tile.error < 8 * largest  # it is measured, not a guess far above
    assert 1 <= tile.terrain_error <= 3


def test_tiles_of_projected_terrain_lie_where_the_raster_does(tmp_path):
    path = write_twz(
        tmp_path, hills(64, 64), (400000, 3780000, 401920, 3781920), crs="EPSG:32611", max_error=0
    )
    with terrainwave.open(path) as terrain:
        heights = terrain.read()
    rows, cols = np.array([3, 20, 60]), np.array([5, 31, 50])
    xs, ys = 400000 + (cols + 0.5) * 30, 3781920 - (rows + 0.5) * 30
    longitudes, latitudes = transform("EPSG:32611", "EPSG:4326", xs, ys)
    with client_of(path) as client:
        for longitude, latitude, row, col in zip(longitudes, latitudes, rows, cols, strict=True):
            answer = client.get("/hills/height", params={"lon": longitude, "lat": latitude}).json()
            assert answer["height"] == pytest.approx(heights[row, col], abs=1e-3)
            assert answer["max_error"] == 0
        z = client.get("/hills/tiles.json").json()["maxzoom"]
        x, y = tile_at(z, longitudes[1], latitudes[1])
        drawn = heights_of(client.get(f"/hills/rgb/{z}/{x}/{y}.png").content)
    lon, lat = pixel_centres(z, x, y)
    nearest = np.argmin((lon - longitudes[1]) ** 2 + (lat - latitudes[1]) ** 2)
    assert abs(drawn.ravel()[nearest] - heights[20, 31]) < 25  # half a pixel of slope
    assert 12 <= z <= 14


def test_quantized_mesh_tiles_are_those_of_the_library(hilly):
    with client_of(hilly) as client, terrainwave.open(hilly) as terrain:
        layer = client.get("/hills/mesh/layer.json").json()
        zoom = layer["maxzoom"]
        first = layer["available"][zoom][0]
        tile = client.get(f"/hills/mesh/{zoom}/{first['startX']}/{first['startY']}.terrain")
        lowest = Globe(terrain).height_range[0]
        pyramid = tile_pyramid.TilePyramid(terrain, void_height=lowest - 1)
        assert tile.content == pyramid.tile(zoom, first["startX"], first["startY"]).data
        assert float(tile.headers["x-tile-error"]) > 0
        assert client.get(f"/hills/mesh/{zoom}/0/0.terrain").status_code == 404
        assert client.get("/hills/mesh/1/4/0.terrain").status_code == 404


PLACES = [(46.2, 8.2), (46.31, 8.44), (0.0, 100.0), (46.0 + 0.4 / 65, 8.0 + 1e-9)]
TEXT = "|".join(f"{lat!r},{lon!r}" for lat, lon in PLACES)
OBJECTS = [{"latitude": lat, "longitude": lon} for lat, lon in PLACES]


@pytest.mark.parametrize(
    "ask",
    [
        lambda client: client.get("/hills/height", params={"locations": TEXT}),
        lambda client: client.get(f"/hills/height?locations={TEXT}&interpolation=bilinear"),
        lambda client: client.post("/hills/height", json={"locations": OBJECTS}),
        lambda client: client.post("/hills/height", json={"locations": TEXT}),
        lambda client: client.post("/hills/height", data={"locations": TEXT}),
        lambda client: client.post("/hills/height", content=json.dumps({"locations": OBJECTS})),
    ],
)
def test_heights_at_many_places_are_those_of_the_library(hilly, ask):
    with client_of(hilly) as client, terrainwave.open(hilly) as terrain:
        answer = ask(client)
        assert answer.status_code == 200
        found = answer.json()
        expected = terrain.sample([(lon, lat) for lat, lon in PLACES[:2]]).tolist()
        one = [client.get(f"/hills/height?lat={lat}&lon={lon}").json() for lat, lon in PLACES]
    assert found["status"] == "OK"
    assert (found["max_error"], found["units"]) == (one[0]["max_error"], "m")
    heights = [result["elevation"] for result in found["results"]]
    assert heights[:2] == pytest.approx(expected, abs=1e-9)
    assert heights == [single["height"] for single in one]
    assert heights[2] is None
    assert isinstance(heights[3], float)  # the outermost half pixel
    for result, (lat, lon) in zip(found["results"], PLACES, strict=True):
        assert (result["latitude"], result["longitude"]) == (lat, lon)
        assert result["location"] == {"lat": lat, "lng": lon}
        assert result["dataset"] == "hills"


BAD_LOCATIONS = [
    (None, "found no locations, expected locations=lat,lon|lat,lon"),
    ("", "found no locations, expected locations=lat,lon|lat,lon"),
    ([], "found no locations, expected locations=lat,lon|lat,lon"),
    ({"latitude": 1}, "found no locations, expected locations=lat,lon|lat,lon"),
    ("1,2|3", "found location 2 the text '3', expected lat,lon, or in JSON an object"),
    ("1,2|", "found location 2 '', expected lat,lon"),
    ("1;2", "found location 1 '1;2', expected lat,lon"),
    ("91,0", "found latitude the text '91' of location 1, expected -90 … 90 degrees"),
    ("0,0|0,721", "found longitude the text '721' of location 2, expected -720 … 720 degrees"),
    ("1e999,0", "found latitude the text '1e999' of location 1"),
    ("--,0", "found latitude '--' of location 1"),
    ([[1, 2]], "found location 1 [1, 2], expected lat,lon"),
    ([{"latitude": 1}], "found longitude None of location 1"),
    ([{"latitude": True, "longitude": 0}], "found latitude True of location 1"),
    ([{"latitude": 10**400, "longitude": 0}], "of location 1, expected -90 … 90 degrees"),
    ([{"latitude": float("nan"), "longitude": 0}], "found latitude nan of location 1"),
    ([{"latitude": "a\nb", "longitude": 0}], "of location 1, expected -90 … 90 degrees"),
    ("|".join(["0,0"] * 10_001), "found 10,001 locations, expected at most 10,000: ask in several"),
]


@pytest.mark.parametrize(("locations", "line"), BAD_LOCATIONS)
def test_wrong_locations_are_one_line(hilly, locations, line):
    with client_of(hilly) as client:
        answer = client.post("/hills/height", content=json.dumps({"locations": locations}))
        if isinstance(locations, str) and len(locations) < 1000:
            asked = client.get("/hills/height", params={"locations": locations})
            assert asked.json() == answer.json()
    assert answer.status_code == 400
    assert set(answer.json()) == {"status", "error"}
    assert answer.json()["status"] == "INVALID_REQUEST"
    assert line in answer.json()["error"]
    assert len(answer.json()["error"].splitlines()) == 1
    assert len(answer.json()["error"]) < 300


@pytest.mark.parametrize(
    "body", [b"", b"{", b"[]", b"\xff", b"[" * 100_000, b'"0,0"', b"locations=0,0"]
)
def test_a_body_that_is_no_object_is_one_line(hilly, body):
    with client_of(hilly) as client:
        answer = client.post("/hills/height", content=body)
    assert answer.status_code == 400
    assert answer.json()["error"].startswith("found a body without a JSON object, expected ")


def test_another_interpolation_and_half_a_place_are_refused(hilly):
    with client_of(hilly) as client:
        cubic = client.get("/hills/height?locations=46.2,8.2&interpolation=cubic")
        half = client.get("/hills/height?lat=46.2")
        long_body = client.post("/hills/height", content=b" " * (1 << 20) + b"{}")
        unknown = client.post("/other/height", json={"locations": "0,0"})
    assert cubic.status_code == half.status_code == 400
    assert cubic.json()["error"] == "found interpolation 'cubic', expected bilinear"
    assert half.json()["error"].startswith("found longitude None of location 1, expected -720")
    assert long_body.status_code == 413
    assert unknown.status_code == 404


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/hills/rgb/23/0/0.png", 404),
        ("/hills/rgb/-1/0/0.png", 404),
        ("/hills/rgb/3/8/0.png", 404),
        ("/hills/rgb/3/0/-1.png", 404),
        ("/hills/rgb/999999999999/0/0.png", 404),
        ("/hills/rgb/a/0/0.png", 422),
        ("/other/rgb/0/0/0.png", 404),
        ("/hills/height?lon=nan&lat=0", 400),
        ("/hills/height?lon=0&lat=91", 400),
        ("/hills/height", 400),
        ("/static/../app.py", 404),
        ("/static/%2e%2e/app.py", 404),
        ("/docs", 404),
        ("/openapi.json", 404),
    ],
)
def test_addresses_are_checked(hilly, path, status):
    with client_of(hilly) as client:
        answer = client.get(path)
    assert answer.status_code == status
    assert "Traceback" not in answer.text


def test_other_hosts_and_origins_are_refused_unless_named(hilly):
    with client_of(hilly, host="http://terrain.example") as client:
        assert client.get("/terrains.json").status_code == 400
    with client_of(hilly, host="http://terrain.example", hosts=("terrain.example",)) as client:
        assert client.get("/terrains.json").status_code == 200
    origin = {"Origin": "http://elsewhere.example"}
    with client_of(hilly) as client:
        assert "access-control-allow-origin" not in client.get("/", headers=origin).headers
    with client_of(hilly, cors=True) as client:
        assert client.get("/", headers=origin).headers["access-control-allow-origin"] == "*"


def test_what_is_said_of_a_file_has_no_path(hilly):
    with client_of(hilly) as client:
        text = client.get("/terrains.json").text
        described = client.get("/terrains.json").json()[0]
    assert str(hilly.parent) not in text
    assert described["name"] == "hills"
    assert described["rows"] == 65
    assert described["error"] == 2


def test_a_tile_that_the_client_has_is_not_sent_again(hilly):
    with client_of(hilly) as client:
        first = client.get("/hills/rgb/9/267/181.png")
        again = client.get(
            "/hills/rgb/9/267/181.png", headers={"If-None-Match": first.headers["etag"]}
        )
    assert again.status_code == 304
    assert not again.content


def test_damaged_files_are_one_line(tmp_path):
    path = write_twz(tmp_path, hills(65, 97), BOUNDS)
    data = bytearray(path.read_bytes())
    for at in range(len(data) // 2, len(data), 3):
        data[at] ^= 0x55
    path.write_bytes(data)
    with client_of(path) as client:
        answers = [client.get(f"/hills/rgb/10/{x}/362.png") for x in range(530, 540)]
    refused = [answer for answer in answers if answer.status_code == 500]
    assert refused
    assert all(a.json() == {"detail": "the file cannot be read there"} for a in refused)


def test_faults_of_our_own_show_no_traceback(hilly, monkeypatch):
    monkeypatch.setattr(tiling, "rgb_tile", Mock(side_effect=RuntimeError("secret")))
    with client_of(hilly) as client:
        answer = client.get("/hills/rgb/0/0/0.png")
    assert answer.status_code == 500
    assert answer.json() == {"detail": "internal error"}


def test_no_more_requests_decode_at_a_time_than_allowed(hilly, monkeypatch):
    monkeypatch.setattr(sending, "N_WAITING", 2)
    release, lock = threading.Event(), threading.Lock()
    running, most = 0, 0

    def slow(*_):
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        release.wait(20)
        with lock:
            running -= 1

    monkeypatch.setattr(tiling, "rgb_tile", slow)
    found = []
    with client_of(hilly, n_decoding=1) as client:

        def ask():
            found.append(client.get("/hills/rgb/0/0/0.png").status_code)
            if found.count(503) >= 3:
                release.set()

        threads = [threading.Thread(target=ask) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30)
    assert most == 1
    assert sorted(found) == [204] * 3 + [503] * 3


def test_bytes_of_files_and_heads_do_not_wait_for_tiles(hilly, monkeypatch):
    monkeypatch.setattr(sending, "N_WAITING", 0)
    has_begun, release = threading.Event(), threading.Event()

    def slow(*_):
        has_begun.set()
        release.wait(20)

    monkeypatch.setattr(tiling, "rgb_tile", slow)
    with client_of(hilly, n_decoding=1) as client:
        tile = threading.Thread(target=client.get, args=["/hills/rgb/0/0/0.png"])
        tile.start()
        assert has_begun.wait(20)
        statuses = [
            client.get("/hills/rgb/1/0/0.png").status_code,
            client.head("/hills.tif").status_code,
            client.get("/hills.twz", headers={"Range": "bytes=0-9"}).status_code,
            client.get("/hills.twz").status_code,
        ]
        release.set()
        tile.join(20)
    assert statuses == [503, 200, 206, 200]


def test_two_files_of_one_name_are_refused(hilly, tmp_path):
    other = tmp_path / "hills.twz"
    other.write_bytes(hilly.read_bytes())
    with pytest.raises(InvalidHeightsError, match="both be served as hills"):
        make_app([str(hilly), str(other)])


@pytest.fixture(scope="module")
def nowhere(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nowhere")
    with rasterio.open(
        folder / "x.tif", "w", driver="GTiff", height=33, width=700, count=1, dtype="int16"
    ) as raster:
        raster.write(hills(33, 700), 1)
    terrainwave.compress(folder / "x.tif", folder / "nowhere.twz", block=32)
    return folder / "nowhere.twz"


def test_files_that_cannot_be_served_do_not_stop_the_others(hilly, nowhere, tmp_path):
    text, missing = tmp_path / "text.twz", tmp_path / "missing.twz"
    text.write_text("no terrain at all")
    with pytest.warns(TerrainwaveWarning) as told:
        client = client_of(nowhere, text, hilly, missing)
    with client:
        assert [terrain["name"] for terrain in client.get("/terrains.json").json()] == ["hills"]
        assert client.get("/hills/rgb/9/267/181.png").status_code == 200
        assert client.get("/nowhere/tiles.json").status_code == 404
    for path, line in zip((nowhere, text, missing), told, strict=True):
        assert str(line.message).startswith("not served: ")
        assert str(path) in str(line.message)


def test_a_terrain_across_180_degrees_is_in_its_bounds(tmp_path):
    path = write_twz(tmp_path, hills(65, 97), (179.6, -17.0, 180.2, -16.6), max_error=0)
    with client_of(path) as client, terrainwave.open(path) as terrain:
        found = client.get("/hills/tiles.json").json()
        z = found["maxzoom"]
        for longitude in (179.7, 179.999, -179.999, -179.9):
            west, _, east, _ = found["bounds"]
            assert west <= longitude <= east
            assert -180 <= found["center"][0] <= 180
            x, y = tile_at(z, longitude, -16.8)
            drawn = heights_of(client.get(f"/hills/rgb/{z}/{x}/{y}.png").content)
            assert drawn.max() > 300
            asked = {"lon": longitude, "lat": -16.8}
            expected = terrain.sample([(longitude % 360, -16.8)])[0]
            assert client.get("/hills/height", params=asked).json()["height"] == pytest.approx(
                expected
            )


@pytest.mark.parametrize(
    "path",
    [
        "/", "/terrains.json", "/hills/tiles.json", "/hills/rgb/9/267/181.png", "/static/page.js",
        "/hills/mesh/layer.json", "/hills/height?lon=8.2&lat=46.2", "/hills.tif",
        "/hills/rgb/0/9/9.png",
    ],
)  # fmt: skip
def test_head_is_answered_as_get_without_a_body(hilly, path):
    with client_of(hilly) as client:
        head, whole = client.head(path), client.get(path)
    assert head.status_code == whole.status_code
    assert head.content == b""
    assert whole.content
    for name in ("content-length", "content-type", "etag"):
        assert head.headers.get(name) == whole.headers.get(name)


def test_heights_below_what_a_tile_can_hold_are_in_its_error(tmp_path):
    path = write_twz(tmp_path, hills(33, 33) - 10700, BOUNDS, max_error=0)
    with terrainwave.open(path) as terrain:
        tile = tiling.rgb_tile(Globe(terrain), 6, *tile_at(6, 8.25, 46.2))
        deepest = terrain.read().min()
    assert heights_of(tile.image).min() == -10000
    assert -10000 - deepest - 30 < tile.error <= -10000 - deepest


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """A raster whose sides are askew in Web Mercator, with a void."""
    heights = hills(97, 97)
    heights[40:50, 30:60] = -999
    return write_twz(
        tmp_path_factory.mktemp("turned"), heights, (300000, 7000000, 302910, 7002910),
        crs="EPSG:32633", max_error=0, nodata=-999,
    )  # fmt: skip


def test_tiles_with_a_rim_continue_each_other(turned):
    """A tile beside the terrain, at most the rim away, has what its neighbour begins."""
    with terrainwave.open(turned) as terrain:
        globe = Globe(terrain)
        west, south, _, north = globe.extent
        z = 16
        x, y = tile_at(z, west, (south + north) / 2)
        whole = [tiling.rgb_tile(globe, z, x + k, y, 8) for k in range(3)]
    drawn = np.hstack([heights_of(tile.image) for tile in whole if tile is not None])
    voids = np.hstack([tile.voids for tile in whole if tile is not None])
    seams = range(256, drawn.shape[1], 256)
    assert seams
    ordinary = np.abs(np.diff(drawn, axis=1))[(voids[:, 1:] == 0) & (voids[:, :-1] == 0)].max()
    for seam in seams:
        here = (voids[:, seam] == 0) & (voids[:, seam - 1] == 0)
        steps = np.abs(drawn[:, seam] - drawn[:, seam - 1])[here]
        assert steps.max(initial=0) <= ordinary


def test_voids_are_painted_and_the_terrain_is_clear(turned):
    with client_of(turned) as client:
        z = client.get("/hills/tiles.json").json()["maxzoom"]
        west, south, east, north = client.get("/terrains.json").json()[0]["bounds"]
        x, y = tile_at(z, (west + east) / 2, (south + north) / 2)
        heights = heights_of(client.get(f"/hills/rgb/{z}/{x}/{y}.png").content)
        address = f"/hills/voids/{z}/{x}/{y}.png"
        png = client.get(address, params={"color": "dbe4e8", "rim": 4}).content
        assert client.get(address, params={"color": "red"}).status_code == 422
        assert client.get(address, params={"color": "dbe4e8", "rim": 9}).status_code == 422
        far = client.get("/hills/voids/3/0/0.png?color=dbe4e8").content
        empty = client.get("/hills/rgb/3/0/0.png", params={"rim": 4}).content
    assert (np.asarray(Image.open(io.BytesIO(far))) == (0xDB, 0xE4, 0xE8, 255)).all()
    pixels = np.asarray(Image.open(io.BytesIO(png)))
    assert (pixels[..., :3] == (0xDB, 0xE4, 0xE8)).all()
    is_void = heights == heights_of(empty)[0, 0]
    assert is_void.any()
    assert (pixels[..., 3][~is_void] < 255).all()
    assert (pixels[..., 3][is_void] > 0).all()
    within = (slice(1, -1), slice(1, -1))  # what lies in other tiles counts too
    shares = pixels[..., 3][within]
    assert (shares[minimum_filter(~is_void, 3)[within]] == 0).all()
    assert (shares[minimum_filter(is_void, 3)[within]] == 255).all()
    assert ((shares > 0) & (shares < 255)).any()


def test_the_file_itself_is_served_with_ranges(hilly):
    data = hilly.read_bytes()
    with client_of(hilly) as client:
        assert client.get("/hills.twz").content == data
        part = client.get("/hills.twz", headers={"Range": "bytes=10-19"})
        assert client.head("/hills.twz").headers["content-length"] == str(len(data))
    assert (part.status_code, part.content) == (206, data[10:20])
    with served(make_app([str(hilly)])) as address, terrainwave.open(hilly) as terrain:
        with terrainwave.open(f"{address}/hills.twz") as remote:
            np.testing.assert_array_equal(remote.read((5, 6, 7, 8)), terrain.read((5, 6, 7, 8)))


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C there is no signal to send")
def test_ctrl_c_says_stopped(hilly):
    server = start("serve", hilly, "--port", "0")
    try:
        address = re.search(r"http://\S+", server.stdout.readline())[0]
        with urllib.request.urlopen(address, timeout=300) as page:
            assert page.status == 200
        server.send_signal(signal.SIGINT)
        said, complaint = server.communicate(timeout=300)
    finally:
        server.kill()
    assert server.returncode == 0
    assert said.strip() == "stopped"
    assert "Traceback" not in complaint
    assert "target" not in complaint


@pytest.mark.full
def test_names_on_stdin_are_served_until_it_ends(hilly, nowhere, tmp_path):
    missing = tmp_path / "missing.twz"
    answers = []
    with start("serve", "--stdin", "--quiet", "--port", "0", stdin=subprocess.PIPE) as server:
        try:
            for name in (hilly, nowhere, missing, hilly):
                print(name, file=server.stdin, flush=True)
                answers.append(json.loads(server.stdout.readline()))
            with urllib.request.urlopen(answers[1]["url"], timeout=300) as raster:
                assert raster.read(4) in (b"II*\0", b"II+\0")
            server.stdin.close()
            assert server.wait(300) == 0
        finally:
            server.kill()
    assert [answer["file"] for answer in answers] == [
        str(hilly), str(nowhere), str(missing), str(hilly)
    ]  # fmt: skip
    names = [answer.get("url", "").rpartition("/")[2] for answer in answers]
    assert names == ["hills.tif", "nowhere.tif", "", "hills-2.tif"]
    assert answers[0]["info"]["effective_error"] > 0
    assert "No such file" in answers[2]["error"]


def test_tiles_off_the_terrain_are_empty(hilly):
    with client_of(hilly) as client:
        assert client.get("/hills/rgb/10/0/0.png").status_code == 204
        assert client.get("/hills/rgb/9/267/181.png").status_code == 200
        far = client.get("/hills/height", params={"lon": 100, "lat": 0}).json()
    assert far["height"] is None
