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

_TO_CLASS, _CLASS_ZERO = 22, 2 * 127
_i32, _u64 = np.int32, np.uint64
_ONE = np.uint64(1)
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
    v0, v1, v2, v3 = weights[0], weights[1], weights[2], weights[3]
    shift = weights[4] & 31  # 16 at most; with this, all sums stay of 32 bits
    pitch, size = _u64(pitches[0]), _u64(pitches[1])
    # One row and column outside are there.
    here = _u64(row + 1) * pitch + _ONE
    above, below, n = here - pitch, here + pitch, _u64(n)
    if plane == HH:
        for k in range(n):
            at, under = here + k, below + k
            bend = _i32(bends[at]) + _i32(bends[at + _ONE])
            bend = _i32(bend + _i32(bends[under]) + _i32(bends[under + _ONE]))
            total = max(_i32(v1 * _i32(ranges[at]) + v2 * bend), _i32(0))
            expected[k] = (total >> shift) + v0
    elif plane == HL:
        for k in range(n):
            at, over = here + k, above + k
            bend = _i32(_i32(bends[at]) + _i32(bends[at + _ONE]))
            both = _i32(_i32(ranges[at]) + _i32(ranges[over]))
            total = max(_i32(v1 * both + v2 * bend), _i32(0))
            expected[k] = (total >> shift) + v3 * _i32(_i32(near[over]) + _i32(near[at])) + v0
    else:
        for k in range(n):
            at, under = here + k, below + k
            bend = _i32(_i32(bends[at]) + _i32(bends[under]))
            both = _i32(_i32(ranges[at]) + _i32(ranges[at - _ONE]))
            total = max(_i32(v1 * both + v2 * bend), _i32(0))
            details = _i32(near[at]) + _i32(near[at - _ONE])
            at, under = at + size, under + size
            details += _i32(near[at]) + _i32(near[at - _ONE])
            details = _i32(details + _i32(near[under]) + _i32(near[under - _ONE]))
            expected[k] = (total >> shift) + v3 * details + v0


@kernel_part
def _classify(value):
    """Return a number, as float32, whose top bits are the class of an expected magnitude.

    The class has the two top bits of the number and where they stand. A float32 has them, too:
    without the bits two below those that are set, no rounding reaches them.
    """
    value = max(value, _i32(1))
    return np.float32(_i32(value & ~_i32(value >> 2)))


@kernel_part
def _class_of(bits):
    """Return the class that the bits of a float32 of `_classify` say."""
    return np.int8(min(_i32(_i32(bits >> _TO_CLASS) - _CLASS_ZERO), _i32(N_CLASSES - 1)))


@kernel_part
def _class_row(expected, floats, bits, n, pairs, singles, at):
    """Fill the classes of the samples of a row, and of its pairs, from pair `at` on.

    An odd one is a pair alone.
    """
    if n & 1:
        expected[n] = expected[n - 1]
    n_pairs, first, at = _u64((n + 1) // 2), _u64(2 * at), _u64(at)
    for k in range(_u64(n)):
        floats[k] = _classify(expected[k])
    for k in range(_u64(n)):
        singles[first + k] = _class_of(bits[k])
    for k in range(n_pairs):
        mean = _i32(_i32(expected[k + k] >> 1) + _i32(expected[k + k + _ONE] >> 1))
        floats[k] = _classify(mean)
    for k in range(n_pairs):
        pairs[at + k] = _class_of(bits[k])
    if n & 1:
        singles[first + _u64(n)] = HIDDEN


@kernel_part
def _hide_voids(valid, plane, row, n, pairs, singles, at):
    """Hide void samples of a row, and pairs of them."""
    here, col, first = valid[2 * row + (plane != HL)], _u64(plane != LH), _u64(2 * at)
    for k in range(_u64(n)):
        singles[first + k] = singles[first + k] if here[col + k + k] else np.int8(HIDDEN)
    for k in range(_u64(at), _u64(at + (n + 1) // 2)):
        is_hidden = (singles[k + k] == HIDDEN) & (singles[k + k + _ONE] == HIDDEN)
        pairs[k] = np.int8(HIDDEN) if is_hidden else pairs[k]


@kernel_part
def _forget_near(lattice, near, first):
    """Clear what is near outside of HH and HL, and above the first strip of a band."""
    near[:, STRIP_ROWS * first] = 0
    near[0, lattice.n_rows // 2 + 1] = near[1, (lattice.n_rows + 1) // 2 + 1] = 0
    near[:, :, 0] = near[:, :, lattice.n_cols // 2 + 1] = 0


@kernel_part
def _class_strip(lattice, work, flats, valid, strip, plane, weights):
    """Fill the classes of a strip of a plane; return its rows and the number of columns."""
    near, pairs, singles, expected = work.near, work.pairs, work.singles, work.expected
    n_rows = (lattice.n_rows + (plane == HL)) // 2
    n = (lattice.n_cols + (plane == LH)) // 2
    first = max(STRIP_ROWS * strip - (plane == LH), 0)
    last = min(STRIP_ROWS * (strip + 1) - (plane == LH), n_rows)
    if n == 0:
        last = first
    pitches = near.shape[2], near.shape[1] * near.shape[2]
    for row in range(first, last):
        at = (n + 1) // 2 * (row - first)
        _expect_row(flats, pitches, plane, row, weights[plane - 1], n, expected)
        _class_row(expected, work.floats, work.bits, n, pairs, singles, at)
        if lattice.has_void:
            _hide_voids(valid, plane, row, n, pairs, singles, at)
    return first, last, n


@kernel_part
def _of_strip(work, plane, first, last, n):
    """Return the classes of pairs and samples of a strip, and where their details are."""
    n_pairs = (n + 1) // 2
    n_all, at = n_pairs * (last - first), 2 * n_pairs * first
    details = work.details[plane - 1]
    return work.pairs[:n_all], work.singles[: 2 * n_all], details[at : at + 2 * n_all]


@kernel_part
def _note_near(near, details, plane, first, last, n):
    """Note how large the details of rows are, for planes after their own."""
    for row in range(first, last if plane != LH else first):
        to, at = near[plane - 1, row + 1], _u64((n + (n & 1)) * (row - first))
        for k in range(_u64(n)):
            to[k + _ONE] = np.int16(min(_i32(abs(details[at + k])), _i32(MOST_NEAR)))


@kernel
def read_details(lattice, work, valid, strips, weights, frequencies, streams):
    """Read the details of strips ``strips[0] ... strips[1] - 1`` of a band.

    Nothing is known of strips before the first one of a band. Rows of `weights` belong to HH, HL
    and LH.
    """
    work, valid = borrowed((work, valid))
    flats = borrowed((work.ranges.reshape(-1), work.bends.reshape(-1), work.near.reshape(-1)))
    memory = work.entries, work.symbols, work.more
    _forget_near(lattice, work.near, strips[0])
    for strip in range(strips[0], strips[1]):
        for plane in (HH, HL, LH):
            first, last, n = _class_strip(lattice, work, flats, valid, strip, plane, weights)
            if first < last:
                pairs, singles, details = _of_strip(work, plane, first, last, n)
                read_strip(memory, pairs, singles, details, lattice.most, frequencies, streams)
                _note_near(work.near, details, plane, first, last, n)


@kernel
def log_details(lattice, work, valid, strips, weights, frequencies, streams):
    """Log the details of strips of a band, as `read_details` reads them."""
    work, valid = borrowed((work, valid))
    flats = borrowed((work.ranges.reshape(-1), work.bends.reshape(-1), work.near.reshape(-1)))
    _forget_near(lattice, work.near, strips[0])
    for strip in range(strips[0], strips[1]):
        for plane in (HH, HL, LH):
            first, last, n = _class_strip(lattice, work, flats, valid, strip, plane, weights)
            if first < last:
                pairs, singles, details = _of_strip(work, plane, first, last, n)
                log_strip(pairs, singles, details, work.more, frequencies, streams)
                _note_near(work.near, details, plane, first, last, n)


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
