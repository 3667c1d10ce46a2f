"""Rows of the planes of a lattice: filled, predicted, made readable (format-rapid.md, R.5, R.6).

`at` is the corner of a row's neighbourhood in the workspace `m` (`rapid_layout`): the row's own
samples are ``at + place(plane, 0, column)``. Heights are less than the unit's origin.
"""

import numpy as np

from terrainwave.codec.lattice import HH, HL, LH, A, reflect
from terrainwave.codec.rapid_layout import (
    BENDS,
    CORE_HH,
    CORE_HL,
    CORE_LH,
    ERRORS,
    LEAST,
    MOST,
    PLANE,
    PREDICTED,
    ROWS_ABOVE,
    ROWS_BELOW,
    STENCIL,
    STRIDE,
    SUM,
    TAPS_HH,
    TAPS_HL,
    TAPS_LH,
    TWIST,
    place,
)
from terrainwave.coding.jit import inlined_kernel, kernel

_A, _BENDS = place(A, 0, 0), place(BENDS, 0, 0)
_HH, _HL, _LH = place(HH, 0, 0), place(HL, 0, 0), place(LH, 0, 0)
_U1, _U2, _U3, _U4 = (np.uint64(k) for k in (1, 2, 3, 4))
_STRIDE = np.uint64(STRIDE)
_TO_ERRORS = np.uint64(ERRORS * PLANE)
# The row of LH is two behind; its neighbourhood is as high as any.
_KEPT_ROWS = 2 + ROWS_ABOVE + 1 + ROWS_BELOW


@inlined_kernel
def corner(row, base):
    """Return the corner of the neighbourhood of a plane's row."""
    return np.uint64(row - base) * _STRIDE


@kernel
def keep_latest_rows(m, first, n_cols):
    """Move the rows that are still needed, from slot `first` on, to the front of each plane."""
    for plane in range(8):
        for row in range(_KEPT_ROWS):
            to = np.uint64(plane * PLANE + row * STRIDE)
            source = to + np.uint64(first * STRIDE)
            for col in range(n_cols):
                m[to + np.uint64(col)] = m[source + np.uint64(col)]


@kernel
def load_coarse_row(m, at, row, source, start, row_step, col_step, origin, shape, scale):
    """Fill a row of plane A with what lies around it, mirrored where the lattice ends."""
    n_rows, n_cols = shape
    n = (n_cols + 1) >> 1
    cast = m.dtype.type
    first = np.uint64(start + (reflect(2 * row, n_rows) >> 1) * row_step)
    to, step = at + _A, np.uint64(col_step)
    low, high = cast(scale.low), cast(scale.high)
    for j in range(n):
        height = cast(np.int64(source[first + np.uint64(j) * step]) - origin)
        m[to + np.uint64(j)] = min(max(height, low), high)
    for k in range(1, 4):
        m[to - np.uint64(k)] = m[to + np.uint64(reflect(-2 * k, n_cols) >> 1)]
        right = n - 1 + k
        m[to + np.uint64(right)] = m[to + np.uint64(reflect(2 * right, n_cols) >> 1)]


@kernel
def fill_bends(m, at, n, shift, most):
    """Fill a row of curvatures of plane A: fourth differences along the row plus the column."""
    cast = m.dtype.type
    for j in range(n):
        k = at + np.uint64(j)
        middle = cast(6 * m[k + _A])
        across = cast(
            m[k + _A - _U2] + m[k + _A + _U2] - 4 * (m[k + _A - _U1] + m[k + _A + _U1]) + middle
        )
        m[k + _BENDS] = abs(across)
    for j in range(n):
        k = at + np.uint64(j)
        middle = cast(6 * m[k + _A])
        along = cast(
            m[k + _A - _U2 * _STRIDE]
            + m[k + _A + _U2 * _STRIDE]
            - 4 * (m[k + _A - _STRIDE] + m[k + _A + _STRIDE])
            + middle
        )
        m[k + _BENDS] = min(cast(cast(m[k + _BENDS] + abs(along)) >> shift), cast(most))
    m[at + _BENDS + np.uint64(n)] = m[at + _BENDS + np.uint64(n - 1)]


@inlined_kernel
def copy_row(m, source, to, n):
    """Copy `n` samples."""
    for j in range(n):
        m[to + np.uint64(j)] = m[source + np.uint64(j)]


@inlined_kernel
def widen_row(m, start, n):
    """Repeat the first and the last sample of a row three times beside it."""
    first, last = m[start], m[start + np.uint64(n - 1)]
    for k in range(1, 4):
        m[start - np.uint64(k)] = first
        m[start + np.uint64(n - 1 + k)] = last


@kernel
def surround(m, own, row, n_rows, n):
    """Make a coded row, and the errors of its predictions, readable beside it, above and below."""
    widen_row(m, own, n)
    widen_row(m, own + _TO_ERRORS, n)
    left = own - _U4
    if row == 0:
        for k in range(1, 4):
            copy_row(m, left, left - np.uint64(k) * _STRIDE, n + 8)
            copy_row(m, left + _TO_ERRORS, left + _TO_ERRORS - np.uint64(k) * _STRIDE, n + 8)
    if row == n_rows - 1:
        for k in range(1, 3):
            copy_row(m, left, left + np.uint64(k) * _STRIDE, n + 8)
            copy_row(m, left + _TO_ERRORS, left + _TO_ERRORS + np.uint64(k) * _STRIDE, n + 8)


@kernel
def fill_between(m, at, to, plane, n):
    """Fill a row from place `to` on with means of the coarse samples around a row of a plane."""
    cast = m.dtype.type
    for j in range(n):
        k = at + np.uint64(j) + _A
        here, east = np.int64(m[k]), np.int64(m[k + _U1])
        south, south_east = np.int64(m[k + _STRIDE]), np.int64(m[k + _STRIDE + _U1])
        if plane == HH:
            mean = (here + east + south + south_east + 2) >> 2
        elif plane == HL:
            mean = (here + east + 1) >> 1
        else:
            mean = (here + south + 1) >> 1
        m[to + np.uint64(j)] = cast(mean)
    widen_row(m, to, n)


@kernel
def start_plane(m, at, plane, n):
    """Fill what is above a plane's first row: heights as means of coarse ones, errors of 0."""
    own = at + np.uint64(plane * PLANE) + _A
    fill_between(m, at, own - _STRIDE, plane, n)
    for k in range(1, 3):
        clear_row(m, own + _TO_ERRORS - np.uint64(k) * _STRIDE - _U4, n + 8)


@inlined_kernel
def clear_row(m, start, n):
    """Set `n` samples to 0."""
    for j in range(n):
        m[start + np.uint64(j)] = 0


@kernel
def fill_empty(m, at, plane, n):
    """Fill a row of a plane without samples of its own, and its errors, for those who read it."""
    own = at + np.uint64(plane * PLANE) + _A
    fill_between(m, at, own, plane, n)
    clear_row(m, own + _TO_ERRORS - _U4, n + 8)


@kernel
def predict_hh(m, at, n):
    """Fill `PREDICTED` with the stencil's predictions of a row of HH, in 1/64 quanta."""
    cast, w, t = m.dtype.type, STENCIL[HH], TAPS_HH
    w0, w1, w2, w3, w4 = m[w], m[w + _U1], m[w + _U2], m[w + _U3], m[w + _U4]
    w += np.uint64(5)
    w5, w6, w7, w8, w9 = m[w], m[w + _U1], m[w + _U2], m[w + _U3], m[w + _U4]
    w += np.uint64(5)
    w10, w11, w12, w13, w14 = m[w], m[w + _U1], m[w + _U2], m[w + _U3], m[w + _U4]
    w += np.uint64(5)
    w15, w16, w17, w18 = m[w], m[w + _U1], m[w + _U2], m[w + _U3]
    for j in range(n):
        k = at + np.uint64(j)
        total = cast(
            w0 * m[k + t[0]] + w1 * m[k + t[1]] + w2 * m[k + t[2]] + w3 * m[k + t[3]]
            + w4 * m[k + t[4]] + w5 * m[k + t[5]] + w6 * m[k + t[6]] + w7 * m[k + t[7]]
            + w8 * m[k + t[8]] + w9 * m[k + t[9]] + w10 * m[k + t[10]] + w11 * m[k + t[11]]
            + w12 * m[k + t[12]] + w13 * m[k + t[13]] + w14 * m[k + t[14]] + w15 * m[k + t[15]]
            + w16 * m[k + t[16]] + w17 * m[k + t[17]] + w18 * m[k + t[18]] + 32
        )  # fmt: skip
        m[PREDICTED + np.uint64(j)] = cast(total >> 6)


@kernel
def predict_hl(m, at, n):
    """Fill `PREDICTED` with the stencil's predictions of a row of HL, in 1/64 quanta."""
    cast, w, t = m.dtype.type, STENCIL[HL], TAPS_HL
    w0, w1, w2, w3, w4 = m[w], m[w + _U1], m[w + _U2], m[w + _U3], m[w + _U4]
    w += np.uint64(5)
    w5, w6, w7, w8, w9 = m[w], m[w + _U1], m[w + _U2], m[w + _U3], m[w + _U4]
    w += np.uint64(5)
    w10, w11, w12, w13, w14 = m[w], m[w + _U1], m[w + _U2], m[w + _U3], m[w + _U4]
    w += np.uint64(5)
    w15, w16, w17, w18 = m[w], m[w + _U1], m[w + _U2], m[w + _U3]
    for j in range(n):
        k = at + np.uint64(j)
        total = cast(
            w0 * m[k + t[0]] + w1 * m[k + t[1]] + w2 * m[k + t[2]] + w3 * m[k + t[3]]
            + w4 * m[k + t[4]] + w5 * m[k + t[5]] + w6 * m[k + t[6]] + w7 * m[k + t[7]]
            + w8 * m[k + t[8]] + w9 * m[k + t[9]] + w10 * m[k + t[10]] + w11 * m[k + t[11]]
            + w12 * m[k + t[12]] + w13 * m[k + t[13]] + w14 * m[k + t[14]] + w15 * m[k + t[15]]
            + w16 * m[k + t[16]] + w17 * m[k + t[17]] + w18 * m[k + t[18]] + 32
        )  # fmt: skip
        m[PREDICTED + np.uint64(j)] = cast(total >> 6)


@kernel
def predict_lh(m, at, n):
    """Fill `PREDICTED` with the stencil's predictions of a row of LH, in 1/64 quanta."""
    cast, w, t = m.dtype.type, STENCIL[LH], TAPS_LH
    w0, w1, w2, w3, w4 = m[w], m[w + _U1], m[w + _U2], m[w + _U3], m[w + _U4]
    w += np.uint64(5)
    w5, w6, w7, w8, w9 = m[w], m[w + _U1], m[w + _U2], m[w + _U3], m[w + _U4]
    w10 = m[w + np.uint64(5)]
    # In two turns, so that the weights stay in registers.
    for j in range(n):
        k = at + np.uint64(j)
        m[PREDICTED + np.uint64(j)] = cast(
            w0 * m[k + t[0]] + w1 * m[k + t[1]] + w2 * m[k + t[2]] + w3 * m[k + t[3]]
            + w4 * m[k + t[4]] + w5 * m[k + t[5]] + w6 * m[k + t[6]] + w7 * m[k + t[7]]
            + w8 * m[k + t[8]] + w9 * m[k + t[9]] + w10 * m[k + t[10]] + 32
        )  # fmt: skip
    w += np.uint64(6)
    w11, w12, w13, w14 = m[w], m[w + _U1], m[w + _U2], m[w + _U3]
    w += np.uint64(4)
    w15, w16, w17, w18 = m[w], m[w + _U1], m[w + _U2], m[w + _U3]
    w += np.uint64(4)
    w19, w20, w21, w22 = m[w], m[w + _U1], m[w + _U2], m[w + _U3]
    for j in range(n):
        k = at + np.uint64(j)
        total = cast(
            m[PREDICTED + np.uint64(j)]
            + w11 * m[k + t[11]] + w12 * m[k + t[12]] + w13 * m[k + t[13]] + w14 * m[k + t[14]]
            + w15 * m[k + t[15]] + w16 * m[k + t[16]] + w17 * m[k + t[17]] + w18 * m[k + t[18]]
            + w19 * m[k + t[19]] + w20 * m[k + t[20]] + w21 * m[k + t[21]] + w22 * m[k + t[22]]
        )  # fmt: skip
        m[PREDICTED + np.uint64(j)] = cast(total >> 6)


@kernel
def _look_around(m, at, n, core):
    """Fill `LEAST`, `MOST` and `SUM` from the four samples of the core."""
    cast = m.dtype.type
    for j in range(n):
        k, to = at + np.uint64(j), np.uint64(j)
        a, b, c, d = m[k + core[0]], m[k + core[1]], m[k + core[2]], m[k + core[3]]
        m[to + LEAST] = min(min(a, b), min(c, d))
    for j in range(n):
        k, to = at + np.uint64(j), np.uint64(j)
        a, b, c, d = m[k + core[0]], m[k + core[1]], m[k + core[2]], m[k + core[3]]
        m[to + MOST] = max(max(a, b), max(c, d))
    for j in range(n):
        k, to = at + np.uint64(j), np.uint64(j)
        m[to + SUM] = cast(m[k + core[0]] + m[k + core[1]] + m[k + core[2]] + m[k + core[3]])


@kernel
def look_around_hh(m, at, n):
    """Fill `LEAST`, `MOST`, `SUM` and `TWIST` of a row of HH."""
    cast, core = m.dtype.type, CORE_HH
    _look_around(m, at, n, core)
    for j in range(n):
        k = at + np.uint64(j)
        difference = m[k + core[0]] - m[k + core[1]] - m[k + core[2]] + m[k + core[3]]
        m[np.uint64(j) + TWIST] = abs(cast(difference))


@kernel
def look_around_hl(m, at, n):
    """Fill `LEAST`, `MOST`, `SUM` and `TWIST` of a row of HL."""
    cast, core = m.dtype.type, CORE_HL
    _look_around(m, at, n, core)
    for j in range(n):
        k = at + np.uint64(j)
        difference = m[k + core[0]] + m[k + core[1]] - m[k + core[2]] - m[k + core[3]]
        m[np.uint64(j) + TWIST] = abs(cast(difference))


@kernel
def look_around_lh(m, at, n):
    """Fill `LEAST`, `MOST`, `SUM` and `TWIST` of a row of LH."""
    cast, core = m.dtype.type, CORE_LH
    _look_around(m, at, n, core)
    for j in range(n):
        k = at + np.uint64(j)
        difference = m[k + core[0]] + m[k + core[1]] - m[k + core[2]] - m[k + core[3]]
        m[np.uint64(j) + TWIST] = abs(cast(difference))


@kernel
def store_rows(m, at, row, out, start, row_step, col_step, origin, shape):
    """Write lattice rows 2·row and 2·row + 1 (where there is one) to `out`."""
    n_rows, n_cols = shape
    for parity in range(2):
        if 2 * row + parity >= n_rows:
            continue
        to = np.uint64(start + (2 * row + parity) * row_step)
        even = at + (_LH if parity else _A)
        odd = at + (_HH if parity else _HL)
        step = np.uint64(col_step)
        for j in range(n_cols >> 1):
            k = to + np.uint64(2 * j) * step
            out[k] = m[even + np.uint64(j)] + origin
            out[k + step] = m[odd + np.uint64(j)] + origin
        if n_cols & 1:
            out[to + np.uint64(n_cols - 1) * step] = m[even + np.uint64(n_cols >> 1)] + origin
