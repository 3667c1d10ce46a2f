"""`Terrain`: windows, levels, places, damage, threads. Expected values by hand or from numpy."""

import io
import os
import pickle
import signal
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import rasterio.transform
from containers import open_container
from rasterio.transform import Affine
from rasterio.windows import Window, from_bounds
from strategies import terrain_like, write_geotiff
from twz import twz_bytes

from terrainwave.codec.unit_specs import unit_spec
from terrainwave.errors import (
    CorruptStreamError,
    InvalidHeightsError,
    LimitExceededError,
    StorageError,
)
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.read.decoder import units_of
from terrainwave.read.resample import resample
from terrainwave.terrain import Terrain
from terrainwave.write.compress import compress

R, C = 261, 140  # five levels of blocks of 32
HEIGHTS = terrain_like(R, C)
VALID = np.ones((R, C), dtype=bool)
VALID[100:180, 30:100] = False
VALID[7, 7] = False
WITH_VOIDS = np.where(VALID, HEIGHTS, -32768).astype("int16")


@pytest.fixture(scope="module")
def store_data():
    """Return a lossless file whose levels are the raster's own samples."""
    return twz_bytes(HEIGHTS, max_error=0, method="store")


@pytest.fixture(scope="module")
def void_data():
    return twz_bytes(WITH_VOIDS, max_error=0, method="store", nodata=-32768)


@pytest.fixture
def terrain(store_data):
    with Terrain(store_data, threads=2) as terrain:
        yield terrain


def tiny(heights, **options):
    """Return a Terrain of a small array, lossless."""
    return Terrain(twz_bytes(np.asarray(heights), max_error=0, method="store", **options))


def georeferenced(tmp_path, heights, transform, **profile):
    source = write_geotiff(
        tmp_path / "dem.tif", np.asarray(heights), transform=Affine(*transform), **profile
    )
    compress(source, tmp_path / "dem.twz", max_error=0, method="store", block=32, threads=1)
    return Terrain(tmp_path / "dem.twz", threads=1)


@pytest.mark.parametrize(
    "window",
    [
        (0, 0, 1, 1),
        (0, C - 1, 1, 1),
        (R - 1, 0, 1, 1),
        (R - 1, C - 1, 1, 1),
        (63, 63, 3, 3),  # around a corner of four groups
        (64, 64, 1, 1),
        (0, 0, R, C),
        (100, 20, 90, 100),
        (260, 0, 1, C),
    ],
)
def test_a_window_is_that_part_of_the_whole(terrain, window):
    row, col, n_rows, n_cols = window
    expected = HEIGHTS[row : row + n_rows, col : col + n_cols]
    np.testing.assert_array_equal(terrain.read(window), expected)


def test_a_window_beyond_the_far_corner_is_clipped(terrain):
    np.testing.assert_array_equal(terrain.read((R - 3, C - 2, 99, 99)), HEIGHTS[-3:, -2:])


@pytest.mark.parametrize(
    ("window", "rows", "cols"),
    [
        (np.s_[11:16, 3:5], (11, 16), (3, 5)),
        (np.s_[:5, -3:], (0, 5), (C - 3, C)),
        (np.s_[R - 2 : R + 9, :], (R - 2, R), (0, C)),
    ],
)
def test_slices_count_as_python_does(terrain, window, rows, cols):
    np.testing.assert_array_equal(terrain.read(window), HEIGHTS[slice(*rows), slice(*cols)])


def test_a_window_of_rasterio_in_parts_of_samples_is_refused_but_for_rounding(terrain):
    rounded = Window(3.0000001, 10.9999999, 2, 5)
    np.testing.assert_array_equal(terrain.read(rounded), HEIGHTS[11:16, 3:5])
    for window in (Window(3.5, 11, 2, 5), Window(3, 11, 2, float("nan"))):
        with pytest.raises(InvalidHeightsError, match="round_offsets"):
            terrain.read(window)


@pytest.mark.few(2)
@pytest.mark.parametrize("raster", [HEIGHTS, WITH_VOIDS])
@pytest.mark.parametrize("on_error", ["raise", "mask"])
def test_a_whole_read_is_its_windows_and_keeps_no_unit_of_the_full_grid(raster, on_error):
    data = twz_bytes(raster, max_error=0, method="rapid", nodata=-32768)
    with Terrain(data) as terrain:
        np.testing.assert_array_equal(terrain.read(on_error=on_error), raster)
        assert terrain.read(masked=True).mask.sum() == (raster == -32768).sum()
        k_max = terrain.grid.k_max
        whole = Region(0, 0, R, C)
        finest = units_of(terrain.grid, k_max, whole)
        side = 2 * terrain.grid.block
        np.testing.assert_array_equal(terrain.read((0, 0, side, side)), raster[:side, :side])
        assert not any(terrain.decoder._cache.get(key) for key in finest)
        np.testing.assert_array_equal(terrain.read((3, 5, 200, 100)), raster[3:203, 5:105])
        assert any(terrain.decoder._cache.get(key) for key in finest)
        np.testing.assert_array_equal(terrain.read(), raster)


def test_what_is_read_is_a_copy(terrain):
    terrain.read((0, 0, 5, 5))[:] = 0
    np.testing.assert_array_equal(terrain.read((0, 0, 5, 5)), HEIGHTS[:5, :5])


@pytest.mark.parametrize(
    ("level", "stride"), [(-1, 1), (-2, 2), (-3, 4), (-5, 16), (0, 16), (2, 4), (3, 2), (4, 1)]
)
def test_levels_of_nested_samples_are_every_second_sample(terrain, level, stride):
    np.testing.assert_array_equal(terrain.read(level=level), HEIGHTS[::stride, ::stride])


def test_a_window_of_a_level_counts_its_samples(terrain):
    np.testing.assert_array_equal(
        terrain.read((60, 30, 5, 9), level=-2), HEIGHTS[::2, ::2][60:65, 30:39]
    )


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        *(({"window": one}, "lies outside") for one in [(R, 0, 1, 1), (0, C, 9, 9), (-9, 0, 9, 9)]),
        ({"window": (0, 0, 0, 5)}, "of 0 x 5 samples, expected at least 1 x 1"),
        *(
            ({"window": one}, "two slices without a step")
            for one in (np.s_[::2, :9], np.s_[:9, 4], np.s_[:9, :9, :9], np.s_[9:0:-1, :9])
        ),
        *(({"level": level}, "found level") for level in (5, -6, 100)),
        *(({"bounds": one}, "left < right") for one in [(5, 0, 0, 5), (0, 5, 5, 0), (0, 0, 0, 0)]),
        ({"window": (0, 0, 1, 1), "bounds": (0, 0, 1, 1)}, "both window and bounds"),
        *(({"out_shape": one}, "out_shape") for one in [(0, 3), (3, 0), (-1, 2)]),
    ],
    ids=str,
)
def test_what_cannot_be_read_is_refused(terrain, asked, message):
    with pytest.raises(InvalidHeightsError, match=message):
        terrain.read(**asked)


def centre(transform, row, col):
    a, b, c, d, e, f = transform
    return a * (col + 0.5) + b * (row + 0.5) + c, d * (col + 0.5) + e * (row + 0.5) + f


NORTH_UP = (10.0, 0.0, 1000.0, 0.0, -10.0, 5000.0)
SOUTH_UP = (10.0, 0.0, 1000.0, 0.0, 10.0, 5000.0)
ROTATED = (3.0, 4.0, 100.0, 4.0, -3.0, 200.0)
FLAT_261 = np.arange(261, dtype="int16")[:, None]


@pytest.mark.parametrize(
    ("level", "expected"),
    [
        (-1, (10.0, 0.0, 1030.0, 0.0, -10.0, 4980.0)),
        (-2, (20.0, 0.0, 1055.0, 0.0, -20.0, 4965.0)),
    ],
)
def test_the_transform_of_a_window_begins_at_its_corner(tmp_path, level, expected):
    with georeferenced(tmp_path, FLAT_261, NORTH_UP) as terrain:
        assert terrain.transform_of(level, window=(2, 3, 4, 5))[:6] == expected


@pytest.mark.parametrize("transform", [NORTH_UP, SOUTH_UP, ROTATED])
def test_samples_of_levels_lie_on_those_of_the_full_grid(tmp_path, transform):
    with georeferenced(tmp_path, FLAT_261, transform) as terrain:
        for level, stride in ((-2, 2), (-3, 4)):
            for row, col in ((0, 0), (5, 3)):
                here = centre(terrain.transform_of(level)[:6], row, col)
                assert here == pytest.approx(centre(transform, stride * row, stride * col))


@pytest.mark.parametrize("transform", [NORTH_UP, SOUTH_UP, ROTATED])
def test_the_transform_is_the_one_that_rasterio_has(tmp_path, transform):
    with georeferenced(tmp_path, FLAT_261, transform) as terrain:
        found, expected = terrain.transform, Affine(*transform)
        assert isinstance(found, Affine)
        assert (found, hash(found)) == (expected, hash(expected))
        assert expected == found
        assert found != Affine.identity()
        assert found != transform[:5]
        assert rasterio.transform.xy(found, 3, 5) == rasterio.transform.xy(expected, 3, 5)
        assert ~found == ~expected
        copied = pickle.loads(pickle.dumps(found))
        assert (type(copied), copied) == (Affine, expected)


def test_windows_from_bounds_take_the_transforms_of_levels(tmp_path):
    with georeferenced(tmp_path, HEIGHTS, NORTH_UP) as terrain:
        for level, stride in ((-1, 1), (-2, 2)):
            # 20 columns and 10 rows of the level, from (row 4, column 6).
            left, top = centre(NORTH_UP, 4 * stride, 6 * stride)
            left, top = left - 5 * stride, top + 5 * stride
            bottom, right = top - 100 * stride, left + 200 * stride
            window = from_bounds(left, bottom, right, top, terrain.transform_of(level))
            assert terrain.region(window, level=level) == (4, 6, 10, 20)


@pytest.mark.parametrize(
    ("transform", "bounds", "rows", "cols"),
    [
        (NORTH_UP, (1010, 4970, 1040, 4990), (1, 3), (1, 4)),  # along pixel edges
        (NORTH_UP, (1012, 4972, 1038, 4988), (1, 3), (1, 4)),  # touching the same pixels
        (NORTH_UP, (0, 4000, 1015, 4995), (0, 6), (0, 2)),  # clipped
        (SOUTH_UP, (1010, 5010, 1040, 5030), (1, 3), (1, 4)),
    ],
)
def test_bounds_give_the_pixels_that_touch_them(tmp_path, transform, bounds, rows, cols):
    heights = np.arange(48, dtype="int16").reshape(6, 8)
    with georeferenced(tmp_path, heights, transform) as terrain:
        expected = heights[slice(*rows), slice(*cols)]
        np.testing.assert_array_equal(terrain.read(bounds=bounds), expected)


def test_bounds_on_a_coarser_level_count_its_pixels(tmp_path):
    # Pixels of level -2 reach from 4985 down to 4965: that is row 1, samples at 4975.
    with georeferenced(tmp_path, FLAT_261, NORTH_UP) as terrain:
        assert terrain.read(bounds=(1000, 4966, 1010, 4984), level=-2).tolist() == [[2]]


@pytest.mark.parametrize("bounds", [(-np.inf, -np.inf, np.inf, np.inf), (0, 0, 1e308, 1e308)])
@pytest.mark.parametrize(
    "transform", [(1, 0, 0, 0, -1, 0), (1e-200, 1e200, 1e308, 3, 1e-5, -1e308)]
)
def test_bounds_that_cannot_be_placed_are_refused(bounds, transform):
    data = twz_bytes(HEIGHTS, max_error=0, method="store")
    with Terrain(data) as terrain:
        terrain._raster = replace(terrain.raster_info, transform=tuple(map(float, transform)))
        with pytest.raises(InvalidHeightsError):
            terrain.read(bounds=bounds)
        assert np.isnan(terrain.sample([(np.inf, 1e308)])).all()


@pytest.mark.parametrize(
    ("transform", "bounds"),
    [(NORTH_UP, (1000, 4980, 1030, 5000)), (SOUTH_UP, (1000, 5000, 1030, 5020))],
)
def test_the_bounds_of_a_raster_are_its_pixels_outer_edges(tmp_path, transform, bounds):
    with georeferenced(tmp_path, np.zeros((2, 3), dtype="int16"), transform) as terrain:
        assert terrain.bounds == bounds


# Resampling; output pixel i covers samples from i * scale to (i + 1) * scale

LINE = np.array([[0.0, 3.0, 9.0]])


@pytest.mark.few(8)
@pytest.mark.parametrize(
    ("method", "n_cols", "expected"),
    [
        ("nearest", 2, [0, 9]),  # places 0.25 and 1.75
        ("bilinear", 2, [0.75, 7.5]),
        ("average", 2, [1, 7]),  # (0 + 3/2) / 1.5 and (3/2 + 9) / 1.5
        ("nearest", 6, [0, 0, 3, 3, 9, 9]),
        ("bilinear", 6, [0, 0.75, 2.25, 4.5, 7.5, 9]),
        ("average", 6, [0, 0, 3, 3, 9, 9]),
        ("average", 1, [4]),
        ("bilinear", 3, [0, 3, 9]),
    ],
)
def test_resampling_of_three_samples(method, n_cols, expected):
    with tiny(LINE) as terrain:
        heights = terrain.read(out_shape=(1, n_cols), resampling=method)
    assert heights[0].tolist() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("method", "expected"),
    [("nearest", [[5, 7], [13, 15]]), ("bilinear", [[2.5, 4.5], [10.5, 12.5]])],
)
def test_resampling_to_half_the_size(method, expected):
    # Places 0.5 and 2.5: the upper of two nearest, the mean of four.
    with tiny(np.arange(16.0).reshape(4, 4)) as terrain:
        assert terrain.read(out_shape=(2, 2), resampling=method).tolist() == expected


def test_averages_leave_voids_out():
    heights = np.array([[1.0, np.nan, np.nan, np.nan, 5.0, 7.0]])
    with tiny(heights) as terrain:
        found = terrain.read(out_shape=(1, 3), resampling="average")[0]
    np.testing.assert_array_equal(found, [1, np.nan, 6])


def test_bilinear_resampling_leaves_voids_out():
    with tiny(np.array([[1.0, np.nan, 4.0, 6.0]])) as terrain:
        found = terrain.read(out_shape=(1, 2), resampling="bilinear")[0]
    assert found.tolist() == [1, 5]


def test_averaging_to_one_sample_does_not_hold_the_window():
    sizes = []

    def read(shift, region):
        sizes.append(region.n_rows * region.n_cols)
        assert sizes[-1] <= 5 << 20
        rows = np.arange(region.row, region.row + region.n_rows, dtype="int32")
        heights = np.repeat(rows[:, None], region.n_cols, axis=1)
        return heights, heights % 2 == 1

    grid, region = Grid(16_000, 1000, 32), Region(0, 0, 16_000, 1000)
    heights, _ = resample(read, region, (2, 1), "average", grid.k_max, grid, 1 << 30)
    assert heights.tolist() == [[3999], [11999]]  # means of 0, 2, … 7998 and 8000, … 15998
    assert sum(sizes) == 16_000 * 1000


def test_averages_of_many_samples_are_numpys(terrain):
    found = terrain.read((0, 0, 260, 140), out_shape=(26, 14), resampling="average")
    means = HEIGHTS[:260].reshape(26, 10, 14, 10).mean(axis=(1, 3))
    np.testing.assert_array_equal(found, np.rint(means))


def test_nearest_takes_samples_of_a_level_that_is_fine_enough(terrain):
    # Scale 4: level -3's samples, every fourth one; places 4 i + 1.5 are nearest to sample i.
    found = terrain.read((0, 0, 260, 140), out_shape=(65, 35))
    np.testing.assert_array_equal(found, HEIGHTS[:260:4, :140:4])


@pytest.mark.parametrize("method", ["nearest", "bilinear", "average"])
def test_resampling_to_the_same_shape_changes_nothing(terrain, method):
    found = terrain.read((60, 60, 9, 9), out_shape=(9, 9), resampling=method)
    np.testing.assert_array_equal(found, HEIGHTS[60:69, 60:69])


def test_voids_come_back_as_the_rasters_nodata(void_data):
    with Terrain(void_data) as terrain:
        np.testing.assert_array_equal(terrain.read(), WITH_VOIDS)


def test_a_masked_array_has_its_voids_masked(void_data):
    with Terrain(void_data, threads=1) as terrain:
        heights = terrain.read((0, 0, 20, 20), masked=True)
    assert isinstance(heights, np.ma.MaskedArray)
    assert np.argwhere(heights.mask).tolist() == [[7, 7]]
    assert heights.fill_value == -32768


SQUARE = np.array([[1.0, 2.0], [5.0, 10.0]])


@pytest.mark.parametrize(
    ("x", "y", "height"),
    [
        (0.5, 0.5, 1),
        (1.5, 0.5, 2),
        (0.5, 1.5, 5),
        (1.5, 1.5, 10),
        (1.0, 1.0, 4.5),  # the mean of four
        (0.75, 0.5, 1.25),
        (1.25, 1.25, 1 / 16 * 1 + 3 / 16 * 2 + 3 / 16 * 5 + 9 / 16 * 10),
    ],
)
def test_sample_is_bilinear_between_pixel_centres(x, y, height):
    with tiny(SQUARE) as terrain:
        assert terrain.sample([(x, y)])[0] == pytest.approx(height)


@pytest.mark.parametrize(("x", "y"), [(0.4, 1), (1, 0.4), (1.6, 1), (1, 1.6), (-9, 1e9)])
def test_sample_is_nan_outside_the_outermost_centres(x, y):
    with tiny(SQUARE) as terrain:
        assert np.isnan(terrain.sample([(x, y)])[0])


def test_sample_is_nan_where_a_void_would_count():
    heights = np.array([[1, 2, -1], [3, 4, 5]], dtype="int16")
    with tiny(heights, nodata=-1) as terrain:
        found = terrain.sample([(2.0, 0.6), (1.5, 0.5), (2.5, 1.5), (2.5, 0.5)])
    np.testing.assert_array_equal(found, [np.nan, 2, 5, np.nan])


def test_sample_gives_physical_heights(tmp_path):
    source = write_geotiff(
        tmp_path / "dem.tif",
        np.array([[10, 20]], dtype="int16"),
        bands={"scales": 0.1, "offsets": 100.0},
    )
    compress(source, tmp_path / "dem.twz", max_error=0, threads=1)
    with Terrain(tmp_path / "dem.twz") as terrain:
        assert terrain.sample([(1.0, 0.5)])[0] == pytest.approx(101.5)


def test_a_read_larger_than_max_bytes_is_refused_with_its_size(terrain):
    with pytest.raises(LimitExceededError, match="73,080 bytes"):  # 261 * 140 * 2
        terrain.read(max_bytes=73_079)


def test_the_cache_stays_within_its_limit(store_data):
    with Terrain(store_data, cache_bytes=50_000, threads=2) as terrain:
        for _ in range(2):
            terrain.read()
        cache = terrain.decoder._cache
        kept = sum(unit.nbytes for unit in cache._values.values())
        assert 0 < kept <= 50_000


def broken_at(data, key):
    """Return the file with one byte changed in the middle of the payload of `key`."""
    with open_container(data) as container:
        ((segment, row),) = container._rows([key])
        start, length = segment.payload_range(row)
    damaged = bytearray(data)
    damaged[start + length // 2] ^= 0x10
    return bytes(damaged)


def test_a_damaged_finest_group_costs_only_its_own_area(store_data):
    # Group below block (3, 1, 0): full-grid rows 64 ... 128, columns 0 ... 64.
    damaged = broken_at(store_data, Block(3, 1, 0))
    with Terrain(damaged) as terrain:
        heights, valid = terrain.read_with_mask(on_error="mask")
    inside = np.zeros((R, C), dtype=bool)
    inside[64:129, 0:65] = True
    np.testing.assert_array_equal(heights[~inside], HEIGHTS[~inside])
    assert valid[~inside].all()
    assert not valid[65:128, 0:64].any()
    # Its lines that a sound neighbour shares are there.
    np.testing.assert_array_equal(valid[64, :64], True)


def test_a_damaged_inner_group_costs_everything_below_it(store_data):
    # Block (2, 1, 0): samples 32 ... 64 of level 2, so full-grid rows 128 ... 256.
    damaged = broken_at(store_data, Block(2, 1, 0))
    with Terrain(damaged) as terrain:
        valid = terrain.read_with_mask(on_error="mask")[1]
    assert not valid[129:256, 0:128].any()
    assert valid[:129].all()
    assert valid[256:].all()
    assert valid[:, 128:].all()


def test_a_damaged_root_costs_everything(store_data):
    with Terrain(broken_at(store_data, Block(-1, 0, 0))) as terrain:
        for level in range(terrain.n_levels):
            assert not terrain.read_with_mask(level=level, on_error="mask")[1].any()


@pytest.mark.parametrize(
    ("key", "name"),
    [
        (Block(-1, 0, 0), r"root block .*row 0, col"),
        (Block(2, 1, 0), r"group .*level 2, row 1, col"),
    ],
)
def test_a_damaged_unit_is_named_for_what_lies_below_it(store_data, key, name):
    damaged = broken_at(store_data, key)
    with Terrain(damaged) as terrain:
        with pytest.raises(CorruptStreamError, match=name):
            terrain.read((200, 0, 1, 1))


def test_a_damaged_group_leaves_other_windows_readable(store_data):
    damaged = broken_at(store_data, Block(3, 1, 0))
    with Terrain(damaged) as terrain:
        np.testing.assert_array_equal(terrain.read((129, 0, 132, C)), HEIGHTS[129:])


def test_a_payload_that_contradicts_the_format_is_named_too(store_data, monkeypatch):
    # The checksum is right and the payload is not: what an attacker makes.
    monkeypatch.setattr("terrainwave.container.reader.check_crc", lambda *_: None)
    damaged = bytearray(store_data)
    with open_container(store_data) as container:
        ((segment, row),) = container._rows([Block(3, 1, 0)])
        damaged[segment.payload_range(row).offset] = 0xFF
    with Terrain(bytes(damaged)) as terrain:
        with pytest.raises(CorruptStreamError, match=r"level 3, row 1, column 0.*damaged: .*0xff"):
            terrain.read()


@pytest.mark.parametrize("on_error", ["raise", "mask"])
def test_a_damaged_index_page_costs_only_its_segment(on_error):
    heights = terrain_like(1030, 3)  # k_max = 6: level 2's blocks head segments
    data = twz_bytes(heights, max_error=0, method="store")
    with open_container(data) as container:
        start = container.segment(None).page_range(Block(2, 1, 0)).offset
    damaged = bytearray(data)
    damaged[start + 20] ^= 1
    with Terrain(bytes(damaged)) as terrain:
        if on_error == "raise":
            with pytest.raises(CorruptStreamError, match="level 2, row 1"):
                terrain.read()
            return
        found, valid = terrain.read_with_mask(on_error="mask")
    # Block (2, 1, 0) covers full-grid rows 32 * 16 to 64 * 16.
    assert not valid[513:1024].any()
    keep = np.r_[0:513, 1024:1030]
    np.testing.assert_array_equal(found[keep], heights[keep])


def test_check_names_the_damaged_group(store_data):
    with Terrain(broken_at(store_data, Block(3, 1, 0))) as terrain:
        *damaged, share = terrain.check()
        assert all("level 3, row 1" in line for line in damaged)
        assert share.startswith("level 4: ")
        assert share.endswith(" % of the samples cannot be read")


@pytest.mark.parametrize("cache_bytes", [0, 1 << 28])
def test_eight_threads_read_what_one_does(store_data, cache_bytes):
    rng = np.random.default_rng(1)
    windows = [(int(rng.integers(R)), int(rng.integers(C)), 70, 70) for _ in range(64)]
    with (
        Terrain(store_data, cache_bytes=cache_bytes, threads=2) as terrain,
        ThreadPoolExecutor(8) as executor,
    ):
        for window, heights in zip(windows, executor.map(terrain.read, windows)):
            row, col = window[:2]
            np.testing.assert_array_equal(heights, HEIGHTS[row : row + 70, col : col + 70])


def test_threads_are_as_many_as_the_processors_that_the_process_may_use(store_data, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3, 5, 6}, raising=False)
    with Terrain(store_data) as terrain:
        assert terrain.n_threads == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    with Terrain(store_data) as terrain:
        assert terrain.n_threads == 1


def test_a_terrain_opened_by_path_can_be_pickled(tmp_path, store_data):
    path = tmp_path / "dem.twz"
    path.write_bytes(store_data)
    with Terrain(path) as terrain, pickle.loads(pickle.dumps(terrain)) as other:
        np.testing.assert_array_equal(other.read((0, 0, 3, 3)), HEIGHTS[:3, :3])


def test_a_terrain_opened_from_bytes_says_that_it_cannot_be_pickled(terrain):
    with pytest.raises(TypeError, match="path or URL"):
        pickle.dumps(terrain)


def test_a_file_object_can_be_read(store_data):
    with Terrain(io.BytesIO(store_data)) as terrain:
        np.testing.assert_array_equal(terrain.read((0, 0, 3, 3)), HEIGHTS[:3, :3])


def test_reading_after_close_says_that_the_file_is_closed(tmp_path, store_data):
    path = tmp_path / "dem.twz"
    path.write_bytes(store_data)
    with Terrain(path, threads=2) as terrain:
        terrain.read()
    with pytest.raises(StorageError, match="is closed"):
        terrain.read()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_fork_reads_with_threads_of_its_own(store_data):
    with Terrain(store_data, cache_bytes=0, threads=2) as terrain:
        terrain.read()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads
            child = os.fork()
        if child == 0:
            signal.alarm(20)  # the threads of the parent are not here: it would wait for ever
            os._exit(0 if np.array_equal(terrain.read(), HEIGHTS) else 1)
        assert os.waitpid(child, 0)[1] == 0


@pytest.fixture
def info(tmp_path):
    source = write_geotiff(
        tmp_path / "dem.tif",
        np.arange(130 * 5, dtype="int16").reshape(130, 5),
        transform=Affine(*NORTH_UP),
        crs="EPSG:32633",
        nodata=-1,
        units=("metre",),
        tags={"AREA_OR_POINT": "Point"},
        bands={"scales": 0.1, "offsets": 100.0, "descriptions": "height"},
    )
    compress(source, tmp_path / "dem.twz", max_error=0.35, block=32, method="store", threads=1)
    with Terrain(tmp_path / "dem.twz") as terrain:
        return terrain.info(), (tmp_path / "dem.twz").stat().st_size


SAID = [
    ("n_rows", 130),
    ("n_cols", 5),
    ("dtype", "int16"),
    ("max_error", 0.35),
    ("effective_error", 0.3),  # three quanta of 0.1
    ("quantum", 0.1),
    ("rounding_error", 0),
    ("units", "metre"),
    ("method", "store"),
    ("effort", "default"),
    ("block", 32),
    ("border_rings", 1),
    ("n_levels", 4),
    ("level_shapes", ((17, 1), (33, 2), (65, 3), (130, 5))),
    ("crs", "EPSG:32633"),
    ("transform", NORTH_UP),
    ("bounds", (1000.0, 3700.0, 1050.0, 5000.0)),
    ("nodata", -1),
    ("scale", 0.1),
    ("offset", 100.0),
    ("area_or_point", "Point"),
    ("description", "height"),
    ("minimum", 100.0),
    ("maximum", 164.9),
]


def test_info_says_what_the_raster_does_and_counts_bytes_and_bits(info):
    found, n_bytes = info
    for name, value in SAID:
        expected = pytest.approx(value) if isinstance(value, float) else value
        assert getattr(found, name) == expected, name
    assert found.n_bytes == n_bytes
    assert found.bits_per_sample == pytest.approx(8 * n_bytes / 650)
    assert found.ratio == pytest.approx(1300 / n_bytes)


def all_keys(grid):
    keys = grid.root_keys()
    for key in keys:
        blocks = [Block(0, key.row, key.col)] if key.level < 0 else grid.children(key)
        keys += [block for block in blocks if block.level < grid.k_max]
    return keys


def assert_neighbours_agree(data, seed):
    """Decode every unit by itself, in shuffled order; compare the samples that units share."""
    with Terrain(data, cache_bytes=0, threads=1) as terrain:
        grid, decoder = terrain.grid, terrain.decoder
        shape = (grid.k_max + 1, *terrain.shape)
        heights, mask, count = (
            np.zeros(shape, np.int32),
            np.zeros(shape, bool),
            np.zeros(shape, int),
        )
        keys = all_keys(grid)
        n_shared = 0
        for index in np.random.default_rng(seed).permutation(len(keys)):
            spec = unit_spec(grid, terrain.header.codec_parameters, keys[index])
            unit = decoder.unit(keys[index])
            at = (spec.level, *spec.region.slices_in(Region(0, 0, *terrain.shape)))
            seen = count[at] > 0
            np.testing.assert_array_equal(mask[at][seen], unit.mask[seen])
            known = seen & unit.mask
            np.testing.assert_array_equal(heights[at][known], unit.heights[known])
            n_shared += int(known.sum())
            heights[at], mask[at] = unit.heights, unit.mask
            count[at] += 1
        assert n_shared > 0


@pytest.mark.few(6)
@pytest.mark.parametrize("method", ["cdf97", "store"])
@pytest.mark.parametrize("rings", [1, 3])
@pytest.mark.parametrize("voids", ["none", "areas", "noise"])
@pytest.mark.parametrize("max_error", [0, 5])
def test_neighbouring_units_decode_shared_samples_identically(method, rings, voids, max_error):
    valid = {
        "none": np.ones((R, C), dtype=bool),
        "areas": VALID,
        "noise": np.random.default_rng(2).random((R, C)) < 0.6,
    }[voids]
    heights = np.where(valid, HEIGHTS, -32768).astype("int16")
    data = twz_bytes(heights, max_error=max_error, method=method, border_rings=rings, nodata=-32768)
    assert_neighbours_agree(data, seed=3)
