"""Sources of what stored meshes follow, by their kind.

Zero trees (Yusov & Turlapov 2010, §2.4), or wavelet coefficients (Zheng, Wang, Wang).
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Block
from terrainwave.names import UNBOUNDED_MESHES
from terrainwave.read.decoder import TreeDecoder, unit_key
from terrainwave.read.tile_decoder import with_coefficients
from terrainwave.tri.zerotree.labels import Trees
from terrainwave.tri.zerotree.layer_trees import layer_trees

# Returns the trees of a block and its tolerance, in 1/16 quanta; None if the group below it has
# none.
ZeroTrees = Callable[[Block, int], Trees | None]
# Returns magnitudes in quanta at the samples of a block that lie inside the raster.
BlockCoefficients = Callable[[Block], NDArray[np.int64]]


def layer_source(decoder: TreeDecoder) -> ZeroTrees:

    def trees(block: Block, tolerance: int) -> Trees:
        grid = decoder.grid
        _, own = decoder.part(unit_key(block), grid.block_region(block))
        _, finer = decoder.part(block, grid.group_region(block))
        return layer_trees(
            np.ascontiguousarray(own.heights), own.mask, finer.heights, finer.mask, tolerance
        )

    return trees


def coded_source(decoder: TreeDecoder) -> ZeroTrees:
    """Return the trees that payloads have coded; a unit of plain bits has none."""
    return lambda block, _: decoder.unit(block).labels


_SOURCES = {"zerotree-layer": layer_source, "zerotree-coded": coded_source}


def tree_source(kind: str, decoder: TreeDecoder) -> ZeroTrees | None:
    """Return the source of zero trees for a kind of meshes; None if it has none."""
    source = _SOURCES.get(kind)
    return None if source is None else source(decoder)


def coefficient_source(kind: str, decoder: TreeDecoder) -> BlockCoefficients | None:
    """Return the source of coefficients for a kind of meshes; None if it follows none."""
    if kind not in UNBOUNDED_MESHES:
        return None
    tiled = with_coefficients(decoder)
    return lambda block: tiled.coefficients(block.level, decoder.grid.block_region(block))
