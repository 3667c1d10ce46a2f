"""Surface of a regular block, and its distance from that of the next finer level.

A block of N x N cells has (N + 1)² vertices on the file's samples of its level, those on its border
shared with its neighbours; cells are cut from their first corner to their last. NaN is void.
"""

import numpy as np

from terrainwave.coding.jit import kernel


@kernel
def half_place(vertices, row, col):
    """Return a surface's height at (row / 2, col / 2); NaN if a corner is void or outside."""
    r, c = row // 2, col // 2
    r_1, c_1 = r + row % 2, c + col % 2
    if not (0 <= r and r_1 < vertices.shape[0] and 0 <= c and c_1 < vertices.shape[1]):
        return np.nan
    # In the middle of a cell the mean of the corners that its cut joins.
    return (float(vertices[r, c]) + float(vertices[r_1, c_1])) / 2


@kernel
def fill_parent_heights(vertices, parent, first_row, first_col, out):
    """Fill `out`, like `vertices`, with the parent's surface at them.

    Vertex (0, 0) is at (first_row, first_col) halves of the parent's cells. If the parent is void,
    the block's own height is used.
    """
    for row in range(vertices.shape[0]):
        for col in range(vertices.shape[1]):
            z = half_place(parent, first_row + row, first_col + col)
            out[row, col] = vertices[row, col] if np.isnan(z) else z


@kernel
def largest_deviation(vertices, fine, valid, rows, cols, has_between):
    """Return the distance of the bilinear surface of finer samples from a block's, at valid ones.

    `vertices` are float32 (n, m), `fine` and `valid` the next finer level's (2n - 1, 2m - 1), of
    which the rows and columns from `rows[0]` to before `rows[1]` count. With `has_between` there
    are originals between samples, and distances there count: along edges of its cells both are
    linear, and a bilinear cell less a plane is largest on edges, so only cuts of cells remain,
    where it is quadratic.
    """
    largest = 0.0
    for row in range(rows[0], rows[1]):
        for col in range(cols[0], cols[1]):
            if not valid[row, col]:
                continue
            one = fine[row, col] - half_place(vertices, row, col)
            if abs(one) > largest:  # never for NaN
                largest = abs(one)
            is_cut = (row + col) % 2 == 0 and row + 1 < rows[1] and col + 1 < cols[1]
            if not has_between or not is_cut or not valid[row + 1, col + 1]:
                continue
            if not valid[row, col + 1] or not valid[row + 1, col]:
                continue
            two = fine[row + 1, col + 1] - half_place(vertices, row + 1, col + 1)
            twist = fine[row, col] + fine[row + 1, col + 1] - fine[row, col + 1]
            twist -= fine[row + 1, col]
            # one + t (two - one) - t (1 - t) twist
            if abs(two - one) < abs(twist):
                t = (1 - (two - one) / twist) / 2
                apart = abs(one + t * (two - one) - t * (1 - t) * twist)
                if apart > largest:
                    largest = apart
    return largest
