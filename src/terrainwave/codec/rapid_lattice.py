"""Code the rows of a unit: shared lines, then a lattice in a wavefront (format-rapid.md, R.3, R.5).

HH row t, HL row t - 1 and LH row t - 2 follow each other, then lattice rows 2(t - 2) and the one
below are complete: all that a row needs is still in the fastest caches.
"""

from typing import NamedTuple

import numpy as np

from terrainwave.codec.lattice import HH, HL, LH
from terrainwave.codec.rapid_border import (
    MOST_CORNERS,
    START,
    STEP,
    prepare_corners,
    prepare_even,
    prepare_odd,
)
from terrainwave.codec.rapid_code import (
    BIT_POS,
    code_raw,
    fill_heights,
    log_symbols,
    needs_raw,
    note_errors,
    quantize,
    read_bits,
    read_symbols,
    write_bits,
)
from terrainwave.codec.rapid_layout import (
    GOAL,
    N_ROWS,
    ON_LINE,
    PAD,
    PLANE,
    RESULT,
    ROWS_ABOVE,
    ROWS_BELOW,
    VALID,
    place,
)
from terrainwave.codec.rapid_magnitude import expect, fill_contexts, round_predictions
from terrainwave.codec.rapid_rows import (
    copy_row,
    corner,
    fill_bends,
    fill_means,
    keep_latest_rows,
    load_coarse_row,
    look_around,
    store_rows,
    surround,
    weigh_taps,
)
from terrainwave.coding.jit import kernel, kernel_part

_A, _BEND_ROW = place(0, 0, 0), place(7, 0, 0)
_LEFT, _BOTH = np.uint64(PAD), np.uint64(2 * PAD)
_FIRST_LOADED = -3  # row of plane A that the first rows read
# Rows of HH, HL and LH are coded in turns; so many turns before the first one, rows are loaded, and
# after the last one, rows are stored.
_TURNS_BEFORE, _TURNS_AFTER = 6, 3


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
def code_rows(
    is_encoding, has_void, goal, valid, out, source, corners, lines, grid, coarse, shape, known,
    origin, workspace, scale, s,
):  # fmt: skip
    """Encode or decode shared samples, then a lattice's samples that are not coarse.

    Parameters
    ----------
    goal, valid, out : ndarray, flat
        Heights to approximate when encoding, validity where `has_void`, and decoded heights, which
        take what is coded, the shared samples first; laid out as `grid` says.
    source : ndarray of int32, flat
        Holds the coarse samples, laid out as `coarse` says.
    corners, lines : ndarray of int64
        What is shared, as `plan_lines` returns it.
    shape, known
        Of the lattice.
    origin : int
        What the workspace's heights are less.

    Notes
    -----
    One loop over rows of all kinds, so that each part of the work is compiled once.
    """
    m, reals, bits_of_reals = workspace
    places, slots, words, n_words, states = s.places, s.slots, s.words, s.n_words, s.states
    n_states, raw, n_bits, freqs = s.n_states, s.raw, s.n_bits, s.freqs
    contexts_log, symbols_log = s.contexts_log, s.symbols_log
    n_rows, n_cols = shape
    n_corner_rows = (corners.shape[0] + MOST_CORNERS - 1) // MOST_CORNERS
    n_before = n_corner_rows + 2 * lines.shape[0]
    n_turns = ((n_rows + 1) >> 1) + _TURNS_BEFORE + _TURNS_AFTER
    base = np.int64(_FIRST_LOADED)
    for index in range(n_before + 3 * n_turns):
        t = np.int64(0)
        plane, row, n_own_rows = np.int64(ON_LINE), np.int64(0), np.int64(0)
        start, step, first = np.int64(0), np.int64(1), np.int64(0)
        col, lattice_row = np.int64(0), np.int64(0)
        own, is_corner = RESULT, index < n_corner_rows
        if is_corner:
            start = index * MOST_CORNERS
            stop = prepare_corners(m, source, corners, start, origin, scale)
        elif index < n_before:
            line = (index - n_corner_rows) >> 1
            step = 2 * lines[line, STEP]
            if (index - n_corner_rows) & 1:
                skipped, stop = prepare_odd(m, out, lines, line, origin, scale)
                start = lines[line, START] + skipped * step + lines[line, STEP]
            else:
                skipped, stop = prepare_even(m, out, source, lines, line, origin, scale)
                start = lines[line, START] + skipped * step
        else:
            t, plane = (index - n_before) // 3 - _TURNS_BEFORE, HH + (index - n_before) % 3
            if plane == HH:
                base = _advance(m, t, base, out, source, grid, coarse, shape, origin, scale)
            row = t + HH - plane
            n_own_rows = (n_rows + 1) >> 1 if plane == HL else n_rows >> 1
            col = np.int64(plane != LH)
            stop = (n_cols + 1 - col) >> 1
            if row < 0 or row >= n_own_rows:
                stop = np.int64(0)
            lattice_row = 2 * row + np.int64(plane != HL)
            start = grid.start + lattice_row * grid.row_step + col * grid.col_step
            step = np.int64(2 * grid.col_step)
        if stop <= 0:
            continue
        n = np.uint64(stop)
        if plane != ON_LINE:
            at = corner(row, base)
            weigh_taps(m, at, n, plane)
            look_around(m, at, n, plane)
            own = at + np.uint64(plane * PLANE) + _A
            first = (known.left + 1 - col) >> 1
            stop -= (known.right + 1 - ((n_cols - 1 - col) & 1)) >> 1
            if lattice_row < known.top or lattice_row >= n_rows - known.bottom:
                first = stop = np.int64(n)
            first = min(first, np.int64(n))
            stop = max(stop, first)
            _load_known(m, own, out, start, step, origin, first, stop, np.int64(n), scale)
        expect(m, n, plane, scale)
        round_predictions(m, n, scale)
        fill_contexts(m, reals, bits_of_reals, n, scale)
        if stop > first:
            if is_encoding or has_void:
                for j in range(first, stop):
                    k = np.uint64(corners[start + j, 0] if is_corner else start + j * step)
                    if is_encoding:
                        m[GOAL + np.uint64(j)] = np.int64(goal[k]) - origin
                    if has_void:
                        m[VALID + np.uint64(j)] = valid[k]
            skipped_here, n_here = np.uint64(first), np.uint64(stop - first)
            if is_encoding:
                quantize(m, skipped_here, n_here, has_void, scale)
                log_symbols(
                    m, skipped_here, n_here, has_void, places, freqs, contexts_log, symbols_log
                )
            else:
                read_symbols(
                    m, skipped_here, n_here, has_void, places, slots, words, n_words, states,
                    n_states,
                )  # fmt: skip
            if needs_raw(m, skipped_here, n_here):
                code_raw(
                    m, skipped_here, n_here, is_encoding, has_void, np.int64(scale.most_detail),
                    places, raw, n_bits,
                )  # fmt: skip
            fill_heights(m, skipped_here, n_here, own, scale)
        if plane != ON_LINE:
            note_errors(m, n, own, scale)
            surround(m, own, row, n_own_rows, n)
        else:
            for j in range(stop):
                k = corners[start + j, 0] if is_corner else start + j * step
                out[np.uint64(k)] = m[RESULT + np.uint64(j)] + origin


@kernel_part
def _advance(m, t, base, out, source, grid, coarse, shape, origin, scale):
    """Store what is complete and load what row `t` of HH needs; return the new `base`."""
    n_rows, n_cols = shape
    n_even, n_even_cols = (n_rows + 1) >> 1, np.uint64((n_cols + 1) >> 1)
    if 0 <= t - _TURNS_AFTER < n_even:
        stored = t - _TURNS_AFTER
        store_rows(m, corner(stored, base), stored, out, grid, origin, shape)
    if t - base + ROWS_ABOVE + ROWS_BELOW >= N_ROWS:
        keep_latest_rows(m, t - base - 2, n_even_cols + _BOTH)
        base = t - 2
    if t < n_even + 2:
        load_coarse_row(m, corner(t + 3, base) + _A, t + 3, source, coarse, origin, shape, scale)
    if t >= -1:
        if t + 1 < n_even:
            at = corner(t + 1, base)
            fill_bends(m, at, n_even_cols, scale.range_shift, scale.most_range)
        elif t + 1 == n_even:
            bends = corner(t, base) + _BEND_ROW - _LEFT
            copy_row(m, bends, corner(t + 1, base) + _BEND_ROW - _LEFT, n_even_cols + _BOTH)
    if t == -1 or (min(n_rows, n_cols) == 1 and t >= -4):
        for plane in range(HH, LH + 1):
            # Planes without samples are filled for those who read them; of others the row above.
            is_empty = (n_rows == 1 and plane != HL) or (n_cols == 1 and plane != LH)
            n = n_even_cols if plane == LH else np.uint64(max(n_cols >> 1, 1))
            if is_empty or t == -1:
                from_row, to_row = (t + 2, t + 2) if is_empty else (0, -1)
                to = corner(to_row, base) + np.uint64(plane * PLANE) + _A
                fill_means(m, corner(from_row, base), to, plane, n)
    return base


@kernel_part
def _load_known(m, own, out, start, step, origin, first, stop, n, scale):
    """Take known samples of a row, all but `first` … ``stop - 1``, from `out`."""
    cast = m.dtype.type
    for k in range(first + n - stop):
        j = k if k < first else k - first + stop
        height = np.int64(out[np.uint64(start + j * step)]) - origin
        m[own + np.uint64(j)] = cast(min(max(height, scale.low), scale.high))


@kernel
def code_corners(is_encoding, has_void, goal, valid, out, grid, shape, origin, n_bits, scale, s):
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
            if is_encoding:
                index = (np.int64(goal[k]) - origin - scale.low) // scale.step
                write_bits(s.raw, bit_pos, index)
            else:
                index = read_bits(s.raw, bit_pos, n_bits)
            s.places[BIT_POS] += n_bits
            height = scale.low + index * scale.step + (scale.step >> 1)
            out[k] = min(height, scale.high) + origin
