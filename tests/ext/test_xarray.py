"""The xarray backend, found by its entry point, and the accessor."""

import pickle

import dask
import numpy as np
import pytest
import rioxarray  # registers .rio, too
import xarray as xr
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.ext import xarray_backend
from terrainwave.file import TerrainFile

# rioxarray 0.19 multiplies transforms, which affine 3 will deprecate.
pytestmark = pytest.mark.filterwarnings("ignore:Use .@. matmul:PendingDeprecationWarning")

# Which codec makes the file is nothing to xarray.
QUICK = {"method": "store", "mesh": "none"}

PLACE = {"crs": "EPSG:32633", "transform": Affine(30.0, 0, 500_000.1, 0, -30.0, 5_000_000.7)}


@pytest.fixture(scope="module")
def terrain_file(tmp_path_factory):
    """A raster of 5 x 3 blocks with a lake of voids; to be read only."""
    tmp_path = tmp_path_factory.mktemp("xarray")
    heights = terrain_like(150, 90)
    heights[40:60, 20:50] = -9999
    tif = write_geotiff(
        tmp_path / "a.tif", heights, nodata=-9999, units=("m",), tags={"AREA_OR_POINT": "Point"},
        **PLACE,
    )  # fmt: skip
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=1, block=32, **QUICK)
    return tmp_path / "a.twz"


def test_file_opens_without_naming_an_engine(terrain_file):
    with xr.open_dataset(terrain_file) as dataset, terrainwave.open(terrain_file) as terrain:
        expected = terrain.read(masked=True).astype(np.float32).filled(np.nan)
        assert dataset.heights.dims == ("y", "x")
        np.testing.assert_array_equal(dataset.heights, expected)
        assert dataset.heights.attrs["units"] == "m"
        assert dataset.heights.terrainwave.bound() == 1


def test_rioxarray_finds_crs_transform_and_nodata(terrain_file):
    with xr.open_dataset(terrain_file) as dataset:
        assert dataset.rio.crs.to_epsg() == 32633
        assert dataset.rio.transform() == PLACE["transform"]
        assert dataset.heights.rio.encoded_nodata == -9999
        bounds = 500_000.1, 4_995_500.7, 502_700.1, 5_000_000.7
        assert dataset.heights.rio.bounds() == pytest.approx(bounds)
        assert dataset.x[0] == 500_015.1


class CountedReads:
    """Windows that were read."""

    def __init__(self, monkeypatch):
        self.windows = []
        read = TerrainFile.read_with_mask

        def counting(terrain, window=None, **options):
            self.windows.append(tuple(window))
            return read(terrain, window, **options)

        monkeypatch.setattr(TerrainFile, "read_with_mask", counting)


KEYS = [
    np.s_[3, 4],
    np.s_[-1, :],
    np.s_[10:20, 60:70],
    np.s_[100:30:-7, ::3],
    np.s_[5:5, :],
    np.s_[:, [80, 3, 3]],
    np.s_[[1, 50, 149], 20:40],
]


@pytest.mark.parametrize("key", KEYS, ids=str)
def test_any_index_gives_what_numpy_gives(terrain_file, key):
    with xr.open_dataset(terrain_file) as lazy, xr.open_dataset(terrain_file) as loaded:
        np.testing.assert_array_equal(lazy.heights[key].values, loaded.heights.values[key])


def test_places_that_are_no_grid_are_picked_one_by_one(terrain_file):
    with xr.open_dataset(terrain_file) as dataset:
        x = xr.DataArray([500_020.0, 502_000.0], dims="point")
        y = xr.DataArray([4_999_000.0, 4_996_000.0], dims="point")
        picked = dataset.heights.sel(x=x, y=y, method="nearest").values
        full = dataset.heights.values
        np.testing.assert_array_equal(picked, [full[33, 0], full[133, 66]])


def test_opening_reads_nothing_and_a_window_reads_that_window(terrain_file, monkeypatch):
    counted = CountedReads(monkeypatch)
    with xr.open_dataset(terrain_file) as dataset:
        assert repr(dataset)
        assert counted.windows == []
        dataset.heights[10:20, 60:70].load()
    assert counted.windows == [(10, 60, 10, 10)]


def test_dask_blocks_are_the_preferred_chunks(terrain_file, monkeypatch):
    monkeypatch.setattr(xarray_backend, "CHUNK", 64)
    counted = CountedReads(monkeypatch)
    with xr.open_dataset(terrain_file, chunks={}) as chunked, dask.config.set(scheduler="threads"):
        assert chunked.heights.chunks == ((64, 64, 22), (64, 26))
        with xr.open_dataset(terrain_file) as whole:
            np.testing.assert_array_equal(chunked.heights.compute(), whole.heights)
    assert {window[:2] for window in counted.windows[:6]} == {
        (row, col) for row in (0, 64, 128) for col in (0, 64)
    }


def test_dataset_travels_to_another_process(terrain_file):
    with xr.open_dataset(terrain_file) as dataset:
        copy = pickle.loads(pickle.dumps(dataset))
        np.testing.assert_array_equal(copy.heights, dataset.heights)
        copy.close()


def test_stored_values_and_levels_can_be_asked_for(terrain_file):
    with (
        xr.open_dataset(terrain_file, mask_and_scale=False, level=-2) as dataset,
        terrainwave.open(terrain_file) as terrain,
    ):
        np.testing.assert_array_equal(dataset.heights, terrain.read(level=-2))
        assert dataset.heights.dtype == np.int16
        assert dataset.heights.attrs["_FillValue"] == -9999


def test_levels_are_groups_with_their_own_coordinates(terrain_file):
    with xr.open_datatree(terrain_file) as tree, terrainwave.open(terrain_file) as terrain:
        assert list(tree.children) == [f"level_{level}" for level in range(terrain.n_levels)]
        for level in range(terrain.n_levels):
            node = tree[f"level_{level}"]
            assert node.heights.shape == terrain.level_shape(level)
            # Every level's first sample lies on the first sample of the full grid.
            assert (node.x[0], node.y[0]) == (500_015.1, 4_999_985.7)
            assert node.x[1] - node.x[0] == pytest.approx(
                30.0 * 2 ** (terrain.n_levels - 1 - level)
            )
            assert node.heights.rio.transform() == Affine(*terrain.transform_of(level)[:6])
            expected = terrain.read(level=level, masked=True).astype(np.float32).filled(np.nan)
            np.testing.assert_array_equal(node.heights, expected)


def test_scale_and_offset_are_applied(tmp_path):
    heights = terrain_like(20, 20)
    bands = {"scales": 0.1, "offsets": -50.0}
    tif = write_geotiff(tmp_path / "a.tif", heights, bands=bands)
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, **QUICK)
    with xr.open_dataset(tmp_path / "a.twz") as dataset:
        np.testing.assert_array_equal(dataset.heights, heights * 0.1 - 50)
    with xr.open_dataset(tmp_path / "a.twz", mask_and_scale=False) as dataset:
        attrs = dataset.heights.attrs
        assert (attrs["scale_factor"], attrs["add_offset"]) == (0.1, -50.0)


def test_rotated_raster_has_a_transform_and_places_of_each_sample(tmp_path):
    rotated = Affine(10, 2, 100, 3, -10, 200)
    tif = write_geotiff(tmp_path / "a.tif", terrain_like(20, 20), transform=rotated)
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, **QUICK)
    with xr.open_dataset(tmp_path / "a.twz") as dataset:
        assert set(dataset.coords) == {"spatial_ref", "xc", "yc"}
        assert dataset.heights.rio.transform() == rotated
        with rioxarray.open_rasterio(tif) as expected:
            np.testing.assert_array_equal(dataset.xc, expected.xc)
            np.testing.assert_array_equal(dataset.yc[3:9, 4], expected.yc[3:9, 4])


def test_array_that_was_opened_is_written_with_its_place(terrain_file, tmp_path):
    with xr.open_dataset(terrain_file) as dataset:
        result = dataset.heights.terrainwave.to_twz(tmp_path / "b.twz", max_error=0, **QUICK)
        assert result.measured_error == 0
        with terrainwave.open(terrain_file) as first, terrainwave.open(tmp_path / "b.twz") as copy:
            expected, found = first.read(masked=True), copy.read(masked=True)
            np.testing.assert_array_equal(np.ma.getmaskarray(found), expected.mask)
            np.testing.assert_array_equal(found.filled(0), expected.filled(0))
            for name in ("crs", "transform", "units", "area_or_point"):
                assert getattr(copy.raster_info, name) == getattr(first.raster_info, name), name


def test_pixels_stay_exact_where_coordinates_are_rounded(tmp_path):
    # Centres are sums of floats: their differences are not the pixel any more.
    size = 1 / 3600
    place = Affine(size, 0, 6 - size / 2, 0, -size, 47 + size / 2)
    tif = write_geotiff(tmp_path / "a.tif", terrain_like(30, 30), crs="EPSG:4326", transform=place)
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, **QUICK)
    with xr.open_dataset(tmp_path / "a.twz") as dataset:
        dataset.heights[7:, 3:].terrainwave.to_twz(tmp_path / "b.twz", max_error=0, **QUICK)
    with terrainwave.open(tmp_path / "b.twz") as terrain:
        cut = (size, 0.0, place.c + 3 * size, 0.0, -size, place.f - 7 * size)
        assert terrain.raster_info.transform == cut


@pytest.mark.parametrize(
    ("has_void", "nodata", "masked", "attribute"),
    [
        (True, None, "float32", -9999),
        (False, None, "int16", -9999),
        (False, "none", "int16", None),
    ],
)
def test_whole_numbers_keep_their_type_where_no_sample_is_void(
    tmp_path, has_void, nodata, masked, attribute
):
    heights = terrain_like(20, 17)
    if has_void:
        heights[3, 4] = -9999
    dem = write_geotiff(tmp_path / "a.tif", heights, nodata=-9999)
    terrainwave.compress(dem, tmp_path / "a.twz", max_error=0, block=32, nodata=nodata)
    with xr.open_dataset(tmp_path / "a.twz", engine="terrainwave") as dataset:
        assert dataset.heights.dtype == masked
        expected = np.where(heights == -9999, np.nan, heights) if has_void else heights
        np.testing.assert_array_equal(dataset.heights, expected)
        assert dataset.heights.encoding.get("_FillValue") == attribute
    with xr.open_dataset(tmp_path / "a.twz", engine="terrainwave", mask_and_scale=False) as raw:
        assert raw.heights.dtype == "int16"
        assert raw.heights.attrs.get("_FillValue") == attribute


def test_damaged_blocks_of_a_file_without_voids_are_nan(tmp_path):
    heights = terrain_like(90, 70)
    path = tmp_path / "a.twz"
    terrainwave.compress(heights, path, max_error=0, block=32, mesh="none", digest=False)
    data = path.read_bytes()
    path.write_bytes(data[:-9] + bytes(9))
    with terrainwave.open(path, on_error="mask") as terrain:
        found = terrain.to_xarray()
        assert found.dtype == "float32"
        assert 0 < np.isnan(found.values).sum() < heights.size


def test_variables_can_be_dropped(terrain_file):
    with xr.open_dataset(terrain_file, drop_variables="spatial_ref") as dataset:
        assert set(dataset.coords) == {"x", "y"}
