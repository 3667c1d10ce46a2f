"""The surface of a regular block and how far samples are from it.

A block of N x N samples covers the squares around them: its vertices are the samples and, on its
border, the means of the samples on both sides, which its neighbours share. So blocks of one level
meet, and those of other levels cover the same ground, though samples of levels do not nest; the
paper does not say where its samples lie. Vertex 0 is on the border, vertex k = 1 … N half a cell
before k, vertex N + 1 at N.
"""

import numpy as np

from terrainwave.coding.jit import kernel


@kernel
def fill_vertices(samples, out):
    """Fill `out`, float32 (n + 2, m + 2), from `samples` (n + 2, m + 2): a block and a ring around.

    Inner vertices are samples; those on the border are means across it, void (NaN) where one is.
    """
    last_row, last_col = out.shape[0] - 1, out.shape[1] - 1
    for r in range(out.shape[0]):
        r_0 = min(r, last_row - 1)
        r_1 = max(r, 1) if r < last_row else last_row
        for c in range(out.shape[1]):
            c_0 = min(c, last_col - 1)
            c_1 = max(c, 1) if c < last_col else last_col
            if r_0 == r_1 and c_0 == c_1:
                out[r, c] = samples[r, c]
                continue
            total = float(samples[r_0, c_0]) + float(samples[r_0, c_1])
            total += float(samples[r_1, c_0]) + float(samples[r_1, c_1])
            out[r, c] = total / 4


@kernel
def _place(k, last):
    """Return where vertex k of 0 … last lies, in cells."""
    if k == 0:
        return 0.0
    return k - 0.5 if k < last else last - 1.0


@kernel
def surface_height(vertices, row, col):
    """Return the height at a place in cells from the block's corner; NaN where a corner is void."""
    last_row, last_col = vertices.shape[0] - 1, vertices.shape[1] - 1
    r = min(max(int(np.floor(row + 0.5)), 0), last_row - 1)
    c = min(max(int(np.floor(col + 0.5)), 0), last_col - 1)
    row_0, col_0 = _place(r, last_row), _place(c, last_col)
    t = (row - row_0) / (_place(r + 1, last_row) - row_0)
    s = (col - col_0) / (_place(c + 1, last_col) - col_0)
    z_00, z_11 = float(vertices[r, c]), float(vertices[r + 1, c + 1])
    # Two triangles, cut from (0, 0) to (1, 1).
    if s >= t:
        corner = float(vertices[r, c + 1])
        return z_00 + s * (corner - z_00) + t * (z_11 - corner)
    corner = float(vertices[r + 1, c])
    return z_00 + t * (corner - z_00) + s * (z_11 - corner)


@kernel
def largest_deviation(heights, vertices, first_row, first_col, size):
    """Return how far `heights` are from a surface, both NaN in voids.

    Sample (r, c) of `heights` lies (first_row + r + ½, first_col + c + ½) / size cells from the
    corner of the block of `vertices`.
    """
    largest = 0.0
    for r in range(heights.shape[0]):
        row = (first_row + r + 0.5) / size
        for c in range(heights.shape[1]):
            apart = abs(
                float(heights[r, c]) - surface_height(vertices, row, (first_col + c + 0.5) / size)
            )
            if apart > largest:  # never for NaN
                largest = apart
    return largest


@kernel
def fill_parent_heights(vertices, parent, first_row, first_col, out):
    """Fill `out`, float32 like `vertices`, with the parent's surface at them.

    The block begins (first_row, first_col) cells of its own from its parent's corner. Where the
    parent is void the block's own height is taken.
    """
    last_row, last_col = vertices.shape[0] - 1, vertices.shape[1] - 1
    for r in range(vertices.shape[0]):
        row = (first_row + _place(r, last_row)) / 2
        for c in range(vertices.shape[1]):
            z = surface_height(parent, row, (first_col + _place(c, last_col)) / 2)
            out[r, c] = vertices[r, c] if np.isnan(z) else z
