"""Does every example run, and do the README's snippets?"""

import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from commands import python_with
from rasterio.transform import Affine
from strategies import terrain_like, write_geotiff

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.full
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path, tmp_path):
    done = python_with(["-W", "error", path], cwd=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.large
def test_python_of_the_readme_runs(tmp_path, monkeypatch):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (snippet,) = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    rows, cols = np.mgrid[:300, :300]  # large enough for two levels
    heights = (100 + rows + 20 * np.sin(cols / 9)).astype(np.float32)
    write_geotiff(tmp_path / "dem.tif", heights)
    monkeypatch.chdir(tmp_path)
    exec(compile(snippet, "README.md", "exec"), {})
    assert (tmp_path / "dem.glb").exists()


@pytest.fixture
def rasters(tmp_path, monkeypatch):
    """The rasters that documents name, in the current directory."""
    heights = terrain_like(300, 300)
    heights[20:50, 30:90] = -32768
    for name, part, left in (
        ("dem", heights, 0),
        ("west", heights[:, :200], 0),
        ("east", heights[:, 150:], 150),
    ):
        transform = Affine(30, 0, 500_000 + 30 * left, 0, -30, 5_000_000)
        write_geotiff(
            tmp_path / f"{name}.tif",
            part,
            nodata=-32768,
            units=("m",),
            crs="EPSG:32633",
            transform=transform,
        )
    monkeypatch.chdir(tmp_path)
    return tmp_path


INTEGRATIONS = ROOT / "docs" / "integrations.md"


@pytest.mark.large
def test_python_of_the_integrations_runs(rasters):
    snippets = re.findall(
        r"```python\n(.*?)```", INTEGRATIONS.read_text(encoding="utf-8"), re.DOTALL
    )
    scope = {}
    for snippet in snippets:
        exec(compile(snippet, INTEGRATIONS.name, "exec"), scope)
    assert scope["result"].measured_error <= 0.5
    assert scope["surface"].field_data["error"][0] <= 5


@pytest.mark.large
def test_commands_of_the_integrations_run(rasters):
    from rasterio.rio.main import main_group

    from terrainwave.cli import main

    text = INTEGRATIONS.read_text(encoding="utf-8")
    lines = re.findall(r"^(rio|terrainwave) (.+)$", text, re.MULTILINE)
    for program, arguments in lines:
        group = main if program == "terrainwave" else main_group
        done = CliRunner().invoke(group, arguments.split())
        assert done.exit_code == 0, done.output
    assert (rasters / "rio_back.tif").exists()
    assert (rasters / "both.twz").exists()


def test_tables_of_the_readme_are_those_of_the_results():
    from benchmarks.tables import DOCUMENTS, PAGES, figures_by_hand, fill_in

    assert {page: found for page in PAGES if (found := figures_by_hand(page))} == {}

    for name in DOCUMENTS:
        path = ROOT / name
        if path.exists():
            text = path.read_text(encoding="utf-8")
            assert fill_in(text) == text, f"{name}: run python -m benchmarks.tables"
