"""Shares of threads: everything once, and seldom two in turn below the same block."""

import itertools

import pytest

from terrainwave.grid.quadtree import Grid, Region
from terrainwave.grid.shares import shares_of


def place(block):
    return block.row, block.col


@pytest.mark.parametrize("shape", [(1, 1), (40, 40), (200, 1), (333, 500), (1000, 700)])
def test_each_block_is_in_one_share_with_its_siblings(shape):
    grid = Grid(*shape, 32)
    blocks = grid.blocks(grid.k_max)
    shares = shares_of(blocks, place)
    assert sorted(block for share in shares for block in share) == sorted(blocks)
    parents = [{block.parent for block in share} for share in shares]
    assert all(len(own) == 1 for own in parents)
    assert len(set.union(*parents)) == len(shares)


def test_shares_in_turn_lie_below_different_blocks():
    grid = Grid(1025, 1025, 32)
    shares = shares_of(grid.blocks(grid.k_max), place)
    above = [share[0].parent.parent for share in shares]
    assert all(one != other for one, other in itertools.pairwise(above))
    # And not too many are in use at a time.
    last = {block: index for index, block in enumerate(above)}
    for index in range(len(above)):
        assert sum(1 for b in set(above[: index + 1]) if last[b] > index) <= 8


def test_anything_with_a_place_can_be_shared():
    windows = list(Region(0, 0, 900, 300).tiles(100, 100))
    shares = shares_of(windows, lambda window: (window.row // 100, window.col // 100))
    assert sorted(window for share in shares for window in share) == sorted(windows)
    assert shares_of([], place) == []
