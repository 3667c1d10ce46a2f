"""What `compress` takes from the names, coordinates and attributes of xarray's objects."""

import subprocess
import sys
import warnings

import numpy as np
import pytest
import rioxarray  # registers .rio, too
import xarray as xr
from pyproj import CRS as ProjCRS
from rasterio.control import GroundControlPoint
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError, TerrainwaveWarning
from terrainwave.grid.affine import IDENTITY, coordinates
from terrainwave.raster_io.source import RasterSource

# rioxarray 0.19 multiplies transforms, which affine 3 will deprecate.
pytestmark = pytest.mark.filterwarnings("ignore:Use .@. matmul:PendingDeprecationWarning")

N_ROWS, N_COLS = 7, 5
HEIGHTS = terrain_like(N_ROWS, N_COLS)
X, Y = 500_005.0 + 10 * np.arange(N_COLS), 4_999_995.0 - 10 * np.arange(N_ROWS)
TRANSFORM = (10.0, 0.0, 500_000.0, 0.0, -10.0, 5_000_000.0)
POINTS = [GroundControlPoint(r, c, 10.0 + c, 50.0 - r) for r, c in [(0, 0), (0, 9), (9, 0)]]
LON, LAT = 10.05 + 0.1 * np.arange(N_COLS), 45.25 - 0.1 * np.arange(N_ROWS)


def labelled(
    x="x", y="y", *, heights=HEIGHTS, x_attrs=None, y_attrs=None, attrs=None, turned=False
):
    """Return rows and columns, or columns and rows, with coordinates in UTM."""
    array = xr.DataArray(
        heights,
        dims=(y, x),
        coords={x: (x, X, x_attrs or {}), y: (y, Y, y_attrs or {})},
        attrs=attrs or {},
    )
    return array.transpose(x, y) if turned else array


def read(source, **options):
    """Return all that is taken: heights, validity, info, notes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        with RasterSource(source, **options) as raster:
            info = raster.info
            return *raster.read(0, 0, info.n_rows, info.n_cols), info, raster.notes


@pytest.mark.parametrize("georeference", [True, False])
def test_depths_are_known(georeference):
    for positive, kind in (("down", "depth"), ("up", None)):
        array = labelled(attrs={"positive": positive})
        *_, info, _ = read(array, georeference=georeference)
        assert (info.heights_are, info.band_tags) == (kind, (("positive", positive),))


# Which dimension is x.

CF = {
    "axis": ({"axis": "X"}, {"axis": "Y"}),
    "standard name": (
        {"standard_name": "projection_x_coordinate"},
        {"standard_name": "projection_y_coordinate"},
    ),
    "rotated pole": ({"standard_name": "grid_longitude"}, {"standard_name": "grid_latitude"}),
    "units": ({"units": "degrees_east"}, {"units": "degrees_north"}),
    "unit of another spelling": ({"units": "degreeE"}, {"units": "degree_N"}),
}


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("names", [("a", "b"), ("nj", "ni"), ("y2", "x2"), ("time", "level")])
@pytest.mark.parametrize("signs", CF.values(), ids=CF)
def test_attributes_of_coordinates_say_which_is_x(names, signs, turned):
    x_attrs, y_attrs = signs
    array = labelled(*names, x_attrs=x_attrs, y_attrs=y_attrs, turned=turned)
    heights, _, info, notes = read(array)
    np.testing.assert_array_equal(heights, HEIGHTS)
    assert info.transform == TRANSFORM
    assert notes == ()


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    ("x", "y"),
    [
        ("x", "y"), ("lon", "lat"), ("longitude", "latitude"), ("easting", "northing"),
        ("easting_m", "northing_m"), ("nx", "ny"), ("X", "Y"), ("XDim", "YDim"), ("col", "row"),
        ("columns", "rows"), ("west_east", "south_north"), ("rlon", "rlat"), ("xc", "yc"),
    ],
)  # fmt: skip
def test_known_names_say_which_is_x(x, y, turned):
    heights, _, info, _ = read(labelled(x, y, turned=turned))
    np.testing.assert_array_equal(heights, HEIGHTS)
    assert info.transform == TRANSFORM


@pytest.mark.parametrize("turned", [False, True])
def test_rioxarray_is_believed_before_names(turned):
    # "row" and "col" the other way round.
    array = labelled("row", "col", turned=turned).rio.set_spatial_dims("row", "col")
    heights, _, info, _ = read(array.rio.write_crs(32633))
    np.testing.assert_array_equal(heights, HEIGHTS)
    assert info.transform == TRANSFORM
    assert info.crs == "EPSG:32633"


def test_attributes_are_believed_before_names():
    array = labelled("row", "col", x_attrs={"axis": "X"}, y_attrs={"axis": "Y"})
    np.testing.assert_array_equal(read(array)[0], HEIGHTS)


def test_coordinates_with_other_names_than_their_dimensions_are_found():
    array = xr.DataArray(HEIGHTS.T, dims=("i", "j"), coords={"lon": ("i", LON), "lat": ("j", LAT)})
    heights, _, info, _ = read(array)
    np.testing.assert_array_equal(heights, HEIGHTS)
    assert info.transform == pytest.approx((0.1, 0, 10, 0, -0.1, 45.3))


@pytest.mark.parametrize("with_crs", [False, True])
def test_dimensions_that_nothing_tells_are_refused_with_their_names(with_crs):
    array = labelled("a", "b")
    if with_crs:
        array = array.drop_vars(["a", "b"]).rio.write_crs(32633)
    with pytest.raises(InvalidHeightsError, match=r"b \(7\), a \(5\).*x_dim='a', y_dim='b'"):
        read(array)


def test_both_dimensions_that_call_themselves_x_are_refused():
    with pytest.raises(InvalidHeightsError, match="easting and lon both say that they are x"):
        read(labelled("lon", "easting"))
    # rioxarray believes the last of them.
    with pytest.raises(InvalidHeightsError, match=r"b \(7\), a \(5\)"):
        read(labelled("a", "b", x_attrs={"axis": "X"}, y_attrs={"axis": "x"}))


def test_position_counts_for_arrays_without_coordinates_and_crs():
    heights, _, info, notes = read(xr.DataArray(HEIGHTS, dims=("a", "b")))
    np.testing.assert_array_equal(heights, HEIGHTS)
    assert (info.transform, info.crs, notes) == (read(HEIGHTS)[2].transform, None, ())


@pytest.mark.full
def test_names_are_known_without_rioxarray(tmp_path):
    """rioxarray helps where it is imported; without it the same comes out."""
    code = """
import numpy as np, sys, xarray as xr
from pyproj import CRS
from terrainwave.raster_io.source import RasterSource
mapping = xr.Variable((), 0, attrs=CRS.from_epsg(32633).to_cf() | {"GeoTransform": "x"})
for drop in ((), ("crs_wkt",)):
    attrs = {key: value for key, value in mapping.attrs.items() if key not in drop}
    array = xr.DataArray(np.zeros((3, 2), "i2"), dims=("a", "b"), coords={
        "a": ("a", [5.0, 15, 25], {"axis": "X"}), "b": ("b", [8.0, 4.0], {"axis": "Y"}),
        "utm": ((), 0, attrs)}, attrs={"grid_mapping": "utm", "missing_value": 7})
    with RasterSource(array) as source:
        info = source.info
    assert info.transform == (10, 0, 0, 0, -4, 10), info
    assert "32633" in info.crs or "UTM zone 33N" in info.crs or "unknown" in info.crs, info
    assert info.nodata == 7 and (info.n_rows, info.n_cols) == (2, 3)
assert "rioxarray" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# Which layer.


@pytest.mark.parametrize("where", [0, 1, 2])
def test_dimensions_of_length_1_are_left_out(where):
    array = labelled().expand_dims({"time": 1}, axis=where)
    heights, _, info, _ = read(array)
    np.testing.assert_array_equal(heights, HEIGHTS)
    assert info.transform == TRANSFORM


@pytest.mark.parametrize("where", [0, 1, 2])
def test_layers_of_another_dimension_are_named_in_one_line(where):
    array = xr.concat([labelled()] * 3, "time").transpose(
        *np.roll(["time", "y", "x"], where).tolist()
    )
    with pytest.raises(InvalidHeightsError, match=r"time \(3\).*array\.isel\(time=0\)") as caught:
        read(array)
    assert "\n" not in str(caught.value)


def test_first_of_several_bands_is_taken_with_a_note_and_others_are_chosen():
    array = xr.concat([labelled() + number for number in (0, 1, 2)], "band").transpose(
        "y", "x", ...
    )
    heights, _, _, notes = read(array)
    np.testing.assert_array_equal(heights, HEIGHTS)
    assert "has 3 bands; using band 1" in notes[0]
    heights, _, _, notes = read(array, band=3)
    np.testing.assert_array_equal(heights, HEIGHTS + 2)
    assert notes == ()
    with pytest.raises(InvalidArgumentError, match="found band 4, expected 1 … "):
        read(array, band=4)


def test_band_of_an_array_without_bands_is_refused():
    with pytest.raises(InvalidArgumentError, match="found band 2, expected 1"):
        read(labelled(), band=2)


def test_rows_of_one_sample_are_told_from_a_dimension_to_leave_out():
    array = labelled()[:, :1].expand_dims("time").rio.write_transform(Affine(*TRANSFORM))
    heights, _, info, _ = read(array)
    np.testing.assert_array_equal(heights, HEIGHTS[:, :1])
    assert info.transform == TRANSFORM


@pytest.mark.parametrize("dims", [1, 4])
def test_arrays_that_are_no_raster_are_refused(dims):
    with pytest.raises(InvalidHeightsError, match="expected rows and columns"):
        read(xr.DataArray(np.zeros((3,) * dims, "i2")))


# Datasets and trees.


def test_only_variable_of_a_dataset_is_taken(tmp_path):
    data = labelled().to_dataset(name="elevation")
    result = terrainwave.compress(data, tmp_path / "a.twz", max_error=0)
    assert result.measured_error == 0
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        assert terrain.raster_info.transform == TRANSFORM


def test_variables_that_describe_others_are_no_heights():
    # As netCDF files are opened without decode_coords="all".
    data = labelled(attrs={"grid_mapping": "utm"}).to_dataset(name="z")
    data["utm"] = ((), 0, ProjCRS.from_epsg(32633).to_cf())
    data["x"].attrs["bounds"] = "x_bnds"
    data["x_bnds"] = (("x", "nv"), np.zeros((N_COLS, 2)))
    data["profile"] = ("x", np.zeros(N_COLS))
    data["name"] = (("y", "x"), np.full((N_ROWS, N_COLS), "a"))
    _, _, info, notes = read(data)
    assert (info.transform, notes) == (TRANSFORM, ())
    assert "UTM zone 33N" in info.crs


def test_several_variables_are_named_in_one_line(tmp_path):
    data = xr.Dataset({"elevation": labelled(), "slope": labelled(), "time": 3})
    with pytest.raises(InvalidHeightsError, match=r"elevation, slope;.*dataset\['elevation'\]"):
        terrainwave.compress(data, tmp_path / "a.twz")
    assert not (tmp_path / "a.twz").exists()


@pytest.mark.parametrize("data", [xr.Dataset(), xr.Dataset({"a": ("x", [1.0])})])
def test_dataset_without_heights_is_refused(data):
    with pytest.raises(InvalidHeightsError, match="no variable of rows and columns"):
        read(data)


def test_dims_that_a_dataset_was_told_count():
    data = labelled("a", "b").to_dataset(name="z").rio.set_spatial_dims("a", "b")
    np.testing.assert_array_equal(read(data)[0], HEIGHTS)


def test_node_of_a_tree_is_taken_and_its_root_says_which_there_are():
    tree = xr.DataTree.from_dict({"/low": labelled().to_dataset(name="z"), "/high": xr.Dataset()})
    np.testing.assert_array_equal(read(tree["low"])[0], HEIGHTS)
    with pytest.raises(InvalidHeightsError, match="groups are low, high"):
        read(tree)


# Where.


def mercator(n):
    return np.degrees(np.arctan(np.sinh(np.linspace(1.2, 0.2, n))))


def gaussian(n):
    return np.degrees(np.arcsin(np.polynomial.legendre.leggauss(n)[0]))


UNEVEN = {
    "Mercator rows": mercator(N_ROWS),
    "Gaussian rows": gaussian(N_ROWS),
    "a gap": np.array([1.0, 2, 3, 5, 6, 7, 8]),
    "one number wrong": np.array([1.0, 2, 3, 4.2, 5, 6, 7]),
    "not in order": np.array([1.0, 3, 2, 4, 5, 6, 7]),
    "all the same": np.full(N_ROWS, 3.0),
    "NaN": np.array([1.0, 2, np.nan, 4, 5, 6, 7]),
    "infinite": np.array([1.0, 2, np.inf, 4, 5, 6, 7]),
}


@pytest.mark.parametrize("with_crs", [False, True])
@pytest.mark.parametrize("side", ["lat", "lon"])
@pytest.mark.parametrize("uneven", UNEVEN.values(), ids=UNEVEN)
def test_uneven_coordinates_are_refused_or_taken_without_place_and_crs(uneven, side, with_crs):
    other = {"lat": "lon", "lon": "lat"}[side]
    array = xr.DataArray(
        terrain_like(N_ROWS, 4), dims=(side, other), coords={side: uneven, other: [1.0, 2, 3, 4]}
    )
    if with_crs:
        array = array.rio.set_spatial_dims("lon", "lat").rio.write_crs(4326)
    with pytest.raises(InvalidHeightsError, match=f"{side} is not evenly") as caught:
        read(array)
    assert "georeference=False" in str(caught.value)
    _, _, info, _ = read(array, georeference=False)
    assert (info.crs, info.transform) == (None, (1, 0, 0, 0, 1, 0))


def test_largest_deviation_is_stated():
    array = labelled().assign_coords(y=[0.0, 1, 2, 3.25, 4, 5, 6])
    with pytest.raises(InvalidHeightsError, match=r"up to 0\.25 pixels beside an even grid"):
        read(array)


@pytest.mark.parametrize("dtype", ["float32", "float64", "int64"])
def test_coordinates_rounded_to_their_type_are_even(dtype):
    numbers = np.arange(50, dtype=dtype) * (1 if dtype == "int64" else np.dtype(dtype).type(0.1))
    array = xr.DataArray(
        np.zeros((50, 50), "i2"), dims=("y", "x"), coords={"y": numbers, "x": numbers}
    )
    assert read(array)[2].transform[0] == pytest.approx(0.1 if dtype != "int64" else 1, rel=1e-3)


@pytest.mark.parametrize("decimals", [6, 7, 8])
def test_coordinates_rounded_to_decimals_are_even(decimals):
    numbers = np.round(10 + np.arange(500) / 3600, decimals)
    array = xr.DataArray(
        np.zeros((500, 500), "i2"), dims=("y", "x"), coords={"y": numbers, "x": numbers}
    )
    assert read(array)[2].transform[0] == pytest.approx(1 / 3600, rel=1e-4)


@pytest.mark.few(1)
@pytest.mark.parametrize("n", [7, 16, 32, 64, 128, 320])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_gaussian_rows_are_no_grid_however_nearly_they_are(n, dtype):
    for lat in (gaussian(n), np.round(gaussian(n), 3)):
        array = xr.DataArray(
            np.zeros((n, 2), "i2"), dims=("lat", "lon"),
            coords={"lat": lat.astype(dtype), "lon": [0.0, 1.0]},
        )  # fmt: skip
        with pytest.raises(InvalidHeightsError, match="lat is not evenly"):
            read(array)


def test_arc_seconds_of_float32_at_the_antimeridian_are_even():
    # A spacing of float32 there is 5 % of the pixel.
    numbers = (179 + np.arange(3600) / 3600).astype("float32")
    array = xr.DataArray(
        np.zeros((1, 3600), "i2"), dims=("lat", "lon"), coords={"lon": numbers, "lat": [0]}
    )
    array = array.isel(lat=[0, 0]).assign_coords(lat=[1.0, 0.0])
    assert read(array)[2].transform[0] == pytest.approx(1 / 3600, rel=1e-4)


def test_step_of_a_few_digits_gives_the_same_coordinates_again(tmp_path):
    """Joined with what it was made of, the file loses no sample."""
    lon, lat = 10.05 + np.arange(60) * 0.1, 47.3 - np.arange(40) * (1 / 1200)
    array = xr.DataArray(terrain_like(40, 60), dims=("lat", "lon"), coords={"lon": lon, "lat": lat})
    terrainwave.compress(array, tmp_path / "a.twz", max_error=0)
    with xr.open_dataset(tmp_path / "a.twz") as data:
        np.testing.assert_array_equal(data.x, lon)
        np.testing.assert_array_equal(data.y, lat)


def curvilinear(transform, shape=(N_ROWS, N_COLS), bend=0.0):
    rows, cols = np.mgrid[: shape[0], : shape[1]].astype(float)
    x, y = coordinates(transform, rows, cols)
    return x + bend * np.hypot(rows, cols) ** 2, y


@pytest.mark.parametrize(("x", "y"), [("lon", "lat"), ("xc", "yc"), ("LONGITUDE", "LATITUDE")])
def test_curvilinear_grid_is_refused_or_taken_without_place_and_crs(x, y):
    xs, ys = curvilinear((0.1, 0.02, 5, 0.03, -0.1, 50), bend=0.01)
    array = xr.DataArray(
        HEIGHTS, dims=("nj", "ni"), coords={x: (("nj", "ni"), xs), y: (("nj", "ni"), ys)}
    ).rio.write_crs(4326)
    with pytest.raises(InvalidHeightsError, match=f"{x} and {y} are not evenly .* up to "):
        read(array)
    heights, _, info, _ = read(array, georeference=False)
    np.testing.assert_array_equal(heights, HEIGHTS)
    assert (info.crs, info.transform) == (None, (1, 0, 0, 0, 1, 0))


@pytest.mark.parametrize("turned", [False, True])
def test_places_of_each_sample_on_a_turned_grid_give_its_transform(turned):
    transform = (10.0, 2.0, 100.0, 3.0, -10.0, 200.0)
    xs, ys = curvilinear(transform)
    array = xr.DataArray(HEIGHTS, dims=("nj", "ni")).assign_coords(
        lon=(("ni", "nj"), xs.T), lat=(("nj", "ni"), ys)
    )
    array = array.transpose("ni", "nj") if turned else array
    heights, _, info, _ = read(array)
    expected = (2.0, 10.0, 100.0, -10.0, 3.0, 200.0) if turned else transform
    np.testing.assert_array_equal(heights, HEIGHTS.T if turned else HEIGHTS)
    assert info.transform == pytest.approx(expected)


def test_longitudes_of_each_sample_are_no_place_in_a_projected_crs():
    lon, lat = curvilinear((1e-4, 0, 15, 0, -1e-4, 45))
    array = xr.DataArray(
        HEIGHTS,
        dims=("nj", "ni"),
        coords={"lon": (("nj", "ni"), lon, {"units": "degrees_east"}),
                "lat": (("nj", "ni"), lat, {"units": "degrees_north"})},
    ).rio.write_crs(32633)  # fmt: skip
    with pytest.raises(
        InvalidHeightsError, match="lon is in degrees, the unit of its CRS is metre"
    ):
        read(array)


def test_one_dimensional_places_count_before_longitudes_of_each_sample():
    lon, lat = curvilinear((0.1, 0.02, 5, 0.03, -0.1, 50), bend=0.01)
    array = labelled().assign_coords(lon=(("y", "x"), lon), lat=(("y", "x"), lat))
    assert read(array.rio.write_crs(32633))[2].transform == TRANSFORM


@pytest.mark.parametrize("crs", [None, 4326])
@pytest.mark.parametrize("unit", ["rad", "radians"])
def test_radians_are_no_degrees(unit, crs):
    array = labelled(
        x_attrs={"units": unit, "standard_name": "longitude"},
        y_attrs={"units": unit, "standard_name": "latitude"},
    )
    array = array if crs is None else array.rio.write_crs(crs)
    with pytest.raises(
        InvalidHeightsError, match=f"is in {unit}, (and no CRS|the unit of its CRS is deg)"
    ):
        read(array)


@pytest.mark.parametrize("unit", ["km", "rad", "ft"])
def test_coordinates_in_another_unit_than_the_crs_are_refused(unit):
    attrs = {"units": unit, "standard_name": "projection_x_coordinate"}
    array = labelled(x_attrs=attrs).rio.write_crs(32633)
    with pytest.raises(InvalidHeightsError, match=f"x is in {unit}, the unit of its CRS is metre"):
        read(array)


def test_crs_that_was_corrected_counts_more_than_old_attributes_of_coordinates():
    attrs = {"units": "degrees_east", "standard_name": "longitude"}
    assert read(labelled(x_attrs=attrs).rio.write_crs(32633))[2].transform == TRANSFORM


def test_crs_without_a_place_is_dropped_with_a_note():
    array = xr.DataArray(HEIGHTS, dims=("y", "x")).rio.write_crs(32633)
    _, _, info, notes = read(array)
    assert (info.crs, info.transform) == (None, (1, 0, 0, 0, 1, 0))
    assert "no transform says where the samples" in notes[0]


@pytest.mark.parametrize("place", [{}, {"gcps": POINTS}], ids=["nothing", "GCPs"])
@pytest.mark.parametrize("key", [np.s_[:, :], np.s_[2:, 1:]], ids=["whole", "cut"])
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_crs_of_a_file_without_transform_is_no_place_by_way_of_rioxarray(tmp_path, place, key):
    path = write_geotiff(tmp_path / "a.tif", terrain_like(10, 10), crs="EPSG:4326", **place)
    with rioxarray.open_rasterio(path) as array:
        _, _, info, notes = read(array[0][key])
    assert (info.crs, info.transform) == (None, (1, 0, 0, 0, 1, 0))
    assert "no transform says where the samples" in notes[0]


def test_coordinates_that_are_the_identity_are_a_place():
    coords = {"lat": 0.5 + np.arange(N_ROWS), "lon": 0.5 + np.arange(N_COLS)}
    array = xr.DataArray(HEIGHTS, dims=("lat", "lon"), coords=coords)
    array = array.rio.set_spatial_dims("lon", "lat").rio.write_crs(4326)
    assert read(array)[2].crs == "EPSG:4326"


def test_stored_transform_is_a_place():
    array = xr.DataArray(HEIGHTS, dims=("y", "x")).rio.write_crs(32633)
    _, _, info, notes = read(array.rio.write_transform(Affine(*TRANSFORM)))
    assert (info.crs, info.transform, notes) == ("EPSG:32633", TRANSFORM, ())


def test_coordinates_count_where_an_old_transform_is_nearly_theirs():
    # 1000 steps that are 0.5 % longer: 5 pixels at the end.
    array = xr.DataArray(
        np.zeros((2, 1000), "i2"),
        dims=("y", "x"),
        coords={"x": 500_005.0 + 10.05 * np.arange(1000), "y": [4_999_995.0, 4_999_985.0]},
    ).rio.write_transform(Affine(*TRANSFORM))
    assert read(array)[2].transform[0] == pytest.approx(10.05)


def test_one_row_without_a_transform_is_refused():
    with pytest.raises(InvalidHeightsError, match="one sample along y"):
        read(labelled()[:1])


def test_coordinates_that_are_no_numbers_are_refused():
    array = labelled().assign_coords(y=np.arange(N_ROWS).astype("datetime64[D]"))
    with pytest.raises(InvalidHeightsError, match=r"y is of type datetime64.*expected numbers"):
        read(array)


def test_grid_mapping_that_is_not_there_is_noted():
    _, _, info, notes = read(labelled(attrs={"grid_mapping": "crs"}))
    assert info.crs is None
    assert 'decode_coords="all"' in notes[0]


# Files whose place is no transform.


def geolocated(path, heights):
    """Return a VRT whose samples are placed by arrays of longitudes and latitudes."""
    tif = write_geotiff(path / "heights.tif", heights)
    rows, cols = np.mgrid[:10, :10]
    lon = write_geotiff(path / "lon.tif", (cols + 0.1 * rows).astype("float32"))
    lat = write_geotiff(path / "lat.tif", (rows + 0.01 * cols**2).astype("float32"))
    vrt = path / "a.vrt"
    wkt = ProjCRS.from_epsg(4326).to_wkt("WKT1_GDAL").replace('"', "&quot;")
    vrt.write_text(
        f"""<VRTDataset rasterXSize="10" rasterYSize="10"><SRS>{wkt}</SRS>
<Metadata domain="GEOLOCATION"><MDI key="X_DATASET">{lon}</MDI><MDI key="X_BAND">1</MDI>
<MDI key="Y_DATASET">{lat}</MDI><MDI key="Y_BAND">1</MDI><MDI key="PIXEL_OFFSET">0</MDI>
<MDI key="LINE_OFFSET">0</MDI><MDI key="PIXEL_STEP">1</MDI><MDI key="LINE_STEP">1</MDI></Metadata>
<VRTRasterBand dataType="Int16" band="1"><NoDataValue>-1</NoDataValue><SimpleSource>
<SourceFilename>{tif}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>""",
        encoding="utf-8",
    )
    return vrt


def with_points(path, heights):
    return write_geotiff(path / "a.tif", heights, gcps=POINTS, crs="EPSG:4326")


@pytest.mark.parametrize(
    ("make", "what"), [(geolocated, "geolocation arrays"), (with_points, "GCPs")]
)
def test_file_placed_by_points_or_arrays_loses_place_and_crs_with_a_note(tmp_path, make, what):
    path = make(tmp_path, terrain_like(10, 10))
    _, _, info, notes = read(path)
    assert (info.crs, info.transform) == (None, (1, 0, 0, 0, 1, 0))
    assert any(f"{what} are dropped" in note and "place and CRS are lost" in note for note in notes)
    with pytest.warns(TerrainwaveWarning, match="lost"):
        terrainwave.compress(path, tmp_path / "a.twz", max_error=0)
    assert terrainwave.verify(tmp_path / "a.twz", path).ok


def test_note_of_a_lost_place_is_left_out_where_it_was_asked_for(tmp_path):
    path = with_points(tmp_path, terrain_like(10, 10))
    assert read(path, georeference=False)[3] == ()


def test_crs_of_a_file_without_transform_is_dropped_with_a_note(tmp_path):
    path = write_geotiff(tmp_path / "a.tif", HEIGHTS, crs="EPSG:32633")
    _, _, info, notes = read(path)
    assert info.crs is None
    assert "no transform says where its samples lie" in notes[0]
    with pytest.warns(TerrainwaveWarning, match="no transform"):
        terrainwave.compress(path, tmp_path / "a.twz", max_error=0)
    assert terrainwave.verify(tmp_path / "a.twz", path).ok


def test_place_that_is_the_identity_is_a_place(tmp_path):
    """Northern hemisphere, degrees, from the equator up: nothing but the identity."""
    heights = terrain_like(9, 12)
    place = {"crs": "EPSG:4326", "transform": Affine.identity()}
    path = write_geotiff(tmp_path / "a.tif", heights, **place)
    terrainwave.compress(path, tmp_path / "a.twz", max_error=0)
    terrainwave.decompress(tmp_path / "a.twz", tmp_path / "b.tif")
    with rioxarray.open_rasterio(tmp_path / "b.tif") as back:
        assert back.rio.crs.to_epsg() == 4326
        assert back.rio.transform() == Affine.identity()
        assert read(tmp_path / "b.tif")[2].crs == "EPSG:4326"


def test_georeference_false_leaves_the_place_of_any_file_out(tmp_path):
    path = write_geotiff(
        tmp_path / "a.tif", HEIGHTS, crs="EPSG:32633", transform=Affine(*TRANSFORM)
    )
    terrainwave.compress(path, tmp_path / "a.twz", max_error=0, georeference=False)
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        assert terrain.crs is None
        assert terrain.transform[:6] == (1, 0, 0, 0, 1, 0)
        np.testing.assert_array_equal(terrain.read(), HEIGHTS)


def test_mosaic_needs_places(tmp_path):
    path = write_geotiff(tmp_path / "a.tif", HEIGHTS, transform=Affine(*TRANSFORM))
    with pytest.raises(InvalidArgumentError, match="georeference False and 2 rasters"):
        read([path, path], georeference=False)


# Voids.

DECLARED = {
    "rio.set_nodata": lambda array, value: array.rio.set_nodata(value),
    "rio.write_nodata": lambda array, value: array.rio.write_nodata(value),
    "_FillValue": lambda array, value: array.assign_attrs(_FillValue=value),
    "missing_value": lambda array, value: array.assign_attrs(missing_value=np.int16(value)),
    "missing values": lambda array, value: array.assign_attrs(missing_value=[value, value]),
    "nodatavals": lambda array, value: array.assign_attrs(nodatavals=(value,)),
    "nodata": lambda array, value: array.assign_attrs(nodata=value),
    "fill_value": lambda array, value: array.assign_attrs(fill_value=float(value)),
    "text": lambda array, value: array.assign_attrs(missing_value=str(value)),
    "encoding _FillValue": lambda array, value: encoded(array, _FillValue=value),
    "encoding missing_value": lambda array, value: encoded(array, missing_value=value),
}


def encoded(array, **fields):
    array.encoding |= fields
    return array


@pytest.mark.few(20)
@pytest.mark.parametrize("dtype", ["int16", "float32", "float64", "int32"])
@pytest.mark.parametrize("declare", DECLARED.values(), ids=DECLARED)
@pytest.mark.parametrize("value", [0, -9999])
def test_declared_value_marks_voids_by_whatever_name(declare, value, dtype):
    heights = (HEIGHTS + 1).astype(dtype)
    heights[2:4, 1:3] = value
    _, valid, info, notes = read(declare(labelled(heights=heights), value))
    assert info.nodata == value
    np.testing.assert_array_equal(valid, heights != value)
    assert notes == ()


def test_all_declared_values_mark_voids_and_the_first_finite_one_is_stored(tmp_path):
    heights = (HEIGHTS + 1).astype("float32")
    voids = [np.nan, -9999, 1e20, np.inf, 0]
    heights.ravel()[: len(voids)] = voids
    array = labelled(heights=heights, attrs={"_FillValue": np.nan, "missing_value": [-9999, 1e20]})
    array = encoded(array, _FillValue=np.inf, missing_value=0.0)
    with pytest.warns(TerrainwaveWarning, match=r"1e\+20, inf, 0 marks voids too"):
        result = terrainwave.compress(array, tmp_path / "a.twz", max_error=0)
    assert "the file marks all of them by -9999" in result.notes[0]
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        found, valid = terrain.read_with_mask()
        assert not valid.ravel()[: len(voids)].any()
        assert valid.sum() == heights.size - len(voids)
        assert (found[~valid] == -9999).all()


@pytest.mark.parametrize(
    ("nodata", "stored", "voids"),
    [(-9999, -9999, (0, -1, -9999)), ("only:-9999", -9999, (-9999,)), ("none", None, ())],
)
def test_nodata_that_is_asked_for_adds_to_what_is_declared_or_replaces_it(nodata, stored, voids):
    heights = HEIGHTS.copy()
    heights.ravel()[:3] = 0, -1, -9999
    array = labelled(heights=heights, attrs={"_FillValue": 0, "missing_value": -1})
    _, valid, info, _ = read(array, nodata=nodata)
    assert info.nodata == stored
    np.testing.assert_array_equal(valid, ~np.isin(heights, voids))


def test_values_that_the_type_cannot_hold_are_noted():
    array = labelled(attrs={"_FillValue": -99999, "missing_value": 0.5, "nodata": -5})
    _, _, info, notes = read(array)
    assert info.nodata == -5
    assert ["-99999" in notes[0], "0.5" in notes[1]] == [True, True]


def test_packed_fill_values_of_decoded_arrays_are_no_heights():
    # Packed 0 was void and is NaN now; a height of 0.0 is one.
    heights = (HEIGHTS * 0.1).astype("float64")
    heights[0, 0], heights[1, 1] = 0.0, np.nan
    array = encoded(labelled(heights=heights), _FillValue=0, scale_factor=0.1, add_offset=-50.0)
    _, valid, info, _ = read(array)
    np.testing.assert_array_equal(valid, ~np.isnan(heights))
    assert info.nodata is None or np.isnan(info.nodata)


RANGES = {
    "valid_range": {"valid_range": np.array([50, 150], "int16")},
    "valid_min and valid_max": {"valid_min": np.int16(50), "valid_max": np.int16(150)},
    "list": {"valid_range": [50, 150]},
}


@pytest.mark.parametrize("dtype", ["int16", "float32"])
@pytest.mark.parametrize("attrs", RANGES.values(), ids=RANGES)
def test_samples_outside_the_valid_range_are_voids(attrs, dtype):
    heights = HEIGHTS.astype(dtype)
    heights[0, :3] = 49, 50, 151
    _, valid, info, notes = read(labelled(heights=heights, attrs=attrs))
    np.testing.assert_array_equal(valid, (heights >= 50) & (heights <= 150))
    assert info.mask_kind == ("mask" if dtype == "int16" else "nan")
    assert "outside the valid range" in notes[0]


def test_one_end_of_the_valid_range_is_enough():
    _, valid, _, _ = read(labelled(attrs={"valid_min": np.int16(100)}))
    np.testing.assert_array_equal(valid, HEIGHTS >= 100)


@pytest.mark.parametrize("decoded", [False, True])
@pytest.mark.parametrize("is_wide", [False, True])
def test_valid_range_counts_in_packed_numbers_unless_its_type_is_wider(decoded, is_wide):
    """CF 1.11, 2.5.1 and 8.1."""
    packing = {"scale_factor": 0.5, "add_offset": -10.0}
    ends = np.array([20.0, 40.0]) if is_wide else np.array([60, 100], "int16")
    dtype = "float64" if decoded else "int16"
    physical = HEIGHTS * 0.5 - 10
    array = labelled(heights=(physical if decoded else HEIGHTS).astype(dtype))
    array.attrs["valid_range"] = ends
    if decoded:
        encoded(array, dtype=np.dtype("int16"), **packing)
    else:
        array.attrs |= packing
    _, valid, _, _ = read(array)
    np.testing.assert_array_equal(valid, (physical >= 20) & (physical <= 40))


def test_valid_range_beyond_the_type_and_voids_in_it_are_no_trouble():
    heights = HEIGHTS.astype("float32")
    heights[0, 0] = np.nan
    _, valid, _, _ = read(labelled(heights=heights, attrs={"valid_range": [100.0, 1e300]}))
    np.testing.assert_array_equal(valid, heights >= 100)


def test_scale_that_is_no_number_is_refused():
    with pytest.raises(InvalidHeightsError, match="scale_factor is 'half'; expected a number"):
        read(labelled(attrs={"scale_factor": "half"}))


def test_voids_of_every_kind_stay_voids_in_the_file(tmp_path):
    heights = HEIGHTS.copy()
    heights[0, :2] = 500, -7
    array = labelled(heights=heights, attrs={"valid_max": np.int16(300), "missing_value": -7})
    with pytest.warns(TerrainwaveWarning, match="valid range"):
        terrainwave.compress(array, tmp_path / "a.twz", max_error=1)
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        _, valid = terrain.read_with_mask()
        np.testing.assert_array_equal(valid, (heights <= 300) & (heights != -7))


def test_text_of_several_numbers_and_a_value_that_the_type_rounds_are_what_they_mean():
    heights = (HEIGHTS + 1).astype("float32")
    heights.ravel()[:3] = -9999, -32768, 1e20
    array = labelled(heights=heights, attrs={"missing_value": "-9999, -32768"})
    _, valid, info, notes = read(array.assign_attrs(_FillValue=1e20, nodata=np.float32(1e20)))
    np.testing.assert_array_equal(np.flatnonzero(~valid), [0, 1, 2])
    assert info.nodata == 1e20 or info.nodata == float(np.float32(1e20))
    assert notes[0].startswith("-9999, -32768 marks voids too")
    _, valid, _, _ = read(labelled(attrs={"valid_range": "100 120"}))
    np.testing.assert_array_equal(valid, (HEIGHTS >= 100) & (HEIGHTS <= 120))


@pytest.mark.parametrize("decoded", [False, True])
@pytest.mark.parametrize("end", ["valid_min", "valid_max"])
def test_one_end_of_a_packed_valid_range_counts_in_packed_numbers(decoded, end):
    packing = {"scale_factor": 0.5, "add_offset": -10.0}
    array = labelled(
        heights=(HEIGHTS * 0.5 - 10) if decoded else HEIGHTS, attrs={end: np.int16(80)}
    )
    array = encoded(array, dtype=np.dtype("int16"), **packing) if decoded else array
    array.attrs |= {} if decoded else packing
    _, valid, _, _ = read(array)
    np.testing.assert_array_equal(valid, HEIGHTS >= 80 if end == "valid_min" else HEIGHTS <= 80)


def test_numbers_without_sign_in_a_type_with_one_are_refused_until_they_are_decoded():
    attrs = {"_Unsigned": "true", "_FillValue": np.int16(-1), "valid_max": np.int16(-2)}
    packed = HEIGHTS.astype("int16")
    packed[0, :3] = -1, -2, -30_000
    dataset = labelled(heights=packed, attrs=attrs).to_dataset(name="h")
    with pytest.raises(InvalidHeightsError, match=r"_Unsigned .* int16 have no sign; expected"):
        read(dataset)
    heights, valid, info, _ = read(xr.decode_cf(dataset))
    np.testing.assert_array_equal(np.flatnonzero(~valid), [0])
    np.testing.assert_array_equal(heights[0, 1:3], [65534, 35536])
    assert info.nodata is None or info.nodata != -1


@pytest.mark.parametrize("georeference", [False, True])
def test_arrays_without_a_sample_are_refused(georeference):
    with pytest.raises(InvalidHeightsError, match=r"y \(0\), x \(5\); expected at least one"):
        read(labelled()[:0], georeference=georeference)


@pytest.mark.parametrize(
    ("x", "y"), [("nav_lon", "nav_lat"), ("XLONG", "XLAT"), ("geolon", "geolat")]
)
def test_places_of_each_sample_are_known_by_the_end_of_their_names(x, y):
    """Dropping them would lose the place without a word."""
    curved = {name: (("y", "x"), HEIGHTS.astype(float) ** 2) for name in (x, y)}
    with pytest.raises(InvalidHeightsError, match=f"{x} and {y} are not evenly spaced"):
        read(xr.DataArray(HEIGHTS, dims=("y", "x"), coords=curved))


@pytest.mark.parametrize("nodata", ["-9999", [-9999, 0], object()])
def test_nodata_that_is_no_number_is_refused(nodata):
    with pytest.raises(InvalidArgumentError, match=r"found `?nodata.*expected a number, or nan"):
        read(HEIGHTS, nodata=nodata)


@pytest.mark.parametrize(
    ("transform", "words"),
    [
        (Affine(0, 0, 5, 0, -30, 7), "puts all samples on one line or point"),
        (Affine(2, 1, 5, 4, 2, 7), "puts all samples on one line or point"),
        (Affine(0, 0, 5, 0, 0, 7), "puts all samples on one line or point"),
    ],
)
def test_a_transform_that_places_nothing_is_named(transform, words):
    array = xr.DataArray(terrain_like(9, 9), dims=("y", "x"))
    array = array.rio.write_crs("EPSG:32633").rio.write_transform(transform)
    with pytest.warns(TerrainwaveWarning, match=words) as warned, RasterSource(array) as source:
        assert (source.info.transform, source.info.crs) == (IDENTITY, None)
    assert len(warned) == 1
    assert "and the CRS with it" in str(warned[0].message)
