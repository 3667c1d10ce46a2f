"""Does the cache of compiled kernels hold as long as their sources do, and no longer?"""

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from terrainwave.coding.compiled import sources_of

PACKAGE = Path(__file__).parents[2] / "src" / "terrainwave"

# Calls a few kernels and prints the names of those that were compiled, then a result.
USE_KERNELS = """
import numpy as np
from numba.core import event

import terrainwave.terrain
from terrainwave.codec import example
from terrainwave.grid.quadtree import Region
from terrainwave.render.modes import regular

with event.install_recorder("numba:compile") as recorder:
    regular.half_place(np.zeros((3, 3)), 2, 2)
    results = example.scaled(3), example.first_of(example.pair())
functions = [e.data["dispatcher"].py_func for _, e in recorder.buffer]
names = {f.__name__ for f in functions if f.__module__.startswith("terrainwave")}
print(*sorted(names), *results)
"""

CONSTANTS = 'FACTOR = 2\n"""A factor."""\n'
PART = """
from terrainwave.coding.jit import kernel_part

@kernel_part
def times(number, factor):
    return factor * number
"""
PAIR = "from typing import NamedTuple\nclass Pair(NamedTuple):\n    first: int\n    second: int\n"
# `first_of` takes what its file does not import at its head.
EXAMPLE = """
from terrainwave.coding.example_constants import FACTOR
from terrainwave.coding.example_part import times
from terrainwave.coding.jit import kernel

def pair():
    from terrainwave.coding.example_pair import Pair
    return Pair(**{"first": 10, "second": 20})

@kernel
def scaled(number):
    return times(number, FACTOR)

@kernel
def first_of(pair):
    return pair.first
"""


def files_with_kernels():
    texts = {path: path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    marks = "\n@kernel\n", "\n@inlined_kernel"
    return sorted(path for path, text in texts.items() if any(mark in text for mark in marks))


def imported_at_the_top(path):
    """Yield the package's files that a file imports when it is run, by `ast`."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom | ast.Import):
            yield from files_named_by(node)
        elif isinstance(node, ast.If):
            assert ast.unparse(node.test) == "TYPE_CHECKING", path
        else:
            is_plain = ast.Assign | ast.AnnAssign | ast.Expr | ast.FunctionDef | ast.ClassDef
            assert isinstance(node, is_plain | ast.Assert | ast.For), (path, node.lineno)


def files_named_by(node):
    if isinstance(node, ast.Import):
        assert not any(alias.name.startswith("terrainwave") for alias in node.names)
        return
    parts = node.module.split(".")
    if parts[0] != "terrainwave":
        return
    for alias in node.names:
        place = PACKAGE.joinpath(*parts[1:])
        names = place / f"{alias.name}.py", place.with_suffix(".py"), place / "__init__.py"
        yield next(path for path in names if path.is_file())


@pytest.mark.few(8)
@pytest.mark.parametrize("path", files_with_kernels(), ids=lambda path: path.stem)
def test_sources_are_what_the_imports_of_a_file_lead_to(path):
    found, waiting = set(), [path]
    while waiting:
        current = waiting.pop()
        if current not in found:
            found.add(current)
            waiting += imported_at_the_top(current)
    assert [Path(source) for source in sources_of(str(path))] == sorted(found)


@pytest.fixture(scope="module")
def copied(tmp_path_factory):
    """A copy of the package with an example of its own, whose kernels were compiled once."""
    root = tmp_path_factory.mktemp("copied")
    package = root / "terrainwave"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "coding" / "example_constants.py").write_text(CONSTANTS)
    (package / "coding" / "example_part.py").write_text(PART)
    (package / "coding" / "example_pair.py").write_text(PAIR)
    (package / "codec" / "example.py").write_text(EXAMPLE)
    assert used(package) == (["first_of", "half_place", "scaled"], (6, 10))
    return package


def used(package):
    """Return what a new process compiled and what it got."""
    environment = {**os.environ, "PYTHONPATH": str(package.parent)}
    environment |= {"NUMBA_CACHE_DIR": str(package.parent / "cache"), "NUMBA_DISABLE_JIT": "0"}
    environment |= {"TERRAINWAVE_NUMBA_CACHE": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", USE_KERNELS]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    *compiled, scaled, first = done.stdout.split()
    return compiled, (int(scaled), int(first))


def edit(path, old, new):
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


@pytest.mark.full
def test_files_that_a_kernel_does_not_import_recompile_nothing(copied):
    edit(copied / "terrain.py", '"""', '"""Edited. ')
    edit(copied / "coding" / "zerotrees.py", '"""', '"""Edited. ')
    assert used(copied)[0] == []


def test_a_constant_recompiles_the_kernels_whose_file_imports_it(copied):
    edit(copied / "coding" / "example_constants.py", "FACTOR = 2", "FACTOR = 5")
    compiled, (scaled, _) = used(copied)
    assert compiled == ["first_of", "scaled"]
    assert scaled == 15


@pytest.mark.full
def test_a_part_is_compiled_with_its_kernels_and_again_when_its_text_changes(copied):
    # The first use compiled no `times` by itself.
    edit(copied / "coding" / "example_part.py", "factor * number", "-factor * number")
    compiled, (scaled, _) = used(copied)
    assert compiled == ["first_of", "scaled"]
    assert scaled < 0


def test_fields_of_a_tuple_that_change_places_recompile_the_kernel_that_is_given_it(copied):
    edit(copied / "coding" / "example_pair.py", "first: int\n    second", "second: int\n    first")
    compiled, (_, first) = used(copied)
    assert compiled == ["first_of"]
    assert first == 10
