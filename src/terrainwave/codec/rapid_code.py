"""Details of one row: symbols, raw bits, heights; written or read (format-rapid.md, R.7-R.9)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.rapid_layout import (
    CONTEXT,
    DETAIL,
    ERRORS,
    GOAL,
    PLANE,
    PREDICTED,
    SIDE,
    STRIDE,
    SYMBOL,
    VALID,
    WHOLE,
)
from terrainwave.codec.rapid_magnitude import MOST_ERROR, N_CONTEXTS
from terrainwave.coding.jit import inlined_kernel, kernel
from terrainwave.coding.rans import N_STATES, decode_row, decode_symbol

# Symbols: an escape, then the upper parts of details, -30 … 31.
ESCAPE, ZERO, N_SYMBOLS = 0, 31, 63
ESCAPE_BITS = 33
_FREQ_MASK = np.uint32(0xFFFF)
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

    Decoding uses `slots`, `words`, `n_words`, `states`, `n_states`; encoding `freqs` and the
    logs. `n_bits` of
    raw bits can be there; the arrays have as much to spare as a row may read.
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
def code_span(goal, m, first, stop, to, has_void, scale, s):
    """Encode or decode samples ``first`` … ``stop - 1`` of a row; their heights go to `to`.

    Where `goal` is None symbols are read, else `GOAL` holds what to approximate. With `has_void`,
    `VALID` says which samples have a symbol.
    """
    n = stop - first
    if n <= 0:
        return
    at = np.uint64(first)
    if goal is None:
        _read_symbols(m, at, n, has_void, s)
    else:
        _quantize(m, at, n, has_void, scale, s)
    cast = m.dtype.type
    if _needs_raw(m, at, n):
        _code_raw(goal, m, at, n, has_void, scale, s)
    step, low, high = cast(scale.step), cast(scale.low), cast(scale.high)
    for j in range(n):
        k = at + np.uint64(j)
        detail = cast(-m[k + DETAIL]) if m[k + SIDE] < 0 else m[k + DETAIL]
        height = cast(m[k + WHOLE] + cast(detail * step))
        m[to + k] = min(max(height, low), high)


@kernel
def note_errors(m, n, own, scale):
    """Fill the errors of a row whose heights begin at `own`."""
    cast, shift = m.dtype.type, scale.error_shift
    to = own + np.uint64(ERRORS * PLANE)
    for j in range(n):
        k = np.uint64(j)
        error = cast(abs(cast(64 * m[own + k] - m[k + PREDICTED])))
        m[to + k] = min(cast(error >> shift), cast(MOST_ERROR))


@kernel
def _read_symbols(m, at, n, has_void, s):
    """Decode `SYMBOL`, and `DETAIL` but for raw bits."""
    cast = m.dtype.type
    start = min(s.places[WORD_POS], s.n_words)
    count = s.places[COUNT]
    if not has_void and s.n_states == N_STATES:
        end = decode_row(m, at + CONTEXT, at + SYMBOL, n, s.slots, s.words, start, s.states, count)
        s.places[COUNT] = count + n
    else:
        end = start
        for j in range(n):
            m[at + np.uint64(j) + SYMBOL] = ZERO
            if not has_void or m[at + np.uint64(j) + VALID] != 0:
                which = count & (s.n_states - 1)
                end = np.int64(
                    decode_symbol(
                        m, at + CONTEXT, at + SYMBOL, j, s.slots, s.words, end, s.states, which
                    )
                )
                count += 1
        s.places[COUNT] = count
    s.places[WORD_POS] += end - start
    for j in range(n):
        k = at + np.uint64(j)
        m[k + DETAIL] = cast(m[k + SYMBOL] - ZERO)


@kernel
def _quantize(m, at, n, has_void, scale, s):
    """Fill `DETAIL` and `SYMBOL` from `GOAL`; log the symbols."""
    cast = m.dtype.type
    if has_void:
        for j in range(n):
            k = at + np.uint64(j)
            m[k + GOAL] = m[k + GOAL] if m[k + VALID] != 0 else m[k + WHOLE]
    half, inverse = scale.step >> 1, 1.0 / scale.step
    for j in range(n):
        k = at + np.uint64(j)
        distance = cast(m[k + GOAL] - m[k + WHOLE])
        # A quotient is at least 0.5 / step away from a whole number: rounding can't matter.
        size = cast(np.int64((np.float64(abs(distance)) + (half + 0.5)) * inverse))
        flips = (distance < 0) != (m[k + SIDE] < 0)
        m[k + DETAIL] = cast(-size) if flips else size
    for j in range(n):
        k = at + np.uint64(j)
        upper = cast(m[k + DETAIL] >> cast(low_bits(m[k + CONTEXT])))
        is_near = (upper > -ZERO) and (upper <= ZERO)
        symbol = upper + ZERO if is_near else ESCAPE
        freq = s.freqs[m[k + CONTEXT], symbol] & _FREQ_MASK
        m[k + SYMBOL] = cast(symbol if freq > 0 else ESCAPE)
    count = s.places[COUNT]
    if not has_void:
        for j in range(n):
            s.contexts_log[count + j] = m[at + np.uint64(j) + CONTEXT]
        for j in range(n):
            s.symbols_log[count + j] = m[at + np.uint64(j) + SYMBOL]
        s.places[COUNT] = count + n
        return
    for j in range(n):
        k = at + np.uint64(j)
        if m[k + VALID] != 0:
            s.contexts_log[count] = m[k + CONTEXT]
            s.symbols_log[count] = m[k + SYMBOL]
            count += 1
    s.places[COUNT] = count


@kernel
def _needs_raw(m, at, n):
    """Return whether a row has raw bits: a context with low bits, or an escape."""
    cast = m.dtype.type
    most, least = cast(0), cast(N_CONTEXTS)
    for j in range(n):
        most = max(most, m[at + np.uint64(j) + CONTEXT])
    for j in range(n):
        least = min(least, m[at + np.uint64(j) + SYMBOL])
    return most >= _FIRST_RAW or least == ESCAPE


@kernel
def _code_raw(goal, m, at, n, has_void, scale, s):
    """Write or read the raw bits of a row and complete `DETAIL`."""
    cast = m.dtype.type
    start = min(s.places[BIT_POS], s.n_bits)
    bit_pos = start
    most = np.int64(scale.most_detail)
    for j in range(n):
        k = at + np.uint64(j)
        if has_void and m[k + VALID] == 0:
            continue
        n_low = np.int64(low_bits(m[k + CONTEXT]))
        if m[k + SYMBOL] == ESCAPE:
            n_low = np.int64(ESCAPE_BITS)
        elif n_low == 0:
            continue
        if goal is None:
            bits = read_bits(s.raw, bit_pos, n_low)
            if n_low == ESCAPE_BITS:
                sign = np.int64(1) << (ESCAPE_BITS - 1)
                detail = (bits ^ sign) - sign
            else:
                detail = (np.int64(m[k + DETAIL]) << n_low) | bits
            m[k + DETAIL] = cast(min(max(detail, -most), most))
        else:
            bits = np.int64(m[k + DETAIL]) & ((np.int64(1) << n_low) - 1)
            write_bits(s.raw, bit_pos, bits)
        bit_pos += n_low
    s.places[BIT_POS] += bit_pos - start


@inlined_kernel
def read_bits(raw, bit_pos, n):
    """Return `n` <= 33 bits from a bit on, the first one lowest."""
    at = np.uint64(bit_pos >> 5)
    both = np.uint64(raw[at]) | np.uint64(raw[at + np.uint64(1)]) << np.uint64(32)
    shifted = both >> np.uint64(bit_pos & 31)
    return np.int64(shifted & ((np.uint64(1) << np.uint64(n)) - np.uint64(1)))


@inlined_kernel
def write_bits(raw, bit_pos, bits):
    """Put bits, at most 33, where all following ones are still 0."""
    at = np.uint64(bit_pos >> 5)
    both = np.uint64(bits) << np.uint64(bit_pos & 31)
    raw[at] |= np.uint32(both & _MASK32)
    raw[at + np.uint64(1)] |= np.uint32(both >> np.uint64(32))
