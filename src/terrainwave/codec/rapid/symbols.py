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


# Details that symbols stand for where more follows: of a pair's first sample, and of a single one.
_ESCAPE_FOUND, _GOES_ON = PAIR_LIMIT + 1, SINGLE_LIMIT + 1
_i32, _u32, _u64 = np.int32, np.uint32, np.uint64
_ONE = np.uint64(1)


class Log(NamedTuple):
    """Symbols in coding order, which an encoder notes before it knows the first state."""

    tables: NDArray[np.uint8]
    symbols: NDArray[np.uint8]
    states: NDArray[np.uint8]  # of MOST_STATES: of fewer, the remainder


class Streams(NamedTuple):
    """States, words and raw bits of a band of strips; the lowest bit is first."""

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
    freqs[NO_SINGLE, SINGLE_LIMIT] = N_SLOTS
    freqs[freqs.sum(1) == 0, NOTHING] = N_SLOTS
    starts = np.cumsum(freqs, 1) - freqs
    own = np.arange(N_SYMBOLS) + ((freqs - 1) << 8) - (starts << 20)
    slots = np.repeat((own & 0xFFFFFFFF).astype(np.uint32).ravel(), freqs.ravel())
    slots += np.tile(np.arange(N_SLOTS, dtype=np.uint32) << np.uint32(20), N_TABLES)
    return Frequencies(cut, slots, freqs.astype(np.uint32), starts.astype(np.uint32))


@kernel_part
def _list_entries(pairs, singles, cut, entries):
    """Write the entries of a list; return how many there are."""
    n_pairs, n, highest = _u64(pairs.shape[0]), _u64(0), np.int8(HIDDEN)
    for k in range(n_pairs):
        highest = max(highest, pairs[k])
    if highest < cut:
        for k in range(n_pairs):
            entries[k] = np.uint8(np.int64(pairs[k]) & NO_PAIR)
        return np.int64(n_pairs)
    for k in range(n_pairs):
        # Nothing branches by the class, which no processor foresees.
        own, j = np.int64(pairs[k]), k + k
        is_two = _u64(own >= cut)
        first, second = SINGLES | np.int64(singles[j]), SINGLES | np.int64(singles[j + _ONE])
        entries[n] = np.uint8((first & NO_SINGLE) if is_two else own & NO_PAIR)
        entries[n + _ONE] = np.uint8(second & NO_SINGLE)
        n += _ONE + is_two
    return np.int64(n)


@kernel_part
def raw_bits(single):
    """Return how many raw bits a sample has that is coded by itself."""
    return max(np.int64(single) - _RAW_CLASS, 0) >> 1


@kernel_part
def _take(raw, bit, n):
    """Return the n raw bits from a place on, at most 32; past the end any."""
    at = min(_u64(bit >> 5), _u64(raw.shape[0] - 2))
    both = _u64(raw[at]) | _u64(raw[at + _ONE]) << _u64(32)
    return np.int64((both >> _u64(bit & 31)) & ((_ONE << _u64(n)) - _ONE))


@kernel_part
def _follow(state, found):
    """Return what a state becomes by its entry of `Frequencies.slots`, before it takes a word.

    At most N_SLOTS * (2**20 - 1) + N_SLOTS - 1, below 2**32.
    """
    whole = state >> _u32(SLOT_BITS)
    return _u32(((found >> _u32(8)) & _u32(N_SLOTS - 1)) * whole + whole + (found >> _u32(20)))


@kernel_part
def _read_alone(entries, n, frequencies, state, words, at, symbols):
    """Read symbols of a band of one state; return the state and the number of the next word.

    Nearly all details are 0. Trying that first is faster than a look-up, as each symbol waits for
    the one before.
    """
    slots, freqs = frequencies.slots, frequencies.freqs.reshape(-1)
    starts = frequencies.starts.reshape(-1)
    last = _u64(words.shape[0] - 1)
    for k in range(_u64(n)):
        entry, slot = _u64(entries[k]), state & _u32(N_SLOTS - 1)
        nothing = _u64(NOTHING if entry < SINGLES else SINGLE_LIMIT)
        at_nothing = entry * _u64(N_SYMBOLS) + nothing
        freq, place = freqs[at_nothing], np.int64(slot) - np.int64(starts[at_nothing])
        if 0 <= place < freq:
            state = _u32(freq * (state >> _u32(SLOT_BITS)) + _u32(place))
            symbols[k] = np.uint8(nothing)
        else:
            found = slots[entry << _u64(SLOT_BITS) | _u64(slot)]
            state = _follow(state, found)
            symbols[k] = np.uint8(found & _u32(255))
        if state < _u32(STATE_START):
            state = _u32((state << _u32(16)) | _u32(words[min(at, last)]))
            at += _ONE
    return state, at


@kernel
def read_entries(entries, n, frequencies, streams, symbols):
    """Read the symbols of a list. Past the last word, the last ones are read again."""
    entries, frequencies, symbols = borrowed((entries, frequencies, symbols))
    states, words, _, _, places = borrowed(streams)
    slots = frequencies.slots
    at, most = _u64(places[WORD]), _u64(words.shape[0] - MOST_STATES)
    mask, n, first = _u64(states.shape[0] - 1), _u64(n), _u64(0)
    if states.shape[0] == 1:
        states[0], at = _read_alone(entries, n, frequencies, states[0], words, at, symbols)
        first = n
    # Unsigned, so that no index needs to be checked for a sign; without a branch, which no
    # processor would foresee.
    while first < n:
        if at > most:
            places[IS_BAD] = 1
            at = most
        last = min(first + _u64(MOST_STATES), n)
        for k in range(first, last):
            state = states[k & mask]
            slot = _u64(entries[k]) << _u64(SLOT_BITS) | _u64(state & _u32(N_SLOTS - 1))
            found = slots[slot]
            symbols[k] = np.uint8(found & _u32(255))
            state = _follow(state, found)
            is_short, longer = state < _u32(STATE_START), (state << _u32(16)) | _u32(words[at])
            states[k & mask] = longer if is_short else state
            at += _u64(is_short)
        first = last
    places[WORD] = np.int64(at)


@kernel_part
def _beyond(raw, bit):
    """Return what a symbol says no more: a signed number beyond SINGLE_LIMIT, below 2**33.

    Then the place behind its bits.
    """
    length = _take(raw, bit, _LENGTH_BITS)
    rest = _take(raw, bit + _LENGTH_BITS, length + 1)
    beyond = (np.int64(1) << length) - 1 + (rest >> 1) + SINGLE_LIMIT + 1
    return -beyond if rest & 1 else beyond, bit + _LENGTH_BITS + length + 1


@kernel_part
def _spread(pairs, cut, symbols, seconds):
    """Put the symbols of pairs, or of their first samples, side by side; those of second ones, too.

    They move towards the start of `symbols`.
    """
    k = _u64(0)
    for pair in range(_u64(pairs.shape[0])):
        is_two = _u64(np.int64(pairs[pair]) >= cut)
        symbols[pair], seconds[pair] = symbols[k], symbols[k + is_two]
        k += _ONE + is_two


@kernel_part
def _place(pairs, cut, symbols, seconds, details):
    """Fill the details that symbols stand for; return how many pairs have none."""
    n_escaped = _i32(0)
    for pair in range(_u64(pairs.shape[0])):
        is_two, own = pairs[pair] >= cut, _i32(symbols[pair])
        # What is below 2**8, by _SIDE.
        first = _i32(_i32(own * _i32(4370)) >> 16)
        second = _i32(own - _i32(first * _i32(_SIDE)))
        n_escaped = _i32(n_escaped + _i32(own == PAIR_ESCAPE))
        first, second = _i32(first - PAIR_LIMIT), _i32(second - PAIR_LIMIT)
        other = _i32(_i32(seconds[pair]) - SINGLE_LIMIT)
        details[pair + pair] = _i32(own - SINGLE_LIMIT) if is_two else first
        details[pair + pair + _ONE] = other if is_two else second
    return n_escaped


@kernel_part
def _complete(pairs, singles, cut, streams, details, more, most):
    """Read the raw bits of samples coded by themselves, and what is beyond their symbols.

    A detail is below 2**33 << 13 before it is brought within ±most, which fits 32 bits.
    """
    raw, bit, n, n_beyond = streams.raw, streams.places[BIT], _u64(0), _u64(0)
    # Most lists have none.
    is_long = False
    for i in range(_u64(singles.shape[0])):
        is_long |= (singles[i] > _RAW_CLASS + 1) | (details[i] == _GOES_ON)
    for pair in range(_u64(pairs.shape[0] if is_long else 0)):
        is_two, i = pairs[pair] >= cut, pair + pair
        more[n] = _i32(i)
        n += _u64(is_two & ((singles[i] > _RAW_CLASS + 1) | (details[i] == _GOES_ON)))
        i += _ONE
        more[n] = _i32(i)
        n += _u64(is_two & ((singles[i] > _RAW_CLASS + 1) | (details[i] == _GOES_ON)))
    for k in range(n):
        i = _u64(more[k])
        n_bits, before = raw_bits(singles[i]), details[i]
        low = _take(raw, bit, n_bits)
        bit += n_bits
        detail = min(max(np.int64(before) << n_bits | low, -most), most)
        # Raw bits of those that go on wait in their place.
        details[i] = _i32(low if before == _GOES_ON else detail)
        more[n_beyond] = _i32(i)
        n_beyond += _u64(before == _GOES_ON)
    for k in range(n_beyond):
        i = _u64(more[k])
        beyond, bit = _beyond(raw, bit)
        detail = (beyond << raw_bits(singles[i])) | np.int64(details[i])
        details[i] = _i32(min(max(detail, -most), most))
    streams.places[BIT] = bit


@kernel
def read_strip(memory, pairs, singles, details, most, frequencies, streams):
    """Read the details of a list, two for each pair; none of many bits is beyond ±most.

    The list; a list of the samples of pairs that have no symbol; the raw bits of samples coded by
    themselves; what is beyond the symbols of these; the same of samples of pairs.
    """
    pairs, singles, details = borrowed((pairs, singles, details))
    entries, symbols, more = borrowed(memory)
    frequencies, streams = borrowed((frequencies, streams))
    cut, n_pairs = frequencies.cut, pairs.shape[0]
    n = _list_entries(pairs, singles, cut, entries)
    read_entries(entries, n, frequencies, streams, symbols)
    if n > n_pairs:
        _spread(pairs, cut, symbols, entries)
    n_escaped = _place(pairs, cut, symbols, entries, details)
    # Samples of pairs without a symbol are at the end of `more`, as others are put at its start.
    first = more.shape[0] - n_escaped
    if n_escaped:
        k = first
        for pair in range(n_pairs):
            if details[2 * pair] == _ESCAPE_FOUND and pairs[pair] < cut:
                more[k] = 2 * pair
                k += 1
        entries[: 2 * n_escaped] = ESCAPED
        read_entries(entries, 2 * n_escaped, frequencies, streams, symbols)
    if n > n_pairs:
        _complete(pairs, singles, cut, streams, details, more, most)
    for k in range(2 * n_escaped):
        detail = np.int64(symbols[k]) - SINGLE_LIMIT
        if detail == _GOES_ON:
            detail, streams.places[BIT] = _beyond(streams.raw, streams.places[BIT])
        details[more[first + (k >> 1)] + (k & 1)] = _i32(min(max(detail, -most), most))


@kernel_part
def _put(raw, places, value, n):
    bit = places[BIT]
    shifted = np.uint64(value) << np.uint64(bit & 31)
    raw[bit >> 5] |= np.uint32(shifted & np.uint64(0xFFFFFFFF))
    raw[(bit >> 5) + 1] |= np.uint32(shifted >> np.uint64(32))
    places[BIT] = bit + n


@kernel_part
def pair_symbol(first, second):
    """Return the symbol of two details, PAIR_ESCAPE if they have none."""
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
    n = np.uint64(_list_entries(pairs, singles, cut, tables))
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
                symbols[k] = SINGLE_LIMIT if singles[i] == HIDDEN else single_symbol(value)
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
