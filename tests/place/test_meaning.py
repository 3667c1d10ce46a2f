"""Numbers that are depths or distances from the centre: what says so, and what becomes of them."""

import io
import warnings

import numpy as np
import pytest
import rasterio
import xarray as xr
from click.testing import CliRunner
from crs_texts import sphere
from rasterio.transform import Affine
from twz import twz_bytes

import terrainwave
from terrainwave.cli import main
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError, TerrainwaveWarning
from terrainwave.export.frames import areas, to_frame
from terrainwave.export.mesh_files import add_skirts
from terrainwave.export.quantized_mesh import on_globe
from terrainwave.globe.lonlat import Globe
from terrainwave.globe.polynomials import fit_places
from terrainwave.place.ellipsoid import EARTH
from terrainwave.place.meaning import Names, told_by
from terrainwave.render.scene.frame import frame_of
from terrainwave.render.scene.measure import Ruler, read_profile
from terrainwave.render.scene.scales import HeightScale
from terrainwave.terrain import Terrain

N = 33
# Of the sea's floor, as files of hydrographers have them: 5 to 60 m, larger to the south.
DEPTHS = np.linspace(5, 60, N * N, dtype=np.float32).reshape(N, N)
DOWN = "EPSG:4326+5715"  # depths below mean sea level
MOON, MARS = sphere(1_737_400), sphere(3_396_190)
FLAT_MARS = sphere(3_396_190, 169.894447223612)  # IAU 2000
# LOLA's: height above the radius of 1,737.4 km in half metres.
LOLA = np.linspace(-3000, 6000, N * N).reshape(N, N).astype(np.int16)


def write(path, heights, *, crs="EPSG:4326", tags=None, band_tags=None, scale=1.0, offset=0.0,
          unit=None, description=None, nodata=None, driver="GTiff", col=0):  # fmt: skip
    """Write a raster around 10.2 E, 46.1 N, or columns to the east of it, and return its path."""
    n_rows, n_cols = heights.shape
    with rasterio.open(
        path, "w", driver=driver, width=n_cols, height=n_rows, count=1, dtype=heights.dtype,
        crs=crs, transform=Affine(1 / 64, 0, 10.2 + col / 64, 0, -1 / 64, 46.1), nodata=nodata,
    ) as dataset:  # fmt: skip
        dataset.write(heights, 1)
        dataset.scales, dataset.offsets = (scale,), (offset,)
        dataset.update_tags(**(tags or {}))
        dataset.update_tags(1, **(band_tags or {}))
        if unit:
            dataset.units = (unit,)
        if description:
            dataset.descriptions = (description,)
    return path


def write_netcdf(path, name="depth", heights=DEPTHS, **attributes):
    """Write a netCDF file as programs of oceanographers do."""
    data = xr.Dataset(
        {name: (("lat", "lon"), heights, {"units": "m", "grid_mapping": "crs", **attributes})},
        {
            "lat": ("lat", 54 - np.arange(N) * 0.01, {"units": "degrees_north"}),
            "lon": ("lon", 3 + np.arange(N) * 0.01, {"units": "degrees_east"}),
        },
    )
    data["crs"] = (
        (),
        0,
        {
            "grid_mapping_name": "latitude_longitude",
            "semi_major_axis": 6378137.0,
            "inverse_flattening": 298.257223563,
        },
    )
    data.to_netcdf(path, engine="scipy")
    return path


def made(source, tmp_path, **options):
    """Return the path of a .twz file of a raster, and the notes on what its numbers are."""
    path = tmp_path / "made.twz"
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        options = {"max_error": 0, "block": 32, "threads": 1, "overwrite": True} | options
        result = terrainwave.compress(source, path, **options)
    found = [note for note in result.notes if "numbers" in note]
    assert sum("numbers" in str(one.message) for one in said) == len(found)  # as often as noted
    return path, found


def opened(heights, tmp_path, *, options=None, **about):
    """Return an open terrain of a raster that says something, without its warnings."""
    source = write(tmp_path / "dem.tif", heights, **about)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        return Terrain(io.BytesIO(twz_bytes(source, **{"max_error": 0} | (options or {}))))


def quietly(call, *args, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        return call(*args, **options)


@pytest.mark.parametrize(
    ("marks", "names", "kind"),
    [
        ({"positive": "down"}, Names(), "depth"),
        ({"POSITIVE": " Down "}, Names("elevation"), "depth"),
        ({"standard_name": "depth"}, Names(), "depth"),
        ({"standard_name": "depth_below_geoid"}, Names(), "depth"),
        ({"standard_name": "sea_floor_depth_below_mean_sea_level"}, Names(), "depth"),
        ({"standard_name": "sea_floor_depth_below_geopotential_datum"}, Names(), "depth"),
        ({"NETCDF_VARNAME": "depth"}, Names(), "depth"),
        ({"NETCDF_VARNAME": "deptho", "long_name": "Sea Floor Depth"}, Names(), "depth"),
        ({}, Names("Depth"), "depth"),
        ({}, Names(title="depth"), "depth"),
        ({}, Names(title="Sea floor depth below sea level (m)"), "depth"),
        ({}, Names(title="depth", driver="S102"), "depth"),
        # what is said counts before what a name means
        ({"positive": "up", "standard_name": "depth"}, Names("depth"), None),
        ({"standard_name": "height_above_mean_sea_level"}, Names("depth"), None),
        # other depths, and heights
        ({"standard_name": "surface_snow_thickness"}, Names("depth"), None),
        ({"standard_name": "water_table_depth"}, Names(), None),
        ({"standard_name": "depth_below_sea_floor"}, Names(), None),
        ({"long_name": "snow depth"}, Names("depth"), None),
        ({"standard_name": "sea_floor_depth_below_geoid standard_error"}, Names("depth"), None),
        ({"long_name": "Maximum water depth of the flood"}, Names("depth"), None),
        ({}, Names("snow_depth"), None),
        ({}, Names("water_depth"), None),
        ({}, Names("bathymetry"), None),
        ({}, Names("elevation", "GEBCO elevation relative to sea level"), None),
        ({}, Names(title="elevation", driver="BAG"), None),
        ({}, Names("depth", has_length=False), None),
        ({}, Names(), None),
    ],
)  # fmt: skip
def test_marks_and_names_say_what_numbers_are(marks, names, kind):
    assert told_by(marks, names, "EPSG:4326").kind == kind


@pytest.mark.parametrize(
    ("marks", "names", "kind"),
    [
        ({}, Names(), None),  # the axis counts
        ({"positive": "down"}, Names(), "depth"),
        ({"positive": "up"}, Names(), "height"),
        ({}, Names(title="elevation", driver="BAG"), "height"),
        ({}, Names(title="elevation", driver="S102"), "height"),
        ({}, Names(title="uncertainty", driver="BAG"), None),
        ({"positive": "down"}, Names(title="elevation", driver="BAG"), "depth"),
        # a name adds nothing to the axis, whatever the numbers are
        ({"standard_name": "depth"}, Names("depth"), None),
    ],
)
def test_what_is_said_counts_before_an_axis_downwards(marks, names, kind):
    told = told_by(marks, names, rasterio.CRS.from_user_input(DOWN).to_wkt())
    assert (told.kind, bool(told.note)) == (kind, kind == "height")


def netcdf_of(tmp_path):
    return write_netcdf(tmp_path / "d.nc", positive="down", standard_name="depth")


SOURCES = {
    "netCDF": netcdf_of,
    "netCDF, by GDAL's name": lambda folder: f"NETCDF:{netcdf_of(folder)}:depth",
    "netCDF, by name alone": lambda folder: write_netcdf(
        folder / "d.nc", standard_name="sea_floor_depth_below_mean_sea_level"
    ),
    "xarray": lambda folder: xr.open_dataset(netcdf_of(folder), decode_coords="all"),
    "dataset": lambda folder: rasterio.open(netcdf_of(folder)),
    "band tag": lambda folder: write(folder / "d.tif", DEPTHS, band_tags={"positive": "down"}),
    "tag": lambda folder: write(folder / "d.tif", DEPTHS, tags={"positive": "down"}),
    "description": lambda folder: write(folder / "d.tif", DEPTHS, description="depth"),
    "tag and axis": lambda folder: write(
        folder / "d.tif", DEPTHS, crs=DOWN, band_tags={"positive": "down"}
    ),
}  # fmt: skip


@pytest.mark.parametrize("source", SOURCES)
def test_depths_of_all_sources_lie_below_the_sea_and_it_is_said_once(tmp_path, source):
    path, notes = made(SOURCES[source](tmp_path), tmp_path)
    (note,) = notes
    assert "its numbers are depths (" in note
    with terrainwave.open(path) as terrain:
        np.testing.assert_array_equal(terrain.read(), DEPTHS)
        assert terrain.info().heights_are == "depth"
        with pytest.warns(TerrainwaveWarning, match="a depth of 10 becomes a height of -10"):
            globe = Globe(terrain)
        assert globe.height_range == (-60, -5)


def test_what_contradicts_a_downward_axis_is_not_turned(tmp_path):
    source = write(tmp_path / "d.tif", DEPTHS, crs=DOWN, band_tags={"positive": "up"})
    path, notes = made(source, tmp_path)
    (note,) = notes
    assert "it says positive: up, but its CRS counts depths downwards (MSL depth)" in note
    with terrainwave.open(path) as terrain:
        assert terrain.info().heights_are == "height"
        assert quietly(Globe, terrain).height_range == (5, 60)


@pytest.mark.parametrize(
    ("asked", "about", "ends"),
    [
        ("depth", {}, (-60, -5)),
        ("height", {"band_tags": {"positive": "down"}}, (5, 60)),
        ("height", {"crs": DOWN}, (5, 60)),
        ("radius", {}, (5 - EARTH.axis, 60 - EARTH.axis * np.sqrt(1 - EARTH.e2))),
    ],
)
def test_what_is_asked_for_counts_and_is_kept(tmp_path, asked, about, ends):
    path, notes = made(write(tmp_path / "d.tif", DEPTHS, **about), tmp_path, heights_are=asked)
    assert notes == []
    with terrainwave.open(path) as terrain:
        assert terrain.info().heights_are == asked
        low, high = quietly(Globe, terrain).height_range
    if asked != "radius":
        assert (low, high) == ends
    else:
        assert ends[0] - 1 <= low < high <= ends[1] + 1


def test_an_unknown_word_is_refused_in_one_line(tmp_path):
    source = write(tmp_path / "d.tif", DEPTHS)
    with pytest.raises(InvalidArgumentError, match="expected height, depth, radius"):
        terrainwave.compress(source, tmp_path / "d.twz", heights_are="deep")
    done = CliRunner().invoke(main, ["compress", "--heights-are", "deep", str(source), "d.twz"])
    assert done.exit_code == 2
    assert "'deep' is not one of 'height', 'depth', 'radius'" in done.stderr


def test_a_geotiff_made_of_depths_is_of_depths(tmp_path):
    path, _ = made(netcdf_of(tmp_path), tmp_path)
    back = tmp_path / "back.tif"
    terrainwave.decompress(path, back)
    with rasterio.open(back) as dataset:
        assert dataset.tags(1)["positive"] == "down"
        np.testing.assert_array_equal(dataset.read(1), DEPTHS)
    again, _ = made(back, tmp_path)
    with terrainwave.open(again) as terrain:
        assert terrain.info().heights_are == "depth"
    assert terrainwave.verify(again, back).ok


def test_a_twz_file_of_depths_gives_depths(tmp_path):
    first, _ = made(write(tmp_path / "d.tif", DEPTHS), tmp_path, heights_are="depth")
    kept = first.rename(tmp_path / "first.twz")
    again, notes = made(kept, tmp_path)
    assert len(notes) == 1
    with terrainwave.open(again) as terrain:
        assert terrain.info().heights_are == "depth"


@pytest.fixture
def both(tmp_path):
    """Paths of a raster of depths and of one of heights beside it."""
    down = write(tmp_path / "down.tif", DEPTHS, band_tags={"positive": "down"})
    return down, write(tmp_path / "up.tif", DEPTHS)


def test_a_file_that_was_told_is_verified_and_patched_by_its_own_raster(both, tmp_path):
    for source, asked in zip(both, ("height", "depth"), strict=True):
        path, _ = made(source, tmp_path, heights_are=asked)
        assert terrainwave.verify(path, source).ok
        assert terrainwave.patch(path, source).n_recoded == 0
    path, _ = made(DEPTHS, tmp_path, heights_are="depth")
    assert terrainwave.patch(path, DEPTHS).n_recoded == 0  # plain numbers say nothing


def test_meshes_of_depths_are_those_of_the_heights_of_the_same_places(tmp_path):
    tag = {"band_tags": {"positive": "down"}}
    with (
        opened(DEPTHS, tmp_path, **tag) as down,
        opened(-DEPTHS, tmp_path) as up,
    ):
        deep, high = down.mesh(max_error=5.0), up.mesh(max_error=5.0)
    np.testing.assert_array_equal(deep.points[:, 2], -high.points[:, 2])
    for frame in ("local", "ecef"):
        with pytest.warns(TerrainwaveWarning, match="numbers are depths; a depth of 10"):
            turned = to_frame(deep, frame)
        same = to_frame(high, frame)
        np.testing.assert_allclose(turned.points, same.points, atol=1e-6)
        np.testing.assert_array_equal(turned.triangles, same.triangles)
    assert (areas(quietly(to_frame, deep, "local")) > 0).all()
    native = to_frame(deep, "native")
    np.testing.assert_array_equal(native.points, deep.points)
    tile = quietly(on_globe, deep).mesh
    np.testing.assert_allclose(tile.points, on_globe(high).mesh.points)
    saved = quietly(deep.save, tmp_path / "a.ply", frame="local", skirts=20.0)
    assert saved.n_triangles > deep.n_triangles
    hanging = quietly(to_frame, add_skirts(deep, 20.0, is_downward=True), "local")
    assert hanging.points[:, 2].min() == pytest.approx(-80)
    with pytest.raises(InvalidHeightsError, match="numbers that count downwards"):
        deep.save(tmp_path / "a.stl", frame="local", solid=100.0)


def test_views_and_profiles_of_depths_are_those_of_heights(tmp_path):
    with (
        opened(DEPTHS, tmp_path, band_tags={"positive": "down"}) as down,
        opened(-DEPTHS, tmp_path) as up,
    ):
        frame, own = quietly(frame_of, up), quietly(frame_of, down)
        np.testing.assert_allclose(own.box, frame.box)
        corners = [(10.3, 46.0), (10.5, 45.7)]
        profile = read_profile(down, Ruler(down), corners)
        other = read_profile(up, Ruler(up), corners)
    np.testing.assert_allclose(profile.upwards, other.upwards)
    assert profile.rise == pytest.approx(other.rise)
    assert profile.rise < 0
    assert profile.along_surface == pytest.approx(other.along_surface)
    assert profile.csv().splitlines()[0].endswith(",depth")


def test_depths_become_heights_above_the_ellipsoid(tmp_path):
    crs = "EPSG:4979"  # numbers are above the ellipsoid already, or below it
    path, _ = made(write(tmp_path / "d.tif", DEPTHS, crs=crs), tmp_path, heights_are="depth")
    quietly(terrainwave.decompress, path, tmp_path / "up.tif", vertical="ellipsoid")
    with rasterio.open(tmp_path / "up.tif") as dataset:
        np.testing.assert_array_equal(dataset.read(1), -DEPTHS)
        assert "positive" not in dataset.tags(1)


CASES = {
    "LOLA": (LOLA, {"crs": MOON, "scale": 0.5, "offset": 1_737_400.0}),
    "MOLA": (LOLA, {"crs": MARS, "offset": 3_396_000.0}),
    "an ellipsoid": (LOLA, {"crs": FLAT_MARS, "offset": 3_396_000.0}),
    "kilometres": ((LOLA / 1000 + 3396).astype(np.float64), {"crs": MARS, "unit": "km"}),
}


@pytest.mark.parametrize("case", CASES)
def test_radii_are_distances_from_the_centre(tmp_path, case):
    numbers, about = CASES[case]
    unit = 1000.0 if about.get("unit") == "km" else 1.0
    path, notes = made(write(tmp_path / "r.tif", numbers, **about), tmp_path)
    (note,) = notes
    assert "taken for radii" in note
    with terrainwave.open(path) as terrain:
        info = terrain.info()
        assert info.heights_are == "radius"
        mesh = terrain.mesh(max_error=1.0 / unit)
        with pytest.warns(TerrainwaveWarning, match="numbers are radii"):
            placed = to_frame(mesh, "ecef")
        np.testing.assert_allclose(
            np.linalg.norm(placed.points, axis=1), mesh.points[:, 2] * unit, atol=1e-6
        )
        globe = quietly(Globe, terrain)
        rows, cols = np.array([0.0, 7.25, 31.5]), np.array([2.0, 3.5, 20.0])
        lon, lat = globe.from_samples(rows, cols)
        heights, _ = globe.heights_at(rows, cols, terrain.grid.k_max)
        there = globe.ellipsoid.geocentric(np.column_stack([lon, lat, heights]))
        stored = numbers.astype(float) * info.scale + info.offset
        expected = [stored[0, 2], bilinear(stored, 7.25, 3.5), bilinear(stored, 31.5, 20.0)]
        np.testing.assert_allclose(np.linalg.norm(there, axis=1), np.array(expected) * unit)
        low, high = globe.height_range
        assert low <= heights.min() <= heights.max() <= high
        assert fit_places(globe).as_json(globe)["radii"] is True
        local = quietly(to_frame, mesh, "local")
        relief = float(np.ptp(stored)) * unit
        frame = quietly(frame_of, terrain)
        for z in (local.points[:, 2], np.array([frame.box[0][2], frame.box[1][2]])):
            assert np.ptp(z) == pytest.approx(relief, abs=2)
            assert np.abs(z).max() < 30_000  # no plateau of a body's radius
        middle = np.array([[10.3, 46.0, info.minimum]])
        np.testing.assert_allclose(frame.to_world(frame.to_local(middle)), middle)
        scale = HeightScale.of(terrain, frame)
        z_min, z_max = terrain.header.z_min, terrain.header.z_max
        ends = scale.metres(np.array([z_min, z_max]))
        np.testing.assert_allclose(ends, frame.height_range, atol=1e-3)
        saved = quietly(mesh.save, tmp_path / "local.ply", frame="local", overwrite=True)
        assert saved.rounding * unit < 0.01


def bilinear(values, row, col):
    r, c = int(row), int(col)
    u, v = row - r, col - c
    left = values[r, c] * (1 - u) + values[r + 1, c] * u
    return left * (1 - v) + (values[r, c + 1] * (1 - u) + values[r + 1, c + 1] * u) * v


# What meets radii of the Moon, all in float32: numbers, and what is said of them.
RELIEF = (LOLA / 2).astype(np.float32)
FAR = RELIEF + np.float32(1_737_400)
MEETS = {
    "radii": (FAR, {}),
    "heights": (RELIEF, {}),
    "depths": (-RELIEF, {"band_tags": {"positive": "down"}}),
    "zeros between": (np.where(LOLA < 0, np.float32(0), FAR), {}),
    "voids": (np.full((N, N), np.nan, np.float32), {}),
}
WIDE = {"max_error": 0.5, "height_range": (-10_000, 2_000_000)}


def moon(path, kind, **about):
    """Write a raster of `MEETS`."""
    numbers, said = MEETS[kind]
    return write(path, numbers, crs=MOON, **said | about)


def as_array(path):
    with rasterio.open(path) as dataset:
        return dataset.read(1)


def as_labelled(path):
    return xr.open_dataarray(path, engine="rasterio")[0]


def as_twz(path, **options):
    target = path.with_suffix(".twz")
    quietly(terrainwave.compress, path, target, max_error=0, block=32, threads=1, **options)
    return target


@pytest.mark.parametrize(
    ("kinds", "opened_as"),
    [
        (("radii", "heights"), str),
        (("heights", "radii"), rasterio.open),
        (("radii", "heights"), as_twz),
        (("radii", "depths"), str),
        (("depths", "radii"), as_twz),
        (("zeros between", "radii"), str),
        (("depths", "heights"), str),
        (("heights", "depths"), str),
    ],
)
def test_a_mosaic_of_several_kinds_is_refused_unless_told(tmp_path, kinds, opened_as):
    pair = [moon(tmp_path / f"{kind}.tif", kind, col=N * i) for i, kind in enumerate(kinds)]
    sources = [opened_as(path) for path in pair]
    with pytest.raises(InvalidHeightsError, match=r"found (radii|heights|depths).*, .* has "):
        made(sources, tmp_path)
    path, _ = made(sources, tmp_path, heights_are="height")
    with terrainwave.open(path) as terrain:
        assert terrain.info().heights_are == "height"


@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # of rioxarray
@pytest.mark.parametrize(
    ("own", "other", "opened_as"),
    [
        ("radii", "heights", str),
        ("radii", "heights", as_array),
        ("radii", "depths", as_labelled),
        ("radii", "zeros between", str),
        ("heights", "radii", rasterio.open),
        ("heights", "radii", as_array),
        ("depths", "radii", as_labelled),
        ("depths", "heights", str),
        ("heights", "depths", str),
    ],
)
def test_patch_and_verify_refuse_another_kind(tmp_path, own, other, opened_as):
    source, newer = moon(tmp_path / "own.tif", own), moon(tmp_path / "other.tif", other)
    path, _ = made(source, tmp_path, **WIDE)
    with pytest.raises(InvalidHeightsError, match=r"found (radii|heights|depths).*, the file has"):
        quietly(terrainwave.patch, path, opened_as(newer))
    with pytest.raises(InvalidHeightsError, match=r"found (radii|heights|depths).*, the file has"):
        quietly(terrainwave.patch, path, source, original=opened_as(newer))
    assert quietly(terrainwave.patch, path, source, original=source).n_recoded == 0
    for report in (
        terrainwave.verify(path, newer),
        terrainwave.verify(path, newer, part=True),
    ):
        assert any("numbers mean something else: found" in one for one in report.problems)
    assert terrainwave.verify(path, source).ok


def test_radii_become_heights_above_the_ellipsoid(tmp_path):
    numbers, about = CASES["MOLA"]
    path, _ = made(write(tmp_path / "r.tif", numbers, **about), tmp_path)
    quietly(terrainwave.decompress, path, tmp_path / "up.tif", vertical="ellipsoid")
    with rasterio.open(tmp_path / "up.tif") as dataset:
        np.testing.assert_allclose(dataset.read(1), LOLA + 3_396_000.0 - 3_396_190.0, atol=1e-3)


def test_a_depth_s_name_over_heights_below_the_sea_is_not_believed(tmp_path):
    heights = -DEPTHS
    heights[0, :5] = 3
    path, notes = made(write_netcdf(tmp_path / "d.nc", heights=heights), tmp_path)
    (note,) = notes
    assert "its name: depth means depths, but most numbers are below 0" in note
    with terrainwave.open(path) as terrain:
        assert terrain.info().heights_are == "height"
        assert quietly(Globe, terrain).height_range == (-60, 3)


def test_numbers_of_which_some_are_near_the_radius_are_heights_with_a_note(tmp_path):
    path, notes = made(moon(tmp_path / "z.tif", "zeros between"), tmp_path)
    assert "only some of its numbers are near the radius" in notes[0]
    with terrainwave.open(path) as terrain:
        assert terrain.info().heights_are == "height"
    path, notes = made(moon(tmp_path / "z.tif", "zeros between"), tmp_path, nodata=0)
    assert "taken for radii" in notes[0]
