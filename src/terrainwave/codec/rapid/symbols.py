"""Details of a unit: classes by what is known before any height, symbols, raw bits.

A *list* has one entry for each pair of samples of rows side by side, or two where the pair's class
is above the file's cut. An entry is the number of a table of frequencies: pairs have those below
SINGLES, samples of their own those from it on. Entry k of a list uses state k mod n_states.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.borrowed import borrowed
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
HIDDEN = -1
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


def _values() -> NDArray[np.int64]:
    """Return details of symbols as the halves of 64 bits, lower first, shape (4, 256).

    Rows: both of a pair; the first of two samples; nothing; the second of two.
    """
    values = np.zeros((4, N_SYMBOLS), dtype=np.int64)
    pairs = np.arange(_SIDE * _SIDE)
    first, second = pairs // _SIDE - PAIR_LIMIT, pairs % _SIDE - PAIR_LIMIT
    values[0, : len(pairs)] = (first & 0xFFFFFFFF) | second << 32
    samples = np.arange(SINGLE_ESCAPE + 1) - SINGLE_LIMIT
    values[1, : len(samples)] = samples & 0xFFFFFFFF
    values[3, : len(samples)] = samples << 32
    return values


VALUES = _values()
# The value of SINGLE_ESCAPE, which no other symbol has.
_GOES_ON = SINGLE_LIMIT + 1


class Log(NamedTuple):
    """What an encoder writes down before it knows the first state."""

    tables: NDArray[np.uint8]
    symbols: NDArray[np.uint8]
    states: NDArray[np.uint8]  # of MOST_STATES: of fewer, the remainder


class Streams(NamedTuple):
    """What kernels read or write of a band of strips; `raw` has bits, the lowest first."""

    states: NDArray[np.uint32]
    words: NDArray[np.uint16]
    raw: NDArray[np.uint32]
    log: Log
    places: NDArray[np.int64]


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
    own = np.arange(N_SYMBOLS) + ((freqs - 1) << 8) - (starts << 20)
    slots = np.repeat((own & 0xFFFFFFFF).astype(np.uint32).ravel(), freqs.ravel())
    slots += np.tile(np.arange(N_SLOTS, dtype=np.uint32) << np.uint32(20), N_TABLES)
    return Frequencies(cut, slots, freqs.astype(np.uint32), starts.astype(np.uint32))


@kernel_part
def _list_entries(pairs, singles, n_pairs, cut, entries):
    """Write the entries of a list; return how many there are."""
    n, one = np.uint64(0), np.uint64(1)
    for k in range(np.uint64(n_pairs)):
        # Nothing branches by the class, which no processor foresees.
        own, j = np.int64(pairs[k]), k + k
        is_single = np.uint64(own >= cut)
        first, second = SINGLES | np.int64(singles[j]), SINGLES | np.int64(singles[j + one])
        entries[n] = np.uint8((first & 127) if is_single else own & 63)
        entries[n + one] = np.uint8(second & 127)
        n += one + is_single
    return np.int64(n)


@kernel_part
def raw_bits(single):
    """Return how many raw bits a sample has that is coded by itself."""
    return max(np.int64(single) - _RAW_CLASS, 0) >> 1


@kernel_part
def _take(raw, places, n):
    """Return the next n raw bits, at most 32; past the end any."""
    bit = places[BIT]
    places[BIT] = bit + n
    at = np.uint64(min(bit >> 5, raw.shape[0] - 2))
    both = np.uint64(raw[at]) | np.uint64(raw[at + np.uint64(1)]) << np.uint64(32)
    mask = (np.uint64(1) << np.uint64(n)) - np.uint64(1)
    return np.int64((both >> np.uint64(bit & 31)) & mask)


@kernel
def read_entries(entries, n, slots, streams, symbols):
    """Read the symbols of a list. Past the last word, the last ones are read again."""
    entries, slots, symbols = borrowed((entries, slots, symbols))
    states, words, _, _, places = borrowed(streams)
    at, most = np.uint64(places[WORD]), np.uint64(words.shape[0] - MOST_STATES)
    # Unsigned, so that no index needs to be checked for a sign; without a branch, which no
    # processor would foresee. A state is at most N_SLOTS * (2**20 - 1) + N_SLOTS - 1 < 2**32.
    mask, n = np.uint64(states.shape[0] - 1), np.uint64(n)
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
            is_short = state < np.uint32(STATE_START)
            longer = (state << np.uint32(16)) | np.uint32(words[at])
            states[k & mask] = longer if is_short else state
            at += np.uint64(is_short)
        first = last
    places[WORD] = np.int64(at)


@kernel_part
def _beyond(raw, places):
    """Return what a symbol says no more: a signed number beyond SINGLE_LIMIT, below 2**33."""
    length = _take(raw, places, _LENGTH_BITS)
    rest = _take(raw, places, length + 1)
    beyond = (np.int64(1) << length) - 1 + (rest >> 1) + SINGLE_LIMIT + 1
    return -beyond if rest & 1 else beyond


@kernel_part
def _expand(pairs, n_pairs, cut, symbols, values, both, more):
    """Fill the details that symbols stand for; return how many pairs have none, first in `more`."""
    k, n_escaped, one = np.uint64(0), np.uint64(0), np.uint64(1)
    for pair in range(np.uint64(n_pairs)):
        is_single = np.uint64(np.int64(pairs[pair]) >= cut)
        symbol, other = np.uint64(symbols[k]), np.uint64(symbols[k + is_single])
        k += one + is_single
        both[pair] = values[is_single, symbol] | values[np.uint64(2) + is_single, other]
        more[n_escaped] = pair + pair
        n_escaped += np.uint64(symbol == np.uint64(PAIR_ESCAPE))
    return np.int64(n_escaped)


@kernel_part
def _complete(pairs, singles, n_pairs, cut, streams, details, more, most):
    """Read the raw bits of samples coded by themselves, and what is beyond their symbols.

    A detail is below 2**33 << 13 before it is brought within ±most, which fits 32 bits.
    """
    raw, places = streams.raw, streams.places
    n_beyond = 0
    for pair in range(n_pairs):
        if pairs[pair] < cut:
            continue
        for i in range(2 * pair, 2 * pair + 2):
            n_bits = raw_bits(singles[i])
            goes_on = details[i] == _GOES_ON
            if n_bits == 0 and not goes_on:
                continue
            low = _take(raw, places, n_bits)
            detail = (np.int64(details[i]) << n_bits) | low
            # Raw bits of those that go on wait in their place.
            details[i] = np.int32(low if goes_on else min(max(detail, -most), most))
            more[n_beyond] = i
            n_beyond += goes_on
    for k in range(n_beyond):
        i = more[k]
        detail = (_beyond(raw, places) << raw_bits(singles[i])) | np.int64(details[i])
        details[i] = np.int32(min(max(detail, -most), most))


@kernel
def read_strip(memory, pairs, singles, both, details, most, frequencies, values, streams):
    """Read the details of a list, two for each pair; none of many bits is beyond ±most.

    The list; a list of the samples of pairs that have no symbol; the raw bits of samples coded by
    themselves; what is beyond the symbols of these; the same of samples of pairs.
    """
    pairs, singles, both, details = borrowed((pairs, singles, both, details))
    entries, symbols, more = borrowed(memory)
    streams = borrowed(streams)
    cut, slots = frequencies.cut, frequencies.slots
    n_pairs = pairs.shape[0]
    n = _list_entries(pairs, singles, n_pairs, cut, entries)
    read_entries(entries, n, slots, streams, symbols)
    n_escaped = _expand(pairs, n_pairs, cut, symbols, values, both, more)
    # Samples of pairs without a symbol are at the end of `more`, as others are put at its start.
    first = more.shape[0] - n_escaped
    for k in range(n_escaped - 1, -1, -1):
        more[first + k] = more[k]
    if n_escaped:
        for k in range(2 * n_escaped):
            entries[k] = ESCAPED
        read_entries(entries, 2 * n_escaped, slots, streams, symbols)
    if n > n_pairs:
        _complete(pairs, singles, n_pairs, cut, streams, details, more, most)
    for k in range(2 * n_escaped):
        i = more[first + (k >> 1)] + (k & 1)
        detail = np.int64(np.int32(values[1, symbols[k]]))
        if detail == _GOES_ON:
            detail = _beyond(streams.raw, streams.places)
        details[i] = np.int32(min(max(detail, -most), most))


@kernel_part
def _put(raw, places, value, n):
    bit = places[BIT]
    shifted = np.uint64(value) << np.uint64(bit & 31)
    raw[bit >> 5] |= np.uint32(shifted & np.uint64(0xFFFFFFFF))
    raw[(bit >> 5) + 1] |= np.uint32(shifted >> np.uint64(32))
    places[BIT] = bit + n


@kernel_part
def pair_symbol(first, second):
    """Return the symbol of two details, PAIR_ESCAPE where there is none."""
    x, y = first + PAIR_LIMIT, second + PAIR_LIMIT
    return x * _SIDE + y if 0 <= x < _SIDE and 0 <= y < _SIDE else PAIR_ESCAPE


@kernel_part
def single_symbol(value):
    """Return the symbol of a detail's upper part, SINGLE_ESCAPE where it goes on."""
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


@kernel
def log_strip(pairs, singles, details, more, frequencies, streams):
    """Log a list as `read_strip` reads it. What is hidden has the one symbol of its table."""
    pairs, singles, details, more = borrowed((pairs, singles, details, more))
    log, raw, places = borrowed((streams.log, streams.raw, streams.places))
    cut, freqs = frequencies.cut, borrowed(frequencies.freqs)
    n_pairs, one, at = np.uint64(pairs.shape[0]), np.uint64(1), np.uint64(places[N_LOGGED])
    tables, symbols, states = log.tables[at:], log.symbols[at:], log.states[at:]
    n = np.uint64(_list_entries(pairs, singles, n_pairs, cut, tables))
    k, n_escaped, last = np.uint64(0), np.uint64(0), np.uint64(more.shape[0])
    first_beyond = last
    for pair in range(n_pairs):
        i = pair + pair
        if pairs[pair] < cut:
            symbol = pair_symbol(details[i], details[i + one])
            has_none = pairs[pair] != HIDDEN and freqs[tables[k], symbol] == 0
            if symbol == PAIR_ESCAPE or has_none:
                symbol = PAIR_ESCAPE
                more[n_escaped] = i
                n_escaped += one
            symbols[k] = symbol
            k += one
        else:
            for _ in range(2):
                n_bits = raw_bits(singles[i])
                value = details[i] >> n_bits
                symbols[k] = NOTHING if singles[i] == HIDDEN else single_symbol(value)
                k += one
                if n_bits:
                    _put(raw, places, details[i] & ((np.int64(1) << n_bits) - 1), n_bits)
                if abs(value) > SINGLE_LIMIT:
                    first_beyond -= one
                    more[first_beyond] = i
                i += one
    for k in range(n):
        states[k] = k & np.uint64(MOST_STATES - 1)
    k = last
    while k > first_beyond:
        k -= one
        i = more[k]
        _put_beyond(raw, places, np.int64(details[i]) >> raw_bits(singles[i]))
    for k in range(n_escaped + n_escaped):
        detail = details[np.uint64(more[k >> one]) + (k & one)]
        tables[n + k], symbols[n + k] = ESCAPED, single_symbol(detail)
        states[n + k] = k & np.uint64(MOST_STATES - 1)
        if abs(detail) > SINGLE_LIMIT:
            _put_beyond(raw, places, np.int64(detail))
    places[N_LOGGED] = at + n + n_escaped + n_escaped


@kernel
def encode_log(streams, frequencies, words):
    """Encode what has been logged, from its end on; return how many words end `words`."""
    log, states, words = borrowed((streams.log, streams.states, words))
    freqs, starts = borrowed((frequencies.freqs, frequencies.starts))
    one, at, k = np.uint64(1), np.uint64(words.shape[0]), np.uint64(streams.places[N_LOGGED])
    mask = np.uint64(states.shape[0] - 1)
    while k > np.uint64(0):
        k -= one
        table, symbol = np.uint64(log.tables[k]), np.uint64(log.symbols[k])
        lane = np.uint64(log.states[k]) & mask
        freq, start = np.uint64(freqs[table, symbol]), np.uint64(starts[table, symbol])
        state = np.uint64(states[lane])
        if state >= freq << np.uint64(32 - SLOT_BITS):
            at -= one
            words[at] = np.uint16(state & np.uint64(0xFFFF))
            state >>= np.uint64(16)
        quotient = state // freq
        states[lane] = np.uint32(
            (quotient << np.uint64(SLOT_BITS)) + state - quotient * freq + start
        )
    return words.shape[0] - np.int64(at)


@kernel
def count_log(log, n, counts):
    """Count the symbols that have been logged; `counts` as `Frequencies.freqs`."""
    for k in range(n):
        counts[log.tables[k], log.symbols[k]] += 1
    counts[NO_PAIR], counts[NO_SINGLE] = 0, 0
