"""`rio twz`, in rasterio's own command line."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from rasterio.rio.main import main_group
from strategies import read_geotiff, terrain_like, write_geotiff


@pytest.fixture
def rio():
    """Return the result of a rio command."""
    return lambda *arguments: CliRunner().invoke(main_group, [*map(str, arguments)])


def test_rio_compresses_shows_checks_and_writes_back(rio, tmp_path):
    heights = terrain_like(20, 25)
    tif, twz, back = tmp_path / "a.tif", tmp_path / "a.twz", tmp_path / "b.tif"
    write_geotiff(tif, heights)
    assert rio("twz", "compress", tif, twz, "--max-error", 1).exit_code == 0
    shown = rio("twz", "info", twz, "--json")
    assert json.loads(shown.stdout)["max_error"] == 1
    assert rio("twz", "verify", twz, tif).exit_code == 0
    assert rio("twz", "decompress", twz, back).exit_code == 0
    assert np.abs(read_geotiff(back)[0] - heights).max() <= 1


def test_failure_is_one_line_and_status_1(rio, tmp_path):
    done = rio("twz", "info", tmp_path / "gone.twz")
    assert done.exit_code == 1
    assert done.stderr.startswith("Error: cannot read ")
    assert done.stderr.count("\n") == 1


def test_wrong_usage_is_status_2(rio, tmp_path):
    assert rio("twz", "compress", tmp_path / "a.tif").exit_code == 2
    assert rio("twz", "info", "--no-such").exit_code == 2


def test_damaged_file_is_status_1_as_in_terrainwave(rio, tmp_path):
    (tmp_path / "a.twz").write_bytes(b"nothing")
    done = rio("twz", "verify", tmp_path / "a.twz")
    assert done.exit_code == 1
    assert "expected a .twz file" in done.stderr
