"""Does CI run the releases of numba for which there are shortcuts?"""

import tomllib
from pathlib import Path

import yaml

from terrainwave.coding.compiled import TRIED

ROOT = Path(__file__).parents[2]


def test_ci_runs_each_release_that_the_list_names():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text())
    releases = workflow["jobs"]["numba"]["strategy"]["matrix"]["numba"]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (lowest,) = (name for name in project["dependencies"] if name.startswith("numba"))
    assert lowest == f"numba>={releases[0]}"
    assert tuple(releases) == TRIED
