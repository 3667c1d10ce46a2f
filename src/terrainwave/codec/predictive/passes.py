"""One pass of the `predictive` method over a plane of details (FORMAT.md: predictive).

For each row, terms that do not depend on the row itself are computed first, over whole rows; the
others (the western tap and two errors) are added sample by sample while coding.
"""

from collections import namedtuple
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.corrections import corrected
from terrainwave.codec.magnitudes import (
    E_BITS,
    E_OFFSET,
    MAX_E,
    MAX_ERROR,
    N_FRACTIONS,
    N_RANGE_BINS,
    P_BITS,
    SIGN_B,
    SIGN_E_OF_BIN,
    SIGN_H,
    ZERO_B,
    ZERO_H,
    code_detail,
    contexts_of,
    error_of,
    fill_fractions,
    in_steps,
    log8,
    middle_bin,
    range_bin_of,
    side_of,
    step_scale,
)
from terrainwave.codec.planes import PAD, WEIGHT_BITS
from terrainwave.codec.refiner import FREE
from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.filters import MAX_HEIGHT
from terrainwave.coding.jit import inlined_kernel, kernel, kernel_part
from terrainwave.coding.rangecoder import code_mean_step, code_step, put_back, take_out

# State of a sample: nothing to code, coded in this pass, or known already (on a shared line).
VOID, CODED, KNOWN = 0, 1, 2

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
(_ACC, _LOWEST, _LOWER, _UPPER, _HIGHEST, _ERRORS, _SPREAD, _FLOOR, _CEILING, _WIDTH) = range(10)
N_ROW_BUFFERS = 10


@kernel
def _frame_own(plane, core, planes, row, n_cols):
    """Set the padding left and right of a row to the means of the adjacent core samples.

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
def _add_taps(acc, planes, taps, weights, row, n_cols):
    """Set `acc` to the stencil's sum over a row without its western tap, rounded for P_BITS."""
    n_taps = taps.shape[0]
    for j in range(n_cols):
        acc[j] = 1 << (WEIGHT_BITS - P_BITS - 1)
    for t in range(1, n_taps - 3, 4):
        source_0 = planes[taps[t, 0], row + taps[t, 1] + PAD, taps[t, 2] + PAD :]
        source_1 = planes[taps[t + 1, 0], row + taps[t + 1, 1] + PAD, taps[t + 1, 2] + PAD :]
        source_2 = planes[taps[t + 2, 0], row + taps[t + 2, 1] + PAD, taps[t + 2, 2] + PAD :]
        source_3 = planes[taps[t + 3, 0], row + taps[t + 3, 1] + PAD, taps[t + 3, 2] + PAD :]
        weight_0, weight_1 = np.int64(np.int32(weights[t])), np.int64(np.int32(weights[t + 1]))
        weight_2, weight_3 = np.int64(np.int32(weights[t + 2])), np.int64(np.int32(weights[t + 3]))
        for j in range(n_cols):
            acc[j] += (
                weight_0 * source_0[j]
                + weight_1 * source_1[j]
                + weight_2 * source_2[j]
                + weight_3 * source_3[j]
            )
    for t in range(n_taps - (n_taps - 1) % 4, n_taps):
        weight_0 = np.int64(np.int32(weights[t]))
        source_0 = planes[taps[t, 0], row + taps[t, 1] + PAD, taps[t, 2] + PAD :]
        for j in range(n_cols):
            acc[j] += weight_0 * source_0[j]


@kernel
def _sort_core(planes, core, row, n_cols, lowest, lower, upper, highest):
    """Fill the rows of the sorted core values."""
    first = planes[core[0, 0], row + core[0, 1] + PAD, core[0, 2] + PAD :]
    second = planes[core[1, 0], row + core[1, 1] + PAD, core[1, 2] + PAD :]
    third = planes[core[2, 0], row + core[2, 1] + PAD, core[2, 2] + PAD :]
    fourth = planes[core[3, 0], row + core[3, 1] + PAD, core[3, 2] + PAD :]
    # One row at a time: loops with more outputs are not vectorised.
    for j in range(n_cols):
        lowest[j] = min(min(first[j], second[j]), min(third[j], fourth[j]))
    for j in range(n_cols):
        highest[j] = max(max(first[j], second[j]), max(third[j], fourth[j]))
    for j in range(n_cols):
        middle_1 = max(min(first[j], second[j]), min(third[j], fourth[j]))
        middle_2 = min(max(first[j], second[j]), max(third[j], fourth[j]))
        lower[j] = min(middle_1, middle_2)
    for j in range(n_cols):
        middle_1 = max(min(first[j], second[j]), min(third[j], fourth[j]))
        middle_2 = min(max(first[j], second[j]), max(third[j], fourth[j]))
        upper[j] = max(middle_1, middle_2)


@kernel
def _add_spread(
    spread, planes, bends, core, bent, lines, row, n_cols, is_diagonal, e_weights, lowest, highest
):
    """Set `spread` to the weighted distances, in quanta, that don't depend on the prediction."""
    weight = np.int64(np.int32(e_weights[F_RANGE]))
    for j in range(n_cols):
        spread[j] = weight * (np.int64(highest[j]) - lowest[j])
    weight = np.int64(np.int32(e_weights[F_TWIST]))
    if weight != 0:
        # Opposite corners of HH; the first two and the last two of HL and LH.
        swap = 2 if is_diagonal else 0
        first = planes[core[0, 0], row + core[0, 1] + PAD, core[0, 2] + PAD :]
        k = 1 + swap
        second = planes[core[k, 0], row + core[k, 1] + PAD, core[k, 2] + PAD :]
        third = planes[core[2, 0], row + core[2, 1] + PAD, core[2, 2] + PAD :]
        k = 3 - swap
        fourth = planes[core[k, 0], row + core[k, 1] + PAD, core[k, 2] + PAD :]
        for j in range(n_cols):
            twist = (np.int64(first[j]) + second[j]) - (np.int64(third[j]) + fourth[j])
            spread[j] += weight * abs(twist)
    weight = np.int64(np.int32(e_weights[F_BEND]))
    if weight != 0:
        for k in range(0, bent.shape[0], 2):
            bend_0 = bends[row + bent[k, 1] + PAD, bent[k, 2] + PAD :]
            bend_1 = bends[row + bent[k + 1, 1] + PAD, bent[k + 1, 2] + PAD :]
            for j in range(n_cols):
                spread[j] += weight * (np.int64(bend_0[j]) + bend_1[j])
    weight = np.int64(np.int32(e_weights[F_LINES]))
    if weight != 0:
        for k in range(0, lines.shape[0], 4):
            first = planes[lines[k, 0], row + lines[k, 1] + PAD, lines[k, 2] + PAD :]
            second = planes[lines[k + 1, 0], row + lines[k + 1, 1] + PAD, lines[k + 1, 2] + PAD :]
            third = planes[lines[k + 2, 0], row + lines[k + 2, 1] + PAD, lines[k + 2, 2] + PAD :]
            fourth = planes[lines[k + 3, 0], row + lines[k + 3, 1] + PAD, lines[k + 3, 2] + PAD :]
            for j in range(n_cols):
                bend = np.int64(first[j]) - second[j] - third[j] + fourth[j]
                spread[j] += weight * abs(bend)


@kernel
def _add_errors(sums, errors, activity, own, near, far, row, n_cols, e_weights):
    """Set `sums` to the weighted surrounding errors that are known before the row."""
    above, above2 = errors[own, row - 1 + PAD], errors[own, row - 2 + PAD]
    w_n, w_nw = np.int64(np.int32(e_weights[F_N])), np.int64(np.int32(e_weights[F_NW]))
    w_ne, w_nn = np.int64(np.int32(e_weights[F_NE])), np.int64(np.int32(e_weights[F_NN]))
    constant = np.int64(np.int32(e_weights[F_CONST]))
    for j in range(n_cols):
        sums[j] = (
            w_n * above[j + PAD]
            + w_nw * above[j + PAD - 1]
            + w_ne * above[j + PAD + 1]
            + w_nn * above2[j + PAD]
            + constant
        )
    weight = np.int64(np.int32(e_weights[F_ACTIVITY]))
    if weight != 0:
        active = activity[own, row - 1 + PAD]
        for j in range(n_cols):
            sums[j] += weight * active[j + PAD]
    weight = np.int64(np.int32(e_weights[F_OTHERS]))
    if weight != 0:
        for other in range(1, own):
            # For HL and LH next to HH, and LH next to HL: the next row if there is one.
            active = activity[other, row + (1 if other == 2 else 0) + PAD]
            for j in range(n_cols):
                sums[j] += weight * active[j + PAD]
    for feature in range(2):
        places = near if feature == 0 else far
        weight = np.int64(np.int32(e_weights[F_NEAR + feature]))
        if weight == 0:
            continue
        for k in range(0, places.shape[0], 2):
            error_0 = errors[places[k, 0], row + places[k, 1] + PAD, places[k, 2] + PAD :]
            error_1 = errors[
                places[k + 1, 0], row + places[k + 1, 1] + PAD, places[k + 1, 2] + PAD :
            ]
            for j in range(n_cols):
                sums[j] += weight * (np.int64(error_0[j]) + error_1[j])


@kernel
def _update_activity(errors, before, n_cols, after):
    """Fill a row of activity: its smoothed errors, and a share of the row before."""
    # Errors are at most 2^15 and activities 2^19: 32 bits are enough.
    error_0, error_1, error_2 = errors[PAD - 1 :], errors[PAD:], errors[PAD + 1 :]
    old_0, old_1, old_2 = before[PAD - 1 :], before[PAD:], before[PAD + 1 :]
    smoothed = after[PAD:]
    for j in range(n_cols):
        fresh = np.int32(error_0[j] + 2 * error_1[j] + error_2[j])
        old = np.int32(3 * (old_0[j] + 2 * old_1[j] + old_2[j]))
        smoothed[j] = np.int32(fresh + (old >> 4))
    after[PAD - 1] = after[PAD]
    after[PAD + n_cols] = after[PAD + n_cols - 1]


class Arrays(NamedTuple):
    """Arrays of a lattice, by plane: heights, errors of prediction and activity; bends of A."""

    planes: NDArray[np.int32]
    errors: NDArray[np.int32]
    activity: NDArray[np.int32]
    bends: NDArray[np.int32]


class PassTables(NamedTuple):
    """Tables that code a plane.

    With `clamp`, predictions stay within the core. `limits` are `magnitudes.cell_limits`, or None
    if each decision has only one model.
    """

    weights: NDArray[np.int64]
    e_weights: NDArray[np.int64]
    clamp: bool
    limits: NDArray[np.int64] | None


class Range(NamedTuple):
    """The quantiser's step, and the range of heights, in quanta."""

    step: int
    z_min: int
    z_max: int


# Values derived from a `Range`.
_Scale = namedtuple("_Scale", "shift inverse half p_low p_high")
# A sample to code: its sorted core, its prediction in 2**-P_BITS and rounded, two neighbours.
_Sample = namedtuple("_Sample", "bottom lower upper top west north value whole")


@kernel_part
def _scale_of(heights):
    shift, inverse = step_scale(heights.step)
    p_low, p_high = np.int64(heights.z_min) << P_BITS, np.int64(heights.z_max) << P_BITS
    return _Scale(shift, inverse, heights.step >> 1, p_low, p_high)


@kernel_part
def _prepare_row(arrays, geometry, tables, scale, rows, row, n_cols):
    """Fill the row buffers with the terms that do not depend on the row itself."""
    p_low, p_high = scale.p_low, scale.p_high
    own, core, e_weights = geometry.plane, geometry.core, tables.e_weights
    planes, errors, activity, bends = arrays
    lowest, highest = rows[_LOWEST], rows[_HIGHEST]
    floors, ceilings, widths = rows[_FLOOR], rows[_CEILING], rows[_WIDTH]
    _add_taps(rows[_ACC], planes, geometry.taps, tables.weights, row, n_cols)
    _sort_core(planes, core, row, n_cols, lowest, rows[_LOWER], rows[_UPPER], highest)
    _add_spread(
        rows[_SPREAD], planes, bends, core, geometry.bends, geometry.lines, row, n_cols, own == 1,
        e_weights, lowest, highest,
    )  # fmt: skip
    _add_errors(
        rows[_ERRORS], errors, activity, own, geometry.near, geometry.far, row, n_cols, e_weights
    )
    for j in range(n_cols):
        bound = np.int64(lowest[j]) << P_BITS if tables.clamp else p_low
        floors[j] = min(max(bound, p_low), p_high)
    for j in range(n_cols):
        bound = np.int64(highest[j]) << P_BITS if tables.clamp else p_high
        ceilings[j] = min(max(bound, p_low), p_high)
    for j in range(n_cols):
        width = np.int64(highest[j]) - lowest[j]
        widths[j] = in_steps(width, scale.shift, scale.inverse, E_BITS)


@inlined_kernel
def _distances(sample, unclamped, w_median, w_middle, w_mean):
    """Return the weighted distances of the core's means to a prediction, which is in 2**-P_BITS."""
    bottom, lower, upper, top = sample.bottom, sample.lower, sample.upper, sample.top
    distances = np.int64(0)
    if w_median != 0:
        median = (lower + upper) << (P_BITS - 1)
        distances += w_median * abs(median - sample.value)
    if w_middle != 0:
        middle = (bottom + top) << (P_BITS - 1)
        distances += w_middle * abs(middle - sample.value)
    if w_mean != 0:
        mean = (bottom + lower + upper + top) << (P_BITS - 2)
        distances += w_mean * abs(unclamped - mean)
    return distances


@inlined_kernel
def _sides(sample, half):
    """Return how many of core and neighbours are more than half a step above, and below."""
    bottom, lower, upper, top, west, north, _, whole = sample
    n_up = n_down = np.int64(0)
    is_quiet = (
        max(max(top, west), north) - whole <= half and whole - min(min(bottom, west), north) <= half
    )
    if not is_quiet:
        ceiling, floor = whole + half, whole - half
        n_up = np.int64(bottom > ceiling) + (lower > ceiling) + (upper > ceiling)
        n_up += np.int64(top > ceiling) + (west > ceiling) + (north > ceiling)
        n_down = np.int64(bottom < floor) + (lower < floor) + (upper < floor)
        n_down += np.int64(top < floor) + (west < floor) + (north < floor)
    return n_up, n_down


@inlined_kernel
def _detail_of(goal, whole, step, half):
    """Return the steps from a prediction, rounded to quanta, to a height."""
    off = np.int64(goal) - whole
    if abs(off) <= half:
        return np.int64(0)
    detail = (abs(off) + half) // step
    return -detail if off < 0 else detail


@inlined_kernel
def _contexts_of_other(sample, expected, e_bin, n_up, n_down, scale):
    """Return the arguments of `code_detail` for a detail that is not 0, from `sign_b` on."""
    bottom, lower, upper, top, west, north, value, whole = sample
    shift, inverse = scale.shift, scale.inverse
    from_median = ((lower + upper) << (P_BITS - 1)) - value
    from_middle = ((bottom + top) << (P_BITS - 1)) - value
    e_floor = max(expected, 128)
    log_floor = log8(e_floor)
    size = in_steps(abs(from_median), shift, inverse, E_BITS - P_BITS)
    median_bin = middle_bin(size if from_median > 0 else -size, e_floor, log_floor)
    size = in_steps(abs(from_middle), shift, inverse, E_BITS - P_BITS)
    middle = middle_bin(size if from_middle > 0 else -size, e_floor, log_floor)
    side = side_of(value - (whole << P_BITS), shift, inverse)
    sign_b = SIGN_B + ((SIGN_E_OF_BIN[e_bin] * 7 + side) * 9 + median_bin) * 9 + middle
    sign_h = SIGN_H + ((e_bin >> 2) * 8 + n_up) * 8 + n_down
    above, below = max((top << P_BITS) - value, 0), max(value - (bottom << P_BITS), 0)
    reach_b = in_steps(above, shift, inverse, E_BITS - P_BITS)
    reach_a = in_steps(below, shift, inverse, E_BITS - P_BITS)
    around = (
        bottom - whole, lower - whole, upper - whole, top - whole, west - whole, north - whole,
    )  # fmt: skip
    return sign_b, sign_h, reach_b, reach_a, around


@kernel
def code_pass(
    target, kinds, arrays, geometry, tables, heights, rows, coder, mixers, corrections
):  # fmt: skip
    """Encode a plane of `target`, or decode it if that is None, into its `planes`.

    `kinds` (VOID, CODED, KNOWN) and `target` have the plane's size without padding; known samples
    are in place. Fills the plane's `errors` and `activity` as well, whose padding must be 0.
    `geometry` is the pass (`planes.Pass`), `tables` are `PassTables`, `heights` a `Range`. `rows`
    may be int32 if `fits_narrow` allows it, for the same result in half the time. `coder` and
    `mixers` adapt. `corrections` are those of the plane, flat, or empty.
    """
    goal, kinds, arrays, geometry = borrowed((target, kinds, arrays, geometry))
    tables, rows, coder, mixers = borrowed((tables, rows, coder, mixers))
    kept, added = borrowed(corrections)
    n_rows, n_cols = kinds.shape
    own, core_taps = geometry.plane, geometry.core
    planes, activity = arrays.planes, arrays.activity
    plane, own_errors = planes[own], arrays.errors[own]
    acc, lowest, lower = rows[_ACC], rows[_LOWEST], rows[_LOWER]
    upper, highest = rows[_UPPER], rows[_HIGHEST]
    sums, spread = rows[_ERRORS], rows[_SPREAD]
    floors, ceilings, widths = rows[_FLOOR], rows[_CEILING], rows[_WIDTH]
    step, z_min, z_max = heights
    scale = _scale_of(heights)
    most = 2 * MAX_HEIGHT // step + 2
    e_weights, limits = tables.e_weights, tables.limits
    w_west = np.int64(tables.weights[0])
    w_e_west, w_e_west2 = e_weights[F_W], e_weights[F_WW]
    w_median, w_middle, w_mean = e_weights[F_MEDIAN], e_weights[F_MIDDLE], e_weights[F_MEAN]
    has_corrections = added.shape[0] > 0
    z_range = np.int64(z_min), np.int64(z_max)
    bin_of_fraction = np.empty(N_FRACTIONS, dtype=np.int64)
    error_of_fraction = np.empty(N_FRACTIONS, dtype=np.int64)
    fill_fractions(scale.shift, scale.inverse, bin_of_fraction, error_of_fraction)
    state, stream, models, is_encoder = coder
    at = take_out(state)
    _frame_own(plane, core_taps, planes, -1, n_cols)
    for row in range(n_rows):
        _frame_own(plane, core_taps, planes, row, n_cols)
        here, here_errors = plane[row + PAD], own_errors[row + PAD]
        above = plane[row + PAD - 1]
        here_errors[PAD - 1] = own_errors[row + PAD - 1, PAD]
        here_errors[PAD - 2] = own_errors[row + PAD - 1, PAD]
        _prepare_row(arrays, geometry, tables, scale, rows, row, n_cols)
        west = np.int64(here[PAD - 1])
        error_west, error_west2 = np.int64(here_errors[PAD - 1]), np.int64(here_errors[PAD - 2])
        samples, sample_errors, northern = here[PAD:], here_errors[PAD:], above[PAD:]
        own_kinds = kinds[row]
        for j in range(n_cols):
            unclamped = (np.int64(acc[j]) + w_west * west) >> (WEIGHT_BITS - P_BITS)
            value = min(max(unclamped, np.int64(floors[j])), np.int64(ceilings[j]))
            whole = (value + (1 << (P_BITS - 1))) >> P_BITS
            kind = own_kinds[j]
            if kind != CODED:
                error = np.int64(0)
                if kind == KNOWN:
                    west = np.int64(samples[j])
                    error = error_of(west, value, scale.shift, scale.inverse)
                else:
                    west = whole
                    if has_corrections:
                        place = row * n_cols + j
                        west = corrected(whole, kept, added, place, z_range, z_range)
                    samples[j] = west
                sample_errors[j] = error
                error_west2, error_west = error_west, error
                continue
            sample = _Sample(
                np.int64(lowest[j]), np.int64(lower[j]), np.int64(upper[j]), np.int64(highest[j]),
                west, np.int64(northern[j]), value, whole,
            )  # fmt: skip
            distances = np.int64(spread[j]) << P_BITS
            distances += _distances(sample, unclamped, w_median, w_middle, w_mean)
            # In 1/16384 step.
            expected = (
                sums[j]
                + w_e_west * error_west
                + w_e_west2 * error_west2
                + in_steps(distances, scale.shift, scale.inverse, 5 - P_BITS)
            )
            expected = min(expected >> 6, MAX_E)
            e_bin, log_range = contexts_of(expected)
            range_bin = range_bin_of(np.int64(widths[j]), expected + E_OFFSET, log_range)
            fraction = np.uint64(abs(value - (whole << P_BITS)))
            zero_b = ZERO_B + (e_bin * N_RANGE_BINS + range_bin) * 4 + bin_of_fraction[fraction]
            detail = np.int64(0)
            if target is not None:
                detail = _detail_of(goal[row, j], whole, step, scale.half)
            bit = np.int64(detail != 0)
            n_up = n_down = np.int64(0)
            if limits is not None:
                n_up, n_down = _sides(sample, scale.half)
                zero_h = ZERO_H + (e_bin * 7 + 6 - n_up - n_down) * 4 + min(min(n_up, n_down), 3)
                bit, at = code_mean_step(at, state, stream, models, is_encoder, zero_b, zero_h, bit)
            else:
                bit, at = code_step(at, state, stream, models, is_encoder, zero_b, bit)
            if not bit:
                west = whole
                error = error_of_fraction[fraction]
            else:
                sign_b, sign_h, reach_b, reach_a, around = _contexts_of_other(
                    sample, expected, e_bin, n_up, n_down, scale
                )
                detail, at = code_detail(
                    at, state, stream, models, is_encoder, mixers, e_bin, sign_b, sign_h, reach_b,
                    reach_a, expected + E_OFFSET, log_range, around, limits, detail,
                )  # fmt: skip
                detail = min(max(detail, -most), most)
                west = min(max(whole + detail * step, z_min), z_max)
                error = error_of(west, value, scale.shift, scale.inverse)
            if has_corrections:
                height = corrected(west, kept, added, row * n_cols + j, z_range, z_range)
                if height != west:
                    west = height
                    error = error_of(west, value, scale.shift, scale.inverse)
            samples[j] = west
            sample_errors[j] = error
            error_west2, error_west = error_west, error
        here_errors[PAD + n_cols] = here_errors[PAD + n_cols - 1]
        _update_activity(
            here_errors, activity[own, row + PAD - 1], n_cols, activity[own, row + PAD]
        )
    put_back(at, state)


def fits_narrow(most: int, weights: NDArray[np.int64], e_weights: NDArray[np.int64]) -> bool:
    """Return whether `code_pass` may use int32 rows if all heights are within +/- `most`.

    The bounds are those of the sums in `_add_taps`, `_add_spread` and `_add_errors`: errors are at
    most 2^15, activities 16 times that.
    """
    taps = (1 << P_BITS) + sum(map(abs, weights.tolist()))
    of = e_weights.tolist()
    spread = 128 * of[F_BEND] + 16 * of[F_LINES] + 4 * of[F_TWIST] + 2 * of[F_RANGE]
    near = of[F_N] + of[F_NW] + of[F_NE] + of[F_NN] + 6 * of[F_NEAR] + 4 * of[F_FAR]
    near += 16 * (of[F_ACTIVITY] + 2 * of[F_OTHERS])
    limit = 1 << 30
    return bool(
        min(of[:N_FEATURES]) >= 0
        and taps * most < limit
        and spread * most < limit
        and near * (MAX_ERROR + 1) + of[F_CONST] < limit
    )


@kernel
def open_loop_cost(target, kinds, planes, own, geometry, weights, step, every, rows):
    """Return the cost of some rows, their mean detail, and their number of samples.

    Uses every `every`-th row of `target`; the cost is in about 1/16 bit, the mean in 1/256.
    Own-pass taps see the targets with simulated quantisation noise, which ``planes[own]`` holds.
    """
    n_rows, n_cols = target.shape
    plane, taps = planes[own], geometry.taps
    scale_shift, inverse = step_scale(step)
    acc = rows[_ACC]
    w_west = np.int64(weights[0])
    rounding = (1 << (WEIGHT_BITS - 1)) - (1 << (WEIGHT_BITS - P_BITS - 1))
    total = magnitudes = n_seen = np.int64(0)
    for row in range(every >> 1, n_rows, every):
        _add_taps(acc, planes, taps, weights, row, n_cols)
        here = plane[row + PAD]
        for j in range(n_cols):
            if kinds[row, j] != CODED:
                continue
            value = (acc[j] + w_west * here[j + PAD - 1] + rounding) >> WEIGHT_BITS
            error = abs(value - target[row, j])
            error = in_steps(error, scale_shift, inverse, E_BITS)
            # Approximate bits of a detail: next to nothing below half a step, then its logarithm.
            total += log8(256 + ((min(error, 1 << 14) ** 2) >> 6))
            magnitudes += min((error + 128) >> 8, 1 << 20)
            n_seen += 1
    return total, (magnitudes << 8) // max(n_seen, 1), n_seen


@kernel
def n_reached(goal, kinds, kept, planes, own, geometry, weights, clamp, step, z_min, z_max, rows):
    """Return how many heights that must stay a stencil reaches by whole steps.

    ``planes[own]`` holds `goal`; `kept` is that of `Corrections`, flat.
    """
    n_rows, n_cols = goal.shape
    plane = planes[own]
    acc, lowest, lower = rows[_ACC], rows[_LOWEST], rows[_LOWER]
    upper, highest = rows[_UPPER], rows[_HIGHEST]
    w_west = np.int64(weights[0])
    p_low, p_high = np.int64(z_min) << P_BITS, np.int64(z_max) << P_BITS
    n = np.int64(0)
    for row in range(n_rows):
        _add_taps(acc, planes, geometry.taps, weights, row, n_cols)
        _sort_core(planes, geometry.core, row, n_cols, lowest, lower, upper, highest)
        here = plane[row + PAD]
        for j in range(n_cols):
            if kinds[row, j] != CODED or kept[row * n_cols + j] == FREE:
                continue
            value = np.int64(acc[j]) + w_west * here[j + PAD - 1]
            value >>= WEIGHT_BITS - P_BITS
            if clamp:
                value = max(value, np.int64(lowest[j]) << P_BITS)
                value = min(value, np.int64(highest[j]) << P_BITS)
            value = min(max(value, p_low), p_high)
            whole = (value + (1 << (P_BITS - 1))) >> P_BITS
            n += np.int64((np.int64(goal[row, j]) - whole) % step == 0)
    return n


def fill_noisy(target: NDArray[np.int32], plane: NDArray[np.int32], step: int) -> None:
    """Fill a padded plane with `target` plus noise of up to 0.4 steps, fixed by position."""
    n_rows, n_cols = target.shape
    inner = plane[PAD : PAD + n_rows, PAD : PAD + n_cols]
    np.add(target, _noise(n_rows, n_cols, int(step)), out=inner)


@lru_cache(maxsize=4)
def _noise(n_rows: int, n_cols: int, step: int) -> NDArray[np.int32]:
    """Return noise by position; the array is shared."""
    rows, cols = np.arange(n_rows)[:, None], np.arange(n_cols)
    noise = (rows * 40503 + cols * 10007 + 12345) * 2654435761 & 0xFFFFFFFF
    noise = ((noise >> 8) & 0xFFFF) - 32768
    return ((step * 4 // 5 * noise) >> 16).astype(np.int32)
