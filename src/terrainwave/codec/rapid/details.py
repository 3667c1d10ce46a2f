"""Details of a lattice in strips: what is expected of each, then its symbols.

The expected magnitude of a detail follows from the parent's heights and from details of planes
coded before, never from heights of the lattice: all details can be read before any height is made.
"""

import numpy as np

from terrainwave.codec.rapid.layout import HH, HL, LH, STRIP_ROWS
from terrainwave.codec.rapid.symbols import (
    HIDDEN,
    MOST_NEAR,
    N_CLASSES,
    PAIR_ESCAPE,
    STEP_CLASS,
    log_strip,
    pair_symbol,
    raw_bits,
    read_strip,
    single_symbol,
)
from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.jit import kernel, kernel_part

_TOP_CLASS = np.int32(N_CLASSES - 1)
_TO_CLASS, _CLASS_ZERO = np.int32(22), np.int32(2 * 127)
_ONE, _TWO = np.int32(1), np.int32(2)
# Encoders choose a cut from the first to the second. Escapes of pairs above would cost more.
LEAST_CUT, MOST_CUT = 16, STEP_CLASS + 6


@kernel_part
def _expect_row(flats, pitches, plane, row, weights, n, expected):
    """Fill the expected magnitudes of the samples of a row.

    ``((v1 * range + v2 * bend) >> shift) + v3 * near + v0``, in 2**-14 steps, with `weights` (v0,
    v1, v2, v3, shift). Ranges are at most 2 * 16382, bends 4 * 8191, v1 and v2 2**13 - 1: their
    sum is below 2**29.1. `near` is at most 6 * 4095, v3 2**15 - 1, v0 2**29: all below 2**31.
    `flats` are ranges, bends and what is near in flat memory, `pitches` how far apart rows and
    planes of it lie.
    """
    ranges, bends, near = flats
    v0, v1, v2, v3, shift = weights[0], weights[1], weights[2], weights[3], weights[4]
    pitch, size, one = np.uint64(pitches[0]), np.uint64(pitches[1]), np.uint64(1)
    # One row and column outside are there.
    here = np.uint64(row + 1) * pitch + one
    above, below, n = here - pitch, here + pitch, np.uint64(n)
    if plane == HH:
        for k in range(n):
            at, under = here + k, below + k
            all_bends = np.int32(bends[at]) + np.int32(bends[at + one])
            all_bends += np.int32(bends[under]) + np.int32(bends[under + one])
            expected[k] = ((v1 * np.int32(ranges[at]) + v2 * all_bends) >> shift) + v0
    elif plane == HL:
        for k in range(n):
            at, over = here + k, above + k
            both_bends = np.int32(bends[at]) + np.int32(bends[at + one])
            both = np.int32(ranges[at]) + np.int32(ranges[over])
            magnitudes = np.int32(near[over]) + np.int32(near[at])
            expected[k] = ((v1 * both + v2 * both_bends) >> shift) + v3 * magnitudes + v0
    else:
        for k in range(n):
            at, under = here + k, below + k
            both_bends = np.int32(bends[at]) + np.int32(bends[under])
            both = np.int32(ranges[at]) + np.int32(ranges[at - one])
            magnitudes = np.int32(near[at]) + np.int32(near[at - one])
            at, under = at + size, under + size
            magnitudes += np.int32(near[at]) + np.int32(near[at - one])
            magnitudes += np.int32(near[under]) + np.int32(near[under - one])
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
def _class_row(expected, floats, bits, n, pairs, singles, at):
    """Fill the classes of the samples of a row, and of its pairs, from pair `at` on.

    An odd one is a pair alone.
    """
    if n & 1:
        expected[n] = expected[n - 1]
    n_pairs, first, at = np.uint64((n + 1) // 2), np.uint64(2 * at), np.uint64(at)
    for k in range(np.uint64(n)):
        floats[k] = _classify(expected[k])
    for k in range(np.uint64(n)):
        singles[first + k] = np.int8(min((bits[k] >> _TO_CLASS) - _CLASS_ZERO, _TOP_CLASS))
    for k in range(n_pairs):
        floats[k] = _classify((expected[k + k] >> _ONE) + (expected[k + k + np.uint64(1)] >> _ONE))
    for k in range(n_pairs):
        pairs[at + k] = np.int8(min((bits[k] >> _TO_CLASS) - _CLASS_ZERO, _TOP_CLASS))
    if n & 1:
        singles[first + np.uint64(n)] = HIDDEN


@kernel_part
def _hide_voids(valid, plane, row, n, pairs, singles, at):
    """Hide void samples of a row, and pairs of them."""
    of_row, first = 2 * row + (plane != HL), np.int64(plane != LH)
    for k in range(n):
        if not valid[of_row, first + 2 * k]:
            singles[2 * at + k] = HIDDEN
    for k in range(at, at + (n + 1) // 2):
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
    work, valid = borrowed((work, valid))
    near, pairs, singles, expected = work.near, work.pairs, work.singles, work.expected
    flats = borrowed((work.ranges.reshape(-1), work.bends.reshape(-1), near.reshape(-1)))
    all_details, all_both = borrowed((work.details.reshape(-1), work.both.reshape(-1)))
    pitches = near.shape[2], near.shape[1] * near.shape[2]
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
                _expect_row(flats, pitches, plane, row, weights[plane - 1], n, expected)
                _class_row(expected, work.floats, work.bits, n, pairs, singles, at)
                if lattice.has_void:
                    _hide_voids(valid, plane, row, n, pairs, singles, at)
            n_all = n_pairs * (last - first)
            at = (plane - 1) * work.both.shape[1] + n_pairs * first
            both, details = all_both[at : at + n_all], all_details[2 * at : 2 * (at + n_all)]
            if is_encoding:
                log_strip(
                    pairs[:n_all], singles[: 2 * n_all], details, work.more, frequencies, streams
                )
            else:
                memory = work.entries, work.symbols, work.more
                read_strip(
                    memory, pairs[:n_all], singles[: 2 * n_all], both, details, lattice.most,
                    frequencies, values, streams,
                )  # fmt: skip
            if plane != LH:
                for row in range(first, last):
                    source = np.uint64(2 * n_pairs * (row - first))
                    to = np.uint64((plane - 1) * pitches[1] + (row + 1) * pitches[0] + 1)
                    for k in range(np.uint64(n)):
                        flats[2][to + k] = np.int16(min(abs(details[source + k]), MOST_NEAR))


@kernel
def look(plane, features, weights, found):
    """Fill with each of some weights what is expected of the samples of a plane, coded before."""
    (ranges, bends, near), found = borrowed((features, found))
    flats = borrowed((ranges.reshape(-1), bends.reshape(-1), near.reshape(-1)))
    pitches = near.shape[2], near.shape[1] * near.shape[2]
    for k in range(found.shape[0]):
        for row in range(found.shape[1]):
            _expect_row(flats, pitches, plane, row, weights[k], found.shape[2], found[k, row])


@kernel
def count_seen(features, details, is_coded, weights, memory, pairs, singles, escaped):
    """Count the symbols of pairs, by their class; those of their samples as if coded alone, too.

    Only of classes that may be below a cut that encoders choose, or not.
    """
    features, details, is_coded = borrowed((features, details, is_coded))
    expected, floats, bits, of_pairs, of_singles = borrowed(memory)
    pairs, singles, escaped = borrowed((pairs, singles, escaped))
    v0, v1, v2, v3, shift = weights[0], weights[1], weights[2], weights[3], weights[4]
    most = expected.shape[0]
    for begin in range(0, details.shape[0], most):
        n = min(most, details.shape[0] - begin)
        for k in range(n):
            both = v1 * features[0, begin + k] + v2 * features[1, begin + k]
            expected[k] = (both >> shift) + v3 * features[2, begin + k] + v0
        _class_row(expected, floats, bits, n, of_pairs, of_singles, 0)
        for k in range(0, n, 2):
            i, own = begin + k, of_pairs[k >> 1]
            if not (is_coded[i] or is_coded[i + 1]):
                continue
            symbol = pair_symbol(details[i], details[i + 1])
            if own < MOST_CUT:
                pairs[own, symbol] += 1
            for j in range(2):
                if own < MOST_CUT and symbol == PAIR_ESCAPE:
                    escaped[own, single_symbol(details[i + j])] += 1
                if own >= LEAST_CUT and is_coded[i + j]:
                    single = of_singles[k + j]
                    singles[own, single, single_symbol(details[i + j] >> raw_bits(single))] += 1


def n_strips(n_rows: int) -> int:
    """Return how many strips a lattice has: as many as HL needs, and LH a row further down."""
    return -(-max((n_rows + 1) // 2, n_rows // 2 + 1) // STRIP_ROWS)
