"""What a file does not hold is said, once; bands that mark voids mark them in every type."""

import json
import re

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from rasterio.control import GroundControlPoint
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.cli import main
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


def test_alpha_band_that_is_taken_itself_names_the_others(tmp_path):
    path = with_alpha(tmp_path / "a.tif", "float32", [np.ones((1, 2))], [np.array([[0.0, 9.0]])])
    with RasterSource(path, band=2) as source:  # chosen: no warning
        heights, valid = read_all(source)
        assert source.notes == (f"{path}: using band 2; left out: band 1",)
    assert (heights.tolist(), valid.tolist()) == ([[0.0, 9.0]], [[True, True]])


def test_alpha_band_that_nobody_chose_is_named(tmp_path):
    bands = np.array([[[0, 9]], [[5, 6]]], dtype="uint8")
    path = write_geotiff(tmp_path / "a.tif", bands, **PLACE)
    with rasterio.open(path, "r+") as dataset:
        dataset.colorinterp = (ColorInterp.alpha, ColorInterp.gray)
    with RasterSource(path, warn=False) as source:
        assert (
            f"{path}: band 1 is an alpha band, whose numbers are taken for heights" in source.notes
        )


def test_bands_that_are_left_out_have_their_names(tmp_path):
    path = write_geotiff(tmp_path / "a.tif", np.stack([terrain_like(4, 4)] * 3), **PLACE)
    with rasterio.open(path, "r+") as dataset:
        dataset.descriptions = ("height", "slope", None)
    with pytest.warns(TerrainwaveWarning, match=r"left out: band 2 \(slope\), band 3$"):
        RasterSource(path).close()


def test_many_bands_are_named_in_few_words(tmp_path):
    path = write_geotiff(tmp_path / "a.tif", np.stack([terrain_like(4, 4)] * 60), **PLACE)
    with pytest.warns(TerrainwaveWarning, match="left out: 59 bands, from 2 to 60$"):
        RasterSource(path).close()


def test_a_place_that_is_lost_is_said(tmp_path):
    points = [GroundControlPoint(r, c, 10.0 + c, 50.0 - r) for r, c in [(0, 0), (0, 9), (9, 0)]]
    with pytest.warns(NotGeoreferencedWarning):
        rasterio.open(write_geotiff(tmp_path / "a.tif", terrain_like(10, 10))).close()
    with rasterio.open(
        tmp_path / "b.tif", "w", driver="GTiff", width=10, height=10, count=1, dtype="int16",
        gcps=points, crs="EPSG:4326",
    ) as dataset:  # fmt: skip
        dataset.write(terrain_like(10, 10), 1)
    with pytest.warns(TerrainwaveWarning, match="GCPs are dropped.* place and CRS are lost"):
        RasterSource(tmp_path / "b.tif").close()


def test_geolocation_arrays_are_said_to_be_lost(tmp_path):
    path = write_geotiff(tmp_path / "a.tif", terrain_like(10, 10))
    with pytest.warns(NotGeoreferencedWarning), rasterio.open(path, "r+") as dataset:
        dataset.update_tags(ns="GEOLOCATION", X_DATASET="lon.tif", Y_DATASET="lat.tif")
    with pytest.warns(TerrainwaveWarning, match="geolocation arrays are dropped") as noted:
        RasterSource(path).close()
    assert len(noted) == 1


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


@pytest.mark.parametrize("n_tiles", [1, 2])
def test_overviews_and_statistics_are_noted_without_a_warning(tmp_path, n_tiles):
    paths = []
    for number in range(n_tiles):
        place = {**PLACE, "transform": Affine(10, 0, 5e5 + 400 * number, 0, -10, 5e6)}
        paths.append(write_geotiff(tmp_path / f"{number}.tif", terrain_like(40, 40), **place))
        with rasterio.open(paths[-1], "r+") as dataset:
            dataset.build_overviews([2])
            dataset.update_tags(1, STATISTICS_MEAN="5.5")
    with RasterSource(paths) as source:  # warnings are errors
        (note,) = source.notes
    more = " and 1 more" if n_tiles == 2 else ""
    assert note == (
        f"{paths[0]}{more}: not kept, as the heights give them again: overviews (levels are samples"
        " of the full grid) and statistics"
    )


def test_other_rasters_of_a_file_are_named(tmp_path):
    path = tmp_path / "a.tif"
    write_geotiff(path, terrain_like(4, 4), **PLACE)
    write_geotiff(path, terrain_like(4, 4), append_subdataset="YES", **PLACE)
    with pytest.warns(TerrainwaveWarning, match="several rasters.*GTIFF_DIR:1:.*GTIFF_DIR:2:"):
        RasterSource(path).close()


@pytest.mark.parametrize(("band", "other"), [(1, 2), (2, 1)])
@pytest.mark.parametrize("as_json", [True, False])
def test_each_note_is_printed_once_and_is_in_the_result(tmp_path, band, other, as_json):
    path = write_geotiff(tmp_path / "a.tif", np.stack([terrain_like(40, 40)] * 2), **PLACE)
    args = ["compress", str(path), f"{tmp_path}/a.twz", "--band", str(band)]
    done = CliRunner().invoke(main, [*args, "--json"] if as_json else args)
    printed = done.stderr.count(f"left out: band {other}")
    if as_json:
        notes = json.loads(done.stdout)["notes"]
        assert sum(f"left out: band {other}" in note for note in notes) == 1
        assert printed == (band == 1)  # as a warning
    else:
        assert printed == 1
