"""Border lines: their vertices depend only on the shared samples.

Two blocks of one level have the same decoded samples on the line between them, the same voids next
to it and the same tolerance, so both find the same vertices, in any order and on any machine.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel

# Vertices on borders keep within 7/10 of the tolerance, which leaves some to the adjacent
# triangles.
_SHARE_NUM, _SHARE_DEN = 7, 10


@kernel
def line_vertices(heights, forced, offset, side, tolerance):
    """Return which samples of a border line are vertices, always the first and the last.

    Dyadic: in the line of a whole block, sample m, an odd multiple of s, lies between m - s and m +
    s. It is a vertex if a sample between these two is further than the tolerance from their chord,
    or if a vertex lies between them; so vertices of a tolerance are vertices of any smaller one.
    `heights`, integers below 2^40 in magnitude, have the unit of `tolerance`. `forced` are vertices
    in any case: voids, and samples next to voids. `offset` is the position of the first sample in
    the line of a block of `side` cells, a power of two.
    """
    n = heights.shape[0]
    last = offset + n - 1
    active = np.zeros(side + 1, dtype=np.bool_)
    for i in range(n):
        active[offset + i] = forced[i]
    spacing = 1
    while spacing < side:
        for middle in range(spacing, side, 2 * spacing):
            if active[middle]:
                continue
            below = spacing >> 1
            if below > 0 and (active[middle - below] or active[middle + below]):
                # Also beyond the end of the line, to pass on vertices before the end.
                active[middle] = True
                continue
            if not offset < middle < last:
                continue
            start, stop = max(middle - spacing, offset), min(middle + spacing, last)
            first = np.int64(heights[start - offset])
            rise = np.int64(heights[stop - offset]) - first
            length = stop - start
            limit = np.int64(tolerance) * length * _SHARE_NUM
            for place in range(start + 1, stop):
                chord = (np.int64(heights[place - offset]) - first) * length
                chord -= rise * (place - start)
                if abs(chord) * _SHARE_DEN > limit:
                    active[middle] = True
                    break
        spacing *= 2
    vertices = active[offset : last + 1].copy()
    vertices[0] = True
    vertices[n - 1] = True
    return vertices


def beside_void(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the samples that are void or touch a grid triangle with a void corner.

    `mask` has an apron of one sample, and is true where there is no sample. Grid triangles are (a,
    b, c) and (a, c, d) of each quad with corners a, b in the upper row and d, c in the lower.
    """
    inner = mask[1:-1, 1:-1] & mask[:-2, :-2] & mask[2:, 2:]
    inner &= mask[:-2, 1:-1] & mask[2:, 1:-1] & mask[1:-1, :-2] & mask[1:-1, 2:]
    return ~inner
