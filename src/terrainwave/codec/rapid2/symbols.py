"""Details of a unit: classes by what is known before any height, symbols, raw bits.

A *list* has one entry for each pair of samples of rows side by side, or two where the pair's class
is above the file's cut. An entry is the number of a table of frequencies: pairs have those below
SINGLES, samples of their own those from it on. Entry k of a list uses state k mod n_states.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel, kernel_part

SLOT_BITS = 12
N_SLOTS = 1 << SLOT_BITS
N_SYMBOLS = 256
STATE_START = 1 << 16
MOST_STATES = 32
# Classes are two for each doubling of the expected magnitude E, in 2**-14 steps; class 28: a step.
N_CLASSES = 60
STEP_BITS = 14
STEP_CLASS = 2 * STEP_BITS
# Tables: pairs by class, then samples by class.
SINGLES, N_TABLES = 64, 128
# What is not coded (void, or known before): two details of 0, or one.
NO_PAIR, NO_SINGLE = 63, 127
# Samples of pairs that have no symbol.
ESCAPED = 126
HIDDEN = 255
# Symbols of pairs: (a + 7) 15 + b + 7, and one that says that both come as samples; of samples:
# d + 31, and one that says that more bits follow.
PAIR_LIMIT, SINGLE_LIMIT = 7, 31
PAIR_ESCAPE, SINGLE_ESCAPE = 225, 63
_SIDE = 2 * PAIR_LIMIT + 1
NOTHING = (_SIDE * _SIDE) // 2
# Samples above this class have raw bits: one more for each two classes.
_RAW_CLASS = STEP_CLASS + 4
# Details as large as this say no more of those beside them.
MOST_NEAR = 4095
_LENGTH_BITS = 5

# Places in a unit's streams.
WORD, BIT, N_LOGGED, IS_BAD = 0, 1, 2, 3


def _values() -> NDArray[np.int16]:
    """Return the details of symbols: of pairs (first, second), of samples, shape (3, 256)."""
    values = np.zeros((3, N_SYMBOLS), dtype=np.int16)
    pairs = np.arange(_SIDE * _SIDE)
    values[0, : len(pairs)], values[1, : len(pairs)] = np.divmod(pairs, _SIDE)
    values[:2, : len(pairs)] -= PAIR_LIMIT
    values[2, :SINGLE_ESCAPE] = np.arange(SINGLE_ESCAPE) - SINGLE_LIMIT
    values[2, SINGLE_ESCAPE] = SINGLE_LIMIT + 1
    return values


VALUES = _values()


class Frequencies(NamedTuple):
    """Tables as kernels read them.

    ``slots[table << SLOT_BITS | slot]`` is ``symbol | (frequency - 1) << 8 | place << 20``, `place`
    that of the slot among those of the symbol. ``freqs[table, symbol]`` and the sum of those before
    it, ``starts``, are for encoders. Pairs of classes from `cut` on are two samples each.
    """

    cut: int
    slots: NDArray[np.uint32]
    freqs: NDArray[np.uint32]
    starts: NDArray[np.uint32]


def frequencies_of(cut: int, freqs: NDArray[np.int64]) -> Frequencies:
    """Return tables from frequencies, shape (N_TABLES, N_SYMBOLS); rows sum to N_SLOTS or 0."""
    freqs = freqs.copy()
    # Decoders go through these without a change of any state.
    freqs[[NO_PAIR, NO_SINGLE]] = 0
    freqs[freqs.sum(1) == 0, NOTHING] = N_SLOTS
    starts = np.cumsum(freqs, 1) - freqs
    symbols = np.repeat(np.tile(np.arange(N_SYMBOLS), N_TABLES), freqs.ravel())
    tables = np.repeat(np.arange(N_TABLES), N_SLOTS)
    places = np.tile(np.arange(N_SLOTS), N_TABLES) - starts[tables, symbols]
    slots = symbols | (freqs[tables, symbols] - 1) << 8 | places << 20
    return Frequencies(
        cut, slots.astype(np.uint32), freqs.astype(np.uint32), starts.astype(np.uint32)
    )


@kernel_part
def class_of(expected):
    """Return the class of an expected magnitude, 0 ... 2**31 - 1."""
    value = np.uint32(max(expected, np.int64(1)))
    log = np.int64(0)
    for bits in (16, 8, 4, 2, 1):
        if value >> np.uint32(bits):
            value >>= np.uint32(bits)
            log += bits
    # The bit below the top one: `value` is 1 now.
    below = (np.int64(max(expected, np.int64(1))) >> max(log - 1, 0)) & 1 if log else 0
    return min(2 * log + below, N_CLASSES - 1)


@kernel_part
def make_list(pairs, singles, n_pairs, cut, entries):
    """Write the entries of a list; return how many there are."""
    n, one = np.uint64(0), np.uint64(1)
    for k in range(np.uint64(n_pairs)):
        # Nothing branches by the class, which no processor foresees.
        own = np.int64(np.int8(pairs[k]))
        is_single = np.uint64(own >= cut)
        j = k + k
        first, second = SINGLES | np.int64(singles[j]), SINGLES | np.int64(singles[j + one])
        entries[n] = np.uint8((first & 127) if is_single else own & 63)
        entries[n + one] = np.uint8(second & 127)
        n += one + is_single
    return np.int64(n)


@kernel_part
def _raw_bits(single):
    """Return how many raw bits a sample has that is coded by itself."""
    return 0 if single == HIDDEN else max(np.int64(single) - _RAW_CLASS, 0) >> 1


@kernel_part
def _take(raw, places, n):
    """Return the next n raw bits, at most 33."""
    bit = places[BIT]
    places[BIT] = bit + n
    if n == 0 or bit + n > 8 * (raw.shape[0] - 8):
        return np.int64(0)
    value = np.uint64(0)
    for k in range(6):
        value |= np.uint64(raw[(bit >> 3) + k]) << np.uint64(8 * k)
    return np.int64((value >> np.uint64(bit & 7)) & ((np.uint64(1) << np.uint64(n)) - np.uint64(1)))


@kernel_part
def _read_entries(entries, n, slots, states, n_states, words, places, symbols):
    """Read the symbols of a list. Past the last word, the last ones are read again."""
    at, most = np.uint64(places[WORD]), np.uint64(words.shape[0] - MOST_STATES)
    # Unsigned, so that no index needs to be checked for a sign; without a branch, which no
    # processor would foresee.
    mask, n = np.uint64(n_states - 1), np.uint64(n)
    first = np.uint64(0)
    while first < n:
        if at > most:
            places[IS_BAD] = 1
            at = most
        last = min(first + np.uint64(MOST_STATES), n)
        for k in range(first, last):
            state = states[k & mask]
            table = np.uint64(entries[k]) << np.uint64(SLOT_BITS)
            found = slots[table | np.uint64(state & np.uint32(N_SLOTS - 1))]
            whole = state >> np.uint32(SLOT_BITS)
            freq = (found >> np.uint32(8)) & np.uint32(N_SLOTS - 1)
            state = freq * whole + whole + (found >> np.uint32(20))
            symbols[k] = np.uint8(found & np.uint32(255))
            is_short = np.uint32(state < np.uint32(STATE_START))
            word = np.uint32(words[at]) * is_short
            states[k & mask] = (state << (is_short << np.uint32(4))) | word
            at += np.uint64(is_short)
        first = last
    places[WORD] = np.int64(at)


@kernel_part
def _beyond(raw, places):
    """Return what a symbol says no more: a signed number beyond SINGLE_LIMIT."""
    length = _take(raw, places, _LENGTH_BITS)
    rest = _take(raw, places, length + 1)
    beyond = (np.int64(1) << length) - 1 + (rest >> 1) + SINGLE_LIMIT + 1
    return -beyond if rest & 1 else beyond


@kernel_part
def read_strip(
    pairs, singles, n_pairs, entries, symbols, details, most, values, cut, slots, states, n_states,
    words, raw, places, more,
):  # fmt: skip
    """Read the details of a list, int32, two for each pair; none is beyond ±most.

    The list; a list of the samples of pairs that have no symbol; the raw bits of samples coded by
    themselves; what is beyond the symbols of these; the same of samples of pairs.
    """
    n = make_list(pairs, singles, n_pairs, cut, entries)
    _read_entries(entries, n, slots, states, n_states, words, places, symbols)
    k, n_more, n_escaped, n_beyond = np.uint64(0), np.uint64(0), np.uint64(0), 0
    one, end = np.uint64(1), np.uint64(more.shape[0] - 1)
    for pair in range(np.uint64(n_pairs)):
        j = pair + pair
        is_single = np.uint64(np.int64(np.int8(pairs[pair])) >= cut)
        symbol, other = np.uint64(symbols[k]), np.uint64(symbols[k + is_single])
        k += one + is_single
        details[j] = values[is_single + is_single, symbol]
        details[j + one] = values[one + is_single, other]
        # Escaped pairs from the end on, samples that are not complete from the start.
        more[end - n_escaped] = j
        n_escaped += np.uint64(symbol == np.uint64(PAIR_ESCAPE))
        more[n_more] = j
        n_more += is_single & np.uint64(
            (np.int8(singles[j]) > _RAW_CLASS + 1) | (symbol == np.uint64(SINGLE_ESCAPE))
        )
        more[n_more] = j + one
        n_more += is_single & np.uint64(
            (np.int8(singles[j + one]) > _RAW_CLASS + 1) | (other == np.uint64(SINGLE_ESCAPE))
        )
    n_escaped, n_more = np.int64(n_escaped), np.int64(n_more)
    if n_escaped:
        n = 2 * n_escaped
        for k in range(n):
            entries[k] = ESCAPED
        _read_entries(entries, n, slots, states, n_states, words, places, symbols)
    for k in range(n_more):
        i = more[k]
        n_bits = _raw_bits(singles[i])
        low = _take(raw, places, n_bits)
        if details[i] == values[2, SINGLE_ESCAPE]:
            # Those that go on; their raw bits wait in their place.
            details[i] = low
            more[n_beyond] = i
            n_beyond += 1
        else:
            details[i] = min(max((details[i] << n_bits) | low, -most), most)
    for k in range(n_beyond):
        i = more[k]
        detail = (_beyond(raw, places) << _raw_bits(singles[i])) | np.int64(details[i])
        details[i] = np.int32(min(max(detail, -np.int64(most)), np.int64(most)))
    for k in range(2 * n_escaped):
        i = more[more.shape[0] - 1 - (k >> 1)] + (k & 1)
        detail = np.int64(values[2, symbols[k]])
        if symbols[k] == SINGLE_ESCAPE:
            detail = _beyond(raw, places)
        details[i] = np.int32(min(max(detail, -np.int64(most)), np.int64(most)))


class Log(NamedTuple):
    """What an encoder writes down before it knows the first state."""

    tables: NDArray[np.uint8]
    symbols: NDArray[np.uint8]
    states: NDArray[np.uint8]
    raw: NDArray[np.uint8]


@kernel_part
def _put(raw, places, value, n):
    bit = places[BIT]
    shifted = np.uint64(value) << np.uint64(bit & 7)
    for k in range((n + (bit & 7) + 7) >> 3):
        raw[(bit >> 3) + k] |= np.uint8((shifted >> np.uint64(8 * k)) & np.uint64(255))
    places[BIT] = bit + n


@kernel_part
def _log(log, places, table, symbol, state):
    at = places[N_LOGGED]
    log.tables[at], log.symbols[at], log.states[at] = table, symbol, state
    places[N_LOGGED] = at + 1


@kernel_part
def _pair_symbol(table, first, second, freqs):
    """Return the symbol of two details; PAIR_ESCAPE where there is none, or it has no slot."""
    if max(abs(first), abs(second)) > PAIR_LIMIT:
        return PAIR_ESCAPE
    symbol = (first + PAIR_LIMIT) * _SIDE + second + PAIR_LIMIT
    return symbol if freqs[table, symbol] else PAIR_ESCAPE


@kernel_part
def _single_symbol(value):
    return SINGLE_ESCAPE if abs(value) > SINGLE_LIMIT else value + SINGLE_LIMIT


@kernel_part
def _put_beyond(raw, places, value):
    """Write what the symbol of a value says no more, if there is anything."""
    beyond = abs(value) - SINGLE_LIMIT - 1
    if beyond >= 0:
        length = 0
        while (np.int64(1) << (length + 1)) - 1 <= beyond:
            length += 1
        _put(raw, places, length, _LENGTH_BITS)
        rest = (beyond - ((np.int64(1) << length) - 1)) << 1 | np.int64(value < 0)
        _put(raw, places, rest, length + 1)


@kernel_part
def log_strip(pairs, singles, n_pairs, details, cut, freqs, n_states, log, places):
    """Log a list as `read_strip` reads it."""
    k = 0
    for pair in range(n_pairs):
        j = 2 * pair
        if pairs[pair] == HIDDEN:
            k += 1
        elif pairs[pair] < cut:
            symbol = _pair_symbol(pairs[pair], details[j], details[j + 1], freqs)
            _log(log, places, pairs[pair], symbol, k % n_states)
            k += 1
        else:
            for i in range(j, j + 2):
                if singles[i] != HIDDEN:
                    symbol = _single_symbol(details[i] >> _raw_bits(singles[i]))
                    _log(log, places, SINGLES | singles[i], symbol, k % n_states)
                k += 1
    k = 0
    for pair in range(n_pairs):
        j = 2 * pair
        if pairs[pair] < cut and (
            _pair_symbol(pairs[pair], details[j], details[j + 1], freqs) == PAIR_ESCAPE
        ):
            for i in range(j, j + 2):
                _log(log, places, ESCAPED, _single_symbol(details[i]), k % n_states)
                k += 1
    for pair in range(n_pairs):
        if cut <= pairs[pair] != HIDDEN:
            for j in range(2 * pair, 2 * pair + 2):
                n_bits = _raw_bits(singles[j])
                _put(log.raw, places, details[j] & ((np.int64(1) << n_bits) - 1), n_bits)
    for is_escaped in (False, True):
        for pair in range(n_pairs):
            j = 2 * pair
            if pairs[pair] == HIDDEN or (pairs[pair] < cut) != is_escaped:
                continue
            if is_escaped and (
                _pair_symbol(pairs[pair], details[j], details[j + 1], freqs) != PAIR_ESCAPE
            ):
                continue
            for i in range(j, j + 2):
                if is_escaped or singles[i] != HIDDEN:
                    n_bits = 0 if is_escaped else _raw_bits(singles[i])
                    _put_beyond(log.raw, places, np.int64(details[i]) >> n_bits)


@kernel
def encode_log(log, n, freqs, starts, words, states):
    """Encode what has been logged, from its end on; return how many words end `words`."""
    at = words.shape[0]
    for k in range(n - 1, -1, -1):
        table, symbol, lane = log.tables[k], log.symbols[k], log.states[k]
        freq, start = np.uint64(freqs[table, symbol]), np.uint64(starts[table, symbol])
        state = np.uint64(states[lane])
        if state >= freq << np.uint64(32 - SLOT_BITS):
            at -= 1
            words[at] = np.uint16(state & np.uint64(0xFFFF))
            state >>= np.uint64(16)
        quotient = state // freq
        states[lane] = np.uint32(
            (quotient << np.uint64(SLOT_BITS)) + state - quotient * freq + start
        )
    return words.shape[0] - at


@kernel
def count_log(log, n, counts):
    """Count the symbols that have been logged; `counts` as `Frequencies.freqs`."""
    for k in range(n):
        counts[log.tables[k], log.symbols[k]] += 1
