"""Does a raster come back from disk as it went in, and is each fault one clear error?"""

import errno
import json
import math
import os
import shutil
import socketserver
import sys
import tempfile
import warnings
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import rasterio
from commands import python
from forks import holds_in_a_fork
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.control import GroundControlPoint
from rasterio.crs import CRS
from rasterio.rpc import RPC
from rasterio.transform import Affine
from strategies import (
    RASTER_DTYPES,
    heights_arrays,
    read_geotiff,
    terrain_like,
    valid_masks,
    write_geotiff,
)

from terrainwave.errors import (
    CorruptStreamError,
    InvalidHeightsError,
    StorageError,
    TerrainwaveWarning,
)
from terrainwave.place.crs import format_crs, parse_crs
from terrainwave.raster_io.geotiff.sink import TILE, RasterSink
from terrainwave.raster_io.raster_info import RasterInfo
from terrainwave.raster_io.source import RasterSource

MOON = (
    'GEOGCRS["Moon (2015) - Sphere",DATUM["Moon (2015) - Sphere",ELLIPSOID["Moon",1737400,0]],'
    'PRIMEM["Reference Meridian",0],CS[ellipsoidal,2],AXIS["latitude",north],'
    'AXIS["longitude",east],ANGLEUNIT["degree",0.0174532925199433]]'
)


def read_all(source):
    return source.read(0, 0, source.info.n_rows, source.info.n_cols)


def write_all(path, info, heights, valid, **options):
    with RasterSink(path, info, **options) as sink:
        for row, col, n_rows, n_cols in sink.blocks():
            part = np.s_[row : row + n_rows, col : col + n_cols]
            sink.write(row, col, heights[part], valid[part])
    return path


def file_names(folder):
    return sorted(os.listdir(folder))


@pytest.mark.few(8)
@pytest.mark.parametrize("dtype", RASTER_DTYPES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (530, 1030)])
def test_each_dtype_and_shape_comes_back(tmp_path, dtype, shape):
    heights = terrain_like(*shape, dtype)
    info = RasterInfo(*shape, dtype, mask_kind="nan" if dtype[0] == "f" else "none")
    path = write_all(tmp_path / "a.tif", info, heights, np.ones(shape, bool))
    with RasterSource(path) as source:
        found, valid = read_all(source)
        assert found.dtype == dtype
        np.testing.assert_array_equal(found, heights)
        assert valid.all()
        assert source.info.nodata is None
        assert source.info.dtype == dtype
    assert file_names(tmp_path) == ["a.tif"]


@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_any_heights_and_voids_come_back(tmp_path_factory, data):
    heights = data.draw(heights_arrays())
    valid = data.draw(valid_masks(heights.shape))
    if heights.dtype.kind == "f":
        nodata = data.draw(st.sampled_from([math.nan, -9999.5, 3e4, math.inf, None]))
    else:
        limits = np.iinfo(heights.dtype)
        nodata = data.draw(st.sampled_from([None, int(limits.min), int(limits.max)]))
    if nodata is not None:
        valid = valid & (heights != nodata)
    if heights.dtype.kind == "f" and (nodata is None or math.isnan(nodata)):
        kind = "nan"
    else:
        kind = "mask" if nodata is None else "nodata"
    info = RasterInfo(*heights.shape, heights.dtype.name, nodata=nodata, mask_kind=kind)
    path = tmp_path_factory.mktemp("any") / "a.tif"
    write_all(path, info, heights, valid)
    with RasterSource(path) as source:
        found, found_valid = read_all(source)
        np.testing.assert_array_equal(found_valid, valid)
        np.testing.assert_array_equal(found[valid], heights[valid])
        assert source.info.mask_kind == kind
        # Equal also as text, in which NaN equals NaN.
        assert repr(source.info.nodata) == repr(nodata)
    _, gdal_valid, _ = read_geotiff(path)
    if kind != "nan" or nodata is not None:
        np.testing.assert_array_equal(gdal_valid, valid)


@pytest.mark.few(8)
@pytest.mark.parametrize(
    "transform",
    [
        (30.0, 0.0, 4e5, 0.0, -30.0, 4e6),
        (30.0, 0.0, 4e5, 0.0, 30.0, 4e6),
        (20.0, 5.0, 4e5, 4.0, -31.0, 4e6),
        (1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
        (1.0, 0.0, 0.0, 0.0, -1.0, 0.0),
        (1 / 3600, 0.0, -120 - 1 / 7200, 0.0, -1 / 3600, 38 + 1 / 7200),
    ],
    ids=["north up", "south up", "rotated", "none", "flipped identity", "arc seconds"],
)
@pytest.mark.parametrize("area_or_point", ["Area", "Point"])
@pytest.mark.parametrize("cog", [False, True])
def test_transform_comes_back_with_area_or_point(tmp_path, transform, area_or_point, cog):
    heights = terrain_like(20, 30)
    source_path = write_geotiff(
        tmp_path / "a.tif",
        heights,
        transform=Affine(*transform),
        crs="EPSG:32611",
        tags={"AREA_OR_POINT": area_or_point},
    )
    with RasterSource(source_path) as source:
        info = source.info
    back = write_all(tmp_path / "b.tif", info, heights, heights == heights, cog=cog)
    with RasterSource(back) as source:
        assert source.info.transform == pytest.approx(info.transform, rel=1e-15)
        assert source.info.area_or_point == area_or_point
    if transform[:2] != (1.0, 0.0):
        assert info.transform == pytest.approx(transform, rel=1e-15)


@pytest.mark.parametrize("cog", [False, True])
def test_units_scale_offset_description_and_nodata_come_back(tmp_path, cog):
    info = RasterInfo(
        600,
        700,
        "int16",
        nodata=-32768,
        crs="EPSG:25832",
        transform=(1.0, 0.0, 3e5, 0.0, -1.0, 5e6),
        units="ft",
        scale=0.1,
        offset=-12.5,
        area_or_point="Area",
        description="höhe",
        mask_kind="nodata",
    )
    heights = terrain_like(600, 700)
    valid = heights < 150
    path = write_all(tmp_path / "a.tif", info, heights, valid, cog=cog)
    with RasterSource(path) as source:
        assert source.info == info
        np.testing.assert_array_equal(read_all(source)[1], valid)


@pytest.mark.parametrize(
    ("crs", "expected"),
    [
        ("EPSG:4326", "EPSG:4326"),
        ("EPSG:32611", "EPSG:32611"),
        ("EPSG:25832+5783", None),
        ("+proj=laea +lat_0=12.5 +lon_0=7 +R=1737400 +units=m", None),
        (MOON, None),
        (None, None),
    ],
)
def test_crs_comes_back(tmp_path, crs, expected):
    heights = terrain_like(5, 6)
    place = Affine(0.3, 0, 40, 0, -0.3, 40)
    source_path = write_geotiff(tmp_path / "a.tif", heights, crs=crs, transform=place)
    with RasterSource(source_path) as source:
        info = source.info
    back = write_all(tmp_path / "b.tif", info, heights, heights == heights)
    if expected is not None:
        assert info.crs == expected
    with RasterSource(back) as source:
        assert source.info.crs == info.crs
    with rasterio.open(source_path) as original, rasterio.open(back) as decoded:
        assert decoded.crs == original.crs
        if crs:
            assert decoded.crs.to_wkt() == original.crs.to_wkt()


def test_code_is_refused_for_a_crs_whose_ellipsoid_differs_in_the_ninth_digit():
    wkt = CRS.from_authority("ESRI", "102003").to_wkt()
    nearly = CRS.from_wkt(wkt.replace("298.257222101", "298.257222101004"))
    assert nearly.to_authority() == ("ESRI", "102003")  # the trap
    assert format_crs(CRS.from_authority("ESRI", "102003")) == "ESRI:102003"
    assert "298.257222101004" in format_crs(nearly)


def test_codes_of_inner_parts_of_a_custom_crs_are_kept():
    wkt = (
        CRS.from_epsg(32611).to_wkt().replace('"central_meridian",-117', '"central_meridian",-118')
    )
    custom = CRS.from_wkt(wkt)
    assert 'AUTHORITY["EPSG","7030"]' in custom.to_wkt()  # the ellipsoid's
    assert parse_crs(format_crs(custom)).to_wkt() == custom.to_wkt()


@pytest.mark.parametrize("layout", [{}, {"tiled": True, "blockxsize": 64, "blockysize": 128}])
def test_striped_and_tiled_sources_are_read_alike(tmp_path, layout):
    heights = terrain_like(300, 1100)
    path = write_geotiff(tmp_path / "a.tif", heights, **layout)
    with RasterSource(path) as source:
        assert source.is_striped is (not layout)
        np.testing.assert_array_equal(source.read(7, 900, 200, 130)[0], heights[7:207, 900:1030])


def test_nodata_and_mask_both_make_voids(tmp_path):
    heights = np.array([[1, 2, 3, -9]], dtype="int16")
    path = write_geotiff(tmp_path / "a.tif", heights, mask=[[True, False, True, True]], nodata=-9)
    with RasterSource(path) as source:
        assert source.info.mask_kind == "mask"
        assert read_all(source)[1].tolist() == [[True, False, True, False]]


def test_nan_is_void_beside_a_numeric_nodata(tmp_path):
    heights = np.array([[1, np.nan, -9999]], dtype="float32")
    path = write_geotiff(tmp_path / "a.tif", heights, nodata=-9999)
    with RasterSource(path) as source:
        assert source.info.mask_kind == "nodata"
        assert read_all(source)[1].tolist() == [[True, False, False]]


def test_float32_nodata_of_few_digits_matches_its_stored_value(tmp_path):
    heights = np.array([[1, -3.4028234663852886e38, 2]], dtype="float32")
    path = write_geotiff(tmp_path / "a.tif", heights, nodata=-3.40282346638529e38)
    with RasterSource(path) as source:
        assert read_all(source)[1].tolist() == [[True, False, True]]
    with RasterSource(heights, nodata=-3.40282346638529e38) as source:
        assert read_all(source)[1].tolist() == [[True, False, True]]


@pytest.mark.parametrize("nodata", [0.5, -1, 256, math.nan])
def test_override_that_does_not_fit_the_type_is_refused(nodata):
    with pytest.raises(InvalidHeightsError, match="nodata"):
        RasterSource(np.zeros((2, 2), "uint8"), nodata=nodata)


def test_declared_nodata_that_does_not_fit_the_type_is_ignored_with_a_warning():
    array = FakeDataArray(np.zeros((2, 3), "uint8"), ("y", "x"), attrs={"_FillValue": -9999})
    with pytest.warns(TerrainwaveWarning, match="-9999"):
        source = RasterSource(array)
    assert source.info.nodata is None
    assert read_all(source)[1].all()


def test_infinite_height_is_refused_with_its_position(tmp_path):
    heights = np.zeros((5, 6), "float32")
    heights[3, 4] = -np.inf
    path = write_geotiff(tmp_path / "a.tif", heights)
    with (
        RasterSource(path) as source,
        pytest.raises(InvalidHeightsError, match=r"row 3, column 4 is -inf.*nodata -inf"),
    ):
        source.read(2, 2, 3, 4)
    with RasterSource(path, nodata=-math.inf) as source:
        assert np.argwhere(~read_all(source)[1]).tolist() == [[3, 4]]


def test_void_in_a_raster_without_voids_is_a_corrupt_file(tmp_path):
    with (
        pytest.raises(CorruptStreamError, match="void"),
        RasterSink(tmp_path / "a.tif", RasterInfo(1, 2, "int16")) as sink,
    ):
        sink.write(0, 0, np.zeros((1, 2), "int16"), np.array([[True, False]]))
    assert file_names(tmp_path) == []


def test_array_is_copied_and_byte_order_made_native():
    heights = terrain_like(4, 5).astype(">i2")
    source = RasterSource(heights)
    found, valid = read_all(source)
    assert found.dtype == np.dtype("int16")
    assert found.dtype.isnative
    found[:] = 0
    assert heights.any()
    assert valid.all()
    assert source.info == RasterInfo(4, 5, "int16")


@pytest.mark.parametrize(
    ("dtype", "kind", "nodata"), [("int16", "mask", None), ("float32", "nan", None)]
)
def test_masked_array_keeps_its_mask(dtype, kind, nodata):
    heights = np.ma.masked_equal(np.array([[1, 2, 3]], dtype), 2)
    source = RasterSource(heights)
    found, valid = read_all(source)
    assert not isinstance(found, np.ma.MaskedArray)
    assert valid.tolist() == [[True, False, True]]
    assert (source.info.mask_kind, source.info.nodata) == (kind, nodata)


@pytest.mark.parametrize("shape", [(), (3,), (1, 2, 3), (0, 4)])
def test_array_that_is_no_grid_is_refused(shape):
    with pytest.raises(InvalidHeightsError, match="two dimensions"):
        RasterSource(np.zeros(shape))


@pytest.mark.parametrize(
    ("dtype", "advice"), [("int8", "int16"), ("uint32", "int32"), ("int64", "int32")]
)
def test_unsupported_type_gets_advice(dtype, advice):
    with pytest.raises(InvalidHeightsError, match=rf"{dtype}.*not supported.*convert to {advice}"):
        RasterSource(np.zeros((2, 2), dtype))


class FakeDataArray:
    """The part of xarray.DataArray that is used, as xarray itself is no dependency."""

    name = None

    def __init__(self, values, dims, coords=None, attrs=None):
        self.values = values
        self.dims = dims
        self.coords = coords or {}
        self.attrs = attrs or {}
        self.shape, self.dtype = values.shape, values.dtype

    def __getitem__(self, key):
        values = self.values[key]
        return FakeDataArray(values, self.dims[-values.ndim :], self.coords, self.attrs)

    def transpose(self, *dims):
        return FakeDataArray(self.values.T, dims, self.coords, self.attrs)


@given(
    shape=st.tuples(st.integers(1, 60), st.integers(1, 60)),
    block=st.tuples(st.integers(1, 70), st.integers(1, 70)),
    max_samples=st.integers(1, 3000),
)
def test_scan_covers_the_grid_once_in_bounded_windows(shape, block, max_samples):
    source = RasterSource(np.zeros(shape, "uint8"))
    source._backend.block_shape = block
    count = np.zeros(shape, int)
    for row, col, n_rows, n_cols in source.blocks(max_samples):
        assert 1 <= n_rows * n_cols <= max_samples
        count[row : row + n_rows, col : col + n_cols] += 1
    assert (count == 1).all()


def test_many_threads_read_the_same_heights(tmp_path):
    heights = terrain_like(400, 500)
    path = write_geotiff(tmp_path / "a.tif", heights, compress="DEFLATE")
    wrong = []
    with RasterSource(path) as source:

        def read_some(seed):
            rng = np.random.default_rng(seed)
            for _ in range(20):
                row, col = int(rng.integers(300)), int(rng.integers(400))
                found, _ = source.read(row, col, 100, 100)
                if (found != heights[row : row + 100, col : col + 100]).any():
                    wrong.append((row, col))

        with ThreadPoolExecutor(6) as pool:
            list(pool.map(read_some, range(6)))
    assert not wrong


def test_several_bands_are_noted_and_can_be_chosen(tmp_path):
    layers = np.stack([np.full((2, 2), value, "int16") for value in (1, 2, 3)])
    path = write_geotiff(tmp_path / "a.tif", layers, photometric="MINISBLACK")
    with pytest.warns(TerrainwaveWarning, match=r"3 bands; using band 1 \(choose with --band\)"):
        source = RasterSource(path)
    assert [note.split(": ", 1)[1] for note in source.notes] == [
        "found 3 bands; using band 1 (choose with --band); left out: band 2, band 3"
    ]
    source.close()
    with RasterSource(path, band=3) as source:
        assert read_all(source)[0].max() == 3
        assert source.notes == (f"{path}: using band 3; left out: band 1, band 2",)
    with pytest.raises(InvalidHeightsError, match=r"found band 4, expected 1 … 3: .* has 3 bands"):
        RasterSource(path, band=4)


def test_gcps_and_rpcs_are_dropped_with_a_warning(tmp_path):
    path = tmp_path / "a.tif"
    points = [GroundControlPoint(r, c, 10.0 + c, 50.0 - r) for r, c in [(0, 0), (0, 9), (9, 0)]]
    terms = [1.0] + [0.0] * 19
    rpc = RPC(0, 1, 0, 1, terms, terms, 0, 1, 0, 1, terms, terms, 0, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write_geotiff(path, terrain_like(10, 10), gcps=points, crs="EPSG:4326")
        with rasterio.open(path, "r+") as dataset:
            dataset.rpcs = rpc
    with pytest.warns(TerrainwaveWarning, match="GCPs and RPCs are dropped"):
        RasterSource(path).close()


def test_open_dataset_is_read_and_left_open(tmp_path):
    heights = terrain_like(4, 5)
    path = write_geotiff(tmp_path / "a.tif", heights, transform=Affine(2, 0, 3, 0, -2, 4))
    with rasterio.open(path) as dataset:
        with RasterSource(dataset) as source:
            np.testing.assert_array_equal(read_all(source)[0], heights)
        assert not dataset.closed
    with pytest.raises(InvalidHeightsError, match="closed"):
        RasterSource(dataset)


def test_unreadable_window_names_rows_and_columns(tmp_path):
    heights = np.random.default_rng(0).integers(0, 9999, (300, 300)).astype("int16")
    path = write_geotiff(tmp_path / "a.tif", heights, compress="DEFLATE", blockysize=10)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2000] = b"\xff" * 2000
    path.write_bytes(data)
    with (
        RasterSource(path) as source,
        pytest.raises(StorageError, match="rows 0 to 299, columns 0 to 299 cannot be read"),
    ):
        read_all(source)


@pytest.mark.parametrize("nodata", [None, -9999, -9999.5, math.nan, math.inf, -math.inf])
def test_metadata_survive_json(nodata):
    dtype = "int16" if isinstance(nodata, int) else "float64"
    info = RasterInfo(3, 4, dtype, nodata=nodata, crs="EPSG:4326", transform=(0.1,) * 6, units="m")
    text = json.dumps(info.to_metadata(), allow_nan=False)
    assert repr(RasterInfo.from_metadata(json.loads(text))) == repr(info)


def test_unknown_metadata_are_ignored():
    fields = RasterInfo(3, 4, "int16").to_metadata() | {"colour": "red"}
    assert RasterInfo.from_metadata(fields) == RasterInfo(3, 4, "int16")


@pytest.mark.parametrize(
    "change",
    [
        {"n_rows": 0},
        {"n_rows": True},
        {"n_cols": 1.5},
        {"dtype": "int64"},
        {"dtype": ["int16"]},
        {"nodata": "many"},
        {"nodata": 70000},
        {"nodata": "nan"},
        {"transform": [1, 2, 3]},
        {"transform": ["a"] * 6},
        {"transform": None},
        {"scale": None},
        {"scale": 10**400},
        {"units": 7},
        {"mask_kind": "fog"},
        {"crs": {}},
    ],
    ids=str,
)
def test_damaged_metadata_are_rejected(change):
    fields = RasterInfo(3, 4, "int16").to_metadata() | change
    with pytest.raises(CorruptStreamError, match="metadata are damaged"):
        RasterInfo.from_metadata(fields)


def test_crs_from_a_file_fetches_no_url():
    requests = []
    with socketserver.TCPServer(("127.0.0.1", 0), None) as server:
        server.timeout = 0.3
        server.process_request = lambda *request: requests.append(request)
        with pytest.warns(TerrainwaveWarning, match="neither"):
            parse_crs(f"http://127.0.0.1:{server.server_address[1]}/crs")
        server.handle_request()
    assert not requests


@pytest.mark.parametrize("takes_more", [True, False])
def test_a_full_disk_ends_a_sink_of_several_threads_at_once(tmp_path, monkeypatch, takes_more):
    heights, valid = np.zeros((512, 512), np.int16), np.ones((512, 512), np.bool_)
    sink = RasterSink(tmp_path / "a.tif", RasterInfo(600, 600, "int16"), n_threads=2)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    if takes_more:  # of this user alone
        sink.write(0, 0, heights, valid)
    monkeypatch.setattr(
        tempfile, "TemporaryFile", Mock(side_effect=OSError(errno.ENOSPC, "no space"))
    )
    with pytest.raises(StorageError, match=r"a\.tif: the disk is full"):
        sink.write(0, 0, heights, valid)
    sink.abort()
    assert list(tmp_path.iterdir()) == []


def test_target_that_cannot_fit_is_refused_at_once(tmp_path):
    with pytest.raises(StorageError, match="bytes are free"):
        RasterSink(tmp_path / "a.tif", RasterInfo(2**27, 2**20, "float64"))
    assert file_names(tmp_path) == []


FULL_DISK = """
import resource, sys, numpy as np
from terrainwave.errors import StorageError
from terrainwave.raster_io.raster_info import RasterInfo
from terrainwave.raster_io.geotiff.sink import RasterSink
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), -1))
n_threads, side = int(sys.argv[4]), int(sys.argv[5])
heights = np.random.default_rng(0).integers(-9999, 9999, (side, side)).astype("int16")
try:
    info = RasterInfo(side, side, "int16")
    with RasterSink(sys.argv[1], info, cog=sys.argv[3] == "cog", n_threads=n_threads) as sink:
        for row, col, n_rows, n_cols in sink.blocks(2**19):
            part = heights[row:row + n_rows, col:col + n_cols]
            sink.write(row, col, part, part == part)
except StorageError as error:
    sys.exit(f"StorageError: {error}")
"""


@pytest.mark.few(2)
@pytest.mark.skipif(sys.platform == "win32", reason="no limit on file sizes to set")
@pytest.mark.parametrize(
    ("missing", "kind", "threads", "side"),
    # The whole file, its second half, some of the last tile, the directory after it; of a COG the
    # overviews. The only tile, which GDAL's threads replace by zeros where it could not be written.
    [
        (2_000_000, "tif", 1, 1024),
        (1_000_000, "tif", 1, 1024),
        (5000, "tif", 1, 1024),
        (80, "tif", 1, 1024),
        (-10_000, "cog", 1, 1024),
        (200_000, "tif", 2, 400),
    ],
)
def test_full_disk_is_an_error_and_leaves_nothing(tmp_path, missing, kind, threads, side):
    heights = np.random.default_rng(0).integers(-9999, 9999, (side, side)).astype("int16")
    path = tmp_path / "a.tif"
    write_all(path, RasterInfo(side, side, "int16"), heights, heights == heights)
    limit = path.stat().st_size - missing
    path.unlink()
    run = python(FULL_DISK, path, limit, kind, threads, side)
    assert run.returncode == 1, run.stderr
    assert "StorageError" in run.stderr
    assert "Traceback" not in run.stderr
    assert file_names(tmp_path) == []


def test_cog_overviews_are_averages_of_the_grid(tmp_path):
    heights = terrain_like(1100, 1300, "float32")
    info = RasterInfo(1100, 1300, "float32", mask_kind="nan")
    path = write_all(tmp_path / "a.tif", info, heights, heights == heights, cog=True)
    with rasterio.open(path) as dataset:
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert dataset.overviews(1) == [2, 4]
        assert dataset.block_shapes == [(512, 512)]
        np.testing.assert_array_equal(dataset.read(1), heights)
    with rasterio.open(path, overview_level=0) as dataset:
        half = dataset.read(1)
    expected = heights.reshape(550, 2, 650, 2).mean(axis=(1, 3), dtype=np.float64)
    np.testing.assert_allclose(half, expected, rtol=1e-6)


def test_cog_overviews_leave_out_voids(tmp_path):
    heights = np.full((1024, 1024), 100, "int16")
    valid = np.ones(heights.shape, bool)
    valid[::2, ::2] = False
    valid[:512, :512] = False
    info = RasterInfo(1024, 1024, "int16", nodata=-32768, mask_kind="nodata")
    path = write_all(tmp_path / "a.tif", info, heights, valid, cog=True)
    with rasterio.open(path, overview_level=0) as dataset:
        half = dataset.read(1)
    assert (half[:256, :256] == -32768).all()
    assert (half[256:, :] == 100).all()


def test_cog_keeps_an_internal_mask(tmp_path):
    heights = terrain_like(1100, 1100)
    valid = heights < 120
    info = RasterInfo(1100, 1100, "int16", mask_kind="mask")
    path = write_all(tmp_path / "a.tif", info, heights, valid, cog=True)
    assert file_names(tmp_path) == ["a.tif"]
    with RasterSource(path) as source:
        assert source.info.mask_kind == "mask"
        np.testing.assert_array_equal(read_all(source)[1], valid)


MEMORY = """
import resource, sys, numpy as np
from terrainwave.raster_io.raster_info import RasterInfo
from terrainwave.raster_io.geotiff.sink import RasterSink
from terrainwave.raster_io.source import RasterSource
start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
info = RasterInfo(8192, 16384, "int16", nodata=-1, mask_kind="nodata")
with RasterSink(sys.argv[1], info) as sink:
    for row, col, n_rows, n_cols in sink.blocks():
        heights = np.zeros((n_rows, n_cols), "int16")
        sink.write(row, col, heights, heights == 0)
with RasterSource(sys.argv[1]) as source:
    for window in source.blocks():
        source.read(*window)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - start) // 1024)
"""


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss has another unit or is missing")
def test_memory_stays_flat_on_a_raster_of_256_megabytes(tmp_path):
    run = python(MEMORY, tmp_path / "a.tif", check=True)
    # 64 MiB of GDAL's cache and a few windows of 4 Mi samples.
    assert int(run.stdout) < 140


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_fork_writes_after_its_parent_has_written_with_threads(tmp_path):
    heights = np.arange(TILE * TILE, dtype="int16").reshape(TILE, TILE)

    def write(name):
        with RasterSink(tmp_path / name, RasterInfo(TILE, TILE, "int16"), n_threads=2) as sink:
            sink.write(0, 0, heights, np.ones(heights.shape, dtype=bool))
        return np.array_equal(read_geotiff(tmp_path / name)[0], heights)

    assert write("parent.tif")
    assert holds_in_a_fork(lambda: write("child.tif"))
