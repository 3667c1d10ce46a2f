"""Arrays of .twz files beside rioxarray's, and written again."""

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
from terrainwave.errors import TerrainwaveWarning
from terrainwave.grid.affine import of_level
from terrainwave.read.places import LevelPlace

# rioxarray 0.19 multiplies transforms, which affine 3 will deprecate.
pytestmark = pytest.mark.filterwarnings("ignore:Use .@. matmul:PendingDeprecationWarning")

QUICK = {"method": "store", "mesh": "none"}


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


@pytest.mark.few(3)
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


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("dtype", "voids", "packed"), [(*case, i % 2 == 1) for i, case in enumerate(CASES)]
)
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
