"""Wavelet coefficients that stored meshes follow, by their kind (Zheng, Wang, Wang)."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Block
from terrainwave.names import UNBOUNDED_MESHES
from terrainwave.read.decoder import TreeDecoder
from terrainwave.read.tile_decoder import with_coefficients

# Returns magnitudes in quanta at the samples of a block that lie inside the raster.
BlockCoefficients = Callable[[Block], NDArray[np.int64]]


def coefficient_source(kind: str, decoder: TreeDecoder) -> BlockCoefficients | None:
    """Return the source of coefficients for a kind of meshes; None if it follows none.

    Raises
    ------
    InvalidArgumentError
        If it does, and the file's method has none.
    """
    if kind not in UNBOUNDED_MESHES:
        return None
    tiled = with_coefficients(decoder)
    return lambda block: tiled.coefficients(block.level, decoder.grid.block_region(block))
