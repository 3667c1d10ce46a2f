"""Positions of a restricted quadtree's vertices between two thresholds (`view`).

Each vertex exists for a share of the thresholds, no larger than the shares of the vertices it
depends on. For each threshold the existing vertices have a triangulation of their own; the mean of
these surfaces is drawn, at the vertices that exist for any threshold.

Around a vertex v the triangulations differ in how far the triangles that hold it are split: T, next
to the edge that v splits, is split for the share of v and exists for that of its top, which splits
the parent of T, and so on upwards to one whose top always exists. v's mean height is the mean of
its own height and its positions on these triangles, weighted by the differences of shares.
"""

import numpy as np

from terrainwave.coding.jit import kernel
from terrainwave.tri.rqt.stored import own_neighbours


@kernel
def place_vertices(active, vertex_of, shares, heights, z_scale, matrix, vertices, places):
    """Fill vertices and their samples; return how many are not void.

    `vertex_of` holds numbers of active vertices, and afterwards those of filled ones; -1 is void.
    `heights` are those of samples.
    """
    for number in range(active.shape[0]):
        vertices[number, 2] = _mean_height(active, number, vertex_of, shares, heights)
    count = 0
    for number in range(active.shape[0]):
        row, col, height = active[number, 0], active[number, 1], vertices[number, 2]
        if np.isnan(height):
            vertex_of[row, col] = -1
            continue
        vertex_of[row, col] = count
        places[count, 0], places[count, 1] = row, col
        vertices[count, 0] = matrix[0] * col + matrix[1] * row + matrix[2]
        vertices[count, 1] = matrix[3] * col + matrix[4] * row + matrix[5]
        vertices[count, 2] = height * z_scale
        count += 1
    return count


@kernel
def _mean_height(active, number, vertex_of, shares, heights):
    """Return the mean of a vertex's heights for all thresholds; its own without thresholds."""
    own, share = heights[number], shares[number]
    if share >= 1 or np.isnan(own):
        return own
    row, col = np.int64(active[number, 0]), np.int64(active[number, 1])
    r0, c0, r1, c1, r2, c2, r3, c3 = own_neighbours(row, col)
    if not (0 <= r2 < vertex_of.shape[0] and 0 <= c2 < vertex_of.shape[1]):
        r2, c2 = r3, c3  # both sides give the same
    mean = share * own
    # Corners and weights of the vertex's position on a triangle: ends of its longest side, its top.
    first, second, top = vertex_of[r0, c0], vertex_of[r1, c1], vertex_of[r2, c2]
    of_first, of_second, of_top = 0.5, 0.5, 0.0
    while True:
        above = shares[top]
        if above > share:
            height = of_first * heights[first] + of_second * heights[second]
            if of_top > 0:
                height += of_top * heights[top]
            mean += (above - share) * (own if np.isnan(height) else height)
            share = above
        if share >= 1:
            return mean
        # The parent: its longest side was split by the top, and its own top is one of the others.
        row, col = np.int64(active[top, 0]), np.int64(active[top, 1])
        r0, c0, r1, c1, r2, c2, r3, c3 = own_neighbours(row, col)
        end, other_end = vertex_of[r0, c0], vertex_of[r1, c1]
        if second == end or second == other_end:
            first, second, of_first, of_second = second, first, of_second, of_first
        if first == other_end:
            other_end = end
        top, of_first, of_second, of_top = (
            second, of_first + of_top / 2, of_top / 2, of_second
        )  # fmt: skip
        second = other_end
