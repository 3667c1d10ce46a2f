"""Static interleaved rANS (docs/format-rapid.md, R.8).

J. Duda, Asymmetric numeral systems, 2013; interleaved as in F. Giesen, Interleaved entropy coders,
2014: symbol i uses state i mod 8, so that a processor works on eight of them at a time. States have
32 bits and are refilled by words of 16, all of one stream. The frequencies of each context are
fixed and sum to 2**SLOT_BITS.

Any words decode to some symbols: slots are masked, and the caller gives as many words past the end
as one call may read. Whether they were the right ones is seen at the end: all states are back at
`STATE_START`, and the words are used up.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import inlined_kernel, kernel

SLOT_BITS = 11
N_SLOTS = 1 << SLOT_BITS
N_STATES = 8
WORD_BITS = 16
STATE_START = 1 << WORD_BITS

_SLOT_MASK, _SLOTS = np.uint64(N_SLOTS - 1), np.uint64(SLOT_BITS)
_WORD, _REFILL = np.uint64(WORD_BITS), np.uint64(STATE_START)
# Of a packed frequency: `packed_freqs`.
_FREQ_BITS, _FREQ_MASK = np.uint64(16), np.uint64(0xFFFF)
# Quotients of a state and a frequency f by a product: the inverse is at most f / 2**43 of one too
# large, and a state is below f * 2**21, so that neither the quotient nor 64 bits are exceeded.
_INVERSE_BITS = np.uint64(43)
_INVERSES = np.array(
    [-(-(1 << 43) // max(freq, 1)) for freq in range(N_SLOTS + 1)], dtype=np.uint64
)
SYMBOL_BITS = 6
_SYMBOLS = np.uint64(SYMBOL_BITS)
# Of what `slots_of` returns: a frequency is at most N_SLOTS.
_PLACE_SHIFT = SYMBOL_BITS + SLOT_BITS + 1
_PLACE, _SLOT_FREQ_MASK = np.uint64(_PLACE_SHIFT), np.uint64(2 * N_SLOTS - 1)


def packed_freqs(freqs: NDArray[np.int64]) -> NDArray[np.uint32]:
    """Return of each context and symbol the sum of those before and its own.

    Parameters
    ----------
    freqs : ndarray of int64, shape (n_contexts, n_symbols)
        Each row sums to N_SLOTS; at most 64 symbols.

    Returns
    -------
    packed : ndarray of uint32, shape (64 * n_contexts,)
        ``before << 16 | freq``, at ``context << SYMBOL_BITS | symbol``.
    """
    packed = np.zeros((freqs.shape[0], 1 << SYMBOL_BITS), dtype=np.uint32)
    before = np.cumsum(freqs, 1) - freqs
    packed[:, : freqs.shape[1]] = before << int(_FREQ_BITS) | freqs
    return packed.ravel()


def slots_of(freqs: NDArray[np.int64]) -> NDArray[np.uint32]:
    """Return of each slot of all contexts all that a decoder asks; `freqs` as in `packed_freqs`.

    Returns
    -------
    slots : ndarray of uint32, shape (N_SLOTS * n_contexts,)
        ``place << 18 | freq << 6 | symbol``, at ``context << SLOT_BITS | slot``: the symbol, its
        frequency, and which one of its slots it is.
    """
    before = np.cumsum(freqs, 1) - freqs
    symbols = np.arange(freqs.shape[1], dtype=np.uint32)
    own = (freqs << SYMBOL_BITS | symbols) - (before << _PLACE_SHIFT)
    slots = np.repeat(own.astype(np.uint32).ravel(), freqs.ravel())
    places = np.arange(N_SLOTS, dtype=np.uint32) << np.uint32(_PLACE_SHIFT)
    return (slots.reshape(-1, N_SLOTS) + places).ravel()


@inlined_kernel
def _decoded(m, place, state, slots, contexts, symbols, words, at):
    """Decode the symbol at `place`, whose state is `state`; return the next state and word."""
    context = np.uint64(m[contexts + place])
    own = np.uint64(slots[(context << _SLOTS) | (state & _SLOT_MASK)])
    m[symbols + place] = np.int64(own)  # of which callers take the symbol, many at a time
    state = ((own >> _SYMBOLS) & _SLOT_FREQ_MASK) * (state >> _SLOTS) + (own >> _PLACE)
    is_low = state < _REFILL
    filled = (state << _WORD) | np.uint64(words[at])
    return (filled if is_low else state), at + np.uint64(is_low)


@inlined_kernel
def decode_row(m, contexts, symbols, n, slots, words, word_pos, states, count):
    """Decode `n` symbols, all with states that take turns; return the word after the last.

    What `slots_of` says of each is noted: its lowest SYMBOL_BITS are the symbol.

    Parameters
    ----------
    m : ndarray of int
        Holds the contexts, from place `contexts` on, and takes what is noted, from `symbols` on.
    slots : ndarray of uint32
        `slots_of`.
    words : ndarray of uint16
        Has at least `n` words from `word_pos` on.
    states : ndarray of uint64, shape (N_STATES,)
        The states, in place.
    count : int
        How many symbols have been decoded before, of which symbol i used state i mod N_STATES.
    """
    at, place = np.uint64(word_pos), np.uint64(0)
    x0, x1 = states[count & 7], states[(count + 1) & 7]
    x2, x3 = states[(count + 2) & 7], states[(count + 3) & 7]
    x4, x5 = states[(count + 4) & 7], states[(count + 5) & 7]
    x6, x7 = states[(count + 6) & 7], states[(count + 7) & 7]
    for k in range(0, n - 7, 8):
        place = np.uint64(k)
        x0, at = _decoded(m, place, x0, slots, contexts, symbols, words, at)
        place = np.uint64(k + 1)
        x1, at = _decoded(m, place, x1, slots, contexts, symbols, words, at)
        place = np.uint64(k + 2)
        x2, at = _decoded(m, place, x2, slots, contexts, symbols, words, at)
        place = np.uint64(k + 3)
        x3, at = _decoded(m, place, x3, slots, contexts, symbols, words, at)
        place = np.uint64(k + 4)
        x4, at = _decoded(m, place, x4, slots, contexts, symbols, words, at)
        place = np.uint64(k + 5)
        x5, at = _decoded(m, place, x5, slots, contexts, symbols, words, at)
        place = np.uint64(k + 6)
        x6, at = _decoded(m, place, x6, slots, contexts, symbols, words, at)
        place = np.uint64(k + 7)
        x7, at = _decoded(m, place, x7, slots, contexts, symbols, words, at)
    states[count & 7], states[(count + 1) & 7] = x0, x1
    states[(count + 2) & 7], states[(count + 3) & 7] = x2, x3
    states[(count + 4) & 7], states[(count + 5) & 7] = x4, x5
    states[(count + 6) & 7], states[(count + 7) & 7] = x6, x7
    for k in range(n - (n & 7), n):
        which = (count + k) & 7
        at = decode_symbol(m, contexts, symbols, k, slots, words, at, states, which)
    return np.int64(at)


@inlined_kernel
def decode_symbol(m, contexts, symbols, k, slots, words, at, states, which):
    """Decode symbol `k` of a row with state `which`, as `decode_row` does.

    Return the place of the next word.
    """
    states[which], at = _decoded(
        m, np.uint64(k), states[which], slots, contexts, symbols, words, np.uint64(at)
    )
    return at


@kernel
def encode_symbols(contexts, symbols, n, freqs, n_states, words, states):
    """Encode symbols that are logged in order; return the number of words.

    Parameters
    ----------
    contexts, symbols : ndarray of uint8
        The first `n` are coded, the last one first.
    freqs : ndarray of uint32
        `packed_freqs`.
    n_states : int
        1 or N_STATES.
    words : ndarray of uint16
        Room for `n`; the words fill its end, in the order in which they are decoded.
    states : ndarray of uint64, shape (N_STATES,)
        Takes what the decoder starts from.
    """
    at = words.shape[0]
    for k in range(N_STATES):
        states[k] = _REFILL
    for i in range(n - 1, -1, -1):
        packed = np.uint64(freqs[(np.uint64(contexts[i]) << _SYMBOLS) | np.uint64(symbols[i])])
        freq, before = packed & _FREQ_MASK, packed >> _FREQ_BITS
        which = np.uint64(i & (n_states - 1))
        state = states[which]
        # Without a branch, which would often be foretold wrongly: what is written stands or is
        # written over. There is room, as no symbol takes more than a word.
        is_high = state >= freq << np.uint64(32 - SLOT_BITS)
        words[at - 1] = state & np.uint64(0xFFFF)
        at -= np.int64(is_high)
        shifted = state >> _WORD
        state = shifted if is_high else state
        quotient = (state * _INVERSES[freq]) >> _INVERSE_BITS
        states[which] = (quotient << _SLOTS) + (state - quotient * freq) + before
    return words.shape[0] - at


@kernel
def count_symbols(contexts, symbols, n, counts):
    """Count logged symbols by context, as `packed_freqs` has them.

    Every second one in the other row of `counts`: most symbols are as the one before, whose count
    would not have been stored yet.
    """
    for i in range(np.uint64(n)):
        which = (np.uint64(contexts[i]) << _SYMBOLS) | np.uint64(symbols[i])
        counts[i & np.uint64(1), which] += 1
