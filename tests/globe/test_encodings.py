"""Pixels of terrain-RGB tiles in each encoding, by hand, and what an encoding cannot hold."""

import io
import re

import numpy as np
import pytest
from click.testing import CliRunner
from ext.rasters import hills, write_twz
from fastapi.testclient import TestClient
from globe.test_archive import read_archive
from PIL import Image

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
        assert (pixels_of(tile.png) == pixel).all(), height
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
    colours, pixels = pixels_of(opaque.png), pixels_of(clear.png)
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
                tiling.rgb_tile(globe, z, x, y, 0, look).png,
                tiling.rgb_tile(globe, z, x, y, 2).png,
            ]
        answers = [client.get(one["tiles"][0].format(z=z, x=x, y=y)) for one in (told, other)]
        assert [answer.content for answer in answers] == expected
        assert answers[0].headers["etag"] != answers[1].headers["etag"]
        empty = client.get("/trench/rgb/11/0/0.png?rim=2")
        assert pixels_of(empty.content)[..., 3].max() == 0
        assert client.get("/trench/rgb/11/0/0.png?encoding=rgb").status_code == 422
