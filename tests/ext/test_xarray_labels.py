"""What `compress` takes from the names, coordinates and attributes of xarray's objects."""

import warnings

import numpy as np
import pytest
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


@pytest.mark.parametrize("dims", [1, 4])
def test_arrays_that_are_no_raster_are_refused(dims):
    with pytest.raises(InvalidHeightsError, match="expected rows and columns"):
        read(xr.DataArray(np.zeros((3,) * dims, "i2")))


@pytest.mark.parametrize("data", [xr.Dataset(), xr.Dataset({"a": ("x", [1.0])})])
def test_dataset_without_heights_is_refused(data):
    with pytest.raises(InvalidHeightsError, match="no variable of rows and columns"):
        read(data)


def test_node_of_a_tree_is_taken_and_its_root_says_which_there_are():
    tree = xr.DataTree.from_dict({"/low": labelled().to_dataset(name="z"), "/high": xr.Dataset()})
    np.testing.assert_array_equal(read(tree["low"])[0], HEIGHTS)
    with pytest.raises(InvalidHeightsError, match="groups are low, high"):
        read(tree)


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


@pytest.mark.parametrize("dtype", ["float32", "float64", "int64"])
def test_coordinates_rounded_to_their_type_are_even(dtype):
    numbers = np.arange(50, dtype=dtype) * (1 if dtype == "int64" else np.dtype(dtype).type(0.1))
    array = xr.DataArray(
        np.zeros((50, 50), "i2"), dims=("y", "x"), coords={"y": numbers, "x": numbers}
    )
    assert read(array)[2].transform[0] == pytest.approx(0.1 if dtype != "int64" else 1, rel=1e-3)


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


@pytest.mark.parametrize("crs", [None, 4326])
@pytest.mark.parametrize("unit", ["rad", "radians"])
def test_radians_are_no_degrees(unit, crs):
    array = labelled(
        x_attrs={"units": unit, "standard_name": "longitude"},
        y_attrs={"units": unit, "standard_name": "latitude"},
    )
    array = array if crs is None else array.rio.write_crs(crs)
    with pytest.raises(InvalidHeightsError, match=f"is in {unit}, (and no CRS|.* deg)"):
        read(array)


@pytest.mark.parametrize("unit", ["km", "rad", "ft"])
def test_coordinates_in_another_unit_than_the_crs_are_refused(unit):
    attrs = {"units": unit, "standard_name": "projection_x_coordinate"}
    array = labelled(x_attrs=attrs).rio.write_crs(32633)
    with pytest.raises(InvalidHeightsError, match=f"x is in {unit}, the unit of its CRS is metre"):
        read(array)


def test_coordinates_that_are_no_numbers_are_refused():
    array = labelled().assign_coords(y=np.arange(N_ROWS).astype("datetime64[D]"))
    with pytest.raises(InvalidHeightsError, match=r"y is of type datetime64.*expected numbers"):
        read(array)


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


def test_several_variables_are_named_in_one_line(tmp_path):
    data = xr.Dataset({"elevation": labelled(), "slope": labelled(), "time": 3})
    with pytest.raises(InvalidHeightsError, match=r"elevation, slope;.*dataset\['elevation'\]"):
        terrainwave.compress(data, tmp_path / "a.twz")
    assert not (tmp_path / "a.twz").exists()


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


def test_crs_of_a_file_without_transform_is_dropped_with_a_note(tmp_path):
    path = write_geotiff(tmp_path / "a.tif", HEIGHTS, crs="EPSG:32633")
    _, _, info, notes = read(path)
    assert info.crs is None
    assert "no transform says where its samples lie" in notes[0]
    with pytest.warns(TerrainwaveWarning, match="no transform"):
        terrainwave.compress(path, tmp_path / "a.twz", max_error=0)
    assert terrainwave.verify(tmp_path / "a.twz", path).ok


def test_mosaic_needs_places(tmp_path):
    path = write_geotiff(tmp_path / "a.tif", HEIGHTS, transform=Affine(*TRANSFORM))
    with pytest.raises(InvalidArgumentError, match="georeference False and 2 rasters"):
        read([path, path], georeference=False)
