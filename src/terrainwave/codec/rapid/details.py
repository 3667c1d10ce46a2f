"""Details of a lattice in strips: what is expected of each, then its symbols.

The expected magnitude of a detail follows from the parent's heights and from details of planes
coded before, never from heights of the lattice: all details can be read before any height is made.
"""

import numpy as np

from terrainwave.codec.rapid.layout import HH, HL, LH, STRIP_ROWS
from terrainwave.codec.rapid.symbols import HIDDEN, MOST_NEAR, N_CLASSES, log_strip, read_strip
from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.jit import kernel, kernel_part

_TOP_CLASS = np.int32(N_CLASSES - 1)
_TO_CLASS, _CLASS_ZERO = np.int32(22), np.int32(2 * 127)
_ONE, _TWO = np.int32(1), np.int32(2)


@kernel_part
def _expect_row(work, plane, row, weights, n, expected):
    """Fill the expected magnitudes of the samples of a row.

    ``((v1 * range + v2 * bend) >> shift) + v3 * near + v0``, in 2**-14 steps, with `weights` (v0,
    v1, v2, v3, shift). Ranges are at most 2 * 16382, bends 4 * 8191, v1 and v2 2**13 - 1: their
    sum is below 2**29.1. `near` is at most 6 * 4095, v3 2**15 - 1, v0 2**29: all below 2**31.
    """
    ranges, bends, near = work.ranges, work.bends, work.near
    v0, v1, v2, v3, shift = weights[0], weights[1], weights[2], weights[3], weights[4]
    # One row and column outside are there.
    here, above = ranges[row + 1, 1:], ranges[row, 1:]
    bend, below = bends[row + 1, 1:], bends[row + 2, 1:]
    if plane == HH:
        for k in range(n):
            all_bends = np.int32(bend[k]) + np.int32(bend[k + 1])
            all_bends += np.int32(below[k]) + np.int32(below[k + 1])
            expected[k] = ((v1 * np.int32(here[k]) + v2 * all_bends) >> shift) + v0
    elif plane == HL:
        north, own = near[0, row, 1:], near[0, row + 1, 1:]
        for k in range(n):
            both_bends = np.int32(bend[k]) + np.int32(bend[k + 1])
            both = np.int32(here[k]) + np.int32(above[k])
            magnitudes = np.int32(north[k]) + np.int32(own[k])
            expected[k] = ((v1 * both + v2 * both_bends) >> shift) + v3 * magnitudes + v0
    else:
        west, before = ranges[row + 1], near[0, row + 1]
        corner, own, south = near[0, row + 1, 1:], near[1, row + 1, 1:], near[1, row + 2, 1:]
        own_before, south_before = near[1, row + 1], near[1, row + 2]
        for k in range(n):
            both_bends = np.int32(bend[k]) + np.int32(below[k])
            both = np.int32(here[k]) + np.int32(west[k])
            magnitudes = np.int32(corner[k]) + np.int32(before[k]) + np.int32(own[k])
            magnitudes += np.int32(own_before[k]) + np.int32(south[k]) + np.int32(south_before[k])
            expected[k] = ((v1 * both + v2 * both_bends) >> shift) + v3 * magnitudes + v0


@kernel_part
def _classify(value):
    """Return a number, as float32, whose top bits are the class of an expected magnitude.

    The class has the two top bits of the number and where they stand. A float32 has them, too:
    without the bits two below those that are set, no rounding reaches them.
    """
    value = max(value, _ONE)
    return np.float32(value & ~(value >> _TWO))


@kernel_part
def _class_row(work, n, pairs, singles):
    """Fill the classes of the samples of a row, and of its pairs; an odd one is a pair alone."""
    expected, floats, bits = work.expected, work.floats, work.bits
    if n & 1:
        expected[n] = expected[n - 1]
    for k in range(n):
        floats[k] = _classify(expected[k])
    for k in range(n):
        singles[k] = np.int8(min((bits[k] >> _TO_CLASS) - _CLASS_ZERO, _TOP_CLASS))
    for k in range((n + 1) // 2):
        floats[k] = _classify((expected[2 * k] >> _ONE) + (expected[2 * k + 1] >> _ONE))
    for k in range((n + 1) // 2):
        pairs[k] = np.int8(min((bits[k] >> _TO_CLASS) - _CLASS_ZERO, _TOP_CLASS))
    if n & 1:
        singles[n] = HIDDEN


@kernel_part
def _hide_voids(valid, plane, row, n, pairs, singles):
    """Hide void samples of a row, and pairs of them."""
    of_row = valid[2 * row + (plane != HL)]
    at = np.int64(plane != LH)
    for k in range(n):
        if not of_row[at + 2 * k]:
            singles[k] = HIDDEN
    for k in range((n + 1) // 2):
        if singles[2 * k] == HIDDEN and singles[2 * k + 1] == HIDDEN:
            pairs[k] = HIDDEN


@kernel
def code_details(
    is_encoding, lattice, work, valid, strips, weights, frequencies, values, streams
):  # fmt: skip
    """Read or log the details of strips ``strips[0] ... strips[1] - 1`` of a band.

    Nothing is known of strips before the first one of a band. Rows of `weights` belong to HH, HL
    and LH.
    """
    work = borrowed(work)
    near, all_pairs, all_singles = work.near, work.pairs, work.singles
    n_rows = (lattice.n_rows // 2, (lattice.n_rows + 1) // 2, lattice.n_rows // 2)
    n_cols = (lattice.n_cols // 2, lattice.n_cols // 2, (lattice.n_cols + 1) // 2)
    near[:, STRIP_ROWS * strips[0]] = 0
    for plane in (HH, HL):
        near[plane - 1, n_rows[plane - 1] + 1] = 0
        near[plane - 1, :, 0] = 0
        near[plane - 1, :, n_cols[plane - 1] + 1] = 0
    for strip in range(strips[0], strips[1]):
        for plane in (HH, HL, LH):
            n = n_cols[plane - 1]
            last = min(STRIP_ROWS * (strip + 1) - (plane == LH), n_rows[plane - 1])
            first = max(STRIP_ROWS * strip - (plane == LH), 0)
            n_pairs = (n + 1) // 2
            if n == 0 or first >= last:
                continue
            for row in range(first, last):
                at = n_pairs * (row - first)
                pairs, singles = all_pairs[at:], all_singles[2 * at :]
                _expect_row(work, plane, row, weights[plane - 1], n, work.expected)
                _class_row(work, n, pairs, singles)
                if lattice.has_void:
                    _hide_voids(valid, plane, row, n, pairs, singles)
            both = work.both[plane - 1, n_pairs * first : n_pairs * last]
            details = work.details[plane - 1, 2 * n_pairs * first : 2 * n_pairs * last]
            n_all = n_pairs * (last - first)
            if is_encoding:
                log_strip(
                    all_pairs[:n_all], all_singles[: 2 * n_all], details, frequencies, streams
                )
            else:
                read_strip(
                    work, all_pairs[:n_all], all_singles[: 2 * n_all], both, details, lattice.most,
                    frequencies, values, streams,
                )  # fmt: skip
            if plane != LH:
                for row in range(first, last):
                    at = 2 * n_pairs * (row - first)
                    source, to = details[at : at + n], near[plane - 1, row + 1, 1:]
                    for k in range(n):
                        to[k] = np.int16(min(abs(source[k]), MOST_NEAR))


def n_strips(n_rows: int) -> int:
    """Return how many strips a lattice has: as many as HL needs, and LH a row further down."""
    return -(-max((n_rows + 1) // 2, n_rows // 2 + 1) // STRIP_ROWS)
