"""The paced flight: it ends, keeps the clock, and says what was drawn."""

import csv

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

flight = pytest.importorskip("benchmarks.flight")


@pytest.mark.full
def test_flights_from_a_file_and_from_the_web_end_within_tau(tmp_path):
    rows, cols = np.mgrid[0:300, 0:280]
    heights = 200 * np.sin(rows / 30) * np.cos(cols / 25) + 20 * np.sin(rows / 3)
    with rasterio.open(
        tmp_path / "a.tif", "w", driver="GTiff", height=300, width=280, count=1, dtype="int16",
        crs="EPSG:32633", transform=rasterio.Affine(30, 0, 5e5, 0, -30, 5e6),
    ) as sink:  # fmt: skip
        sink.write(heights.round().astype(np.int16), 1)
    words = [tmp_path / "a.tif", "--side", 700, "--work", tmp_path, "--out", tmp_path / "a.csv"]
    words += ["--seconds", 2.5, "--size", "320x200", "--mode", "adaptive", "dynamic"]
    words += ["--what", "low", "jump", "web"]
    done = CliRunner().invoke(flight.main, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    with (tmp_path / "a.csv").open() as file:
        found = list(csv.DictReader(file))
    assert [(row["mode"], row["what"]) for row in found] == [
        (mode, what) for mode in ("adaptive", "dynamic") for what in ("low", "jump", "web")
    ]
    for row in found:
        assert 0 <= float(row["time_to_tau_s"]) < flight.JUMP_TIMEOUT_S
        assert float(row["read_mib"]) > 0
        assert int(row["frames"]) > 0
        assert float(row["p99_error_px"]) <= np.hypot(320, 200) + 1e-6
