"""`make bench`: it goes on where it stopped, and its tables say what the CSVs say."""

import csv

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

pytest.importorskip("matplotlib")

from benchmarks.report import CsvSink, read_cases
from benchmarks.speeds import Row
from benchmarks.tables import cases_table, speeds_table


def speed_row(codec, encode):
    return Row("hill", 3.0, codec, 10**6, 0.5, encode, 2 * encode, 1)


def test_a_sink_that_appends_keeps_rows_and_remembers_the_machine(tmp_path):
    path = tmp_path / "speeds.csv"
    for codec in ("sperr", "terrainwave-cdf97"):
        with CsvSink(path, Row, append=True) as sink:
            sink.write(speed_row(codec, 1.0))
    assert read_cases(path) == {("hill", 3.0, "sperr"), ("hill", 3.0, "terrainwave-cdf97")}
    before = path.read_bytes()
    with CsvSink(path, Row, append=True):
        pass
    assert path.read_bytes() == before


def test_speeds_are_told_beside_sperr_with_geometric_means(tmp_path):
    with CsvSink(tmp_path / "speeds.csv", Row) as sink:
        for codec, speed in (
            ("terrainwave-predictive-fast", 8.0),
            ("terrainwave-predictive", 4.0),
            ("terrainwave-cdf97", 1.6),
            ("sperr", 16.0),
        ):
            sink.write(speed_row(codec, speed))
    assert speeds_table(tmp_path).splitlines()[-1] == (
        "| / SPERR | | 0.50 | 0.25 | 0.10 | 1.00 | 0.50 | 0.25 | 0.10 | 1.00 |"
    )


@pytest.mark.large
def test_a_second_run_measures_nothing_again(tmp_path, monkeypatch):
    from benchmarks import bench

    monkeypatch.setattr(bench, "pin_to_one_core", lambda: True)
    rows, cols = np.mgrid[:60, :70]
    heights = (rows * cols // 40).astype(np.int16)
    profile = {"driver": "GTiff", "count": 1, "height": 60, "width": 70, "dtype": "int16"}
    transform = rasterio.Affine(1, 0, 0, 0, -1, 0)
    with rasterio.open(tmp_path / "hill.tif", "w", **profile, transform=transform) as sink:
        sink.write(heights, 1)
    results = tmp_path / "results"
    args = [str(tmp_path), "--only", "cdf97", "--max-error", "0", "3", "--results", str(results)]
    first = CliRunner().invoke(bench.main, args)
    assert first.exit_code == 0, first.output
    with (results / "cdf97.csv").open(newline="") as file:
        assert [float(row["measured_error"]) <= 3 for row in csv.DictReader(file)] == [True, True]
    before = (results / "cdf97.csv").read_bytes()
    again = CliRunner().invoke(bench.main, args)
    assert again.exit_code == 0, again.output
    assert (results / "cdf97.csv").read_bytes() == before
    assert "hill at" not in again.output
    assert cases_table(results).count("\n") == 1  # without predictive and peers: no case
    assert (results / "rates.png").stat().st_size > 0
