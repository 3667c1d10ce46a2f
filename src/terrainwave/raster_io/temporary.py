"""Two-dimensional temporary arrays that stay in memory while small and on disk otherwise."""

import errno
import os
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from terrainwave.container.spool import TEMPORARY_ADVICE, cannot_write
from terrainwave.grid.quadtree import Region

# Arrays up to this many bytes are held in memory: below it the disk would only cost time.
MEMORY_LIMIT = 20 << 20
TILE = 256


class Spool:
    """A 2-D array of fixed shape with windowed reads and writes; thread-safe for disjoint writes.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns.
    dtype : dtype
        Element type.
    directory : Path
        Where the temporary file lies if one is needed; it is deleted by `close`.
    origin : tuple of int
        Row and column of the first sample: regions are counted as those of a larger array.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        dtype: DTypeLike,
        directory: Path,
        origin: tuple[int, int] = (0, 0),
    ) -> None:
        self.shape = shape
        self.origin = origin
        self.dtype = np.dtype(dtype)
        self._memory: NDArray[Any] | None = None
        self._file: Any = None
        self._lock = threading.Lock()
        self._directory = directory
        if shape[0] * shape[1] * self.dtype.itemsize <= MEMORY_LIMIT:
            self._memory = np.zeros(shape, dtype=self.dtype)
        else:
            # Unbuffered, unnamed where the system can: nothing is left behind by a kill.
            self._file = tempfile.TemporaryFile(dir=directory, buffering=0)
            self._tile_cols = -(-shape[1] // TILE)

    @property
    def region(self) -> Region:
        """Return the whole array as a region."""
        return Region(*self.origin, *self.shape)

    def read(self, region: Region) -> NDArray[Any]:
        """Return a copy of the samples of `region`.

        Raises
        ------
        ValueError
            If `region` does not lie inside the array.
        """
        if region.intersect(self.region) != region:
            raise ValueError(f"{region} is not inside {self.region}")
        if self._memory is not None:
            return self._memory[region.slices_in(self.region)].copy()
        window = np.empty(region.shape, dtype=self.dtype)
        for tile, number in self._tiles(region):
            part = tile.intersect(region)
            window[part.slices_in(region)] = self._read_tile(number)[part.slices_in(tile)]
        return window

    def write(self, region: Region, values: NDArray[Any]) -> None:
        """Store `values` in `region`; windows made of whole tiles are written without reading."""
        if self._memory is not None:
            self._memory[region.slices_in(self.region)] = values
            return
        for tile, number in self._tiles(region):
            part = tile.intersect(region)
            is_whole = part.shape == tile.intersect(self.region).shape
            with self._lock:
                content = (
                    np.zeros((TILE, TILE), self.dtype)
                    if is_whole
                    else self._read_tile_locked(number)
                )
                content[part.slices_in(tile)] = values[part.slices_in(region)]
                self._write_tile_locked(number, content)

    def close(self) -> None:
        """Free the memory or delete the file."""
        self._memory = None
        if self._file is not None:
            self._file.close()
            self._file = None

    def _tiles(self, region: Region) -> list[tuple[Region, int]]:
        row, col = region.row - self.origin[0], region.col - self.origin[1]
        rows = range(row // TILE, (row + region.n_rows - 1) // TILE + 1)
        cols = range(col // TILE, (col + region.n_cols - 1) // TILE + 1)
        return [
            (
                Region(self.origin[0] + r * TILE, self.origin[1] + c * TILE, TILE, TILE),
                r * self._tile_cols + c,
            )
            for r in rows
            for c in cols
        ]

    def _read_tile(self, number: int) -> NDArray[Any]:
        size = TILE * TILE * self.dtype.itemsize
        if hasattr(os, "pread"):
            data = os.pread(self._file.fileno(), size, number * size)
            return _tile_from_bytes(data, self.dtype)
        with self._lock:
            return self._read_tile_locked(number)

    def _read_tile_locked(self, number: int) -> NDArray[Any]:
        size = TILE * TILE * self.dtype.itemsize
        self._file.seek(number * size)
        return _tile_from_bytes(self._file.read(size), self.dtype)

    def _write_tile_locked(self, number: int, content: NDArray[Any]) -> None:
        try:
            self._file.seek(number * content.nbytes)
            if self._file.write(content.tobytes()) != content.nbytes:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise cannot_write(self._directory, error, advice=TEMPORARY_ADVICE) from error


def _tile_from_bytes(data: bytes, dtype: np.dtype[Any]) -> NDArray[Any]:
    tile = np.zeros(TILE * TILE, dtype=dtype)
    present = np.frombuffer(data, dtype=dtype)  # shorter where the file ends inside a hole
    tile[: present.size] = present
    return tile.reshape(TILE, TILE)
