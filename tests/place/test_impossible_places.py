"""Coordinates that no globe has: `compress` says so, and nothing is made of them on a globe."""

import re
import warnings

import numpy as np
import pytest
import rasterio
import rioxarray  # noqa: F401
import xarray
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import InvalidHeightsError, TerrainwaveWarning
from terrainwave.export.frames import to_frame
from terrainwave.export.quantized_mesh import on_globe
from terrainwave.ext.publish import publish_site
from terrainwave.ext.serve.layers import open_layers
from terrainwave.globe.lonlat import Globe
from terrainwave.globe.stac import stac_item
from terrainwave.place.crs import format_crs
from terrainwave.place.description import impossible_places
from terrainwave.raster_io.source import RasterSource

SWAPPED = (0.01, 0, 46, 0, -0.01, 100)
SHAPE = (64, 64)
COMPOUND = format_crs(rasterio.crs.CRS.from_user_input("EPSG:4326+5773"))


@pytest.mark.parametrize(
    ("crs", "transform", "shape", "cause"),
    [
        ("EPSG:4326", SWAPPED, SHAPE, "latitudes of 99.995 degrees.*swapped"),
        ("EPSG:4979", SWAPPED, SHAPE, "swapped"),
        (COMPOUND, SWAPPED, SHAPE, "swapped"),
        ("IAU_2015:49900", SWAPPED, SHAPE, "swapped"),
        ("EPSG:4326", (0.1, 0, 8, 0, -0.1, 91), SHAPE, "90.95 degrees.*transform is wrong, or x"),
        ("EPSG:4326", (0.5, 0, -180, 0, -0.5, 92), (360, 720), "the transform is wrong: correct"),
        ("EPSG:4326", (0.5, 0, -180, 0, 0.5, -92), (360, 720), "latitudes of -91.75 degrees"),
        ("EPSG:4326", (0, 0.1, 8, 0.1, 0, 88), SHAPE, "94.35"),  # rows go east
        ("EPSG:4326", (10, 0, 5e5, 0, -10, 5e6), SHAPE, "metres or feet.*gdal_edit -a_srs"),
        ("EPSG:4326", (10, 0, 0, 0, -10, 0), SHAPE, "latitudes of -635.*metres or feet"),
        ("EPSG:4326", (1, 0, 0, 0, -1, 50), (20, 1000), "longitudes of 999.5.*metres or feet"),
        ("EPSG:4807", (0.1, 0, 0, 0, -0.1, 102), SHAPE, "latitudes of 91.755"),  # in grads
    ],
)
def test_degrees_that_no_globe_has_are_named_with_the_likely_cause(crs, transform, shape, cause):
    assert re.search(cause, impossible_places(crs, transform, shape))


@pytest.mark.parametrize(
    ("crs", "transform", "shape"),
    [
        ("EPSG:4326", (0.5, 0, -180.25, 0, -0.5, 90.25), (361, 720)),  # samples on both poles
        ("EPSG:4326", (0.5, 0, -180.25, 0, 0.5, -90.25), (361, 720)),
        ("EPSG:4326", (0.5, 0, -180, 0, -0.5, 90), (360, 720)),
        ("EPSG:4326", (0.5, 0, -180, 0, -0.5, 90.29), (361, 720)),  # within a tenth of a pixel
        ("EPSG:4326", (0.5, 0, 180, 0, -0.5, 90), (360, 720)),
        ("EPSG:4807", (0.1, 0, 0, 0, -0.1, 100), SHAPE),
        ("EPSG:32632", (10, 0, 5e5, 0, -10, 5e6), SHAPE),
        (None, (10, 0, 5e5, 0, -10, 5e6), SHAPE),
    ],
)
def test_coordinates_that_are_possible_are_not_named(crs, transform, shape):
    assert impossible_places(crs, transform, shape) is None


@pytest.fixture
def dem(tmp_path):
    place = {"crs": "EPSG:4326", "transform": Affine(*SWAPPED)}
    return write_geotiff(tmp_path / "a.tif", terrain_like(*SHAPE, "float32"), **place)


@pytest.fixture
def twz(tmp_path, dem):
    with pytest.warns(TerrainwaveWarning, match="no globe has"):
        terrainwave.compress(dem, tmp_path / "a.twz", max_error=1, method="store", mesh="none")
    return tmp_path / "a.twz"


def notes_of(source):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with RasterSource(source) as opened:
            return opened.notes


def test_every_source_of_impossible_places_is_noted_once(tmp_path, dem):
    heights = terrain_like(*SHAPE, "float32")
    beside = Affine(0.01, 0, 46.64, 0, -0.01, 100)
    other = write_geotiff(tmp_path / "b.tif", heights, crs="EPSG:4326", transform=beside)
    x, y = 46.005 + 0.01 * np.arange(64), 99.995 - 0.01 * np.arange(64)
    array = xarray.DataArray(heights, {"y": y, "x": x}, ("y", "x")).rio.write_crs("EPSG:4326")
    with rasterio.open(dem) as dataset:
        for source in (dem, dataset, [dem, other], array):
            assert sum("no globe has" in note for note in notes_of(source)) == 1


def ecef(terrain):
    to_frame(terrain.mesh(), "ecef")


@pytest.mark.parametrize(
    "make",
    [
        Globe,
        stac_item,
        ecef,
        lambda terrain: on_globe(terrain.mesh()),
        lambda terrain: terrain.explore(),
        lambda terrain: open_layers([str(terrain.name)], None, "as-is"),
        lambda terrain: publish_site([str(terrain.name)], f"{terrain.name}-site"),
    ],
    ids=["tiles", "stac", "ecef", "quantized mesh", "explore", "serve", "publish"],
)
def test_nothing_on_a_globe_is_made_of_impossible_places(twz, make):
    with (
        terrainwave.open(twz) as terrain,
        pytest.raises(InvalidHeightsError, match=r"99\.995 degrees.*swapped"),
    ):
        make(terrain)


def test_a_globe_with_samples_on_its_poles_is_silent_and_shown(tmp_path):
    heights = terrain_like(37, 72, "float32")
    place = {"crs": "EPSG:4326", "transform": Affine(5, 0, -182.5, 0, -5, 92.5)}
    path = write_geotiff(tmp_path / "a.tif", heights, **place)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        terrainwave.compress(path, tmp_path / "a.twz", max_error=1, mesh="none")
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        assert Globe(terrain).extent == (-180, -90, 180, 90)
