"""What the benchmarks of the papers' systems count and change."""

import numpy as np
import pytest

outlines = pytest.importorskip("benchmarks.outlines")
zerotrees = pytest.importorskip("benchmarks.zerotrees")


def test_a_pixel_lacks_ground_only_where_all_of_it_is_ground():
    fine = np.zeros((20 * outlines.PARTS, 30 * outlines.PARTS), dtype=bool)
    fine[:, : 10 * outlines.PARTS] = True  # nothing there
    fine[83, 203] = True  # a void smaller than a pixel, in that of row 10 and column 25
    parts = outlines.parts_of(fine)
    found = parts > 0
    assert outlines.counts(parts, found, 1.0) == (20 * 20 - 1, 0, 0)
    found[3, 15] = found[10, 24] = found[5, 11] = True  # the last two are near voids
    found[3, 4] = found[3, 9] = False
    assert outlines.counts(parts, found, 1.0) == (20 * 20 - 1, 1, 1)


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


def test_bounds_that_grow_double_with_each_coarser_level():
    from terrainwave.codec import unit_specs

    fields = {
        "step": 7, "z_min": 0, "z_max": 9, "forbidden": (1, 0), "rings": 1, "effort": 0,
        "core": None, "region": None, "parent_region": None, "shared": None,
    }  # fmt: skip
    with zerotrees.growing_bounds(2, k_max=3):
        halves = [unit_specs.GroupSpec(**fields, level=level).half for level in range(4)]
    assert halves == [24, 12, 6, 3]
    assert unit_specs.GroupSpec(**fields, level=0).half == 3
