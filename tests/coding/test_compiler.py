"""Do kernels that are called by kernels and by Python, or seldom, do what they should?"""

import os

import numba
import numpy as np
import pytest
from numba.core import event
from numba.core.compiler_lock import global_compiler_lock

from terrainwave.codec.rapid import file_tables as rapid_parameters
from terrainwave.codec.rapid.file_tables import (
    annex,
    pack_file_tables,
    parse_file_tables,
    plain_tables,
)
from terrainwave.coding import jit
from terrainwave.coding.jit import inlined_kernel, kernel, kernel_part, rare_kernel

needs_jit = pytest.mark.skipif(
    os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"}, reason="nothing is compiled"
)


@kernel
def doubled(number):
    return 2 * number


@inlined_kernel
def tripled(number):
    return 3 * number


@kernel_part
def summed(numbers):
    total = 0
    for number in numbers:
        total += doubled(number)
    return total


@kernel
def all_three(numbers):
    return summed(numbers) + tripled(numbers[0]) + doubled(numbers[1])


@kernel
def factorial(number):
    if number <= 1:
        return 1
    return number * factorial(number - 1)


@kernel
def of_factorials(number):
    return factorial(number) + factorial(number + 1)


@kernel
def filled(numbers):
    return numbers.sum() if numbers.shape[0] else np.zeros(4).sum()


@kernel
def of_library(n):
    return filled(np.arange(n))


@rare_kernel
def quadrupled(number):
    return doubled(doubled(number))


@numba.njit
def odd_numbers(n):
    for number in range(n):
        if number & 1:
            yield number


@kernel
def of_odd_numbers(n):
    total = 0
    for number in odd_numbers(n):
        total += number * number
    return total


def compiled_by(task):
    """Return the kernels, by name, that a task has compiled for Python."""
    with event.install_recorder("numba:compile") as recorder:
        task()
    functions = [e.data["dispatcher"].py_func for _, e in recorder.buffer]
    return {f.__name__ for f in functions if f.__module__ == __name__}


def test_kernels_parts_and_inlined_kernels_call_one_another():
    numbers = np.array([5, 7, 11])
    assert all_three(numbers) == 2 * (5 + 7 + 11) + 3 * 5 + 2 * 7


def test_kernels_may_call_themselves():
    assert factorial(5) == 120
    assert of_factorials(4) == 24 + 120


@pytest.mark.full
def test_parts_may_use_what_numba_brings():
    assert of_library(5) == 10
    assert of_library(0) == 0


def test_kernels_may_call_generators_of_numba():
    assert of_odd_numbers(5) == 1 + 9


@needs_jit
def test_a_rare_kernel_is_plain_until_it_has_taken_long(monkeypatch):
    monkeypatch.setattr(jit, "_is_patient", True)
    monkeypatch.setattr(quadrupled._compiled._cache, "load_overload", lambda *_: None)
    assert compiled_by(lambda: quadrupled(np.int16(3))) == set()
    assert quadrupled(np.int16(3)) == 12
    assert quadrupled._seconds > 0
    monkeypatch.setattr(quadrupled, "_seconds", 2.0)
    assert "quadrupled" in compiled_by(lambda: quadrupled(np.int16(3)))
    assert quadrupled(np.int16(3)) == 12


@needs_jit
def test_a_rare_kernel_is_looked_for_while_nobody_compiles(monkeypatch):
    """To look for one brings numba's tables up to date. Threads that compile then miss some."""
    held = []

    def look(*_):
        held.append(global_compiler_lock.is_locked())

    seldom = rare_kernel(quadrupled._compiled.py_func)
    monkeypatch.setattr(jit, "_is_patient", True)
    monkeypatch.setattr(seldom._compiled._cache, "load_overload", look)
    assert seldom(np.int32(3)) == 12
    assert held == [True]
    assert not global_compiler_lock.is_locked()


@needs_jit
def test_tables_of_files_are_the_same_by_plain_python(monkeypatch):
    codes = annex().codes[1, 5].copy()
    codes[np.flatnonzero(codes > 8)[:3]] -= 3
    tables = plain_tables(3, 1)._replace(codes={5: codes})
    compiled = pack_file_tables(tables)
    monkeypatch.setattr(jit, "_is_patient", True)
    monkeypatch.setattr(rapid_parameters._code_tables, "_is_compiled", False)
    monkeypatch.setattr(rapid_parameters._code_tables, "_is_cheap", lambda _: True)
    assert pack_file_tables(tables) == compiled
    plain = parse_file_tables(compiled, 3)
    assert plain.stencils == tables.stencils
    np.testing.assert_array_equal(plain.codes[5], codes)
