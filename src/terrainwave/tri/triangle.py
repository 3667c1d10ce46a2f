"""Triangles over samples, in exact integers: areas, planes, the samples they cover.

A triangle (r0, c0), (r1, c1), (r2, c2) is the right way round if twice its area
``(c1 - c0) * (r2 - r0) - (c2 - c0) * (r1 - r0)`` is positive. Deviations are vertical (Yusov &
Turlapov 2010, §2.5, measure the distance to the plane, which is never larger), times twice the
area, so that they are integers: with heights below 2**31 and sides of at most MAX_SIDE samples
everything stays below 2**62.
"""

import numpy as np

from terrainwave.coding.jit import kernel
from terrainwave.tri.block_mesh import FRACTION_BITS

MAX_SIDE = 4097
# Tolerances are in 1/16 quanta; larger ones mean the same for heights below 2**30.
MAX_TOLERANCE = 1 << (31 + FRACTION_BITS)
# Triangles at most this wide are scanned column by column.
_NARROW = 16


@kernel
def area_of(r0, c0, r1, c1, r2, c2):
    return (c1 - c0) * (r2 - r0) - (c2 - c0) * (r1 - r0)


@kernel
def columns_inside(row, r0, c0, r1, c1, r2, c2):
    """Return (first, last) column of `row` inside the closed triangle, which has positive area."""
    first, last = min(c0, c1, c2), max(c0, c1, c2)
    # On the right side of each edge p -> q: (qc - pc) * (row - pr) >= (col - pc) * (qr - pr).
    rise = r1 - r0
    if rise > 0:
        last = min(last, ((c1 - c0) * (row - r0) + c0 * rise) // rise)
    elif rise < 0:
        first = max(first, -(((c1 - c0) * (row - r0) + c0 * rise) // -rise))
    rise = r2 - r1
    if rise > 0:
        last = min(last, ((c2 - c1) * (row - r1) + c1 * rise) // rise)
    elif rise < 0:
        first = max(first, -(((c2 - c1) * (row - r1) + c1 * rise) // -rise))
    rise = r0 - r2
    if rise > 0:
        last = min(last, ((c0 - c2) * (row - r2) + c2 * rise) // rise)
    elif rise < 0:
        first = max(first, -(((c0 - c2) * (row - r2) + c2 * rise) // -rise))
    return first, last


@kernel
def deviation(heights, r0, c0, r1, c1, r2, c2, limit):
    """Return the largest deviation of samples from the plane, times twice the area (> 0).

    Vertices have the heights of their samples. Returns early above `limit`.
    """
    area = area_of(r0, c0, r1, c1, r2, c2)
    worst = np.int64(0)
    if area == 1:
        return worst  # no sample except its vertices (Pick)
    base = np.int64(heights[r0, c0])
    rise_1, rise_2 = np.int64(heights[r1, c1]) - base, np.int64(heights[r2, c2]) - base
    per_col = rise_1 * (r2 - r0) - rise_2 * (r1 - r0)
    per_row = (c1 - c0) * rise_2 - (c2 - c0) * rise_1
    left, right = min(c0, c1, c2), max(c0, c1, c2)
    if right - left <= _NARROW:
        # Divisions would cost more than testing the adjacent samples.
        for row in range(min(r0, r1, r2), max(r0, r1, r2) + 1):
            edge_0 = (c1 - c0) * (row - r0) - (left - c0) * (r1 - r0)
            edge_1 = (c2 - c1) * (row - r1) - (left - c1) * (r2 - r1)
            edge_2 = (c0 - c2) * (row - r2) - (left - c2) * (r0 - r2)
            plane = area * base + per_row * (row - r0) + per_col * (left - c0)
            line = heights[row]
            for col in range(left, right + 1):
                if edge_0 >= 0 and edge_1 >= 0 and edge_2 >= 0:
                    worst = max(worst, abs(area * np.int64(line[col]) - plane))
                plane += per_col
                edge_0 -= r1 - r0
                edge_1 -= r2 - r1
                edge_2 -= r0 - r2
            if worst > limit:
                return worst
        return worst
    for row in range(min(r0, r1, r2), max(r0, r1, r2) + 1):
        first, last = columns_inside(row, r0, c0, r1, c1, r2, c2)
        plane = area * base + per_row * (row - r0) + per_col * (first - c0)
        line = heights[row]
        for col in range(first, last + 1):
            error = abs(area * np.int64(line[col]) - plane)
            worst = max(worst, error)
            plane += per_col
        if worst > limit:
            return worst
    return worst


@kernel
def fits(heights, r0, c0, r1, c1, r2, c2, tolerance):
    """Return whether the triangle has positive area and all its samples lie within `tolerance`."""
    area = area_of(r0, c0, r1, c1, r2, c2)
    if area <= 0:
        return False
    limit = (area * tolerance) >> FRACTION_BITS
    return deviation(heights, r0, c0, r1, c1, r2, c2, limit) <= limit
