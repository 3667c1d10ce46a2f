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

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Held sides of a field.
HELD_TOP, HELD_LEFT, HELD_BOTTOM, HELD_RIGHT = 1, 2, 4, 8


def _forward(field: NDArray[np.int64], *, holds_first: bool, holds_last: bool) -> None:
    """Transform `field` down its columns in place: s to the top, d below it."""
    n = len(field)
    if n == 1:
        return
    even = field[::2].copy()
    high = field[1::2] - (_sums_after(even, n >> 1) >> 1)
    field[: len(even)] = even + _updates(high, n, holds_first, holds_last)
    field[len(even) :] = high


def _inverse(field: NDArray[np.int64], *, holds_first: bool, holds_last: bool) -> None:
    """Undo `_forward`."""
    n = len(field)
    if n == 1:
        return
    n_low = (n + 1) >> 1
    even = field[:n_low] - _updates(field[n_low:], n, holds_first, holds_last)
    odd = field[n_low:] + (_sums_after(even, n >> 1) >> 1)
    field[::2], field[1::2] = even, odd


def _sums_after(even: NDArray[np.int64], n_odd: int) -> NDArray[np.int64]:
    """Return the sum of the even samples on both sides of each odd one."""
    sums = np.empty_like(even, shape=(n_odd, *even.shape[1:]))
    np.add(even[:-1], even[1:], out=sums[: len(even) - 1])
    if n_odd == len(even):
        np.add(even[-1], even[-1], out=sums[-1])
    return sums


def _updates(
    high: NDArray[np.int64], n: int, holds_first: bool, holds_last: bool
) -> NDArray[np.int64]:
    """Return what `high` adds to each of the even ones of `n` samples."""
    sums = np.empty_like(high, shape=((n + 1) >> 1, *high.shape[1:]))
    np.add(high[0], high[0], out=sums[0])
    np.add(high[:-1], high[1:], out=sums[1 : len(high)])
    if n & 1:
        np.add(high[-1], high[-1], out=sums[-1])
    sums += 2
    sums >>= 2
    if holds_first:
        sums[0] = 0
    if holds_last and n & 1:
        sums[-1] = 0
    return sums


def level_shapes(shape: tuple[int, int], n_levels: int) -> list[tuple[int, int]]:
    """Return the shape of a field and of the LL band of each of `n_levels` transforms."""
    return [(((shape[0] - 1) >> t) + 1, ((shape[1] - 1) >> t) + 1) for t in range(n_levels + 1)]


def forward_transform(field: NDArray[np.int64], n_levels: int, held: int) -> None:
    """Transform `field` `n_levels` times in place, each time the LL band of the last.

    LL comes top left, HL top right, LH bottom left, HH bottom right. Rows first, then columns.
    `held` is a sum of HELD_TOP ….
    """
    for n_rows, n_cols in level_shapes(field.shape, n_levels)[:-1]:
        part = field[:n_rows, :n_cols]
        _forward(part.T, holds_first=bool(held & HELD_LEFT), holds_last=bool(held & HELD_RIGHT))
        _forward(part, holds_first=bool(held & HELD_TOP), holds_last=bool(held & HELD_BOTTOM))


def inverse_transform(
    field: NDArray[np.int64], n_levels: int, held: int
) -> list[NDArray[np.int64]]:
    """Undo `forward_transform` in place; return the field of every level, the coarsest first.

    These are copies of the LL bands of the inverse stopped early, then the whole field itself.
    """
    levels: list[NDArray[np.int64]] = []
    for n_rows, n_cols in level_shapes(field.shape, n_levels)[-2::-1]:
        part = field[:n_rows, :n_cols]
        _inverse(part, holds_first=bool(held & HELD_TOP), holds_last=bool(held & HELD_BOTTOM))
        _inverse(part.T, holds_first=bool(held & HELD_LEFT), holds_last=bool(held & HELD_RIGHT))
        levels.append(part.copy() if len(levels) < n_levels - 1 else part)
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
    cols = _low(
        heights.T, first[1], level_shape[1], out_first[1], out_shape[1], tile_cells, n_tiles[1]
    )
    return _low(
        cols.T, first[0], level_shape[0], out_first[0], out_shape[0], tile_cells, n_tiles[0]
    ).astype(np.int32)


def _low(
    heights: NDArray[Any], first: int, n: int, out_first: int, n_out: int, tile_cells: int,
    n_tiles: int,
) -> NDArray[np.int64]:  # fmt: skip
    """Return s of every second row of a level with `n` rows; `heights` begins with row `first`."""
    places = 2 * (out_first + np.arange(n_out))
    here = heights[places - first].astype(np.int64)
    if n == 1:
        return here

    def beside(distance: int) -> NDArray[np.int64]:
        at = np.abs(places + distance)
        at = np.where(at < n, at, 2 * (n - 1) - at).clip(0, n - 1)
        return heights[at - first].astype(np.int64)

    low = beside(-1) - ((beside(-2) + here) >> 1)
    high = beside(1) - ((here + beside(2)) >> 1)
    tiles = places // tile_cells
    is_border = (places % tile_cells == 0) & (tiles > 0) & (tiles < n_tiles)
    return np.where(is_border[:, None], here, here + ((low + high + 2) >> 2))
