"""What a CRS says: ellipsoids, bodies, bases, axes, vertical parts."""

import math
import sys

import numpy as np
import pyproj
import pytest
from place.crs_cases import MOON, TOWGS84
from rasterio.crs import CRS
from rasterio.warp import transform

from terrainwave.errors import InvalidHeightsError, TerrainwaveError
from terrainwave.place.bodies import body_of_radius
from terrainwave.place.crs import format_crs
from terrainwave.place.description import describe_crs
from terrainwave.place.ellipsoid import EARTH
from terrainwave.place.position import axis_labels, place_of
from terrainwave.place.system import system_of

BOUND_TO_A_GRID = "+proj=utm +zone=33 +geoidgrids=a.gtx +vunits=us-ft"


def system(crs):
    return system_of(format_crs(CRS.from_user_input(crs)))


def test_radii_at_45_degrees_are_those_of_wgs84():
    # M and N of WGS 84 at 45 degrees, as tables of the ellipsoid give them
    assert EARTH.radii(45.0) == pytest.approx((6367381.816, 6388838.290), abs=0.001)


def test_geocentric_points_known_by_hand():
    b = 6356752.314245
    points = np.array([[0.0, 0.0, 100.0], [90.0, 0.0, 0.0], [7.0, 90.0, 10.0]])
    expected = [[6378237.0, 0, 0], [0, 6378137.0, 0], [0, 0, b + 10]]
    np.testing.assert_allclose(EARTH.geocentric(points), expected, rtol=0, atol=1e-5)


def test_the_ellipsoid_comes_from_the_crs():
    assert system(MOON).ellipsoid == (1737400.0, 0.0)
    # Clarke 1866 through NAD27: a = 6378206.4 m, b = 6356583.8 m
    axis, e2 = system("EPSG:4267").ellipsoid
    assert axis == 6378206.4
    assert axis * math.sqrt(1 - e2) == pytest.approx(6356583.8, abs=0.01)


def test_an_ellipsoid_in_feet_becomes_metres():
    wkt = (
        'GEODCRS["in feet",DATUM["D",ELLIPSOID["E",20925832,300,LENGTHUNIT["foot",0.3048]]],'
        'CS[ellipsoidal,2],AXIS["lat",north],AXIS["lon",east],'
        'ANGLEUNIT["degree",0.0174532925199433]]'
    )
    assert system(wkt).ellipsoid.axis == pytest.approx(20925832 * 0.3048, rel=1e-12)


@pytest.mark.parametrize("crs", ["EPSG:7415", TOWGS84])
def test_an_ellipsoid_is_found_within_other_systems(crs):
    # Bessel 1841: a = 6377397.155 m, 1/f = 299.1528128
    flattening = 1 / 299.1528128
    assert system(crs).ellipsoid.axis == 6377397.155
    assert system(crs).ellipsoid.e2 == pytest.approx(flattening * (2 - flattening), rel=1e-9)


def test_a_local_system_has_the_ellipsoid_of_the_earth_and_no_globe():
    local = system('LOCAL_CS["a quarry",UNIT["metre",1]]')
    assert local.ellipsoid == EARTH
    with pytest.raises(InvalidHeightsError, match="no longitudes and latitudes behind it"):
        local.to_globe(np.zeros((1, 2)))


@pytest.mark.parametrize("radius", [6.30e6, 6.325e6, 6.345e6, 6.37e6, 6.371229e6, 6.405e6, 6.43e6])
def test_a_sphere_is_the_earth_where_proj_takes_it_for_it(radius):
    # PROJ refuses to transform between bodies; its rule is 0.7 % (0.5 % in PROJ 8)
    sphere = pyproj.CRS.from_proj4(f"+proj=longlat +R={radius} +no_defs")
    try:
        pyproj.Transformer.from_crs(sphere, "EPSG:4326")
        expected = True
    except pyproj.exceptions.ProjError:
        expected = False
    assert (body_of_radius(radius) == "earth") == expected


@pytest.mark.parametrize(
    ("crs", "body"),
    [("IAU_2015:39900", "earth"), ("IAU_2015:19900", "other"), ("IAU_2015:49912", "mars"),
     ("ESRI:104903", "moon"), ("ESRI:104905", "mars"), ("EPSG:3857", "earth")],
)  # fmt: skip
def test_the_body_is_the_authority_s_or_the_radius_s(crs, body):
    assert system(crs).body == body


def test_planetocentric_latitudes_are_degrees_beside_longitudes_as_gdal_has_them():
    text, xy = "IAU_2015:49902", np.array([[10.0, 40.0], [-170.0, -60.0]])
    place = place_of(text, (0, 0, 1, 1))
    ends = CRS.from_user_input(text), CRS.from_user_input("IAU_2015:49900")
    expected = np.column_stack(transform(*ends, *xy.T))
    # GDAL gives them on the spheroid as on the sphere: tan φ = (a/b)² tan of the planetocentric one
    latitudes = np.degrees(np.arctan((3396190 / 3376200) ** 2 * np.tan(np.radians(xy[:, 1]))))
    np.testing.assert_allclose(expected, np.column_stack([xy[:, 0], latitudes]), atol=1e-9)
    np.testing.assert_allclose(place.to_lonlat(xy), expected, atol=1e-9)
    np.testing.assert_allclose(place.from_lonlat(expected), xy, atol=1e-9)
    assert place.in_degrees
    assert place.longitude_axis == 0
    assert place.local_axes(10.0, 40.0).lengths == pytest.approx((45448, 58992), rel=1e-2)


@pytest.mark.parametrize(
    ("crs", "expected"),
    [
        ("EPSG:4326", None),
        ("EPSG:2263+6360", ("NAVD88 height (ftUS)", 1200 / 3937, False, False)),
        ("EPSG:4326+5715", ("MSL depth", 1.0, True, False)),
        ("EPSG:4979", ("Ellipsoidal height", 1.0, False, True)),
        ("EPSG:7415", ("NAP height", 1.0, False, False)),
        (BOUND_TO_A_GRID, ("unknown", 1200 / 3937, False, False)),
        ('COMPD_CS["c",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
         'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],VERT_CS["Ellipsoid (metre)",'
         'VERT_DATUM["Ellipsoid",2002],UNIT["metre",1],AXIS["Up",UP]]]',
         ("Ellipsoidal height", 1.0, False, True)),
    ],
)  # fmt: skip
def test_the_vertical_part_is_told(crs, expected):
    found = describe_crs(format_crs(CRS.from_user_input(crs))).vertical
    if expected is None:
        assert found is None
        return
    assert (found.name, found.is_down, found.is_ellipsoidal) == (expected[0], *expected[2:])
    assert found.metres == pytest.approx(expected[1], rel=1e-9)


def test_without_pyproj_what_a_crs_says_is_told_and_the_globe_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    monkeypatch.setitem(sys.modules, "pyproj.exceptions", None)
    assert axis_labels("EPSG:4326") == ("longitude, degrees", "latitude, degrees")
    assert describe_crs("EPSG:4979").vertical.unit == "metre"
    with pytest.raises(TerrainwaveError, match=r'needs pyproj: pip install "terrainwave\[mesh\]"'):
        system_of("EPSG:32633")
