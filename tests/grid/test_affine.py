"""Affine arithmetic, beside the package `affine` and by hand."""

import affine as library
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.grid.affine import (
    bounds,
    determinant,
    of_level,
    of_window,
    pixels_to_places,
    places_to_pixels,
    places_to_samples,
    samples_to_places,
    without_shift,
)

NORTH_UP = (30.0, 0.0, 500000.0, 0.0, -30.0, 4100000.0)
TURNED = (8.0, 6.0, 1000.0, 6.0, -8.0, 2000.0)
SOUTH_UP = (0.25, 0.0, -120.0, 0.0, 0.25, 35.0)

SIZES = st.floats(-1e4, 1e4)


@given(transform=st.tuples(*[SIZES] * 6), row=SIZES, col=SIZES)
def test_the_inverse_is_that_of_the_affine_package(transform, row, col):
    linear = without_shift(transform)
    expected = library.Affine(*linear)
    assert determinant(transform) == expected.determinant
    if abs(expected.determinant) < 1:
        return
    a, b, _, d, e, _ = tuple(~expected)[:6]
    x, y = pixels_to_places(linear, row, col)
    rows, cols = places_to_pixels(linear, x, y)
    scale = max(map(abs, linear)) ** 2 / abs(expected.determinant)
    assert rows == pytest.approx(d * x + e * y, rel=1e-9, abs=1e-9 * scale * (abs(row) + abs(col)))
    assert cols == pytest.approx(a * x + b * y, rel=1e-9, abs=1e-9 * scale * (abs(row) + abs(col)))


@pytest.mark.parametrize("transform", [NORTH_UP, TURNED, SOUTH_UP])
def test_samples_on_whole_metres_come_back_whole(transform):
    rows, cols = (axis.ravel().astype(np.float64) for axis in np.mgrid[0:40000:997, 0:40000:991])
    found = places_to_samples(transform, *samples_to_places(transform, rows, cols))
    np.testing.assert_array_equal(found, (rows, cols))


def test_the_first_sample_of_every_level_lies_in_one_place():
    place = samples_to_places(TURNED, 0.0, 0.0)
    assert place == (1000 + 8 / 2 + 6 / 2, 2000 + 6 / 2 - 8 / 2)
    for stride in (1, 2, 4, 64):
        assert samples_to_places(of_level(TURNED, stride), 0.0, 0.0) == place


@pytest.mark.parametrize("transform", [NORTH_UP, TURNED, SOUTH_UP])
def test_samples_of_a_window_of_a_level_are_samples_of_the_full_grid(transform):
    placed = of_level(transform, 4, 3, 5)
    assert samples_to_places(placed, 2.0, 1.0) == samples_to_places(transform, 20.0, 24.0)


def test_a_window_begins_at_a_corner_of_a_pixel():
    assert of_window(NORTH_UP, 2, 3) == (30, 0, 500090, 0, -30, 4099940)


def test_bounds_are_those_of_pixels_or_of_samples():
    assert bounds(NORTH_UP, (10, 20)) == (500000, 4099700, 500600, 4100000)
    assert bounds(NORTH_UP, (10, 20), inset=0.5) == (500015, 4099715, 500585, 4099985)
    # Corners of the turned grid, by hand: (1000, 2000), + 2 columns, + 1 row, + both.
    assert bounds(TURNED, (1, 2)) == (1000, 1992, 1022, 2012)
