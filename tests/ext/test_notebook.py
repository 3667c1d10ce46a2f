"""What notebooks get of a Terrain."""

import base64
import io
import re

import numpy as np
import pytest
import xarray as xr
from PIL import Image
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.ext.html import picture


def bytes_of(heights, **options):
    return terrainwave.compress_to_bytes(
        heights, **{"block": 32, "max_error": 2, "method": "store", **options}
    )


def table_of(page):
    """Return names and values of the table."""
    return dict(re.findall(r"<tr><th[^>]*>(.*?)</th><td[^>]*>(.*?)</td></tr>", page))


def test_page_shows_size_bound_levels_and_a_picture():
    with terrainwave.open(bytes_of(terrain_like(150, 90))) as terrain:
        page = terrain._repr_html_()
        table = table_of(page)
        assert table["size"].startswith("150 × 90 samples, int16;")
        assert table["bound"] == "every height within 2 of the original"
        assert table["unit"] == "unknown"
        assert table["levels"].endswith("75 × 45, 150 × 90")
        (data,) = re.findall(r"data:image/png;base64,([^\"]+)", page)
        assert Image.open(io.BytesIO(base64.b64decode(data))).size == (90, 150)


def test_picture_is_small_whatever_the_raster():
    with terrainwave.open(bytes_of(np.zeros((3, 2000), np.int16))) as terrain:
        assert picture(terrain).shape == (1, 320, 3)


def test_text_of_a_file_is_escaped(tmp_path):
    bad = "<script>alert(1)</script>\x1b[31m\u202e"
    array = xr.DataArray(terrain_like(9, 9), dims=("y", "x"), attrs={"units": bad})
    with terrainwave.open(bytes_of(array)) as terrain:
        page = terrain._repr_html_()
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert not {"\x1b", "\u202e"} & set(page)


def test_damaged_file_shows_its_table_and_what_is_wrong():
    data = bytearray(bytes_of(terrain_like(40, 40)))
    data[-2] ^= 1
    with terrainwave.open(bytes(data)) as terrain:
        page = terrain._repr_html_()
    assert "<img" not in page
    assert "no picture: checksum of the payload" in page
    assert table_of(page)["size"].startswith("40 × 40")


def test_voids_are_grey_and_north_is_up(tmp_path):
    heights = terrain_like(40, 40, "float32")
    heights[:10] = np.nan  # the first rows
    south_up = {"transform": (10, 0, 0, 0, 10, 0), "crs": "EPSG:32633"}
    tif = write_geotiff(tmp_path / "a.tif", heights, **south_up)
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=1, method="store", mesh="none")
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        image = picture(terrain)
    np.testing.assert_array_equal((image == 238).all(axis=2).all(axis=1), np.arange(40) >= 30)


def test_light_comes_from_the_north_west():
    # A roof whose ridge runs from north to south: its western side faces the light.
    roof = np.tile(20 - np.abs(np.arange(40) - 20), (40, 1)).astype(np.int16)
    with terrainwave.open(bytes_of(roof, max_error=0)) as terrain:
        image = picture(terrain).astype(int).sum(axis=2)
    assert (image[:, 10] > image[:, 30]).all()


def test_to_xarray_reads_windows_of_a_level():
    with terrainwave.open(bytes_of(terrain_like(150, 90))) as terrain:
        array = terrain.to_xarray(level=-2)
        np.testing.assert_array_equal(array[3:9, 20:30], terrain.read((3, 20, 6, 10), level=-2))
        assert array.name == "heights"


def test_to_xarray_says_what_is_missing(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "xarray", None)
    with terrainwave.open(bytes_of(terrain_like(9, 9))) as terrain:
        with pytest.raises(terrainwave.TerrainwaveError, match=r"terrainwave\[xarray\]"):
            terrain.to_xarray()


def test_info_without_heights_is_shown():
    heights = np.full((9, 9), -1, np.int16)
    with terrainwave.open(bytes_of(heights, nodata=-1)) as terrain:
        assert table_of(terrain._repr_html_())["heights"] == "none"
