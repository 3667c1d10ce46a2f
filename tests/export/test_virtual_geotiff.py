"""A file read as a GeoTIFF that is made when it is read: what GDAL sees of it."""

import io
import tracemalloc
import warnings
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import pytest
import rasterio
import rasterio.shutil
import rioxarray
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine
from rasterio.windows import Window
from strategies import terrain_like, write_geotiff

from terrainwave.errors import LimitExceededError
from terrainwave.export.virtual_geotiff import VirtualGeoTIFF
from terrainwave.file import TerrainFile
from terrainwave.raster_io.geotiff.sparse import GeoTIFFStream, sparse_geotiff
from terrainwave.raster_io.raster_info import RasterInfo
from terrainwave.write.compress import compress

HEIGHTS = terrain_like(700, 1130)
TRANSFORM = Affine(10.0, 0.0, 1000.0, 0.0, -10.0, 5000.0)


def holed(heights, void):
    heights = heights.copy()
    heights[100:250, 20:190] = void
    heights[600:, 1000:] = void
    return heights


# What a raster holds, and what its profile says.
RASTERS = {
    "int16 without voids": (HEIGHTS, {}),
    "int16 with nodata": (holed(HEIGHTS, -32768), {"nodata": -32768}),
    "float32 with nan": (holed(HEIGHTS / np.float32(4), np.nan), {"nodata": np.nan}),
    "float64 without a declared void": (holed(HEIGHTS / 4, np.nan), {}),
    "uint8, a row": ((HEIGHTS[:1] - HEIGHTS.min() & 127).astype(np.uint8), {}),
    "one sample": (HEIGHTS[:1, :1], {}),
}


@pytest.fixture(scope="module", params=RASTERS)
def source_and_terrain(request, tmp_path_factory):
    """Return the path of a GeoTIFF and its lossless file, open."""
    heights, profile = RASTERS[request.param]
    folder = tmp_path_factory.mktemp("geotiff")
    profile = {"transform": TRANSFORM, "crs": "EPSG:32633", **profile}
    write_geotiff(folder / "dem.tif", heights, units=("m",), **profile)
    compress(folder / "dem.tif", folder / "dem.twz", max_error=0, method="store", mesh="none")
    with TerrainFile(folder / "dem.twz") as terrain:
        yield folder / "dem.tif", terrain


def opened(terrain, **options):
    return rasterio.open(stream_of(terrain), **options)


def stream_of(terrain):
    return GeoTIFFStream(VirtualGeoTIFF(terrain))


@pytest.mark.few(2)
def test_gdal_reads_the_heights_of_the_file(source_and_terrain):
    source, terrain = source_and_terrain
    with rasterio.open(source) as original, opened(terrain) as dataset:
        np.testing.assert_array_equal(dataset.read(1), original.read(1))
        np.testing.assert_array_equal(dataset.dataset_mask(), original.dataset_mask())


@pytest.mark.few(8)
@pytest.mark.parametrize("name", ["crs", "transform", "nodata", "dtype", "width", "height"])
def test_the_profile_is_that_of_the_source(source_and_terrain, name):
    source, terrain = source_and_terrain
    with rasterio.open(source) as original, opened(terrain) as dataset:
        found, expected = dataset.profile[name], original.profile[name]
    # NaN is not equal to itself; a void value without a declaration becomes one or a mask.
    assert repr(found) == repr(expected)


def test_the_bound_and_the_unit_are_told(source_and_terrain):
    _, terrain = source_and_terrain
    with opened(terrain) as dataset:
        assert float(dataset.tags(1, ns="TERRAINWAVE")["MAX_ERROR"]) == terrain.effective_error
        assert dataset.units == ("m",)


def test_no_overview_and_no_copy_states_the_bound(source_and_terrain, tmp_path):
    _, terrain = source_and_terrain
    with opened(terrain) as dataset:
        rasterio.shutil.copy(dataset, tmp_path / "copy.tif", driver="GTiff")
        assert not any(key.startswith("TERRAINWAVE") for key in (*dataset.tags(), *dataset.tags(1)))
        n_overviews = len(dataset.overviews(1))
    opens = [(tmp_path / "copy.tif", {})]
    opens += [(stream_of(terrain), {"overview_level": i}) for i in range(n_overviews)]
    for source, options in opens:
        with rasterio.open(source, **options) as dataset:
            assert "MAX_ERROR" not in dataset.tags(ns="TERRAINWAVE")
            assert "MAX_ERROR" not in dataset.tags(1, ns="TERRAINWAVE")


@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # of rioxarray
def test_the_bound_does_not_go_on_to_rasters_of_other_heights(source_and_terrain, tmp_path):
    _, terrain = source_and_terrain
    with rioxarray.open_rasterio(stream_of(terrain)) as array:
        assert not any("ERROR" in name for name in array.attrs)
        (array // 2).rio.to_raster(tmp_path / "other.tif")
    with rasterio.open(tmp_path / "other.tif") as dataset:
        assert "TERRAINWAVE" not in dataset.tag_namespaces()
        assert not any("ERROR" in name for name in dataset.tags())


def test_a_mask_of_its_own_comes_back(tmp_path):
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        source = write_geotiff(tmp_path / "dem.tif", HEIGHTS, transform=TRANSFORM, crs="EPSG:32633")
        valid = np.ones(HEIGHTS.shape, dtype=bool)
        valid[40:520, 300:1101] = False
        with rasterio.open(source, "r+") as dataset:
            dataset.write_mask(valid)
    compress(source, tmp_path / "dem.twz", max_error=0, method="store", mesh="none")
    with TerrainFile(tmp_path / "dem.twz") as terrain, opened(terrain) as dataset:
        np.testing.assert_array_equal(dataset.dataset_mask() > 0, valid)
        np.testing.assert_array_equal(dataset.read(1)[valid], HEIGHTS[valid])


@pytest.fixture(scope="module")
def plane(tmp_path_factory):
    """Return a file of an inclined plane with nested levels: averages of it are known."""
    rows, cols = np.mgrid[:1300, :2100]
    path = tmp_path_factory.mktemp("plane") / "plane.twz"
    compress(
        (8.0 * rows - 3 * cols).astype(np.float64), path, max_error=0, method="store", mesh="none"
    )
    with TerrainFile(path) as terrain:
        yield terrain


@pytest.mark.full
def test_overviews_of_a_plane_are_its_heights_at_the_centres_of_their_pixels(plane):
    """No shift: pixel i of the overview of a factor f has its centre at sample f·i + (f - 1)/2."""
    n_compared = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        for index, factor in enumerate((2, 4, 8)):
            with opened(plane, overview_level=index) as dataset:
                heights = dataset.read(1)
            rows, cols = (factor * np.arange(n) + (factor - 1) / 2 for n in heights.shape)
            expected = 8 * rows[:, None] - 3 * cols
            # The last pixels reach past the raster's edge.
            np.testing.assert_allclose(heights[:-1, :-1], expected[:-1, :-1], atol=1e-9)
            n_compared += 1
    assert n_compared == 3


def test_an_overview_is_void_where_nothing_is_valid(source_and_terrain):
    source, terrain = source_and_terrain
    with rasterio.open(source) as original, opened(terrain) as dataset:
        if not dataset.overviews(1):
            return
        valid = original.dataset_mask() > 0
        with opened(terrain, overview_level=0) as overview:
            half = overview.dataset_mask() > 0
    for row, col in ((80, 50), (330, 540), (0, 0), (0, 300)):
        if row >= half.shape[0]:
            continue
        assert half[row, col] == valid[2 * row : 2 * row + 2, 2 * col : 2 * col + 2].any()


def test_an_average_never_equals_the_void_value(tmp_path):
    heights = np.full((600, 600), 1, dtype=np.int16)
    heights[:, ::2] = -1
    path = tmp_path / "dem.twz"
    compress(heights, path, max_error=0, method="store", nodata=0, mesh="none")
    with TerrainFile(path) as terrain, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with opened(terrain, overview_level=0) as dataset:
            assert (dataset.read(1) == 1).all()


def test_any_part_of_the_bytes_is_that_part_of_the_whole(plane):
    file = VirtualGeoTIFF(plane)
    whole = file.read_at(0, file.size)
    assert len(whole) == file.size
    generator = np.random.default_rng(1)
    for place, n_bytes in zip(
        generator.integers(0, file.size, 40), generator.integers(0, 3 << 20, 40), strict=True
    ):
        assert file.read_at(int(place), int(n_bytes)) == whole[place : place + n_bytes]


def test_threads_that_read_one_stream_of_their_own_each_get_the_same(plane):
    file = VirtualGeoTIFF(plane)
    whole = file.read_at(0, file.size)
    with ThreadPoolExecutor(8) as pool:
        parts = pool.map(lambda k: file.read_at(k << 20, 1 << 20), range((file.size >> 20) + 1))
    assert b"".join(parts) == whole


def test_a_stream_seeks_and_reads_as_a_file_does(plane):
    stream = stream_of(plane)
    whole = stream.read()
    for offset, whence in ((100, io.SEEK_SET), (50, io.SEEK_CUR), (-70, io.SEEK_END)):
        place = stream.seek(offset, whence)
        assert stream.read(60) == whole[place : place + 60]
        assert stream.tell() == place + 60
    with pytest.raises(ValueError, match="seek"):
        stream.seek(-1)
    assert stream.read(100) == whole[-10:]
    assert stream.read(100) == b""


class Zeros(NamedTuple):
    """A head and, behind it, zeros up to a size."""

    head: bytes
    size: int

    def read_at(self, place, n_bytes):
        data = self.head[place : place + n_bytes]
        return data + bytes(min(n_bytes, self.size - place) - len(data))


def test_more_than_four_gigabytes_make_a_bigtiff():
    info = RasterInfo(n_rows=100_000, n_cols=70_000, dtype="float32", crs="EPSG:32633")
    head, planes = sparse_geotiff(info, 7, {})
    assert head[:4] == b"II+\0"
    assert planes[-1].stop - planes[-1].start == 196 * 137 * 512 * 512 * 4
    with rasterio.open(GeoTIFFStream(Zeros(head, planes[-1].stop))) as dataset:
        assert dataset.shape == (100_000, 70_000)
        assert dataset.overviews(1) == [2, 4, 8, 16, 32, 64, 128]
        assert (dataset.read(1, window=Window(69_990, 99_990, 10, 10)) == 0).all()


class Counted:
    """Counts the bytes that are read."""

    def __init__(self, file):
        self.file, self.n_bytes = file, 0

    @property
    def size(self):
        return self.file.size

    def read_at(self, place, n_bytes):
        self.n_bytes += n_bytes
        return self.file.read_at(place, n_bytes)


@pytest.mark.parametrize("way", ["stream", "opener"])
def test_rasterio_reads_no_more_than_it_needs(plane, way):
    counted = Counted(VirtualGeoTIFF(plane))
    stream = GeoTIFFStream(counted)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        first = (stream,) if way == "stream" else ("dem.tif",)
        options = {} if way == "stream" else {"opener": stream.opener}
        with rasterio.open(*first, **options) as dataset:
            heights = dataset.read(1, window=Window(900, 600, 40, 30))
    np.testing.assert_array_equal(heights, plane.read((600, 900, 30, 40)))
    assert counted.n_bytes < counted.size / 4


@pytest.mark.parametrize(
    ("side", "tile"), [(1 << 14, 512), (1 << 19, 1024), (1 << 20, 2048), (2_900_000, 2048)]
)
def test_a_large_raster_has_larger_tiles_so_that_the_head_stays_small(side, tile):
    info = RasterInfo(side, side, "int16")
    head, planes = sparse_geotiff(info, 3, {})
    assert {plane.tile for plane in planes} == {tile}
    assert len(head) < 48 << 20


@pytest.mark.parametrize("shape", [(1 << 25, 1 << 25), (1 << 31, 1 << 19), (3 << 20, 3 << 20)])
def test_a_raster_that_no_geotiff_holds_is_refused_at_once(shape):
    tracemalloc.start()
    try:
        with pytest.raises(LimitExceededError, match="more than a GeoTIFF of at most"):
            sparse_geotiff(RasterInfo(*shape, "int16", nodata=-1), 12, {})
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()
