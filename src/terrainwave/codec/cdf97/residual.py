"""Residuals in quantiser steps, which ensure the bound (FORMAT.md §7.7, §7.9).

E. Yusov, V. Turlapov 2010, §2.1: r = round(error / n), coded in the sample domain after the wavelet
stage, with the same bound on every level; coarse levels of faithful files are quantised as printed.
Departure: the error is not simply that of the wavelet's heights (the *base*). It is the error after
a prediction from the base's curvature and from errors decoded before, which are alike where small
coefficients were dropped.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.magnitudes import (
    ERROR_BITS,
    MAX_E,
    N_E_BINS,
    N_FRACTIONS,
    P_BITS,
    SHIFT_OF_E,
    contexts_of,
    error_of,
    fill_fractions,
    in_steps,
    log8,
    side_of,
    step_scale,
)
from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.filters import MAX_HEIGHT
from terrainwave.coding.jit import inlined_kernel, kernel, kernel_part
from terrainwave.coding.rangecoder import (
    N_PREFIX,
    N_UNARY,
    code_magnitude_step,
    code_step,
    put_back,
    take_out,
)

# State of a sample: nothing to code, coded here, or known already (on a shared line).
VOID, CODED, KNOWN = 0, 1, 2

# The base has a frame of two samples and fraction bits as predictions; terms are weighted in 1/256.
BASE_BITS = P_BITS
FRAME = 2
WEIGHT_BITS = 8
# Differences of the base and errors are clamped to this: products fit 32 x 32 bits.
_MAX_DIFFERENCE = 1 << 30
# Errors of prediction are in 1/32 step, the expected magnitude in 1/256, its weights in 1/128.
_E_SHIFT = 7 + ERROR_BITS - 8

# Terms of the prediction: differences of the base at these places, each with its mirror images,
# then errors at places decoded before.
CURVES = ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (1, 2), (2, 1))
PLACES = (
    (0, -1), (0, -2), (-1, 0), (-1, -1), (-1, 1), (-1, -2), (-1, 2),
    (-2, 0), (-2, -1), (-2, 1), (-2, -2), (-2, 2),
)  # fmt: skip
N_CURVES = len(CURVES)
N_TERMS = N_CURVES + len(PLACES)
_T_WEST, _T_WEST2, _T_ABOVE, _T_ABOVE2 = N_CURVES, N_CURVES + 1, N_CURVES + 2, N_CURVES + 7

# Start of the errors of a term in their framed row.
_FIRST_OF_TERM = np.array([0] * N_CURVES + [FRAME + col for _, col in PLACES], dtype=np.int64)

# Features of the expected magnitude: errors of prediction around, differences of the base's errors
# in the row above, one in 1/128.
(F_W, F_WW, F_N, F_NW, F_NE, F_NN, F_SLOPE, F_CONST) = range(8)
N_FEATURES = 8

_N_PHASES = 4
_N_FRACTIONS = 4
_N_SIDES = 7
_SIGN_MODELS = _N_PHASES * N_E_BINS * _N_FRACTIONS
_MAG_MODELS = _SIGN_MODELS + 25 * _N_SIDES
_PREFIX_MODELS = _MAG_MODELS + N_E_BINS * N_UNARY
N_RESIDUAL_MODELS = _PREFIX_MODELS + N_PREFIX


class Rounding(NamedTuple):
    """Rounding of residuals r to indices ``(abs(r) + bias) // width``, and back.

    An index decodes to ``index * width + shift``, 0 to 0. With `octaves`, indices are 2**octaves
    times finer than steps.
    """

    width: int
    bias: int
    shift: int
    octaves: int


def rounding_of(step: int, *, is_coarse: bool) -> Rounding:
    """Return the rounding of residuals: to steps, or as printed in Y10 §2.1 for coarse levels.

    There, with the bound ``delta = step >> 1`` (> 0) as unit, ``abs(r) // delta`` decodes to the
    middle of its interval. (The text reads the brackets as "nearest integer"; with it the bound
    would hold, but every error would have the sign of its residual, and by equation 1 it would not
    hold at all.)
    """
    half = step >> 1
    return Rounding(half, 0, half >> 1, 1) if is_coarse else Rounding(step, half, 0, 0)


class ResidualRows(NamedTuple):
    """Scratch rows; rows of samples have a frame of two."""

    wide: NDArray[np.int32]
    curves: NDArray[np.int32]
    errors: NDArray[np.int32]
    mags: NDArray[np.int32]
    signs: NDArray[np.int32]
    predicted: NDArray[np.int64]
    expected: NDArray[np.int64]


def new_scratch(n_cols: int) -> ResidualRows:
    """Return scratch rows for regions of `n_cols` columns."""
    framed = n_cols + 2 * FRAME
    return ResidualRows(
        np.zeros((2, N_TERMS, n_cols), dtype=np.int32),
        np.zeros((N_CURVES, n_cols), dtype=np.int32),
        np.zeros((3, framed), dtype=np.int32),
        np.zeros((3, framed), dtype=np.int32),
        np.zeros((2, framed), dtype=np.int32),
        np.zeros(n_cols, dtype=np.int64),
        np.zeros(n_cols, dtype=np.int64),
    )


def frame_base(base: NDArray[np.int64]) -> None:
    """Extend a base (frame of two) antisymmetrically about its outermost samples."""
    for lines in (base[FRAME:-FRAME].T, base):
        last = len(lines) - FRAME - 1
        for k in range(1, FRAME + 1):
            lines[FRAME - k] = 2 * lines[FRAME] - lines[min(FRAME + k, last)]
            lines[last + k] = 2 * lines[last] - lines[max(last - k, FRAME)]


@kernel
def _cut(difference):
    return np.int32(min(max(difference, -_MAX_DIFFERENCE), _MAX_DIFFERENCE))


@kernel
def _fill_curves(base, row, curves):
    """Fill ``curves[term, col]`` (int32) with the differences of the base around a row."""
    a2, a1, here = base[row], base[row + 1], base[row + 2]
    b1, b2 = base[row + 3], base[row + 4]
    n_cols = curves.shape[1]
    for j in range(n_cols):
        curves[0, j] = _cut(here[j + 1] + here[j + 3] - 2 * here[j + 2])
    for j in range(n_cols):
        curves[1, j] = _cut(a1[j + 2] + b1[j + 2] - 2 * here[j + 2])
    for j in range(n_cols):
        curves[2, j] = _cut(a1[j + 1] + a1[j + 3] + b1[j + 1] + b1[j + 3] - 4 * here[j + 2])
    for j in range(n_cols):
        curves[3, j] = _cut(here[j] + here[j + 4] - 2 * here[j + 2])
    for j in range(n_cols):
        curves[4, j] = _cut(a2[j + 2] + b2[j + 2] - 2 * here[j + 2])
    for j in range(n_cols):
        curves[5, j] = _cut(a1[j] + a1[j + 4] + b1[j] + b1[j + 4] - 4 * here[j + 2])
    for j in range(n_cols):
        curves[6, j] = _cut(a2[j + 1] + a2[j + 3] + b2[j + 1] + b2[j + 3] - 4 * here[j + 2])


@kernel
def _spread_weights(weights, parity, wide):
    """Fill ``wide[term, col]`` with the weights of each column's phase, for rows of this parity."""
    for t in range(N_TERMS):
        line, even, odd = wide[t], weights[2 * parity, t], weights[2 * parity + 1, t]
        for j in range(wide.shape[1]):
            line[j] = odd if j & 1 else even


@kernel
def _predict_row(base_row, curves, wide, above, above2, predicted):
    """Set `predicted` to 256 times the prediction of a row without its western terms.

    `above` and `above2` are the errors of the two rows above.
    """
    n_cols = curves.shape[1]
    for j in range(n_cols):
        predicted[j] = base_row[j + FRAME] << WEIGHT_BITS
    for t in range(N_CURVES):
        curve, weight = curves[t], wide[t]
        for j in range(n_cols):
            predicted[j] += np.int64(curve[j]) * np.int64(weight[j])
    for t in range(_T_ABOVE, N_TERMS):
        errors = above if t < _T_ABOVE2 else above2
        source, weight = errors[_FIRST_OF_TERM[t] :], wide[t]
        for j in range(n_cols):
            predicted[j] += np.int64(source[j]) * np.int64(weight[j])


@kernel
def _expect_row(above, above_mags, above2_mags, e_weights, shift, inverse, expected):
    """Set `expected` to the expected magnitudes of a row without their western features."""
    w_n, w_nw = np.int64(np.int32(e_weights[F_N])), np.int64(np.int32(e_weights[F_NW]))
    w_ne, w_nn = np.int64(np.int32(e_weights[F_NE])), np.int64(np.int32(e_weights[F_NN]))
    w_slope, constant = np.int64(e_weights[F_SLOPE]), np.int64(e_weights[F_CONST])
    n_cols = expected.shape[0]
    for j in range(n_cols):
        middle = np.int64(above[j + 2])
        slope = abs(middle - above[j + 1]) + abs(above[j + 3] - middle)
        expected[j] = in_steps(w_slope * slope, shift, inverse, ERROR_BITS - BASE_BITS)
    for j in range(n_cols):
        expected[j] += (
            w_n * above_mags[j + 2]
            + w_nw * above_mags[j + 1]
            + w_ne * above_mags[j + 3]
            + w_nn * above2_mags[j + 2]
            + constant
        )


@kernel
def _sign_context(signs, above_signs, col, side):
    """Return the model of a sign from those of W, NW and N, NE, and the prediction's fraction."""
    west = 2 * signs[col + 1] + above_signs[col + 1]
    north = 2 * above_signs[col + 2] + above_signs[col + 3]
    west = (2 if west > 0 else 0) + (1 if west == 0 else 0)
    north = min(max(north, -2), 2) + 2
    return _SIGN_MODELS + (west * 5 + north) * _N_SIDES + side


@kernel_part
def _start(scratch, weights):
    """Clear the rows of errors, magnitudes and signs; spread the weights of even and odd rows."""
    scratch.errors[:] = 0
    scratch.mags[:] = 0
    scratch.signs[:] = 0
    for parity in range(2):
        _spread_weights(weights, parity, scratch.wide[parity])


@inlined_kernel
def _index_of(goal, height, width, bias):
    """Return the magnitude of the index from a prediction to its goal, and its sign."""
    error = np.int64(goal) - height
    return (abs(error) + bias) // width, np.int64(-1 if error < 0 else 1)


@kernel
def code_residuals(
    target, heights, kinds, base, step, rounding, weights, e_weights, scratch, coder
):
    """Encode `target` (int32), or decode if it is None, into `heights`, row by row.

    `base` is framed; `weights` (4, N_TERMS) int32 are those of the phases 2 (row & 1) + (col & 1).
    Known samples are in `heights` already; void ones get their prediction.
    """
    n_rows, n_cols = heights.shape
    curves, wide = scratch.curves, scratch.wide
    errors, mags, signs = scratch.errors, scratch.mags, scratch.signs
    predicted, expected = scratch.predicted, scratch.expected
    _start(scratch, weights)
    scale_shift, inverse = step_scale(step)
    width, bias, shift, octaves = rounding
    most = 2 * MAX_HEIGHT // width + 1
    highest = np.int64(MAX_HEIGHT) << BASE_BITS
    w_e_west, w_e_west2 = np.int64(e_weights[F_W]), np.int64(e_weights[F_WW])
    bin_of_fraction = np.empty(N_FRACTIONS, dtype=np.int64)
    error_of_fraction = np.empty(N_FRACTIONS, dtype=np.int64)
    fill_fractions(scale_shift, inverse, bin_of_fraction, error_of_fraction)
    state, stream, models, is_encoder = borrowed(coder)
    at = take_out(state)
    for row in range(n_rows):
        here, above, above2 = errors[row % 3], errors[(row + 2) % 3], errors[(row + 1) % 3]
        here_mags, above_mags = mags[row % 3], mags[(row + 2) % 3]
        here_signs, above_signs = signs[row & 1], signs[(row + 1) & 1]
        base_row, row_kinds, row_heights = base[row + FRAME], kinds[row], heights[row]
        weights_here = wide[row & 1]
        _fill_curves(base, row, curves)
        _predict_row(base_row, curves, weights_here, above, above2, predicted)
        _expect_row(
            above, above_mags, mags[(row + 1) % 3], e_weights, scale_shift, inverse, expected
        )
        w_west, w_west2 = weights_here[_T_WEST], weights_here[_T_WEST2]
        west = west2 = mag_west = mag_west2 = np.int64(0)
        phase = (row & 1) * 2 * N_E_BINS
        for j in range(n_cols):
            value = (predicted[j] + west * w_west[j] + west2 * w_west2[j]) >> WEIGHT_BITS
            value = min(max(value, -highest), highest)
            height = (value + (1 << (BASE_BITS - 1))) >> BASE_BITS
            fraction = value - (height << BASE_BITS)
            kind = row_kinds[j]
            mag = np.int64(0)
            sign = np.int64(0)
            if kind == CODED:
                e_sum = expected[j] + w_e_west * mag_west + w_e_west2 * mag_west2
                e_bin, _ = contexts_of(min(e_sum >> _E_SHIFT, MAX_E))
                zero = (phase + (j & 1) * N_E_BINS + e_bin) * _N_FRACTIONS
                zero += bin_of_fraction[np.uint64(abs(fraction))]
                residual = np.int64(0)
                if target is not None:
                    residual, sign = _index_of(target[row, j], height, width, bias)
                bit = np.int64(residual != 0)
                bit, at = code_step(at, state, stream, models, is_encoder, zero, bit)
                if bit:
                    side = side_of(fraction, scale_shift, inverse)
                    model = _sign_context(here_signs, above_signs, j, side)
                    bit = np.int64(sign < 0)
                    bit, at = code_step(at, state, stream, models, is_encoder, model, bit)
                    sign = np.int64(1 - 2 * bit)
                    # Two bins an octave.
                    mag_bin = min(e_bin + 2 * octaves, N_E_BINS - 1)
                    residual, at = code_magnitude_step(
                        at, state, stream, models, is_encoder, _MAG_MODELS + mag_bin * N_UNARY,
                        np.int64(_PREFIX_MODELS), SHIFT_OF_E[mag_bin], residual - 1,
                    )  # fmt: skip
                    residual = min(residual + 1, most)
                    height += sign * (residual * width + shift)
                    height = min(max(height, -MAX_HEIGHT), MAX_HEIGHT)
                    mag = error_of(height, value, scale_shift, inverse)
                else:
                    sign = np.int64(0)
                    mag = error_of_fraction[np.uint64(abs(fraction))]
                row_heights[j] = height
            elif kind == KNOWN:
                height = np.int64(row_heights[j])
                mag = error_of(height, value, scale_shift, inverse)
            else:
                row_heights[j] = height
            mag_west2, mag_west = mag_west, mag
            west2 = west
            west = np.int64(_cut((height << BASE_BITS) - base_row[j + FRAME]))
            here[j + FRAME] = west
            here_mags[j + FRAME] = mag
            here_signs[j + FRAME] = sign
    put_back(at, state)


@kernel
def open_loop_costs(target, kinds, base, step, sets, every, scratch, costs):
    """Fill `costs` with the cost of each set of weights, in about 1/16 bit, on some rows.

    Errors are those of the targets with simulated quantisation noise. `base` is framed.
    """
    n_rows, n_cols = target.shape
    curves, errors, predicted = scratch.curves, scratch.errors, scratch.predicted
    scale_shift, inverse = step_scale(step)
    costs[:] = 0
    errors[:] = 0
    for row in range(min(2, n_rows - 1), n_rows, every):
        for k in range(3):
            source = max(row - k, 0)
            base_row, line, goal = base[source + FRAME], errors[k], target[source]
            for j in range(n_cols):
                noise = (source * 40503 + j * 10007 + 12345) * 2654435761 & 0xFFFFFFFF
                noise = ((noise >> 8) & 0xFFFF) - 32768
                height = np.int64(goal[j]) + ((step * 4 // 5 * noise) >> 16)
                line[j + FRAME] = _cut((height << BASE_BITS) - base_row[j + FRAME])
        _fill_curves(base, row, curves)
        for k in range(sets.shape[0]):
            wide = scratch.wide[0]
            _spread_weights(sets[k], row & 1, wide)
            _predict_row(base[row + FRAME], curves, wide, errors[1], errors[2], predicted)
            west, west2 = wide[_T_WEST], wide[_T_WEST2]
            total = np.int64(0)
            for j in range(n_cols):
                if kinds[row, j] != CODED:
                    continue
                value = predicted[j] + np.int64(errors[0, j + 1]) * west[j]
                value = (value + np.int64(errors[0, j]) * west2[j]) >> WEIGHT_BITS
                distance = abs(value - (np.int64(target[row, j]) << BASE_BITS))
                size = in_steps(distance, scale_shift, inverse, 8 - BASE_BITS)
                total += log8(256 + ((min(size, 1 << 14) ** 2) >> 6))
            costs[k] += total
