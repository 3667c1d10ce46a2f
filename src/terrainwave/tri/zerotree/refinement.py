"""Algorithm II: refinement labels of the guaranteed triangulation (format-mesh-zerotree.md).

E. Yusov, V. Turlapov 2010, §2.6. A JS node has no bit; others have one: 1 if the node is S (the
guaranteed triangulation is finer here), 0 if it is TR. Nodes at height 0 have none. In blocks that
no group refines, every node has its bit ("step 1 is left out").

Departures: the order is by height, then by rows, instead of depth first: the same bits. Nodes that
voids keep from merging have no bit (the decoder knows the mask), nor have nodes with a single
child. Contexts are of two kinds; the one with the shorter result is used, and the first byte names
it: 0, one model for each height, as in the paper; 1, for each height, how rough the decoded heights
under the node are relative to the tolerance, and the number of nodes to the west and north that are
S.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.coding.rangecoder import (
    code_bit,
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
    new_models,
)
from terrainwave.coding.status import raise_for_status
from terrainwave.errors import CorruptStreamError, TruncatedStreamError
from terrainwave.tri.block_mesh import FRACTION_BITS
from terrainwave.tri.quads import void_edges
from terrainwave.tri.triangle import MAX_TOLERANCE
from terrainwave.tri.zerotree.labels import (
    Cut,
    Trees,
    axis_nodes,
    ceilings,
    first_sample,
    promote,
    second_child,
    set_node,
    top_height,
)

BY_HEIGHT, BY_ROUGHNESS = 0, 1

# Roughness over tolerance in 1/16, by half octaves: 0, then from 1/16 up to 64 and above.
_RATIO_BITS = 4
_N_ROUGH = 22
_ROUGH_EDGES = np.array(
    [1, *(v for p in range(10) for v in ((1 << p) * 181 >> 7, 2 << p))], dtype=np.int64
)
_N_HEIGHTS = 13
_N_MODELS = _N_HEIGHTS * _N_ROUGH * 3


def encode_refinement(
    cut: Cut,  # shape (n_rows, n_cols); as `guarantee.guaranteed_cut` returns it, `keep` or not
    # `heights, mask, tolerance, trees`: as there; they are known to the decoder and only steer
    # contexts
    heights: NDArray[np.int32],
    mask: NDArray[np.bool_],
    tolerance: int,
    trees: Trees | None = None,
) -> bytes:
    """Return the refinement labels of a cut (§3 of the annex).

    `decode_refinement` with the same arguments undoes it.
    """
    coded = []
    out, reached = np.empty(cut.size + 64, dtype=np.uint8), np.empty(cut.shape, dtype=np.uint8)
    for kind in (BY_HEIGHT, BY_ROUGHNESS):
        ceiling, rough = _side_information(heights, mask, tolerance, trees, kind)
        coder = new_encoder(out, new_models(_N_MODELS))
        _code_labels(reached, cut, ceiling, rough, coder)
        coded.append(bytes([kind]) + out[: finish_encoder(coder.state, out)].tobytes())
    return min(coded, key=len)


def decode_refinement(
    data: bytes,
    heights: NDArray[np.int32],
    mask: NDArray[np.bool_],
    tolerance: int,
    trees: Trees | None = None,
) -> Cut:
    """Return the cut that `encode_refinement` wrote (§2 and §3 of the annex).

    Any bytes give a cut or a `CorruptStreamError`, in time and memory bounded by the block's size.
    A cut from wrong bytes makes a mesh without cracks, but not within the tolerance, and it may
    fold.
    """
    if not data:
        raise TruncatedStreamError("refinement labels are empty")
    if data[0] not in (BY_HEIGHT, BY_ROUGHNESS):
        raise CorruptStreamError(f"contexts {data[0]} of refinement labels are not defined")
    coder = new_decoder(data[1:], new_models(_N_MODELS))
    cut = np.empty(mask.shape, dtype=np.uint8)
    ceiling, rough = _side_information(heights, mask, tolerance, trees, data[0])
    _code_labels(cut, None, ceiling, rough, coder)
    raise_for_status(*finish_decoder(coder.state, coder.stream))
    promote(cut)
    return cut


def _side_information(
    heights: NDArray[np.int32],
    mask: NDArray[np.bool_],
    tolerance: int,
    trees: Trees | None,
    kind: int,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the ceilings of nodes, and their roughness (empty if contexts don't need it)."""
    tolerance = min(tolerance, MAX_TOLERANCE)
    ceiling = ceilings(void_edges(mask), trees)
    if kind == BY_HEIGHT:
        return ceiling, np.zeros((0, 0, 0), dtype=np.uint8)
    n_rows, n_cols = heights.shape
    n_heights = int(top_height(n_rows, n_cols)) + 1
    rough = np.zeros((n_heights, (n_rows + 1) // 2 + 1, (n_cols + 1) // 2 + 1), dtype=np.uint8)
    ranges = np.zeros(heights.shape, dtype=np.int64)
    heights, mask = np.ascontiguousarray(heights), np.ascontiguousarray(mask)
    _measure_roughness(heights, mask, tolerance, ranges, rough)
    return ceiling, rough


@kernel
def _bend(heights, mask, row, col, down, right):
    """Return |second difference| around (row, col) + (down, right); 0 if it is undefined."""
    n_rows, n_cols = heights.shape
    end_row, end_col = row + 2 * down, col + 2 * right
    if end_row >= n_rows or end_col >= n_cols or end_col < 0:
        return np.int64(0)
    if not (mask[row, col] and mask[row + down, col + right] and mask[end_row, end_col]):
        return np.int64(0)
    middle = np.int64(heights[row + down, col + right])
    return abs(np.int64(heights[row, col]) + np.int64(heights[end_row, end_col]) - 2 * middle)


@kernel
def _measure_roughness(heights, mask, tolerance, sums, rough):
    """Fill ``rough[height, i, j]`` with the class of a node's roughness (§3 of the annex).

    The roughness of a node is half the largest second difference at its stride, plus the largest
    roughness of its children: about the largest deviation if it became one vertex. `sums` is
    scratch.
    """
    n_rows, n_cols = heights.shape
    for height in range(1, top_height(n_rows, n_cols) + 1):
        half = 1 << (height - 1)
        for i in range(axis_nodes(n_rows, height)):
            row = first_sample(i, n_rows, height)
            row_2 = second_child(row, n_rows, height)
            for j in range(axis_nodes(n_cols, height)):
                col = first_sample(j, n_cols, height)
                col_2 = second_child(col, n_cols, height)
                below = max(sums[row, col], sums[row_2, col])
                below = max(below, max(sums[row, col_2], sums[row_2, col_2]))
                bend = _bend(heights, mask, row, col, 0, half)
                bend = max(bend, _bend(heights, mask, row, col, half, 0))
                bend = max(bend, _bend(heights, mask, row, col, half, half))
                if col + 2 * half < n_cols:
                    bend = max(bend, _bend(heights, mask, row, col + 2 * half, half, -half))
                total = below + bend
                sums[row, col] = total
                ratio = (total << (FRACTION_BITS + _RATIO_BITS - 1)) // max(tolerance, 1)
                index = 0
                while index < _N_ROUGH - 1 and ratio >= _ROUGH_EDGES[index]:
                    index += 1
                rough[height, i, j] = index


@kernel
def _code_labels(reached, cut, ceiling, rough, coder):
    """Encode the labels of `cut`, or decode if it is None; `reached` receives the cut."""
    n_rows, n_cols = reached.shape
    top = top_height(n_rows, n_cols)
    for row in range(n_rows):
        for col in range(n_cols):
            reached[row, col] = top
    for height in range(top, 0, -1):
        rows, cols = axis_nodes(n_rows, height), axis_nodes(n_cols, height)
        for i in range(rows):
            row = first_sample(i, n_rows, height)
            row_north = first_sample(i - 1, n_rows, height) if i > 0 else row
            for j in range(cols):
                col = first_sample(j, n_cols, height)
                if reached[row, col] != height:
                    continue
                splits = height > ceiling[row, col] or (
                    second_child(row, n_rows, height) == row
                    and second_child(col, n_cols, height) == col
                )
                if not splits:
                    index = height
                    if rough.shape[0] > 0:
                        n_split = 0
                        if j > 0 and reached[row, first_sample(j - 1, n_cols, height)] < height:
                            n_split += 1
                        if i > 0 and reached[row_north, col] < height:
                            n_split += 1
                        index = (height * _N_ROUGH + np.int64(rough[height, i, j])) * 3 + n_split
                    if cut is not None:
                        splits = cut[row, col] < height
                    splits = code_bit(coder, index, np.int64(splits)) == 1
                if splits:
                    set_node(reached, row, col, height, height - 1)
