"""What a file does not hold is said, once; bands that mark voids mark them in every type."""

import re

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import TerrainwaveWarning
from terrainwave.raster_io.raster_info import SUPPORTED_DTYPES
from terrainwave.raster_io.source import RasterSource

PLACE = {"crs": "EPSG:32633", "transform": Affine(10, 0, 5e5, 0, -10, 5e6)}


def with_alpha(path, dtype, bands, alphas, **profile):
    """Write `bands` and `alphas` as a GeoTIFF of a type; return the path."""
    layers = np.stack([np.asarray(layer).astype(dtype) for layer in (*bands, *alphas)])
    write_geotiff(path, layers, photometric="MINISBLACK", **PLACE, **profile)
    with rasterio.open(path, "r+") as dataset:
        gray = (ColorInterp.gray, *[ColorInterp.undefined] * (len(bands) - 1))
        dataset.colorinterp = (*gray, *[ColorInterp.alpha] * len(alphas))
    return path


def read_all(source):
    return source.read(0, 0, source.info.n_rows, source.info.n_cols)


@pytest.mark.few(12)
@pytest.mark.parametrize("dtype", SUPPORTED_DTYPES)
@pytest.mark.parametrize("nodata", [None, 7])
@pytest.mark.parametrize("n_bands", [1, 2, 3])
@pytest.mark.filterwarnings("ignore:.*found . bands")
def test_alpha_of_0_is_void_in_every_type(tmp_path, dtype, nodata, n_bands):
    heights, alpha = np.array([[5, 6, 7, 8]]), np.array([[255, 0, 255, 1]])
    path = with_alpha(tmp_path / "a.tif", dtype, [heights] * n_bands, [alpha], nodata=nodata)
    with RasterSource(path) as source:
        assert read_all(source)[1].tolist() == [[True, False, nodata is None, True]]


@pytest.mark.few(4)
@pytest.mark.parametrize("dtype", SUPPORTED_DTYPES)
@pytest.mark.parametrize("nodata", [None, 0])
def test_voids_of_an_alpha_band_come_back(tmp_path, dtype, nodata):
    heights = terrain_like(40, 50, "float64") % 100 + 1
    alpha = np.full(heights.shape, 255)
    alpha[5:20, 30:], heights[5:20, 30:] = 0, 0
    path = with_alpha(tmp_path / "a.tif", dtype, [heights], [alpha], nodata=nodata)
    result = terrainwave.compress(path, tmp_path / "a.twz", max_error=0.5)
    assert result.notes == [] or "lossless" in result.notes[0]
    terrainwave.decompress(tmp_path / "a.twz", tmp_path / "back.tif")
    with rasterio.open(tmp_path / "back.tif") as dataset:
        assert (dataset.read_masks(1) > 0).tolist() == (alpha > 0).tolist()
    report = terrainwave.verify(tmp_path / "a.twz", path)
    assert (report.problems, report.errors.n_valid) == ((), 40 * 50 - 15 * 20)


def test_alpha_of_a_band_without_a_number_is_void(tmp_path):
    heights, alpha = np.array([[5.0, 6.0]]), np.array([[np.nan, 1.0]])
    with RasterSource(with_alpha(tmp_path / "a.tif", "float32", [heights], [alpha])) as source:
        assert read_all(source)[1].tolist() == [[False, True]]


def test_several_alpha_bands_all_count_and_are_named(tmp_path):
    alphas = np.array([[255, 0, 255]]), np.array([[255, 255, 0]])
    path = with_alpha(tmp_path / "a.tif", "float32", [np.ones((1, 3))], alphas)
    with pytest.warns(TerrainwaveWarning, match="bands 2 and 3 are alpha bands"):
        source = RasterSource(path)
    with source:
        assert read_all(source)[1].tolist() == [[True, False, False]]


@pytest.mark.parametrize(
    ("tags", "is_noted"),
    [
        ({"missing_value": "-999"}, True),
        ({"missing_value": "-9999"}, False),
        ({"_FillValue": "nan"}, False),
        ({"missing_value": "none"}, False),
    ],
)
def test_value_that_a_tag_calls_missing_is_named(tmp_path, tags, is_noted):
    path = write_geotiff(tmp_path / "a.tif", terrain_like(4, 4), nodata=-9999, **PLACE)
    with rasterio.open(path, "r+") as dataset:
        dataset.update_tags(1, **tags)
    with RasterSource(path, warn=False) as source:
        assert [bool(re.search("heights of -999 count", note)) for note in source.notes] == (
            [True] * is_noted
        )
