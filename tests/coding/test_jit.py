"""Does the cache of compiled kernels hold as long as the sources do, and no longer?"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

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


ALL = ["first_of", "half_place", "scaled"]


def test_a_constant_of_another_file_recompiles_the_kernels(copied):
    assert used(copied)[0] == []
    edit(copied / "coding" / "example_constants.py", "FACTOR = 2", "FACTOR = 5")
    assert used(copied) == (ALL, (15, 10))


@pytest.mark.full
def test_a_part_is_compiled_with_its_kernels_and_again_when_its_text_changes(copied):
    # The first use compiled no `times` by itself.
    edit(copied / "coding" / "example_part.py", "factor * number", "-factor * number")
    compiled, (scaled, _) = used(copied)
    assert compiled == ALL
    assert scaled < 0


def test_fields_of_a_tuple_that_change_places_recompile_the_kernel_that_is_given_it(copied):
    edit(copied / "coding" / "example_pair.py", "first: int\n    second", "second: int\n    first")
    compiled, (_, first) = used(copied)
    assert compiled == ALL
    assert first == 10
