"""`make bench`: it goes on where it stopped, and its tables say what the CSVs say."""

import csv
import weakref

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

pytest.importorskip("matplotlib")

from benchmarks.codecs import SpeedRow, leave_slow_speeds, read_cases
from benchmarks.common import take_turns, write_rows
from benchmarks.tables import markdown


def speed_row(codec, encode, *, raster="hill", max_error=3.0, decode=None, slow=False):
    n = 5 * 10**6 if raster == "hill" else 10**6
    decode = 2 * encode if decode is None else decode
    return SpeedRow(raster, max_error, codec, slow, n, 0.5, encode, decode, 1)


def test_rows_that_are_appended_keep_others_and_remember_the_machine(tmp_path):
    path = tmp_path / "speeds.csv"
    for codec in ("sperr", "terrainwave-cdf97"):
        write_rows(path, [speed_row(codec, 1.0)], append=True)
    assert read_cases(path) == {("hill", 3.0, "sperr"), ("hill", 3.0, "terrainwave-cdf97")}
    before = path.read_bytes()
    write_rows(path, [], append=True)
    assert path.read_bytes() == before


def test_rows_that_are_not_appended_take_the_place_of_others(tmp_path):
    path = tmp_path / "speeds.csv"
    for codec in ("sperr", "terrainwave-cdf97"):
        write_rows(path, [speed_row(codec, 1.0)])
    assert read_cases(path) == {("hill", 3.0, "terrainwave-cdf97")}


def test_speeds_of_slow_codecs_stay_where_those_of_fast_ones_are_measured_again(tmp_path):
    path = tmp_path / "speeds.csv"
    slow = [speed_row("cog", 9.0, slow=True), speed_row("sperr", 1.0, slow=True)]
    write_rows(path, slow)
    before = path.read_bytes()
    write_rows(path, [speed_row("cog", 8.0), *slow, speed_row("terrainwave-rapid", 7.0)])
    leave_slow_speeds(path)
    assert path.read_bytes() == before


def test_speeds_are_told_beside_the_cog_of_the_same_turns_with_the_slowest_case(tmp_path):
    cases = [
        ("hill", 0.0, "cog", 16.0, 100.0, False),
        ("hill", 0.0, "terrainwave-rapid+", 8.0, 50.0, False),
        ("hill", 1.0, "cog", 20.0, 200.0, False),
        ("hill", 1.0, "terrainwave-rapid+", 4.0, 50.0, False),
        ("hill", 10.0, "cog", 80.0, 200.0, False),
        ("hill", 10.0, "terrainwave-rapid+", 9.0, 50.0, False),
        # On another day: over this COG, not over the other.
        ("hill", 1.0, "cog", 10.0, 100.0, True),
        ("hill", 1.0, "sperr", 5.0, 50.0, True),
        ("dale", 1.0, "cog", 20.0, 200.0, False),
        ("dale", 1.0, "terrainwave-rapid+", 2.0, 20.0, False),
    ]
    rows = [
        speed_row(codec, encode, raster=raster, max_error=bound, decode=decode, slow=slow)
        for raster, bound, codec, encode, decode, slow in cases
    ]
    write_rows(tmp_path / "speeds.csv", rows)
    large, small = "4 Mpx and more", "1 to 4 Mpx"
    none = "– | – | –"
    assert markdown("speeds", tmp_path).splitlines()[2:] == [
        f"| cog | {large} | 16.0 | 1.00 | 1.00 | 100.0 | 1.00 | 1.00 |"
        " 40.0 | 1.00 | 1.00 | 200.0 | 1.00 | 1.00 |",
        f"| terrainwave-rapid+ | {large} | 8.0 | 0.50 | 0.50 | 50.0 | 0.50 | 0.50 |"
        " 6.0 | 0.15 | 0.11 | 50.0 | 0.25 | 0.25 |",
        f"| sperr | {large} | {none} | {none} | 5.0 | 0.50 | 0.50 | 50.0 | 0.50 | 0.50 |",
        f"| cog | {small} | {none} | {none} | 20.0 | 1.00 | 1.00 | 200.0 | 1.00 | 1.00 |",
        f"| terrainwave-rapid+ | {small} | {none} | {none} |"
        " 2.0 | 0.10 | 0.10 | 20.0 | 0.10 | 0.10 |",
    ]
    assert markdown("default_reads", tmp_path).splitlines()[2:] == [
        "| hill | 5,000,000 | 0 | 50 | 100 | 0.50 |",
        "| hill | 5,000,000 | 1 | 50 | 200 | 0.25 |",
        "| hill | 5,000,000 | 10 | 50 | 200 | 0.25 |",
        "| dale | 1,000,000 | 1 | 20 | 200 | 0.10 |",
    ]


def test_a_table_says_what_was_not_measured(tmp_path):
    heading = "raster,renderer,camera,mode,tau,triangles,submitted,cpu_ms,frame_ms,first_bytes,"
    line = "hill,a driver,low,full,2.0,1234,1234,,12.3,5000,,"
    (tmp_path / "systems_modes.csv").write_text(f"{heading}frame_bytes,largest_pixels\n{line}\n")
    found = markdown("systems_modes", tmp_path).splitlines()
    assert found[2] == "| low | full | 1,234 | 1,234 | – | 12 | 5 | – | – |"
    assert found[-1] == "Renderer: a driver. τ kept: 2 pixels."


def test_tasks_take_turns_and_stop_when_patience_ends():
    clock = iter(range(100))
    calls = []

    def tasks():
        calls.append("round")
        return [lambda: calls.append("a"), lambda: calls.append("b")]

    found = take_turns(tasks, 5, patience=4, clock=lambda: next(clock))
    assert calls == ["round", "a", "b"] * 2
    assert [(timed.seconds, timed.n_runs) for timed in found] == [(1, 2), (1, 2)]


@pytest.mark.large
def test_a_second_run_measures_nothing_again(tmp_path, monkeypatch):
    from benchmarks import bench

    monkeypatch.setattr(bench.common, "pin_to_cores", lambda *_: None)
    rows, cols = np.mgrid[:60, :70]
    heights = (rows * cols // 40).astype(np.int16)
    profile = {"driver": "GTiff", "count": 1, "height": 60, "width": 70, "dtype": "int16"}
    transform = rasterio.Affine(1, 0, 0, 0, -1, 0)
    with rasterio.open(tmp_path / "hill.tif", "w", **profile, transform=transform) as sink:
        sink.write(heights, 1)
    results = tmp_path / "results"
    args = [str(tmp_path), "--only", "cdf97", "--max-error", "0", "3", "--out", str(results)]
    first = CliRunner().invoke(bench.main, args)
    assert first.exit_code == 0, first.output
    with (results / "cdf97.csv").open(newline="") as file:
        assert [float(row["measured_error"]) <= 3 for row in csv.DictReader(file)] == [True, True]
    before = (results / "cdf97.csv").read_bytes()
    again = CliRunner().invoke(bench.main, args)
    assert again.exit_code == 0, again.output
    assert (results / "cdf97.csv").read_bytes() == before
    assert "hill," not in again.output
    assert markdown("cases", results).count("\n") == 1  # without predictive and peers: no case
    assert (results / "rates.png").stat().st_size > 0


def test_a_result_is_given_up_just_before_its_task_runs_again():
    class Result:
        pass

    alive = []
    kept = [None, None]  # weak references

    def task(index):
        alive.append([other() is not None if other else None for other in kept])
        result = Result()
        kept[index] = weakref.ref(result)
        return result

    found = take_turns(lambda: [lambda: task(0), lambda: task(1)], 3)
    assert alive == [[None, None], [True, None], *[[False, True], [True, False]] * 2]
    assert [type(one.result) for one in found] == [Result, Result]
