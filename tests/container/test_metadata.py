"""The JSON metadata (FORMAT.md §4.2): what is kept, and what is refused."""

import json
import re
import tracemalloc
import zlib

import pytest
from container.toys import toy_header
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.annexes import read_annex
from terrainwave.coding.deflate import deflate, inflate
from terrainwave.container.header import MAX_METADATA
from terrainwave.container.metadata import pack_metadata, unpack_metadata
from terrainwave.errors import CorruptStreamError, InvalidHeightsError, TerrainwaveError

FULL = {
    "crs": "EPSG:25832",
    "transform": [30.0, 0.0, 500000.0, 0.0, -30.0, 4e6],
    "nodata": -9999,
    "mask_kind": "nodata",
    "units": "metre",
    "scale": 0.1,
    "offset": -5,
    "area_or_point": "Point",
    "description": "Größe, <script>, \x1b[1m",
    "software": "terrainwave",
    "a key of the future": {"list": [1, 2.5, None, True, "x"]},
}


def deflated(text):
    return deflate(text if isinstance(text, bytes) else text.encode(), read_annex("dictionary.txt"))


def test_metadata_come_back_with_unknown_keys():
    assert unpack_metadata(pack_metadata(FULL)) == FULL


def test_the_order_of_keys_does_not_change_the_bytes():
    assert pack_metadata(dict(reversed(FULL.items()))) == pack_metadata(FULL)


@pytest.mark.parametrize("nodata", [0, -9999.5, -3.4028234663852886e38, "nan", "inf", "-inf", None])
def test_every_kind_of_nodata_comes_back(nodata):
    assert unpack_metadata(pack_metadata({"nodata": nodata})) == {"nodata": nodata}


@pytest.mark.full
@given(
    st.dictionaries(
        st.text(max_size=8).map("own ".__add__),
        st.recursive(
            st.none()
            | st.booleans()
            | st.integers(-(2**64), 2**64)
            | st.text(max_size=8)
            | st.floats(allow_nan=False, allow_infinity=False),
            lambda inner: (
                st.lists(inner, max_size=3)
                | st.dictionaries(st.text(max_size=3), inner, max_size=3)
            ),
            max_leaves=8,
        ),
        max_size=5,
    )
)
def test_any_json_of_unknown_keys_comes_back(metadata):
    try:
        packed = pack_metadata(metadata)
    except InvalidHeightsError:  # lone surrogates, nested too deeply
        return
    assert unpack_metadata(packed) == metadata


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not the JSON"),
        ("{", "not the JSON"),
        ("{} {}", "not the JSON"),
        ("null", "not a JSON object"),
        ('{"own": {"b": 1, "b": 2}}', "twice"),
        ('{"a": Infinity}', "Infinity"),
        ('{"a": -Infinity}', "Infinity"),
        ('{"a": "\n"}', "not the JSON"),
        ('{"units": []}', "units is not a string"),
        ('{"scale": "1"}', "scale is not a number"),
        ('{"scale": true}', "scale is not a number"),
        ('{"moved": 1.5}', "moved is not a whole number of quanta"),
        ('{"moved": true}', "moved is not a whole number of quanta"),
        ('{"moved": 4294967296}', "moved is not a whole number of quanta"),
        ('{"tags": "x"}', "tags is not an object of strings"),
        ('{"band_tags": {"a": 1}}', "band_tags is not an object of strings"),
        ('{"color_interpretation": []}', "color_interpretation is not a string"),
        ('{"offset": {}}', "offset is not a number"),
        ('{"offset": ' + "9" * 400 + "}", "is too large"),
        ('{"unknown": ' + "9" * 400 + "}", "is too large"),
        ('{"transform": [1, 0, 0, 0, 1, "0"]}', "six numbers"),
        ('{"nodata": "NaN"}', "nodata"),
        ('{"nodata": false}', "nodata"),
        ('{"nodata": []}', "nodata"),
    ],
)
def test_other_json_is_corrupt(text, message):
    with pytest.raises(CorruptStreamError, match=message):
        unpack_metadata(deflated(text))


@pytest.mark.parametrize("depth", [17, 1000, 400_000])
@pytest.mark.parametrize("pair", ["[]", "{}"])
def test_deep_nesting_is_corrupt_and_does_not_recurse(depth, pair):
    opening = '{"a":' if pair == "{}" else "["
    with pytest.raises(CorruptStreamError, match=r"nested deeper|more than"):
        unpack_metadata(deflated('{"a":' + opening * depth + "0" + pair[1] * depth + "}"))


def test_brackets_in_strings_are_no_nesting():
    metadata = {"description": "[" * 100 + '\\"{' * 100}
    assert unpack_metadata(pack_metadata(metadata)) == metadata


@pytest.mark.full
def test_a_bomb_is_stopped_while_it_inflates():
    bomb = deflated(b" " * 200_000_000)
    assert len(bomb) < MAX_METADATA
    tracemalloc.start()
    with pytest.raises(CorruptStreamError, match="inflates to more than 1048576"):
        unpack_metadata(bomb)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 * MAX_METADATA


@pytest.mark.parametrize(
    ("packed", "message"),
    [
        (b"", "without an end"),
        (b"\xff", "cannot be inflated"),
        (zlib.compress(b"{}"), "cannot be inflated"),
    ],
)
def test_other_bytes_than_one_deflate_stream_are_corrupt(packed, message):
    with pytest.raises(CorruptStreamError, match=message):
        unpack_metadata(packed)


@given(st.binary(max_size=64))
def test_any_bytes_give_metadata_or_our_own_error(data):
    for packed in (data, deflated(data)):
        try:
            metadata = unpack_metadata(packed)
        except TerrainwaveError:
            continue
        assert isinstance(metadata, dict)


@pytest.mark.parametrize(
    "metadata",
    [{"a": float("nan")}, {"a": {1, 2}}, {"scale": 0}, {"a": "\ud800"}, {"a": "x" * 2**20}],
)
def test_metadata_that_could_not_be_read_are_not_written(metadata):
    with pytest.raises(InvalidHeightsError, match="metadata"):
        pack_metadata(metadata)


def test_nothing_about_time_host_or_path_is_added():
    text = inflate(
        pack_metadata(toy_header().metadata), MAX_METADATA, "metadata", read_annex("dictionary.txt")
    ).decode()
    assert json.loads(text).keys() == toy_header().metadata.keys()
    assert not re.search(r"\s", text)
