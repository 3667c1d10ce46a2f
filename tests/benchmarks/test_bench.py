"""`make bench`: it goes on where it stopped, and its tables say what the CSVs say."""

import csv

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

pytest.importorskip("matplotlib")

from benchmarks.codecs import SpeedRow, read_cases
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
