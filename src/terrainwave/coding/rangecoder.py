"""Adaptive binary range coder (FORMAT.md §6).

The range coder of LZMA (I. Pavlov; after G. N. N. Martin, 1979) with a 32-bit range, renormalised
by bytes with carry propagation in the encoder. Departures: the constant first byte is not written,
and of the last four bytes only one, and probabilities adapt at 1/(n + 3/2) down to 1/256 instead of
a fixed 1/32 (0.7 % over entropy instead of 2.5 %).

All quantities are non-negative and below 2**63 (range < 2**32, low < 2**57, products < 2**48), so
signed 64-bit arithmetic is exact and equal in compiled and plain Python.

A *mixed* bit has two models. Their probabilities are added as logits, with weights that adapt to
every bit: the logistic mixing of PAQ7 (M. Mahoney, 2005), here with two inputs and in integers.
Weights move by less than 2**11 a bit, products with them stay below 2**50.

A *model* is one uint32: the probability of a one in the upper 22 bits, the number of bits seen in
the lower 10. The coder uses the upper 16 bits of the probability.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import inlined_kernel, kernel, rare_kernel
from terrainwave.coding.status import Status

# Indices into the state array (int64) of an encoder or a decoder. The *point* is an encoder's LOW,
# the lower end of its range, or a decoder's CODE, the distance of the code from that end.
#
# Bytes leave an encoder _MOST_HELD at a time: POINT has HELD of them above its lowest 32 bits. The
# next byte is written at an encoder's OUT_POS, or read at a decoder's BYTE_POS.
RANGE, POINT, CACHE, PENDING, BYTE_POS, OUT_POS = 0, 1, 2, 3, 4, 5
LOW = CODE = POINT
HELD = BYTE_POS
STATE_SIZE = 6
_MOST_HELD = 3

_TOP = 1 << 24
_MASK32 = (1 << 32) - 1
_COUNT_BITS = 10
_PROB_BITS = 22
_COUNT_LIMIT = 254
# Weight of a new bit after `count` earlier ones, in 1/65536: 1/(count + 3/2), at least 1/255.5.
RATES = np.array([131072 // (2 * n + 3) for n in range(_COUNT_LIMIT + 1)], dtype=np.int64)

MODEL_START = np.uint32(1 << 31)  # probability 1/2, nothing seen

# Magnitudes: unary in adaptive bits, then Exp-Golomb whose prefix is adaptive as well.
N_UNARY = 14
N_PREFIX = 32
MAGNITUDE_MODELS = N_UNARY + N_PREFIX
MAX_MAGNITUDE = N_UNARY + (1 << 32) - 2

# Mixed bits: logits of 10-bit probabilities in 1/256, their mixtures in 1/32 from -11 to 11, the
# weights in 1/65536.
_LOGIT_BITS = 10
_LOGIT_UNIT = 256
_WEIGHT_BITS = 16
_HALF_WEIGHT = 1 << (_WEIGHT_BITS - 1)
_MIXTURE_UNIT = 32
_MIXTURE_SHIFT = _WEIGHT_BITS + 3
_MAX_MIXTURE = 11 * _MIXTURE_UNIT


def _logits() -> NDArray[np.int16]:
    """Return ln(p / (1 - p)) for the middle of each of 2**_LOGIT_BITS intervals of p."""
    doubled = np.arange(1, 2 << _LOGIT_BITS, 2)
    logits = np.log(doubled / ((2 << _LOGIT_BITS) - doubled))
    return np.rint(_LOGIT_UNIT * logits).astype(np.int16)


def _probabilities() -> NDArray[np.uint16]:
    """Return 1 / (1 + exp(-x)) in 1/65536 for the middle of each step of a mixture x."""
    doubled = np.arange(1 - 2 * _MAX_MIXTURE, 2 * _MAX_MIXTURE, 2)
    return np.rint((1 << 16) / (1 + np.exp(-doubled / (2 * _MIXTURE_UNIT)))).astype(np.uint16)


# Equal on every machine: no value lies so close to a half that rounding could differ (P.1).
LOGITS = _logits()
PROBABILITIES = _probabilities()


class Coder(NamedTuple):
    """Encoder or decoder: its state, the bytes written or read, the adaptive models.

    `is_encoder` is None in a decoder: numba then compiles each kernel for both cases and drops the
    unused branches.
    """

    state: NDArray[np.int64]
    stream: NDArray[np.uint8]
    models: NDArray[np.uint32]
    is_encoder: Literal[True] | None


def new_encoder(stream: NDArray[np.uint8], models: NDArray[np.uint32]) -> Coder:
    """Return an encoder into `stream`, from its start."""
    return Coder(start_encoder(), stream, models, True)


def new_decoder(data: bytes, models: NDArray[np.uint32]) -> Coder:
    """Return a decoder of `data`, from their start."""
    # A writable copy, because numba infers the types of encoder branches as well.
    stream = np.frombuffer(data, dtype=np.uint8).copy()
    state = np.zeros(STATE_SIZE, dtype=np.int64)
    start_decoder(state, stream)
    return Coder(state, stream, models, None)


def new_models(n_models: int) -> NDArray[np.uint32]:
    """Return `n_models` fresh models: probability 1/2, nothing seen."""
    return np.full(n_models, MODEL_START, dtype=np.uint32)


def new_mixers(n_mixers: int) -> NDArray[np.int64]:
    """Return the weights of `n_mixers` fresh mixers, one half each: shape (2, n_mixers)."""
    return np.full((2, n_mixers), _HALF_WEIGHT, dtype=np.int64)


def start_encoder() -> NDArray[np.int64]:
    """Return the state of an encoder that has written nothing."""
    state = np.zeros(STATE_SIZE, dtype=np.int64)
    reset_encoder(state)
    return state


def reset_encoder(state: NDArray[np.int64]) -> None:
    """Reset `state` to that of an encoder that has written nothing."""
    state[RANGE], state[LOW], state[CACHE], state[HELD] = _MASK32, 0, 0, 0
    # The first byte out is always 0 and not written: it is "byte -1", and pending.
    state[PENDING], state[OUT_POS] = 1, -1


@kernel
def n_bytes_begun(state):
    """Return how many bytes an encoder has output or holds back; its LOW follows them."""
    return state[OUT_POS] + state[PENDING] + state[HELD]


@kernel
def _move_out(point, held, state, out):
    """Move the `held` bytes above the lowest 32 bits of a point out; return the rest.

    Bytes that a carry may still change are held back: one in CACHE, then PENDING - 1 of 255. Bytes
    beyond the end of `out` are counted but not stored; `finish_encoder` reports them.
    """
    carry = point >> (32 + 8 * held)
    for k in range(held - 1, -1, -1):
        byte = (point >> (32 + 8 * k)) & 255
        if byte < 255 or carry:
            first, pos = state[CACHE], state[OUT_POS]
            # Nearly always one iteration. The counter lies in the state, so that the loop, which is
            # inlined everywhere, is not vectorised.
            while state[PENDING] > 0:
                if 0 <= pos < out.shape[0]:
                    out[np.uint64(pos)] = (first + carry) & 255
                pos += 1
                first = 255
                state[PENDING] -= 1
            state[OUT_POS], state[CACHE] = pos, byte
        state[PENDING] += 1
        carry = np.int64(0)
    return point & _MASK32


@inlined_kernel
def _parts_of(model):
    """Return the 22-bit probability and the count of a model."""
    model = np.int64(model)
    return model >> _COUNT_BITS, model & ((1 << _COUNT_BITS) - 1)


@inlined_kernel
def _adapted(prob, count, bit):
    """Return the model of a probability and a count after a bit."""
    rate = RATES[np.uint64(count)]
    if bit:
        prob += (((1 << _PROB_BITS) - prob) * rate) >> 16
    else:
        prob -= (prob * rate) >> 16
    return (prob << _COUNT_BITS) + count + (count < _COUNT_LIMIT)


@inlined_kernel
def _renewed(span, point, pos, state, stream, is_encoder):
    """Return `at` after renormalisation by bytes until the range is large enough."""
    while span < _TOP:
        span <<= 8
        pos += 1
        if is_encoder is None:
            byte = np.int64(stream[np.uint64(pos - 1)]) if pos <= stream.shape[0] else np.int64(0)
            point = ((point << 8) | byte) & _MASK32
        else:
            point <<= 8
            if pos == _MOST_HELD:
                point = _move_out(point, pos, state, stream)
                pos = np.int64(0)
    return span, point, pos


@rare_kernel
def finish_encoder(state, out):
    """Write the last byte; return the number of bytes of the stream.

    The stream fits `out` if and only if that number is at most ``out.shape[0]``.
    """
    # Range >= 2**24, so the next multiple of 2**24 is inside: its lower three bytes are zero and
    # not written, the decoder supplies them.
    low = ((state[LOW] + _TOP - 1) >> 24) << 24
    low = _move_out(low << 8, state[HELD] + 1, state, out)
    # Now low is 0, so one more byte releases everything held back.
    state[LOW] = _move_out(low << 8, 1, state, out)
    state[HELD] = 0
    return state[OUT_POS]


def start_decoder(state: NDArray[np.int64], data: NDArray[np.uint8]) -> None:
    """Set `state` to the start of `data`; bytes past their end count as zero."""
    code = int.from_bytes(data[:4].tobytes().ljust(4, b"\0"), "big")
    state[RANGE], state[CODE], state[CACHE] = _MASK32, code, 0
    state[PENDING], state[BYTE_POS] = 0, 4


def finish_decoder(state: NDArray[np.int64], data: NDArray[np.uint8]) -> tuple[Status, int]:
    """Return (status, position): OK if `data` ends exactly where the encoder ended it.

    TRUNCATED if more than the three unwritten zero bytes were read past the end, TRAILING if
    bytes were not needed.
    """
    needed, n_bytes = int(state[BYTE_POS]) - 3, len(data)
    if needed > n_bytes:
        return Status.TRUNCATED, n_bytes
    return (Status.TRAILING if needed < n_bytes else Status.OK), needed


@inlined_kernel
def _mixed(prob, other_prob, weight, other_weight):
    """Return the 16-bit probability of two mixed models, and both logits."""
    logit = np.int64(LOGITS[np.uint64(prob >> (_PROB_BITS - _LOGIT_BITS))])
    other_logit = np.int64(LOGITS[np.uint64(other_prob >> (_PROB_BITS - _LOGIT_BITS))])
    mixture = (weight * logit + other_weight * other_logit) >> _MIXTURE_SHIFT
    mixture = min(max(mixture, -_MAX_MIXTURE), _MAX_MIXTURE - 1)
    return np.int64(PROBABILITIES[np.uint64(mixture + _MAX_MIXTURE)]), logit, other_logit


@inlined_kernel
def _learned(weight, logit, mixed, bit):
    """Return a weight moved down the slope of the bit's cost."""
    return weight + ((_HALF_WEIGHT - mixed * logit) >> _WEIGHT_BITS) + (logit if bit else 0)


# One text for encoder and decoder: the value to code is an argument, ignored by a decoder, and the
# coded value is returned. Loops unpack their coder, because each access counts references, and keep
# `at`, which is (RANGE, POINT, BYTE_POS or HELD), out of the state (half the time). A one is coded
# as the lower part of the range, `bound` wide. Bit coders are inlined: passing arrays and returning
# `at` costs more than coding.


@inlined_kernel
def take_out(state):
    """Return a coder's state as scalars, for loops."""
    return state[RANGE], state[POINT], state[BYTE_POS]


@inlined_kernel
def put_back(at, state):
    """Undo `take_out`."""
    state[RANGE], state[POINT], state[BYTE_POS] = at


@inlined_kernel
def code_step(at, state, stream, models, is_encoder, index, bit):
    """Code one bit with ``models[index]``, which adapts; return (bit, at).

    A decoder reads bytes past the end of `stream` as zero; `finish_decoder` reports that.
    """
    span, point, pos = at
    index = np.uint64(index)
    prob, count = _parts_of(models[index])
    bound = (span >> 16) * ((prob >> 6) | 1)
    if is_encoder is None:
        bit = np.int64(point < bound)
    if bit:
        span = bound
    else:
        point = _raised(point, bound, is_encoder)
        span -= bound
    models[index] = _adapted(prob, count, bit)
    span, point, pos = _renewed(span, point, pos, state, stream, is_encoder)
    return bit, (span, point, pos)


@inlined_kernel
def code_mean_step(at, state, stream, models, is_encoder, first, second, bit):
    """Code one bit with the mean of two models' probabilities; as `code_step`."""
    span, point, pos = at
    first, second = np.uint64(first), np.uint64(second)
    prob, count = _parts_of(models[first])
    other_prob, other_count = _parts_of(models[second])
    bound = (span >> 16) * (((prob + other_prob) >> 7) | 1)
    if is_encoder is None:
        bit = np.int64(point < bound)
    if bit:
        span = bound
    else:
        point = _raised(point, bound, is_encoder)
        span -= bound
    models[first] = _adapted(prob, count, bit)
    models[second] = _adapted(other_prob, other_count, bit)
    span, point, pos = _renewed(span, point, pos, state, stream, is_encoder)
    return bit, (span, point, pos)


@inlined_kernel
def code_mixed_step(at, state, stream, models, is_encoder, first, second, weights, bit):
    """Code one bit with two models mixed by `weights`, which adapt; return (bit, at, weights)."""
    span, point, pos = at
    weight, other_weight = weights
    first, second = np.uint64(first), np.uint64(second)
    prob, count = _parts_of(models[first])
    other_prob, other_count = _parts_of(models[second])
    mixed, logit, other_logit = _mixed(prob, other_prob, weight, other_weight)
    bound = (span >> 16) * mixed
    if is_encoder is None:
        bit = np.int64(point < bound)
    if bit:
        span = bound
    else:
        point = _raised(point, bound, is_encoder)
        span -= bound
    models[first] = _adapted(prob, count, bit)
    models[second] = _adapted(other_prob, other_count, bit)
    weight = _learned(weight, logit, mixed, bit)
    other_weight = _learned(other_weight, other_logit, mixed, bit)
    span, point, pos = _renewed(span, point, pos, state, stream, is_encoder)
    return bit, (span, point, pos), (weight, other_weight)


@inlined_kernel
def _raised(point, distance, is_encoder):
    """Return the point after the lower end of the range has moved up."""
    return point - distance if is_encoder is None else point + distance


@inlined_kernel
def code_raw_step(at, state, stream, is_encoder, n_bits, value):
    """Code the lowest `n_bits` (0 to 62) bits of a value, the highest first, at one bit each.

    Return those bits as a number, and `at`.
    """
    span, point, pos = at
    coded = np.int64(0)
    for shift in range(n_bits - 1, -1, -1):
        span >>= 1
        bit = (value >> shift) & 1
        if is_encoder is None:
            bit = np.int64(point >= span)
        if bit:
            point = _raised(point, span, is_encoder)
        coded = (coded << 1) | bit
        span, point, pos = _renewed(span, point, pos, state, stream, is_encoder)
    return coded, (span, point, pos)


@kernel
def code_magnitude_step(at, state, stream, models, is_encoder, first, prefix, shift, value):
    """Code a value (0 to MAX_MAGNITUDE); return (value, at).

    The `shift` lowest bits are raw. What is above is unary with the N_UNARY models from `first` on;
    the rest + 1 Exp-Golomb, with the N_PREFIX models from `prefix` on and a raw mantissa. Any bytes
    decode to less than 2**(33 + shift).
    """
    upper = value >> shift
    n_ones = np.int64(0)
    bit = np.int64(1)
    while bit and n_ones < N_UNARY:
        bit = np.int64(upper > n_ones)
        bit, at = code_step(at, state, stream, models, is_encoder, first + n_ones, bit)
        n_ones += bit
    n_bits = np.int64(0)
    rest = upper - N_UNARY + 1
    # Only if all of the unary bits are ones.
    while bit and n_bits < N_PREFIX - 1:
        bit = np.int64(rest >> (n_bits + 1) > 0)
        bit, at = code_step(at, state, stream, models, is_encoder, prefix + n_bits, bit)
        n_bits += bit
    base = np.int64(N_UNARY - 1) << shift
    raw = np.int64(0)
    if n_bits + shift > 0:
        raw, at = code_raw_step(at, state, stream, is_encoder, n_bits + shift, value - base)
    if n_ones < N_UNARY:
        return (n_ones << shift) | raw, at
    return base + ((np.int64(1) << (n_bits + shift)) | raw), at


# The same for rare calls, with everything in the state.


@kernel
def code_bit(coder, index, bit):
    """Code one bit with ``models[index]``; return it."""
    state, stream, models, is_encoder = coder
    bit, at = code_step(take_out(state), state, stream, models, is_encoder, index, bit)
    put_back(at, state)
    return bit


@kernel
def code_raw(coder, n_bits, value):
    """Code the lowest `n_bits` bits of a value, unpredicted; return them as a number."""
    state, stream, _, is_encoder = coder
    value, at = code_raw_step(take_out(state), state, stream, is_encoder, n_bits, value)
    put_back(at, state)
    return value


@kernel
def code_magnitude(coder, first, prefix, shift, value):
    """Code a value (0 to MAX_MAGNITUDE) as `code_magnitude_step` does; return it."""
    state, stream, models, is_encoder = coder
    value, at = code_magnitude_step(
        take_out(state), state, stream, models, is_encoder, first, prefix, shift, value
    )
    put_back(at, state)
    return value
