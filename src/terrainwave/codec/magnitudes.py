"""Details in quantiser steps: expected magnitude, contexts, symbols (FORMAT.md: predictive).

Contexts depend mainly on one number, the expected magnitude E of a detail, and then on the position
of the known neighbours relative to the prediction.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import inlined_kernel, kernel
from terrainwave.coding.rangecoder import (
    N_PREFIX,
    N_UNARY,
    code_mixed_step,
    code_raw_step,
    code_step,
)

# Expected magnitudes are in 1/256 step; their logarithm counts eighths of an octave.
E_BITS = 8
MAX_E = (1 << 28) - 1
# Predictions have 6 fraction bits, their errors are in 1/32 step, at most MAX_ERROR.
P_BITS, ERROR_BITS = 6, 5
MAX_ERROR = (1 << 15) - 1
N_FRACTIONS = (1 << (P_BITS - 1)) + 1
# Added to an expected magnitude before distances are compared with it.
E_OFFSET = 77
_LOG_TABLE_BITS = 12


def _eighth_octaves() -> np.ndarray:
    """Return floor(8 log2 v) for v below 4096 in exact integers; 0 for v = 0."""
    table = np.zeros(1 << _LOG_TABLE_BITS, dtype=np.uint8)  # small enough for the first-level cache
    for value in range(1, 1 << _LOG_TABLE_BITS):
        # 2**(k/8) <= v  <=>  2**k <= v**8
        table[value] = (value**8).bit_length() - 1
    return table


LOG8 = _eighth_octaves()
_FIRST_LOG = 24
N_E_BINS = 44
N_RANGE_BINS = 8
_N_FRAC_BINS = 4
_N_BALANCE = 7 * 4
_N_BEYOND = 6 * 3
# Low bits of magnitudes that are not coded, by E bin: magnitudes of about a quarter of E.
SHIFT_OF_E = np.array(
    [0] + [max(0, ((_FIRST_LOG + 4 * (b - 1)) >> 3) - E_BITS - 1) for b in range(1, N_E_BINS)],
    dtype=np.int64,
)
SIGN_E_OF_BIN = np.array(
    [sum(_FIRST_LOG + 4 * b > edge for edge in (50, 61, 72, 84)) for b in range(N_E_BINS)],
    dtype=np.int64,
)

# Weighted sums of magnitudes are in 1/16 of the expected magnitude and fall into third-octave bins.
SUM_LIMIT = 4095


def _third_octave_bins() -> np.ndarray:
    sums = np.arange(SUM_LIMIT + 1)
    # Thresholds 2**p, 2**p * 1.26 and 2**p * 1.59, in integers.
    edges = sorted(
        {max(1, (1 << power) * third >> 6) for power in range(12) for third in (64, 81, 102)}
    )
    return np.searchsorted(edges, sums, side="right").astype(np.uint8)


BIN_OF_SUM = _third_octave_bins()
N_BINS = 36

_N_MIDDLE = 9
ZERO_B = 0
ZERO_H = ZERO_B + N_E_BINS * N_RANGE_BINS * _N_FRAC_BINS
SIGN_B = ZERO_H + N_E_BINS * _N_BALANCE
SIGN_H = SIGN_B + 5 * 7 * _N_MIDDLE * _N_MIDDLE
UNARY_B = SIGN_H + 11 * 64
UNARY_H = UNARY_B + N_E_BINS * N_RANGE_BINS * N_UNARY
LOW_BITS = UNARY_H + N_E_BINS * N_UNARY * _N_BEYOND
PREFIX = LOW_BITS + N_E_BINS * 16
N_DETAIL_MODELS = PREFIX + N_PREFIX

# Mixers, one for every four E bins.
SIGN_MIXERS = 0
UNARY_MIXERS = N_E_BINS >> 2
N_MIXERS = 2 * UNARY_MIXERS

# Distances in quanta become steps by multiplication.
_MAX_DISTANCE = 1 << 40
INVERSE_BITS = 22

# Largest magnitude in any stream.
MAX_DETAIL = 1 << 33


@kernel
def step_scale(step):
    """Return (shift, inverse): v / step is about ((v >> shift) * inverse) >> 22."""
    shift = np.int64(0)
    while step >> shift >= 1 << 12:
        shift += 1
    return shift, (np.int64(1) << INVERSE_BITS) // (step >> shift)


@kernel
def in_steps(distance, shift, inverse, bits):
    """Return a distance >= 0 in quanta as a number of ``2**-bits`` steps, rounded down."""
    return ((min(distance, _MAX_DISTANCE) >> shift) * inverse) >> (INVERSE_BITS - bits)


@kernel
def fill_fractions(shift, inverse, bins, errors):
    """Fill in values that depend on a prediction's distance to the nearest integer, at most 32."""
    for k in range(N_FRACTIONS):
        bins[k] = min(in_steps(np.int64(k), shift, inverse, 3 - P_BITS), 3)
        errors[k] = in_steps(np.int64(k), shift, inverse, ERROR_BITS - P_BITS)


@inlined_kernel
def side_of(fraction, shift, inverse):
    """Return on which side of a whole number a prediction lies, and how far: 0 … 6."""
    sixth = in_steps(6 * abs(fraction), shift, inverse, 1 - P_BITS)
    sixth = min((sixth + 1) >> 1, 3)
    return 3 + sixth if fraction > 0 else 3 - sixth


@inlined_kernel
def error_of(height, value, shift, inverse):
    """Return the distance of a height from its prediction."""
    distance = abs((height << P_BITS) - value)
    return min(in_steps(distance, shift, inverse, ERROR_BITS - P_BITS), MAX_ERROR)


@lru_cache(64)
def cell_limits(step: int) -> NDArray[np.int64]:
    """Return the least distance from a prediction of a neighbour beyond each unary step.

    By the number of low bits and the number of steps: such a neighbour's own detail, less 1 and its
    low bits, is at least that number.
    """
    shift, inverse = (int(part) for part in step_scale(np.int64(step)))
    cells = [[(k << low) + 1 for k in range(N_UNARY + 1)] for low in range(max(SHIFT_OF_E) + 1)]
    # Inverse of `in_steps`.
    places = [[-(-(c << INVERSE_BITS) // inverse) << shift for c in line] for line in cells]
    return np.array(places, dtype=np.int64) - (step >> 1)


@kernel
def log8(value):
    """Return floor(8 log2(value)) with 12 bits of `value`; 0 for 0 or less."""
    # Branchless: values near a limit, as on rough ground, would mispredict half of the branches.
    shift = (np.int64(value >= 4096) + (value >= 1 << 20) + (value >= 1 << 28)) << 3
    return np.int64(LOG8[np.uint64(min(max(value, 0) >> shift, 4095))]) + (shift << 3)


@kernel
def e_bin_of(log):
    """Return the bin of an expected magnitude from its `log8`."""
    return min(max(((log - _FIRST_LOG) >> 2) + 1, 0), N_E_BINS - 1)


def _contexts_of_small() -> np.ndarray:
    """Return, for each expected magnitude below 4096, its bin and `log8` of it + E_OFFSET."""
    logs = [int(LOG8[v]) if v < 4096 else int(LOG8[v >> 8]) + 64 for v in range(4096 + E_OFFSET)]
    bins = [min(max(((log - _FIRST_LOG) >> 2) + 1, 0), N_E_BINS - 1) for log in logs]
    pairs = zip(bins[:4096], logs[E_OFFSET:], strict=True)
    return np.array([bin_ | log << 8 for bin_, log in pairs], dtype=np.uint16)


_CONTEXTS_OF_SMALL = _contexts_of_small()


@kernel
def contexts_of(expected):
    """Return the bin of an expected magnitude, and `log8` of it + E_OFFSET."""
    if 0 <= expected < 4096:
        pair = np.int64(_CONTEXTS_OF_SMALL[np.uint64(expected)])
        return pair & 255, pair >> 8
    return e_bin_of(log8(expected)), log8(expected + E_OFFSET)


@kernel
def middle_bin(distance, e_floor, log_floor):
    """Return 0 … 8: distance of the prediction from a middle value, in expected magnitudes."""
    size = min((log8(2 * abs(distance) + e_floor) - log_floor) >> 2, 4)
    return 4 + size if distance > 0 else 4 - size


@kernel
def range_bin_of(reach, e_range, log_range):
    """Return 0 … 7: distance of a core value, in expected magnitudes."""
    return min((log8(reach + e_range) - log_range) >> 2, N_RANGE_BINS - 1)


@inlined_kernel
def _n_reaching(around, limit):
    """Return the number of known neighbours at or beyond a distance."""
    a, b, c, d, e, f = around
    return (
        np.int64(a >= limit)
        + (b >= limit)
        + (c >= limit)
        + (d >= limit)
        + (e >= limit)
        + (f >= limit)
    )


@inlined_kernel
def code_detail(
    at, state, stream, models, is_encoder, mixers, e_bin, sign_b, sign_h, reach_b, reach_a, e_range,
    log_range, around, limits, detail,
):  # fmt: skip
    """Code a detail known not to be 0; return (detail, at).

    `reach_b` and `reach_a` are the distances to the highest and the lowest core value; `around` the
    heights of the known neighbours less the prediction. `limits` are `cell_limits`, None if each
    decision has only one model. Inlined into a loop that has all of the arguments at hand.
    """
    positive = np.int64(detail > 0)
    if limits is not None:
        mixer = SIGN_MIXERS + (e_bin >> 2)
        weights = mixers[0, mixer], mixers[1, mixer]
        positive, at, weights = code_mixed_step(
            at, state, stream, models, is_encoder, sign_b, sign_h, weights, positive
        )
        mixers[0, mixer], mixers[1, mixer] = weights
    else:
        positive, at = code_step(at, state, stream, models, is_encoder, sign_b, positive)
    shift = SHIFT_OF_E[e_bin]
    size = np.int64(abs(detail)) - 1
    wanted = size >> shift
    # The upper bits: unary, then the rest.
    range_bin = range_bin_of(reach_b if positive else reach_a, e_range, log_range)
    first_b = UNARY_B + (e_bin * N_RANGE_BINS + range_bin) * N_UNARY
    first_h = UNARY_H + e_bin * N_UNARY * _N_BEYOND
    mixer = UNARY_MIXERS + (e_bin >> 2)
    weights = mixers[0, mixer], mixers[1, mixer]
    # Number of known neighbours on the detail's side, in this unary step or a later one.
    beyond = np.int64(0)
    if limits is not None:
        if not positive:
            a, b, c, d, e, f = around
            around = -a, -b, -c, -d, -e, -f
        beyond = _n_reaching(around, limits[np.uint64(shift), 0])
    upper = np.int64(0)
    while upper < N_UNARY:
        bit = np.int64(wanted > upper)
        if limits is not None:
            limit = limits[np.uint64(shift), np.uint64(upper + 1)]
            here, beyond = beyond, _n_reaching(around, limit)
            here -= beyond
            index_h = first_h + upper * _N_BEYOND + min(beyond, 5) * 3 + min(here, 2)
            bit, at, weights = code_mixed_step(
                at, state, stream, models, is_encoder, first_b + upper, index_h, weights, bit
            )
        else:
            bit, at = code_step(at, state, stream, models, is_encoder, first_b + upper, bit)
        if bit == 0:
            break
        upper += 1
    mixers[0, mixer], mixers[1, mixer] = weights
    first_low = LOW_BITS + e_bin * 16 + min(upper, 3) * 4
    if upper == N_UNARY:
        rest, at = _code_rest(at, state, stream, models, is_encoder, wanted - N_UNARY + 1)
        upper += rest - 1
    # The `shift` lower bits: two with models.
    value = upper
    for place in range(shift - 1, -1, -1):
        depth = shift - 1 - place
        if depth == 2:
            raw, at = code_raw_step(at, state, stream, is_encoder, place + 1, size)
            value = (value << (place + 1)) | raw
            break
        index = first_low + (1 + (value & 1) if depth == 1 else 0)
        bit, at = code_step(at, state, stream, models, is_encoder, index, (size >> place) & 1)
        value = (value << 1) | bit
    value = min(value, MAX_DETAIL) + 1
    return value if positive else -value, at


@kernel
def _code_rest(at, state, stream, models, is_encoder, rest):
    """Code the part beyond the unary one, 1 or more, as Exp-Golomb; return (rest, at)."""
    n_bits = np.int64(0)
    while n_bits < N_PREFIX - 1:
        bit = np.int64(rest >> (n_bits + 1) > 0)
        bit, at = code_step(at, state, stream, models, is_encoder, PREFIX + n_bits, bit)
        if bit == 0:
            break
        n_bits += 1
    raw, at = code_raw_step(at, state, stream, is_encoder, n_bits, rest)
    return (np.int64(1) << n_bits) | raw, at
