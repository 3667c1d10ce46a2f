"""How much of a file's zero trees is significant (Yusov & Turlapov 2010, §2.4)."""

from typing import NamedTuple

import numpy as np

from terrainwave.grid.quadtree import Block
from terrainwave.read.decoder import TreeDecoder


class NodeCount(NamedTuple):
    """How many of the finest nodes of a level's trees have a coefficient that is not 0.

    A block has as many of these nodes as samples. Blocks whose group has no trees (all void, or raw
    heights) are left out.
    """

    n_significant: int
    n_nodes: int


def count_significant(decoder: TreeDecoder) -> list[NodeCount]:
    """Count the nodes of the trees that payloads of a faithful file code.

    Returns
    -------
    list of NodeCount
        Of the blocks of each level that a group refines: of all levels but the finest. Zeros where
        the file is not faithful.

    Notes
    -----
    Decodes all of the file, depth first.
    """
    counts = np.zeros((decoder.grid.k_max, 2), dtype=np.int64)
    for root in decoder.grid.blocks(0):
        _count_below(decoder, root, counts)
    return [NodeCount(int(significant), int(nodes)) for significant, nodes in counts]


def _count_below(decoder: TreeDecoder, key: Block, counts: np.ndarray) -> None:
    """Add the trees of the group below a block, and of all groups below that."""
    if key.level == decoder.grid.k_max or not decoder.block(key).mask.any():
        return
    trees = decoder.unit(key).labels
    if trees is not None:
        counts[key.level] += np.count_nonzero(trees == 0), trees.size
    for child in decoder.grid.children(key):
        _count_below(decoder, child, counts)
