"""Reasons for refusing a cell: while they hold, the cell would be refused again.

A star is refused by one or two of its triangles. These do not change while the cells at their
positions on the ring around it don't grow, whatever else merges.
"""

import numpy as np

from terrainwave.coding.jit import inlined_kernel
from terrainwave.tri.halves.workspace import PLANES, REFUSAL, SWEEP

NO_TEST = 0
_LEVEL_BITS = 8
# Positions on the ring, from the cell's first sample, take 16 bits each.
_PLACE_BITS = 16
_MASK, _SIGN = (1 << _PLACE_BITS) - 1, 1 << (_PLACE_BITS - 1)


@inlined_kernel
def test_of(level, sweep):
    """Return the number of a level's tests in a sweep."""
    return sweep << _LEVEL_BITS | level


@inlined_kernel
def ring_pair(home, start, at):
    """Return two positions on the ring as one number, from the first sample of a cell, `home`."""
    return (start - home) << _PLACE_BITS | (at - home) & _MASK


@inlined_kernel
def write_refusal(work, plane, pitch, home, height, test, low_pair, high_pair):
    """Record the test that refused a cell of `height` rows, and its triangles on the ring.

    NO_TEST if it was not refused, or is so large that positions don't fit.
    """
    refusal = PLANES + REFUSAL * plane + home
    if test != NO_TEST:
        work[np.uint64(refusal + plane)] = low_pair
        work[np.uint64(refusal + 2 * plane)] = high_pair
    work[np.uint64(refusal)] = test if (height + 2) * pitch < _SIGN else NO_TEST


@inlined_kernel
def refusing_pairs(work, plane, home):
    """Return the two pairs of positions recorded last."""
    refusal = PLANES + REFUSAL * plane + home
    low_pair = np.int64(work[np.uint64(refusal + plane)])
    return low_pair, np.int64(work[np.uint64(refusal + 2 * plane)])


@inlined_kernel
def refusal_stands(work, plane, pitch, home, height, level):
    """Return whether this cell of a level was refused, for reasons that still hold."""
    refusal = PLANES + REFUSAL * plane + home
    noted = np.int64(work[np.uint64(refusal)])
    stands = noted & ((1 << _LEVEL_BITS) - 1) == level
    if stands:
        sweep = noted >> _LEVEL_BITS
        low_pair, high_pair = refusing_pairs(work, plane, home)
        stands = not (
            _has_grown(work, plane, pitch, home, height, low_pair >> _PLACE_BITS, sweep)
            or _has_grown(work, plane, pitch, home, height, _second_of(low_pair), sweep)
            or _has_grown(work, plane, pitch, home, height, high_pair >> _PLACE_BITS, sweep)
            or _has_grown(work, plane, pitch, home, height, _second_of(high_pair), sweep)
        )
    return stands


@inlined_kernel
def _second_of(pair):
    return ((pair & _MASK) ^ _SIGN) - _SIGN


@inlined_kernel
def _has_grown(work, plane, pitch, home, height, place, sweep):
    """Return whether the cell at a position on the ring has grown since a test in a sweep.

    In the same sweep, the ones above and the one to the left, which the ring meets in its last row,
    had grown before the test.
    """
    last = work[np.uint64(PLANES + SWEEP * plane + home + place)]
    was_before = place < -1 or place == (height - 1) * pitch - 1
    return last > sweep or (last == sweep and not was_before)
