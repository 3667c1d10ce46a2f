"""What every release must keep: one version everywhere, metadata that agree, pinned workflows."""

import configparser
import json
import re
import tomllib
from pathlib import Path

import yaml

from terrainwave import __version__

ROOT = Path(__file__).parent.parent


def text_of(name):
    return (ROOT / name).read_text(encoding="utf-8")


def test_the_version_is_the_same_everywhere():
    plugin = configparser.ConfigParser(interpolation=None)
    plugin.read_string(text_of("qgis/terrainwave_plugin/metadata.txt"))
    stated = {
        "js/package.json": json.loads(text_of("js/package.json"))["version"],
        "qgis": plugin["general"]["version"],
        "CITATION.cff": yaml.safe_load(text_of("CITATION.cff"))["version"],
        "conda": yaml.safe_load(text_of("conda/recipe.yaml"))["context"]["version"],
    }
    assert stated == dict.fromkeys(stated, __version__)


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
