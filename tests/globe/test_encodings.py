"""Pixels of terrain-RGB tiles in each encoding, by hand, and what an encoding cannot hold."""

import io
import re
import warnings

import numpy as np
import pytest
from click.testing import CliRunner
from ext.rasters import hills, write_twz
from fastapi.testclient import TestClient
from globe.test_archive import read_archive
from PIL import Image
from pmtiles.tile import TileType
from scipy.ndimage import map_coordinates

import terrainwave
from terrainwave.cli import main
from terrainwave.errors import InvalidArgumentError
from terrainwave.ext.publish import publish_site
from terrainwave.ext.serve.app import make_app
from terrainwave.globe import terrain_rgb as tiling
from terrainwave.globe.archive import write_pmtiles
from terrainwave.globe.lonlat import Globe

BOUNDS = (141.0, 11.0, 141.5, 11.4)
# Height in metres, and its pixel. By hand: mapbox (0 + 10000) / 0.1 = 100000 = 0x0186A0;
# (-10000 + 10000) / 0.1 = 0; (8848.8 + 10000) / 0.1 = 188488 = 0x02E048; -10900 and lower: 0.
# Terrarium: 0 + 32768 = 0x8000; -10900 + 32768 = 21868 = 0x556C; 8848.8125 + 32768 = 41616.8125 =
# 0xA290 and 0.8125 * 256 = 208 = 0xD0; -0.5 + 32768 = 32767.5 = 0x7FFF and 128.
PIXELS = {
    "mapbox": {0.0: (1, 0x86, 0xA0), -10000.0: (0, 0, 0), 8848.8: (2, 0xE0, 0x48),
               -10900.0: (0, 0, 0)},
    "terrarium": {0.0: (0x80, 0, 0), -10900.0: (0x55, 0x6C, 0), 8848.8125: (0xA2, 0x90, 0xD0),
                  -0.5: (0x7F, 0xFF, 128)},
}  # fmt: skip


def pixels_of(png):
    return np.asarray(Image.open(io.BytesIO(png)))


def middle_tile(globe):
    """Return the tile of the terrain's middle on zoom 11, which lies within it."""
    west, south, east, north = globe.extent
    column, row = tiling.column_of(11, (west + east) / 2), tiling.row_of(11, (south + north) / 2)
    return 11, int(column), int(row)


@pytest.fixture(scope="module")
def trench(tmp_path_factory):
    """A trench down to -10,900 m with a void of some 60 x 60 samples in its middle."""
    heights = hills(300, 300) - 10_000
    heights[:100] = -10_900
    heights[120:180, 120:180] = 32_000
    folder = tmp_path_factory.mktemp("trench")
    return write_twz(folder, heights, BOUNDS, name="trench", nodata=32_000, max_error=0)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return write_twz(tmp_path_factory.mktemp("plain"), hills(65, 97), BOUNDS, name="plain")


def client_of(path, **options):
    return TestClient(make_app([str(path)], **options), "http://127.0.0.1")


@pytest.mark.parametrize("encoding", PIXELS)
def test_pixels_are_those_of_the_encoding(tmp_path, encoding):
    for height, pixel in PIXELS[encoding].items():
        twz = write_twz(tmp_path, np.full((33, 33), height), BOUNDS, name="flat", max_error=0)
        with terrainwave.open(twz) as terrain:
            globe = Globe(terrain)
            tile = tiling.rgb_tile(globe, *middle_tile(globe), 0, tiling.Look(encoding))
        assert (pixels_of(tile.image) == pixel).all(), height
        is_held = height >= -10000 or encoding == "terrarium"
        assert tile.error == pytest.approx(0 if is_held else 900, abs=1e-6)
        (tmp_path / "flat.twz").unlink()


@pytest.mark.parametrize("rim", [0, 4])
def test_voids_are_transparent_if_asked_for_and_keep_their_colours(trench, rim):
    with terrainwave.open(trench) as terrain:
        globe = Globe(terrain)
        at = middle_tile(globe)
        opaque = tiling.rgb_tile(globe, *at, rim, tiling.Look("terrarium"))
        clear = tiling.rgb_tile(globe, *at, rim, tiling.Look("terrarium", True))
        empty = pixels_of(tiling.void_tile(globe, tiling.Look("terrarium", True)))
    colours, pixels = pixels_of(opaque.image), pixels_of(clear.image)
    assert (colours == pixels[..., :3]).all()
    # 1 m below the lowest: -10,901 + 32,768 = 21,867 = 0x556B
    is_void = (colours == (0x55, 0x6B, 0)).all(axis=-1)
    assert 0 < is_void.sum() < is_void.size
    assert (pixels[..., 3] == np.where(is_void, 0, 255)).all()
    assert (empty == (0x55, 0x6B, 0, 0)).all()


@pytest.mark.parametrize("encoding", ["mapbox", "terrarium"])
def test_an_archive_has_the_encoding_and_says_what_it_cannot_hold(tmp_path, trench, encoding):
    target = tmp_path / "a.pmtiles"
    args = ["tiles", str(trench), str(target), "--max-zoom", "6", "--transparent-voids"]
    done = CliRunner().invoke(main, [*args, "--encoding", encoding])
    assert done.exit_code == 0, done.output
    notes = [line for line in done.stderr.splitlines() if "heights reach" in line]
    if encoding == "terrarium":
        assert notes == []
    else:
        (note,) = notes
        assert "heights reach from -10900 to " in note
        assert "tiles of --encoding mapbox hold none below -10000 m, which is shown" in note
        assert note.endswith("; --encoding terrarium holds them")
    tiles, _, metadata = read_archive(target)
    assert metadata["encoding"] == encoding
    assert all(pixels_of(png).shape[-1] == 4 for png in tiles.values())


def heights_in(image, encoding):
    """Return heights by the formulas of the encodings' authors."""
    red, green, blue, *alpha = np.moveaxis(pixels_of(image).astype(float), -1, 0)
    if encoding == "mapbox":
        heights = -10000 + (red * 256 * 256 + green * 256 + blue) * 0.1
    else:
        heights = red * 256 + green + blue / 256 - 32768
    return np.where(alpha[0] == 0, np.nan, heights) if alpha else heights


def test_webp_and_png_have_the_same_pixels_and_say_which_they_are(tmp_path, plain):
    made = {}
    with terrainwave.open(plain) as terrain:
        for image in ("webp", "png"):
            options = {} if image == "webp" else {"image": image}  # the default
            write_pmtiles(terrain, tmp_path / f"{image}.pmtiles", transparent_voids=True, **options)
            made[image], header, metadata = read_archive(tmp_path / f"{image}.pmtiles")
            assert header["tile_type"] == {"png": TileType.PNG, "webp": TileType.WEBP}[image]
            assert metadata["format"] == image
            assert {Image.open(io.BytesIO(one)).format.lower() for one in made[image].values()} == {
                image
            }
    assert made["webp"].keys() == made["png"].keys()
    for place, tile in made["webp"].items():
        assert (pixels_of(tile) == pixels_of(made["png"][place])).all()
    assert sum(map(len, made["webp"].values())) < 0.8 * sum(map(len, made["png"].values()))


def test_a_tile_of_512_pixels_is_four_of_the_next_zoom(tmp_path, trench):
    tiles, headers, last, encoding = {}, {}, {}, "terrarium"
    with terrainwave.open(trench) as terrain:
        for size in (256, 512):
            target = tmp_path / f"{size}.pmtiles"
            zooms = write_pmtiles(terrain, target, min_zoom=6, tile_size=size, encoding=encoding)
            tiles[size], headers[size], metadata = read_archive(target)
            assert metadata["tileSize"] == size
            last[size] = zooms[-1].zoom
    assert last[512] == headers[512]["max_zoom"] == last[256] - 1
    compared = 0
    for (z, x, y), tile in tiles[512].items():
        pixels = pixels_of(tile)
        assert pixels.shape == (512, 512, 3)
        for row, col in np.ndindex(2, 2):
            quarter = tiles[256].get((z + 1, 2 * x + col, 2 * y + row))
            if z == last[512] and quarter is not None:
                part = pixels[256 * row : 256 * (row + 1), 256 * col : 256 * (col + 1)]
                assert (part == pixels_of(quarter)).all()
                compared += 1
    assert compared > 3


def surface_of(heights, bounds, z, x, y, size):
    """Return the bilinear surface of samples at a tile's pixels; NaN outside the outermost."""
    west, south, east, north = bounds
    at = (np.arange(size) + 0.5) / size
    lon = (x + at) / 2**z * 360 - 180
    lat = np.degrees(np.arctan(np.sinh(np.pi * (1 - 2 * (y + at) / 2**z))))
    rows = (north - lat) / (north - south) * heights.shape[0] - 0.5
    cols = (lon - west) / (east - west) * heights.shape[1] - 0.5
    rows, cols = np.meshgrid(rows, cols, indexing="ij")
    return map_coordinates(heights, [rows, cols], order=1, mode="constant", cval=np.nan)


@pytest.mark.parametrize("encoding", ["mapbox", "terrarium"])
@pytest.mark.parametrize(("max_error", "tile_size"), [(0, 256), (3, 512)])
def test_no_pixel_is_further_from_the_original_than_its_zoom_states(
    tmp_path, encoding, max_error, tile_size
):
    originals, target = hills(300, 400, seed=7) - 350, tmp_path / "a.pmtiles"
    twz = write_twz(tmp_path, originals, BOUNDS, max_error=max_error)
    args = ["tiles", str(twz), str(target), "--round-by-zoom", "--encoding", encoding, "--min-zoom",
            "4", "--tile-size", str(tile_size), "--transparent-voids"]  # fmt: skip
    done = CliRunner().invoke(main, args)
    assert done.exit_code == 0, done.output
    tiles, _, metadata = read_archive(target)
    printed = {line.split()[0]: line.split() for line in done.stdout.splitlines()}
    unit = 0.1 if encoding == "mapbox" else 1 / 256
    steps = []
    for zoom in metadata["zooms"]:
        z, step, error = zoom["zoom"], zoom["step"], zoom["error"]
        assert error == pytest.approx(step / 2 + zoom["terrain_error"])
        assert printed[str(z)][3] == f"{step:g}"
        assert float(printed[str(z)][-1]) == pytest.approx(error, rel=1e-4)
        distances = []
        for (_, x, y), tile in [one for one in tiles.items() if one[0][0] == z]:
            drawn = heights_in(tile, encoding)
            offsets = np.abs(drawn / step - np.rint(drawn / step))
            assert offsets[np.isfinite(offsets)].max() < 1e-6  # zero is such a height, too
            surface = surface_of(originals.astype(float), BOUNDS, z, x, y, tile_size)
            distances.append(np.abs(drawn - surface))
        largest = max(np.nanmax(one) for one in distances if np.isfinite(one).any())
        assert step / 4 < largest <= error + 1e-6
        # by hand: 2πa/2^z at the middle's latitude, a 64th of a pixel
        pixel = 2 * np.pi * 6378137 * np.cos(np.radians(11.2)) / (tile_size << z)
        wanted = min(max(max_error, unit) * 2 ** (metadata["zooms"][-1]["zoom"] - z), pixel / 64)
        assert step == pytest.approx(unit * 2 ** max(np.floor(np.log2(wanted / unit)), 0))
        steps.append(step)
    assert steps == sorted(steps, reverse=True)
    assert steps[0] > 8 * steps[-1]


def test_the_error_of_a_zoom_has_what_the_encoding_cannot_hold(tmp_path, trench):
    target = tmp_path / "a.pmtiles"
    with terrainwave.open(trench) as terrain, warnings.catch_warnings(action="ignore"):
        zooms = write_pmtiles(terrain, target, min_zoom=7, round_by_zoom=True)
    # down to -10,900 m, and the encoding begins at -10,000 m
    assert all(zoom.error - zoom.terrain_error == pytest.approx(900) for zoom in zooms)


@pytest.mark.parametrize("encoding", ["mapbox", "terrarium"])
def test_voids_lie_below_heights_that_are_rounded_down(tmp_path, encoding):
    heights = np.maximum(hills(200, 200) - 400, 5)
    heights[50:100, 50:100] = -9999
    twz = write_twz(tmp_path, heights, BOUNDS, max_error=8, nodata=-9999)
    look = {"encoding": encoding, "round_by_zoom": True}
    found = {}
    with terrainwave.open(twz) as terrain:
        for is_clear in (False, True):
            target = tmp_path / f"{is_clear}.pmtiles"
            zooms = write_pmtiles(terrain, target, min_zoom=5, transparent_voids=is_clear, **look)
            found[is_clear] = read_archive(target)[0]
    assert any(5 % zoom.step > 0.5 for zoom in zooms)
    for place, tile in found[False].items():
        drawn, is_void = (
            heights_in(tile, encoding),
            np.isnan(heights_in(found[True][place], encoding)),
        )
        assert 0 < is_void.sum() < is_void.size
        assert drawn[is_void].max() < drawn[~is_void].min()


@pytest.mark.parametrize(("encoding", "height"), [("mapbox", -10_001), ("terrarium", 32_768)])
def test_a_height_of_voids_that_does_not_fit_is_refused(tmp_path, plain, encoding, height):
    with (
        terrainwave.open(plain) as terrain,
        pytest.raises(InvalidArgumentError, match=f"void_height {height}, expected -"),
    ):
        write_pmtiles(terrain, tmp_path / "a.pmtiles", void_height=height, encoding=encoding)


def test_an_encoding_that_there_is_not_is_refused(tmp_path, plain):
    expected = "found encoding 'rgb', expected mapbox or terrarium"
    with terrainwave.open(plain) as terrain, pytest.raises(InvalidArgumentError, match=expected):
        write_pmtiles(terrain, tmp_path / "a.pmtiles", encoding="rgb")
    with pytest.raises(InvalidArgumentError, match=expected):
        make_app([str(plain)], encoding="rgb")
    with pytest.raises(InvalidArgumentError, match=expected):
        publish_site([str(plain)], tmp_path / "site", encoding="rgb")


def test_a_server_has_one_encoding_and_answers_in_the_other_where_asked(trench):
    with client_of(trench, encoding="terrarium", transparent_voids=True) as client:
        (listed,) = client.get("/terrains.json").json()
        told = client.get("/trench/tiles.json").json()
        other = client.get("/trench/tiles.json?encoding=mapbox&voids=height&rim=2").json()
        assert (listed["encoding"], told["encoding"], other["encoding"]) == (
            "terrarium", "terrarium", "mapbox",
        )  # fmt: skip
        plain, asked = (
            one["tiles"][0].partition("/trench/rgb/{z}/{x}/{y}.png?")[2] for one in (told, other)
        )
        assert re.fullmatch(r"v=\w+&encoding=terrarium&voids=transparent", plain)
        assert re.fullmatch(r"v=\w+&encoding=mapbox&voids=height&rim=2", asked)
        with terrainwave.open(trench) as terrain:
            globe = Globe(terrain)
            z, x, y = middle_tile(globe)
            look = tiling.Look("terrarium", True)
            expected = [
                tiling.rgb_tile(globe, z, x, y, 0, look).image,
                tiling.rgb_tile(globe, z, x, y, 2).image,
            ]
        answers = [client.get(one["tiles"][0].format(z=z, x=x, y=y)) for one in (told, other)]
        assert [answer.content for answer in answers] == expected
        assert answers[0].headers["etag"] != answers[1].headers["etag"]
        empty = client.get("/trench/rgb/11/0/0.png?rim=2")
        assert pixels_of(empty.content)[..., 3].max() == 0
        assert client.get("/trench/rgb/11/0/0.png?encoding=rgb").status_code == 422
