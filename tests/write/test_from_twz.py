"""Files that are made of .twz files: the bound is from the original, not from the file between."""

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from strategies import terrain_like, write_geotiff
from twz import stated_bounds_problems

import terrainwave
from terrainwave import Terrain
from terrainwave.cli import main
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError, StorageError

HEIGHTS = terrain_like(100, 130)
NODATA = -9999


@pytest.fixture
def original(tmp_path):
    heights = HEIGHTS.copy()
    heights[20:30, 40:70] = NODATA
    return write_geotiff(tmp_path / "dem.tif", heights, nodata=NODATA)


def made(source, path, max_error=None, **options):
    options = {"method": "store", "mesh": "none", "block": 32} | options
    return terrainwave.compress(source, path, max_error=max_error, overwrite=True, **options)


@pytest.mark.few(5)
@pytest.mark.parametrize("method", ["store", "rapid", "predictive", "cdf97", "cdf53"])
@pytest.mark.parametrize("bound", [2, 3, 7.5])
def test_a_coarser_file_is_within_what_is_asked_of_the_original(tmp_path, original, method, bound):
    made(original, tmp_path / "a.twz", 2)
    result = made(tmp_path / "a.twz", tmp_path / "b.twz", bound, method=method)
    assert result.effective_error <= result.max_error <= bound
    assert result.measured_error <= bound - 2
    report = terrainwave.verify(tmp_path / "b.twz", original)
    assert report.ok, report
    assert report.errors.max_error <= result.effective_error
    assert report.earlier == ({"file": "a.twz", "max_error": 2.0},)


def test_without_a_bound_the_heights_stay_as_they_are(tmp_path, original):
    for dtype, bound in (("int16", 3), ("float32", 0.37), ("float64", 0)):
        heights = HEIGHTS.astype(dtype)
        if dtype != "int16":
            heights += np.random.default_rng(5).random(heights.shape).astype(dtype)
        source = write_geotiff(tmp_path / "one.tif", heights)
        made(source, tmp_path / "a.twz", bound, method="rapid")
        result = made(tmp_path / "a.twz", tmp_path / "b.twz")
        with Terrain(tmp_path / "a.twz") as first, Terrain(tmp_path / "b.twz") as second:
            assert np.array_equal(first.read(), second.read())
            assert result.measured_error == 0
            # In whole quanta of the new file.
            quantum = second.info().quantum
            assert first.effective_error <= second.effective_error
            assert second.effective_error < first.effective_error + quantum
        assert terrainwave.verify(tmp_path / "b.twz", source).ok


def test_what_is_lost_does_not_come_back(tmp_path, original):
    made(original, tmp_path / "a.twz", 2)
    with pytest.raises(InvalidArgumentError, match=r"found max_error 1 .* expected at least 2"):
        made(tmp_path / "a.twz", tmp_path / "b.twz", 1)
    assert not (tmp_path / "b.twz").exists()
    with pytest.raises(InvalidArgumentError, match="expected the original raster"):
        made(tmp_path / "a.twz", tmp_path / "b.twz", 6, stable=True)


def test_losses_add_along_a_chain_and_are_named(tmp_path, original):
    source, bound = original, 0
    for number, name in enumerate(("a", "b", "c")):
        bound += number + 1
        made(source, tmp_path / f"{name}.twz", bound, method="rapid")
        source = tmp_path / f"{name}.twz"
    report = terrainwave.verify(tmp_path / "c.twz", original)
    assert report.ok
    assert report.effective_error == 6
    assert [step["max_error"] for step in report.earlier] == [1, 3]
    told = CliRunner().invoke(main, ["verify", str(tmp_path / "c.twz")]).output
    assert "made from b.twz, within 3 of the original, from a.twz, within 1" in told
    assert "made from" in CliRunner().invoke(main, ["info", str(tmp_path / "c.twz")]).output


def test_blocks_and_boxes_state_bounds_from_the_original(tmp_path, original):
    heights = HEIGHTS.copy()
    heights[20:30, 40:70] = NODATA
    made(original, tmp_path / "a.twz", 2, method="rapid", mesh="halves")
    made(tmp_path / "a.twz", tmp_path / "b.twz", 5, method="rapid", mesh="halves")
    report = terrainwave.verify(tmp_path / "b.twz", original, mesh=True)
    assert report.ok, report
    assert stated_bounds_problems(tmp_path / "b.twz", heights, NODATA) == []


@pytest.mark.filterwarnings("ignore:.*the rest is void")
def test_a_mosaic_of_files_is_that_of_their_rasters_within_the_largest_bound(tmp_path):
    whole = terrain_like(90, 140)
    places = [((0, 0), (60, 80)), ((30, 60), (60, 80)), ((0, 70), (50, 60))]
    rasters, files = [], []
    for number, ((row, col), (n_rows, n_cols)) in enumerate(places):
        part = whole[row : row + n_rows, col : col + n_cols]
        transform = (10.0, 0.0, 500 + 10.0 * col, 0.0, -10.0, 900 - 10.0 * row)
        raster = write_geotiff(tmp_path / f"{number}.tif", part, transform=transform, nodata=NODATA)
        made(raster, tmp_path / f"{number}.twz", number + 1, method="rapid")
        rasters.append(raster)
        files.append(tmp_path / f"{number}.twz")
    made(rasters, tmp_path / "exact.twz", 0)
    terrainwave.decompress(tmp_path / "exact.twz", tmp_path / "exact.tif")
    for bound in (None, 3, 5):
        result = made(files, tmp_path / "all.twz", bound, method="rapid")
        assert result.effective_error <= (bound or 3)
        report = terrainwave.verify(tmp_path / "all.twz", tmp_path / "exact.tif")
        assert report.ok, report
    # Rasters and files together, and open files.
    with terrainwave.open(files[0]) as first:
        result = made([first, *rasters[1:]], tmp_path / "mixed.twz", 2, method="rapid")
        assert first.read().any()
    assert result.effective_error == 2
    assert terrainwave.verify(tmp_path / "mixed.twz", tmp_path / "exact.tif").ok
    with pytest.raises(StorageError, match="is the file to be read"):
        made(files, files[1], 5)


def test_all_else_of_the_file_stays(tmp_path):
    source = write_geotiff(
        tmp_path / "dem.tif",
        HEIGHTS,
        nodata=NODATA,
        crs="EPSG:32610",
        units=("metre",),
        transform=(10.0, 0.0, 500.0, 0.0, -10.0, 900.0),
    )
    with rasterio.open(source, "r+") as dataset:
        dataset.scales, dataset.offsets = (0.5,), (10.0,)
        dataset.set_band_description(1, "bare earth")
        dataset.update_tags(SOURCE="survey")
    made(source, tmp_path / "a.twz", 1)
    made(tmp_path / "a.twz", tmp_path / "b.twz", 2)
    assert terrainwave.verify(tmp_path / "b.twz", source).ok
    with Terrain(tmp_path / "a.twz") as first, Terrain(tmp_path / "b.twz") as second:
        assert first.raster_info == second.raster_info


def test_a_bound_that_no_file_can_state_names_the_next(tmp_path):
    """Losses are stated in whole quanta, of which a file on no grid has others than its source."""
    heights = (HEIGHTS * np.pi).astype("float32")
    made(write_geotiff(tmp_path / "dem.tif", heights), tmp_path / "a.twz", 0.4, method="rapid")
    with Terrain(tmp_path / "a.twz") as terrain:
        before = terrain.effective_error
    try:
        result = made(tmp_path / "a.twz", tmp_path / "b.twz", before, method="rapid")
    except InvalidHeightsError as error:
        before = float(str(error).split("expected at least ")[1].split(":")[0])
        result = made(tmp_path / "a.twz", tmp_path / "b.twz", before, method="rapid")
    assert result.effective_error <= before


@pytest.mark.full
def test_any_bound_of_small_heights_is_settled(tmp_path):
    """Quanta of many digits: the bound that is left differs from the one before in the last one."""
    rng = np.random.default_rng(0)
    for _ in range(12):
        size = 10 ** rng.uniform(-6, 1)
        heights = np.cumsum(rng.normal(size=(9, 9)), 0) * size
        made(heights, tmp_path / "a.twz", size * 10 ** rng.uniform(-3, -0.5))
        with Terrain(tmp_path / "a.twz") as terrain:
            before = terrain.effective_error
        for bound in before * rng.uniform(2, 3000, 6):
            result = made(tmp_path / "a.twz", tmp_path / "b.twz", float(bound))
            assert result.effective_error <= result.max_error <= bound * (1 + 1e-15)
