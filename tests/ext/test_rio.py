"""`rio twz`, in rasterio's own command line."""

import pytest
from click.testing import CliRunner
from rasterio.rio.main import main_group


@pytest.fixture
def rio():
    """Return the result of a rio command."""
    return lambda *arguments: CliRunner().invoke(main_group, [*map(str, arguments)])


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
