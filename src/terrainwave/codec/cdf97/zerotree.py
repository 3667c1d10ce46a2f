"""Joint zero trees of quantised wavelet coefficients (FORMAT.md §7.5).

E. Yusov, V. Turlapov 2010, §2.4 ("triple tree"): one tree for the three bands. Contexts are ours:
the paper's reference for its models was not available.

Node grids halve, rounding up, from the finest (half the region) to 1 x 1. A node of the grid of
transform t holds HL, LH and HH at its place; the root also LL.
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.magnitudes import BIN_OF_SUM, N_BINS, SUM_LIMIT
from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.filters import n_transforms
from terrainwave.coding.jit import inlined_kernel, kernel
from terrainwave.coding.rangecoder import (
    N_PREFIX,
    N_UNARY,
    code_bit,
    code_magnitude_step,
    code_raw,
    code_raw_step,
    code_step,
    put_back,
    take_out,
)
from terrainwave.coding.zerotrees import JS, JZTC, JZTR

# Below, np.int64(0) and the like are arguments of kernels, because numba compiles a kernel anew for
# every literal argument.

# Coefficients sit at the front of each row's halves and at rows of their own stride, as
# `filters.forward_transform` leaves them; magnitudes are kept, clamped to 255, in planes of nodes
# with a frame of zeros: two above and to the left, two to the right, one below.
FRAME_ROWS, FRAME_COLS = 3, 4
MAX_MAG = 255

# Magnitudes are coded without their lowest bits where large ones are expected: mean >= 8 * 2**k.
SHIFT_OF_BIN = np.array([max(0, b // 3 - 6) for b in range(N_BINS)], dtype=np.int64)

_N_LABEL_CLASSES = 5
_N_ZERO_CLASSES = 4
_N_MAG_CLASSES = 2
_ZERO_MODELS = _N_LABEL_CLASSES * 3 * N_BINS
_MAG_MODELS = _ZERO_MODELS + _N_ZERO_CLASSES * 3 * N_BINS
_PREFIX_MODELS = _MAG_MODELS + _N_MAG_CLASSES * 3 * N_BINS * N_UNARY
_LL_MODELS = _PREFIX_MODELS + 3 * N_PREFIX
N_TREE_MODELS = _LL_MODELS + 32

# Weights of the context sums, in 1/32: W, N, NW, NE, WW, NN. The second row is for bands whose
# magnitudes run along edges (HL down, LH across); the header selects it.
_BALANCED = (6, 6, 0, 2, 1, 1)
_HL_ALONG = (1, 13, 0, 0, 0, 2)
_LH_ALONG = (13, 1, 0, 0, 2, 0)
_DIAGONAL = (6, 5, 1, 2, 1, 1)
WEIGHTS = np.array([_BALANCED, _BALANCED, _DIAGONAL, _HL_ALONG, _LH_ALONG], dtype=np.int64)
_W_SIBLING = 1
_ROUGH_GAIN = 4
ROUGH_LIMIT = 1024


# Bands as arguments of kernels.
LL, HL, LH, HH = (np.int64(band) for band in range(4))


class Bands(NamedTuple):
    """Quantiser of coefficients: ``steps[t, band]`` and ``limits[t, band]``, the largest index.

    `offset` moves a magnitude towards zero, in 1/64 of a step. `along` is that of `choose_along`.
    """

    steps: NDArray[np.int64]
    limits: NDArray[np.int64]
    offset: int
    along: int


class Nodes(NamedTuple):
    """Arrays over the nodes of the grids, which begin at `offsets` (`node_offsets`).

    `labels` of all; `rough` (rows, cols) is the parent's roughness at the finest nodes. Scratch for
    the finest grid: `mags` (2, 3, rows + FRAME_ROWS, cols + FRAME_COLS), `spread` (3, rows, cols).
    """

    offsets: NDArray[np.int64]
    labels: NDArray[np.uint8]
    rough: NDArray[np.int64]
    mags: NDArray[np.uint8]
    spread: NDArray[np.int64]


@kernel
def node_offsets(n_rows, n_cols, offsets):
    """Fill `offsets` with the start of each node grid in a flat array; return their number.

    Coarsest first; ``offsets[count]`` is the number of nodes. 32 entries are enough.
    """
    count = n_transforms(n_rows, n_cols)
    offsets[0] = 0
    for level in range(count):
        t = count - 1 - level
        rows, cols = ((n_rows - 1) >> (t + 1)) + 1, ((n_cols - 1) >> (t + 1)) + 1
        offsets[level + 1] = offsets[level] + rows * cols
    return count


def places_of_bands(shape: tuple[int, ...]) -> Iterator[tuple[tuple[slice, slice], int, int]]:
    """Yield where the coefficients of each transform and band lie in a field."""
    count = n_transforms(*shape)
    for t in range(count):
        low, cols = ((shape[1] - 1) >> (t + 1)) + 1, ((shape[1] - 1) >> t) + 1
        even, odd = slice(None, None, 2 << t), slice(1 << t, None, 2 << t)
        yield (even, slice(low, cols)), t, int(HL)
        yield (odd, slice(0, low)), t, int(LH)
        yield (odd, slice(low, cols)), t, int(HH)
    yield (slice(1), slice(1)), count - 1, int(LL)


def mark_labels(
    quants: NDArray[np.int32], offsets: NDArray[np.int64], labels: NDArray[np.uint8]
) -> int:
    """Label every node of `quants` (layout of the transform); return the number of JS."""
    (n_rows, n_cols), count = quants.shape, n_transforms(*quants.shape)
    is_js = [
        np.zeros((((n_rows - 1) >> (t + 1)) + 1, ((n_cols - 1) >> (t + 1)) + 1), dtype=np.bool_)
        for t in range(count)
    ]
    for at, t, band in places_of_bands(quants.shape):
        if band != LL:
            found = quants[at] != 0
            is_js[t][: found.shape[0], : found.shape[1]] |= found
    for below, here in pairwise(is_js):
        for i, j in np.ndindex(2, 2):
            child = below[i::2, j::2]
            here[: child.shape[0], : child.shape[1]] |= child
    is_open = np.ones((1, 1), dtype=np.bool_)  # the root has no parent
    for level, significant in enumerate(is_js[::-1]):
        rows, cols = significant.shape
        inside = is_open.repeat(2, 0).repeat(2, 1)[:rows, :cols]
        grid = np.where(significant, JS, np.where(inside, JZTR, JZTC))
        labels[offsets[level] : offsets[level + 1]] = grid.ravel()
        is_open = significant
    return sum(int(np.count_nonzero(grid)) for grid in is_js)


@kernel
def clear_planes(mags, rows, cols):
    """Zero the part of the planes that a grid of rows x cols nodes uses, frame included."""
    for band in range(3):
        for i in range(rows + FRAME_ROWS):
            for j in range(cols + FRAME_COLS):
                mags[band, i, j] = 0


@kernel
def spread_parents(mags, rows, cols, spread):
    """Fill ``spread[band, i, j]`` with the weighted magnitudes of node (i, j) and its ring."""
    for band in range(3):
        for i in range(rows):
            above, here, below = mags[band, i + 1], mags[band, i + 2], mags[band, i + 3]
            for j in range(cols):
                ring = np.int64(above[j + 2]) + here[j + 1] + here[j + 3]
                # The frame has one row below, needed only for the last row; it is zero.
                ring += np.int64(below[j + 2])
                spread[band, i, j] = (2 * np.int64(here[j + 2]) + ring) >> 2


@inlined_kernel
def _causal_sum(here, above, above2, j, weights):
    """Return the weighted sum of the magnitudes coded before place `j` in a row of a plane."""
    return (
        weights[0] * here[j + 1]
        + weights[1] * above[j + 2]
        + weights[2] * above[j + 1]
        + weights[3] * above[j + 3]
        + weights[4] * here[j]
        + weights[5] * above2[j + 2]
    )


@kernel
def _label_context(sums, west, north, level_class):
    """Return the model of a label: sum of the three bands' context sums, labels W and N."""
    bin_ = np.int64(BIN_OF_SUM[min(sums, SUM_LIMIT)])
    n_significant = (1 if west == JS else 0) + (1 if north == JS else 0)
    return (level_class * 3 + n_significant) * N_BINS + bin_


@kernel
def code_tree(goal, field, bands, nodes, coder):
    """Encode the indices `goal`, or decode if it is None, coarse to fine, HL, LH, HH of a node.

    In both cases `field` (int64, zeros) receives the dequantised coefficients. An encoder takes
    labels from `mark_labels`; a decoder fills them.
    """
    n_rows, n_cols = field.shape
    count = n_transforms(n_rows, n_cols)
    quant = np.int64(0) if goal is None else np.int64(goal[0, 0])
    quant = _code_signed(quant, coder)
    field[0, 0] = dequantize(
        quant, bands.steps[count - 1, 0], bands.limits[count - 1, 0], np.int64(0)
    )
    clear_planes(nodes.mags[0], np.int64(1), np.int64(1))
    clear_planes(nodes.mags[1], np.int64(1), np.int64(1))
    for level in range(count):
        t = count - 1 - level
        parent_rows, parent_cols = ((n_rows - 1) >> (t + 2)) + 1, ((n_cols - 1) >> (t + 2)) + 1
        spread_parents(nodes.mags[(level + 1) & 1], parent_rows, parent_cols, nodes.spread)
        _code_level(goal, field, level, t, bands, nodes, coder)


@kernel
def _code_level(goal, field, level, t, bands, nodes, coder):
    """Code the nodes of the grid of transform `t`, row by row."""
    state, stream, models, is_encoder = borrowed(coder)
    offsets, labels, rough, mags, spread = nodes
    n_rows, n_cols = field.shape
    rows, cols = ((n_rows - 1) >> (t + 1)) + 1, ((n_cols - 1) >> (t + 1)) + 1
    parent_cols = ((n_cols - 1) >> (t + 2)) + 1
    plane = mags[level & 1]
    clear_planes(plane, rows, cols)
    weights_1 = WEIGHTS[3 if bands.along & 1 and t == 0 else 0]
    weights_2 = WEIGHTS[4 if bands.along & 2 and t == 0 else 1]
    weights_3 = WEIGHTS[2]
    steps, limits, offset = bands.steps[t], bands.limits[t], bands.offset
    at = take_out(state)
    for i in range(rows):
        hl, hl_above, hl_above2 = plane[0, i + 2], plane[0, i + 1], plane[0, i]
        lh, lh_above, lh_above2 = plane[1, i + 2], plane[1, i + 1], plane[1, i]
        hh, hh_above, hh_above2 = plane[2, i + 2], plane[2, i + 1], plane[2, i]
        for j in range(cols):
            node = offsets[level] + i * cols + j
            if level > 0:
                parent = offsets[level - 1] + (i >> 1) * parent_cols + (j >> 1)
                if labels[parent] != JS:
                    labels[node] = JZTC
                    continue
            sum_1 = spread[0, i >> 1, j >> 1] + _causal_sum(hl, hl_above, hl_above2, j, weights_1)
            sum_2 = spread[1, i >> 1, j >> 1] + _causal_sum(lh, lh_above, lh_above2, j, weights_2)
            sum_3 = spread[2, i >> 1, j >> 1] + _causal_sum(hh, hh_above, hh_above2, j, weights_3)
            if t == 0:
                hint = rough[i, j]
                sum_1 += hint
                sum_2 += hint
                sum_3 += hint >> 1
            west = labels[node - 1] if j > 0 else JZTR
            north = labels[node - cols] if i > 0 else JZTR
            index = _label_context((sum_1 + sum_2 + sum_3) >> 1, west, north, min(t, 4))
            label = np.int64(labels[node])
            label, at = code_step(at, state, stream, models, is_encoder, index, label)
            labels[node] = label
            if label == JS:
                at = _code_node(
                    at, state, stream, models, is_encoder, goal, field, t, i, j, steps, limits,
                    offset, plane, sum_1, sum_2, sum_3,
                )  # fmt: skip
    put_back(at, state)


@inlined_kernel
def _code_node(
    at, state, stream, models, is_encoder, goal, field, t, i, j, steps, limits, offset, plane,
    sum_1, sum_2, sum_3,
):  # fmt: skip
    """Code the coefficients of node (i, j); return `at`.

    Inlined into its only caller, a loop, so its many arguments cost nothing.
    """
    n_rows, n_cols = field.shape
    cols = ((n_cols - 1) >> (t + 1)) + 1
    high_rows, high_cols = (((n_rows - 1) >> t) + 1) >> 1, (((n_cols - 1) >> t) + 1) >> 1
    row, high_row, high_col = (2 * i) << t, (2 * i + 1) << t, cols + j
    is_open = np.int64(1)
    quant = mag_1 = mag_2 = np.int64(0)
    if j < high_cols:
        if goal is not None:
            quant = np.int64(goal[row, high_col])
        quant, at = _code_coeff(at, state, stream, models, is_encoder, HL, t, sum_1, is_open, quant)
        field[row, high_col] = dequantize(quant, steps[HL], limits[HL], offset)
        mag_1 = min(abs(quant), MAX_MAG)
        plane[0, i + 2, j + 2] = mag_1
    if i < high_rows:
        sum_2 += _W_SIBLING * mag_1
        if goal is not None:
            quant = np.int64(goal[high_row, j])
        quant, at = _code_coeff(at, state, stream, models, is_encoder, LH, t, sum_2, is_open, quant)
        field[high_row, j] = dequantize(quant, steps[LH], limits[LH], offset)
        mag_2 = min(abs(quant), MAX_MAG)
        plane[1, i + 2, j + 2] = mag_2
        if j < high_cols:
            sum_3 += _W_SIBLING * (mag_1 + mag_2)
            is_open = np.int64(t > 0 or mag_1 + mag_2 > 0)
            if goal is not None:
                quant = np.int64(goal[high_row, high_col])
            quant, at = _code_coeff(
                at, state, stream, models, is_encoder, HH, t, sum_3, is_open, quant
            )
            field[high_row, high_col] = dequantize(quant, steps[HH], limits[HH], offset)
            plane[2, i + 2, j + 2] = min(abs(quant), MAX_MAG)
    return at


@kernel
def _code_coeff(at, state, stream, models, is_encoder, band, t, sums, is_open, quant):
    """Code a coefficient's index; return (quant, at).

    A coefficient that must be non-zero (`is_open` 0) has no zero flag.
    """
    bin_ = np.int64(BIN_OF_SUM[min(sums >> 1, SUM_LIMIT)])
    if is_open:
        index = _ZERO_MODELS + (min(t, 3) * 3 + band - 1) * N_BINS + bin_
        bit = np.int64(quant != 0)
        bit, at = code_step(at, state, stream, models, is_encoder, index, bit)
        if not bit:
            return np.int64(0), at
    first = _MAG_MODELS + ((min(t, 1) * 3 + band - 1) * N_BINS + bin_) * N_UNARY
    prefix = _PREFIX_MODELS + (band - 1) * N_PREFIX
    shift = SHIFT_OF_BIN[bin_]
    mag, at = code_magnitude_step(
        at, state, stream, models, is_encoder, first, prefix, shift, abs(quant) - 1
    )
    is_negative, at = code_raw_step(at, state, stream, is_encoder, np.int64(1), np.int64(quant < 0))
    return -(mag + 1) if is_negative else mag + 1, at


@kernel
def _code_signed(value, coder):
    """Code the root's LL: Exp-Golomb of |value| + 1 with an adaptive prefix, then a sign.

    Any bytes decode to less than 2**32 in magnitude.
    """
    rest = abs(value) + 1
    n_bits, bit = np.int64(0), np.int64(1)
    while n_bits < 31 and bit:
        bit = code_bit(coder, _LL_MODELS + n_bits, np.int64(rest >> (n_bits + 1) > 0))
        n_bits += bit
    mag = ((np.int64(1) << n_bits) | code_raw(coder, n_bits, rest)) - 1
    if mag != 0 and code_raw(coder, np.int64(1), np.int64(value < 0)):
        return -mag
    return mag


@kernel
def dequantize(quant, step, limit, offset):
    """Return the coefficient of index `quant`: |quant| - offset / 64 steps, at most `limit`."""
    if quant == 0:
        return np.int64(0)
    value = (((min(abs(quant), limit) << 6) - offset) * step) >> 6
    return value if quant > 0 else -value


@kernel
def measure_roughness(parent, first_row, first_col, step, rough):
    """Fill `rough` with second differences of the parent around each node, in 1/8 of `step`.

    Node (0, 0) lies on ``parent[first_row, first_col]``. Edge samples are repeated beyond the
    array.
    """
    n_rows, n_cols = parent.shape
    for i in range(rough.shape[0]):
        row = min(first_row + i, n_rows - 1)
        above, here, below = parent[max(row - 1, 0)], parent[row], parent[min(row + 1, n_rows - 1)]
        for j in range(rough.shape[1]):
            col = min(first_col + j, n_cols - 1)
            twice = 2 * np.int64(here[col])
            bend = abs(np.int64(above[col]) + np.int64(below[col]) - twice)
            bend += abs(
                np.int64(here[max(col - 1, 0)]) + np.int64(here[min(col + 1, n_cols - 1)]) - twice
            )
            rough[i, j] = min(_ROUGH_GAIN * bend // step, ROUGH_LIMIT)


def choose_along(quants: NDArray[np.int32]) -> int:
    """Return 1 if HL runs down its columns, plus 2 if LH runs along its rows, on the finest level.

    Decided by the differences of neighbouring magnitudes along and across.
    """
    mags = np.minimum(np.abs(quants.astype(np.int64)), MAX_MAG)
    cols = (quants.shape[1] + 1) >> 1
    totals = []
    for band in (mags[::2, cols:], mags[1::2, :cols]):
        here = band[1:, 1:]
        totals.append([int(np.abs(here - other).sum()) for other in (band[:-1, 1:], band[1:, :-1])])
    (down, across), (lh_down, lh_across) = totals
    return int(4 * down < 3 * across) + 2 * int(4 * lh_across < 3 * lh_down)
