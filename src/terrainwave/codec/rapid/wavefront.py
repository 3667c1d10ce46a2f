"""Code the rows of a unit: shared lines, then a lattice in a wavefront (format-rapid.md, R.3, R.5).

HH row t, HL row t - 1 and LH row t - 2 follow each other, then lattice rows 2(t - 2) and the one
below are complete: all that a row needs is still in the fastest caches.
"""

from typing import NamedTuple

import numpy as np

from terrainwave.codec.corrections import corrected
from terrainwave.codec.planes import HH, HL, LH
from terrainwave.codec.rapid.layout import (
    GOAL,
    N_ROWS,
    ON_LINE,
    PAD,
    PLANE,
    RESULT,
    ROWS_ABOVE,
    ROWS_BELOW,
    STRIDE,
    VALID,
    WEIGHTS,
    place,
)
from terrainwave.codec.rapid.line_coder import MOST_CORNERS, prepare_shared
from terrainwave.codec.rapid.magnitude import fill_contexts
from terrainwave.codec.rapid.rows import (
    copy_row,
    fill_bends,
    fill_means,
    keep_latest_rows,
    load_coarse_row,
    predict_row,
    store_rows,
    surround,
)
from terrainwave.codec.rapid.symbols import code_details, note_errors
from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.jit import kernel, kernel_part

_A, _BEND_ROW = place(0, 0, 0), place(7, 0, 0)
_STRIDE = np.uint64(STRIDE)
_LEFT, _BOTH = np.uint64(PAD), np.uint64(2 * PAD)
_FIRST_LOADED = -3  # row of plane A that the first rows read
# Rows of HH, HL and LH are coded in turns; so many turns before the first one, rows are loaded, and
# after the last one, rows are stored.
_TURNS_BEFORE, _TURNS_AFTER = 6, 3


class Lattice(NamedTuple):
    """Where the samples of a lattice lie in a flat array."""

    start: int
    row_spacing: int
    col_spacing: int


class Known(NamedTuple):
    """How many lattice rows and columns at each side are known before."""

    top: int
    left: int
    bottom: int
    right: int


@kernel
def code_rows(
    is_encoding, has_void, goal, valid, out, source, corners, lines, finest, coarse_of_finest, core,
    stride, weights, known, origin, workspace, scale, s, kept, added, n_wanted,
):  # fmt: skip
    """Encode or decode shared samples, then a lattice's samples that are not coarse.

    And those of finer lattices one after the other, down to the finest.

    Parameters
    ----------
    goal, valid, out : ndarray, flat
        Heights to approximate when encoding, validity where `has_void`, and decoded heights, which
        take what is coded, the shared samples first; the finest lattice is laid out as `finest`
        says.
    source : ndarray of int32, flat
        Holds the coarse samples, those of the finest lattice laid out as `coarse_of_finest` says.
    corners, lines : ndarray of int64
        What is shared, as `plan_lines` returns it.
    core
        Rows and columns of the finest lattice.
    stride : int
        Of the first lattice, a power of two: it has each so many of the finest one's samples.
    weights : ndarray of int64, shape (n, n_weights)
        `arranged_weights` of each lattice.
    known
        Of each lattice.
    origin : int
        What the workspace's heights are less.
    kept, added : ndarray of int32, flat
        `Corrections`: both empty where there are none.
    n_wanted : int
        Rows of each lattice that are enough, from the first on.

    Notes
    -----
    One loop over rows of all kinds, so that each part of the work is compiled once.
    """
    goal, valid, out, source = borrowed((goal, valid, out, source))
    corners, lines, weights = borrowed((corners, lines, weights))
    workspace, s = borrowed((workspace, s))
    kept, added = borrowed((kept, added))
    m = workspace.m
    first_weight = WEIGHTS[HH]
    for lattice in range(weights.shape[0]):
        for k in range(np.uint64(weights.shape[1])):
            m[first_weight + k] = weights[lattice, k]
        shape = (core[0] - 1) // stride + 1, (core[1] - 1) // stride + 1
        grid, coarse = _each(finest, stride), _each(coarse_of_finest, stride)
        stride >>= 1
        n_rows, n_cols = shape
        n_corner_rows = (corners.shape[0] + MOST_CORNERS - 1) // MOST_CORNERS
        n_before = n_corner_rows + 2 * lines.shape[0]
        n_turns = ((min(n_rows, n_wanted) + 1) >> 1) + _TURNS_BEFORE + _TURNS_AFTER
        base = np.int64(_FIRST_LOADED)
        for index in range(n_before + 3 * n_turns):
            is_lattice, is_corner = index >= n_before, index < n_corner_rows
            t = (index - n_before) // 3 - _TURNS_BEFORE
            plane = HH + (index - n_before) % 3 if is_lattice else ON_LINE
            row = t + HH - plane
            n_own_rows = (n_rows + 1) >> 1 if plane == HL else n_rows >> 1
            col, lattice_row = np.int64(plane != LH), 2 * row + np.int64(plane != HL)
            if is_lattice:
                if plane == HH:
                    base = advance(m, t, base, out, source, grid, coarse, shape, origin, scale)
                if row < 0 or row >= n_own_rows:
                    continue
                start = grid.start + lattice_row * grid.row_spacing + col * grid.col_spacing
                spacing, stop = 2 * grid.col_spacing, (n_cols + 1 - col) >> 1
            else:
                start, spacing, stop = prepare_shared(
                    m, out, source, corners, lines, index, origin, scale
                )
            if stop <= 0:
                continue
            n, first, own = np.uint64(stop), np.int64(0), RESULT
            if is_lattice:
                at = np.uint64(row - base) * _STRIDE
                predict_row(m, at, n, plane)
                own = at + np.uint64(plane * PLANE) + _A
                first = min((known.left + 1 - col) >> 1, stop)
                stop = max(stop - ((known.right + 1 - ((n_cols - 1 - col) & 1)) >> 1), first)
                if lattice_row < known.top or lattice_row >= n_rows - known.bottom:
                    first = stop = np.int64(n)
                _load_known(m, own, out, start, spacing, origin, first, stop, np.int64(n), scale)
            fill_contexts(m, workspace.reals, workspace.bits_of_reals, n, plane, scale)
            is_void_there = has_void
            if is_corner:
                _take_corners(m, goal, valid, corners, start, stop, origin, is_encoding, has_void)
            elif is_encoding or has_void:
                _take_row(
                    m, goal, valid, start, spacing, first, stop, origin, is_encoding, has_void
                )
                is_void_there = has_void and _has_void(m, first, stop)
            if stop > first:
                n_coded = np.uint64(stop - first)
                code_details(
                    m, np.uint64(first), n_coded, own, is_encoding, is_void_there, scale, s
                )
                if added.shape[0] > 0:
                    _correct(
                        m, own, kept, added, corners, is_corner, start, spacing, first, stop,
                        origin, scale,
                    )  # fmt: skip
            if is_lattice:
                make_readable(m, own, row, n_own_rows, n)
            else:
                _store_shared(m, out, corners, is_corner, start, spacing, stop, origin)


@kernel_part
def _each(grid, stride):
    """Return where each `stride`-th sample of a lattice lies."""
    return Lattice(grid.start, grid.row_spacing * stride, grid.col_spacing * stride)


@kernel
def advance(m, t, base, out, source, grid, coarse, shape, origin, scale):
    """Store what is complete and load what row `t` of HH needs; return the new `base`."""
    n_rows, n_cols = shape
    n_even, n_even_cols = (n_rows + 1) >> 1, np.uint64((n_cols + 1) >> 1)
    stored = t - _TURNS_AFTER
    if 0 <= stored < n_even:
        store_rows(m, np.uint64(stored - base) * _STRIDE, stored, out, grid, origin, shape)
    if t - base + ROWS_ABOVE + ROWS_BELOW >= N_ROWS:
        keep_latest_rows(m, t - base - 2, n_even_cols + _BOTH)
        base = t - 2
    if t < n_even + 2:
        to = np.uint64(t + 3 - base) * _STRIDE + _A
        load_coarse_row(m, to, t + 3, source, coarse, origin, shape, scale)
    if t >= -1:
        here = np.uint64(t - base) * _STRIDE
        if t + 1 < n_even:
            fill_bends(m, here + _STRIDE, n_even_cols, scale.most_range)
        elif t + 1 == n_even:
            bends = here + _BEND_ROW - _LEFT
            copy_row(m, bends, bends + _STRIDE, n_even_cols + _BOTH)
    if t == -1 or (min(n_rows, n_cols) == 1 and t >= -4):
        for plane in range(HH, LH + 1):
            # Planes without samples are filled for those who read them; of others the row above.
            is_empty = (n_rows == 1 and plane != HL) or (n_cols == 1 and plane != LH)
            n = n_even_cols if plane == LH else np.uint64(max(n_cols >> 1, 1))
            if is_empty or t == -1:
                from_row, to_row = (t + 2, t + 2) if is_empty else (0, -1)
                to = np.uint64(to_row - base) * _STRIDE + np.uint64(plane * PLANE) + _A
                fill_means(m, np.uint64(from_row - base) * _STRIDE, to, plane, n)
    return base


@kernel
def make_readable(m, own, row, n_rows, n):
    """Note the errors of a row that has been coded; make it readable around."""
    note_errors(m, n, own)
    surround(m, own, row, n_rows, n)


@kernel
def _correct(m, own, kept, added, corners, is_corner, start, spacing, first, stop, origin, scale):
    """Put coded samples `first` … ``stop - 1`` of a row back; an encoder finds what that takes."""
    cast = m.dtype.type
    is_encoding = kept.shape[0] > 0
    limits = np.int64(scale.low) + origin, np.int64(scale.high) + origin
    for j in range(first, stop):
        k = np.uint64(corners[start + j, 0] if is_corner else start + j * spacing)
        if added[k] == 0 and not is_encoding:
            continue  # nearly all, in nearly all units
        at = own + np.uint64(j)
        height = corrected(np.int64(m[at]) + origin, kept, added, k, limits, limits)
        m[at] = cast(height - origin)


@kernel_part
def _store_shared(m, out, corners, is_corner, start, spacing, n, origin):
    """Store a row of shared samples, which `RESULT` holds."""
    for j in range(n):
        k = np.uint64(corners[start + j, 0] if is_corner else start + j * spacing)
        out[k] = m[RESULT + np.uint64(j)] + origin


@kernel_part
def _take_corners(m, goal, valid, corners, start, n, origin, is_encoding, has_void):
    """Fill `GOAL` and `VALID` of a row of corner samples, as far as they are needed."""
    for j in range(n):
        k = np.uint64(corners[start + j, 0])
        if is_encoding:
            m[GOAL + np.uint64(j)] = np.int64(goal[k]) - origin
        if has_void:
            m[VALID + np.uint64(j)] = valid[k]


@kernel_part
def _take_row(m, goal, valid, start, spacing, first, stop, origin, is_encoding, has_void):
    """Fill `GOAL` and `VALID` of any other row, each in a loop of its own, which is faster."""
    if is_encoding:
        for j in range(first, stop):
            m[GOAL + np.uint64(j)] = np.int64(goal[np.uint64(start + j * spacing)]) - origin
    if has_void:
        if spacing == 2:  # rows of all but root blocks: known, it makes a loop of vectors
            for j in range(np.uint64(first), np.uint64(stop)):
                m[VALID + j] = valid[np.uint64(start) + j * np.uint64(2)]
        else:
            for j in range(first, stop):
                m[VALID + np.uint64(j)] = valid[np.uint64(start + j * spacing)]


@kernel_part
def _has_void(m, first, stop):
    """Return whether a sample `first` … ``stop - 1`` of a row is void, as `VALID` has it."""
    least = m.dtype.type(1)
    for j in range(np.uint64(first), np.uint64(stop)):
        least = min(least, m[VALID + j])
    return least == 0


@kernel_part
def _load_known(m, own, out, start, spacing, origin, first, stop, n, scale):
    """Take known samples of a row, all but `first` … ``stop - 1``, from `out`."""
    cast = m.dtype.type
    for k in range(first + n - stop):
        j = k if k < first else k - first + stop
        height = np.int64(out[np.uint64(start + j * spacing)]) - origin
        m[own + np.uint64(j)] = cast(min(max(height, scale.low), scale.high))
