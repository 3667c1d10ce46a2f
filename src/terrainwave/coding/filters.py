"""CDF 9/7 in integers: low-pass analysis and synthesis, and the lifted transform.

A. Cohen, I. Daubechies, J.-C. Feauveau, "Biorthogonal bases of compactly supported wavelets"
(1992); lifting steps by I. Daubechies and W. Sweldens, "Factoring wavelet transforms into lifting
steps" (1998). Departures: fixed-point weights, and no scaling by K — the gain of each band is a
factor of its quantiser step instead (`BAND_GAINS`).

Bounds below assume heights of at most 2**30 quanta in magnitude.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel

MAX_HEIGHT = 1 << 30

# Filter taps in 1/2**14, centre first. Each phase sums to 2**14 exactly: DC gain 1.
_TAP_BITS = 14
_LOW_0, _LOW_1, _LOW_2, _LOW_3, _LOW_4 = 9880, 4372, -1282, -276, 438
_EVEN_0, _EVEN_1 = 18270, -943
_ODD_0, _ODD_1 = 9687, -1495
_HALO = 4

# Lifting weights alpha, beta, gamma, delta in 1/2**12.
_LIFT_BITS = 12
_LIFT_HALF = 1 << (_LIFT_BITS - 1)
_ALPHA, _BETA, _GAMMA, _DELTA = -6497, -217, 3616, 1817

# 4096 / (L2 norm of a basis function) by transform (0 = finest) and band (LL, HL, LH, HH).
BAND_GAINS = np.array(
    [
        [3153, 4050, 4050, 5203],
        [2275, 3104, 3104, 4235],
        [1687, 2242, 2242, 2981],
        [1269, 1663, 1663, 2181],
        [958, 1251, 1251, 1634],
        [725, 945, 945, 1233],
        [548, 715, 715, 933],
        [415, 541, 541, 706],
        [314, 409, 409, 534],
        [238, 310, 310, 404],
        [180, 234, 234, 305],
        [136, 177, 177, 230],
    ],
    dtype=np.int64,
)


def lowpass_analysis(
    heights: NDArray[np.int32],
    first: tuple[int, int],
    level_shape: tuple[int, int],
    out_first: tuple[int, int],
    out_shape: tuple[int, int],
) -> NDArray[np.int32]:
    """Return part of the next coarser level: CDF 9/7 low-pass, DC gain 1, every second sample.

    Parameters
    ----------
    heights : ndarray of int32, shape (n_rows, n_cols)
        A window of a level. It must hold every sample of the level within 4 of the window
        wanted, so that the result doesn't depend on how a raster is cut into windows.
    first : tuple of int
        Row and column of ``heights[0, 0]`` in its level.
    level_shape : tuple of int
        Rows and columns of the whole level; at its edges the signal is mirrored.
    out_first, out_shape : tuple of int
        The window wanted, in indices of the coarser level; sample (r, c) lies on (2r, 2c).

    Returns
    -------
    ndarray of int32, shape `out_shape`
        Rounded once, half up.
    """
    rows = _analyse(heights, first[0], level_shape[0], out_first[0], out_shape[0])
    total = _analyse(rows.T, first[1], level_shape[1], out_first[1], out_shape[1]).T
    total += 1 << (2 * _TAP_BITS - 1)
    return np.ascontiguousarray(total >> 2 * _TAP_BITS, dtype=np.int32)


def _analyse(
    heights: NDArray[Any], first: int, n: int, out_first: int, n_out: int
) -> NDArray[np.int64]:
    """Return every second row of a level with `n` rows, low-passed.

    `heights` holds its rows from `first` on, as far as the result needs them.
    Taps sum to less than 1.6 * 2**14 in magnitude, so 2**30 grows to less than 2**60.
    """
    places = np.arange(2 * out_first - _HALO, 2 * (out_first + n_out) + _HALO - 1)
    places %= max(2 * (n - 1), 1)
    places = np.minimum(places, 2 * (n - 1) - places) - first
    near = heights[places].astype(np.int64)
    total = _LOW_0 * near[_HALO : _HALO + 2 * n_out : 2]
    for k, weight in enumerate((_LOW_1, _LOW_2, _LOW_3, _LOW_4), 1):
        pair = near[_HALO - k :: 2][:n_out] + near[_HALO + k :: 2][:n_out]
        pair *= weight
        total += pair
    return total


@kernel
def extend_line(line, n):
    """Extend ``line[2 : n + 2]`` by two samples on both sides, antisymmetric about its ends.

    A ramp stays a ramp; a single sample becomes a constant. int64, in place. Values grow at most
    fivefold.
    """
    if n == 1:
        line[0] = line[1] = line[3] = line[4] = line[2]
        return
    last = n + 1
    line[1] = 2 * line[2] - line[3]
    line[last + 1] = 2 * line[last] - line[last - 1]
    # With two samples, line[4] is the extension just made.
    line[0] = 2 * line[2] - line[4]
    line[last + 2] = 2 * line[last] - line[last - 2]


@kernel
def synthesise_line(parent, offset, out):
    """Low-pass synthesis of an extended line: `out` gets 2**14 times the child's samples.

    ``parent[p + 2]`` is sample p; child sample c lies at parent position (c + offset) / 2.
    """
    for col in range(out.shape[0]):
        at = ((col + offset) >> 1) + 2
        if (col + offset) & 1:
            out[col] = _ODD_0 * (parent[at] + parent[at + 1]) + _ODD_1 * (
                parent[at - 1] + parent[at + 2]
            )
        else:
            out[col] = _EVEN_0 * parent[at] + _EVEN_1 * (parent[at - 1] + parent[at + 1])


@kernel
def synthesise(parent, row_offset, col_offset, line, rows, out):
    """Low-pass synthesis of a parent's heights (int32) to a child's positions (int32).

    Child sample (r, c) lies at parent position ((r + row_offset) / 2, (c + col_offset) / 2). The
    caller gives `line`, n_cols of the parent + 4, and `rows`, (n_rows of the parent + 4) x n_cols
    of the child, int64. Columns are extended from at most 2**31 and grow by less than 1.37 * 2**14
    in each direction and fivefold in the extension of rows: less than 2**62.3. Rounded once, half
    up; the result is clamped to +-2**30.
    """
    n_rows, n_cols = parent.shape
    for row in range(n_rows):
        for col in range(n_cols):
            line[col + 2] = parent[row, col]
        extend_line(line, n_cols)
        for col in (0, 1, n_cols + 2, n_cols + 3):
            line[col] = min(max(line[col], -2 * MAX_HEIGHT), 2 * MAX_HEIGHT)
        synthesise_line(line, col_offset, rows[row + 2])
    n_out = out.shape[1]
    for col in range(n_out):
        # `extend_line` down this column.
        if n_rows == 1:
            rows[0, col] = rows[1, col] = rows[3, col] = rows[4, col] = rows[2, col]
            continue
        rows[1, col] = 2 * rows[2, col] - rows[3, col]
        rows[n_rows + 2, col] = 2 * rows[n_rows + 1, col] - rows[n_rows, col]
        rows[0, col] = 2 * rows[2, col] - rows[4, col]
        rows[n_rows + 3, col] = 2 * rows[n_rows + 1, col] - rows[n_rows - 1, col]
    half = 1 << (2 * _TAP_BITS - 1)
    for row in range(out.shape[0]):
        at = ((row + row_offset) >> 1) + 2
        r0, r1, r2, r3 = rows[at - 1], rows[at], rows[at + 1], rows[min(at + 2, n_rows + 3)]
        if (row + row_offset) & 1:
            for col in range(n_out):
                total = _ODD_0 * (r1[col] + r2[col]) + _ODD_1 * (r0[col] + r3[col])
                total = (total + half) >> (2 * _TAP_BITS)
                out[row, col] = min(max(total, -MAX_HEIGHT), MAX_HEIGHT)
        else:
            for col in range(n_out):
                total = _EVEN_0 * r1[col] + _EVEN_1 * (r0[col] + r2[col])
                total = (total + half) >> (2 * _TAP_BITS)
                out[row, col] = min(max(total, -MAX_HEIGHT), MAX_HEIGHT)


@kernel
def lift(target, left, right, weight):
    """Add ``weight * (left + right)`` / 4096, rounded half up, to `target` in place (1-D)."""
    for i in range(target.shape[0]):
        target[i] += (weight * (left[i] + right[i]) + _LIFT_HALF) >> _LIFT_BITS


@kernel
def unlift(target, left, right, weight):
    """Undo `lift`."""
    for i in range(target.shape[0]):
        target[i] -= (weight * (left[i] + right[i]) + _LIFT_HALF) >> _LIFT_BITS


@kernel
def n_transforms(n_rows, n_cols):
    """Return how many transforms take n_rows x n_cols samples to 1 x 1; at least 1."""
    count = 1
    side = (max(n_rows, n_cols) + 1) >> 1
    while side > 1:
        side = (side + 1) >> 1
        count += 1
    return count


@kernel
def _forward_line(line, low, high):
    """Transform a row: low-pass samples to its front, high-pass behind them.

    `low` and `high` hold half the row and two more: one sample of extension at each end of `high`,
    one at the end of `low`.
    """
    n = line.shape[0]
    n_low, n_high = (n + 1) >> 1, n >> 1
    if n_high == 0:
        return
    for i in range(n_high):
        low[i] = line[2 * i]
        high[i + 1] = line[2 * i + 1]
    if n_low > n_high:
        low[n_high] = line[n - 1]
    inner = high[1 : n_high + 1]
    for first, second in ((_ALPHA, _BETA), (_GAMMA, _DELTA)):
        low[n_low] = low[n_low - 1]
        lift(inner, low, low[1:], first)
        high[0] = high[1]
        high[n_high + 1] = high[n_high]
        lift(low[:n_low], high, high[1:], second)
    # Loops: numba takes two seconds to compile an assignment of slices.
    for i in range(n_low):
        line[i] = low[i]
    for i in range(n_high):
        line[n_low + i] = inner[i]


@kernel
def _inverse_line(line, low, high):
    """Undo `_forward_line`."""
    n = line.shape[0]
    n_low, n_high = (n + 1) >> 1, n >> 1
    if n_high == 0:
        return
    inner = high[1 : n_high + 1]
    for i in range(n_low):
        low[i] = line[i]
    for i in range(n_high):
        inner[i] = line[n_low + i]
    for first, second in ((_GAMMA, _DELTA), (_ALPHA, _BETA)):
        high[0] = high[1]
        high[n_high + 1] = high[n_high]
        unlift(low[:n_low], high, high[1:], second)
        low[n_low] = low[n_low - 1]
        unlift(inner, low, low[1:], first)
    for i in range(n_high):
        line[2 * i] = low[i]
        line[2 * i + 1] = high[i + 1]
    if n_low > n_high:
        line[n - 1] = low[n_high]


@kernel
def _forward_rows(field, n_rows, n_cols, stride):
    """Transform down the columns, whole rows at a time, `n_rows` rows at every `stride`-th row.

    One sweep carries all four steps, each two rows behind the one before, so rows stay in cache.
    """
    last = n_rows - 1
    if last == 0:
        return
    for row in range(1, n_rows + 4, 2):
        for lag, weight in ((0, _ALPHA), (1, _BETA), (2, _GAMMA), (3, _DELTA)):
            _lift_row(field, row - lag, last, n_cols, stride, weight)


@kernel
def _lift_row(field, at, last, n_cols, stride, weight):
    """Add the weighted neighbours of row `at`, mirrored at rows 0 and `last`, to it."""
    if at < 0 or at > last:
        return
    above = at - 1 if at > 0 else 1
    below = at + 1 if at < last else last - 1
    lift(
        field[at * stride, :n_cols],
        field[above * stride, :n_cols],
        field[below * stride, :n_cols],
        weight,
    )


@kernel
def _unlift_row(field, at, last, n_cols, stride, weight):
    """Undo `_lift_row`."""
    if at < 0 or at > last:
        return
    above = at - 1 if at > 0 else 1
    below = at + 1 if at < last else last - 1
    unlift(
        field[at * stride, :n_cols],
        field[above * stride, :n_cols],
        field[below * stride, :n_cols],
        weight,
    )


@kernel
def _inverse_rows(field, n_rows, n_cols, stride):
    """Undo `_forward_rows`."""
    last = n_rows - 1
    if last == 0:
        return
    for row in range(0, n_rows + 4, 2):
        for lag, weight in ((0, _DELTA), (1, _GAMMA), (2, _BETA), (3, _ALPHA)):
            _unlift_row(field, row - lag, last, n_cols, stride, weight)


@kernel
def forward_transform(field, low, high):
    """Transform `field` (int64) in place down to one sample.

    Rows stay where they are: after transform t, rows at odd multiples of 2**t are high in y.
    Columns move: the low-pass half of a row to its front. `low` and `high` hold half a row
    and 3 more.
    """
    n_rows, n_cols = field.shape
    stride = 1
    for _ in range(n_transforms(n_rows, n_cols)):
        for row in range(n_rows):
            _forward_line(field[row * stride, :n_cols], low, high)
        _forward_rows(field, n_rows, n_cols, stride)
        n_rows, n_cols, stride = (n_rows + 1) >> 1, (n_cols + 1) >> 1, 2 * stride


@kernel
def inverse_transform(field, low, high):
    """Undo `forward_transform` in place."""
    count = n_transforms(field.shape[0], field.shape[1])
    for t in range(count - 1, -1, -1):
        # Sizes before transform t: halved t times, rounding up.
        n_rows = ((field.shape[0] - 1) >> t) + 1
        n_cols = ((field.shape[1] - 1) >> t) + 1
        _inverse_rows(field, n_rows, n_cols, 1 << t)
        for row in range(n_rows):
            _inverse_line(field[row << t, :n_cols], low, high)
