"""What the benchmarks of the papers' systems count and change."""

from unittest import mock

import numpy as np
import pytest

from terrainwave.coding.rangecoder import new_encoder

outlines = pytest.importorskip("benchmarks.outlines")
zerotrees = pytest.importorskip("benchmarks.zerotrees")
zhang = pytest.importorskip("benchmarks.zhang")


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


def test_a_levels_triangles_are_cut_from_the_first_corner_to_the_last():
    vertices = np.array([[0.0, 8.0, 8.0], [0.0, 4.0, 8.0]])
    # Vertices at 1.5 + 4 k: samples 2 and 4 of a row lie at 1/8 and 5/8 of the first cell.
    found = zhang.surface(vertices, 1.5, 4, (8, 12))
    assert found[0, 0] == 0.0  # beyond the outermost vertices
    assert found[0, 4] == 8 * 5 / 8
    assert found[2, 4] == 8 * 5 / 8 + (4 - 8) / 8  # right of the cut
    assert found[4, 2] == 4 / 8  # left of it
    assert found[7, 11] == 8.0


def test_blocks_are_measured_where_their_triangles_are(tmp_path):
    from rasterio.transform import Affine

    from benchmarks.rasters import Raster, write_geotiff

    random = np.random.default_rng(3)
    heights = np.round(200 * random.random((150, 200))).cumsum(1).astype(np.int16)
    mask, path = np.ones(heights.shape, dtype=bool), tmp_path / "a.tif"
    transform = Affine(30, 0, 500000, 0, -30, 5200000)
    write_geotiff(Raster("a", heights, mask, 1.0, None, transform, "EPSG:32633"), path)
    with zhang.lossless(path, tmp_path) as terrain:
        levels = zhang.Levels(terrain)
        grid = levels.terrain.grid
        for order in zhang.ORDERS:
            errors, bounds = levels.block_errors("ours", order), levels.bounds(order)
            assert errors.keys() == bounds.keys()
            # The viewer's bounds hold, and of the level above the finest they are exact.
            assert all(errors[block] <= bounds[block] * (1 + 1e-6) for block in bounds)
            second = [block for block in bounds if block.level == grid.k_max - 1]
            assert [errors[b] for b in second] == pytest.approx(
                [bounds[b] for b in second], rel=1e-4
            )
        theirs = levels.block_errors("paper", 4)
        assert all((theirs[block] == 0) == (block.level == grid.k_max) for block in theirs)


@pytest.mark.parametrize("rings", [1, 3])
@pytest.mark.parametrize("size", [(65, 66), (18, 41)])
def test_contours_as_the_paper_has_them_are_alike_in_neighbours(size, rings):
    from lone_units import check_neighbours, terrain

    from terrainwave.codec.cdf97.refiner import Cdf97Refiner
    from terrainwave.codec.shared_lines import shared_samples
    from terrainwave.coding.filters import lowpass_analysis
    from terrainwave.grid.quadtree import Grid

    grid, levels = Grid(*size, 8), [terrain(size, seed=7)]
    for level in range(grid.k_max - 1, -1, -1):
        fine = levels[-1]
        levels.append(lowpass_analysis(fine, (0, 0), fine.shape, (0, 0), grid.level_shape(level)))
    masks = [np.ones(level.shape, dtype=bool) for level in levels]
    contours, n_coded = zerotrees.Contours(), []
    contours.train()

    def code(spec, parent, target, mask, coder, heights, is_known, *, is_nested):
        contours.code(spec, parent, target, mask, coder, heights, is_known, is_nested=is_nested)
        if parent is not None:
            assert (is_known == shared_samples(spec)).all()
        if target is not None:
            # Equation (1), by hand: the middle of the step in which a height is.
            steps = target[is_known] // spec.step * spec.step + spec.step // 2
            assert (heights[is_known] == steps).all()
            n_coded.append(int(is_known.sum()))

    with mock.patch.object(zerotrees.refiner, "code_border", code):
        check_neighbours(Cdf97Refiner(), grid, levels[::-1], rings, 0, masks[::-1])
    assert sum(n_coded) > 100


def test_differences_of_a_contour_cost_what_the_previous_one_does_not_tell():
    # 0, ±1, ±2 and again; the first sign at random, the second like it: 1/3 bit each.
    random, step = np.random.default_rng(6), 5
    apart = np.outer(random.choice((-1, 1), 8000), (0, 1, 2)).ravel()
    goals = step * (1000 + np.cumsum(apart)) + random.integers(0, step, len(apart))
    models = zerotrees.new_models(zerotrees.N_CONTOUR_MODELS)
    coder = new_encoder(np.zeros(1 << 16, dtype=np.uint8), models)
    before, out = zerotrees.bits_of(coder.state), np.empty(len(goals), dtype=np.int64)
    mask = np.ones(len(goals), dtype=bool)
    zerotrees.code_contour(goals, mask, np.int64(step), 1000, coder, out)
    assert np.abs(out - goals).max() == step // 2
    bits = (zerotrees.bits_of(coder.state) - before) / len(goals)
    assert bits == pytest.approx(1 / 3, rel=0.06)
