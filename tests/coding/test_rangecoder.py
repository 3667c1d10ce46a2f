from math import exp, log

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrainwave.coding.jit import kernel
from terrainwave.coding.rangecoder import (
    LOGITS,
    MAGNITUDE_MODELS,
    MODEL_START,
    N_UNARY,
    PROBABILITIES,
    code_bit,
    code_magnitude,
    code_mixed_step,
    code_raw,
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
    new_mixers,
    new_models,
    put_back,
    take_out,
)
from terrainwave.coding.status import Status, raise_for_status
from terrainwave.errors import CorruptStreamError, TruncatedStreamError

MAX_MAGNITUDE = N_UNARY + (1 << 32) - 2


@kernel
def code_bits(bits, contexts, coder, coded):
    for i in range(bits.shape[0]):
        coded[i] = code_bit(coder, contexts[i], np.int64(bits[i]))


def encoded(bits, contexts, n_models):
    out = np.zeros(2 * len(bits) + 16, dtype=np.uint8)
    coder = new_encoder(out, new_models(n_models))
    code_bits(bits, contexts, coder, np.zeros_like(bits))
    n_bytes = finish_encoder(coder.state, out)
    assert n_bytes <= out.shape[0]
    return out[:n_bytes].copy()


def decoded(data, contexts, n_models):
    bits = np.zeros(len(contexts), dtype=np.uint8)
    coder = new_decoder(data, new_models(n_models))
    code_bits(bits, contexts, coder, bits)
    raise_for_status(*finish_decoder(coder.state, coder.stream))
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
    # docs/FORMAT.md §6.4
    bits = np.array([1, 0, 0, 1, 0] * 8, dtype=np.uint8)
    contexts = np.zeros(40, dtype=np.int64)
    assert encoded(bits[:5], contexts, 1).tobytes() == bytes.fromhex("78")
    assert encoded(bits, contexts, 1).tobytes() == bytes.fromhex("77d8aa57dadc")


def test_size_is_within_one_percent_of_the_adaptive_code_length():
    bits, contexts = skewed_bits(1, 8000)
    assert len(encoded(bits, contexts, 8)) <= 1.01 * ideal_bytes(bits, contexts, 8) + 1


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
    coder = new_encoder(out, new_models(MAGNITUDE_MODELS))
    for value in values:
        assert code_magnitude(coder, 0, N_UNARY, 0, value) == value
        assert code_magnitude(coder, 0, N_UNARY, 3, value) == value
        assert code_raw(coder, 33, value) == value
    data = out[: finish_encoder(coder.state, out)].tobytes()
    coder = new_decoder(data, new_models(MAGNITUDE_MODELS))
    for value in values:
        assert code_magnitude(coder, 0, N_UNARY, 0, 0) == value
        assert code_magnitude(coder, 0, N_UNARY, 3, 0) == value
        assert code_raw(coder, 33, 0) == value
    assert finish_decoder(coder.state, coder.stream) == (Status.OK, len(data))


@settings(deadline=None)  # the first example compiles
@given(st.binary(max_size=40))
def test_any_bytes_give_a_bounded_magnitude(data):
    coder = new_decoder(data, new_models(MAGNITUDE_MODELS))
    for _ in range(20):
        assert 0 <= code_magnitude(coder, 0, N_UNARY, 0, 0) <= MAX_MAGNITUDE


def test_a_full_output_is_counted_but_not_overrun():
    bits, contexts = skewed_bits(5, 400)
    whole = encoded(bits, contexts, 8)
    out = np.zeros(5, dtype=np.uint8)
    coder = new_encoder(out, new_models(8))
    code_bits(bits, contexts, coder, np.zeros_like(bits))
    assert finish_encoder(coder.state, out) == len(whole)
    assert out.tolist() == whole[:5].tolist()


@kernel
def code_mixed_bits(bits, contexts, renewed_every, coder, mixers, coded):
    state, stream, models, is_encoder = coder
    at = take_out(state)
    for i in range(bits.shape[0]):
        first, second = contexts[i]
        if renewed_every and i % renewed_every == 0:
            models[second] = MODEL_START
        weights = mixers[0, 0], mixers[1, 0]
        coded[i], at, weights = code_mixed_step(
            at, state, stream, models, is_encoder, first, second, weights, np.int64(bits[i])
        )
        mixers[0, 0], mixers[1, 0] = weights
    put_back(at, state)


def encoded_mixed(bits, contexts, n_models, renewed_every=0):
    """Return the stream and the weights at its end."""
    out = np.zeros(2 * len(bits) + 16, dtype=np.uint8)
    coder, mixers = new_encoder(out, new_models(n_models)), new_mixers(1)
    code_mixed_bits(bits, contexts, renewed_every, coder, mixers, np.zeros_like(bits))
    return out[: finish_encoder(coder.state, out)].copy(), mixers


def decoded_mixed(data, contexts, n_models, renewed_every=0):
    """Return the bits of a stream and the weights at its end."""
    bits = np.zeros(len(contexts), dtype=np.uint8)
    coder, mixers = new_decoder(data, new_models(n_models)), new_mixers(1)
    code_mixed_bits(bits, contexts, renewed_every, coder, mixers, bits)
    raise_for_status(*finish_decoder(coder.state, coder.stream))
    return bits, mixers


def test_the_tables_are_the_nearest_integers_to_the_formulas():
    # docs/format-predictive.md P.1; far enough from halves for any machine's logarithm.
    logits = np.array([256 * log((2 * k + 1) / (2047 - 2 * k)) for k in range(1024)])
    probabilities = np.array([65536 / (1 + exp((703 - 2 * k) / 64)) for k in range(704)])
    for table, values in ((LOGITS, logits), (PROBABILITIES, probabilities)):
        np.testing.assert_array_equal(table, np.rint(values))
        assert np.abs(values - np.floor(values) - 0.5).min() > 1e-7
    assert [int(LOGITS[k]) for k in (0, 511, 512, 1023)] == [-1952, -1, 1, 1952]
    assert [int(PROBABILITIES[k]) for k in (0, 351, 352, 703)] == [1, 32512, 33024, 65535]


def test_the_example_of_mixed_bits():
    # docs/format-predictive.md P.1
    bits = np.array([1, 0, 0, 1, 0] * 8, dtype=np.uint8)
    contexts = np.tile(np.array([0, 1]), (40, 1))
    data, mixers = encoded_mixed(bits, contexts, 2, renewed_every=5)
    assert data.tobytes() == bytes.fromhex("7900f6a8d84fe7")
    assert mixers.ravel().tolist() == [32270, 29784]
    back, weights = decoded_mixed(data, contexts, 2, renewed_every=5)
    assert back.tolist() == bits.tolist()
    assert weights.tolist() == mixers.tolist()


@settings(deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.integers(0, 2), st.integers(3, 5)), max_size=200))
def test_mixed_bits_come_back(decisions):
    bits = np.array([bit for bit, _, _ in decisions], dtype=np.uint8)
    contexts = np.array([at for _, *at in decisions], dtype=np.int64).reshape(-1, 2)
    data, mixers = encoded_mixed(bits, contexts, 6)
    back, weights = decoded_mixed(data, contexts, 6)
    assert back.tolist() == bits.tolist()
    assert weights.tolist() == mixers.tolist()


def test_a_mixer_learns_which_model_to_trust():
    # The second model of each bit is one of many that have seen nothing: the size must be near that
    # of the first alone, and the weights must say so.
    bits, contexts = skewed_bits(3, 4000)
    noise = 8 + np.random.default_rng(3).integers(0, 900, len(bits))
    data, mixers = encoded_mixed(bits, np.stack([contexts, noise], 1), 908)
    assert len(data) < 1.03 * len(encoded(bits, contexts, 8))
    assert mixers[0, 0] > 4 * abs(mixers[1, 0])


@settings(deadline=None)
@given(st.binary(max_size=60))
def test_any_bytes_give_mixed_bits_or_our_own_error(data):
    contexts = np.arange(400).reshape(200, 2) % 5
    try:
        bits, _ = decoded_mixed(np.frombuffer(data, dtype=np.uint8).copy(), contexts, 5)
    except (CorruptStreamError, TruncatedStreamError):
        return
    assert set(bits.tolist()) <= {0, 1}
