"""Static interleaved rANS: symbols come back, at the cost of the entropy; any bytes decode."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.coding.rans import (
    N_SLOTS,
    N_STATES,
    STATE_START,
    decode_row,
    decode_symbol,
    encode_symbols,
    packed_freqs,
    slots_of,
)

N_CONTEXTS, N_SYMBOLS = 3, 9


def some_freqs(seed=1):
    """Return frequencies of three contexts: skewed, nearly certain, with symbols of none."""
    rng = np.random.default_rng(seed)
    freqs = np.zeros((N_CONTEXTS, N_SYMBOLS), dtype=np.int64)
    for context, power in enumerate((1, 9, 3)):
        weights = rng.random(N_SYMBOLS) ** power + 1e-3
        freqs[context] = np.maximum(1, weights / weights.sum() * (N_SLOTS - N_SYMBOLS))
    freqs[2, 3:6] = 0
    freqs[:, 0] += N_SLOTS - freqs.sum(1)
    return freqs


def draw(freqs, n, seed=2):
    rng = np.random.default_rng(seed)
    contexts = rng.integers(0, N_CONTEXTS, n).astype(np.uint8)
    symbols = [rng.choice(N_SYMBOLS, p=freqs[c] / N_SLOTS) for c in contexts]
    return contexts, np.array(symbols, dtype=np.uint8)


def encode(contexts, symbols, freqs, n_states=N_STATES):
    words, states = np.zeros(len(symbols), np.uint16), np.zeros(N_STATES, np.uint64)
    n_words = encode_symbols(
        contexts, symbols, len(symbols), packed_freqs(freqs), n_states, words, states
    )
    return words[len(words) - n_words :], states


def decode(contexts, n, freqs, words, states, rows):
    """Decode in rows of the given lengths; return symbols, words used and the last states."""
    slots, states = slots_of(freqs), states.copy()
    padded = np.concatenate([words, np.zeros(max(rows) + 1, dtype=np.uint16)])
    m = np.zeros(2 * max(rows), dtype=np.int32)
    found, count, word_pos = [], 0, 0
    for length in rows:
        m[:length] = contexts[count : count + length]
        start = min(word_pos, len(words))
        end = decode_row(
            m,
            np.uint64(0),
            np.uint64(max(rows)),
            length,
            slots,
            padded,
            start,
            states,
            count,
        )
        word_pos += int(end) - start
        found.append(m[max(rows) : max(rows) + length] & 63)
        count += length
    assert count == n
    return np.concatenate(found), word_pos, states


@pytest.mark.parametrize("rows", [[200], [8, 16, 176], [1, 2, 3, 5, 7, 11, 171], [64, 0, 136]])
def test_symbols_come_back_from_rows_of_any_length(rows):
    freqs = some_freqs()
    contexts, symbols = draw(freqs, 200)
    words, states = encode(contexts, symbols, freqs)
    found, n_words, last = decode(contexts, 200, freqs, words, states, rows)
    np.testing.assert_array_equal(found, symbols)
    assert n_words == len(words)
    np.testing.assert_array_equal(last, np.full(N_STATES, STATE_START))


def test_one_state_does_as_well():
    freqs = some_freqs()
    contexts, symbols = draw(freqs, 100)
    words, states = encode(contexts, symbols, freqs, n_states=1)
    slots, m = slots_of(freqs), np.zeros(200, dtype=np.int64)
    m[:100] = contexts
    at, padded = 0, np.concatenate([words, np.zeros(1, dtype=np.uint16)])
    for k in range(100):
        at = decode_symbol(m, np.uint64(0), np.uint64(100), k, slots, padded, at, states, 0)
    np.testing.assert_array_equal(m[100:] & 63, symbols)
    assert int(at) == len(words)
    assert states[0] == STATE_START


def test_no_symbols_are_no_words():
    words, states = encode(np.zeros(0, np.uint8), np.zeros(0, np.uint8), some_freqs())
    assert len(words) == 0
    np.testing.assert_array_equal(states, np.full(N_STATES, STATE_START))


def test_the_size_is_the_entropy():
    freqs = some_freqs()
    contexts, symbols = draw(freqs, 4000)
    words, _ = encode(contexts, symbols, freqs)
    ideal = -np.log2(freqs[contexts, symbols] / N_SLOTS).sum()
    # The states hold some of it: 16 to 32 bits each, where 16 were there before.
    assert ideal - 16 * N_STATES <= 16 * len(words) <= 1.001 * ideal + 16


def test_the_example_of_the_format():
    # By hand: one state, frequencies 1024, 512, 512 of symbols 0, 1, 2; the symbols 2, 0, 1, from
    # the last: 65536 -> 2048 * (65536 // 512) + 1024 + 0 = 263168; 2048 * (263168 // 1024)
    # + 263168 % 1024 = 526336; 2048 * (526336 // 512) + 1536 + 0 = 2106880.
    freqs = np.zeros((1, 3), dtype=np.int64)
    freqs[0] = 1024, 512, 512
    words, states = encode(np.zeros(3, np.uint8), np.array([2, 0, 1], np.uint8), freqs, 1)
    assert len(words) == 0
    assert states[0] == 2106880


@given(
    st.binary(max_size=60),
    st.lists(st.integers(0, 2**32 - 1), min_size=8, max_size=8),
    st.lists(st.integers(0, 40), min_size=1, max_size=4),
)
def test_any_words_and_states_decode_to_symbols(data, numbers, rows):
    words = np.frombuffer(data[: len(data) // 2 * 2], dtype=np.uint16)
    contexts = np.arange(sum(rows)) % N_CONTEXTS
    found, n_words, states = decode(
        contexts, sum(rows), some_freqs(), words, np.array(numbers, np.uint64), rows
    )
    assert ((found >= 0) & (found < N_SYMBOLS)).all()
    assert 0 <= n_words <= sum(rows)
    assert (states < 1 << 32).all()
