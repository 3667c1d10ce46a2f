"""Arrays of .twz files beside rioxarray's, written again, and what they say of their error."""

import io
import os
import warnings
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rioxarray
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from rasterio.transform import Affine
from rioxarray.rioxarray import affine_to_coords
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import InvalidHeightsError, TerrainwaveWarning
from terrainwave.grid.affine import of_level
from terrainwave.grid.quantum import HeightScan
from terrainwave.raster_io.raster_info import RasterInfo
from terrainwave.read.places import LevelPlace
from terrainwave.write.compress_options import Options
from terrainwave.write.earlier import Earlier
from terrainwave.write.job import settled

# rioxarray 0.19 multiplies transforms, which affine 3 will deprecate.
pytestmark = pytest.mark.filterwarnings("ignore:Use .@. matmul:PendingDeprecationWarning")

QUICK = {"method": "store", "mesh": "none"}
# Real rasters, where they lie beside the checkout.
SHARED = sorted((Path(__file__).parents[2] / ".." / "shared" / "data").glob("*.tif"))


# Coordinates.

SECOND = 1 / 3600
PLACES = {
    "UTM": (30.0, 0.0, 500_000.1, 0.0, -30.0, 5_000_000.7),
    "arc seconds": (SECOND, 0.0, 6 - SECOND / 2, 0.0, -SECOND, 47 + SECOND / 2),
    "3 arc seconds": (3 * SECOND, 0.0, -124 - 1.5 * SECOND, 0.0, -3 * SECOND, 50 + 1.5 * SECOND),
    "south up": (0.1, 0.0, 9.95, 0.0, 0.1, -45.05),
    "tenths of a metre": (0.1, 0.0, 377_123.3, 0.0, -0.1, 3_794_876.9),
    "half a metre in degrees": (4.5e-6, 0.0, 15.1, 0.0, -4.5e-6, 45.9),
    "rounding turned it": (30.0, 1e-17, 500_000.1, -1e-17, -30.0, 5_000_000.7),
}
TURNED = {
    "turned": (10.1, 2.3, 100.7, 3.1, -10.7, 200.3),
    "by 90 degrees": (0.0, 10.1, 100.7, -10.1, 0.0, 200.3),
    "a degree or so": (30.0, 0.5, 500_000.1, 0.5, -30.0, 5_000_000.7),
}


def opened(tif, **options):
    return rioxarray.open_rasterio(tif, masked=True, **options).squeeze("band", drop=True)


@pytest.mark.parametrize("place", [*PLACES.values(), *TURNED.values()], ids=[*PLACES, *TURNED])
def test_file_minus_its_raster_loses_no_sample_on_any_level(tmp_path, place):
    heights = terrain_like(150, 170)
    tif = write_geotiff(tmp_path / "a.tif", heights, transform=Affine(*place))
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, block=32, **QUICK)
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        assert terrain.n_levels > 2
        for level in range(-1, -terrain.n_levels - 1, -1):
            part = tmp_path / f"level{level}.tif"
            terrainwave.decompress(tmp_path / "a.twz", part, level=level)
            difference = terrain.to_xarray(level=level) - opened(part)
            assert difference.shape == terrain.level_shape(level)
            assert not difference.any()
        difference = terrain.to_xarray() - opened(tif)
        assert difference.shape == heights.shape
        assert not difference.any()


def test_file_minus_its_raster_loses_no_sample_where_pixels_are_points(tmp_path):
    heights = terrain_like(40, 50)
    tif = write_geotiff(
        tmp_path / "a.tif", heights, transform=Affine(*PLACES["3 arc seconds"]),
        tags={"AREA_OR_POINT": "Point"},
    )  # fmt: skip
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, **QUICK)
    with xr.open_dataset(tmp_path / "a.twz") as dataset:
        difference = dataset.heights - opened(tif)
        assert difference.shape == heights.shape
        assert not difference.any()


numbers = st.floats(1e-6, 1e4) | st.sampled_from([SECOND, 3 * SECOND, 0.1, 30.0, 1 / 3])


@given(
    size=st.tuples(numbers, numbers),
    corner=st.tuples(st.floats(-1e7, 1e7), st.floats(-1e7, 1e7)),
    signs=st.tuples(st.sampled_from([1, -1]), st.sampled_from([1, -1])),
    shape=st.tuples(st.integers(1, 300), st.integers(1, 300)),
    stride=st.sampled_from([1, 2, 4, 8, 1024]),
)
def test_coordinates_are_rioxarrays_to_the_last_bit(size, corner, signs, shape, stride):
    place = (signs[0] * size[0], 0.0, corner[0], 0.0, signs[1] * size[1], corner[1])
    array = np.zeros(shape, "u1")
    expected = affine_to_coords(Affine(*of_level(place, stride)), shape[1], shape[0])
    found = FakeLevel(array.shape, of_level(place, stride)).coordinates()
    np.testing.assert_array_equal(found[0], expected["x"])
    np.testing.assert_array_equal(found[1], expected["y"])


class FakeLevel(terrainwave.Terrain):
    """A level of any shape and place, without a file."""

    def __init__(self, shape, transform):
        self._shape, self._transform = shape, transform

    def level_shape(self, level=-1):
        return self._shape

    def level_place(self, level=-1, row=0, col=0):
        return LevelPlace(0, self._shape, self._transform, (0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("place", TURNED.values(), ids=TURNED)
@pytest.mark.parametrize(
    "key", [np.s_[:, :], np.s_[3:9, 4], np.s_[::-2, 5:1:-1], np.s_[2:2, :]], ids=str
)
def test_places_of_turned_rasters_are_made_as_they_are_asked_for(tmp_path, place, key):
    tif = write_geotiff(tmp_path / "a.tif", terrain_like(20, 30), transform=Affine(*place))
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, **QUICK)
    expected = (
        Affine(*place)
        @ Affine.translation(0.5, 0.5)
        @ tuple(np.meshgrid(np.arange(30), np.arange(20)))
    )
    with xr.open_dataset(tmp_path / "a.twz") as dataset:
        for name, numbers in zip(("xc", "yc"), expected, strict=True):
            np.testing.assert_array_equal(dataset[name][key], numbers[key])


@pytest.mark.parametrize("key", [np.s_[4:, 7:], np.s_[::-1, ::2], np.s_[10:12, 3:30:3]], ids=str)
@pytest.mark.parametrize("place", TURNED.values(), ids=TURNED)
def test_part_of_a_turned_raster_is_written_where_it_lies(tmp_path, place, key):
    tif = write_geotiff(tmp_path / "a.tif", terrain_like(20, 30), transform=Affine(*place))
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, **QUICK)
    with xr.open_dataset(tmp_path / "a.twz") as dataset:
        part = dataset.heights[key]
        part.terrainwave.to_twz(tmp_path / "b.twz", max_error=0, **QUICK)
        with xr.open_dataset(tmp_path / "b.twz") as cut:
            np.testing.assert_array_equal(cut.heights, part)
            np.testing.assert_allclose(cut.xc, part.xc, rtol=0, atol=1e-9)
            np.testing.assert_allclose(cut.yc, part.yc, rtol=0, atol=1e-9)


@pytest.mark.full
@pytest.mark.parametrize("tif", SHARED, ids=lambda path: path.stem)
def test_real_raster_minus_its_file_loses_no_sample(tmp_path, tif):
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=100, block=1024, verify=False, **QUICK)
    with terrainwave.open(tmp_path / "a.twz") as terrain, warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        difference = terrain.to_xarray() - opened(tif)
        assert difference.shape == terrain.shape
        for level in range(-2, -terrain.n_levels - 1, -1):
            part = tmp_path / "level.tif"
            terrainwave.decompress(tmp_path / "a.twz", part, level=level, overwrite=True)
            expected = opened(part)
            with rasterio.open(part) as dataset:
                is_exact = dataset.transform == Affine(*terrain.transform_of(level)[:6])
            # GDAL keeps the middle of the first pixel where pixels are points, and rounds.
            assert is_exact or terrain.raster_info.area_or_point == "Point"
            if is_exact:
                difference = terrain.to_xarray(level=level) - expected
                assert difference.shape == terrain.level_shape(level)


# Written again.


def raster(path, dtype, *, voids, packed, full=False):
    """Return a GeoTIFF, and where it is valid. `full`: every number of the type is a height."""
    heights = terrain_like(64, 64, "float64")
    if full:
        heights = np.arange(64 * 64).reshape(64, 64) % 256 + np.iinfo(dtype).min
        heights[20:], heights[30] = np.iinfo(dtype).min, np.iinfo(dtype).max
    heights = heights.astype(dtype)
    valid = np.ones(heights.shape, bool)
    profile = {"transform": Affine(10, 0, 5e5, 0, -10, 5e6), "crs": "EPSG:32633"}
    if voids is not None:
        valid[:16, 3:40] = False
    if voids == "nodata":
        profile["nodata"] = 0 if np.dtype(dtype).kind == "u" else -5
        heights[~valid] = profile["nodata"]
    elif voids == "nan":
        heights[~valid] = np.nan
    elif voids == "mask":
        profile["mask"] = valid
    if packed:
        profile["bands"] = {"scales": 0.5, "offsets": -100.0}
    return write_geotiff(path / "a.tif", heights, **profile), valid


CASES = [
    (dtype, voids)
    for dtype in ("uint8", "int16", "uint16", "int32", "float32", "float64")
    for voids in (None, "nodata", "nan", "mask")
    if voids != "nan" or dtype.startswith("float")
]


def netcdf(data, path):
    data.to_netcdf(path / "a.nc", engine="scipy")
    return xr.open_dataset(path / "a.nc", engine="scipy", decode_coords="all").heights


def zarr(data, path):
    data.to_zarr(path / "a.zarr", consolidated=False)
    return xr.open_zarr(path / "a.zarr", consolidated=False, decode_coords="all").heights


def geotiff(data, path):
    data.heights.rio.to_raster(path / "back.tif")
    back = rioxarray.open_rasterio(path / "back.tif", mask_and_scale=True)
    with rasterio.open(path / "back.tif") as dataset:
        # What GDAL takes for void; NaN that came in later is void without a nodata value, too.
        if dataset.nodata is not None:
            np.testing.assert_array_equal(dataset.read_masks(1) != 0, back[0].notnull())
    return back[0]


WAYS = {"netCDF": netcdf, "Zarr": zarr, "GeoTIFF": geotiff}


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(("dtype", "voids"), CASES)
def test_every_void_and_height_comes_back(tmp_path, dtype, voids, packed):
    tif, valid = raster(tmp_path, dtype, voids=voids, packed=packed)
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, **QUICK)
    # Others unpack float32 in float32.
    close = {"rtol": 1e-6 if packed and dtype == "float32" else 0}
    with xr.open_dataset(tmp_path / "a.twz") as expected:
        np.testing.assert_array_equal(expected.heights.notnull(), valid)
        for mask_and_scale in (True, False):
            with xr.open_dataset(tmp_path / "a.twz", mask_and_scale=mask_and_scale) as data:
                for name, write in WAYS.items():
                    if name == "netCDF" and np.dtype(dtype).kind == "u":
                        continue  # netCDF 3, all that scipy writes, has no such type
                    folder = tmp_path / f"{name}{mask_and_scale}"
                    folder.mkdir()
                    with write(data, folder) as back:
                        np.testing.assert_allclose(back, expected.heights, **close)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("write", WAYS.values(), ids=WAYS)
def test_voids_come_back_where_every_number_of_the_type_is_a_height(tmp_path, write, packed):
    tif, valid = raster(tmp_path, "uint8", voids="mask", packed=packed, full=True)
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, **QUICK)
    with xr.open_dataset(tmp_path / "a.twz") as data:
        np.testing.assert_array_equal(data.heights.notnull(), valid)
        back = write(data, tmp_path)
        np.testing.assert_array_equal(back, data.heights)
        back.close()
    with pytest.warns(TerrainwaveWarning, match="voids read as 0, as any height does"):
        xr.open_dataset(tmp_path / "a.twz", mask_and_scale=False).close()


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("write", WAYS.values(), ids=WAYS)
def test_voids_that_come_in_later_are_kept(tmp_path, write, packed):
    """A raster without voids, of which an area is asked for that reaches past it."""
    tif, _ = raster(tmp_path, "int16", voids=None, packed=packed)
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, **QUICK)
    with xr.open_dataset(tmp_path / "a.twz") as data:
        wider = data.load().reindex(x=500_005.0 + 10 * np.arange(-5, 40))
        assert wider.heights[:, :5].isnull().all()
        with write(wider, tmp_path) as back:
            np.testing.assert_array_equal(back, wider.heights)


def test_levels_are_written_again_with_their_voids(tmp_path):
    tif, _ = raster(tmp_path, "int16", voids="mask", packed=False)
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, block=32, **QUICK)
    with xr.open_dataset(tmp_path / "a.twz", level=-2) as data:
        assert data.heights.isnull().any()
        back = geotiff(data, tmp_path)
        np.testing.assert_array_equal(back, data.heights)
        back.close()


# What was lost before.


@pytest.fixture
def lossy(tmp_path):
    """A file within 1 m of a raster with voids, whose bound shows."""
    heights = terrain_like(70, 90) * 7 + np.arange(90, dtype="int16")
    heights[10:20, 30:50] = -9999
    tif = write_geotiff(
        tmp_path / "a.tif", heights, nodata=-9999, crs="EPSG:32633",
        transform=Affine(30.0, 0, 500_000.1, 0, -30.0, 5_000_000.7),
    )  # fmt: skip
    terrainwave.compress(tif, tmp_path / "lossy.twz", max_error=1, block=32)
    return tmp_path / "lossy.twz"


def stated(path):
    with terrainwave.open(path) as terrain:
        return terrain.effective_error, terrain.max_error


SAME = {
    "as opened": lambda array: array,
    "loaded": lambda array: array.load(),
    "in chunks": lambda array: array.load().chunk({"y": 32, "x": 32}),
    "cut": lambda array: array[5:40, 3:88],
    "turned over": lambda array: array[::-1, ::-1],
    "thinned out": lambda array: array[::3, 1::2],
    "transposed": lambda array: array.T,
    "of another type": lambda array: array.astype("float64"),
    "times 1": lambda array: (array * 1).assign_attrs(array.attrs),
    "renamed": lambda array: array.rename("z"),
    "a Dataset": lambda array: array.to_dataset(name="z"),
    "one row": lambda array: array[4:5],
}


@pytest.mark.parametrize("change", SAME.values(), ids=SAME)
@pytest.mark.parametrize("max_error", [0, 0.5, 2])
def test_second_loss_adds_to_the_first(lossy, tmp_path, change, max_error):
    with xr.open_dataset(lossy) as dataset:
        result = terrainwave.compress(
            change(dataset.heights), tmp_path / "b.twz", max_error=max_error
        )
    effective, asked = stated(tmp_path / "b.twz")
    assert asked == result.max_error == 1 + max_error
    assert effective == result.effective_error
    assert result.measured_error + 1 <= effective <= 1 + max_error
    assert any("within 1 of an original" in note for note in result.notes)


@pytest.mark.parametrize("method", ["rapid", "predictive", "cdf97", "store", "cdf53"])
def test_bounds_of_a_second_file_hold_for_the_first_original(lossy, tmp_path, method):
    original = opened(tmp_path / "a.tif")
    with xr.open_dataset(lossy) as dataset:
        dataset.heights.terrainwave.to_twz(
            tmp_path / "b.twz", max_error=1.5, method=method, block=32
        )
    with terrainwave.open(tmp_path / "b.twz") as terrain:
        found = terrain.to_xarray()
        assert np.abs(found - original).max() <= terrain.effective_error
        assert terrain.info().moved_error == pytest.approx(1, abs=0.1)
        # A mesh of the finest level tells its distance from the originals.
        assert terrain.mesh().error >= terrain.effective_error - 1e-9


@pytest.mark.parametrize(
    ("dtype", "bound", "second", "expected"),
    [
        ("int16", 2, 2, 2),  # the same steps: nothing is lost, and the bound stays
        ("float32", 0.5, 0.5, 0.5),
        ("int16", 7, 2, 7),  # steps of 15 are steps of 5, too
        ("int16", 2, 7, 9),  # wider ones: both losses count
        ("float32", 0.5, 0.1, 0.6),  # others
    ],
)
def test_heights_that_lie_on_fixed_steps_lose_nothing_again(
    tmp_path, dtype, bound, second, expected
):
    original = terrain_like(60, 70, dtype)
    if dtype == "float32":
        original = original + np.float32(np.pi)
    options = {"block": 32, "stable": True}
    terrainwave.compress(original, tmp_path / "a.twz", max_error=bound, **options)
    with xr.open_dataset(tmp_path / "a.twz") as dataset:
        again = terrainwave.compress(
            dataset.heights, tmp_path / "b.twz", max_error=second, **options
        )
    with terrainwave.open(tmp_path / "a.twz") as first, terrainwave.open(tmp_path / "b.twz") as it:
        is_still = np.array_equal(it.read(), first.read())
        assert is_still == (expected < bound + second)
        apart = np.abs(it.read().astype(float) - original).max()
        assert apart <= it.effective_error <= it.max_error == again.max_error
        # What was lost before is told in whole steps.
        assert expected - 1e-6 <= it.max_error <= expected + (0.02 if is_still else 2 * second + 1)
        assert it.mesh().error >= apart
    (note,) = (note for note in again.notes if "of an original" in note)
    assert ("do not move" in note) == is_still
    assert ("bound holds for it" in note) == (expected == second)


def test_third_loss_adds_to_both(tmp_path):
    heights = terrain_like(40, 50, "float32") * np.float32(np.pi)
    terrainwave.compress(heights, tmp_path / "0.twz", max_error=0.5)
    for number in (1, 2):
        with xr.open_dataset(tmp_path / f"{number - 1}.twz") as dataset:
            dataset.heights.terrainwave.to_twz(tmp_path / f"{number}.twz", max_error=0.25)
    with terrainwave.open(tmp_path / "2.twz") as terrain:
        assert np.abs(terrain.read() - heights).max() <= terrain.effective_error
        assert terrain.effective_error <= terrain.max_error
        assert terrain.max_error == pytest.approx(1, abs=0.05)


def test_heights_on_no_grid_are_exact_and_say_what_was_lost_before(tmp_path):
    heights = terrain_like(40, 50, "float32") * np.float32(np.pi)
    terrainwave.compress(heights, tmp_path / "a.twz", max_error=0.5)
    with xr.open_dataset(tmp_path / "a.twz") as dataset:
        lost = dataset.heights.attrs["max_error"]
        result = dataset.heights.terrainwave.to_twz(tmp_path / "b.twz", max_error=0)
        assert result.measured_error == 0
        with terrainwave.open(tmp_path / "b.twz") as terrain:
            np.testing.assert_array_equal(terrain.read(), dataset.heights)
            assert lost <= terrain.effective_error <= lost * 1.001
            assert np.abs(terrain.read() - heights).max() <= terrain.effective_error


@pytest.mark.parametrize("mask_and_scale", [True, False])
def test_losses_of_packed_heights_are_physical(tmp_path, mask_and_scale):
    tif, _ = raster(tmp_path, "int16", voids="mask", packed=True)
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=2, **QUICK)
    with xr.open_dataset(tmp_path / "a.twz", mask_and_scale=mask_and_scale) as dataset:
        dataset.heights.terrainwave.to_twz(tmp_path / "b.twz", max_error=1, **QUICK)
    assert stated(tmp_path / "b.twz") == (3, 3)


CHANGED = {
    "times 3": lambda array: (array * 3).assign_attrs(array.attrs),
    "one height": lambda array: array.where(
        (array.x != array.x[60]) | (array.y != array.y[60]), 0.0
    ),
    "in place": lambda array: changed_in_place(array),
    "averages": lambda array: array.coarsen(x=2, y=2).mean(),
    "resampled": lambda array: array.rio.reproject(
        "EPSG:32633", resolution=25.0, resampling=rasterio.enums.Resampling.bilinear
    ),
    "another CRS": lambda array: array.rio.reproject("EPSG:4326"),
    "voids filled": lambda array: array.fillna(0.0),
    "more voids": lambda array: array.where(array > 700),
    "moved": lambda array: array.assign_coords(x=array.x + 30.0),
    "beside": lambda array: array.shift(x=1),
    "smoothed": lambda array: array.rolling(x=3, center=True).mean(),
}


def changed_in_place(array):
    array = array.load()
    array[50, 60] += 1
    return array


@pytest.mark.parametrize("change", CHANGED.values(), ids=CHANGED)
def test_bound_of_other_heights_is_not_believed(lossy, tmp_path, change):
    with xr.open_dataset(lossy) as dataset:
        array = change(dataset.heights).assign_attrs(dataset.heights.attrs)
        array.encoding |= dataset.heights.encoding
        result = array.terrainwave.to_twz(tmp_path / "b.twz", max_error=0.5)
    effective, asked = stated(tmp_path / "b.twz")
    assert (effective <= 0.5, asked) == (True, 0.5)
    assert any("are not those of" in note for note in result.notes)


def test_bound_without_a_file_to_compare_with_is_not_believed(lossy, tmp_path):
    with xr.open_dataset(io.BytesIO(lossy.read_bytes())) as dataset:
        result = dataset.heights.terrainwave.to_twz(tmp_path / "b.twz", max_error=0.5)
    assert stated(tmp_path / "b.twz")[1] == 0.5
    assert any("no .twz file to compare" in note for note in result.notes)
    with xr.open_dataset(lossy) as dataset:
        array = dataset.heights.load()
    os.remove(lossy)
    result = array.terrainwave.to_twz(tmp_path / "c.twz", max_error=0.5)
    assert stated(tmp_path / "c.twz")[1] == 0.5
    assert any("cannot be compared" in note for note in result.notes)


@pytest.mark.parametrize("found", ["1 m", None, np.nan, -1.0, 0.0, True])
def test_attribute_that_is_no_bound_says_nothing(tmp_path, found):
    array = xr.DataArray(terrain_like(9, 9), dims=("y", "x"), attrs={"max_error": found})
    result = terrainwave.compress(array, tmp_path / "a.twz", max_error=0)
    assert result.notes == []


def test_more_than_a_bound_can_be_added_to_is_refused():
    """A millionth of a millionth beside a metre: the file counts to 2^31."""
    scan = HeightScan("float64")
    heights = np.random.default_rng(1).random((20, 20)) * 1e-6
    scan.update(heights, np.ones(heights.shape, bool))
    options = Options(max_error=1e-12)
    info = RasterInfo(20, 20, "float64")
    assert settled(options, scan, info)[0].moved == 0
    with pytest.raises(InvalidHeightsError, match="expected a larger max_error"):
        settled(options, scan, info, Earlier(1.0, note="the heights are within 1"))


def test_file_that_another_was_made_of_can_be_patched(lossy, tmp_path):
    with xr.open_dataset(lossy) as dataset:
        dataset.heights.terrainwave.to_twz(tmp_path / "b.twz", max_error=0.5)
        assert stated(tmp_path / "b.twz") == (1, 1.5)
        # Known by itself everywhere: what was lost before counts no more.
        assert terrainwave.patch(tmp_path / "b.twz", dataset.heights).effective_error == 0
