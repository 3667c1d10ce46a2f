"""Code the three planes of a lattice in a wavefront of rows (format-rapid.md, R.5).

HH row t, HL row t - 1 and LH row t - 2 follow each other, then lattice rows 2(t - 2) and the one
below are complete: all that a row needs is still in the fastest caches.
"""

from typing import NamedTuple

import numpy as np

from terrainwave.codec.lattice import HH, HL, LH
from terrainwave.codec.rapid_code import BIT_POS, code_span, note_errors, read_bits, write_bits
from terrainwave.codec.rapid_layout import (
    FEATURE,
    GOAL,
    MAX_TAPS,
    N_FEATURES,
    N_ROWS,
    PAD,
    PLANE,
    ROWS_ABOVE,
    ROWS_BELOW,
    STENCIL,
    VALID,
    place,
)
from terrainwave.codec.rapid_magnitude import (
    expect_hh,
    expect_hl,
    expect_lh,
    fill_contexts,
    round_predictions,
)
from terrainwave.codec.rapid_rows import (
    copy_row,
    corner,
    fill_bends,
    fill_empty,
    keep_latest_rows,
    load_coarse_row,
    look_around_hh,
    look_around_hl,
    look_around_lh,
    predict_hh,
    predict_hl,
    predict_lh,
    start_plane,
    store_rows,
    surround,
)
from terrainwave.coding.jit import inlined_kernel, kernel

_BEND_ROW = place(7, 0, 0)
_LEFT = np.uint64(PAD)
_FIRST = place(0, 0, 0)


class Grid2(NamedTuple):
    """Where the samples of a lattice lie in a flat array."""

    start: int
    row_step: int
    col_step: int


class Known(NamedTuple):
    """How many lattice rows and columns at each side are known before."""

    top: int
    left: int
    bottom: int
    right: int


@kernel
def load_weights(m, stencils, features):
    """Put the weights of a lattice into the workspace."""
    for plane in range(HH, LH + 1):
        for k in range(MAX_TAPS):
            m[STENCIL[plane] + np.uint64(k)] = stencils[plane - 1, k]
    for plane in range(HH, LH + 2):
        for k in range(N_FEATURES):
            m[FEATURE[plane] + np.uint64(k)] = features[plane - 1, k]


@kernel
def code_lattice(
    goal, valid, has_void, out, grid, source, coarse, origin, shape, known, workspace, scale, s
):
    """Encode or decode (`goal` None) a lattice's samples that are not coarse.

    Parameters
    ----------
    goal, valid, out : ndarray, flat
        Heights to approximate, validity, and decoded heights, which hold the known samples and take
        the others; all laid out as `grid` says.
    source : ndarray of int32, flat
        Holds the coarse samples, laid out as `coarse` says.
    origin : int
        What the workspace's heights are less.
    """
    m = workspace.m
    n_rows, n_cols = shape
    n_even, n_odd = (n_rows + 1) >> 1, n_rows >> 1
    n_even_cols, n_odd_cols = (n_cols + 1) >> 1, n_cols >> 1
    base = -3
    for row in range(-3, 3):
        at = corner(row, base)
        load_coarse_row(
            m, at, row, source, coarse.start, coarse.row_step, coarse.col_step, origin, shape, scale
        )
    most = scale.most_range
    fill_bends(m, corner(0, base), n_even_cols, scale.range_shift, most)
    is_thin = min(n_rows, n_cols) == 1
    if is_thin:
        for row in range(-2, 2):
            _fill_empty_planes(m, corner(row, base), n_odd, n_odd_cols)
    if n_odd > 0 and n_odd_cols > 0:
        start_plane(m, corner(0, base), HH, n_odd_cols)
    if n_odd_cols > 0:
        start_plane(m, corner(0, base), HL, n_odd_cols)
    if n_odd > 0:
        start_plane(m, corner(0, base), LH, n_even_cols)
    for t in range(n_even + 2):
        if t - base + ROWS_ABOVE + ROWS_BELOW >= N_ROWS:
            keep_latest_rows(m, t - base - 2, n_even_cols + 2 * PAD)
            base = t - 2
        at = corner(t, base)
        load_coarse_row(
            m, corner(t + 3, base), t + 3, source, coarse.start, coarse.row_step, coarse.col_step,
            origin, shape, scale,
        )  # fmt: skip
        if t + 1 < n_even:
            fill_bends(m, corner(t + 1, base), n_even_cols, scale.range_shift, most)
        elif t + 1 == n_even:
            bends = at + _BEND_ROW - _LEFT
            copy_row(m, bends, corner(t + 1, base) + _BEND_ROW - _LEFT, n_even_cols + 2 * PAD)
        if is_thin:
            _fill_empty_planes(m, corner(t + 2, base), n_odd, n_odd_cols)
        for plane in range(HH, LH + 1):
            i = t + HH - plane
            n_own_rows = n_even if plane == HL else n_odd
            n = n_even_cols if plane == LH else n_odd_cols
            if i < 0 or i >= n_own_rows or n == 0:
                continue
            at = corner(i, base)
            if plane == HH:
                predict_hh(m, at, n)
                look_around_hh(m, at, n)
                expect_hh(m, at, n, scale)
            elif plane == HL:
                predict_hl(m, at, n)
                look_around_hl(m, at, n)
                expect_hl(m, at, n, scale)
            else:
                predict_lh(m, at, n)
                look_around_lh(m, at, n)
                expect_lh(m, at, n, scale)
            _finish_row(
                goal, valid, has_void, out, grid, origin, plane, at, i, n_own_rows, n, shape,
                known, workspace, scale, s,
            )  # fmt: skip
        i = t - 2
        if 0 <= i < n_even:
            at = corner(i, base)
            store_rows(m, at, i, out, grid.start, grid.row_step, grid.col_step, origin, shape)


@kernel
def code_corners(goal, valid, has_void, out, grid, shape, origin, n_bits, scale, s):
    """Encode or decode a lattice of samples that nothing predicts, on a grid of steps from `low`.

    Each takes `n_bits` raw bits; void ones none, and the middle of the range of heights.
    """
    for row in range(shape[0]):
        for col in range(shape[1]):
            k = grid.start + row * grid.row_step + col * grid.col_step
            if has_void and not valid[k]:
                out[k] = ((scale.low + scale.high) >> 1) + origin
                continue
            bit_pos = min(s.places[BIT_POS], s.n_bits)
            if goal is None:
                index = read_bits(s.raw, bit_pos, n_bits)
            else:
                index = (np.int64(goal[k]) - origin - scale.low) // scale.step
                write_bits(s.raw, bit_pos, index)
            s.places[BIT_POS] += n_bits
            height = scale.low + index * scale.step + (scale.step >> 1)
            out[k] = min(height, scale.high) + origin


@inlined_kernel
def _fill_empty_planes(m, at, n_odd, n_odd_cols):
    """Fill the planes without samples that others read, in lattices of one row or column."""
    if n_odd == 0 or n_odd_cols == 0:
        fill_empty(m, at, HH, max(n_odd_cols, 1))
    if n_odd_cols == 0:
        fill_empty(m, at, HL, 1)


@kernel
def _finish_row(
    goal, valid, has_void, out, grid, origin, plane, at, row, n_rows, n, shape,
    known, workspace, scale, s,
):  # fmt: skip
    """Code a row of a plane that has been predicted, and make it readable around."""
    m = workspace.m
    round_predictions(m, n, scale)
    fill_contexts(m, workspace.reals, workspace.bits_of_reals, n, scale)
    own = at + np.uint64(plane * PLANE) + _FIRST
    col = 0 if plane == LH else 1
    lattice_row = 2 * row + (0 if plane == HL else 1)
    first, stop = (
        (known.left + 1 - col) >> 1,
        n - ((known.right + 1 - ((shape[1] - 1 - col) & 1)) >> 1),
    )
    if lattice_row < known.top or lattice_row >= shape[0] - known.bottom:
        first = stop = n
    start = grid.start + lattice_row * grid.row_step + col * grid.col_step
    step = np.uint64(2 * grid.col_step)
    if first > 0 or stop < n:
        _load_known(m, own, out, start, step, origin, 0, min(first, n), scale)
        _load_known(m, own, out, start, step, origin, max(stop, first), n, scale)
    if goal is not None:
        for j in range(first, stop):
            height = np.int64(goal[np.uint64(start) + np.uint64(j) * step])
            m[GOAL + np.uint64(j)] = height - origin
    if has_void:
        for j in range(first, stop):
            m[VALID + np.uint64(j)] = valid[np.uint64(start) + np.uint64(j) * step]
    code_span(goal, m, first, stop, own, has_void, scale, s)
    note_errors(m, n, own, scale)
    surround(m, own, row, n_rows, n)


@kernel
def _load_known(m, own, out, start, step, origin, first, stop, scale):
    """Take known samples of a row from `out`."""
    cast = m.dtype.type
    for j in range(first, stop):
        height = np.int64(out[np.uint64(start) + np.uint64(j) * step]) - origin
        m[own + np.uint64(j)] = cast(min(max(height, scale.low), scale.high))
