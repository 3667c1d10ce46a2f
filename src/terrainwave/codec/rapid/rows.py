"""Rows of the planes of a lattice: filled, predicted, made readable (format-rapid.md, R.5, R.6).

`at` is the corner of a row's neighbourhood in the workspace `m` (`layout`): the row's own
samples are ``at + place(plane, 0, column)``. Heights are less than the unit's origin. Numbers of
samples and places are unsigned, so that no index needs to be checked for a sign.
"""

import numpy as np

from terrainwave.codec.planes import HH, HL, LH, A, reflect
from terrainwave.codec.rapid.layout import (
    BENDS,
    CORE_PLACES,
    ERRORS,
    EXPECTED,
    FEATURE_ORDER,
    LEAST,
    MOST,
    N_STENCIL_TAPS,
    OF_FEATURES,
    PLANE,
    PREDICTED,
    RANGE_SHIFT,
    ROWS_ABOVE,
    ROWS_BELOW,
    SHIFT_MASK,
    STRIDE,
    SUM,
    TAP_PLACES,
    TWIST,
    WEIGHTS,
    place,
)
from terrainwave.coding.jit import kernel, kernel_part

_A, _BENDS = place(A, 0, 0), place(BENDS, 0, 0)
_HH, _HL, _LH = place(HH, 0, 0), place(HL, 0, 0), place(LH, 0, 0)
_U0, _U1, _U2, _U3, _U4 = (np.uint64(k) for k in range(5))
_U6, _U8 = np.uint64(6), np.uint64(8)
_F_NORTH, _F_DIAGONAL, _F_NORTH_2, _F_BEND, _F_NEAR, _F_FAR = (
    np.uint64(feature) for feature in FEATURE_ORDER
)
_STRIDE, _STRIDE_2 = np.uint64(STRIDE), np.uint64(2 * STRIDE)
TO_ERRORS = np.uint64(ERRORS * PLANE)
# The row of LH is two behind, and stored one later; its neighbourhood is as high as any.
_KEPT_ROWS = 2 + ROWS_ABOVE + 1 + ROWS_BELOW


@kernel_part
def keep_latest_rows(m, first, n_cols):
    """Move the rows that are still needed, from slot `first` on, to the front of each plane."""
    for plane in range(8):
        for row in range(_KEPT_ROWS):
            to = np.uint64(plane * PLANE + row * STRIDE)
            source = to + np.uint64(first * STRIDE)
            for col in range(n_cols):
                m[to + col] = m[source + col]


@kernel_part
def load_coarse_row(m, to, row, source, grid, origin, shape, scale):
    """Fill a row of plane A with what lies around it, mirrored where the lattice ends."""
    n_rows, n_cols = shape
    n = np.uint64((n_cols + 1) >> 1)
    cast = m.dtype.type
    first = np.uint64(grid.start + (reflect(2 * row, n_rows) >> 1) * grid.row_spacing)
    spacing = np.uint64(grid.col_spacing)
    low, high = cast(scale.low), cast(scale.high)
    for j in range(n):
        height = cast(np.int64(source[first + j * spacing]) - origin)
        m[to + j] = min(max(height, low), high)
    for k in range(-3, 4):
        col = k if k < 0 else ((n_cols + 1) >> 1) - 1 + k
        m[to - _U3 + np.uint64(col + 3)] = m[to + np.uint64(reflect(2 * col, n_cols) >> 1)]


@kernel_part
def fill_bends(m, at, n, most):
    """Fill a row of curvatures of plane A: fourth differences along the row plus the column."""
    cast, shift = m.dtype.type, m[RANGE_SHIFT] & SHIFT_MASK
    row, to = at + _A, at + _BENDS
    west_2, west, east, east_2 = row - _U2, row - _U1, row + _U1, row + _U2
    for j in range(n):
        across = cast(
            m[west_2 + j] + m[east_2 + j] - 4 * (m[west + j] + m[east + j]) + 6 * m[row + j]
        )
        m[to + j] = abs(across)
    north_2, north, south, south_2 = row - _STRIDE_2, row - _STRIDE, row + _STRIDE, row + _STRIDE_2
    for j in range(n):
        along = cast(
            m[north_2 + j] + m[south_2 + j] - 4 * (m[north + j] + m[south + j]) + 6 * m[row + j]
        )
        m[to + j] = min(cast(cast(m[to + j] + abs(along)) >> shift), cast(most))
    m[to + n] = m[to + n - _U1]


@kernel_part
def copy_row(m, source, to, n):
    """Copy `n` samples."""
    for j in range(n):
        m[to + j] = m[source + j]


@kernel_part
def fill_means(m, at, to, plane, n):
    """Fill a row from place `to` on with means of the coarse samples around a row of a plane.

    Its errors, and those of the row above, become 0.
    """
    cast = m.dtype.type
    first = at + _A
    east = first if plane == LH else first + _U1
    below = _U0 if plane == HL else _STRIDE
    for j in range(n):
        upper = np.int64(m[first + j]) + np.int64(m[east + j])
        lower = np.int64(m[first + below + j]) + np.int64(m[east + below + j])
        m[to + j] = cast((upper + lower + 2) >> 2)
    for k in range(3):
        m[to - _U3 + np.uint64(k)] = m[to]
        m[to + n + np.uint64(k)] = m[to + n - _U1]
    errors = to + TO_ERRORS - _U4
    for j in range(n + _U8):
        m[errors + j] = 0
        m[errors - _STRIDE + j] = 0


@kernel_part
def surround(m, own, row, n_rows, n):
    """Make a coded row, and the errors of its predictions, readable beside it, above and below."""
    for kind in range(2):
        start = own + TO_ERRORS if kind else own
        for k in range(3):
            m[start - _U3 + np.uint64(k)] = m[start]
            m[start + n + np.uint64(k)] = m[start + n - _U1]
        left = start - _U4
        first = left - np.uint64(3) * _STRIDE if row == 0 else left
        last = left + _STRIDE_2 if row == n_rows - 1 else left
        for to in range(first, last + _U1, _STRIDE):
            if to != left:
                copy_row(m, left, to, n + _U8)


@kernel
def predict_row(m, at, n, plane):
    """Fill `PREDICTED`, in 1/64 quanta, and what is seen of the core; start `EXPECTED`."""
    # With each plane's constants, loops over taps become straight code, which runs in vectors.
    if plane == HH:
        _weigh_taps(m, at, n, HH, N_STENCIL_TAPS[HH], _U4, _U0, _U0)
    elif plane == HL:
        _weigh_taps(m, at, n, HL, N_STENCIL_TAPS[HL], _U2, _U2, _U4)
    else:
        _weigh_taps(m, at, n, LH, N_STENCIL_TAPS[LH], _U2, _U6, _U4)
    _look_around(m, at, n, plane)


@kernel_part
def _weigh_taps(m, at, n, plane, n_taps, n_bends, n_near, n_far):
    """Fill `PREDICTED`, in 1/4096 quanta, and start `EXPECTED`: weighted sums of a row's taps."""
    w = WEIGHTS[plane]
    for j in range(n):
        total = np.int64(32)
        for k in range(n_taps):
            total += m[w + k] * m[at + TAP_PLACES[plane, k] + j]
        m[PREDICTED + j] = total
    # As `FEATURE_ORDER` has them.
    f, north = w + OF_FEATURES, n_taps
    diagonal, north_2, bends = north + _U1, north + _U3, north + _U4
    near = bends + n_bends
    far = near + n_near
    for j in range(n):
        k = at + j
        total = (
            m[f + _F_NORTH] * m[k + TAP_PLACES[plane, north]]
            + m[f + _F_DIAGONAL]
            * (m[k + TAP_PLACES[plane, diagonal]] + m[k + TAP_PLACES[plane, diagonal + _U1]])
            + m[f + _F_NORTH_2] * m[k + TAP_PLACES[plane, north_2]]
            + m[f + _F_BEND] * _sum_of_taps(m, k, plane, bends, n_bends)
        )
        if n_far > 0:
            total += m[f + _F_NEAR] * _sum_of_taps(m, k, plane, near, n_near)
            total += m[f + _F_FAR] * _sum_of_taps(m, k, plane, far, n_far)
        m[EXPECTED + j] = total


@kernel_part
def _sum_of_taps(m, at, plane, first, n):
    """Return the sum of `n` taps of a sample."""
    total = np.int64(0)
    for k in range(n):
        total += m[at + TAP_PLACES[plane, first + k]]
    return total


@kernel_part
def _look_around(m, at, n, plane):
    """Fill `LEAST`, `MOST`, `SUM` and `TWIST` from the core; bring `PREDICTED` to 1/64 quanta."""
    cast = m.dtype.type
    a0, b0 = at + CORE_PLACES[plane, 0], at + CORE_PLACES[plane, 1]
    c0, d0 = at + CORE_PLACES[plane, 2], at + CORE_PLACES[plane, 3]
    for j in range(n):
        a, b, c, d = m[a0 + j], m[b0 + j], m[c0 + j], m[d0 + j]
        m[LEAST + j] = min(min(a, b), min(c, d))
        m[MOST + j] = max(max(a, b), max(c, d))
        first, second = cast(a + b), cast(c + d)
        m[SUM + j] = first + second
        m[TWIST + j] = abs(cast(first - second))
        m[PREDICTED + j] >>= 6


@kernel_part
def store_rows(m, at, row, out, grid, origin, shape):
    """Write lattice rows 2·row and 2·row + 1 (where there is one) to `out`."""
    n_rows, n_cols = shape
    spacing = np.uint64(grid.col_spacing)
    for parity in range(2):
        if 2 * row + parity >= n_rows:
            continue
        to = np.uint64(grid.start + (2 * row + parity) * grid.row_spacing)
        even = at + (_LH if parity else _A)
        odd = at + (_HH if parity else _HL)
        if spacing == _U1:  # all but root blocks: known, it makes a loop of vectors
            for j in range(np.uint64(n_cols >> 1)):
                out[to + _U2 * j] = m[even + j] + origin
                out[to + _U2 * j + _U1] = m[odd + j] + origin
        else:
            for j in range(np.uint64(n_cols >> 1)):
                k = to + _U2 * j * spacing
                out[k] = m[even + j] + origin
                out[k + spacing] = m[odd + j] + origin
        if n_cols & 1:
            last = np.uint64(n_cols >> 1)
            out[to + _U2 * last * spacing] = m[even + last] + origin
