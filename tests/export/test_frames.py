"""Frames: metres of degrees, feet, geocentric coordinates; numbers by hand or from geodesy."""

import math

import numpy as np
import pytest
from rasterio.crs import CRS
from tri.meshes import grid_mesh, hills

from terrainwave.errors import InvalidHeightsError, TerrainwaveWarning
from terrainwave.export.frames import areas, steepest, to_frame
from terrainwave.export.mesh import Mesh
from terrainwave.place.ellipsoid import EARTH

UTM = (30.0, 0.0, 400000.0, 0.0, -30.0, 4000000.0)
SECONDS = (1 / 3600, 0.0, 10.0, 0.0, -1 / 3600, 45.0)


def degrees(**options):
    return grid_mesh(hills(9, 11), SECONDS, crs="EPSG:4326", units="m", **options)


def extent(mesh):
    return mesh.points.max(axis=0) - mesh.points.min(axis=0)


def test_degrees_become_metres_of_east_and_north():
    local = to_frame(degrees())
    meridian, normal = EARTH.radii(45 - 4.5 / 3600)
    second = math.radians(1 / 3600)
    width = 10 * second * normal * math.cos(math.radians(45 - 4.5 / 3600))
    assert extent(local)[:2] == pytest.approx([width, 8 * second * meridian], rel=1e-9)


def test_local_coordinates_are_counted_from_the_middle():
    local = to_frame(degrees())
    low, high = local.points.min(axis=0), local.points.max(axis=0)
    assert (low + high)[:2] == pytest.approx([0, 0], abs=1e-6)
    assert local.attributes["frame"]["centre"] == pytest.approx([10 + 5.5 / 3600, 45 - 4.5 / 3600])


@pytest.mark.parametrize(("crs", "frame"), [("EPSG:4326", "local"), ("EPSG:32633", "native")])
def test_the_default_is_local_for_degrees_and_native_else(crs, frame):
    mesh = grid_mesh(hills(3, 3), SECONDS, crs=crs)
    assert to_frame(mesh).attributes["frame"]["name"] == frame


@pytest.mark.parametrize("frame", ["local", "ecef"])
def test_feet_become_metres_and_the_error_stays_in_feet(frame):
    feet = grid_mesh(3 * hills(5, 5), SECONDS, crs="EPSG:4326", units="foot", error=4.0)
    metres = grid_mesh(3 * 0.3048 * hills(5, 5), SECONDS, crs="EPSG:4326", units="m")
    found = to_frame(feet, frame)
    np.testing.assert_allclose(found.points, to_frame(metres, frame).points, rtol=0, atol=1e-8)
    of_globe = found.attributes.get("sag", 0.0) / 0.3048
    assert (of_globe > 0) == (frame == "ecef")
    assert found.error == 4.0 + of_globe


def test_z_scale_multiplies_heights():
    mesh = grid_mesh(hills(4, 5), UTM, crs="EPSG:32633")
    for frame in ("native", "local"):
        found = to_frame(mesh, frame, z_scale=2.5).points[:, 2]
        np.testing.assert_allclose(found, 2.5 * mesh.points[:, 2])


@pytest.mark.parametrize("transform", [SECONDS, (1 / 3600, 0, 10, 0, 1 / 3600, 45)])
@pytest.mark.parametrize("frame", ["local", "native"])
def test_triangles_stay_counter_clockwise(transform, frame):
    mesh = grid_mesh(hills(5, 6), transform, crs="EPSG:4326")
    assert (areas(to_frame(mesh, frame)) > 0).all()


def test_ecef_triangles_face_outwards():
    found = to_frame(degrees(), "ecef")
    corners = found.points[found.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normals * corners.mean(axis=1)).sum(axis=1) > 0).all()


def test_ecef_agrees_with_proj():
    from rasterio.warp import transform

    mesh = degrees()
    x, y, z = transform(CRS.from_epsg(4979), CRS.from_epsg(4978), *mesh.points.T)
    np.testing.assert_allclose(
        to_frame(mesh, "ecef").points, np.array([x, y, z]).T, rtol=0, atol=1e-5
    )


MOON = (
    'GEOGCS["Moon 2000",DATUM["D_Moon_2000",SPHEROID["Moon_2000_IAU_IAG",1737400,0]],'
    'PRIMEM["Reference_Meridian",0],UNIT["degree",0.0174532925199433]]'
)


def test_a_moon_in_degrees_is_scaled_by_its_own_radius():
    mesh = grid_mesh(hills(3, 4), (0.1, 0, 10, 0, -0.1, 0.15), crs=MOON)
    assert extent(to_frame(mesh))[:2] == pytest.approx(
        [0.3 * math.radians(1737400), 0.2 * math.radians(1737400)], rel=1e-9
    )


def test_a_projection_of_mars_goes_back_to_its_own_sphere():
    mars = CRS.from_proj4("+proj=eqc +lat_ts=0 +lon_0=0 +a=3396190 +b=3396190 +units=m")
    mesh = grid_mesh(hills(3, 3), (1000, 0, 0, 0, -1000, 0), crs=mars.to_wkt(), units="m")
    distance = np.linalg.norm(to_frame(mesh, "ecef").points, axis=1)
    np.testing.assert_allclose(distance, 3396190 + mesh.points[:, 2], rtol=0, atol=1e-3)


def test_degrees_are_guessed_and_told_without_a_crs():
    mesh = grid_mesh(hills(5, 5), SECONDS)
    with pytest.warns(TerrainwaveWarning, match="on the Earth"):
        found = to_frame(mesh)
    np.testing.assert_allclose(found.points, to_frame(degrees_like(mesh)).points)


def degrees_like(mesh):
    return Mesh(mesh.vertices, mesh.triangles, mesh.origin, mesh.error, crs="EPSG:4326")


def test_a_radius_takes_the_place_of_the_earth():
    mesh = grid_mesh(hills(3, 4), (0.1, 0, 10, 0, -0.1, 0.15))
    with pytest.warns(TerrainwaveWarning, match="on a sphere of 1.7374e"):
        found = to_frame(mesh, radius=1737400)
    assert extent(found)[0] == pytest.approx(0.3 * math.radians(1737400), rel=1e-9)


EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32), (0, 0, 0), 0.0)
IN_METRES = grid_mesh(hills(4, 5), UTM, crs="EPSG:32633")
AT_THE_POLE = grid_mesh(hills(3, 3), (1e-4, 0, 0, 0, -1e-4, 90.0), crs="EPSG:4326")


@pytest.mark.parametrize(
    ("mesh", "options", "message"),
    [
        *((degrees(), {"z_scale": one}, "z_scale") for one in (-1.0, 0.0, math.nan, math.inf)),
        *((degrees(), {"radius": one}, "radius") for one in (-1.0, 0.0, math.nan)),
        (IN_METRES, {"frame": "local", "radius": 1737400.0}, "not degrees"),
        (grid_mesh(hills(3, 3), UTM), {"frame": "ecef"}, "no coordinate reference system"),
        (AT_THE_POLE, {}, "longitude have no length"),
        (degrees(), {"frame": "geocentric"}, "local, native, ecef"),
        (EMPTY, {}, "empty"),
    ],
)
def test_what_no_frame_can_hold_is_refused(mesh, options, message):
    with pytest.raises(InvalidHeightsError, match=message):
        to_frame(mesh, **options)


def test_slopes_of_a_plane_are_its_own():
    row, col = np.mgrid[:3, :4]
    mesh = grid_mesh(2.0 * col - 3.0 * row, (1.0, 0, 0, 0, -1.0, 0))
    assert steepest(mesh) == pytest.approx((2.0, 3.0))
