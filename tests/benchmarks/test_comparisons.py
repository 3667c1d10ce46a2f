"""What is timed of a peer is its own user's call: what it returns comes back untouched."""

import importlib
import sys
from types import SimpleNamespace

import click
import numpy as np
import pytest
import rasterio
from rasterio.windows import Window

import terrainwave
from benchmarks import javascript, windows


@pytest.fixture
def load(monkeypatch):
    """Return a function that imports a benchmark with stand-ins for libraries."""
    loaded = []

    def with_stand_ins(name, **libraries):
        for library, stand_in in libraries.items():
            monkeypatch.setitem(sys.modules, library, stand_in)
        sys.modules.pop(name, None)
        loaded.append(name)
        return importlib.import_module(name)

    yield with_stand_ins
    for name in loaded:
        sys.modules.pop(name, None)


def load_meshes(load, delatin, martini):
    return load(
        "benchmarks.meshes",
        pydelatin=SimpleNamespace(Delatin=delatin), pymartini=SimpleNamespace(Martini=martini),
    )  # fmt: skip


def test_the_true_error_of_a_mesh_is_the_spike_that_it_misses(load):
    meshes = load_meshes(load, None, None)
    heights = np.zeros((3, 3), np.int32)
    heights[0, 1], heights[0, 2], heights[1, 2], heights[1, 1] = 10, 20, 10, 5
    # Two triangles on the four corners, by pydelatin's vertices (y upwards) and by pymartini's. On
    # the diagonal, which meets row 0, column 2 at height 20, the middle is at 10 instead of 5.
    triangles = np.array([[0, 2, 1], [1, 2, 3]])
    by_delatin = np.array([[0, 2, 0], [2, 2, 20], [0, 0, 0], [2, 0, 0]], np.float32)
    by_martini = np.array([[0, 0], [2, 0], [0, 2], [2, 2]], np.uint16)
    for mesher, vertices in (("delatin", by_delatin), ("martini", by_martini)):
        rows, cols, z, found = meshes.places_of(mesher, heights, (vertices, triangles))
        assert meshes.true_error(heights, rows, cols, z, found) == 5
        with pytest.raises(click.ClickException, match="cover"):
            meshes.true_error(heights, rows, cols, z, found[:1])


def test_our_own_mesh_has_the_true_error_that_it_states(load):
    meshes = load_meshes(load, None, None)
    heights = np.random.default_rng(1).integers(0, 40, (65, 65)).astype(np.int32)
    mesh = meshes.by_array(heights, 10.0)
    found = meshes.true_error(heights, *meshes.places_of("array", heights, mesh))
    assert 5 < found <= mesh.error <= 10


def make_dem(path, side=600):
    rows, cols = np.mgrid[:side, :side]
    heights = (900 + 300 * np.sin(rows / 40) * np.cos(cols / 30)).astype(np.int16)
    with rasterio.open(
        path, "w", driver="GTiff", count=1, height=side, width=side, dtype="int16",
        crs="EPSG:32633", transform=rasterio.Affine(30, 0, 5e5, 0, -30, 5e6),
    ) as sink:  # fmt: skip
        sink.write(heights, 1)
    return path


def test_both_readers_of_windows_hold_the_bound_and_give_the_rasters_type(tmp_path):
    dem = make_dem(tmp_path / "a.tif")
    rows = list(windows.measure([dem], [2.0], 512, 2, tmp_path))
    assert [(row.place, row.reader) for row in rows] == [
        (place, reader) for place in ("aligned", "any") for reader in ("terrainwave", "cog")
    ]
    assert all(0 < row.error <= 2 for row in rows)
    assert all(0 < row.median_ms <= row.most_ms for row in rows)
    cog = windows.read_cog(tmp_path / "windows.tif")
    assert cog.dtype == windows.read_terrain(tmp_path / "windows.twz").dtype == np.int16
    with rasterio.open(tmp_path / "windows.tif") as dataset:
        assert dataset.compression.name == "lerc_zstd"
        assert dataset.overviews(1) == [2]


@pytest.mark.filterwarnings("ignore:Numcodecs codecs are not in the Zarr")
@pytest.mark.parametrize("max_error", [1.0, 10.0, 37.0, 49.0])
def test_steps_of_fixed_scale_offset_use_the_bound_and_keep_it(load, max_error):
    integrations = load("benchmarks.integrations", rioxarray=SimpleNamespace())
    heights = np.arange(-11_000, 9_000, dtype=np.int16)[: 125 * 160].reshape(125, 160)
    options = integrations.zarr_codecs(heights.dtype, max_error)["steps, blosc zstd"]
    array = integrations.fresh_array(options, heights)
    integrations.write(array, heights)
    assert np.abs(array[...].astype(np.int64) - heights).max() == max_error


def test_heights_in_javascript_that_differ_from_python_stop_the_measurement(tmp_path):
    dem, path = make_dem(tmp_path / "a.tif", 64), tmp_path / "a.twz"
    terrainwave.compress(dem, path, max_error=0, mesh="none")
    whole = Window(0, 0, 64, 64)
    for file in (dem, path):
        right = javascript.expected_of(file, whole)
        found = {"digest": right, "seconds": 1.0}
        assert javascript.seconds_of(lambda _question, f=found: f, file, whole, 0, {}) == 1.0
        with pytest.raises(SystemExit, match="not what Python and GDAL read"):
            javascript.seconds_of(lambda _question: {"digest": "other"}, file, whole, 0, {})
