"""Result of triangulating a block: `BlockMesh`, in samples and quanta."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Heights of mesh vertices are in 1/16 quanta.
FRACTION_BITS = 4


class BlockMesh(NamedTuple):
    """Triangles over a rectangle of samples of one level, a height field that covers it once."""

    # shape (n_vertices,); positions in half samples from the rectangle's first sample: vertices lie
    # on samples (even) or between two (odd)
    rows: NDArray[np.int32]
    cols: NDArray[np.int32]
    heights: NDArray[np.int64]  # shape (n_vertices,); in 1/16 quanta
    # shape (n_triangles, 3); indices of vertices; clockwise with columns to the right and rows
    # downwards, so that the area ``(c1 - c0) * (r2 - r0) - (c2 - c0) * (r1 - r0)`` is positive
    triangles: NDArray[np.int32]


def no_mesh() -> BlockMesh:
    places = np.empty(0, dtype=np.int32)
    return BlockMesh(places, places, np.empty(0, dtype=np.int64), np.empty((0, 3), dtype=np.int32))


def used_only(
    rows: NDArray[np.int32],
    cols: NDArray[np.int32],
    heights: NDArray[np.int64],
    triangles: NDArray[np.int32],
) -> BlockMesh:
    """Return a mesh without vertices that no triangle has."""
    is_used = np.zeros(len(rows), dtype=np.bool_)
    is_used[triangles] = True
    number = np.cumsum(is_used, dtype=np.int32) - np.int32(1)
    return BlockMesh(rows[is_used], cols[is_used], heights[is_used], number[triangles])
