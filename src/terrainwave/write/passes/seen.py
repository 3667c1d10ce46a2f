"""Tiles of a raster that the scan found to be void or of one value.

The source's index does not show such tiles if they are stored as ordinary blocks. Once read, they
are handled as cheaply as those that the index shows (`raster_io.even`).
"""

import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from terrainwave.container.spool import storage_errors
from terrainwave.grid.quadtree import Region
from terrainwave.raster_io.even import Even, are_bits

# Samples a side of a tile.
SIDE = 512
_UNSEEN, _MIXED, _VALID, _VOID = range(4)


class SeenTiles:
    """Contents of a raster's tiles as far as scanned; thread-safe.

    A region may be noted more than once.
    """

    def __init__(self, shape: tuple[int, int], dtype: DTypeLike, path: Path | None) -> None:
        n_tiles = -(-shape[0] // SIDE), -(-shape[1] // SIDE)
        kinds = np.dtype([("state", np.uint8), ("value", dtype)])
        self.was_there = path is not None and path.exists()
        self._tiles: Any
        if path is None:
            self._tiles = np.zeros(n_tiles, dtype=kinds)
        else:
            with storage_errors(f"cannot write {path}"):
                mode: Any = "r+" if self.was_there else "w+"
                self._tiles = np.memmap(path, kinds, mode, shape=n_tiles)
        self._has_even: bool | None = None
        self._lock = threading.Lock()

    def note(self, region: Region, heights: NDArray[Any], valid: NDArray[np.bool_]) -> None:
        for tiles, part in self._parts(region):
            if (self._tiles[tiles]["state"] != _MIXED).all():
                there = part.slices_in(region)
                self._merge(tiles, *_what(heights[there], valid[there]))

    def note_even(self, region: Region, even: Even) -> None:
        """Record samples that are known without reading."""
        self._merge(_tiles_of(region), _VALID if even.is_valid else _VOID, even.value)

    def even(self, region: Region) -> Even | None:
        """Return the common content of a region's samples if its tiles are all alike; else None.

        Only once all samples are recorded.
        """
        if self._has_even is None:
            self._has_even = bool((self._tiles["state"] > _MIXED).any())
        if not self._has_even:
            return None
        tiles = self._tiles[_tiles_of(region)]
        state, value = tiles[0, 0]["state"], tiles[0, 0]["value"]
        if state <= _MIXED or (tiles["state"] != state).any():
            return None
        if state == _VALID and not are_bits(tiles["value"], value).all():
            return None
        return Even(value, bool(state == _VALID))

    def close(self) -> None:
        self._tiles = None

    def _parts(self, region: Region) -> list[tuple[tuple[slice, slice], Region]]:
        rows, cols = _tiles_of(region)
        return [
            (
                (slice(row, row + 1), slice(col, col + 1)),
                Region(row * SIDE, col * SIDE, SIDE, SIDE).intersect(region),
            )
            for row in range(rows.start, rows.stop)
            for col in range(cols.start, cols.stop)
        ]

    def _merge(self, at: tuple[slice, slice], state: int, value: Any) -> None:
        tiles = self._tiles[at]
        states, values = tiles["state"], tiles["value"]
        with self._lock:
            is_new = states == _UNSEEN
            is_same = states == state
            if state == _VALID:
                is_same &= are_bits(values, value)
            values[is_new] = value
            states[is_new] = state
            states[~(is_new | is_same)] = _MIXED


def _what(heights: NDArray[Any], valid: NDArray[np.bool_]) -> tuple[int, Any]:
    """Return the common content of all samples and its value; usually a few samples decide."""
    value, is_valid = heights[0, 0], valid[0, 0]
    last_row, last_col = heights.shape[0] - 1, heights.shape[1] - 1
    few = np.s_[[0, last_row // 2, last_row, last_row], [last_col, last_col // 2, 0, last_col]]
    for part in (few, np.s_[:, :]):
        if not (valid[part] == is_valid).all():
            return _MIXED, value
        if is_valid and not are_bits(heights[part], value).all():
            return _MIXED, value
    return (_VALID if is_valid else _VOID), value


def _tiles_of(region: Region) -> tuple[slice, slice]:
    """Return the rows and columns of tiles that a region touches."""
    rows, cols = (
        slice(first // SIDE, (first + n - 1) // SIDE + 1)
        for first, n in zip(region[:2], region.shape, strict=True)
    )
    return rows, cols
