"""What notebooks get of a Terrain."""

import base64
import io
import re

import xarray as xr
from PIL import Image
from strategies import terrain_like

import terrainwave


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
