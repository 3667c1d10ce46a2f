"""Attributes that survive operations: stackstac's transform, and scale and offset."""

import warnings

import numpy as np
import pytest
import rioxarray
import xarray as xr
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import InvalidHeightsError, TerrainwaveWarning
from terrainwave.raster_io.source import RasterSource

# rioxarray 0.19 multiplies transforms, which affine 3 will deprecate.
pytestmark = pytest.mark.filterwarnings("ignore:Use .@. matmul:PendingDeprecationWarning")

QUICK = {"method": "store", "mesh": "none"}
N = 12
PLACE = (10.0, 0.0, 500_000.0, 0.0, -10.0, 5_000_000.0)


class Spec:
    """stackstac's RasterSpec, as far as it is read."""

    shape = N, N


SPEC = Spec()


def stacked(xy_coords, spec=SPEC, **attrs):
    """Return an array as stackstac 0.5 makes it, with `xy_coords` as in its `stack`."""
    corners = {"x": 500_000 + 10.0 * np.arange(N), "y": 5_000_000 - 10.0 * np.arange(N)}
    found = {
        "topleft": corners,
        "center": {"x": corners["x"] + 5, "y": corners["y"] - 5},
        False: {},
    }[xy_coords]
    attrs = {"crs": "epsg:32632", "transform": Affine(*PLACE), "resolution": 10, **attrs}
    if spec is not None:
        attrs["spec"] = spec
    return xr.DataArray(
        terrain_like(N, N, "float32")[None, None],
        dims=("time", "band", "y", "x"),
        coords={"time": [0], "band": ["dem"], "epsg": 32632, **found},
        attrs=attrs,
    )


def read(array, **options):
    """Return information and notes of an array."""
    with RasterSource(array, warn=False, **options) as source:
        return source.info, list(source.notes)


# By hand: places of pixels, whatever the coordinates are of.
PARTS = {
    "whole": (lambda array: array, PLACE),
    "cut": (
        lambda array: array.isel(x=slice(3, 9), y=slice(2, 11)),
        (10.0, 0.0, 500_030.0, 0.0, -10.0, 4_999_980.0),
    ),
    "turned over": (
        lambda array: array.isel(y=slice(None, None, -1)),
        (10.0, 0.0, 500_000.0, 0.0, 10.0, 4_999_880.0),
    ),
    "one row": (
        lambda array: array.isel(y=slice(4, 5)),
        (10.0, 0.0, 500_000.0, 0.0, -10.0, 4_999_960.0),
    ),
    "in chunks": (lambda array: array.chunk(x=5), PLACE),
    "with a CRS by rioxarray": (lambda array: array.rio.write_crs(32632), PLACE),
    "a Dataset": (lambda array: array.to_dataset(dim="band"), PLACE),
    "numbers": (lambda array: array.assign_attrs(transform=PLACE), PLACE),
    "numbers of a file": (
        lambda array: array.assign_attrs(transform=np.array([*PLACE, 0.0, 0.0, 1.0])), PLACE
    ),
}  # fmt: skip


@pytest.mark.parametrize("xy_coords", ["topleft", "center"])
@pytest.mark.parametrize("part", PARTS)
def test_pixels_lie_where_the_transform_says(xy_coords, part):
    change, place = PARTS[part]
    info, notes = read(change(stacked(xy_coords)))
    assert info.transform == pytest.approx(place, rel=0, abs=1e-6)
    assert info.crs == "EPSG:32632"
    assert any("corners of pixels" in note for note in notes) == (xy_coords == "topleft")


def test_array_without_coordinates_has_the_place_of_its_transform():
    info, notes = read(stacked(False))
    assert (info.transform, info.crs, notes) == (PLACE, "EPSG:32632", [])
    info, notes = read(stacked(False, spec=None))
    assert (info.transform, info.crs) == (PLACE, "EPSG:32632")
    assert any("would be wrong if it was cut since" in note for note in notes)


def packed(tmp_path, dtype="int16", nodata=-9):
    """Return the path of a raster of 200 to 1000 m in tenths above 100 m, with a void."""
    stored = np.linspace(1000, 9000, 20 * 20).reshape(20, 20).astype(dtype)
    stored[3, 4] = nodata
    return write_geotiff(
        tmp_path / "a.tif", stored, nodata=nodata, bands={"scales": 0.1, "offsets": 100.0},
        crs="EPSG:32632", transform=Affine(*PLACE),
    )  # fmt: skip


def by_hand(array):
    return array * array.attrs["scale_factor"] + array.attrs["add_offset"]


OPENED = {
    "as stored": ({}, lambda array: array),
    "masked": ({"masked": True}, lambda array: array),
    "masked, cut": ({"masked": True}, lambda array: array[:, :, 1:]),
    "decoded": ({"mask_and_scale": True}, lambda array: array),
    "decoded, smoothed": ({"mask_and_scale": True}, lambda array: (array + array) / 2),
    "by hand": ({}, by_hand),
    "masked, by hand": ({"masked": True}, by_hand),
    "by hand, in chunks": ({}, lambda array: by_hand(array.chunk(x=7))),
    "by hand, as a copy": ({}, lambda array: array.copy(data=by_hand(array))),
    "by a function": ({}, lambda array: xr.apply_ufunc(lambda z: z * 0.1 + 100, array)),
}


@pytest.mark.parametrize(
    ("dtype", "way"),
    [("int16", way) for way in OPENED]
    # Nothing tells a copy of the same type from packed heights.
    + [("float32", way) for way in OPENED if way != "by hand, as a copy"],
)
def test_heights_are_scaled_once(tmp_path, dtype, way):
    options, change = OPENED[way]
    array = change(rioxarray.open_rasterio(packed(tmp_path, dtype), **options))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        terrainwave.compress(array, tmp_path / "a.twz", max_error=0.05, **QUICK)
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        info = terrain.info()
        assert (info.minimum, info.maximum) == pytest.approx((200, 1000), abs=2.5)
        valid = terrain.read_with_mask()[1]
        assert valid.sum() == valid.size - 1


@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_stored_values_of_a_file_are_scaled_once(tmp_path, dtype):
    terrainwave.compress(packed(tmp_path, dtype), tmp_path / "a.twz", max_error=0, **QUICK)
    with xr.open_dataset(tmp_path / "a.twz", mask_and_scale=False) as dataset:
        assert read(dataset.heights[1:])[0].scale == 0.1
        assert dataset.heights.terrainwave.bound() == 0
        assert read(by_hand(dataset.heights))[0].scale == 1.0


def test_one_sample_of_an_unknown_size_is_refused():
    with pytest.raises(InvalidHeightsError, match="has one sample along y"):
        read(stacked("topleft")[..., 3:4, 5:6])


@pytest.mark.parametrize("write_crs", [False, True])
def test_transform_of_another_shape_is_no_place(write_crs):
    array = stacked(False)[..., 2:, :]
    info, notes = read(array.rio.write_crs(32632) if write_crs else array)
    assert info.crs is None
    assert any("10 x 12 samples, and its attribute transform is of 12 x 12" in n for n in notes)
