"""The reversible 5/3 wavelet: its formulas by hand, exact inverses, held sides, windows."""

import numpy as np
import pytest

from terrainwave.coding.lifting53 import (
    HELD_BOTTOM,
    HELD_LEFT,
    HELD_RIGHT,
    HELD_TOP,
    forward_transform,
    inverse_transform,
    lowpass_window,
)

ALL_HELD = HELD_TOP + HELD_LEFT + HELD_BOTTOM + HELD_RIGHT


def noise(shape, seed=0):
    return np.random.default_rng(seed).integers(-1000, 1000, shape)


def test_a_row_by_hand():
    # d0 = 9 - (3 + 4 >> 1) = 6, d1 = 1 - (4 + 8 >> 1) = -5;
    # s0 = 3 + (6 + 6 + 2 >> 2) = 6, s1 = 4 + (6 - 5 + 2 >> 2) = 4, s2 = 8 + (-5 - 5 + 2 >> 2) = 6.
    field = np.array([[3, 9, 4, 1, 8]])
    forward_transform(field, 1, 0)
    assert field.tolist() == [[6, 4, 6, 6, -5]]


def test_held_ends_pass_unchanged():
    field = np.array([[3, 9, 4, 1, 8]])
    forward_transform(field, 1, HELD_LEFT + HELD_RIGHT)
    assert field.tolist() == [[3, 4, 8, 6, -5]]


@pytest.mark.parametrize("held", [0, HELD_TOP, HELD_RIGHT + HELD_BOTTOM, ALL_HELD])
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (2, 3), (5, 5), (8, 6), (17, 9)])
def test_the_inverse_is_exact(shape, held):
    heights = noise(shape)
    field = heights.copy()
    forward_transform(field, 3, held)
    np.testing.assert_array_equal(inverse_transform(field, 3, held)[-1], heights)


def test_the_inverse_gives_the_bands_of_every_level():
    heights = noise((9, 13))
    field, once = heights.copy(), heights.copy()
    forward_transform(field, 3, 0)
    forward_transform(once, 1, 0)
    np.testing.assert_array_equal(inverse_transform(field, 3, 0)[1], once[:5, :7])


def test_a_constant_has_no_details():
    field = np.full((9, 9), 7)
    forward_transform(field, 2, HELD_TOP)
    assert (field[:3, :3] == 7).all()
    assert np.count_nonzero(field) == 9


def test_tiles_agree_on_a_border_they_hold():
    heights = noise((17, 33))
    left, right = heights[:, :17].copy(), heights[:, 16:].copy()
    forward_transform(left, 2, HELD_RIGHT)
    forward_transform(right, 2, HELD_LEFT)
    for t in (2, 1):
        n = (16 >> t) + 1
        edge = inverse_transform(left.copy(), 2, HELD_RIGHT)[2 - t - 1][:, -1] if t < 2 else None
        if edge is not None:
            np.testing.assert_array_equal(
                edge, inverse_transform(right.copy(), 2, HELD_LEFT)[2 - t - 1][:, 0]
            )
        assert left[:n, n - 1].tolist() == right[:n, 0].tolist() or t == 1


@pytest.mark.parametrize("window", [(0, 0, 9, 17), (0, 3, 4, 5), (5, 9, 4, 8), (8, 16, 1, 1)])
def test_a_window_is_the_low_band_of_tiles(window):
    row, col, n_rows, n_cols = window
    heights = noise((17, 33)).astype(np.int32)
    left, right = heights[:, :17].astype(np.int64), heights[:, 16:].astype(np.int64)
    forward_transform(left, 1, HELD_RIGHT)
    forward_transform(right, 1, HELD_LEFT)
    expected = np.hstack([left[:9, :9], right[:9, 1:9]])
    first = max(2 * row - 2, 0), max(2 * col - 2, 0)
    fine = heights[first[0] : 2 * (row + n_rows) + 1, first[1] : 2 * (col + n_cols) + 1]
    found = lowpass_window(fine, first, (17, 33), (row, col), (n_rows, n_cols), 16, (1, 2))
    np.testing.assert_array_equal(found, expected[row : row + n_rows, col : col + n_cols])
