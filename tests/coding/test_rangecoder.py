import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrainwave._jit import kernel
from terrainwave._status import Status, raise_for_status
from terrainwave.coding.rangecoder import (
    MAGNITUDE_MODELS,
    MAX_MAGNITUDE,
    STATE_SIZE,
    decode_bit,
    decode_magnitude,
    decode_raw,
    encode_bit,
    encode_magnitude,
    encode_raw,
    finish_decoder,
    finish_encoder,
    new_models,
    start_decoder,
    start_encoder,
)
from terrainwave.errors import CorruptStreamError, TruncatedStreamError


@kernel
def encode_bits(bits, contexts, models, state, out):
    for i in range(bits.shape[0]):
        encode_bit(state, out, models, contexts[i], bits[i])


@kernel
def decode_bits(data, contexts, models, state, bits):
    for i in range(bits.shape[0]):
        bits[i] = decode_bit(state, data, models, contexts[i])


def encoded(bits, contexts, n_models):
    out = np.zeros(2 * len(bits) + 16, dtype=np.uint8)
    state = start_encoder()
    encode_bits(bits, contexts, new_models(n_models), state, out)
    n_bytes = finish_encoder(state, out)
    assert n_bytes <= out.shape[0]
    return out[:n_bytes].copy()


def decoded(data, contexts, n_models):
    bits = np.zeros(len(contexts), dtype=np.uint8)
    state = np.zeros(STATE_SIZE, dtype=np.int64)
    start_decoder(state, data)
    decode_bits(data, contexts, new_models(n_models), state, bits)
    raise_for_status(*finish_decoder(state, data))
    return bits


def ideal_bytes(bits, contexts, n_models):
    """Return the code length of the adaptive model of the specification, in float64."""
    prob, count, bits_used = np.full(n_models, 0.5), np.zeros(n_models, int), 0.0
    for bit, context in zip(bits, contexts, strict=True):
        bits_used -= np.log2(prob[context] if bit else 1 - prob[context])
        prob[context] += (bit - prob[context]) / min(count[context] + 1.5, 128)
        prob[context] = min(max(prob[context], 1e-5), 1 - 1e-5)
        count[context] += 1
    return bits_used / 8


def skewed_bits(seed, n, n_models=8):
    rng = np.random.default_rng(seed)
    probs = rng.beta(0.4, 0.4, n_models).clip(0.005, 0.995)
    contexts = rng.integers(0, n_models, n)
    return (rng.random(n) < probs[contexts]).astype(np.uint8), contexts


@settings(deadline=None)  # the first example compiles
@given(st.lists(st.tuples(st.booleans(), st.integers(0, 3)), max_size=200))
def test_bits_come_back(pairs):
    bits = np.array([b for b, _ in pairs], dtype=np.uint8)
    contexts = np.array([c for _, c in pairs], dtype=np.int64)
    assert decoded(encoded(bits, contexts, 4), contexts, 4).tolist() == bits.tolist()


def test_the_example_of_the_format():
    # docs/format-cdf97.md R.4
    bits = np.array([1, 0, 0, 1, 0] * 8, dtype=np.uint8)
    contexts = np.zeros(40, dtype=np.int64)
    assert encoded(bits[:5], contexts, 1).tobytes() == bytes.fromhex("78")
    assert encoded(bits, contexts, 1).tobytes() == bytes.fromhex("77d8aa57dadc")


def test_four_bytes_of_255_are_no_trouble():
    # Code equals range from the start: no encoder makes that.
    contexts = np.arange(400) % 3
    with pytest.raises(CorruptStreamError):
        decoded(np.full(4000, 255, dtype=np.uint8), contexts, 3)


def test_size_is_within_one_percent_of_the_adaptive_code_length():
    bits, contexts = skewed_bits(1, 8000)
    assert len(encoded(bits, contexts, 8)) <= 1.01 * ideal_bytes(bits, contexts, 8) + 1


@pytest.mark.large
def test_rate_is_near_the_entropy():
    # A model that never forgets less than 1/128 loses about 1/(4 ln 2 * 128) bit a decision.
    rng = np.random.default_rng(2)
    for p in (0.5, 0.2, 0.03):
        bits = (rng.random(200_000) < p).astype(np.uint8)
        p = bits.mean()
        entropy = -p * np.log2(p) - (1 - p) * np.log2(1 - p)
        size = len(encoded(bits, np.zeros(len(bits), dtype=np.int64), 1))
        assert size <= (entropy + 0.0035) * len(bits) / 8


@pytest.mark.large
def test_certain_bits_cost_almost_nothing():
    bits = np.zeros(1_000_000, dtype=np.uint8)
    assert len(encoded(bits, bits.astype(np.int64), 1)) <= 32


def test_no_symbols_take_one_byte():
    nothing = np.zeros(0, dtype=np.uint8)
    assert len(encoded(nothing, nothing.astype(np.int64), 1)) == 1


def test_a_carry_runs_through_held_back_bytes():
    # Improbable ones after many zeros push `low` towards all-255 bytes; every seed must survive.
    for seed in range(200):
        rng = np.random.default_rng(seed)
        bits = (rng.random(300) < 0.5).astype(np.uint8)
        contexts = np.zeros(300, dtype=np.int64)
        assert (decoded(encoded(bits, contexts, 1), contexts, 1) == bits).all()


def test_every_prefix_is_truncated():
    bits, contexts = skewed_bits(3, 400)
    whole = encoded(bits, contexts, 8)
    for length in range(len(whole)):
        with pytest.raises(CorruptStreamError):
            decoded(whole[:length], contexts, 8)
    with pytest.raises(TruncatedStreamError):
        decoded(whole[:-1], contexts, 8)


def test_extra_byte_is_rejected():
    bits, contexts = skewed_bits(4, 400)
    with pytest.raises(CorruptStreamError, match="left over"):
        decoded(np.append(encoded(bits, contexts, 8), np.uint8(0)), contexts, 8)


@settings(deadline=None)  # the first example compiles
@given(st.binary(max_size=60))
def test_any_bytes_give_bits_or_our_own_error(data):
    contexts = np.arange(200) % 5
    try:
        bits = decoded(np.frombuffer(data, dtype=np.uint8), contexts, 5)
    except CorruptStreamError:
        return
    assert bits.max() <= 1


@settings(deadline=None)  # the first example compiles
@given(st.lists(st.integers(0, MAX_MAGNITUDE) | st.integers(0, 40), max_size=60))
def test_magnitudes_and_raw_bits_come_back(values):
    out = np.zeros(4096, dtype=np.uint8)
    models, state = new_models(MAGNITUDE_MODELS), start_encoder()
    for value in values:
        encode_magnitude(state, out, models, 0, value)
        encode_raw(state, out, value, 33)
    data = out[: finish_encoder(state, out)]
    models = new_models(MAGNITUDE_MODELS)
    start_decoder(state, data)
    for value in values:
        assert decode_magnitude(state, data, models, 0) == value
        assert decode_raw(state, data, 33) == value
    assert finish_decoder(state, data) == (Status.OK, len(data))


@settings(deadline=None)  # the first example compiles
@given(st.binary(max_size=40))
def test_any_bytes_give_a_bounded_magnitude(data):
    state = np.zeros(STATE_SIZE, dtype=np.int64)
    data = np.frombuffer(data, dtype=np.uint8)
    start_decoder(state, data)
    models = new_models(MAGNITUDE_MODELS)
    for _ in range(20):
        assert 0 <= decode_magnitude(state, data, models, 0) <= MAX_MAGNITUDE


def test_a_full_output_is_counted_but_not_overrun():
    bits, contexts = skewed_bits(5, 400)
    whole = encoded(bits, contexts, 8)
    out = np.zeros(5, dtype=np.uint8)
    state = start_encoder()
    encode_bits(bits, contexts, new_models(8), state, out)
    assert finish_encoder(state, out) == len(whole)
    assert out.tolist() == whole[:5].tolist()
