"""Index arithmetic: levels, blocks, groups, segments. Numbers by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.grid.quadtree import Block, Grid, Region, morton

grids = st.builds(
    Grid, st.integers(1, 1500), st.integers(1, 1500), st.sampled_from([32, 64, 128])
) | st.builds(Grid, st.integers(1, 40_000), st.integers(1, 40), st.just(32))
regions = st.builds(
    Region, st.integers(-9, 9), st.integers(-9, 9), st.integers(0, 9), st.integers(0, 9)
)


def parents(grid):
    return [block for level in range(grid.k_max) for block in grid.blocks(level)]


@pytest.mark.parametrize(
    ("n_rows", "n_cols", "block", "k_max"),
    [
        (1, 1, 32, 0),
        (33, 7, 32, 0),  # 32 cells are one block of 32
        (34, 7, 32, 1),
        (65, 65, 32, 1),
        (66, 1, 32, 2),
        (1, 66, 32, 2),
        (257, 257, 256, 0),
        (16384, 16384, 256, 6),  # 16383 / 64 cells, rounded up, are 256
        (2**31, 2**19, 1024, 21),
    ],
)
def test_k_max_is_the_smallest_with_one_root(n_rows, n_cols, block, k_max):
    assert Grid(n_rows, n_cols, block).k_max == k_max


def test_a_strip_does_not_pad_to_a_square():
    grid = Grid(100_000, 500, 256)
    assert grid.k_max == 9
    assert grid.level_blocks(0) == (1, 1)
    assert grid.level_blocks(2) == (4, 1)
    assert grid.level_blocks(9) == (391, 2)


@given(grids)
def test_level_samples_are_every_second_sample_of_the_next(grid):
    for level in range(grid.k_max):
        n_rows, n_cols = grid.level_shape(level + 1)
        expected = len(range(0, n_rows, 2)), len(range(0, n_cols, 2))
        assert grid.level_shape(level) == expected


@given(grids)
def test_the_finest_level_is_the_raster(grid):
    assert grid.level_shape(grid.k_max) == (grid.n_rows, grid.n_cols)


def test_stride_halves_from_level_to_level():
    grid = Grid(100, 100, 32)
    assert [grid.stride(level) for level in range(3)] == [4, 2, 1]


@given(grids)
def test_blocks_of_a_level_cover_its_samples_and_share_only_borders(grid):
    for level in {0, grid.k_max // 2, grid.k_max}:
        for axis in (0, 1):
            n = grid.level_shape(level)[axis]
            count = np.zeros(n, dtype=int)
            for index in range(grid.level_blocks(level)[axis]):
                place = Block(level, index, 0) if axis == 0 else Block(level, 0, index)
                region = grid.block_region(place)
                first, size = (region.row, region.n_rows) if axis == 0 else region[1:4:2]
                assert size >= 1
                count[first : first + size] += 1
            inner = np.arange(n) % grid.block == 0
            inner[0] = False
            # The last line is shared only if cells lie beyond it, outside the raster.
            assert (count[:-1] == 1 + inner[:-1]).all()
            assert count[-1] in (1, 1 + inner[-1])


@given(grids)
def test_children_cover_the_group_of_their_parent(grid):
    for parent in parents(grid)[:: max(1, len(parents(grid)) // 20)]:
        group = grid.group_region(parent)
        covered = np.zeros(group.shape, dtype=bool)
        for child in grid.children(parent):
            part = grid.block_region(child)
            assert part.intersect(group) == part
            covered[part.slices_in(group)] = True
        assert covered.all()


@given(grids)
def test_every_block_but_the_root_is_a_child_of_its_parent(grid):
    for level in range(1, grid.k_max + 1):
        found = [child for parent in grid.blocks(level - 1) for child in grid.children(parent)]
        assert sorted(found) == sorted(grid.blocks(level))
        assert all(block in grid.children(block.parent) for block in found[:50])


@given(grids, st.sampled_from([0, 1]))
def test_even_samples_of_a_group_lie_on_its_parent(grid, apron):
    for parent in parents(grid)[:30]:
        group, above = grid.group_region(parent, apron), grid.block_region(parent, apron)
        rows = [r // 2 for r in range(group.row, group.row + group.n_rows) if r % 2 == 0]
        cols = [c // 2 for c in range(group.col, group.col + group.n_cols) if c % 2 == 0]
        assert min(rows) >= above.row
        assert max(rows) < above.row + above.n_rows
        assert min(cols) >= above.col
        assert max(cols) < above.col + above.n_cols


@given(grids)
def test_full_regions_of_a_level_cover_the_raster(grid):
    for level in range(grid.k_max + 1):
        blocks = grid.blocks(level)
        assert max(sum(grid.full_region(b)[0:3:2]) for b in blocks) == grid.n_rows
        assert max(sum(grid.full_region(b)[1:4:2]) for b in blocks) == grid.n_cols


def test_the_full_region_of_a_block_ends_with_the_raster():
    grid = Grid(300, 200, 32)  # strides 16, 8, 4, 2, 1
    assert grid.full_region(Block(2, 2, 1)) == Region(256, 128, 44, 72)
    assert grid.full_region(Block(2, 0, 0)) == Region(0, 0, 129, 129)
    assert grid.full_region(Block(0, 0, 0)) == Region(0, 0, 300, 200)


def test_an_apron_adds_one_sample_where_the_raster_goes_on():
    grid = Grid(300, 300, 32)
    assert grid.block_region(Block(4, 0, 3), apron=1) == Region(0, 95, 34, 35)
    assert grid.group_region(Block(3, 4, 0), apron=1) == Region(255, 0, 45, 66)


def test_contains_knows_the_corners_of_the_tree():
    grid = Grid(300, 100, 32)
    assert grid.contains(Block(0, 0, 0))
    assert not grid.contains(Block(0, 1, 0))
    assert not grid.contains(Block(0, 0, 1))
    assert grid.level_blocks(2) == (3, 1)
    assert grid.contains(Block(2, 2, 0))
    assert not grid.contains(Block(2, 3, 0))
    assert not grid.contains(Block(2, 0, 1))
    assert not grid.contains(Block(-1, 0, 0))
    assert not grid.contains(Block(5, 0, 0))


@pytest.mark.parametrize(
    ("row", "col", "number"), [(0, 0, 0), (0, 1, 1), (1, 0, 2), (1, 1, 3), (2, 0, 8), (3, 5, 27)]
)
def test_morton_numbers_have_the_rows_bits_above_the_columns(row, col, number):
    assert morton(row, col) == number  # 3 = 011, 5 = 101: 01 10 11 is 27


@given(grids)
def test_segments_partition_all_groups_exactly_once(grid):
    found = [group for head in grid.segment_heads() for group in grid.segment_groups(head)]
    assert len(found) == len(set(found))
    assert sorted(found) == sorted(parents(grid))


@given(grids)
def test_every_group_knows_the_head_of_its_segment(grid):
    for head in grid.segment_heads():
        assert {grid.segment_head(group) for group in grid.segment_groups(head)} <= {head}


@given(grids)
def test_groups_of_a_segment_are_in_file_order(grid):
    for head in grid.segment_heads():
        order = [(g.level, morton(g.row, g.col)) for g in grid.segment_groups(head)]
        assert order == sorted(order)


@given(grids)
def test_segments_are_in_file_order(grid):
    heads = list(grid.segment_heads())
    assert heads[0] is None
    order = [(head.level, morton(head.row, head.col)) for head in heads[1:]]
    assert order == sorted(order)


def cells(region):
    return {
        (row, col)
        for row in range(region.row, region.row + region.n_rows)
        for col in range(region.col, region.col + region.n_cols)
    }


@given(region=regions, n_rows=st.integers(1, 4), n_cols=st.integers(1, 4), is_aligned=st.booleans())
def test_tiles_cover_a_region_once_in_the_order_of_rows(region, n_rows, n_cols, is_aligned):
    covered = np.zeros(region.shape, dtype=np.int64)
    tiles = list(region.tiles(n_rows, n_cols, is_aligned=is_aligned))
    for tile in tiles:
        assert 0 < tile.n_rows <= n_rows
        assert 0 < tile.n_cols <= n_cols
        covered[tile.slices_in(region)] += 1
    assert (covered == 1).all()
    assert tiles == sorted(tiles)
