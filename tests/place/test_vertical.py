"""Heights above the ellipsoid: by a grid that the tests write, or not at all."""

import json
import warnings

import numpy as np
import pyproj
import pytest
import rasterio
from commands import environment, python_with
from place.grids import undulation, write_geotiff, write_gtx
from quantized_mesh import read_tile
from twz import twz_bytes

import terrainwave
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError, TerrainwaveWarning
from terrainwave.export.frames import to_frame
from terrainwave.export.quantized_mesh import on_globe
from terrainwave.globe.cesium import TilePyramid, write_tiles
from terrainwave.globe.lonlat import Globe

EGM96 = "EPSG:4326+5773"
FEET = "+proj=utm +zone=32 +datum=WGS84 +geoidgrids=test_geoid.gtx +vunits=us-ft"
DEPTH = "EPSG:4326+5715"
SURVEY_FOOT = 1200 / 3937
N = 33


@pytest.fixture
def grids(tmp_path, monkeypatch):
    """Give PROJ_DATA with the grids of EGM96 and of `FEET`."""
    before = pyproj.datadir.get_data_dir()
    folder = tmp_path / "grids"
    folder.mkdir()
    write_geotiff(folder / "us_nga_egm96_15.tif")
    write_gtx(folder / "test_geoid.gtx")
    monkeypatch.setenv("PROJ_DATA", str(folder))
    yield folder
    pyproj.datadir.set_data_dir(before)


def raster(tmp_path, crs, heights, *, place=None, nodata=None, units=None, **options):
    """Return the path of a .twz file; `place` is (pixel, left, top), by default 10.2 E, 46.1 N."""
    path = tmp_path / "dem.twz"
    if place is None:
        is_geographic = pyproj.CRS.from_user_input(crs).is_geographic
        place = (1e-3, 10.2, 46.1) if is_geographic else (90, 590000, 5105000)
    transform = rasterio.Affine(place[0], 0, place[1], 0, -place[0], place[2])
    with rasterio.open(
        "", "w+", driver="MEM", height=N, width=N, count=1, dtype=heights.dtype, crs=crs,
        transform=transform, nodata=nodata,
    ) as dataset:  # fmt: skip
        dataset.write(heights, 1)
        if units:
            dataset.units = (units,)
        path.write_bytes(twz_bytes(dataset, **{"max_error": 0} | options))
    return path


def hills(scale=1.0):
    rows, cols = np.mgrid[:N, :N]
    return ((500 + 40 * np.sin(cols / 5) + 30 * np.cos(rows / 7)) * scale).astype(np.float32)


def places(path):
    """Return longitudes and latitudes of the samples, by pyproj."""
    with terrainwave.open(path) as terrain:
        a, b, c, d, e, f = terrain.transform[:6]
        crs = terrain.crs
    cols, rows = np.meshgrid(np.arange(N) + 0.5, np.arange(N) + 0.5)
    flat = pyproj.CRS.from_user_input(crs).sub_crs_list[0]
    to_globe = pyproj.Transformer.from_crs(flat, "OGC:CRS84", always_xy=True)
    return to_globe.transform(a * cols + b * rows + c, d * cols + e * rows + f)


CASES = [(EGM96, 1.0, None), (FEET, SURVEY_FOOT, None), (FEET, 1.0, "m")]


@pytest.mark.parametrize(("crs", "metres", "units"), CASES)
def test_decompress_writes_heights_above_the_ellipsoid(grids, tmp_path, crs, metres, units):
    heights = hills()
    twz, tif = raster(tmp_path, crs, heights, units=units), tmp_path / "above.tif"
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        terrainwave.decompress(twz, tif, vertical="ellipsoid")
    assert sum("above the ellipsoid, by PROJ" in str(one.message) for one in told) == 1
    with rasterio.open(tif) as dataset:
        found, tags, units = dataset.read(1), dataset.tags(), dataset.units
        bound = float(dataset.tags(1, ns="TERRAINWAVE")["MAX_ERROR"])
        known = pyproj.CRS.from_wkt(dataset.crs.to_wkt(version="WKT2_2019"))
    expected = heights * metres + undulation(*places(twz))
    assert "TERRAINWAVE_MAX_ERROR" not in tags
    assert bound < 1e-3
    assert np.abs(found - expected).max() <= bound + 2e-5  # the grid's float32
    assert "grid" not in tags["TERRAINWAVE_VERTICAL"]
    assert any(name in tags["TERRAINWAVE_VERTICAL"] for name in ("egm96", "test_geoid"))
    assert units == ("metre",)
    assert len(known.axis_info) == 3
    assert known.axis_info[2].name == "Ellipsoidal height"


def test_converted_voids_stay_voids_and_integers_become_floats(grids, tmp_path):
    heights = hills().astype(np.int16)
    heights[5:9, 5:9] = 0
    twz, tif = raster(tmp_path, EGM96, heights, nodata=0), tmp_path / "above.tif"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        terrainwave.decompress(twz, tif, vertical="ellipsoid")
    with rasterio.open(tif) as dataset:
        found, mask = dataset.read(1), dataset.read_masks(1) != 0
    assert found.dtype == np.float32
    np.testing.assert_array_equal(mask, heights != 0)
    np.testing.assert_allclose(found[mask], (heights + undulation(*places(twz)))[mask], atol=1e-3)


def test_the_bound_of_converted_heights_holds_for_the_originals(grids, tmp_path):
    heights = hills()
    path, tif = raster(tmp_path, FEET, heights, max_error=5.0), tmp_path / "above.tif"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        terrainwave.decompress(path, tif, vertical="ellipsoid")
    with rasterio.open(tif) as dataset:
        found, bound = dataset.read(1), float(dataset.tags(1, ns="TERRAINWAVE")["MAX_ERROR"])
    errors = np.abs(found - heights * SURVEY_FOOT - undulation(*places(path)))
    assert 0.3 < errors.max() <= bound + 2e-5
    assert bound == pytest.approx(5 * SURVEY_FOOT, rel=0.01)


@pytest.mark.parametrize("cog", [False, True])
def test_the_bound_of_converted_heights_stays_in_their_file(grids, tmp_path, cog):
    path, tif = raster(tmp_path, FEET, hills()), tmp_path / "above.tif"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        terrainwave.decompress(path, tif, vertical="ellipsoid", cog=cog)
        terrainwave.compress(tif, tmp_path / "lossy.twz", max_error=20)
        terrainwave.decompress(tmp_path / "lossy.twz", tmp_path / "back.tif")
    # GDAL's writer of COGs takes no domain along.
    for name, expected in (("above.tif", not cog), ("back.tif", False)):
        with rasterio.open(tmp_path / name) as dataset:
            assert ("MAX_ERROR" in dataset.tags(1, ns="TERRAINWAVE")) == expected
            assert not any("ERROR" in tag for tag in (*dataset.tags(), *dataset.tags(1)))


def test_heights_of_a_part_of_the_bits_state_no_bound(grids, tmp_path):
    path = raster(tmp_path, EGM96, hills(), max_error=1, method="cdf53")
    tif = tmp_path / "above.tif"
    with pytest.warns(TerrainwaveWarning) as told:
        terrainwave.decompress(path, tif, vertical="ellipsoid", quality=1)
    assert not any("of the originals" in str(one.message) for one in told)
    with rasterio.open(tif) as dataset:
        assert "TERRAINWAVE" not in dataset.tag_namespaces()


@pytest.mark.parametrize(("crs", "metres", "units"), CASES)
def test_cesium_tiles_count_from_the_ellipsoid(grids, tmp_path, crs, metres, units):
    twz = raster(tmp_path, crs, hills(), units=units)
    with terrainwave.open(twz) as terrain:
        ground = Globe(terrain)
        pyramid = TilePyramid(ground, vertical="ellipsoid", void_height=500 * metres)
        zoom, (lon, lat) = pyramid.max_zoom, (ground.extent.centre)
        size = 180 / 2**zoom
        x, y = int((lon + 180) / size), int((lat + 90) / size)
        tile = pyramid.tile(zoom, x, y)
        header, u, v, h, *_ = read_tile(tile.data)
        lons, lats = -180 + (x + u / 32767) * size, -90 + (y + v / 32767) * size
        found = header["low"] + h / 32767 * (header["high"] - header["low"])
        rows, cols = ground.to_samples(lons, lats)
        known, _ = ground.heights_at(rows, cols, terrain.grid.k_max)
        within = (rows > 2) & (rows < N - 3) & (cols > 2) & (cols < N - 3)
        assert within.sum() > 5
        expected = known + undulation(lons, lats)
        # The error is that of samples; vertices between them are half a metre off at most.
        assert np.abs(found - expected)[within].max() <= tile.surface_error + 0.5
        assert tile.surface_error < 10
        assert pyramid.vertical["heights"] == "ellipsoid"
        assert pyramid.layer()["vertical"]["grids"] in (["us_nga_egm96_15.tif"], ["test_geoid.gtx"])
        # /height and terrain-RGB keep the file's datum
        assert ground.height_range[1] == pytest.approx(hills().max() * metres)


@pytest.mark.parametrize(("crs", "metres", "units"), CASES)
def test_geocentric_meshes_count_from_the_ellipsoid(grids, tmp_path, crs, metres, units):
    twz = raster(tmp_path, crs, hills(), units=units)
    with terrainwave.open(twz) as terrain:
        mesh = terrain.mesh(max_error=1.0)
        found = to_frame(mesh, "ecef", vertical="ellipsoid")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TerrainwaveWarning)
            bend = to_frame(mesh, "ecef").error - mesh.error
        flat = pyproj.CRS.from_user_input(terrain.crs).sub_crs_list[0]
    to_globe = pyproj.Transformer.from_crs(flat, "OGC:CRS84", always_xy=True)
    lon, lat = to_globe.transform(*mesh.points.T[:2])
    cart = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    expected = cart.transform(lon, lat, mesh.points[:, 2] * metres + undulation(lon, lat))
    assert np.abs(found.points - np.transpose(expected)).max() < 1e-3
    assert found.attributes["frame"]["vertical"]["heights"] == "ellipsoid"
    # a plane does not bend, but UTM's is not quite one; the globe does, and twice its bend is said
    assert mesh.error < found.error < mesh.error + 2 * bend + 0.01


def test_what_the_geoid_bends_under_triangles_is_in_the_error(tmp_path, monkeypatch, grids):
    import place.grids as module

    monkeypatch.setattr(module, "undulation", lambda lon, lat: 40 + 300 * (lon - 10) ** 2)
    write_geotiff(grids / "us_nga_egm96_15.tif")
    path = raster(tmp_path, EGM96, np.zeros((N, N), np.float32), place=(0.1, 9, 48))
    with terrainwave.open(path) as terrain:
        mesh = terrain.mesh(max_error=1.0)
        found = to_frame(mesh, "ecef", vertical="ellipsoid")
    assert found.error > mesh.error + 1.0


def test_as_is_is_the_default_with_one_note_of_the_datum(tmp_path):
    twz = raster(tmp_path, EGM96, hills())
    with terrainwave.open(twz) as terrain:
        mesh = terrain.mesh(max_error=1.0)
        with pytest.warns(TerrainwaveWarning, match="EGM96 geoid are taken for") as told:
            found = on_globe(mesh)
        assert len(told) == 1
        np.testing.assert_allclose(found.mesh.points[:, 2], mesh.points[:, 2])
        with pytest.warns(TerrainwaveWarning, match="EGM96 geoid are taken for") as told:
            write_tiles(terrain, tmp_path / "tiles", max_zoom=1)
        assert len(told) == 1
    layer = json.loads((tmp_path / "tiles" / "layer.json").read_text())
    assert layer["vertical"] == {"heights": "as-is", "datum": "EGM96 geoid"}


@pytest.mark.parametrize("crs", ["EPSG:4979", "EPSG:4937"])
def test_systems_of_three_axes_are_on_the_ellipsoid_already(tmp_path, crs):
    twz, tif = raster(tmp_path, crs, hills()), tmp_path / "above.tif"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        terrainwave.decompress(twz, tif, vertical="ellipsoid")
    with rasterio.open(tif) as dataset:
        np.testing.assert_array_equal(dataset.read(1), hills())
        assert "already" in dataset.tags()["TERRAINWAVE_VERTICAL"]
        assert dataset.crs.to_epsg() == int(crs[5:])


def test_depths_go_down(tmp_path):
    twz = raster(tmp_path, DEPTH, hills())
    with terrainwave.open(twz) as terrain:
        mesh = terrain.mesh(max_error=1.0)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found = on_globe(mesh)
        assert [str(one.message) for one in told] == [
            "the coordinate reference system counts depths downwards (MSL depth); a depth of 10"
            " becomes a height of -10",
            "heights above Mean Sea Level are taken for heights above the ellipsoid; vertical"
            " ellipsoid converts them",
        ]
        np.testing.assert_allclose(found.mesh.points[:, 2], -mesh.points[:, 2])
        with pytest.warns(TerrainwaveWarning, match="counts depths downwards"):
            local = to_frame(mesh, "local")
        np.testing.assert_allclose(local.points[:, 2], -mesh.points[:, 2])
        with pytest.warns(TerrainwaveWarning, match="counts depths downwards"):
            assert Globe(terrain).height_range[1] < 0
        with pytest.raises(InvalidHeightsError, match="numbers that count downwards, as depths do"):
            mesh.save(tmp_path / "a.stl", frame="local", solid=0.0)


def test_a_missing_grid_is_named_with_the_command_that_fetches_it(tmp_path):
    twz = raster(tmp_path, EGM96, hills())
    with pytest.raises(InvalidHeightsError) as told:
        terrainwave.decompress(twz, tmp_path / "a.tif", vertical="ellipsoid")
    message = str(told.value)
    assert "us_nga_egm96_15.tif" in message
    assert "pyproj sync --file us_nga_egm96_15.tif" in message
    assert "\n" not in message
    assert not (tmp_path / "a.tif").exists()


def test_a_second_best_operation_does_not_stand_in_for_the_best(tmp_path, grids):
    # PROJ's first way from NAP needs two files, its second one the first of them
    write_geotiff(grids / "nl_nsgi_nlgeo2018.tif")
    path = raster(tmp_path, "EPSG:7415", hills(), place=(90, 155000, 463000))
    with pytest.raises(InvalidHeightsError, match=r"PROJ's nl_nsgi_rdtrans2018\.tif to become"):
        terrainwave.decompress(path, tmp_path / "a.tif", vertical="ellipsoid")


def test_ballpark_operations_are_refused(tmp_path):
    # PROJ has nothing but a ballpark from heights of a datum that it does not know
    unknown = (
        'COMPD_CS["c",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
        'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],VERT_CS["a quarry\'s zero",'
        'VERT_DATUM["a quarry",2005],UNIT["metre",1],AXIS["Up",UP]]]'
    )
    twz = raster(tmp_path, unknown, hills())
    with terrainwave.open(twz) as terrain:
        with pytest.raises(InvalidHeightsError, match="other than ballpark ones"):
            to_frame(terrain.mesh(max_error=1.0), "ecef", vertical="ellipsoid")


def test_a_crs_without_a_vertical_datum_is_refused(tmp_path):
    twz = raster(tmp_path, "EPSG:4326", hills())
    with pytest.raises(InvalidHeightsError, match="names no vertical datum"):
        terrainwave.decompress(twz, tmp_path / "a.tif", vertical="ellipsoid")


def test_a_grid_that_ends_within_the_raster_is_told(tmp_path, grids):
    path = raster(tmp_path, EGM96, hills(), place=(0.1, 3.5, 46.1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(InvalidHeightsError, match=r"egm96_15\.tif does not cover all"):
            terrainwave.decompress(path, tmp_path / "a.tif", vertical="ellipsoid")


def test_other_frames_and_words_are_refused(tmp_path):
    twz = raster(tmp_path, EGM96, hills())
    with terrainwave.open(twz) as terrain:
        mesh = terrain.mesh(max_error=1.0)
    for frame in (None, "local", "native"):
        with pytest.raises(InvalidArgumentError, match="expected ecef"):
            to_frame(mesh, frame, vertical="ellipsoid")
    with pytest.raises(InvalidArgumentError, match="expected as-is or ellipsoid"):
        to_frame(mesh, "ecef", vertical="geoid")


def run(*args, **variables):
    return python_with(["-m", "terrainwave", *args], env=environment(**variables))


@pytest.mark.full
def test_the_commands_find_a_user_s_grid_and_say_what_heights_are(tmp_path, grids):
    twz = raster(tmp_path, EGM96, hills())
    env = {"PROJ_DATA": "", "PROJ_USER_WRITABLE_DIRECTORY": str(grids)}
    done = run("mesh", twz, tmp_path / "a.ply", "--frame", "ecef", "--vertical", "ellipsoid", **env)
    assert done.returncode == 0, done.stderr
    assert "above the ellipsoid by us_nga_egm96_15.tif" in done.stdout
    done = run(
        "tiles", twz, tmp_path / "tiles", "--vertical", "ellipsoid", "--max-zoom", "2", **env
    )
    assert "heights above the ellipsoid by us_nga_egm96_15.tif" in done.stdout
    done = run("decompress", twz, tmp_path / "a.tif", "--vertical", "ellipsoid", **env)
    assert "by PROJ" in done.stderr
    done = run("tiles", twz, tmp_path / "other")
    assert "as they are (EGM96 geoid)" in done.stdout
    assert done.stderr.count("--vertical ellipsoid converts them") == 1
