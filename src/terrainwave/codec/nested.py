"""One pass of the `predictive` method over a plane of details (FORMAT.md: predictive).

Per row, everything that does not depend on the row itself is computed first, over whole rows; what
does (the western tap and two errors) is added sample by sample while coding.
"""

import numpy as np

from terrainwave._jit import kernel
from terrainwave.codec.detail import (
    E_BITS,
    MAX_E,
    N_RANGE_BINS,
    SIGN_B,
    SIGN_E_OF_BIN,
    SIGN_H,
    ZERO_B,
    ZERO_H,
    decode_detail,
    e_bin_of,
    encode_detail,
    log8,
    middle_bin,
)
from terrainwave.codec.lattice import PAD, WEIGHT_BITS
from terrainwave.coding.filters import MAX_HEIGHT
from terrainwave.coding.rangecoder import (
    BYTE_POS,
    LOW,
    RANGE,
    decode_mean_step,
    decode_step,
    encode_mean_step,
    encode_step,
)

# What a sample is: nothing to code, coded in this pass, or known already (on a shared line).
VOID, CODED, KNOWN = 0, 1, 2

# Predictions have 6 fraction bits in contexts, errors are in 1/32 step, at most MAX_ERROR.
P_BITS = 6
MAX_ERROR = (1 << 15) - 1
_MAX_DISTANCE = 1 << 40
_INVERSE_BITS = 22

# Features of the expected magnitude, weights in 1/512. Errors of prediction in steps: western
# neighbours; the row above; sums over near and far known ones of this lattice. Distances in quanta,
# taken in steps: curvature of the coarse samples, range of the core, its median's and mid-range's
# distance to the prediction, second and third differences, the mean's distance. A constant,
# 1/16384.
(F_W, F_WW, F_N, F_NW, F_NE, F_NN, F_NEAR, F_FAR) = range(8)
(F_BEND, F_RANGE, F_MEDIAN, F_MIDDLE, F_TWIST, F_LINES, F_MEAN, F_CONST) = range(8, 16)
F_ACTIVITY, F_OTHERS = 16, 17
N_FEATURES = 18
E_WEIGHT_BITS = 9

# Rows of the row buffer.
_ACC, _LOWEST, _LOWER, _UPPER, _HIGHEST, _ERRORS, _SPREAD = range(7)
N_ROW_BUFFERS = 7


@kernel
def step_scale(step):
    """Return (shift, inverse): v / step is about ((v >> shift) * inverse) >> 22."""
    shift = np.int64(0)
    while step >> shift >= 1 << 12:
        shift += 1
    return shift, (np.int64(1) << _INVERSE_BITS) // (step >> shift)


@kernel
def in_steps(distance, shift, inverse, bits):
    """Return a distance >= 0 in quanta as a number of ``2**-bits`` steps, rounded down."""
    return ((min(distance, _MAX_DISTANCE) >> shift) * inverse) >> (_INVERSE_BITS - bits)


@kernel
def _frame_own(plane, core, planes, row, n_cols):
    """Set the padding beside row `row` of a plane to the means of the core samples beside it.

    ``row`` -1 sets the whole row above the first.
    """
    source = max(row, 0)
    for j in range(n_cols):
        if row >= 0 and 0 < j < n_cols - 1:
            continue
        total = np.int64(0)
        for k in range(4):
            total += planes[core[k, 0], source + core[k, 1] + PAD, j + core[k, 2] + PAD]
        mean = (total + 2) >> 2
        if row < 0:
            plane[PAD - 1, j + PAD] = mean
        if j == 0:
            plane[row + PAD, PAD - 1] = mean
        if j == n_cols - 1:
            plane[row + PAD, PAD + n_cols] = mean


@kernel
def _prepare_row(
    row,
    n_cols,
    planes,
    errors,
    activity,
    bends,
    own,
    taps,
    weights,
    core,
    near,
    far,
    bent,
    lines,
    is_diagonal,
    e_weights,
    rows,
):
    """Fill the row buffers with all that is known before the row is coded."""
    acc, lowest, lower = rows[_ACC], rows[_LOWEST], rows[_LOWER]
    upper, highest = rows[_UPPER], rows[_HIGHEST]
    sums, spread = rows[_ERRORS], rows[_SPREAD]
    for j in range(n_cols):
        acc[j] = 0
        spread[j] = 0
    for t in range(1, taps.shape[0]):
        weight = np.int64(np.int32(weights[t]))
        source = planes[taps[t, 0], row + taps[t, 1] + PAD, taps[t, 2] + PAD :]
        for j in range(n_cols):
            acc[j] += weight * source[j]
    first = planes[core[0, 0], row + core[0, 1] + PAD, core[0, 2] + PAD :]
    second = planes[core[1, 0], row + core[1, 1] + PAD, core[1, 2] + PAD :]
    third = planes[core[2, 0], row + core[2, 1] + PAD, core[2, 2] + PAD :]
    fourth = planes[core[3, 0], row + core[3, 1] + PAD, core[3, 2] + PAD :]
    w_range, w_twist = e_weights[F_RANGE], e_weights[F_TWIST]
    for j in range(n_cols):
        a, b = np.int64(first[j]), np.int64(second[j])
        c, d = np.int64(third[j]), np.int64(fourth[j])
        low_1, high_1, low_2, high_2 = min(a, b), max(a, b), min(c, d), max(c, d)
        low, high = min(low_1, low_2), max(high_1, high_2)
        mid_1, mid_2 = max(low_1, low_2), min(high_1, high_2)
        lowest[j], highest[j] = low, high
        lower[j], upper[j] = min(mid_1, mid_2), max(mid_1, mid_2)
        twist = abs(a + d - b - c) if is_diagonal else abs(a + b - c - d)
        spread[j] += w_range * (high - low) + w_twist * twist
    weight = e_weights[F_BEND]
    for k in range(bent.shape[0]):
        bend = bends[row + bent[k, 1] + PAD, bent[k, 2] + PAD :]
        for j in range(n_cols):
            spread[j] += weight * bend[j]
    weight = e_weights[F_LINES]
    for k in range(0, lines.shape[0], 4):
        first = planes[lines[k, 0], row + lines[k, 1] + PAD, lines[k, 2] + PAD :]
        second = planes[lines[k + 1, 0], row + lines[k + 1, 1] + PAD, lines[k + 1, 2] + PAD :]
        third = planes[lines[k + 2, 0], row + lines[k + 2, 1] + PAD, lines[k + 2, 2] + PAD :]
        fourth = planes[lines[k + 3, 0], row + lines[k + 3, 1] + PAD, lines[k + 3, 2] + PAD :]
        for j in range(n_cols):
            bend = np.int64(first[j]) - second[j] - third[j] + fourth[j]
            spread[j] += weight * abs(bend)
    above, above2 = errors[own, row - 1 + PAD], errors[own, row - 2 + PAD]
    w_n, w_nw, w_ne, w_nn = e_weights[F_N], e_weights[F_NW], e_weights[F_NE], e_weights[F_NN]
    for j in range(n_cols):
        sums[j] = (
            w_n * above[j + PAD]
            + w_nw * above[j + PAD - 1]
            + w_ne * above[j + PAD + 1]
            + w_nn * above2[j + PAD]
            + e_weights[F_CONST]
        )
    w_activity, active = e_weights[F_ACTIVITY], activity[own, row - 1 + PAD]
    for j in range(n_cols):
        sums[j] += w_activity * active[j + PAD]
    w_others = e_weights[F_OTHERS]
    for other in range(1, own):
        # HH beside HL and LH, HL beside LH: the next row where there is one.
        active = activity[other, row + (1 if other == 2 else 0) + PAD]
        for j in range(n_cols):
            sums[j] += w_others * active[j + PAD]
    weight = e_weights[F_NEAR]
    for k in range(near.shape[0]):
        error = errors[near[k, 0], row + near[k, 1] + PAD, near[k, 2] + PAD :]
        for j in range(n_cols):
            sums[j] += weight * error[j]
    weight = e_weights[F_FAR]
    for k in range(far.shape[0]):
        error = errors[far[k, 0], row + far[k, 1] + PAD, far[k, 2] + PAD :]
        for j in range(n_cols):
            sums[j] += weight * error[j]


@kernel
def _update_activity(errors, before, n_cols, after):
    """Fill a row of activity: its errors, smoothed, and what remains of the row before."""
    for j in range(PAD, n_cols + PAD):
        fresh = np.int64(errors[j - 1]) + 2 * errors[j] + errors[j + 1]
        old = np.int64(before[j - 1]) + 2 * before[j] + before[j + 1]
        after[j] = fresh + ((3 * old) >> 4)
    after[PAD - 1] = after[PAD]
    after[PAD + n_cols] = after[PAD + n_cols - 1]


@kernel
def code_pass(
    target, kinds, planes, errors, activity, bends, own, geometry, weights, e_weights, mixed,
    clamp, step, z_min, z_max, rows, spots, state, stream, models,
):  # fmt: skip
    """Encode a plane of `target`, or decode it where that is None, into ``planes[own]``.

    `kinds` (VOID, CODED, KNOWN) and `target` have the plane's size without padding; known samples
    are in place. Fills ``errors[own]`` and ``activity[own]`` as well, whose padding must be 0.
    """
    n_rows, n_cols = kinds.shape
    plane, own_errors = planes[own], errors[own]
    taps, core = geometry.taps, geometry.core
    is_diagonal = own == 1
    acc, lowest, lower = rows[_ACC], rows[_LOWEST], rows[_LOWER]
    upper, highest = rows[_UPPER], rows[_HIGHEST]
    sums, spread = rows[_ERRORS], rows[_SPREAD]
    scale_shift, inverse = step_scale(step)
    half = step >> 1
    one = np.int64(1)
    most = 2 * MAX_HEIGHT // step + 2
    w_west = np.int64(weights[0])
    w_e_west, w_e_west2 = e_weights[F_W], e_weights[F_WW]
    w_median, w_middle, w_mean = e_weights[F_MEDIAN], e_weights[F_MIDDLE], e_weights[F_MEAN]
    span = state[RANGE]
    low = state[LOW]  # CODE when decoding
    pos = state[BYTE_POS]
    _frame_own(plane, core, planes, -1, n_cols)
    for row in range(n_rows):
        _frame_own(plane, core, planes, row, n_cols)
        own_errors[row + PAD, PAD - 1] = own_errors[row + PAD - 1, PAD]
        own_errors[row + PAD, PAD - 2] = own_errors[row + PAD - 1, PAD]
        _prepare_row(
            row, n_cols, planes, errors, activity, bends, own, taps, weights, core, geometry.near,
            geometry.far, geometry.bends, geometry.lines, is_diagonal, e_weights, rows,
        )  # fmt: skip
        here, here_errors = plane[row + PAD], own_errors[row + PAD]
        above = plane[row + PAD - 1]
        for j in range(n_cols):
            bottom, top = lowest[j], highest[j]
            value = acc[j] + w_west * here[j + PAD - 1]
            value = (value + (one << (WEIGHT_BITS - P_BITS - 1))) >> (WEIGHT_BITS - P_BITS)
            mean = (bottom + lower[j] + upper[j] + top) << (P_BITS - 2)
            from_mean = abs(value - mean)
            if clamp:
                value = min(max(value, bottom << P_BITS), top << P_BITS)
            value = min(max(value, z_min << P_BITS), z_max << P_BITS)
            whole = (value + (1 << (P_BITS - 1))) >> P_BITS
            kind = kinds[row, j]
            if kind == VOID:
                here[j + PAD] = whole
                here_errors[j + PAD] = 0
                continue
            if kind == KNOWN:
                distance = abs((np.int64(here[j + PAD]) << P_BITS) - value)
                here_errors[j + PAD] = min(
                    in_steps(distance, scale_shift, inverse, 5 - P_BITS), MAX_ERROR
                )
                continue
            median = (lower[j] + upper[j]) << (P_BITS - 1)
            middle = (bottom + top) << (P_BITS - 1)
            from_median, from_middle = median - value, middle - value
            distances = (
                (spread[j] << P_BITS)
                + w_median * abs(from_median)
                + w_middle * abs(from_middle)
                + w_mean * from_mean
            )
            # In 1/16384 step.
            expected = (
                sums[j]
                + w_e_west * here_errors[j + PAD - 1]
                + w_e_west2 * here_errors[j + PAD - 2]
                + in_steps(distances, scale_shift, inverse, 5 - P_BITS)
            )
            expected = min(expected >> 6, MAX_E)
            e_bin = e_bin_of(log8(expected))
            e_range = expected + 77
            log_range = log8(e_range)
            width = in_steps(top - bottom, scale_shift, inverse, E_BITS)
            range_bin = min((log8(width + e_range) - log_range) >> 2, N_RANGE_BINS - 1)
            fraction = value - (whole << P_BITS)
            frac_bin = min(in_steps(abs(fraction), scale_shift, inverse, 3 - P_BITS), 3)
            zero_b = ZERO_B + (e_bin * N_RANGE_BINS + range_bin) * 4 + frac_bin
            zero_h = np.int64(0)
            n_up = n_down = 0
            if mixed:
                n_up = (
                    (1 if bottom - whole > half else 0)
                    + (1 if lower[j] - whole > half else 0)
                    + (1 if upper[j] - whole > half else 0)
                    + (1 if top - whole > half else 0)
                    + (1 if here[j + PAD - 1] - whole > half else 0)
                    + (1 if above[j + PAD] - whole > half else 0)
                )
                n_down = (
                    (1 if whole - bottom > half else 0)
                    + (1 if whole - lower[j] > half else 0)
                    + (1 if whole - upper[j] > half else 0)
                    + (1 if whole - top > half else 0)
                    + (1 if whole - here[j + PAD - 1] > half else 0)
                    + (1 if whole - above[j + PAD] > half else 0)
                )
                n_same = 6 - n_up - n_down
                zero_h = ZERO_H + (e_bin * 7 + n_same) * 4 + min(min(n_up, n_down), 3)
            detail = np.int64(0)
            is_zero = False
            if target is None:
                if mixed:
                    bit, span, low, pos = decode_mean_step(
                        span, low, pos, stream, models, zero_b, zero_h
                    )
                else:
                    bit, span, low, pos = decode_step(span, low, pos, stream, models, zero_b)
                is_zero = bit == 0
            else:
                error = np.int64(target[row, j]) - whole
                detail = (abs(error) + half) // step
                if error < 0:
                    detail = -detail
                is_zero = detail == 0
                bit = 0 if is_zero else 1
                if mixed:
                    span, low = encode_mean_step(
                        span, low, state, stream, models, zero_b, zero_h, bit
                    )
                else:
                    span, low = encode_step(span, low, state, stream, models, zero_b, bit)
            if not is_zero:
                e_floor = max(expected, 128)
                log_floor = log8(e_floor)
                size = in_steps(abs(from_median), scale_shift, inverse, E_BITS - P_BITS)
                median_bin = middle_bin(size if from_median > 0 else -size, e_floor, log_floor)
                size = in_steps(abs(from_middle), scale_shift, inverse, E_BITS - P_BITS)
                middle = middle_bin(size if from_middle > 0 else -size, e_floor, log_floor)
                sixth = in_steps(6 * abs(fraction), scale_shift, inverse, 1 - P_BITS)
                sixth = min((sixth + 1) >> 1, 3)
                sixth = 3 + sixth if fraction > 0 else 3 - sixth
                sign_b = SIGN_B + ((SIGN_E_OF_BIN[e_bin] * 7 + sixth) * 9 + median_bin) * 9 + middle
                sign_h = SIGN_H + ((e_bin >> 2) * 8 + n_up) * 8 + n_down
                reach = in_steps(
                    max((top << P_BITS) - value, 0), scale_shift, inverse, E_BITS - P_BITS
                )
                far_b = min((log8(reach + e_range) - log_range) >> 2, N_RANGE_BINS - 1)
                reach = in_steps(
                    max(value - (bottom << P_BITS), 0), scale_shift, inverse, E_BITS - P_BITS
                )
                far_a = min((log8(reach + e_range) - log_range) >> 2, N_RANGE_BINS - 1)
                if mixed:
                    spots[0], spots[1], spots[2] = (
                        bottom - whole,
                        lower[j] - whole,
                        upper[j] - whole,
                    )
                    spots[3], spots[4] = top - whole, here[j + PAD - 1] - whole
                    spots[5] = above[j + PAD] - whole
                    for k in range(6):
                        distance = in_steps(abs(spots[k]) + half, scale_shift, inverse, 0)
                        spots[k] = distance if spots[k] > 0 else -distance
                if target is None:
                    detail, span, low, pos = decode_detail(
                        span, low, pos, state, stream, models, mixed, e_bin, sign_b, sign_h,
                        far_b, far_a, spots,
                    )  # fmt: skip
                    detail = min(max(detail, -most), most)
                else:
                    span, low = encode_detail(
                        span, low, state, stream, models, mixed, e_bin, sign_b, sign_h,
                        far_b, far_a, spots, detail,
                    )  # fmt: skip
            height = min(max(whole + detail * step, z_min), z_max)
            here[j + PAD] = height
            distance = abs((height << P_BITS) - value)
            here_errors[j + PAD] = min(
                in_steps(distance, scale_shift, inverse, 5 - P_BITS), MAX_ERROR
            )
        own_errors[row + PAD, PAD + n_cols] = own_errors[row + PAD, PAD + n_cols - 1]
        _update_activity(
            here_errors, activity[own, row + PAD - 1], n_cols, activity[own, row + PAD]
        )
    state[RANGE], state[LOW] = span, low
    if target is None:
        state[BYTE_POS] = pos


@kernel
def open_loop_cost(target, kinds, planes, own, geometry, weights, step, every, rows):
    """Return the cost of some rows, their mean detail, and how many samples that are.

    Every `every`-th row of `target` is looked at; the cost is in about 1/16 bit, the mean in 1/256.
    Own-pass taps see the targets with noise like that of quantising: ``planes[own]`` holds them.
    """
    n_rows, n_cols = target.shape
    taps = geometry.taps
    scale_shift, inverse = step_scale(step)
    acc = rows[0]
    total = magnitudes = n_seen = np.int64(0)
    for row in range(every >> 1, n_rows, every):
        for j in range(n_cols):
            acc[j] = 1 << (WEIGHT_BITS - 1)
        for t in range(taps.shape[0]):
            weight = np.int64(np.int32(weights[t]))
            source = planes[taps[t, 0], row + taps[t, 1] + PAD, taps[t, 2] + PAD :]
            for j in range(n_cols):
                acc[j] += weight * source[j]
        for j in range(n_cols):
            if kinds[row, j] != CODED:
                continue
            error = abs((acc[j] >> WEIGHT_BITS) - target[row, j])
            error = in_steps(error, scale_shift, inverse, E_BITS)
            # About the bits of a detail: next to nothing below half a step, then its logarithm.
            total += log8(256 + ((min(error, 1 << 14) ** 2) >> 6))
            magnitudes += min((error + 128) >> 8, 1 << 20)
            n_seen += 1
    return total, (magnitudes << 8) // max(n_seen, 1), n_seen


@kernel
def fill_noisy(target, plane, step):
    """Fill a padded plane with `target` plus noise of up to 0.4 steps, a function of the place."""
    for row in range(target.shape[0]):
        for j in range(target.shape[1]):
            noise = (row * 40503 + j * 10007 + 12345) * 2654435761 & 0xFFFFFFFF
            noise = ((noise >> 8) & 0xFFFF) - 32768
            plane[row + PAD, j + PAD] = target[row, j] + ((step * 4 // 5 * noise) >> 16)
