"""The Zarr codec inside zarr itself, found by its entry point."""

import itertools
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from strategies import terrain_like
from zarr.storage import MemoryStore

import terrainwave
import zarr
from terrainwave.errors import (
    CorruptStreamError,
    InvalidHeightsError,
    TerrainwaveWarning,
)
from terrainwave.ext.zarr_codec import TerrainwaveCodec


def make_array(heights, chunks, *, max_error=1.0, codec=None, **options):
    """Return (array, store) with `heights` written through the codec."""
    store = MemoryStore()
    options = {"fill_value": 0, "compressors": None} | options
    array = zarr.create_array(
        store,
        shape=heights.shape,
        dtype=heights.dtype,
        chunks=chunks,
        serializer=codec or TerrainwaveCodec(max_error=max_error),
        **options,
    )
    array[...] = heights
    return array, store


def largest_error(array, heights):
    return np.abs(array[...].astype(np.float64) - heights).max()


@pytest.mark.parametrize("chunks", [(7, 20), (13, 3), (32, 32)])
def test_every_sample_is_within_the_bound_for_any_chunk_shape(chunks):
    heights = terrain_like(20, 24)
    array, store = make_array(heights, chunks, max_error=2)
    assert 1 <= largest_error(array, heights) <= 2
    assert largest_error(zarr.open_array(store), heights) <= 2  # by the entry point


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "int32", "float32", "float64"])
def test_each_type_comes_back_as_itself(dtype):
    heights = terrain_like(12, 15, dtype)
    array, _ = make_array(heights, (12, 15), max_error=0.5)
    assert array[...].dtype == heights.dtype
    assert largest_error(array, heights) <= 0.5


def test_big_endian_heights_come_back():
    heights = terrain_like(20, 30, "int16").astype(">i2")
    array, _ = make_array(heights, (20, 30), max_error=0)
    np.testing.assert_array_equal(array[...], heights)


def test_chunks_inside_shards_are_bounded():
    heights = terrain_like(24, 24)
    array, store = make_array(heights, (6, 8), shards=(12, 16), max_error=1)
    assert largest_error(zarr.open_array(store), heights) <= 1
    np.testing.assert_array_equal(array[5:7, 7:9], array[...][5:7, 7:9])


def test_leading_dimensions_of_one_are_a_stack_of_rasters():
    heights = np.stack([terrain_like(12, 10, seed=seed) for seed in range(3)])
    array, _ = make_array(heights, (1, 12, 10), max_error=1)
    assert largest_error(array, heights) <= 1


@pytest.mark.parametrize("shape", [(8,), (2, 8, 8)])
def test_chunks_that_are_no_rasters_are_refused_with_the_shape_to_use(shape):
    with pytest.raises(InvalidHeightsError, match=r"expected chunks of shape \(n_rows, n_cols\)"):
        make_array(np.zeros(shape, np.int16), shape)


def test_unsupported_type_is_refused_when_the_array_is_made():
    with pytest.raises(InvalidHeightsError, match="found an array of int64"):
        make_array(np.zeros((4, 4), np.int64), (4, 4))


def test_fill_value_and_nan_come_back_exactly():
    heights = terrain_like(20, 20)
    heights[5:9, 3:20] = -9999
    array, _ = make_array(heights, (20, 20), max_error=3, fill_value=-9999)
    np.testing.assert_array_equal(array[...] == -9999, heights == -9999)
    floats = heights.astype(np.float32)
    floats[heights == -9999] = np.nan
    array, _ = make_array(floats, (20, 20), max_error=3, fill_value=-1.0)
    np.testing.assert_array_equal(np.isnan(array[...]), np.isnan(floats))


def test_nan_and_fill_value_in_one_chunk_are_refused():
    heights = np.array([[1, np.nan], [-5, 3]])
    with pytest.raises(InvalidHeightsError, match="both NaN and -5 in a chunk"):
        make_array(heights, (2, 2), max_error=1, fill_value=-5)


def test_empty_chunks_are_not_stored_or_take_a_header_only():
    heights = np.full((64, 64), -9999, np.int16)
    _, store = make_array(heights, (32, 32), fill_value=-9999)
    assert list(store._store_dict) == ["zarr.json"]
    config = {"write_empty_chunks": True}
    _, store = make_array(heights, (64, 64), fill_value=-9999, config=config)
    (chunk,) = (value for key, value in store._store_dict.items() if key.startswith("c/"))
    # Its header and checksums (FORMAT.md §4.1) and the name of the software, no heights.
    assert len(chunk) < 400


def test_chunk_is_a_twz_file():
    heights = terrain_like(20, 20)
    _, store = make_array(heights, (20, 20), max_error=0)
    with terrainwave.open(store._store_dict["c/0/0"].to_bytes()) as terrain:
        np.testing.assert_array_equal(terrain.read(), heights)
        assert terrain.nodata is None  # the fill value 0 is a height


def damaged(store, data):
    store._store_dict["c/0/0"] = store._store_dict["c/0/0"].from_bytes(data)
    return zarr.open_array(store)


@pytest.mark.parametrize("cut", [0, 7, 120, -1])
def test_cut_chunk_is_a_clear_error(cut):
    _, store = make_array(terrain_like(20, 20), (20, 20))
    data = store._store_dict["c/0/0"].to_bytes()
    with pytest.raises(CorruptStreamError, match="a chunk of the codec terrainwave is damaged"):
        damaged(store, data[:cut])[...]


def test_flipped_byte_of_a_chunk_is_a_clear_error():
    _, store = make_array(terrain_like(20, 20), (20, 20))
    data = bytearray(store._store_dict["c/0/0"].to_bytes())
    data[-3] ^= 0x10
    with pytest.raises(CorruptStreamError, match="is damaged"):
        damaged(store, bytes(data))[...]


@pytest.mark.parametrize("other", [(21, 20, "int16"), (20, 20, "int32"), (1, 400, "int16")])
def test_chunk_of_another_shape_or_type_is_refused(other):
    n_rows, n_cols, dtype = other
    _, store = make_array(terrain_like(20, 20), (20, 20))
    foreign = terrainwave.compress_to_bytes(np.zeros((n_rows, n_cols), dtype))
    with pytest.raises(CorruptStreamError, match=r"expected int16 of shape \(20, 20\)"):
        damaged(store, foreign)[...]


def test_metadata_name_the_codec_what_was_chosen_and_whether_heights_are_stable():
    _, store = make_array(np.zeros((4, 4), np.int16), (4, 4), max_error=0.25)
    (codec,) = json.loads(store._store_dict["zarr.json"].to_bytes())["codecs"]
    assert codec == {"name": "terrainwave", "configuration": {"max_error": 0.25, "stable": True}}
    for stable in (False, True):
        codec = TerrainwaveCodec(max_error=1, nodata=-1, effort="fast", stable=stable)
        assert codec.to_dict()["configuration"]["stable"] is stable
        assert TerrainwaveCodec.from_dict(codec.to_dict()) == codec


@pytest.mark.parametrize(
    "configuration",
    [
        {},
        {"max_error": -1},
        {"max_error": "1"},
        {"max_error": 1, "quality": 3},
        {"max_error": 1, "nodata": "x"},
        {"max_error": 1, "effort": "most"},
        {"max_error": 1, "stable": 1},
    ],
)
def test_bad_configuration_is_refused(configuration):
    with pytest.raises(InvalidHeightsError, match="expected"):
        TerrainwaveCodec.from_dict({"name": "terrainwave", "configuration": configuration})


FILL = -32768


def five_kinds():
    """Return arrays by name: smooth, noisy and decimal floats, doubles, whole numbers."""
    rng = np.random.default_rng(5)
    row, col = np.mgrid[0:48, 0:60]
    smooth = 800 + 300 * np.sin(col / 9) * np.cos(row / 7)
    noise = rng.normal(size=smooth.shape)
    return {
        "smooth": smooth.astype("f4"),
        "noisy": (smooth + 0.8 * noise).astype("f4"),
        "decimal": np.round(smooth + noise, 2).astype("f4"),
        "double": smooth + noise,
        "whole": (3 * smooth).astype("i2"),
    }


# 0.1 is no float, nor is a multiple of it; 3.7 of whole numbers is 3.
BOUNDS = {"smooth": (0.5, 3), "noisy": (0.1, 3), "decimal": (0.004, 0.5), "double": (0.1, 7.3)}
CASES = [(kind, BOUNDS.get(kind, (1, 3.7))[i % 2]) for i, kind in enumerate(five_kinds())]
LAYOUTS = [dict(chunks=(24, 24)), dict(chunks=(12, 20), shards=(24, 60))]


def bits(heights):
    return np.ascontiguousarray(heights).view(f"u{heights.itemsize}")


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("kind", "max_error", "layout"),
    [(*case, layout) for case, layout in zip(CASES, itertools.cycle(LAYOUTS), strict=False)],
)
def test_writes_of_parts_keep_the_bound_and_move_nothing_else(kind, max_error, layout):
    heights = five_kinds()[kind]
    array, _ = make_array(heights, max_error=max_error, fill_value=FILL, **layout)
    rng = np.random.default_rng(7)
    originals, before = heights.copy(), array[...]
    for _ in range(12):
        first, n_rows = int(rng.integers(0, 46)), int(rng.integers(1, 3))
        part = slice(first, first + n_rows), slice(int(rng.integers(0, 30)), 55)
        own = heights[part] + 20 * rng.normal(size=heights[part].shape)
        originals[part] = own.astype(heights.dtype)
        array[part] = originals[part]
        before[part], after = array[part], array[...]
        np.testing.assert_array_equal(bits(after), bits(before))
    assert 0 < largest_error(array, originals) <= max_error


@pytest.mark.few(1)
@pytest.mark.parametrize(("kind", "max_error"), CASES)
def test_appended_rows_move_none_of_the_chunk_they_share(kind, max_error):
    heights = five_kinds()[kind]
    array, _ = make_array(heights[:10], (24, 24), max_error=max_error, fill_value=FILL)
    before = array[...]
    for first in range(10, 48, 4):
        array.append(heights[first : first + 4])
        before = np.concatenate([before, array[first:]])
        np.testing.assert_array_equal(bits(array[...]), bits(before))
    assert 0 < largest_error(array, heights) <= max_error


@pytest.mark.few(1)
@pytest.mark.parametrize(("kind", "max_error"), CASES)
def test_ten_copies_hold_the_same_heights(kind, max_error):
    heights = five_kinds()[kind]
    array, _ = make_array(heights, (24, 24), max_error=max_error, fill_value=FILL)
    first = array[...]
    for copy in range(10):
        chunks = (24 - copy, 30)  # other chunks than before
        array, _ = make_array(array[...], chunks, max_error=max_error, fill_value=FILL)
    np.testing.assert_array_equal(bits(array[...]), bits(first))
    assert 0 < largest_error(array, heights) <= max_error


@pytest.mark.few(1)
@pytest.mark.parametrize("dtype", ["uint8", "int16", "int32"])
def test_heights_at_the_ends_of_a_type_stay_within_the_bound(dtype):
    limits = np.iinfo(dtype)
    ends = np.r_[limits.min : limits.min + 40, limits.max - 39 : limits.max + 1].astype(dtype)
    heights = np.tile(ends, (20, 1))
    for max_error in (1, 2, 5, 6, 9, 300):
        array, _ = make_array(heights, (20, 80), max_error=max_error)
        first = array[...]
        assert largest_error(array, heights) <= max_error
        array[0, 0] = 17
        np.testing.assert_array_equal(array[1:], first[1:])


def test_nan_that_comes_to_a_chunk_moves_nothing():
    heights = five_kinds()["noisy"]
    heights[0, :4] = -1.3, -0.8, -0.6, -0.0  # beside the mark of voids
    array, _ = make_array(heights, (24, 24), max_error=0.5, fill_value=-1.0)
    before = array[...]
    array[5, 5] = before[5, 5] = np.nan
    np.testing.assert_array_equal(bits(array[...]), bits(before))
    array[5, 5] = before[5, 5] = 12
    np.testing.assert_array_equal(bits(array[...]), bits(before))


def test_every_bit_stays_where_nothing_may_be_lost():
    heights = np.round(five_kinds()["noisy"])
    heights[2, :9] = -0.0
    array, store = make_array(heights, (24, 24), max_error=0)
    array[7] = heights[7]
    np.testing.assert_array_equal(bits(array[...]), bits(heights))
    (codec,) = json.loads(store._store_dict["zarr.json"].to_bytes())["codecs"]
    assert codec["configuration"] == {"max_error": 0, "stable": True}


def test_an_array_without_fixed_steps_stays_what_it_was_and_warns_of_parts():
    heights = five_kinds()["noisy"]
    codec = TerrainwaveCodec(max_error=0.5, stable=False)
    array, store = make_array(heights, (24, 24), codec=codec)
    (written,) = json.loads(store._store_dict["zarr.json"].to_bytes())["codecs"]
    assert written["configuration"] == {"max_error": 0.5, "stable": False}
    first = array[...]
    old = zarr.open_array(store)
    np.testing.assert_array_equal(old[...], first)
    with pytest.warns(TerrainwaveWarning, match=r"up to 0\.5 more; write chunks as a whole"):
        old[3] = heights[3] + 20
    assert (old[4:24] != first[4:24]).any()  # what the warning says
    old.resize((40, 60))
    (written,) = json.loads(store._store_dict["zarr.json"].to_bytes())["codecs"]
    assert written["configuration"]["stable"] is False


@pytest.mark.parametrize("stable", [True, False])
@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_a_value_that_looks_like_voids_is_named_before_it_is_rounded(dtype, stable):
    heights = terrain_like(40, 30).astype(dtype)
    heights[:3] = -9999  # as xarray's _FillValue, which is an attribute that no codec sees
    codec = TerrainwaveCodec(max_error=2, stable=stable)
    with pytest.warns(TerrainwaveWarning, match="90 heights are -9999.* declare the nodata value"):
        make_array(heights, (40, 30), codec=codec)


def test_nodata_of_the_codec_goes_before_the_fill_value():
    heights = terrain_like(20, 20)
    heights[5:9] = 0
    array, _ = make_array(heights, (20, 20), codec=TerrainwaveCodec(max_error=3, nodata=0))
    np.testing.assert_array_equal(array[...] == 0, heights == 0)


ENTRY = Path(__file__).parents[2] / "zarr" / "codecs" / "terrainwave"


@pytest.fixture(scope="module")
def schema():
    from jsonschema import Draft202012Validator  # here: it takes seconds, of each worker

    return Draft202012Validator(json.loads((ENTRY / "schema.json").read_text()))


@pytest.mark.parametrize("nodata", [None, -5.0, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("options", [{}, {"effort": "best", "stable": False}])
def test_metadata_of_arrays_follow_the_entry_of_the_codec(tmp_path, schema, nodata, options):
    codec = TerrainwaveCodec(max_error=1, nodata=nodata, **options)
    zarr.create_array(
        tmp_path / "a.zarr", shape=(8, 8), dtype="float32", chunks=(8, 8), fill_value=0.0,
        serializer=codec, compressors=None,
    )[:] = np.ones((8, 8), np.float32)  # fmt: skip

    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    text = (tmp_path / "a.zarr" / "zarr.json").read_text()
    (found,) = json.loads(text, parse_constant=refuse)["codecs"]
    schema.validate(found)
    assert repr(TerrainwaveCodec.from_dict(found)) == repr(codec)
    assert abs(zarr.open_array(tmp_path / "a.zarr")[3, 3] - 1) <= 1


def test_the_example_of_the_entry_is_an_array_that_zarr_opens(tmp_path, schema):
    text = (ENTRY / "README.md").read_text()
    example = re.search(r"```json\n(.*?)```", text, re.DOTALL)[1]
    schema.validate(json.loads(example)["codecs"][0])
    (tmp_path / "zarr.json").write_text(example)
    assert zarr.open_array(tmp_path)[0, 0] == -32768
    wrong = {"name": "terrainwave", "configuration": {"max_error": 1, "other": 2}}
    assert not schema.is_valid(wrong)
