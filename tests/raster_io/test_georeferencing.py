"""Do rasters come back pixel for pixel where they were, in the units they had?"""

import numpy as np
import pytest
import rasterio
from rasterio.crs import CRS
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave

# Which codec makes the file is nothing to its place.
QUICK = {"method": "store", "mesh": "none"}
HALF_METRE = Affine(0.5, 0, 412_345.678_9, 0, -0.5, 5_123_456.789_1)
GEO_KEYS, RASTER_TYPE_KEY = 34735, 1025  # GeoTIFF 1.1, GTRasterTypeGeoKey: 1 area, 2 point


def geo_tags(path):
    """Return tie point, pixel scale and raster type as the TIFF itself has them."""
    from PIL import Image

    with Image.open(path) as image:
        keys = np.reshape(image.tag_v2[GEO_KEYS], (-1, 4))
        (raster_type,) = (key[3] for key in keys if key[0] == RASTER_TYPE_KEY)
        return image.tag_v2[33922], image.tag_v2[33550], raster_type


@pytest.mark.parametrize(("kind", "raster_type"), [("Area", 1), ("Point", 2)])
def test_geotiff_tags_of_area_and_point_rasters_come_back(tmp_path, kind, raster_type):
    tif = write_geotiff(
        tmp_path / "a.tif",
        terrain_like(40, 40),
        crs="EPSG:32633",
        transform=HALF_METRE,
        tags={"AREA_OR_POINT": kind},
    )
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=1, **QUICK)
    terrainwave.decompress(tmp_path / "a.twz", tmp_path / "b.tif")
    expected = geo_tags(tif)
    assert expected[2] == raster_type
    assert geo_tags(tmp_path / "b.tif") == expected


@pytest.mark.parametrize("kind", ["Area", "Point"])
def test_levels_and_windows_hold_the_samples_of_the_places_they_name(tmp_path, kind):
    rows, cols = np.mgrid[:150, :140]
    plane = (3 * rows + 2 * cols).astype(np.int16)  # every level of a plane is its samples
    tif = write_geotiff(
        tmp_path / "a.tif",
        plane,
        crs="EPSG:32633",
        transform=HALF_METRE,
        tags={"AREA_OR_POINT": kind},
    )
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, block=32, **QUICK)
    target = tmp_path / "b.tif"
    terrainwave.decompress(tmp_path / "a.twz", target, window=(5, 7, 20, 30), level=-2)
    with rasterio.open(target) as part, rasterio.open(tif) as whole:
        assert part.tags()["AREA_OR_POINT"] == kind
        places = [part.xy(row, col) for row in (0, 19) for col in (0, 29)]
        expected = [int(height[0]) for height in whole.sample(places)]
        heights = part.read(1)
        found = [int(heights[row, col]) for row in (0, 19) for col in (0, 29)]
        assert found == expected
        # By hand: sample (5, 7) of the half level is sample (10, 14) of the full one.
        assert expected[0] == 3 * 10 + 2 * 14


@pytest.mark.parametrize(
    ("crs", "units"),
    [
        ("EPSG:2230+6360", "US survey foot"),  # California zone 6, NAVD88 height (ftUS)
        ("EPSG:2225+8228", "foot"),  # NAVD88 height (ft), international feet
        ("EPSG:32633+5773", "metre"),  # UTM, EGM96 height
    ],
)
def test_vertical_crs_and_its_unit_come_back(tmp_path, crs, units):
    tif = write_geotiff(tmp_path / "a.tif", terrain_like(9, 9), crs=crs, transform=HALF_METRE)
    terrainwave.compress(tif, tmp_path / "a.twz", max_error=0, **QUICK)
    terrainwave.decompress(tmp_path / "a.twz", tmp_path / "b.tif")
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        assert terrain.info().units == units  # GDAL takes it from the vertical CRS
    with rasterio.open(tif) as first, rasterio.open(tmp_path / "b.tif") as second:
        assert first.crs.to_wkt() == second.crs.to_wkt()
        assert first.crs == CRS.from_user_input(crs)
        assert second.units == (units,)


def test_bound_and_heights_are_in_feet_where_the_raster_is(tmp_path):
    heights = terrain_like(40, 40, "float32")
    tif = write_geotiff(tmp_path / "a.tif", heights, units=("ft",), transform=HALF_METRE)
    result = terrainwave.compress(tif, tmp_path / "a.twz", max_error=0.5, **QUICK)
    assert (result.units, result.max_error) == ("ft", 0.5)
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        assert np.abs(terrain.read().astype(np.float64) - heights).max() <= 0.5
