"""Shares of threads: everything once, and seldom two in turn below the same block."""

import pytest

from terrainwave.grid.quadtree import Grid
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
