"""Does CI run the releases of numba that the package may have?"""

import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]


def test_ci_runs_the_lowest_release_and_later_ones():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text())
    releases = workflow["jobs"]["numba"]["strategy"]["matrix"]["numba"]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (lowest,) = (name for name in project["dependencies"] if name.startswith("numba"))
    assert lowest == f"numba>={releases[0]}"
    assert len(releases) > 1
