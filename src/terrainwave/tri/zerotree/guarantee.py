"""Algorithm I: guaranteed triangulation of a block (Yusov & Turlapov 2010, §2.5).

It starts at the full grid and merges nodes from the finest upwards. A node that is not JS and whose
children are all roots becomes the root of their samples; the step is undone if one of the **new**
triangles, those with a corner that moved, has an error above the tolerance. Departures:

* the error is the largest vertical deviation over the covered samples, in exact integers, and may
  equal the tolerance (the paper: less than);
* a step is also undone if a new triangle has no positive area: vertices off the middle of their
  node can fold over. So a mesh is a height field that covers the block exactly once: the area of
  the triangles adds up to that of the grid, and every one adds to it;
* voids, and vertices that neighbours need: `keep`.

The result depends on the order of steps, which is: heights upwards, then row by row. Quads are
split from their first sample to their last, like the direction of roots: with the other diagonal
more steps fold, and far more triangles are left.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.tri.quads import Keep, void_edges
from terrainwave.tri.triangle import MAX_TOLERANCE, fits
from terrainwave.tri.zerotree.labels import (
    Cut,
    Trees,
    axis_nodes,
    ceilings,
    end_sample,
    first_sample,
    second_child,
    top_height,
)

_ROW_SHIFT = 16
_COL_MASK = (1 << _ROW_SHIFT) - 1


def guaranteed_cut(
    # shape (n_rows, n_cols); decoded heights in quanta, within ±2**30; 1 to 4097 samples a side.
    # Void samples may have any value.
    heights: NDArray[np.int32],
    mask: NDArray[np.bool_],  # True for valid samples
    tolerance: int,  # Err_Tri, in 1/16 quanta; >= 0
    # zero trees of the group that refines the block: the triangulation is nowhere coarser. None
    # (for blocks of the full grid) omits this condition.
    trees: Trees | None = None,
    keep: Keep | None = None,  # samples that must be vertices besides those at voids
) -> Cut:
    """Return the cut of the guaranteed triangulation; `connect.mesh_of_cut` makes the mesh."""
    tolerance = min(tolerance, MAX_TOLERANCE)
    kept = void_edges(mask)
    if keep is not None:
        kept |= keep
    rows, cols = np.indices(heights.shape, dtype=np.int32)
    roots, cut = rows << _ROW_SHIFT | cols, np.zeros(heights.shape, dtype=np.uint8)
    _merge(np.ascontiguousarray(heights), ceilings(kept, trees), tolerance, roots, cut)
    return cut[roots >> _ROW_SHIFT, roots & _COL_MASK]


@kernel
def _merge(heights, ceiling, tolerance, roots, cut):
    """Algorithm I; `roots` are row << 16 | column of each sample's root, at first its own.

    Afterwards `cut` is valid at roots.
    """
    n_rows, n_cols = heights.shape
    for height in range(1, top_height(n_rows, n_cols) + 1):
        for i in range(axis_nodes(n_rows, height)):
            row = first_sample(i, n_rows, height)
            row_2, row_end = second_child(row, n_rows, height), end_sample(row, n_rows, height)
            for j in range(axis_nodes(n_cols, height)):
                col = first_sample(j, n_cols, height)
                col_2 = second_child(col, n_cols, height)
                # While heights increase, `cut` is valid only at the first samples of roots.
                below = height - 1
                if ceiling[row, col] < height or cut[row, col] != below:
                    continue
                if row_2 != row and cut[row_2, col] != below:
                    continue
                if col_2 != col and cut[row, col_2] != below:
                    continue
                if row_2 != row and col_2 != col and cut[row_2, col_2] != below:
                    continue
                col_end = end_sample(col, n_cols, height)
                if row_2 == row and col_2 == col:
                    cut[row, col] = height
                    continue
                moved_row = row_2 if row_2 != row else row_end
                moved_col = col_2 if col_2 != col else col_end
                if not _new_triangles_fit(
                    heights, roots, tolerance, row, col, row_end, col_end, moved_row, moved_col
                ):
                    continue
                cut[row, col] = height
                root = row << _ROW_SHIFT | col
                for r in range(row, row_end):
                    line = roots[r]
                    for c in range(col, col_end):
                        line[c] = root


@kernel
def _new_triangles_fit(heights, roots, tolerance, row, col, row_end, col_end, moved_row, moved_col):
    """Check the triangles that change when the node's samples move to its first one.

    Those beyond `moved_row` or `moved_col` move; the first child's samples have their root there
    already. Quads with a void corner never change: `ceiling` keeps their samples.
    """
    n_rows, n_cols = heights.shape
    here = np.int64(row) << _ROW_SHIFT | col
    for r in range(max(row - 1, 0), min(row_end, n_rows - 1)):
        c = max(col - 1, 0)
        last = min(col_end, n_cols - 1)
        a_in, d_in = row <= r < row_end, row <= r + 1 < row_end
        a_late, d_late = r >= moved_row, r + 1 >= moved_row
        both_in = a_in and d_in
        inside = c >= col
        # State of corners a and d of the quad at c: in the node or not, moved or not.
        a_moves = a_in and inside and (a_late or c >= moved_col)
        d_moves = d_in and inside and (d_late or c >= moved_col)
        a = here if a_in and inside else np.int64(roots[r, c])
        d = here if d_in and inside else np.int64(roots[r + 1, c])
        while c < last:
            right = c + 1
            inside = col <= right < col_end
            late = right >= moved_col
            b_moves = a_in and inside and (a_late or late)
            c_moves = d_in and inside and (d_late or late)
            b = here if a_in and inside else np.int64(roots[r, right])
            e = here if d_in and inside else np.int64(roots[r + 1, right])
            if (a_moves or c_moves or b_moves) and a != b and b != e and a != e:
                if not _fits(heights, a, b, e, tolerance):
                    return False
            if (a_moves or c_moves or d_moves) and a != e and e != d and a != d:
                if not _fits(heights, a, e, d, tolerance):
                    return False
            a, d, a_moves, d_moves = b, e, b_moves, c_moves
            c = right
            if both_in and inside and c < col_end - 1:
                # Nothing is left inside the node: go to its last column.
                c = col_end - 1
                a = d = here
                a_moves = a_late or c >= moved_col
                d_moves = d_late or c >= moved_col
    return True


@kernel
def _fits(heights, a, b, c, tolerance):
    return fits(
        heights, a >> _ROW_SHIFT, a & _COL_MASK, b >> _ROW_SHIFT, b & _COL_MASK, c >> _ROW_SHIFT,
        c & _COL_MASK, tolerance,
    )  # fmt: skip
