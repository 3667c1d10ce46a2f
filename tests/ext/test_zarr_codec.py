"""The Zarr codec inside zarr itself, found by its entry point."""

import json

import numpy as np
import pytest
import zarr
from strategies import terrain_like
from zarr.storage import MemoryStore

import terrainwave
from terrainwave.errors import CorruptStreamError, InvalidHeightsError
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


def test_nodata_of_the_codec_goes_before_the_fill_value():
    heights = terrain_like(20, 20)
    heights[5:9] = 0
    array, _ = make_array(heights, (20, 20), codec=TerrainwaveCodec(max_error=3, nodata=0))
    np.testing.assert_array_equal(array[...] == 0, heights == 0)


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


def test_metadata_name_the_codec_and_only_what_was_chosen():
    _, store = make_array(np.zeros((4, 4), np.int16), (4, 4), max_error=0.25)
    (codec,) = json.loads(store._store_dict["zarr.json"].to_bytes())["codecs"]
    assert codec == {"name": "terrainwave", "configuration": {"max_error": 0.25}}
    codec = TerrainwaveCodec(max_error=1, nodata=-1, effort="fast")
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
    ],
)
def test_bad_configuration_is_refused(configuration):
    with pytest.raises(InvalidHeightsError, match="expected"):
        TerrainwaveCodec.from_dict({"name": "terrainwave", "configuration": configuration})
