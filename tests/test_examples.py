"""Does every example run, and do the README's snippets?"""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from strategies import write_geotiff

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.large
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path, tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "error", path],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
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
    assert (tmp_path / "back.tif").exists()


def test_commands_of_the_readme_exist():
    from terrainwave.cli import main

    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    commands = set(re.findall(r"^terrainwave (\w+) \S+\.", readme, re.MULTILINE))
    assert commands
    assert commands <= set(main.commands)


def test_tables_of_the_readme_are_those_of_the_results():
    from benchmarks.tables import DOCUMENTS, fill_in

    for name in DOCUMENTS:
        path = ROOT / name
        if path.exists():
            text = path.read_text(encoding="utf-8")
            assert fill_in(text) == text, f"{name}: run python -m benchmarks.tables"
