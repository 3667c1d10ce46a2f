"""Zero trees of decoded difference layers (docs/format-mesh-zerotree.md, §5).

E. Yusov, V. Turlapov 2010, §2.4 takes the joint zero trees of the coefficients that code the group
below a block. Files are smallest with almost no coefficients, so such trees have little
information. Here the difference layer is the group's decoded heights less their prediction from the
block's, and a coefficient is significant by the triangulation's tolerance: the trees take no bytes,
and include all detail, also that of residuals.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.filters import BAND_GAINS, forward_transform, synthesise
from terrainwave.coding.zerotrees import mark_zero_trees
from terrainwave.tri.block_mesh import FRACTION_BITS
from terrainwave.tri.quads import grown
from terrainwave.tri.zerotree.labels import Trees

# Share of Err_Tri, in 1/16, from which a coefficient is significant.
SHARE_BITS = 4
SHARE = 14
# Fraction bits of the layer, as in `codec.cdf97.refiner`.
_LAYER_BITS = 6
# Reach of predictions, in the block's samples.
_REACH = 2


def layer_trees(
    # shape (n_rows, n_cols); the block's decoded heights in quanta, those inside the raster
    heights: NDArray[np.int32],
    mask: NDArray[np.bool_],  # True for valid ones; void samples may have any value
    # shape (2 * n_rows - 1 or 2 * n_rows, likewise); decoded heights of the next finer level at the
    # same position
    finer: NDArray[np.int32],
    finer_mask: NDArray[np.bool_],  # True for valid ones
    tolerance: int,  # Err_Tri of the block, in 1/16 quanta
) -> Trees:
    """Return the zero trees of the difference layer between a block and the group below it.

    A map as in `coding.zerotrees`; its finest nodes are the block's samples.
    """
    layer = np.empty(finer.shape, dtype=np.int32)
    line = np.zeros(heights.shape[1] + 4, dtype=np.int64)
    rows = np.zeros((heights.shape[0] + 4, finer.shape[1]), dtype=np.int64)
    synthesise(np.where(mask, heights, np.int32(0)), 0, 0, line, rows, layer)
    field = (finer.astype(np.int64) - layer) << _LAYER_BITS
    if not (mask.all() and finer_mask.all()):
        near = grown(~mask, _REACH)
        field[~finer_mask | near.repeat(2, 0).repeat(2, 1)[: field.shape[0], : field.shape[1]]] = 0
    half = np.zeros(((finer.shape[1] + 1) >> 1) + 3, dtype=np.int64)
    forward_transform(field, half, half.copy())
    trees = np.empty(heights.shape, dtype=np.uint8)
    mark_zero_trees(field, _thresholds(tolerance), trees)
    return trees


def _thresholds(tolerance: int) -> NDArray[np.int64]:
    """Return the smallest significant magnitudes by transform and band, in 1/64 quanta."""
    scaled = tolerance * SHARE << (_LAYER_BITS - FRACTION_BITS)
    return np.maximum((scaled * BAND_GAINS) >> (SHARE_BITS + 12), 1)
