"""Heights on no vertical grid, stored with every bit: `max_error` 0 (FORMAT.md §5.3)."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from cases import some
from strategies import terrain_like, write_geotiff
from twz import twz_bytes

import terrainwave
from terrainwave.container.header import HAS_REMAINDERS
from terrainwave.errors import BoundViolationError, InvalidHeightsError
from terrainwave.verification.heights import verify
from terrainwave.write.compress import compress
from terrainwave.write.patch import patch


def off_grid(dtype, shape=(75, 68)):
    """Return heights with a void, both zeros and a very small one, on no vertical grid."""
    heights = (terrain_like(*shape, dtype="float64") / 3).astype(dtype)
    heights[20:30, 40:50] = np.nan
    heights[0, :3] = 0.0, -0.0, 1e-30
    return heights


def int32_from_end_to_end():
    ends = np.array([-(2**31), 2**31 - 1])
    return ends[np.random.default_rng(1).integers(0, 2, (40, 40))] // np.int64(3) * 3 + 1


def assert_same_bits(found, expected):
    valid = ~np.isnan(expected)
    bits = f"i{expected.dtype.itemsize}"
    np.testing.assert_array_equal(found.view(bits)[valid], expected.view(bits)[valid])
    assert np.isnan(found[~valid]).all()


@pytest.mark.parametrize("method", some(["rapid", "predictive", "store", "cdf97"], 2))
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_every_bit_of_floats_comes_back(dtype, method):
    heights = off_grid(dtype)
    with terrainwave.open(twz_bytes(heights, max_error=0, method=method)) as terrain:
        assert terrain.max_error == terrain.effective_error == 0
        assert terrain.quantizer.remainder_bytes == heights.itemsize
        assert_same_bits(terrain.read(), heights)
        row, col = 61, 66  # of one unit and of another, at a sample of the full grid
        x, y = col + 0.5, -(row + 0.5)
        assert terrain.sample([(x, abs(y))])[0] == heights[row, col]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("method", some(["rapid", "predictive", "store", "cdf97"], 2))
def test_negative_zeros_of_a_vertical_grid_come_back(dtype, method):
    heights = terrain_like(75, 68).astype(dtype) - 100
    heights[20:30, 40:50] = np.nan
    heights[heights == 0] = -0.0
    heights[70, 3:9] = 0.0
    with terrainwave.open(twz_bytes(heights, max_error=0, method=method)) as terrain:
        assert terrain.header.features & HAS_REMAINDERS
        assert_same_bits(terrain.read(), heights)
    with terrainwave.open(twz_bytes(heights + 0.0, max_error=0, method=method)) as terrain:
        assert not terrain.header.features & HAS_REMAINDERS


@pytest.mark.full
def test_negative_zeros_in_one_window_of_many_are_found(tmp_path):
    heights = terrain_like(600, 2000).astype("float32") + 5
    heights[599, 1999] = -0.0
    raster = write_geotiff(tmp_path / "dem.tif", heights)
    compress(raster, tmp_path / "dem.twz", max_error=0, mesh="none")
    with terrainwave.open(tmp_path / "dem.twz") as terrain:
        assert_same_bits(terrain.read(), heights)
    for executor in (None, ThreadPoolExecutor(1)):
        target = tmp_path / f"{executor is None}.twz"
        options = {} if executor is None else dict(client=executor, task_samples=1 << 16)
        compress(raster, target, max_error=0, mesh="none", block=64, **options)
    assert (tmp_path / "True.twz").read_bytes() == (tmp_path / "False.twz").read_bytes()


def test_the_proof_finds_a_bit_that_did_not_come_back(monkeypatch):
    heights = terrain_like(40, 40).astype("float32")
    heights[3, 3:9] = -0.0

    def without_signs(raw, valid, decoded):
        return np.zeros(raw.shape, "i4")

    monkeypatch.setattr("terrainwave.write.pyramid.remainders", without_signs)
    with pytest.raises(BoundViolationError, match="row 3, column 3 has other bits"):
        twz_bytes(heights, max_error=0)


def test_a_bound_too_small_for_quanta_is_kept_by_every_bit():
    heights = off_grid("float32")
    with terrainwave.open(twz_bytes(heights, max_error=1e-9)) as terrain:
        assert (terrain.max_error, terrain.effective_error) == (1e-9, 0)
        assert_same_bits(terrain.read(), heights)


def test_integers_too_far_apart_for_quanta_come_back():
    heights = int32_from_end_to_end().astype("int32")
    with terrainwave.open(twz_bytes(heights, max_error=0)) as terrain:
        np.testing.assert_array_equal(terrain.read(), heights)


def test_a_method_of_tiles_refuses_and_names_those_that_can():
    with pytest.raises(InvalidHeightsError, match=r"or method rapid or .* or store, which can"):
        twz_bytes(off_grid("float32"), max_error=0, method="cdf53")


def test_heights_of_no_grid_have_no_remainders_unless_they_need_them():
    with terrainwave.open(twz_bytes(off_grid("float32"), max_error=0.01)) as terrain:
        assert (terrain.header.has_remainders, terrain.quantizer.remainder_bytes) == (False, 0)


def test_the_file_and_its_meshes_are_proved(tmp_path):
    heights = off_grid("float32")
    raster = write_geotiff(tmp_path / "dem.tif", heights, nodata=np.nan)
    path = tmp_path / "dem.twz"
    result = compress(raster, path, max_error=0, block=32)
    assert (result.effective_error, result.measured_error) == (0, 0)
    report = verify(path, raster, mesh=True)
    assert report.problems == ()
    assert report.bound == 0
    with terrainwave.open(path) as terrain:
        assert 0 < terrain.quanta_error < 0.01
        # What heights over 66 and no unit get by default: 66 / 10,000, rounded down.
        assert terrain.info().mesh_tolerance == pytest.approx(0.005, rel=0.05)


def test_a_patch_keeps_the_bits_it_does_not_change(tmp_path):
    heights = off_grid("float32")
    path = tmp_path / "dem.twz"
    path.write_bytes(twz_bytes(heights, max_error=0))
    newer = heights.copy()
    newer[5, 5] = np.nextafter(newer[5, 5], np.float32(1e9))  # of the same quantum
    newer[50:60, 5:9] = newer[10:20, 5:9]
    result = patch(path, newer)
    assert result.effective_error == 0
    assert 0 < result.n_recoded
    with terrainwave.open(path) as terrain:
        assert_same_bits(terrain.read(), newer)


def test_one_float_that_differs_is_coded_again(tmp_path):
    heights = off_grid("float32")
    path = tmp_path / "dem.twz"
    path.write_bytes(twz_bytes(heights, max_error=0))
    heights[5, 5] = np.nextafter(heights[5, 5], np.float32(1e9))
    assert patch(path, heights).n_recoded == 1
    with terrainwave.open(path) as terrain:
        assert_same_bits(terrain.read(), heights)


@pytest.mark.full
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("method", ["rapid", "predictive"])
@pytest.mark.parametrize("roughness", [0.0, 0.01, 1.0])
def test_a_file_is_no_larger_than_zstd_with_its_predictor(tmp_path, dtype, method, roughness):
    row, col = np.mgrid[0:500, 0:500]
    heights = 900 + 700 * np.sin(row / 61.0) * np.cos(col / 83.0 + row / 300)
    heights += np.random.default_rng(3).normal(size=heights.shape) * roughness
    heights = heights.astype(dtype)
    profile = dict(compress="zstd", predictor=3, zstd_level=9, tiled=True)
    raster = write_geotiff(tmp_path / "dem.tif", heights, **profile)
    compress(raster, tmp_path / "dem.twz", max_error=0, method=method)  # with blocks as users have
    assert (tmp_path / "dem.twz").stat().st_size <= raster.stat().st_size


@pytest.mark.parametrize("max_error", [0, 0.01])
def test_meshes_of_heights_that_floats_round_hold(tmp_path, max_error):
    # Floats this high lie further apart than quanta of a bound this small.
    row, col = np.mgrid[0:75, 0:68]
    heights = (8000 + 0.5 * np.sin(row / 7) * np.cos(col / 9)).astype("float32")
    raster = write_geotiff(tmp_path / "dem.tif", heights)
    compress(raster, tmp_path / "dem.twz", max_error=max_error, block=32)
    assert verify(tmp_path / "dem.twz", raster, mesh=True).problems == ()


def test_fine_heights_in_a_large_void_keep_their_bound(tmp_path):
    heights = np.full((1700, 1700), np.nan, dtype=np.float32)
    noise = np.random.default_rng(0).normal(0, 0.01, (300, 300))
    heights[:300, :300] = terrain_like(300, 300, dtype="float32", seed=3) + noise
    compress(heights, tmp_path / "a.twz", max_error=0.001)
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        back = terrain.read()
    np.testing.assert_array_equal(np.isnan(back), np.isnan(heights))
    assert np.nanmax(np.abs(back.astype(np.float64) - heights)) <= 0.001 + 2**-11
