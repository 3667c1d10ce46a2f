"""What the benchmarks of the papers' systems count and change."""

import numpy as np
import pytest

zerotrees = pytest.importorskip("benchmarks.zerotrees")
zhang = pytest.importorskip("benchmarks.zhang")


def test_nevilles_filter_of_order_four_is_exact_for_cubics():
    def height(row, col):
        return row**3 - row * col**2 + 3 * col - 5

    row, col = np.mgrid[0:12, 0:15].astype(float)
    wide, ring = zerotrees.interpolated(height(row, col)), 2 * zerotrees.RING
    row, col = (
        axis / 2 - zerotrees.RING for axis in np.mgrid[0 : wide.shape[0], 0 : wide.shape[1]]
    )
    inside = slice(ring + 4, -ring - 5)
    np.testing.assert_allclose(wide[inside, inside], height(row, col)[inside, inside], atol=1e-9)


def test_equation_one_takes_four_by_four_samples_and_lies_in_their_middle():
    # Of order 4: exact for cubics, in the middle of the four samples that a coarse one replaces.
    def height(row, col):
        return row**3 - row * col**2 + 3 * col - 5

    row, col = np.mgrid[0:12, 0:16].astype(float)
    coarse = zhang.paper_level(height(row, col), 4)
    row, col = (2 * axis + 0.5 for axis in np.mgrid[0:6, 0:8].astype(float))
    inside = slice(1, -1), slice(1, -1)
    np.testing.assert_allclose(coarse[inside], height(row, col)[inside], atol=1e-9)
    one = np.zeros((12, 16))
    one[5, 7] = 32.0
    # H(i, j) sums m = 2i - 1 ... 2i + 2 and n alike: (5, 7) is second or last of two each.
    expected = np.zeros((6, 8))
    expected[2, 3], expected[2, 4], expected[3, 3], expected[3, 4] = 10, -1, -1, 0
    np.testing.assert_array_equal(zhang.paper_level(one, 4), expected)
    # Past the edge samples are repeated, and so is what ends half a sample outside.
    assert (zhang.paper_level(np.full((5, 7), 9.0), 4) == 9).all()
    assert zhang.paper_level(np.ones((5, 7)), 2).shape == (3, 4)
