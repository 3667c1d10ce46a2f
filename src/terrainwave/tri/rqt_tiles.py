"""Tiles of heights and errors that come and go, over an overview that stays (`rqt_view`).

The overview has every `stride`-th sample. A tile that is loaded lies in a slot, with its borders;
slots that were never used are no memory. A vertex is known where the overview has it, or where all
tiles that it touches are loaded. So it has up to three errors:

* of a tile, in all slots that it touches alike, for what the overview does not have;
* in `fine_errors`, for what it has, where all tiles that it touches are loaded;
* in `coarse_errors`, where they are not: what the overview tells, and no smaller than the former.

Errors of tiles that are gone stay in those of vertices of others that theirs depended on: larger
than needed, until these go, too.
"""

import heapq
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.tri.rqt_errors import (
    measure_tile,
    needs_of,
    rounding_of,
    twist_of,
    widen,
    widen_everywhere,
)

_MOST_WIDENED = 128  # waiting at once: at most one of each level, edges and centres, and one


class Tile(NamedTuple):
    """All samples of a tile and the errors that they give its vertices.

    Parameters
    ----------
    heights, errors : ndarray of float32, shape (tile + 1, tile + 1)
    """

    heights: NDArray[np.float32]
    errors: NDArray[np.float32]


def tile_bytes(tile: int) -> int:
    """Return the bytes of a tile of so many cells a side."""
    return 2 * 4 * (tile + 1) ** 2


def _padded(
    values: NDArray[np.floating], shape: tuple[int, int], beyond: float
) -> NDArray[np.float32]:
    padded = np.full(shape, beyond, dtype=np.float32)
    padded[: values.shape[0], : values.shape[1]] = values
    return padded


class Tiles:
    """The samples and errors that a mesh knows.

    Parameters
    ----------
    n_tiles : tuple of int
        Rows and columns.
    tile : int
        Cells per side: a power of two.
    stride : int
        Of the overview: a power of two, at most `tile`.
    overview : ndarray, shape (n_rows, n_cols)
        Every `stride`-th sample as far as the raster goes.
    heights : tuple of float
        Bounds of all heights.
    is_bound : bool
        Whether errors are measured; else details or coefficients.
    coefficients : ndarray, optional
        Of the overview's samples, and then of all tiles: magnitudes.
    base_error : float
        Largest distance of the overview's bilinear surface from what errors count from.

    Attributes
    ----------
    overview_errors : ndarray of float64, shape `n_tiles`
        Largest distance of the overview's finest triangles in and beside each tile from what
        errors count from.
    """

    def __init__(
        self,
        n_tiles: tuple[int, int],
        tile: int,
        stride: int,
        overview: NDArray[np.floating],
        heights: tuple[float, float],
        is_bound: bool,
        base_error: float,
        coefficients: NDArray[np.floating] | None = None,
    ) -> None:
        self.tile, self.stride, self._is_bound = tile, stride, is_bound
        self._rounding = rounding_of(heights)
        side = tile // stride
        shape = n_tiles[0] * side + 1, n_tiles[1] * side + 1
        self._coarse_heights = _padded(overview, shape, np.nan)
        self._coarse_coefficients = np.zeros((0, 0), dtype=np.float32)
        if coefficients is not None:
            self._coarse_coefficients = _padded(coefficients, shape, 0.0)
        self._coarse_errors = np.zeros(shape, dtype=np.float32)
        self._fine_errors = np.zeros(shape, dtype=np.float32)
        self._slot_of = np.full(n_tiles, -1, dtype=np.int32)
        self._free = list(range(n_tiles[0] * n_tiles[1]))
        slots = (len(self._free) if stride > 1 else 0, tile + 1, tile + 1)
        self._heights = np.empty(slots, dtype=np.float32)
        self._errors = np.empty(slots, dtype=np.float32)
        self._stack = np.empty((_MOST_WIDENED, 2), dtype=np.int64)
        self.overview_errors = np.empty(n_tiles)
        for row, col in np.ndindex(n_tiles):
            self._measure_overview(row, col, base_error)
        widen_everywhere(self._coarse_errors, side)

    def _measure_overview(self, row: int, col: int, base_error: float) -> None:
        """Take the errors of a tile's vertices, as far as the overview tells."""
        side = self.tile // self.stride
        first_row, first_col = row * side, col * side
        rows, cols = (slice(first, first + side + 1) for first in (first_row, first_col))
        base = base_error + self._rounding
        beside = self._coarse_heights[
            max(rows.start - 1, 0) : rows.stop + 1, max(cols.start - 1, 0) : cols.stop + 1
        ]
        if self.stride > 1:
            base += twist_of(beside)
        self.overview_errors[row, col] = base
        measure_tile(
            first_row, first_col, base if self._is_bound else 0.0, self._is_bound,
            self._coarse_heights[rows, cols], self._coarse_coefficients[rows, cols],
            self._coarse_errors[rows, cols],
        )  # fmt: skip

    # Tiles

    @property
    def _bits(self) -> tuple[int, int]:
        """Return log2 of the sides of a tile and of the overview's cells, in samples."""
        return self.tile.bit_length() - 1, self.stride.bit_length() - 1

    @property
    def known_errors(self) -> tuple[object, ...]:
        """Return the arguments of `known_error` besides a place."""
        return (
            self._slot_of, self._errors, self._fine_errors, self._coarse_errors, *self._bits
        )  # fmt: skip

    @property
    def known_heights(self) -> tuple[object, ...]:
        """Return the arguments of `height_of` besides a place."""
        return self._slot_of, self._heights, self._coarse_heights, *self._bits

    @property
    def n_loaded(self) -> int:
        """Return how many tiles are loaded."""
        return int(np.count_nonzero(self._slot_of >= 0))

    def is_loaded(self, row: int, col: int) -> bool:
        """Say whether all samples of a tile are known."""
        return self.stride == 1 or bool(self._slot_of[row, col] >= 0)

    def measure(
        self,
        row: int,
        col: int,
        heights: NDArray[np.floating],
        base_error: float,
        coefficients: NDArray[np.floating] | None = None,
    ) -> Tile:
        """Return a tile of all its samples inside the raster; thread-safe."""
        shape = self.tile + 1, self.tile + 1
        padded, own = _padded(heights, shape, np.nan), np.zeros((0, 0), dtype=np.float32)
        if coefficients is not None:
            own = _padded(coefficients, shape, 0.0)
        errors = np.zeros_like(padded)
        base = base_error + self._rounding if self._is_bound else 0.0
        measure_tile(row * self.tile, col * self.tile, base, self._is_bound, padded, own, errors)
        return Tile(padded, errors)

    def load(self, row: int, col: int, tile: Tile) -> None:
        """Keep a tile, and widen the errors of others by its own."""
        if self.is_loaded(row, col):
            return
        slot = heapq.heappop(self._free)
        self._heights[slot], self._errors[slot] = tile
        self._slot_of[row, col] = slot
        join_tile(row, col, tile.errors, *self.known_errors, self._stack)

    def unload(self, row: int, col: int) -> None:
        """Forget a tile."""
        slot = int(self._slot_of[row, col])
        if slot >= 0:
            heapq.heappush(self._free, slot)
            self._slot_of[row, col] = -1


# What is known of a place


@kernel
def is_loaded_around(row, col, slot_of, bits):
    """Say whether all tiles that a place touches are loaded."""
    mask = (1 << bits) - 1
    r, c = row >> bits, col >> bits
    if row & mask and col & mask:
        return slot_of[r, c] >= 0
    for near_row in range(r if row & mask else max(r - 1, 0), min(r, slot_of.shape[0] - 1) + 1):
        for near_col in range(c if col & mask else max(c - 1, 0), min(c, slot_of.shape[1] - 1) + 1):
            if slot_of[near_row, near_col] < 0:
                return False
    return True


@kernel
def _is_of_overview(row, col, step_bits):
    return (row | col) & ((1 << step_bits) - 1) == 0


@kernel
def is_known(row, col, slot_of, bits, step_bits):
    """Say whether a place may be a vertex."""
    return _is_of_overview(row, col, step_bits) or is_loaded_around(row, col, slot_of, bits)


@kernel
def known_error(row, col, slot_of, tile_errors, fine_errors, coarse_errors, bits, step_bits):
    """Return the error of a place; 0 where it is not known."""
    is_of_overview = _is_of_overview(row, col, step_bits)
    if not is_loaded_around(row, col, slot_of, bits):
        if is_of_overview:
            return np.float64(coarse_errors[row >> step_bits, col >> step_bits])
        return 0.0
    if is_of_overview:
        return np.float64(fine_errors[row >> step_bits, col >> step_bits])
    r, c = min(row >> bits, slot_of.shape[0] - 1), min(col >> bits, slot_of.shape[1] - 1)
    return np.float64(tile_errors[slot_of[r, c], row - (r << bits), col - (c << bits)])


@kernel
def height_of(row, col, slot_of, tile_heights, coarse_heights, bits, step_bits):
    """Return the height of a place that is known: of a loaded tile that it touches if there is one.

    NaN is void.
    """
    if tile_heights.shape[0] > 0:
        for r in range(max((row - 1) >> bits, 0), min(row >> bits, slot_of.shape[0] - 1) + 1):
            for c in range(max((col - 1) >> bits, 0), min(col >> bits, slot_of.shape[1] - 1) + 1):
                slot = slot_of[r, c]
                if slot >= 0:
                    return np.float64(tile_heights[slot, row - (r << bits), col - (c << bits)])
    return np.float64(coarse_heights[row >> step_bits, col >> step_bits])


# A tile among others


@kernel
def join_tile(
    tile_row, tile_col, errors, slot_of, tile_errors, fine_errors, coarse_errors, bits, step_bits,
    stack,
):  # fmt: skip
    """Widen errors of other tiles by those of a new one along its border, and its own by theirs."""
    side = errors.shape[0] - 1
    first_row, first_col = tile_row << bits, tile_col << bits
    for row in range(0, side + 1, 1 << step_bits):
        for col in range(0, side + 1, 1 << step_bits):
            r, c = (first_row + row) >> step_bits, (first_col + col) >> step_bits
            widen(fine_errors, r, c, np.float64(errors[row, col]))
            widen(coarse_errors, r, c, np.float64(errors[row, col]))
    for row in range(side + 1):
        for col in range(0, side + 1, 1 if row == 0 or row == side else side):
            _widen_above(
                first_row + row, first_col + col, slot_of, tile_errors, fine_errors, coarse_errors,
                bits, step_bits, stack,
            )  # fmt: skip


@kernel
def _widen_above(
    row, col, slot_of, tile_errors, fine_errors, coarse_errors, bits, step_bits, stack
):
    """Make a vertex's error alike in all tiles, and those it depends on no smaller."""
    n_rows, n_cols = slot_of.shape[0] << bits, slot_of.shape[1] << bits
    _widen_alike(row, col, 0.0, slot_of, tile_errors, fine_errors, coarse_errors, bits, step_bits)
    stack[0, 0], stack[0, 1] = row, col
    depth = 1
    while depth > 0:
        depth -= 1
        row, col = stack[depth, 0], stack[depth, 1]
        error = _error_at(row, col, slot_of, tile_errors, fine_errors, bits, step_bits)
        r2, c2, r3, c3 = needs_of(row, col, 1 << bits)
        for r, c in ((r2, c2), (r3, c3)):
            if 0 <= r <= n_rows and 0 <= c <= n_cols:
                if _widen_alike(
                    r, c, error, slot_of, tile_errors, fine_errors, coarse_errors, bits, step_bits
                ):
                    stack[depth, 0], stack[depth, 1] = r, c
                    depth += 1


@kernel
def _error_at(row, col, slot_of, tile_errors, fine_errors, bits, step_bits):
    """Return the error of a place that at least one loaded tile has."""
    if _is_of_overview(row, col, step_bits):
        return np.float64(fine_errors[row >> step_bits, col >> step_bits])
    for r in range(max((row - 1) >> bits, 0), min(row >> bits, slot_of.shape[0] - 1) + 1):
        for c in range(max((col - 1) >> bits, 0), min(col >> bits, slot_of.shape[1] - 1) + 1):
            if slot_of[r, c] >= 0:
                return np.float64(tile_errors[slot_of[r, c], row - (r << bits), col - (c << bits)])
    return 0.0


@kernel
def _widen_alike(
    row, col, error, slot_of, tile_errors, fine_errors, coarse_errors, bits, step_bits
):
    """Widen the error of a place wherever it is kept; say whether that changed one."""
    if _is_of_overview(row, col, step_bits):
        r, c = row >> step_bits, col >> step_bits
        has_changed = widen(fine_errors, r, c, error)
        return widen(coarse_errors, r, c, error) or has_changed
    # First the largest of all tiles, which may differ along the border of a new one.
    has_changed = False
    for _ in range(2):
        for r in range(max((row - 1) >> bits, 0), min(row >> bits, slot_of.shape[0] - 1) + 1):
            for c in range(max((col - 1) >> bits, 0), min(col >> bits, slot_of.shape[1] - 1) + 1):
                slot = slot_of[r, c]
                if slot >= 0:
                    at = tile_errors[slot]
                    place = row - (r << bits), col - (c << bits)
                    has_changed = widen(at, place[0], place[1], error) or has_changed
                    error = np.float64(at[place[0], place[1]])
    return has_changed
