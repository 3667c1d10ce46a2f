"""Details of a unit in strips: what is expected of each, then its symbols.

The expected magnitude of a detail follows from the parent's heights and from details of planes
coded before, never from heights of the unit: all details can be read before any height is made.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.rapid2.layout import HH, HL, LH
from terrainwave.codec.rapid2.symbols import (
    HIDDEN,
    MOST_NEAR,
    N_CLASSES,
    log_strip,
    read_strip,
)
from terrainwave.coding.jit import kernel, kernel_part

# Rows of a plane that are coded together. Those of LH lie one row further up: they see HL below.
STRIP_ROWS = 8
_TOP_CLASS = np.int32(N_CLASSES - 1)
_TO_CLASS, _CLASS_ZERO = np.int32(22), np.int32(2 * 127)


class Features(NamedTuple):
    """What is known of a unit before its details, and the weights of a level's class and step.

    ``expected = ((v1 * range + v2 * bend) >> shift) + v3 * near + v0``, in 2**-14 steps; rows of
    `weights` (v0, v1, v2, v3, shift) belong to planes HH, HL, LH.
    """

    ranges: NDArray[np.int16]
    bends: NDArray[np.int16]
    near: NDArray[np.int16]  # of planes HH and HL, with one row and column more on each side
    weights: NDArray[np.int32]


class Space(NamedTuple):
    """Memory of strips."""

    expected: NDArray[np.int32]
    floats: NDArray[np.float32]
    bits: NDArray[np.int32]  # the same memory
    pairs: NDArray[np.uint8]
    singles: NDArray[np.uint8]
    entries: NDArray[np.uint8]
    symbols: NDArray[np.uint8]
    details: NDArray[np.int32]
    more: NDArray[np.int32]


def new_space(most_cols: int) -> Space:
    """Return memory for planes of so many columns."""
    n = STRIP_ROWS * (most_cols + 2)
    floats = np.zeros(most_cols + 2, dtype=np.float32)
    return Space(
        expected=np.zeros(most_cols + 2, dtype=np.int32),
        floats=floats,
        bits=floats.view(np.int32),
        pairs=np.zeros(n, dtype=np.uint8),
        singles=np.zeros(n, dtype=np.uint8),
        entries=np.zeros(n + 1, dtype=np.uint8),
        symbols=np.zeros(2 * n, dtype=np.uint8),
        details=np.zeros(n, dtype=np.int32),
        more=np.zeros(n + 4, dtype=np.int32),
    )


@kernel_part
def _expect_row(features, plane, row, first, n, expected):
    """Fill the expected magnitudes of samples first ... first + n - 1 of a row."""
    weights = features.weights[plane - 1]
    v0, v1, v2, v3, shift = weights[0], weights[1], weights[2], weights[3], weights[4]
    # One row and column outside are there.
    here, above = features.ranges[row + 1], features.ranges[row]
    bends, below = features.bends[row + 1], features.bends[row + 2]
    if plane == HH:
        for k in range(n):
            j = first + k + 1
            bend = np.int32(bends[j]) + bends[j + 1] + below[j] + below[j + 1]
            expected[k] = ((v1 * np.int32(here[j]) + v2 * bend) >> shift) + v0
    elif plane == HL:
        north, own = features.near[0, row], features.near[0, row + 1]
        for k in range(n):
            j = first + k + 1
            bend = np.int32(bends[j]) + bends[j + 1]
            both = np.int32(here[j]) + above[j]
            near = np.int32(north[j]) + own[j]
            expected[k] = ((v1 * both + v2 * bend) >> shift) + v3 * near + v0
    else:
        corner, own = features.near[0, row + 1], features.near[1, row + 1]
        south = features.near[1, row + 2]
        for k in range(n):
            j = first + k + 1
            bend = np.int32(bends[j]) + below[j]
            both = np.int32(here[j]) + here[j - 1]
            near = np.int32(corner[j]) + corner[j - 1] + own[j] + own[j - 1] + south[j]
            near += south[j - 1]
            expected[k] = ((v1 * both + v2 * bend) >> shift) + v3 * near + v0


@kernel_part
def _class_row(expected, n, floats, bits, pairs, singles):
    """Fill the classes of the samples of a row, and of its pairs; an odd one is a pair alone.

    The class of E has the two top bits of E and where they stand. A float32 has them, too: without
    the bits two below those that are set, no rounding reaches them.
    """
    if n & 1:
        expected[n] = expected[n - 1]
    for k in range(n):
        value = max(expected[k], np.int32(1))
        floats[k] = np.float32(value & ~(value >> np.int32(2)))
    for k in range(n):
        singles[k] = np.uint8(min((bits[k] >> _TO_CLASS) - _CLASS_ZERO, _TOP_CLASS))
    for k in range((n + 1) // 2):
        mean = (expected[2 * k] >> np.int32(1)) + (expected[2 * k + 1] >> np.int32(1))
        value = max(mean, np.int32(1))
        floats[k] = np.float32(value & ~(value >> np.int32(2)))
    for k in range((n + 1) // 2):
        pairs[k] = np.uint8(min((bits[k] >> _TO_CLASS) - _CLASS_ZERO, _TOP_CLASS))
    if n & 1:
        singles[n] = HIDDEN


@kernel_part
def _hide_voids(valid, plane, row, first, n, pairs, singles):
    """Hide void samples of a row, and pairs of them."""
    of_row = valid[2 * row + (plane != HL)]
    at = 2 * first + (plane != LH)
    for k in range(n):
        if not of_row[at + 2 * k]:
            singles[k] = HIDDEN
    for k in range((n + 1) // 2):
        if singles[2 * k] == HIDDEN and singles[2 * k + 1] == HIDDEN:
            pairs[k] = HIDDEN


@kernel
def code_details(
    is_encoding, has_void, valid, known, shape, strips, features, details, most, values, cut, slots,
    freqs, n_states, states, words, raw, log, places, space,
):  # fmt: skip
    """Read or log the details of strips ``strips[0] ... strips[1] - 1``.

    `known` says of the unit's sides top, left, bottom, right whether their samples are known; these
    have the detail 0. `details` has planes HH, HL, LH.
    """
    n_rows = (shape[0] // 2, (shape[0] + 1) // 2, shape[0] // 2)
    n_cols = (shape[1] // 2, shape[1] // 2, (shape[1] + 1) // 2)
    near = features.near
    # Of strips before these nothing is known.
    if strips[0] > 0:
        near[:, STRIP_ROWS * strips[0]] = 0
    for strip in range(strips[0], strips[1]):
        for plane in (HH, HL, LH):
            first = STRIP_ROWS * strip - (plane == LH)
            last = min(first + STRIP_ROWS, n_rows[plane - 1])
            first_col, n = 0, n_cols[plane - 1]
            first = max(first, 0)
            if plane == HL:
                first = max(first, 1 if known[0] else 0)
                last = min(last, n_rows[1] - (1 if known[2] else 0))
            elif plane == LH:
                first_col = 1 if known[1] else 0
                n -= first_col + (1 if known[3] else 0)
            if first >= last or n <= 0:
                continue
            n_pairs = (n + 1) // 2
            for row in range(first, last):
                at = n_pairs * (row - first)
                pairs, singles = space.pairs[at:], space.singles[2 * at :]
                _expect_row(features, plane, row, first_col, n, space.expected)
                _class_row(space.expected, n, space.floats, space.bits, pairs, singles)
                if has_void:
                    _hide_voids(valid, plane, row, first_col, n, pairs, singles)
            n_all = n_pairs * (last - first)
            if is_encoding:
                for row in range(first, last):
                    to = space.details[2 * n_pairs * (row - first) :]
                    for k in range(n):
                        to[k] = details[plane - 1, row, first_col + k]
                    if n & 1:
                        to[n] = 0
                log_strip(
                    space.pairs, space.singles, n_all, space.details, cut, freqs, n_states, log,
                    places,
                )  # fmt: skip
            else:
                read_strip(
                    space.pairs, space.singles, n_all, space.entries, space.symbols, space.details,
                    most, values, cut, slots, states, n_states, words, raw, places, space.more,
                )  # fmt: skip
                for row in range(first, last):
                    source = space.details[2 * n_pairs * (row - first) :]
                    for k in range(n):
                        details[plane - 1, row, first_col + k] = source[k]
            if plane != LH:
                for row in range(first, last):
                    source = details[plane - 1, row]
                    to = near[plane - 1, row + 1]
                    for k in range(n):
                        to[first_col + k + 1] = np.int16(min(abs(source[first_col + k]), MOST_NEAR))


def n_strips(shape: tuple[int, int]) -> int:
    """Return how many strips a lattice has: as many as HL needs, and LH a row further down."""
    return -(-max((shape[0] + 1) // 2, shape[0] // 2 + 1) // STRIP_ROWS)
