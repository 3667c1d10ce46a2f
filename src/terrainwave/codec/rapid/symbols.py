"""Details of one row: symbols, raw bits, heights; written or read (format-rapid.md, R.7-R.9)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.rapid.layout import (
    CONTEXT,
    DETAIL,
    ERROR_SHIFT,
    ERRORS,
    GOAL,
    N_LOW,
    PLANE,
    PREDICTED,
    SHIFT_MASK,
    SIDE,
    STRIDE,
    SYMBOL,
    VALID,
    WHOLE,
)
from terrainwave.codec.rapid.magnitude import MOST_ERROR
from terrainwave.coding.jit import inlined_kernel, kernel, kernel_part
from terrainwave.coding.rans import N_STATES, SYMBOL_BITS, decode_row, decode_symbol

# Symbols: an escape, then the upper parts of details, -30 … 31.
ESCAPE, ZERO, N_SYMBOLS = 0, 31, 63
ESCAPE_BITS = 33
_FREQ_MASK, _SYMBOL_MASK = np.uint32(0xFFFF), (1 << SYMBOL_BITS) - 1
_MASK32 = np.uint64(0xFFFFFFFF)
# Contexts from this one on have low bits (bin 18 is the first).
_FIRST_RAW = 4 * 18
_LAST_WITHOUT = 8
# What a row may read past the end: a word and an escape for each sample.
SPARE_WORDS = STRIDE
SPARE_BITS = STRIDE * (ESCAPE_BITS + 7)

# Indices into `Streams.places`.
WORD_POS, BIT_POS, COUNT = 0, 1, 2


class Streams(NamedTuple):
    """What a unit's symbols and raw bits are read from, or what they are logged in.

    Decoding uses `slots`, `words`, `n_words`, `states`, `n_states`; encoding `freqs` and the logs.
    `n_bits` of raw bits can be there; the arrays have as much to spare as a row may read.
    """

    places: NDArray[np.int64]
    slots: NDArray[np.uint32]
    words: NDArray[np.uint16]
    n_words: int
    states: NDArray[np.uint64]
    n_states: int
    raw: NDArray[np.uint32]
    n_bits: int
    freqs: NDArray[np.uint32]
    contexts_log: NDArray[np.uint8]
    symbols_log: NDArray[np.uint8]


@inlined_kernel
def low_bits(context):
    """Return how many low bits of a detail are raw."""
    return max((context >> 3) - _LAST_WITHOUT, 0)


@kernel
def code_details(m, at, n, to, is_encoding, has_void, scale, s):
    """Encode or decode the `n` samples of a row from column `at` on; heights go to place `to`.

    When encoding, `GOAL` holds what to approximate. With `has_void`, `VALID` says which samples
    have a symbol.
    """
    if is_encoding:
        _quantize(m, at, n, has_void, scale)
        _log_symbols(m, at, n, has_void, s.places, s.freqs, s.contexts_log, s.symbols_log)
    else:
        _read_symbols(
            m, at, n, has_void, s.places, s.slots, s.words, s.n_words, s.states, s.n_states,
        )  # fmt: skip
    has_raw, has_escape = _find_raw(m, at, n)
    if has_raw:
        most = np.int64(scale.most_detail)
        _code_raw(m, at, n, is_encoding, has_escape, most, s.places, s.raw, s.n_bits)
    _fill_heights(m, at, n, to, scale)


@kernel_part
def _read_symbols(m, at, n, has_void, places, slots, words, n_words, states, n_states):
    """Decode `SYMBOL`, and `DETAIL` but for raw bits."""
    cast = m.dtype.type
    start, count = min(places[WORD_POS], n_words), places[COUNT]
    contexts, symbols, valid = at + CONTEXT, at + SYMBOL, at + VALID
    if has_void:
        # What a void has no symbol for: a detail of 0, and no raw bits.
        for j in range(n):
            m[symbols + j] = ZERO
            m[contexts + j] = m[contexts + j] if m[valid + j] != 0 else 0
    n_all, end, j = np.int64(n), np.int64(start), np.int64(0)
    while j < n_all:
        first, j = j, n_all
        if has_void:
            while first < n_all and m[valid + np.uint64(first)] == 0:
                first += 1
            j = first
            while j < n_all and m[valid + np.uint64(j)] != 0:
                j += 1
        if n_states == N_STATES:
            skipped = np.uint64(first)
            end = decode_row(
                m, contexts + skipped, symbols + skipped, j - first, slots, words, end, states,
                count,
            )  # fmt: skip
        else:
            place = np.uint64(end)
            for k in range(first, j):
                place = decode_symbol(m, contexts, symbols, k, slots, words, place, states, 0)
            end = np.int64(place)
        count += j - first
    places[COUNT] = count
    places[WORD_POS] += end - start
    for j in range(n):
        symbol = cast(m[symbols + j] & _SYMBOL_MASK)
        m[symbols + j] = symbol
        m[DETAIL + at + j] = symbol - ZERO


@kernel_part
def _quantize(m, at, n, has_void, scale):
    """Fill `DETAIL` from `GOAL`."""
    cast = m.dtype.type
    if has_void:
        for j in range(n):
            k = at + j
            m[GOAL + k] = m[GOAL + k] if m[VALID + k] != 0 else m[WHOLE + k]
    half, inverse = scale.step >> 1, 1.0 / scale.step
    for j in range(n):
        k = at + j
        distance = cast(m[GOAL + k] - m[WHOLE + k])
        # A quotient is at least 0.5 / step away from a whole number: rounding can't matter.
        size = cast(np.int64((np.float64(abs(distance)) + (half + 0.5)) * inverse))
        flips = (distance < 0) != (m[SIDE + k] < 0)
        m[DETAIL + k] = cast(-size) if flips else size


@kernel_part
def _log_symbols(m, at, n, has_void, places, freqs, contexts_log, symbols_log):
    """Fill `SYMBOL` from `DETAIL`, and log the symbols."""
    cast = m.dtype.type
    count = places[COUNT]
    for j in range(n):
        k = at + j
        context = m[CONTEXT + k]
        upper = cast(m[DETAIL + k] >> cast(low_bits(context)))
        is_near = (upper > -ZERO) and (upper <= ZERO)
        symbol = upper + ZERO if is_near else ESCAPE
        own = freqs[np.uint64(context << SYMBOL_BITS) + np.uint64(symbol)]
        symbol = symbol if (own & _FREQ_MASK) > 0 else ESCAPE
        if not has_void or m[VALID + k] != 0:
            m[SYMBOL + k] = symbol
            contexts_log[count], symbols_log[count] = context, symbol
            count += 1
        else:
            m[SYMBOL + k], m[CONTEXT + k] = ZERO, 0
    places[COUNT] = count


@kernel_part
def _find_raw(m, at, n):
    """Return whether a row has raw bits, and whether it has an escape."""
    most, least = m[CONTEXT + at], m[SYMBOL + at]
    for j in range(n):
        most = max(most, m[CONTEXT + at + j])
        least = min(least, m[SYMBOL + at + j])
    has_escape = least == ESCAPE
    return has_escape or most >= _FIRST_RAW, has_escape


@kernel_part
def _code_raw(m, at, n, is_encoding, has_escape, most, places, raw, n_bits):
    """Write or read the raw bits of a row and complete `DETAIL`; an escape is at most `most`."""
    cast = m.dtype.type
    start = min(places[BIT_POS], n_bits)
    for j in range(n):
        k = at + j
        is_escape = m[SYMBOL + k] == ESCAPE
        m[N_LOW + k] = cast(ESCAPE_BITS) if is_escape else cast(low_bits(m[CONTEXT + k]))
    bit_pos = start
    for j in range(n):
        k = at + j
        n_low, detail = np.int64(m[N_LOW + k]), np.int64(m[DETAIL + k])
        if is_encoding:
            if n_low > 0:
                _write_bits(raw, bit_pos, detail & ((np.int64(1) << n_low) - 1))
        else:
            # Without a branch, which would often be foretold wrongly.
            m[DETAIL + k] = cast(detail << n_low | _read_bits(raw, bit_pos, n_low))
        bit_pos += n_low
    if has_escape and not is_encoding:
        after = start
        sign = np.int64(1) << (ESCAPE_BITS - 1)
        for j in range(n):
            k = at + j
            if m[SYMBOL + k] == ESCAPE:
                detail = (_read_bits(raw, after, ESCAPE_BITS) ^ sign) - sign
                m[DETAIL + k] = cast(min(max(detail, -most), most))
            after += np.int64(m[N_LOW + k])
    places[BIT_POS] += bit_pos - start


@kernel_part
def _fill_heights(m, at, n, to, scale):
    """Fill heights from place `to` on, from predictions and details."""
    cast = m.dtype.type
    step, low, high = cast(scale.step), cast(scale.low), cast(scale.high)
    # From one end of the range past the other: a larger detail, of a corrupt file, ends there too.
    least, most = cast(-scale.most_detail), cast(scale.most_detail)
    for j in range(n):
        k = at + j
        detail = min(max(m[DETAIL + k], least), most)
        detail = -detail if m[SIDE + k] < 0 else detail
        height = cast(m[WHOLE + k] + cast(detail * step))
        m[to + k] = min(max(height, low), high)


@kernel_part
def note_errors(m, n, own):
    """Fill the errors of a row whose heights begin at `own`."""
    cast, shift = m.dtype.type, m[ERROR_SHIFT] & SHIFT_MASK
    to = own + np.uint64(ERRORS * PLANE)
    for j in range(n):
        error = cast(abs(cast(64 * m[own + j] - m[PREDICTED + j])))
        m[to + j] = min(cast(error >> shift), cast(MOST_ERROR))


@kernel_part
def _read_bits(raw, bit_pos, n):
    """Return `n` <= 33 bits from a bit on, the first one lowest."""
    at = np.uint64(bit_pos >> 5)
    both = np.uint64(raw[at]) | np.uint64(raw[at + np.uint64(1)]) << np.uint64(32)
    shifted = both >> np.uint64(bit_pos & 31)
    return np.int64(shifted & ((np.uint64(1) << np.uint64(n)) - np.uint64(1)))


@kernel_part
def _write_bits(raw, bit_pos, bits):
    """Put bits, at most 33, where all following ones are still 0."""
    at = np.uint64(bit_pos >> 5)
    both = np.uint64(bits) << np.uint64(bit_pos & 31)
    raw[at] |= np.uint32(both & _MASK32)
    raw[at + np.uint64(1)] |= np.uint32(both >> np.uint64(32))
