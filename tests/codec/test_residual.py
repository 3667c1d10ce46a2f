"""Residual quantiser against the formulas as Yusov & Turlapov 2010 print them (§2.1)."""

import numpy as np
import pytest

from terrainwave.codec.residual import compute_residuals


def residuals_of(errors, step):
    target = np.array([errors], dtype=np.int32)
    found = np.zeros_like(target)
    coded = np.ones(target.shape, dtype=np.bool_)
    compute_residuals(target, np.zeros_like(target), coded, step, found)
    return found[0]


@pytest.mark.parametrize("half", [0, 1, 2, 7, 50])
def test_finest_level_is_equation_1_on_the_grid(half):
    # With p = 1 and delta = half: floor((|r| + delta) / (2 delta + p)), the sign of r.
    errors = np.arange(-300, 301)
    printed = np.sign(errors) * ((np.abs(errors) + half) // (2 * half + 1))
    assert residuals_of(errors, 2 * half + 1).tolist() == printed.tolist()


@pytest.mark.parametrize("half", [1, 2, 7, 50])
def test_the_papers_coarse_quantiser_keeps_the_bound_but_costs_a_symbol_more(half):
    # Y10 for coarse levels: r~ = round(|r| / delta), rebuilt as (r~ + 1/2) delta, 0 as 0.
    errors = np.arange(0, 40 * half)
    symbols = np.floor(errors / half + 0.5)
    rebuilt = np.where(symbols > 0, (symbols + 0.5) * half, 0)
    assert np.abs(rebuilt - errors).max() <= half
    ours = residuals_of(errors, 2 * half + 1)
    # Steps of delta instead of 2 delta + p: about twice as many symbols for the same errors.
    assert symbols.max() >= 2 * ours.max()


def test_samples_that_are_not_coded_have_no_residual():
    target = np.array([[100, 100]], dtype=np.int32)
    found = np.zeros_like(target)
    coded = np.array([[True, False]])
    assert compute_residuals(target, np.zeros_like(target), coded, 3, found) == 1
    assert found.tolist() == [[33, 0]]
