"""Bounds of arrays that came out of .twz files: where they are stated, and what they add up to."""

import io
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rioxarray
import xarray as xr
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave

# rioxarray 0.19 multiplies transforms, which affine 3 will deprecate.
pytestmark = pytest.mark.filterwarnings("ignore:Use .@. matmul:PendingDeprecationWarning")

QUICK = {"method": "store", "mesh": "none"}


@pytest.fixture(scope="module")
def raster_and_file(tmp_path_factory):
    """A raster with voids, and a file within 1 m of it, whose bound shows."""
    tmp_path = tmp_path_factory.mktemp("lossy")
    heights = terrain_like(70, 90) * 7 + np.arange(90, dtype="int16")
    heights[10:20, 30:50] = -9999
    tif = write_geotiff(
        tmp_path / "a.tif", heights, nodata=-9999, crs="EPSG:32633", units=("m",),
        transform=Affine(30.0, 0, 500_000.1, 0, -30.0, 5_000_000.7),
    )  # fmt: skip
    terrainwave.compress(tif, tmp_path / "lossy.twz", max_error=1, block=32)
    return tif, tmp_path / "lossy.twz"


@pytest.fixture
def lossy(raster_and_file, tmp_path):
    """The file, to be changed."""
    return Path(shutil.copy(raster_and_file[1], tmp_path))


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
    "called metre": lambda array: array.assign_attrs(units="metre"),
    "renamed": lambda array: array.rename("z"),
    "a Dataset": lambda array: array.to_dataset(name="z"),
    "one row": lambda array: array[4:5],
    "plus nothing": lambda array: array + 0,
    "sorted": lambda array: array.sortby("y"),
    "a function of itself": lambda array: xr.apply_ufunc(np.asarray, array, keep_attrs=True),
    "with time": lambda array: array.expand_dims(time=[0]),
    "without its CRS": lambda array: array.drop_vars("spatial_ref"),
    "without attributes": lambda array: array.drop_attrs(),
    "of a tree": lambda array: xr.DataTree.from_dict({"/": array.to_dataset(name="z")})["z"],
}


@pytest.mark.parametrize("change", SAME.values(), ids=SAME)
def test_heights_of_a_part_of_the_file_have_its_bound(lossy, change):
    with xr.open_dataset(lossy) as dataset:
        array = change(dataset.heights)
        if isinstance(array, xr.Dataset):
            array = array["z"]
        assert array.terrainwave.bound() == 1


FEW = ("as opened", "in chunks", "turned over", "a Dataset", "times 1")


@pytest.mark.parametrize("change", [SAME[name] for name in FEW], ids=FEW)
@pytest.mark.parametrize("max_error", [0, 2])
def test_second_loss_adds_to_the_first(lossy, tmp_path, change, max_error):
    with xr.open_dataset(lossy) as dataset:
        result = terrainwave.compress(
            change(dataset.heights), tmp_path / "b.twz", max_error=max_error, **QUICK
        )
    effective, asked = stated(tmp_path / "b.twz")
    assert asked == result.max_error == 1 + max_error
    assert effective == result.effective_error
    assert result.measured_error + 1 <= effective <= 1 + max_error
    assert any("within 1 of an original" in note for note in result.notes)


@pytest.mark.few(2)
@pytest.mark.parametrize("method", ["rapid", "predictive", "cdf97", "store", "cdf53"])
def test_bounds_of_a_second_file_hold_for_the_first_original(
    raster_and_file, lossy, tmp_path, method
):
    original = rioxarray.open_rasterio(raster_and_file[0], masked=True)[0]
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


@pytest.mark.few(2)
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


def test_heights_on_no_grid_are_exact_and_say_what_was_lost_before(tmp_path):
    heights = terrain_like(40, 50, "float32") * np.float32(np.pi)
    terrainwave.compress(heights, tmp_path / "a.twz", max_error=0.5)
    with xr.open_dataset(tmp_path / "a.twz") as dataset:
        lost = dataset.heights.terrainwave.bound()
        result = dataset.heights.terrainwave.to_twz(tmp_path / "b.twz", max_error=0)
        assert result.measured_error == 0
        with terrainwave.open(tmp_path / "b.twz") as terrain:
            np.testing.assert_array_equal(terrain.read(), dataset.heights)
            assert lost <= terrain.effective_error <= lost * 1.001
            assert np.abs(terrain.read() - heights).max() <= terrain.effective_error


@pytest.mark.parametrize("mask_and_scale", [True, False])
def test_losses_of_packed_heights_are_physical(tmp_path, mask_and_scale):
    heights = terrain_like(64, 64)
    heights[:16, 3:40] = -5
    tif = write_geotiff(
        tmp_path / "a.tif", heights, nodata=-5, bands={"scales": 0.5, "offsets": -100.0}
    )
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=2, **QUICK)
    with xr.open_dataset(tmp_path / "a.twz", mask_and_scale=mask_and_scale) as dataset:
        assert dataset.heights.terrainwave.bound() == 2
        dataset.heights.terrainwave.to_twz(tmp_path / "b.twz", max_error=1, **QUICK)
    assert stated(tmp_path / "b.twz") == (3, 3)


CHANGED = {
    "times 3": lambda array: array * 3,
    "a copy of other data": lambda array: array.copy(data=2 * array),
    "one height": lambda array: array.where(
        (array.x != array.x[60]) | (array.y != array.y[60]), 0.0
    ),
    "in place": lambda array: changed_in_place(array),
    "averages": lambda array: array.coarsen(x=2, y=2).mean(),
    "averages of chunks": lambda array: array.load().chunk(x=32).coarsen(x=2, y=2).mean(),
    "slopes": lambda array: slope(array),
    "resampled": lambda array: array.rio.reproject(
        "EPSG:32633", resolution=25.0, resampling=rasterio.enums.Resampling.bilinear
    ),
    "another CRS": lambda array: array.rio.reproject("EPSG:4326"),
    "called another CRS": lambda array: array.rio.write_crs("EPSG:32634"),
    "called feet": lambda array: array.assign_attrs(units="ft"),
    "voids filled": lambda array: array.fillna(0.0),
    "more voids": lambda array: array.where(array > 700),
    "moved": lambda array: array.assign_coords(x=array.x + 30.0),
    "beside": lambda array: array.shift(x=1),
    "rolled": lambda array: array.roll(x=5),
    "rolled with its place": lambda array: array.roll(x=5, roll_coords=False),
    "between": lambda array: array.interp(x=array.x.values[:-1] + 15.0),
    "smoothed": lambda array: array.rolling(x=3, center=True).mean(),
    "whole numbers": lambda array: (array / 10).fillna(-999).astype("int16"),
    "a level above": lambda array: array[::2, ::2] + 1,
}


def slope(array):
    return xr.apply_ufunc(lambda z: np.hypot(*np.gradient(z)), array, keep_attrs=True)


def changed_in_place(array):
    array = array.load()
    array[50, 60] += 1
    return array


def kept(array, opened):
    """Return an array with all that xarray may leave with it of the one that was opened."""
    array = array.assign_attrs(opened.attrs | array.attrs)
    array.encoding = opened.encoding | array.encoding
    return array


@pytest.mark.parametrize("change", CHANGED.values(), ids=CHANGED)
def test_other_heights_have_no_bound(lossy, change):
    with xr.open_dataset(lossy) as dataset:
        array = kept(change(dataset.heights), dataset.heights)
        assert array.terrainwave.bound() is None


@pytest.mark.parametrize("name", ["a copy of other data", "slopes", "in place", "called feet"])
def test_file_of_other_heights_does_not_add_a_bound(lossy, tmp_path, name):
    with xr.open_dataset(lossy) as dataset:
        array = CHANGED[name](dataset.heights)
        result = array.terrainwave.to_twz(tmp_path / "b.twz", max_error=0.5, **QUICK)
    effective, asked = stated(tmp_path / "b.twz")
    assert (effective <= 0.5, asked) == (True, 0.5)
    assert any("not its heights at their place any more" in note for note in result.notes)


NO_RASTERS = {
    "padded": lambda array: array.pad(x=2, constant_values=0.0),
    "with copies as bands": lambda array: xr.concat([array, 2 * array], "band"),
    "with copies as times": lambda array: xr.concat([array, array], "time"),
    "one line": lambda array: array[3],
    "rolled with its columns": lambda array: array.roll(x=5, roll_coords=True),
    "without a place": lambda array: array.drop_vars(["x", "y", "spatial_ref"]),
    "nothing": lambda array: array[:0],
}


@pytest.mark.parametrize("change", NO_RASTERS.values(), ids=NO_RASTERS)
def test_what_is_no_part_of_the_file_has_no_bound(lossy, change):
    with xr.open_dataset(lossy) as dataset:
        assert kept(change(dataset.heights), dataset.heights).terrainwave.bound() is None


@pytest.mark.parametrize("change", ["gone", "damaged", "replaced"])
def test_bound_without_its_file_is_not_believed(lossy, tmp_path, change):
    with xr.open_dataset(lossy) as dataset:
        array = dataset.heights.load()
    if change == "replaced":
        terrainwave.compress(array + 1, lossy, max_error=1, overwrite=True, **QUICK)
    else:
        os.remove(lossy)
    if change == "damaged":
        lossy.write_bytes(b"\x89TWZ")
    assert array.terrainwave.bound() is None
    result = array.terrainwave.to_twz(tmp_path / "c.twz", max_error=0.5, **QUICK)
    assert stated(tmp_path / "c.twz")[1] == 0.5
    (note,) = (note for note in result.notes if "the heights came from" in note)
    assert ("cannot be compared" in note) == (change != "replaced")


def test_heights_that_came_from_no_file_have_no_bound(lossy):
    with xr.open_dataset(io.BytesIO(lossy.read_bytes())) as dataset:
        assert dataset.heights.terrainwave.bound() is None


@pytest.mark.few(1)
@pytest.mark.parametrize("method", ["cdf97", "cdf53", "rapid"])
@pytest.mark.parametrize("max_error", [0, 1])
def test_levels_have_the_bound_that_holds_for_them(raster_and_file, tmp_path, method, max_error):
    tif = raster_and_file[0]
    terrainwave.compress(tif, tmp_path / "b.twz", max_error=max_error, method=method, block=32)
    with xr.open_datatree(tmp_path / "b.twz") as tree, rasterio.open(tif) as dataset:
        original = dataset.read(1, masked=True).astype(float).filled(np.nan)
        bounds = []
        for level in range(3):
            heights = tree[f"level_{level}"].heights
            apart = np.nanmax(np.abs(heights - original[:: 4 >> level, :: 4 >> level]))
            bounds.append(heights.terrainwave.bound())
            assert apart <= bounds[-1]
            assert (heights + 1).terrainwave.bound() is None
            part = heights[1:, 2:].terrainwave
            assert part.bound() <= bounds[-1]
            result = part.to_twz(tmp_path / f"{level}.twz", max_error=0.5, **QUICK)
            assert bounds[-1] <= result.max_error
    assert bounds[-1] == max_error
    # Of the wavelets' averages, the levels are further from the originals than the full grid.
    assert (bounds[0] > max_error) == (method != "rapid")


WRITTEN = {
    "as opened": lambda array: array,
    "slopes": slope,
    "reprojected": lambda array: array.rio.reproject("EPSG:4326"),
    "cut": lambda array: array.isel(x=slice(3, 30)),
    "doubled": lambda array: array.copy(data=2 * array),
}


def says_a_bound(fields):
    return [key for key in fields if "error" in key.lower() or "lossless" in str(fields).lower()]


@pytest.mark.parametrize("mask_and_scale", [True, False])
@pytest.mark.parametrize("change", WRITTEN.values(), ids=WRITTEN)
def test_no_attribute_encoding_or_written_file_states_a_bound(
    lossy, tmp_path, change, mask_and_scale
):
    with xr.open_dataset(lossy, mask_and_scale=mask_and_scale) as dataset:
        array = kept(change(dataset.heights), dataset.heights)
        array.to_netcdf(tmp_path / "a.nc", engine="scipy")
        array.to_zarr(tmp_path / "a.zarr", consolidated=False)
        array.rio.to_raster(tmp_path / "back.tif")
        found = [dataset, *dataset.variables.values(), array, *array.coords.values()]
        with (
            xr.open_dataset(tmp_path / "a.nc", engine="scipy") as netcdf,
            xr.open_zarr(tmp_path / "a.zarr", consolidated=False) as zarr,
            rioxarray.open_rasterio(tmp_path / "back.tif") as raster,
        ):
            found += [raster, netcdf, *netcdf.variables.values(), zarr, *zarr.variables.values()]
            for one in found:
                assert not says_a_bound(one.attrs)
                assert not says_a_bound(one.encoding)


def test_file_that_another_was_made_of_can_be_patched(lossy, tmp_path):
    with xr.open_dataset(lossy) as dataset:
        dataset.heights.terrainwave.to_twz(tmp_path / "b.twz", max_error=0.5)
        assert stated(tmp_path / "b.twz") == (1, 1.5)
        # Known by itself everywhere: what was lost before counts no more.
        assert terrainwave.patch(tmp_path / "b.twz", dataset.heights).effective_error == 0
