"""What the refusal of a cell rests on: while that is as it was, the cell would be refused again.

A star is refused by two of its triangles, or by one. They stay as they are while the cells at their
places on the ring around it don't grow, whatever else merges.
"""

import numpy as np

from terrainwave._jit import inlined_kernel
from terrainwave.tri.workspace import refusals_at, sweeps_at

NO_TEST = 0
_LEVEL_BITS = 8
# Places on the ring, from the cell's first sample, are kept in 16 bits each.
_PLACE_BITS = 16
_MASK, _SIGN = (1 << _PLACE_BITS) - 1, 1 << (_PLACE_BITS - 1)


@inlined_kernel
def test_of(level, sweep):
    """Return the number of a level's tests in a sweep."""
    return sweep << _LEVEL_BITS | level


@inlined_kernel
def write_refusal(work, plane, pitch, at, height, test, low_1, low_2, high_1, high_2):
    """Note which test has refused a cell of `height` rows, and its triangles' places on the ring.

    NO_TEST if it was not refused; nothing is noted of cells so large that places don't fit.
    """
    refusal = refusals_at(plane) + at
    work[np.uint64(refusal)] = test if (height + 2) * pitch < _SIGN else NO_TEST
    work[np.uint64(refusal + plane)] = low_1 << _PLACE_BITS | low_2 & _MASK
    work[np.uint64(refusal + 2 * plane)] = high_1 << _PLACE_BITS | high_2 & _MASK


@inlined_kernel
def refusal_stands(work, plane, pitch, at, level, top, bottom, left):
    """Say whether what has refused this cell of a level, if it was refused, is as it was."""
    refusal = refusals_at(plane) + at
    noted = np.int64(work[np.uint64(refusal)])
    stands = noted & ((1 << _LEVEL_BITS) - 1) == level
    if stands:
        sweep = noted >> _LEVEL_BITS
        for k in range(2):
            pair = np.int64(work[np.uint64(refusal + (k + 1) * plane)])
            first, second = pair >> _PLACE_BITS, ((pair & _MASK) ^ _SIGN) - _SIGN
            if _has_grown(work, plane, pitch, at + first, sweep, top, bottom, left) or _has_grown(
                work, plane, pitch, at + second, sweep, top, bottom, left
            ):
                stands = False
    return stands


@inlined_kernel
def _has_grown(work, plane, pitch, at, sweep, top, bottom, left):
    """Say whether a cell on the ring has grown since a test in a sweep.

    In the same sweep those above the tested cell, and those left of it, had grown before the test.
    """
    last = np.int64(work[np.uint64(sweeps_at(plane) + at)])
    has_grown = last > sweep
    if last == sweep:
        row = at // pitch
        col = at - row * pitch
        has_grown = not (row < top or (row <= bottom and col < left))
    return has_grown
