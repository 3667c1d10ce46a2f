"""Stored errors and boxes of blocks against the slow reference (FORMAT.md §4.4)."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference import bilinear_error, level_mask, surface_at
from strategies import terrain_like, valid_masks
from twz import twz_bytes

from terrainwave.container.page import decode_error, decode_range, encode_error, encode_range
from terrainwave.grid.block_stats import measure_block
from terrainwave.grid.quadtree import Region
from terrainwave.mesh.sections import mesher_of
from terrainwave.terrain import Terrain


@given(
    st.integers(0, 2**32 - 1),
    st.tuples(st.integers(1, 5), st.integers(1, 5)),
    st.sampled_from([1, 2, 4]),
    st.data(),
)
def test_the_error_of_a_block_is_that_of_the_slow_reference(seed, shape, stride, data):
    rng = np.random.default_rng(seed)
    heights = rng.integers(-1000, 1000, shape).astype(np.int32)
    # A window under the block that may reach into the cell past its last sample.
    row = data.draw(st.integers(0, (shape[0] - 1) * stride))
    col = data.draw(st.integers(0, (shape[1] - 1) * stride))
    n_rows = data.draw(st.integers(1, shape[0] * stride - row))
    n_cols = data.draw(st.integers(1, shape[1] * stride - col))
    originals = rng.integers(-1000, 1000, (n_rows, n_cols)).astype(np.int32)
    valid = data.draw(valid_masks((n_rows, n_cols)))
    exact = bilinear_error(heights, stride, originals, valid, row, col)
    expected = -(-exact.numerator // exact.denominator)
    assert measure_block(heights, stride, originals, valid, row, col) == expected


def test_a_tent_over_a_plain_has_its_height_as_error():
    # One row of samples 0, 8 with stride 4: the surface is 0 2 4 6 8.
    heights = np.array([[0, 8]], dtype=np.int32)
    originals = np.array([[0, 2, 9, 6, 8]], dtype=np.int32)
    assert measure_block(heights, 4, originals, originals >= 0, 0, 0) == 5


@given(st.integers(0, 2**31))
def test_a_code_stands_for_at_least_its_error(error):
    assert decode_error(encode_error(error)) >= error


@given(st.integers(0, 2**31))
def test_a_code_is_the_smallest_that_does(error):
    code = encode_error(error)
    assert code == 0 or decode_error(code - 1) < error


boxes = st.lists(st.integers(-(2**30), 2**30), min_size=4, max_size=4).map(sorted)


@given(boxes)
def test_a_decoded_box_holds_the_one_encoded_and_is_hardly_larger(box):
    outer_low, low, high, outer_high = box
    below, above = encode_range(low, high, outer_low, outer_high)
    found = decode_range(below, above, outer_low, outer_high)
    allowed = (outer_high - outer_low) / 255 + 1
    assert max(outer_low, low - allowed) <= found[0] <= low
    assert high <= found[1] <= min(outer_high, high + allowed)


def test_boxes_are_rounded_as_the_format_says():
    # (100 - 0) * 255 / 1000 = 25.5 and (1000 - 900) * 255 / 1000 = 25.5; 25 * 1000 / 255 = 98.04
    assert encode_range(100, 900, 0, 1000) == (25, 25)
    assert decode_range(25, 25, 0, 1000) == (98, 902)


class File:
    """A compressed raster with everything that is said and decoded of its blocks."""

    def __init__(self, heights, valid, **options):
        nodata = None if valid.all() else -32768
        self.originals = np.where(valid, heights, -32768).astype(heights.dtype)
        self.valid = valid
        data = twz_bytes(self.originals, nodata=nodata, **options)
        with Terrain(data, threads=1) as terrain:
            self.grid = grid = terrain.grid
            self.blocks = [b for level in range(grid.k_max + 1) for b in grid.blocks(level)]
            quantizer = terrain.quantizer
            self.quantum = Fraction(quantizer.numerator, quantizer.denominator)
            self.base, self.whole = quantizer.base, (quantizer.z_min, quantizer.z_max)
            apron = 1 if options.get("border_rings") == 3 else 0
            units = {b: terrain.decoder.block(b) for b in self.blocks}
            at = {b: grid.block_region(b).slices_in(grid.block_region(b, apron)) for b in units}
            self.decoded = {b: unit.heights[at[b]] for b, unit in units.items()}
            self.masks = {b: unit.mask[at[b]] for b, unit in units.items()}
            self.stored = {b: terrain.block_error(b) for b in self.blocks}
            self.codes = {b: terrain.container.codes(b) for b in self.blocks}
            self.bound = terrain.effective_error
            if terrain.mesh_kind != "none":
                self.mesh_errors = {b: terrain.mesh_error(b) for b in self.blocks}
                mesher = mesher_of(terrain)
                self.tolerances = {b: mesher.tolerance(b) / 16 * self.quantum for b in self.blocks}

    def by_recursion(self, block):
        """Return Err_Appr of Yusov & Turlapov 2010, (2), over blocks with originals.

        Or the true error where that is larger: past the last samples of a coarse level.
        """
        if block.level == self.grid.k_max:
            return self.bound
        children = [b for b in self.grid.children(block) if self.quanta_under(b).size]
        errors = [self.by_recursion(child) for child in children]
        first = self.grid.block_region(block)
        apart = 0
        for child in children:
            region = self.grid.block_region(child)
            for row, col in np.argwhere(self.masks[child]).tolist():
                at = region.row + row - 2 * first.row, region.col + col - 2 * first.col
                if at[0] <= 2 * (first.n_rows - 1) and at[1] <= 2 * (first.n_cols - 1):
                    there = surface_at(self.decoded[block], 2, *at)
                    apart = max(apart, abs(there - int(self.decoded[child][row, col])))
        error = max(errors) + float(apart * self.quantum) + self.bound
        return max(error, self.true_error(block))

    def true_error(self, block):
        """Return the largest distance of the originals from the decoded surface, in raw units."""
        at = self.grid.full_region(block).slices_in(Region(0, 0, *self.originals.shape))
        stride = self.grid.stride(block.level)
        return max(
            (
                abs(
                    (surface_at(self.decoded[block], stride, row, col) + self.base) * self.quantum
                    - Fraction(float(self.originals[at][row, col]))
                )
                for row, col in np.argwhere(self.valid[at]).tolist()
            ),
            default=Fraction(0),
        )

    def box(self, block):
        """Return the stored box: relative to the parent's within a segment, else to the file's."""
        outer = self.whole
        if block.level > 0 and self.grid.segment_head(block.parent) != block.parent:
            outer = self.box(block.parent)
        return decode_range(*self.codes[block][:2], *outer)

    def quanta_under(self, block):
        """Return the originals under a block, in quanta."""
        at = self.grid.full_region(block).slices_in(Region(0, 0, *self.originals.shape))
        raw = self.originals[at][self.valid[at]].astype(np.int64)
        return raw // int(self.quantum) - self.base


def file_of(name, **options):
    kind, method, *numbers = name.split()
    max_error, rings = map(int, numbers)
    heights = terrain_like(140, 9, seed=4) if kind == "whole" else terrain_like(261, 12, seed=5)
    if kind == "edge":  # steep past the last row of level 0
        heights = np.where(np.arange(36)[:, None] < 35, 0, 900).repeat(3, axis=1).astype("int16")
    valid = np.ones(heights.shape, dtype=bool)
    if kind == "holed":
        valid = np.random.default_rng(5).random(heights.shape) < 0.98
        valid[90:170] = False  # two blocks of the finest level
    return File(heights, valid, method=method, max_error=max_error, border_rings=rings, **options)


WHOLE = ["whole store 4 1", "whole cdf97 4 1", "whole cdf97 0 1"]
HOLED = ["holed store 2 1", "holed cdf97 2 1", "holed cdf97 2 3"]


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(name, marks=pytest.mark.large if "cdf97" in name else ())
        for name in WHOLE + HOLED
    ],
)
def file(request):
    return file_of(request.param)


@pytest.mark.few(2)
def test_stored_errors_are_at_least_the_true_ones_and_hardly_larger(file):
    for block in file.blocks:
        error = file.true_error(block)
        assert error <= file.stored[block] <= 1.2 * error + file.quantum, block


@pytest.mark.few(1)
@pytest.mark.large
@pytest.mark.parametrize("name", ["whole cdf97 4 1", "holed cdf97 2 3", "edge cdf97 4 1"])
def test_errors_of_a_faithful_file_are_those_of_the_papers_recursion(name):
    file = file_of(name, faithful=True, mesh="halves")
    for block in file.blocks:
        stored, tolerance = file.stored[block], file.tolerances[block]
        if not file.quanta_under(block).size:
            assert file.codes[block] == (0, 0, 0, 0)
            continue
        assert stored >= file.true_error(block), block
        # Codes are rounded up to eight steps an octave.
        by_recursion = file.by_recursion(block)
        assert by_recursion <= stored <= 9 / 8 * by_recursion + 1, block
        if file.mesh_errors[block]:
            assert file.mesh_errors[block] >= stored + tolerance, block


@pytest.mark.large
def test_stored_errors_cover_what_rounding_to_the_quantum_lost():
    heights = np.random.default_rng(6).normal(0, 30, (131, 5)).cumsum(0).astype("float32")
    file = File(heights, heights == heights, method="cdf97", max_error=0.3)
    for block in file.blocks:
        # The decoded heights are rounded once more, to float32.
        assert file.stored[block] >= file.true_error(block), block


def test_boxes_hold_the_originals_under_them(file):
    for block in file.blocks:
        heights = file.quanta_under(block)
        if heights.size:
            low, high = file.box(block)
            assert low <= heights.min() <= heights.max() <= high, block


def test_boxes_hold_all_decoded_heights_of_their_own_and_below_them(file):
    for block in file.blocks:
        heights = file.decoded[block][file.masks[block]]
        above = block
        while heights.size and above.level >= 0:
            low, high = file.box(above)
            assert low <= heights.min() <= heights.max() <= high, (block, above)
            if above.level == 0:
                break
            above = above.parent


def test_blocks_without_heights_have_codes_of_zero():
    file = file_of(HOLED[0])
    empty = [block for block in file.blocks if not file.quanta_under(block).size]
    assert empty
    assert {file.codes[block] for block in empty} == {(0, 0, 0, 0)}


def test_masks_of_blocks_are_as_the_definition_says(file):
    for block in file.blocks:
        mask = level_mask(file.valid, file.grid.k_max - block.level)
        at = file.grid.block_region(block).slices_in(Region(0, 0, *mask.shape))
        np.testing.assert_array_equal(file.masks[block], mask[at])


@pytest.mark.large
@pytest.mark.parametrize("n_rows", [300, 1030])  # the root or level 2's blocks head segments
def test_boxes_begin_anew_in_segments_below_the_top_one(n_rows):
    heights = terrain_like(n_rows, 2, seed=7)
    file = File(heights, heights > -1000, method="store", max_error=1)
    for block in file.blocks:
        quanta = file.quanta_under(block)
        low, high = file.box(block)
        assert low <= quanta.min() <= quanta.max() <= high, block
