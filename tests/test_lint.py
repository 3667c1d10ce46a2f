"""Exemptions from lint rules: each names files that there are, and a rule that they break."""

import json
import re
import subprocess
import sys
import tomllib
from itertools import product
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOOLS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
IGNORED = TOOLS["ruff"]["lint"]["per-file-ignores"]
EXEMPTIONS = [(pattern, rule) for pattern, rules in IGNORED.items() for rule in rules]


def files_of(pattern):
    """Return the Python files and notebooks that a pattern of ruff stands for."""
    if pattern.startswith("!"):
        return set(ROOT.glob("src/**/*.py")) - files_of(pattern[1:])
    parts = [part.split(",") for part in re.findall(r"\{(.*?)\}", pattern)]
    template = re.sub(r"\{.*?\}", "{}", pattern)
    found = set()
    for chosen in product(*parts):
        plain = template.format(*chosen)
        here = set(ROOT.glob(f"{plain}/*" if plain.endswith("**") else plain))
        here = {path for path in here if path.suffix in (".py", ".ipynb")}
        assert here, f"{plain} of {pattern} matches no file"
        found |= here
    return found


@pytest.fixture(scope="module")
def broken():
    """Return (file, rule) of all that ruff finds without exemptions."""
    done = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--output-format", "json", "--no-cache",
         "--config", "lint.per-file-ignores = {}", "."],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return {(Path(found["filename"]), found["code"]) for found in json.loads(done.stdout)}


@pytest.mark.parametrize(("pattern", "rule"), EXEMPTIONS)
def test_an_exemption_is_of_files_that_need_it(broken, pattern, rule):
    files = files_of(pattern)
    assert any(path in files and code.startswith(rule) for path, code in broken)


def test_files_with_another_version_of_python_are_there():
    for pattern in TOOLS["ruff"]["per-file-target-version"]:
        assert files_of(pattern)


def test_modules_that_mypy_treats_otherwise_are_there():
    names = [name for each in TOOLS["mypy"]["overrides"] for name in each["module"]]
    own = [name for name in names if name.startswith("terrainwave.")]
    assert own
    for name in own:
        place = ROOT / "src" / name.replace(".", "/")
        assert place.with_suffix(".py").exists() or (place / "__init__.py").exists(), name
