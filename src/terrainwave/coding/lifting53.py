"""The reversible integer 5/3 wavelet, one level at a time (format-cdf53.md, C.3).

A. R. Calderbank, I. Daubechies, W. Sweldens, B.-L. Yeo, "Wavelet transforms that map integers to
integers" (1998); the (5, 3) filter of D. Le Gall and A. Tabatabai (1988):

    d[i] = x[2i + 1] - floor((x[2i] + x[2i + 2]) / 2)
    s[i] = x[2i] + floor((d[i - 1] + d[i] + 2) / 4)

Signals are mirrored at their ends. An end that is *held* passes unchanged: its s is its x. So the
line on a held side of a field is transformed only along itself, and two fields that share it get
the same result (Zheng, Wang, Wang cut coefficients of the whole raster instead).

Fields are int64. A step at most doubles magnitudes, in each direction.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel

# Held sides of a field.
HELD_TOP, HELD_LEFT, HELD_BOTTOM, HELD_RIGHT = 1, 2, 4, 8


@kernel
def _forward_line(line, spare, holds_first, holds_last):
    """Transform `line` in place: s to its front, d behind it. `spare` is as long."""
    n = line.shape[0]
    if n == 1:
        return
    n_low = (n + 1) >> 1
    for i in range(n):
        spare[i] = line[i]
    for at in range(1, n, 2):
        right = spare[at + 1] if at + 1 < n else spare[at - 1]
        line[n_low + (at >> 1)] = spare[at] - ((spare[at - 1] + right) >> 1)
    for at in range(0, n, 2):
        i = at >> 1
        line[i] = spare[at]
        if (at == 0 and holds_first) or (at == n - 1 and holds_last):
            continue
        left = line[n_low + i - 1] if at > 0 else line[n_low]
        right = line[n_low + i] if at + 1 < n else left
        line[i] += (left + right + 2) >> 2


@kernel
def _inverse_line(line, spare, holds_first, holds_last):
    """Undo `_forward_line`."""
    n = line.shape[0]
    if n == 1:
        return
    n_low = (n + 1) >> 1
    for at in range(0, n, 2):
        i = at >> 1
        spare[at] = line[i]
        if (at == 0 and holds_first) or (at == n - 1 and holds_last):
            continue
        left = line[n_low + i - 1] if at > 0 else line[n_low]
        right = line[n_low + i] if at + 1 < n else left
        spare[at] -= (left + right + 2) >> 2
    for at in range(1, n, 2):
        right = spare[at + 1] if at + 1 < n else spare[at - 1]
        spare[at] = line[n_low + (at >> 1)] + ((spare[at - 1] + right) >> 1)
    for i in range(n):
        line[i] = spare[i]


@kernel
def _forward_columns(field, spare, holds_first, holds_last):
    """Transform all columns as `_forward_line` does, a row at a time."""
    n, n_cols = field.shape
    if n == 1:
        return
    n_low = (n + 1) >> 1
    for row in range(n):
        for col in range(n_cols):
            spare[row, col] = field[row, col]
    for at in range(1, n, 2):
        below = at + 1 if at + 1 < n else at - 1
        for col in range(n_cols):
            mean = (spare[at - 1, col] + spare[below, col]) >> 1
            field[n_low + (at >> 1), col] = spare[at, col] - mean
    for at in range(0, n, 2):
        i = at >> 1
        is_held = (at == 0 and holds_first) or (at == n - 1 and holds_last)
        above = n_low + i - 1 if at > 0 else n_low
        below = n_low + i if at + 1 < n else above
        for col in range(n_cols):
            field[i, col] = spare[at, col]
            if not is_held:
                field[i, col] += (field[above, col] + field[below, col] + 2) >> 2


@kernel
def _inverse_columns(field, spare, holds_first, holds_last):
    """Undo `_forward_columns`."""
    n, n_cols = field.shape
    if n == 1:
        return
    n_low = (n + 1) >> 1
    for at in range(0, n, 2):
        i = at >> 1
        is_held = (at == 0 and holds_first) or (at == n - 1 and holds_last)
        above = n_low + i - 1 if at > 0 else n_low
        below = n_low + i if at + 1 < n else above
        for col in range(n_cols):
            spare[at, col] = field[i, col]
            if not is_held:
                spare[at, col] -= (field[above, col] + field[below, col] + 2) >> 2
    for at in range(1, n, 2):
        below = at + 1 if at + 1 < n else at - 1
        for col in range(n_cols):
            mean = (spare[at - 1, col] + spare[below, col]) >> 1
            spare[at, col] = field[n_low + (at >> 1), col] + mean
    for row in range(n):
        for col in range(n_cols):
            field[row, col] = spare[row, col]


@kernel
def forward_level(field, spare, line, held):
    """Transform `field` in place: LL top left, HL top right, LH bottom left, HH bottom right.

    Rows first, then columns. `held` is a sum of HELD_TOP …; `spare` has the field's shape at
    least, `line` its number of columns.
    """
    for row in range(field.shape[0]):
        _forward_line(field[row], line, held & HELD_LEFT != 0, held & HELD_RIGHT != 0)
    _forward_columns(field, spare, held & HELD_TOP != 0, held & HELD_BOTTOM != 0)


@kernel
def inverse_level(field, spare, line, held):
    """Undo `forward_level`."""
    _inverse_columns(field, spare, held & HELD_TOP != 0, held & HELD_BOTTOM != 0)
    for row in range(field.shape[0]):
        _inverse_line(field[row], line, held & HELD_LEFT != 0, held & HELD_RIGHT != 0)


def level_shapes(shape: tuple[int, int], n_levels: int) -> list[tuple[int, int]]:
    """Return the shape of a field and of the LL band of each of `n_levels` transforms."""
    return [(((shape[0] - 1) >> t) + 1, ((shape[1] - 1) >> t) + 1) for t in range(n_levels + 1)]


def forward_transform(field: NDArray[np.int64], n_levels: int, held: int) -> None:
    """Transform `field` `n_levels` times in place, each time the LL band of the last."""
    spare, line = np.empty_like(field), np.empty(field.shape[1], dtype=np.int64)
    for n_rows, n_cols in level_shapes(field.shape, n_levels)[:-1]:
        forward_level(field[:n_rows, :n_cols], spare, line, held)


def inverse_transform(
    field: NDArray[np.int64], n_levels: int, held: int
) -> list[NDArray[np.int64]]:
    """Undo `forward_transform` in place; return the field of every level, the coarsest first.

    These are copies of the LL bands of the inverse stopped early, then the whole field itself.
    """
    spare, line = np.empty_like(field), np.empty(field.shape[1], dtype=np.int64)
    shapes = level_shapes(field.shape, n_levels)
    levels = []
    for t in range(n_levels - 1, -1, -1):
        part = field[: shapes[t][0], : shapes[t][1]]
        inverse_level(part, spare, line, held)
        levels.append(part.copy() if t else part)
    return levels


def places_of(field: NDArray[np.int64], n_levels: int) -> NDArray[np.int64]:
    """Return the coefficients of `forward_transform` by position: HL and LH on edges, HH in cells.

    Step t, counted from 1, takes its coefficients from samples on odd multiples of 2**(t - 1) rows
    or columns; the last LL band comes from samples on multiples of 2**n_levels.
    """
    found = np.empty_like(field)
    shapes = level_shapes(field.shape, n_levels)
    for t in range(n_levels):
        (n_rows, n_cols), (low_rows, low_cols) = shapes[t], shapes[t + 1]
        low, high = slice(None, None, 2 << t), slice(1 << t, None, 2 << t)
        found[low, high] = field[:low_rows, low_cols:n_cols]
        found[high, low] = field[low_rows:n_rows, :low_cols]
        found[high, high] = field[low_rows:n_rows, low_cols:n_cols]
    last = 1 << n_levels
    found[::last, ::last] = field[: shapes[-1][0], : shapes[-1][1]]
    return found


def lowpass_window(
    heights: NDArray[np.int32],
    first: tuple[int, int],
    level_shape: tuple[int, int],
    out_first: tuple[int, int],
    out_shape: tuple[int, int],
    tile_cells: int,
    n_tiles: tuple[int, int],
) -> NDArray[np.int32]:
    """Return part of a level's LL band, where tiles of `tile_cells` cells hold their borders.

    Parameters
    ----------
    heights : ndarray of int32
        A window of the finer level, with all samples within 2 of the wanted window.
    first, out_first : tuple of int
        Row and column of the first sample of each in its own level.
    level_shape : tuple of int
        Rows and columns of the finer level.
    tile_cells : int
        Cells per side of a tile of the finer level; even.
    n_tiles : tuple of int
        Rows and columns of tiles: the borders between them lie on multiples of `tile_cells`.
    """
    out = np.empty(out_shape, dtype=np.int32)
    rows = np.empty((heights.shape[0], out_shape[1]), dtype=np.int64)
    _lowpass_window(heights, first, level_shape, out_first, tile_cells, n_tiles, rows, out)
    return out


@kernel
def _low(left2, left, here, right, right2):
    """Return s of the sample `here` from its two neighbours on each side."""
    low = left - ((left2 + here) >> 1)
    high = right - ((here + right2) >> 1)
    return here + ((low + high + 2) >> 2)


@kernel
def _mirror(at, n):
    """Return `at` folded once into 0 … n - 1."""
    if at < 0:
        at = -at
    if at >= n:
        at = 2 * (n - 1) - at
    return min(max(at, 0), n - 1)


@kernel
def _is_border(at, tile_cells, n_tiles):
    """Return whether the sample `at` lies on the border of two of `n_tiles` tiles in a line."""
    return at % tile_cells == 0 and 0 < at // tile_cells < n_tiles


@kernel
def _lowpass_window(heights, first, level_shape, out_first, tile_cells, n_tiles, rows, out):
    (first_row, first_col), (n_rows, n_cols) = first, level_shape
    (out_row, out_col), (n_tile_rows, n_tile_cols) = out_first, n_tiles
    for row in range(heights.shape[0]):
        for col in range(out.shape[1]):
            at = 2 * (out_col + col)
            here = np.int64(heights[row, at - first_col])
            rows[row, col] = here
            if n_cols == 1 or _is_border(at, tile_cells, n_tile_cols):
                continue
            rows[row, col] = _low(
                np.int64(heights[row, _mirror(at - 2, n_cols) - first_col]),
                np.int64(heights[row, _mirror(at - 1, n_cols) - first_col]),
                here,
                np.int64(heights[row, _mirror(at + 1, n_cols) - first_col]),
                np.int64(heights[row, _mirror(at + 2, n_cols) - first_col]),
            )
    for row in range(out.shape[0]):
        at = 2 * (out_row + row)
        here = rows[at - first_row]
        if n_rows == 1 or _is_border(at, tile_cells, n_tile_rows):
            for col in range(out.shape[1]):
                out[row, col] = here[col]
            continue
        above2 = rows[_mirror(at - 2, n_rows) - first_row]
        above = rows[_mirror(at - 1, n_rows) - first_row]
        below = rows[_mirror(at + 1, n_rows) - first_row]
        below2 = rows[_mirror(at + 2, n_rows) - first_row]
        for col in range(out.shape[1]):
            out[row, col] = _low(above2[col], above[col], here[col], below[col], below2[col])
