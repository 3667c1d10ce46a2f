"""Heights of a one-sided bound lie above, or below, their originals, and nowhere else."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run
from strategies import terrain_like, write_geotiff

import terrainwave as tw
from benchmarks.one_sided import compressed, n_violations, random_case
from terrainwave.errors import (
    BoundViolationError,
    InvalidArgumentError,
    InvalidHeightsError,
)
from terrainwave.grid import quantum

HEIGHTS = terrain_like(150, 130, seed=3)


@pytest.mark.filterwarnings("ignore::terrainwave.errors.TerrainwaveWarning")
@pytest.mark.parametrize("first", range(0, 500, 100))
def test_random_rasters_keep_to_their_side(first):
    for seed in range(first, first + 100):
        case = random_case(np.random.default_rng(seed))
        assert n_violations(case, compressed(case)) == 0, (seed, case)


@pytest.mark.filterwarnings("ignore:.*marks voids")
@pytest.mark.parametrize("bound", ["above", "below"])
@pytest.mark.parametrize("dtype", ["uint8", "int16"])
def test_ends_of_a_type_are_no_way_out(bound, dtype):
    limits = np.iinfo(dtype)
    rng = np.random.default_rng(1)
    heights = rng.choice([limits.min, limits.max, 100], (40, 40)) + rng.integers(0, 2, (40, 40))
    heights = np.clip(heights, limits.min, limits.max).astype(dtype)
    data = tw.compress_to_bytes(heights, max_error=9, bound=bound, threads=1)
    with tw.open(data) as terrain:
        apart = terrain.read().astype(int) - heights
    assert (apart if bound == "above" else -apart).min() >= 0
    assert 0 < np.abs(apart).max() <= 9


def test_a_file_is_as_large_as_one_of_half_the_bound():
    one = tw.compress_to_bytes(HEIGHTS, max_error=8, bound="above", threads=1)
    two = tw.compress_to_bytes(HEIGHTS, max_error=4, threads=1)
    assert abs(len(one) - len(two)) <= 40  # the word, and numbers of the header


def test_levels_and_meshes_state_what_holds(tmp_path):
    source = write_geotiff(tmp_path / "dem.tif", HEIGHTS, nodata=-9999)
    tw.compress(source, tmp_path / "a.twz", max_error=8, bound="below", mesh="halves", block=32)
    report = tw.verify(tmp_path / "a.twz", source, mesh=True)
    assert report.ok
    with tw.open(tmp_path / "a.twz") as terrain:
        assert terrain.info().bound == "below"
        for level in range(terrain.n_levels):
            step = 2 ** (terrain.n_levels - 1 - level)
            apart = np.abs(terrain.read(level=level).astype(int) - HEIGHTS[::step, ::step])
            assert apart.max() <= terrain.level_errors()[level]


def test_one_height_off_any_grid_is_moved_by_what_the_header_counts():
    heights = np.full((20, 30), np.pi)
    with tw.open(tw.compress_to_bytes(heights, max_error=0.01, bound="above", threads=1)) as file:
        quantum = float(file.header.quantum)
        moved = round(file.read()[0, 0] / quantum) - round(np.pi / quantum)
        assert 0 < moved <= file.header.coded_error


def test_the_proof_finds_a_height_on_the_wrong_side(tmp_path, monkeypatch):
    """Heights are moved by one quantum less than half a step, and so by more than the bound."""
    made = quantum._on_one_side

    def lower(*given):
        found = made(*given)
        return replace(found, base=found.base - 1, lift=found.lift - 2)

    monkeypatch.setattr(quantum, "_on_one_side", lower)
    with pytest.raises(BoundViolationError, match="is below its original"):
        tw.compress(HEIGHTS, tmp_path / "a.twz", max_error=9, bound="above")
    assert not (tmp_path / "a.twz").exists()


def test_verify_finds_a_height_on_the_wrong_side(tmp_path):
    source = write_geotiff(tmp_path / "dem.tif", HEIGHTS, nodata=-9999)
    tw.compress(source, tmp_path / "a.twz", max_error=8, bound="above")
    assert tw.verify(tmp_path / "a.twz", source).ok
    other = HEIGHTS.copy()
    with tw.open(tmp_path / "a.twz") as terrain:
        other[20, 30] = terrain.read()[20, 30] + 1
    report = tw.verify(
        tmp_path / "a.twz", write_geotiff(tmp_path / "other.tif", other, nodata=-9999)
    )
    (problem,) = report.problems
    assert "1 sample is not above the original, the first at row 20, column 30" in problem


def test_depths_are_not_deeper_than_measured(tmp_path):
    depths = np.abs(HEIGHTS)
    data = tw.compress_to_bytes(depths, max_error=6, bound="above", heights_are="depth")
    with tw.open(data) as terrain:
        apart = terrain.read().astype(int) - depths
    assert -6 <= apart.min() < 0 == apart.max()


def test_whole_steps_within_the_bound_are_lossless_and_a_note_says_so(tmp_path):
    result = tw.compress(HEIGHTS, tmp_path / "a.twz", max_error=1, bound="above")
    assert any("the file is lossless" in note for note in result.notes)
    with tw.open(tmp_path / "a.twz") as terrain:
        np.testing.assert_array_equal(terrain.read(), HEIGHTS)
        assert terrain.info().bound == "both"


@pytest.mark.parametrize(
    "options",
    [{"method": "cdf53"}, {"method": tw.Cdf97(faithful=True)}, {"strict": True}, {"stable": True}],
)
def test_options_that_move_heights_in_other_ways_are_refused(options, tmp_path):
    with pytest.raises(InvalidArgumentError, match="found bound above and"):
        tw.compress(HEIGHTS, tmp_path / "a.twz", max_error=5, bound="above", **options)


def test_heights_that_are_off_already_are_refused(tmp_path):
    tw.compress(HEIGHTS, tmp_path / "a.twz", max_error=2)
    with pytest.raises(InvalidHeightsError, match="expected the original raster"):
        tw.compress(tmp_path / "a.twz", tmp_path / "b.twz", max_error=5, bound="below")


def test_the_command_and_catalogues_say_the_side(tmp_path):
    place = {"crs": "EPSG:32633", "transform": (30.0, 0.0, 5e5, 0.0, -30.0, 5.2e6)}
    source = write_geotiff(tmp_path / "dem.tif", HEIGHTS, nodata=-9999, **place)
    path = tmp_path / "a.twz"
    run("compress", source, path, "--max-error", 6, "--bound", "above")
    assert "no height is below its original" in " ".join(run("info", path).stdout.split())
    item = json.loads(run("info", path, "--stac").stdout)
    assert item["properties"]["terrainwave:bound"] == "above"


def test_the_page_on_bounds_tells_a_change_from_the_bounds(tmp_path, monkeypatch):
    """A hill of 3 is more than both bounds together; what they add elsewhere is not."""
    page = (Path(__file__).parents[2] / "docs" / "choosing-a-bound.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    later = HEIGHTS.copy()
    later[40:50, 60:70] += 13
    monkeypatch.chdir(tmp_path)
    tw.compress(HEIGHTS, "2019.twz", max_error=2)
    tw.compress(later, "2024.twz", max_error=3)
    found: dict = {}
    exec(code, found)
    hill = later != HEIGHTS
    assert not found["is_real"][~hill].any()
    assert found["is_real"][hill].all()
