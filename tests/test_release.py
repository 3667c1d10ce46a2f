"""What every release must keep: one version everywhere, metadata that agree, pinned workflows."""

import configparser
import hashlib
import json
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.version import Version

from terrainwave import __version__
from tools.set_version import PLACES, set_version

ROOT = Path(__file__).parent.parent


def text_of(name):
    return (ROOT / name).read_text(encoding="utf-8")


def stated_versions(root):
    """Return the version by each file that states it, as its own users' programs read it."""
    plugin = configparser.ConfigParser(interpolation=None)
    plugin.read_string((root / "qgis/terrainwave_plugin/metadata.txt").read_text())
    defined = re.findall(
        r"^#define (TWZ_VERSION\w*) (.+)$",
        (root / "native/include/terrainwave.h").read_text(),
        re.M,
    )
    project = re.search(
        r"^project\(terrainwave VERSION (\S+) ", (root / "native/CMakeLists.txt").read_text(), re.M
    )
    name = "src/terrainwave/_version.py"
    stated = {
        name: runpy.run_path(root / name)["__version__"],
        "js/package.json": json.loads((root / "js/package.json").read_text())["version"],
        "qgis/terrainwave_plugin/metadata.txt": plugin["general"]["version"],
        "CITATION.cff": yaml.safe_load((root / "CITATION.cff").read_text())["version"],
        "native/CMakeLists.txt": project[1],
        "native/include/terrainwave.h": dict(defined),
    }
    for name in ("conda/recipe.yaml", "conda/gdal/recipe.yaml"):
        stated[name] = yaml.safe_load((root / name).read_text())["context"]["version"]
    return stated


def expected_versions(version, npm, numbers):
    """Return what all files state, the version being spelled in each of these ways."""
    names = ("TWZ_VERSION_MAJOR", "TWZ_VERSION_MINOR", "TWZ_VERSION_PATCH")
    return dict.fromkeys({place[0] for place in PLACES}, version) | {
        "js/package.json": npm,
        "native/CMakeLists.txt": ".".join(numbers),
        "native/include/terrainwave.h": {
            "TWZ_VERSION": f'"{version}"',
            **dict(zip(names, numbers, strict=True)),
        },
    }


def test_the_version_is_the_same_everywhere():
    npm = __version__.replace(".dev", "-dev.")
    numbers = __version__.split(".")[:3]
    assert stated_versions(ROOT) == expected_versions(__version__, npm, numbers)


@pytest.mark.parametrize(
    ("version", "npm"), [("7.8.19", "7.8.19"), ("7.8.19.dev3", "7.8.19-dev.3")]
)
def test_the_version_is_set_everywhere(tmp_path, version, npm):
    for name, *_ in PLACES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    set_version(version, tmp_path)
    assert stated_versions(tmp_path) == expected_versions(version, npm, ["7", "8", "19"])


def test_the_changelog_begins_with_the_release_that_comes_or_the_last_one():
    """While changes are in no release, the version is a development version of that one."""
    number, rest = re.findall(r"^## \[(\d+\.\d+\.\d+)\](.*)$", text_of("CHANGELOG.md"), re.M)[0]
    version = Version(__version__)
    assert number == version.base_version
    assert (rest == " - unreleased") == version.is_devrelease


def test_conda_installs_what_pip_does():
    project = tomllib.loads(text_of("pyproject.toml"))["project"]
    recipe = yaml.safe_load(text_of("conda/recipe.yaml"))
    installed = [re.sub(r"\s", "", name) for name in recipe["requirements"]["run"]]
    assert installed == ["python>=${{python_min}}", *project["dependencies"]]
    assert recipe["context"]["python_min"] == project["requires-python"].removeprefix(">=")


def test_actions_of_workflows_are_pinned_to_commits():
    """A tag can be moved to other code, a commit cannot."""
    workflows = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
    used = [name for path in workflows for name in re.findall(r"uses: *(.+)", path.read_text())]
    assert len(used) >= 6
    for name in used:
        assert re.fullmatch(r"[\w./-]+@[0-9a-f]{40} # v[\d.]+", name), name


def test_the_bill_of_materials_names_artifacts_and_packages(tmp_path):
    (tmp_path / "a.whl").write_bytes(b"a wheel")
    made = []
    for name in ("one.json", "two.json"):
        command = [sys.executable, ROOT / "tools/make_sbom.py", tmp_path / name, tmp_path / "a.whl"]
        subprocess.run(command, check=True)
        made.append((tmp_path / name).read_bytes())
    assert made[0] == made[1]
    parts = {part["name"]: part for part in json.loads(made[0])["components"]}
    (digest,) = parts["a.whl"]["hashes"]
    assert digest["content"] == hashlib.sha256(b"a wheel").hexdigest()
    assert parts["maplibre-gl"]["purl"].startswith("pkg:npm/maplibre-gl@")
    assert parts["geotiff"]["purl"] == "pkg:npm/geotiff@3.0.5"
    assert parts["@mapbox/martini"]["purl"] == "pkg:npm/%40mapbox/martini@0.2.0"
    project = tomllib.loads(text_of("pyproject.toml"))["project"]
    assert {Requirement(text).name for text in project["dependencies"]} <= set(parts)
    assert "pytest" not in parts
