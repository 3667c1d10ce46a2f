"""What every release must keep: one version everywhere, metadata that agree, pinned workflows."""

import configparser
import json
import re
import runpy
import shutil
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.version import Version

from terrainwave import __version__
from tools.set_version import PLACES, set_version, spelled

ROOT = Path(__file__).parent.parent


def text_of(name):
    return (ROOT / name).read_text(encoding="utf-8")


def stated_versions(root):
    """Return the version by each file that states it, as its own users' programs read it."""
    plugin = configparser.ConfigParser(interpolation=None)
    plugin.read_string((root / "qgis/terrainwave_plugin/metadata.txt").read_text())
    recipe = yaml.safe_load((root / "conda/recipe.yaml").read_text())
    return {
        "src/terrainwave/_version.py": runpy.run_path(root / "src/terrainwave/_version.py")[
            "__version__"
        ],
        "js/package.json": json.loads((root / "js/package.json").read_text())["version"],
        "qgis/terrainwave_plugin/metadata.txt": plugin["general"]["version"],
        "conda/recipe.yaml": recipe["context"]["version"],
        "CITATION.cff": yaml.safe_load((root / "CITATION.cff").read_text())["version"],
    }


def test_the_version_is_the_same_everywhere():
    stated = stated_versions(ROOT)
    assert stated == {name: spelled(__version__, name) for name in stated}


@pytest.mark.parametrize("version", ["7.8.9", "7.8.9.dev3"])
def test_the_version_is_set_everywhere(tmp_path, version):
    for name in PLACES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    set_version(version, tmp_path)
    stated = stated_versions(tmp_path)
    assert stated == {name: spelled(version, name) for name in PLACES}
    assert spelled("7.8.9.dev3", "js/package.json") == "7.8.9-dev.3"


def test_builds_between_releases_do_not_call_themselves_a_release():
    """While CHANGELOG has changes that no release has, the version is a development version."""
    (unreleased,) = re.findall(
        r"^## \[Unreleased\]\n(.*?)^## ", text_of("CHANGELOG.md"), re.M | re.S
    )
    (last,) = re.findall(r"^## \[(\d+\.\d+\.\d+)\]", text_of("CHANGELOG.md"), re.M)[:1]
    version = Version(__version__)
    if unreleased.strip():
        assert version.is_devrelease
        assert version > Version(last)
    else:
        assert version == Version(last)


def test_the_classifiers_say_how_ready_it_is():
    """A version of 1 or more is called stable, one before it is not."""
    classifiers = tomllib.loads(text_of("pyproject.toml"))["project"]["classifiers"]
    (status,) = (name for name in classifiers if name.startswith("Development Status"))
    assert status.endswith("Production/Stable") == (int(__version__.split(".")[0]) >= 1)


def test_conda_installs_what_pip_does():
    project = tomllib.loads(text_of("pyproject.toml"))["project"]
    recipe = yaml.safe_load(text_of("conda/recipe.yaml"))
    installed = [re.sub(r"\s", "", name) for name in recipe["requirements"]["run"]]
    assert installed == ["python>=${{python_min}}", *project["dependencies"]]
    assert recipe["context"]["python_min"] == project["requires-python"].removeprefix(">=")
    (script,) = project["scripts"].items()
    assert recipe["build"]["python"]["entry_points"] == ["{} = {}".format(*script)]


def test_actions_of_workflows_are_pinned_to_commits():
    """A tag can be moved to other code, a commit cannot."""
    workflows = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
    used = [name for path in workflows for name in re.findall(r"uses: *(.+)", path.read_text())]
    assert len(used) >= 6
    for name in used:
        assert re.fullmatch(r"[\w./-]+@[0-9a-f]{40} # v[\d.]+", name), name
