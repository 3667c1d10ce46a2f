"""GDAL's commands give of a .twz file what they give of the GeoTIFF that `decompress` makes."""

import json

import numpy as np
import pytest
import rasterio
from gdal_driver.built import build, by_python, good
from gdal_driver.files import write_kind

import terrainwave
from benchmarks.slow_server import SlowServer

pytestmark = [pytest.mark.full, pytest.mark.gdal]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    build()
    return tmp_path_factory.mktemp("commands")


@pytest.fixture(scope="module", params=["int16-nodata", "uint8-mask"])
def pair(request, folder):
    """A .twz file and the GeoTIFF of it."""
    path = write_kind(folder, request.param)
    back = path.with_name(f"{request.param}-back.tif")
    if not back.exists():
        terrainwave.decompress(path, back)
    return path, back


def read(path):
    """Return heights, validity and place."""
    with rasterio.open(path) as dataset:
        valid = dataset.read_masks(1) > 0
        return np.where(valid, dataset.read(1), 0), valid, dataset.transform, dataset.crs


def assert_same(one, other):
    for a, b in zip(read(one)[:2], read(other)[:2], strict=True):
        np.testing.assert_array_equal(a, b)
    assert read(one)[2:] == read(other)[2:]


COMMANDS = {
    "cog": ["gdal_translate", "-q", "-of", "COG", "-co", "COMPRESS=ZSTD"],
    "window": ["gdal_translate", "-q", "-srcwin", "100", "290", "333", "222"],
    "warp": ["gdalwarp", "-q", "-t_srs", "EPSG:4326", "-r", "bilinear", "-ovr", "NONE"],
    "warp-threads": [
        "gdalwarp", "-q", "-t_srs", "EPSG:3857", "-r", "near", "-multi", "-wo", "NUM_THREADS=2",
        "-ovr", "NONE",
    ],
    "hillshade": ["gdaldem", "hillshade", "-q"],
    "slope": ["gdaldem", "slope", "-q", "-alg", "Horn"],
}  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_gives_what_it_gives_of_the_geotiff(pair, folder, name):
    made = [folder / f"{name}-{path.name}.made.tif" for path in pair]
    for path, target in zip(pair, made, strict=True):
        good(*COMMANDS[name], path, target)
    assert_same(*made)


def test_overviews_are_what_small_copies_are_made_of(pair, folder):
    """As of the GeoTIFF that is made while it is read."""
    target = folder / "small.tif"
    good("gdal_translate", "-q", "-outsize", "200", "0", pair[0], target)
    with terrainwave.open(pair[0]) as terrain, rasterio.open(terrain.geotiff()) as dataset:
        heights = read(target)[0]
        expected = np.where(
            dataset.read_masks(1, out_shape=heights.shape) > 0,
            dataset.read(1, out_shape=heights.shape), 0,
        )  # fmt: skip
    np.testing.assert_array_equal(heights, expected)


def test_contours_are_those_of_the_geotiff(pair, folder):
    lines = []
    for path in pair:
        target = folder / f"{path.name}.geojson"
        good("gdal_contour", "-q", "-a", "height", "-i", "50", path, target)
        lines.append(json.loads(target.read_text(encoding="utf-8"))["features"])
    assert lines[0] == lines[1]
    assert lines[0]


def test_a_vrt_of_files_reads_as_one(folder):
    heights = np.add.outer(np.arange(300), np.arange(900)).astype(np.int16)
    parts = []
    for i in range(3):
        source = folder / f"part{i}.tif"
        transform = rasterio.Affine(10, 0, 5000 + 3000 * i, 0, -10, 9000)
        with rasterio.open(
            source, "w", driver="GTiff", height=300, width=300, count=1, dtype="int16",
            crs="EPSG:32632", transform=transform,
        ) as raster:  # fmt: skip
            raster.write(heights[:, 300 * i : 300 * i + 300], 1)
        parts.append(source.with_suffix(".twz"))
        terrainwave.compress(source, parts[-1], max_error=0, mesh="none", threads=1)
    good("gdalbuildvrt", "-q", folder / "all.vrt", *parts)
    good("gdal_translate", "-q", folder / "all.vrt", folder / "all.tif")
    np.testing.assert_array_equal(read(folder / "all.tif")[0], heights)


@pytest.mark.parametrize("row", [0, 900])
def test_a_window_by_http_takes_as_few_requests_as_terrain(folder, row):
    path = write_kind(folder, "int16-nodata", block=64)
    code = """
dataset = gdal.Open(asked[0])
np.save(asked[1], dataset.ReadAsArray(*asked[2]))
print(0)
"""
    column, width, height = 300, 512, 400
    with SlowServer(folder, latency=0.001, bits_per_second=0) as server:
        with terrainwave.open(server.url(path.name)) as terrain:
            expected = terrain.read((row, column, height, width))
        n_of_terrain = server.n_requests
        n_bytes = server.n_bytes
        server.log.clear()
        asked = [f"/vsicurl/{server.url(path.name)}", str(folder / "http.npy")]
        by_python(
            code, [*asked, [column, row, width, height]], GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR"
        )
        # GDAL asks for the size first.
        assert server.n_requests <= n_of_terrain + 1
        assert server.n_bytes < 2 * n_bytes + 65536
    np.testing.assert_array_equal(np.load(folder / "http.npy"), expected)


@pytest.fixture(scope="module")
def rough(folder):
    """A file of 16 x 16 units in 1 + 4 segments, too large to be fetched whole."""
    rng = np.random.default_rng(1)
    heights = np.add.outer(np.arange(2049) * 3, np.arange(2049)) + rng.integers(0, 90, (2049, 2049))
    path = folder / "rough.twz"
    terrainwave.compress(heights.astype(np.int16), path, max_error=0, block=64, mesh="none")
    with terrainwave.open(path) as terrain:
        assert len(terrain.container.segment(None).layout.children) == 4
    assert path.stat().st_size > 3_000_000
    path.with_name("mark").write_bytes(b"what is asked for between opening and reading")
    return path


@pytest.mark.parametrize(
    ("place", "most"),
    [((1000, 300), 3), ((1900, 1900), 3), ((448, 1472), 3), ((600, 600), 3), ((960, 960), 8)],
)
def test_a_first_window_by_http_takes_few_requests(rough, place, most):
    """Three, but where four segments meet, which is the raster's middle."""
    code = """
dataset = gdal.Open(asked[0])
urllib.request.urlopen(asked[1]).read()
dataset.ReadAsArray(*asked[2])
print(0)
"""
    with SlowServer(rough.parent, latency=0.001, bits_per_second=0) as server:
        asked = [f"/vsicurl/{server.url(rough.name)}", server.url("mark"), [*place, 128, 128]]
        by_python("import urllib.request\n" + code, asked, GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR")
        paths = [exchange.path for exchange in server.log]
    opening = paths.index("/mark")
    assert opening <= 2  # GDAL asks for the size first
    assert 1 <= len(paths) - opening - 1 <= most


@pytest.mark.parametrize("box", [(0, 0, 1000, 900), (0, 700, 1091, 1)])
def test_blocks_are_fetched_together_not_one_by_one(folder, box):
    """A large window, and a line, below which five blocks lie."""
    path = write_kind(folder, "int16-nodata", block=64)
    code = "gdal.Open(asked[0]).ReadAsArray(*asked[1]); print(0)"
    with SlowServer(folder, latency=0.001, bits_per_second=0) as server:
        address = f"/vsicurl/{server.url(path.name)}"
        by_python(code, [address, box], GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR")
        assert server.n_requests <= 6
