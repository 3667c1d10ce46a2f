"""The option `nodata`: adds a value to those that a raster declares, replaces or drops them."""

import warnings

import numpy as np
import pytest
import rasterio
import xarray
from rasterio.transform import Affine
from strategies import write_geotiff

import terrainwave
from terrainwave.errors import InvalidArgumentError, TerrainwaveWarning
from terrainwave.raster_io.source import RasterSource

CRS = "EPSG:32632"
CHOICES = {
    -9999: (-9999, {0, -9999}),
    "only:-9999": (-9999, {-9999}),
    "none": (None, set()),
    None: (0, {0}),
}
# Rows of 0, of -9999 and of heights.
HEIGHTS = np.repeat(np.array([[0], [-9999], [100], [250]]), 6, axis=1)


def tif(path, heights=HEIGHTS, nodata=0, left=0, dtype="int16", **options):
    place = Affine(10, 0, 5e5 + left, 0, -10, 5e6)
    return write_geotiff(
        path, heights.astype(dtype), nodata=nodata, crs=CRS, transform=place, **options
    )


def sources(tmp_path, dtype):
    """Yield the raster as a path, a dataset, an array of xarray, and a mosaic of two halves."""
    path = tif(tmp_path / "a.tif", dtype=dtype)
    yield path
    with rasterio.open(path) as dataset:
        yield dataset
    yield xarray.DataArray(HEIGHTS.astype(dtype), dims=("y", "x"), attrs={"_FillValue": 0})
    right = tif(tmp_path / "r.tif", HEIGHTS[:, 3:], left=30, dtype=dtype)
    yield [tif(tmp_path / "l.tif", HEIGHTS[:, :3], dtype=dtype), right]


@pytest.mark.filterwarnings("ignore::terrainwave.TerrainwaveWarning")
@pytest.mark.parametrize("dtype", ["int16", "float32"])
@pytest.mark.parametrize("choice", list(CHOICES), ids=str)
def test_declared_values_stay_voids_unless_they_are_replaced_or_dropped(tmp_path, dtype, choice):
    stored, voids = CHOICES[choice]
    for source in sources(tmp_path, dtype):
        with RasterSource(source, nodata=choice) as opened:
            heights, valid = opened.read(0, 0, *HEIGHTS.shape)
            assert opened.info.nodata == stored
        np.testing.assert_array_equal(valid, ~np.isin(HEIGHTS, list(voids)))
        np.testing.assert_array_equal(heights[valid], HEIGHTS[valid])


def compressed(tmp_path, source, **options):
    """Compress; return the file and the warnings."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", TerrainwaveWarning)
        terrainwave.compress(
            source, tmp_path / "a.twz", max_error=0, method="store", overwrite=True, **options
        )
    return tmp_path / "a.twz", [str(one.message) for one in said]


@pytest.mark.parametrize("choice", ["only:-9999", "none"])
@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_samples_that_become_heights_are_counted(tmp_path, dtype, choice):
    for source in sources(tmp_path, dtype):
        _, said = compressed(tmp_path, source, nodata=choice)
        (note,) = [one for one in said if "declares 0 as nodata" in one]
        assert "6 samples are heights" in note


@pytest.mark.filterwarnings("ignore::terrainwave.TerrainwaveWarning")
@pytest.mark.parametrize("choice", [-9999, "only:-9999", "none"], ids=str)
def test_masks_stay_voids(tmp_path, choice):
    mask = np.ones(HEIGHTS.shape, bool)
    mask[3, 2:] = False
    path = tif(tmp_path / "a.tif", nodata=None, mask=mask)
    _, voids = CHOICES[choice]
    with RasterSource(path, nodata=choice) as source:
        valid = source.read(0, 0, *HEIGHTS.shape)[1]
    np.testing.assert_array_equal(valid, mask & ~np.isin(HEIGHTS, list(voids - {0})))


@pytest.mark.filterwarnings("ignore::terrainwave.TerrainwaveWarning")
@pytest.mark.parametrize("choice", [-9999, "only:-9999", "none"], ids=str)
@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_verify_takes_the_same_choice(tmp_path, dtype, choice):
    path = tif(tmp_path / "a.tif", dtype=dtype)
    file, _ = compressed(tmp_path, path, nodata=choice)
    assert terrainwave.verify(file, path, nodata=choice).ok
    assert not terrainwave.verify(file, path).ok


def test_a_lossy_height_may_have_a_declared_value_that_the_file_does_not_use(tmp_path):
    heights = np.array([[0, 1, 2, 100, -9999]] * 5)
    path = tif(tmp_path / "a.tif", heights)
    with pytest.warns(TerrainwaveWarning, match="marks voids too"):
        terrainwave.compress(path, tmp_path / "a.twz", max_error=1, nodata=-9999)
    assert terrainwave.verify(tmp_path / "a.twz", path, nodata=-9999).ok


def test_patch_counts_heights_that_a_newer_raster_declares_void(tmp_path):
    file = tmp_path / "a.twz"
    heights = np.arange(24).reshape(4, 6)
    terrainwave.compress(tif(tmp_path / "a.tif", heights, None), file, max_error=0, method="rapid")
    newer = tif(tmp_path / "b.tif", heights, 5)
    with pytest.warns(TerrainwaveWarning, match="1 sample is a height.*declares 5 as nodata"):
        assert "1 sample is a height" in terrainwave.patch(file, newer, nodata="none").notes[0]


@pytest.mark.parametrize("wrong", ["-9999", "only", "only:", "only:x", "None", [1], object()])
def test_other_texts_are_refused(wrong):
    with pytest.raises(InvalidArgumentError, match="expected a number, or nan, only:NUMBER or non"):
        RasterSource(np.zeros((2, 2)), nodata=wrong)


@pytest.mark.parametrize("given", ["only:70000", "only:0.5", 70000])
def test_a_value_that_the_type_cannot_hold_is_refused_in_one_line(tmp_path, given):
    for source in sources(tmp_path, "int16"):
        with pytest.raises(InvalidArgumentError, match="choose another nodata"):
            RasterSource(source, nodata=given)
