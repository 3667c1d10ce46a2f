"""Quads of the grid, their triangles, and the mesh of triangles between samples.

Voids: a quad of the grid has only the triangles with valid samples, and with a single void corner
it keeps the triangle of the other three. Samples that touch a missing triangle stay vertices in
every cut (`void_edges`), so void edges are exact.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh

# Samples that must be vertices.
Keep = NDArray[np.bool_]


def void_edges(mask: NDArray[np.bool_]) -> Keep:
    """Return which samples must stay vertices: void ones and those of a quad with a void corner."""
    keep = ~mask
    rows, cols = mask.shape
    if rows > 1 and cols > 1 and keep.any():
        holed = ~(mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1] & mask[1:, 1:])
        for row in (0, 1):
            for col in (0, 1):
                keep[row : rows - 1 + row, col : cols - 1 + col] |= holed
    return keep


def grown(found: NDArray[np.bool_], n_times: int) -> NDArray[np.bool_]:
    """Return an area grown `n_times` by the eight neighbours of its samples."""
    for _ in range(n_times):
        wide = np.pad(found, 1)
        wide = wide[:-2] | wide[1:-1] | wide[2:]
        found = wide[:, :-2] | wide[:, 1:-1] | wide[:, 2:]
    return found


@kernel
def triangles_of_quad(mask, row, col):
    """Return bits for the triangles of the quad at (row, col) of the full grid.

    Corners a (row, col), b right of it, c below b, d below a. 1: a b c, 2: a c d, and with just one
    void corner 4: b c d, 8: a b d.
    """
    a, b = mask[row, col], mask[row, col + 1]
    c, d = mask[row + 1, col + 1], mask[row + 1, col]
    if a and c:
        return (1 if b else 0) | (2 if d else 0)
    if b and d:
        return (4 if c else 0) | (8 if a else 0)
    return 0


@kernel
def corner_of_quad(kind, corner):
    """Return (down, right) of corner 0, 1 or 2 of a kind of triangle (1, 2, 4, 8)."""
    if corner == 0:
        return 0, (1 if kind == 4 else 0)
    if corner == 1:
        return (0, 1) if kind == 1 or kind == 8 else (1, 1)
    return (1, 1) if kind == 1 else (1, 0)


def build_mesh(
    heights: NDArray[np.int32], vertex_of: NDArray[np.int32], corners: NDArray[np.int64]
) -> BlockMesh:
    """Return a mesh from triangles of samples (flat indices); `vertex_of` >= 0 marks their samples.

    Changes `vertex_of` to the number of each vertex.
    """
    rows, cols = np.nonzero(vertex_of >= 0)
    vertex_of[rows, cols] = np.arange(len(rows), dtype=np.int32)
    return BlockMesh(
        (2 * rows).astype(np.int32),
        (2 * cols).astype(np.int32),
        heights[rows, cols].astype(np.int64) << FRACTION_BITS,
        vertex_of.reshape(-1)[corners].astype(np.int32).reshape(-1, 3),
    )
