"""Which bound `compress` takes where none is given, for files, arrays, mosaics and batches."""

from fractions import Fraction

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.cli import main
from terrainwave.grid.default_bound import DefaultBound
from terrainwave.write import job
from terrainwave.write.origin import difference

ON_NO_GRID = terrain_like(24, 24, "float64") / 3


def over(low, high, dtype="float32"):
    """Return heights from `low` to `high` that lie on no vertical grid."""
    share = (ON_NO_GRID - ON_NO_GRID.min()) / np.ptp(ON_NO_GRID)
    return (low + share * (high - low)).astype(dtype)


def raster(path, heights, unit=None, crs="EPSG:32632", col=0, **more):
    place = rasterio.Affine(10, 0, 500_000 + 10 * col, 0, -10, 5_000_000)
    units = None if unit is None else [unit]
    return write_geotiff(path, heights, units=units, crs=crs, transform=place, **more)


@pytest.mark.parametrize(
    ("low", "high", "unit", "crs", "bound", "said"),
    [
        (-0.004, 0.004, "m", "EPSG:32632", 5e-7, "5e-07 m, as 0.01 m is more than 1 %"),
        (20, 900, "m", "EPSG:32632", 0.01, "0.01 m, as the heights lie on no vertical grid"),
        (0, 4, "km", "EPSG:32632", 1e-5, "1e-05 km, as this is 0.01 m"),
        (20, 900, "ft", "EPSG:32632", 0.01 / 0.3048, "0.0328084 ft, as this is 0.01 m"),
        (20, 900, None, "EPSG:2263+6360", 0.0328083, "0.0328083 US survey foot"),
        (-2, 3, "K", "EPSG:32632", 5e-4, "0.0005 K, as K is no known length"),
        (0, 3e-6, None, "EPSG:32632", 2e-10, "2e-10, as no unit is named, and 0.01 is more than"),
        (0, 2000, None, "EPSG:32632", 0.01, "0.01, as the heights lie on no vertical grid"),
    ],
)
def test_files_say_which_bound_they_got(tmp_path, low, high, unit, crs, bound, said):
    heights = over(low, high)
    source = raster(tmp_path / "a.tif", heights, unit, crs)
    result = terrainwave.compress(source, tmp_path / "a.twz")
    assert result.max_error == pytest.approx(bound, rel=1e-5)
    assert result.effective_error <= result.max_error
    assert any(f"no --max-error given: {said}" in note for note in result.notes)
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        assert np.abs(terrain.read().astype(float) - heights).max() <= result.max_error


def test_a_given_bound_is_taken_whatever_the_range(tmp_path):
    source = raster(tmp_path / "a.tif", over(0, 0.001), "m")
    assert terrainwave.compress(source, tmp_path / "a.twz", max_error=0.01).max_error == 0.01


def test_voids_do_not_widen_the_range(tmp_path):
    heights = over(0, 0.008)
    heights[3, 4] = -9999
    source = raster(tmp_path / "a.tif", heights, "m", nodata=-9999)
    assert terrainwave.compress(source, tmp_path / "a.twz").max_error == 5e-7


def test_the_range_is_that_of_scaled_heights(tmp_path):
    heights = over(1, 900)  # millimetres, told in metres: 0.899 m
    source = raster(tmp_path / "a.tif", heights, "m", bands={"scales": 0.001})
    assert terrainwave.compress(source, tmp_path / "a.twz").max_error == pytest.approx(5e-5)


@pytest.mark.parametrize("method", ["rapid", "cdf53"])
def test_heights_that_are_all_the_same_come_back(tmp_path, method):
    heights = np.full((24, 24), np.float32(np.pi))
    source = raster(tmp_path / "a.tif", heights, "m")
    result = terrainwave.compress(source, tmp_path / "a.twz", method=method)
    assert result.effective_error <= np.spacing(heights[0, 0])
    with terrainwave.open(tmp_path / "a.twz") as terrain:
        np.testing.assert_array_equal(terrain.read(), heights)


def test_the_range_of_a_mosaic_is_that_of_all_its_rasters(tmp_path):
    first = raster(tmp_path / "a.tif", over(0, 0.5), "m")
    second = raster(tmp_path / "b.tif", over(700, 701), "metre", col=24)
    assert terrainwave.compress([first, second], tmp_path / "a.twz").max_error == 0.01


def test_the_command_and_a_batch_say_which_rule_was_used(tmp_path):
    source = str(raster(tmp_path / "a.tif", over(0, 0.008), "m"))
    said = "no --max-error given: 5e-07 m, as 0.01 m is more than 1 % of the range"
    one = CliRunner().invoke(main, ["compress", source, str(tmp_path / "a.twz")])
    many = CliRunner().invoke(main, ["compress", source, "--to", str(tmp_path / "out")])
    assert one.output.count(said) == 1
    assert many.output.count(said) == 1


def test_a_file_with_the_default_bound_of_other_rules_is_made_again(tmp_path, monkeypatch):
    source, path = raster(tmp_path / "a.tif", over(-0.004, 0.004), "m"), tmp_path / "a.twz"
    with monkeypatch.context() as earlier:
        usual = DefaultBound(Fraction(1, 100), "of terrainwave 1.0")
        earlier.setattr(job, "default_bound", lambda *_: usual)
        terrainwave.compress(source, path, keep_origin=True)
    assert difference(path, source) == "it was made with another default bound"
    terrainwave.compress(source, path, overwrite=True, keep_origin=True)
    assert difference(path, source) is None
    terrainwave.compress(path, tmp_path / "b.twz", keep_origin=True)
    assert difference(tmp_path / "b.twz", path) is None
