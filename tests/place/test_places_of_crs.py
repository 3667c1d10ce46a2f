"""Where everything lies that a raster becomes, for many systems; expected by pyproj directly."""

import io
import math
import warnings

import numpy as np
import pyproj
import pytest
import rasterio
from place.crs_cases import CASES, N_COLS, N_ROWS, Case, plane
from quantized_mesh import read_tile
from twz import twz_bytes

from terrainwave.errors import InvalidHeightsError, TerrainwaveWarning
from terrainwave.export.frames import areas, to_frame
from terrainwave.globe.cesium import TilePyramid
from terrainwave.globe.lonlat import Globe
from terrainwave.globe.terrain_rgb import max_zoom, rgb_tile
from terrainwave.place.ellipsoid import EARTH
from terrainwave.render.scene.frame import frame_of
from terrainwave.terrain import Terrain

# Samples: PROJ's iterations, and what its datum shifts lose on the way back.
_CLOSE = 1e-3
# Rows and columns of places that are looked at.
_STEP_AT = (
    np.array([0.0, 3.0, 11.0, 16.0, 22.5, 32.0]),
    np.array([0.0, 20.0, 7.25, 40.0, 3.0, 40.0]),
)


def of_all(test):
    return pytest.mark.few(10)(
        pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)(test)
    )


def of_some(test):
    """Meshes and frames, of a third: where samples lie is tested of all."""
    return pytest.mark.few(5)(
        pytest.mark.parametrize("case", CASES[::3], ids=lambda case: case.name)(test)
    )


@pytest.fixture(autouse=True)
def _notes_are_tested_elsewhere():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        yield


def made(crs, transform, heights, units=None):
    options = {} if crs is None else {"crs": crs}
    # In memory: a GeoTIFF does not hold each of these systems.
    with rasterio.open(
        "", "w+", driver="MEM", height=heights.shape[0], width=heights.shape[1], count=1,
        dtype="float32", transform=rasterio.Affine(*transform), **options,
    ) as dataset:  # fmt: skip
        dataset.write(heights.astype(np.float32), 1)
        if units:
            dataset.units = (units,)
        data = twz_bytes(dataset, max_error=0, mesh="none")
    return Terrain(io.BytesIO(data), threads=1)


_TERRAINS = {}


def terrain_of(case):
    if case.name not in _TERRAINS:
        rows, cols = np.mgrid[:N_ROWS, :N_COLS]
        _TERRAINS[case.name] = made(case.crs, case.transform, plane(rows, cols))
    return _TERRAINS[case.name]


def inside(rows, cols, by=0.0):
    return (rows >= by) & (rows <= N_ROWS - 1 - by) & (cols >= by) & (cols <= N_COLS - 1 - by)


@of_all
def test_heights_are_sampled_where_the_affine_says(case):
    terrain, (rows, cols) = terrain_of(case), _STEP_AT
    found = terrain.sample(np.column_stack(case.xy(rows, cols)))
    expected = np.where(inside(rows, cols), plane(rows, cols), np.nan)
    # on the outermost samples rounding decides which side a place is on
    strictly = inside(rows, cols, 1e-6)
    np.testing.assert_allclose(found[strictly], expected[strictly], atol=1e-4)


@of_all
def test_samples_of_a_coarse_level_lie_where_they_lay(case):
    terrain = terrain_of(case)
    heights = terrain.read(level=-2)
    a, b, c, d, e, f = terrain.transform_of(-2)[:6]
    rows, cols = (axis.ravel() for axis in np.mgrid[: heights.shape[0], : heights.shape[1]])
    x, y = a * (cols + 0.5) + b * (rows + 0.5) + c, d * (cols + 0.5) + e * (rows + 0.5) + f
    np.testing.assert_allclose(case.xy(2 * rows, 2 * cols), (x, y), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(heights.ravel(), plane(2 * rows, 2 * cols), atol=1e-4)


@of_all
def test_the_globe_is_of_the_right_body(case):
    globe = Globe(terrain_of(case))
    assert globe.body == case.body
    if case.body == "earth":
        assert globe.ellipsoid == EARTH
    else:
        ellipsoid = pyproj.CRS.from_user_input(case.globe).ellipsoid
        polar = globe.ellipsoid.axis * math.sqrt(1 - globe.ellipsoid.e2)
        assert globe.ellipsoid.axis == pytest.approx(ellipsoid.semi_major_metre, abs=1e-3)
        assert polar == pytest.approx(ellipsoid.semi_minor_metre, abs=1e-3)


@of_all
def test_samples_lie_at_proj_s_longitudes_and_latitudes(case):
    globe = Globe(terrain_of(case))
    rows, cols = (axis.ravel().astype(float) for axis in np.mgrid[:N_ROWS:8, :N_COLS:8])
    lon, lat = case.lonlat(rows, cols)
    found_lon, found_lat = globe.from_samples(rows, cols)
    geod = pyproj.CRS.from_user_input(case.globe).get_geod()
    assert np.max(geod.inv(lon, lat, found_lon, found_lat)[2]) < 1e-3 * globe.pixel
    for turns in (0, 360, -360):
        back = np.array(globe.to_samples(lon + turns, lat))
        np.testing.assert_allclose(back, [rows, cols], atol=_CLOSE)


@of_all
def test_bounds_hold_all_samples_and_little_else(case):
    globe = Globe(terrain_of(case))
    corners = np.mgrid[-0.5 : N_ROWS - 0.5 : 67j, -0.5 : N_COLS - 0.5 : 83j]
    lon, lat = case.lonlat(*(axis.ravel() for axis in corners))
    west, south, east, north = globe.extent
    slack = 1e-3 * (north - south)
    assert (lat >= south - slack).all()
    assert (lat <= north + slack).all()
    beyond = np.mod(lon - west + slack, 360)
    assert (beyond <= east - west + 2 * slack).all()
    if case.name != "north_pole":
        assert north - south == pytest.approx(np.ptp(lat), rel=0.01)
        assert east - west == pytest.approx(np.ptp(np.mod(lon - west + 180, 360)), rel=0.01)


@of_some
def test_terrain_rgb_has_the_heights_of_its_pixels(case):
    from PIL import Image

    globe = Globe(terrain_of(case))
    z, (lon, lat) = max_zoom(globe), np.ravel(case.lonlat(N_ROWS / 2, N_COLS / 2))
    x = (lon + 180) % 360 / 360 * 2**z
    y = (1 - math.asinh(math.tan(math.radians(lat))) / math.pi) / 2 * 2**z
    if abs(lat) > 85.05:  # Web Mercator ends there
        assert rgb_tile(globe, z, int(x), 0) is None
        return
    tile = rgb_tile(globe, z, int(x), int(y))
    pixels = np.asarray(Image.open(io.BytesIO(tile.image))).astype(np.int64)
    codes = pixels[..., 0] << 16 | pixels[..., 1] << 8 | pixels[..., 2]
    at = (np.arange(256) + 0.5) / 256
    mercator = np.pi * (1 - 2 * (int(y) + at) / 2**z)
    lons, lats = np.meshgrid(
        (int(x) + at) / 2**z * 360 - 180, np.degrees(np.arctan(np.sinh(mercator)))
    )
    rows, cols = (np.reshape(axis, lons.shape) for axis in case.samples(lons.ravel(), lats.ravel()))
    within = inside(rows, cols, 0.01)
    assert within.sum() > 20
    expected = plane(rows, cols) * case.metres
    found = -10000 + codes / 10
    assert np.abs(found - expected)[within].max() <= 0.05 + 0.01


@of_some
def test_cesium_tiles_have_the_heights_of_their_vertices(case):
    globe = Globe(terrain_of(case))
    pyramid = TilePyramid(globe, void_height=globe.height_range[0])
    zoom, (lon, lat) = pyramid.max_zoom, np.ravel(case.lonlat(N_ROWS / 2, N_COLS / 2))
    size = 180 / 2**zoom
    x, y = int((lon + 180) % 360 / size), int((lat + 90) / size)
    tile = pyramid.tile(zoom, x, y)
    header, u, v, h, *_ = read_tile(tile.data)
    lons, lats = -180 + (x + u / 32767) * size, -90 + (y + v / 32767) * size
    heights = header["low"] + h / 32767 * (header["high"] - header["low"])
    rows, cols = case.samples(lons, lats)
    within = inside(rows, cols, 2.0)
    assert within.sum() > 3
    expected = plane(rows, cols) * case.metres
    assert np.abs(heights - expected)[within].max() < 1.0


_MESHES = {}


def mesh_of(case):
    if case.name not in _MESHES:
        _MESHES[case.name] = terrain_of(case).mesh(max_error=0.01)
    return _MESHES[case.name]


def vertices(case, mesh):
    """Return rows, columns and heights of a native mesh's vertices, by the affine alone."""
    x, y, z = mesh.points.T
    a, b, c, d, e, f = case.transform
    det = a * e - b * d
    rows = (a * (y - f) - d * (x - c)) / det - 0.5
    cols = (e * (x - c) - b * (y - f)) / det - 0.5
    return rows, cols, z


@of_some
def test_geocentric_meshes_lie_where_proj_s_cartesian_coordinates_do(case):
    mesh = mesh_of(case)
    rows, cols, heights = vertices(case, mesh)
    ellipsoid = pyproj.CRS.from_user_input(case.globe).ellipsoid
    cart = pyproj.Transformer.from_pipeline(
        f"+proj=cart +a={ellipsoid.semi_major_metre} +b={ellipsoid.semi_minor_metre}"
    )
    lon, lat = case.lonlat(rows, cols)
    expected = cart.transform(np.radians(lon), np.radians(lat), heights * case.metres, radians=True)
    found = to_frame(mesh, "ecef")
    assert np.abs(found.points - np.transpose(expected)).max() < 0.01
    corners = found.points[found.triangles]
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((outwards * corners[:, 0]).sum(axis=1) > 0).all()


@of_some
def test_local_meshes_have_the_earths_distances_and_directions(case):
    mesh = mesh_of(case)
    rows, cols, heights = vertices(case, mesh)
    local = to_frame(mesh, "local")
    np.testing.assert_allclose(local.points[:, 2], heights * case.metres, atol=1e-6)
    _like_the_ground(case, rows, cols, local.points[:, :2])
    assert (areas(local) > 0).all()


def _like_the_ground(case, rows, cols, local):
    """Compare local metres with geodesics from the raster's middle; maps stretch by a few %."""
    geod = pyproj.CRS.from_user_input(case.globe).get_geod()
    middle = np.ravel(case.lonlat((N_ROWS - 1) / 2, (N_COLS - 1) / 2))
    lon, lat = case.lonlat(rows, cols)
    start = np.full_like(lon, middle[0]), np.full_like(lat, middle[1])
    azimuth, _, distance = geod.inv(*start, lon, lat)
    length = np.hypot(*local.T)
    far = distance > distance.max() / 4
    stretch = length[far] / distance[far]
    own = _stretch_of_the_map(case, middle)
    assert stretch.min() > 0.94 * own[0]
    assert stretch.max() < 1.06 * own[1]
    if not case.is_curved:
        off = np.degrees(np.arctan2(local[far, 0], local[far, 1])) - azimuth[far]
        assert np.abs((off + 180) % 360 - 180).max() < 8


def _stretch_of_the_map(case, middle):
    """Return the smallest and largest scale of a projection, as PROJ tells it; 1 for degrees."""
    if case.flat.is_geographic:
        return 1.0, 1.0
    flat = case.flat.source_crs if case.flat.is_bound else case.flat
    base = flat.geodetic_crs
    own = pyproj.Transformer.from_crs(case.globe, base, always_xy=True).transform(*middle)
    factors = pyproj.Proj(flat).get_factors(*own)
    return factors.tissot_semiminor, factors.tissot_semimajor


@of_some
def test_the_viewer_s_frame_goes_to_the_ground_and_back(case):
    terrain = terrain_of(case)
    frame = frame_of(terrain)
    rows, cols = (axis.ravel().astype(float) for axis in np.mgrid[:N_ROWS:8, :N_COLS:8])
    points = np.column_stack([*case.xy(rows, cols), plane(rows, cols)])
    local = frame.to_local(points)
    np.testing.assert_allclose(local[:, :2], frame.samples_to_local(rows, cols), atol=1e-3)
    np.testing.assert_allclose(frame.to_world(local), points, rtol=1e-12, atol=1e-6)
    _like_the_ground(case, rows, cols, local[:, :2])
    assert frame.body == case.body
    if not case.is_curved:
        _, lat = case.lonlat(rows, cols)
        assert frame.latitudes == pytest.approx((lat.min(), lat.max()), abs=np.ptp(lat) / 2)
        assert frame.latitudes[0] < frame.latitudes[1]


def test_degrees_without_a_crs_are_guessed_on_the_globe():
    case = Case("none", "EPSG:4326", (10.2, 46.1), 1 / 1200)
    rows, cols = np.mgrid[:N_ROWS, :N_COLS]
    globe = Globe(made(None, case.transform, plane(rows, cols)))
    np.testing.assert_allclose(globe.to_samples(*case.lonlat([3.0], [5.0])), [[3.0], [5.0]])


def test_metres_without_a_crs_have_no_place_on_the_globe():
    terrain = made(None, (30, 0, 5e5, 0, -30, 5e6), np.ones((9, 9)))
    with pytest.raises(InvalidHeightsError, match="no coordinate reference system"):
        Globe(terrain)
    assert to_frame(terrain.mesh(max_error=1.0)).attributes["frame"]["name"] == "native"


@pytest.mark.parametrize("crs", ['LOCAL_CS["a quarry",UNIT["metre",1]]', "EPSG:4978"])
def test_a_system_without_longitudes_is_refused_in_one_line(crs):
    terrain = made(crs, (30, 0, 5e5, 0, -30, 5e6), np.ones((9, 9)))
    with pytest.raises(InvalidHeightsError, match="no longitudes and latitudes behind it") as told:
        assert Globe(terrain).extent
    assert "\n" not in str(told.value)


def test_a_projection_that_proj_does_not_know_is_refused_in_one_line():
    terrain = made("EPSG:3053", (30, 0, 5e5, 0, -30, 5e6), np.ones((9, 9)))
    with pytest.raises(InvalidHeightsError, match="PROJ has no way") as told:
        assert Globe(terrain).extent
    assert "\n" not in str(told.value)


def test_a_radius_makes_another_body_of_degrees():
    case = next(case for case in CASES if case.name == "wgs84")
    globe = Globe(terrain_of(case), radius=3396190.0)
    assert (globe.body, globe.ellipsoid) == ("mars", (3396190.0, 0.0))
    np.testing.assert_allclose(globe.to_samples(*case.lonlat([3.0], [5.0])), [[3.0], [5.0]])


_OTHER_SPHERES = ("modis_sinusoidal", "rotated_pole_cf", "rotated_pole_south_up")


@pytest.mark.full
def test_a_sphere_taken_for_the_earth_is_told_and_nothing_else_is():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for case in CASES:
            is_sphere = case.name.endswith("_sphere") or case.name in _OTHER_SPHERES
            if case.metres < 0:
                continue  # told for another reason
            if is_sphere and case.body == "earth":
                with pytest.warns(TerrainwaveWarning, match="latitudes are kept as they are"):
                    Globe(terrain_of(case))
            else:
                Globe(terrain_of(case))
