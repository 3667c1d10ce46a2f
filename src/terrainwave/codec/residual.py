"""Residuals in quantiser steps: what makes the bound hold (FORMAT.md §7.7).

D. Yusov, V. Turlapov 2010, §2.2: r = round(error / n), coded in the sample domain after the
wavelet stage, with the same bound on every level.
"""

import numpy as np

from terrainwave._jit import kernel
from terrainwave.codec.zerotree import (
    BIN_OF_SUM,
    MAX_MAG,
    N_BINS,
    SUM_LIMIT,
    decode_magnitude_at,
    encode_magnitude_at,
)
from terrainwave.coding.filters import MAX_HEIGHT
from terrainwave.coding.rangecoder import (
    BYTE_POS,
    CODE,
    LOW,
    N_PREFIX,
    N_UNARY,
    RANGE,
    decode_step,
    encode_step,
)

_N_PHASES = 4
_SIGN_MODELS = _N_PHASES * N_BINS
_MAG_MODELS = _SIGN_MODELS + 25
_PREFIX_MODELS = _MAG_MODELS + N_BINS * N_UNARY
_HINT_SHIFT = 6
N_RESIDUAL_MODELS = _PREFIX_MODELS + N_PREFIX

# Weights of the context sum, in 1/64: W and N, NE, WW and NN.
_W_NEAR, _W_NE, _W_FAR = 8, 1, 3


@kernel
def _context_bin(here, above, above2, hints, col):
    """Return the bin of the residual magnitudes coded before `col` and the hint at it.

    Rows of magnitudes have a frame of two to the left and one to the right.
    """
    sums = (
        _W_NEAR * (np.int64(here[col + 1]) + above[col + 2])
        + _W_NE * np.int64(above[col + 3])
        + _W_FAR * (np.int64(here[col]) + above2[col + 2])
        + hints[col]
    )
    return np.int64(BIN_OF_SUM[min(sums, SUM_LIMIT)])


@kernel
def smooth_activity(activity, smooth):
    """Fill `smooth` with twice each node's activity plus that of its four neighbours."""
    rows, cols = activity.shape
    for i in range(rows):
        above, here, below = activity[max(i - 1, 0)], activity[i], activity[min(i + 1, rows - 1)]
        for j in range(cols):
            smooth[i, j] = 2 * here[j] + above[j] + below[j]
        smooth[i, 0] += here[0] + here[min(1, cols - 1)]
        for j in range(1, cols - 1):
            smooth[i, j] += here[j - 1] + here[j + 1]
        if cols > 1:
            smooth[i, cols - 1] += here[cols - 2] + here[cols - 1]


@kernel
def _fill_hints(smooth, row, hints):
    """Fill ``hints[col]`` for a row of samples: the mean of the four nodes around, in 1/64."""
    rows, cols = smooth.shape
    first, second = smooth[row >> 1], smooth[min((row + 1) >> 1, rows - 1)]
    for j in range(cols):
        hints[2 * j] = first[j] + second[j]
    for j in range(cols - 1):
        hints[2 * j + 1] = (hints[2 * j] + hints[2 * j + 2]) >> _HINT_SHIFT
    hints[2 * cols - 1] = (2 * hints[2 * cols - 2]) >> _HINT_SHIFT
    for j in range(cols):
        hints[2 * j] = (2 * hints[2 * j]) >> _HINT_SHIFT


@kernel
def _sign_context(signs, above_signs, col):
    """Return the model of a sign from those of W, NW and N, NE."""
    west = 2 * signs[col + 1] + above_signs[col + 1]
    north = 2 * above_signs[col + 2] + above_signs[col + 3]
    west = (2 if west > 0 else 0) + (1 if west == 0 else 0)
    north = min(max(north, -2), 2) + 2
    return _SIGN_MODELS + west * 5 + north


@kernel
def compute_residuals(target, base, coded, step, residuals):
    """Fill `residuals` (int32) with round((target - base) / step) where `coded`; 0 elsewhere.

    Return the number of non-zero ones. |target - base| <= 2**31, and `step` is odd, so there are no
    ties and target - base - residual * step is at most (step - 1) / 2.
    """
    half = step >> 1
    n_nonzero = 0
    for row in range(target.shape[0]):
        for col in range(target.shape[1]):
            error = np.int64(target[row, col]) - np.int64(base[row, col])
            residual = np.int64(0)
            if coded[row, col] and abs(error) > half:
                residual = (abs(error) + half) // step
                if error < 0:
                    residual = -residual
                n_nonzero += 1
            residuals[row, col] = residual
    return n_nonzero


@kernel
def encode_residuals(residuals, coded, smooth, hints, mags, signs, state, out, models):
    """Encode the residuals of the samples with `coded` set, row by row.

    `smooth` is made by `smooth_activity`; `hints` (n_cols + 1), `mags` (3, n_cols + 3) and `signs`
    (2, n_cols + 3) are scratch.
    """
    n_rows, n_cols = residuals.shape
    mags[:] = 0
    signs[:] = 0
    span, low = state[RANGE], state[LOW]
    for row in range(n_rows):
        here, above, above2 = mags[row % 3], mags[(row + 2) % 3], mags[(row + 1) % 3]
        here_signs, above_signs = signs[row & 1], signs[(row + 1) & 1]
        _fill_hints(smooth, row, hints)
        for col in range(n_cols):
            if not coded[row, col]:
                here[col + 2] = 0
                here_signs[col + 2] = 0
                continue
            bin_ = _context_bin(here, above, above2, hints, col)
            residual = np.int64(residuals[row, col])
            index = ((row & 1) * 2 + (col & 1)) * N_BINS + bin_
            span, low = encode_step(span, low, state, out, models, index, 1 if residual != 0 else 0)
            here[col + 2] = min(abs(residual), MAX_MAG)
            here_signs[col + 2] = 0
            if residual != 0:
                first = _MAG_MODELS + bin_ * N_UNARY
                span, low = encode_magnitude_at(
                    span,
                    low,
                    state,
                    out,
                    models,
                    first,
                    np.int64(_PREFIX_MODELS),
                    np.int64(0),
                    abs(residual) - 1,
                )
                index = _sign_context(here_signs, above_signs, col)
                is_negative = 1 if residual < 0 else 0
                span, low = encode_step(span, low, state, out, models, index, is_negative)
                here_signs[col + 2] = 1 - 2 * is_negative
    state[RANGE], state[LOW] = span, low


@kernel
def decode_residuals(heights, coded, smooth, step, hints, mags, signs, state, data, models):
    """Decode what `encode_residuals` wrote and add it, times `step`, to `heights` in place."""
    n_rows, n_cols = heights.shape
    mags[:] = 0
    signs[:] = 0
    # More than this would leave the range of heights from anywhere in it.
    most = 2 * MAX_HEIGHT // step + 1
    span, code, pos = state[RANGE], state[CODE], state[BYTE_POS]
    for row in range(n_rows):
        here, above, above2 = mags[row % 3], mags[(row + 2) % 3], mags[(row + 1) % 3]
        here_signs, above_signs = signs[row & 1], signs[(row + 1) & 1]
        _fill_hints(smooth, row, hints)
        for col in range(n_cols):
            if not coded[row, col]:
                here[col + 2] = 0
                here_signs[col + 2] = 0
                continue
            bin_ = _context_bin(here, above, above2, hints, col)
            index = ((row & 1) * 2 + (col & 1)) * N_BINS + bin_
            bit, span, code, pos = decode_step(span, code, pos, data, models, index)
            here[col + 2] = 0
            here_signs[col + 2] = 0
            if bit:
                state[RANGE], state[CODE], state[BYTE_POS] = span, code, pos
                first = _MAG_MODELS + bin_ * N_UNARY
                prefix = np.int64(_PREFIX_MODELS)
                mag = decode_magnitude_at(state, data, models, first, prefix, np.int64(0)) + 1
                here[col + 2] = min(mag, MAX_MAG)
                span, code, pos = state[RANGE], state[CODE], state[BYTE_POS]
                index = _sign_context(here_signs, above_signs, col)
                is_negative, span, code, pos = decode_step(span, code, pos, data, models, index)
                sign = 1 - 2 * is_negative
                here_signs[col + 2] = sign
                height = np.int64(heights[row, col]) + sign * min(mag, most) * step
                heights[row, col] = min(max(height, -MAX_HEIGHT), MAX_HEIGHT)
    state[RANGE], state[CODE], state[BYTE_POS] = span, code, pos
