"""Two-dimensional temporary arrays that stay in memory while small and on disk otherwise."""

import errno
import os
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from terrainwave.container.spool import TEMPORARY_ADVICE, cannot_write, storage_errors
from terrainwave.grid.quadtree import Region

# Arrays up to this many bytes are held in memory: below it the disk would only cost time.
MEMORY_LIMIT = 20 << 20
TILE = 256
# What is known of tiles of a file that is kept.
_IN_FILE, _OF_ONE_VALUE = 1, 2


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
    path : Path, optional
        The file to use instead, which may be there already and is not deleted.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        dtype: DTypeLike,
        directory: Path,
        origin: tuple[int, int] = (0, 0),
        path: Path | None = None,
    ) -> None:
        self.shape = shape
        self.origin = origin
        self.dtype = np.dtype(dtype)
        self._memory: NDArray[Any] | None = None
        self._file: Any = None
        self._is_there: Any = None
        self._lock = threading.Lock()
        self._directory = directory
        self.is_kept = self.was_there = False
        if shape[0] * shape[1] * self.dtype.itemsize <= MEMORY_LIMIT:
            self._memory = np.zeros(shape, dtype=self.dtype)
        else:
            n_tiles = -(-shape[0] // TILE), -(-shape[1] // TILE)
            # Where a tile lies in the file, in tiles; -1 where it has one value, which needs none.
            self._slots = np.full(n_tiles, -1, dtype=np.int32)
            self._values: Any = np.zeros(n_tiles, dtype=self.dtype)
            self._n_slots = 0
            if path is not None:
                self._open(path)
            else:
                # Unbuffered, unnamed where the system can: nothing is left behind by a kill.
                self._file = tempfile.TemporaryFile(dir=directory, buffering=0)

    def _open(self, path: Path) -> None:
        """Use a file that outlives this object.

        Of two others beside it, one says which tiles were written, and the other the values of
        those that have one, which are not in the file.
        """
        tiles, values = (
            path.with_name(f"{path.stem}-{name}{path.suffix}") for name in ("tiles", "values")
        )
        is_there = self.was_there = path.exists() and tiles.exists() and values.exists()
        mode: Any = "r+" if is_there else "w+"
        with storage_errors(f"cannot write {path}"):
            self._file = open(path, f"{mode[0]}+b", buffering=0)
            shape = self._slots.shape
            self._is_there = np.memmap(tiles, np.uint8, mode, shape=shape)
            self._values = np.memmap(values, self.dtype, mode, shape=shape)
        self._was_there = self._is_there != 0
        in_file = self._is_there == _IN_FILE
        self._slots[in_file] = np.flatnonzero(in_file)
        self.is_kept = True

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
        if self._memory is not None:
            return self.view(region).copy()
        self._check_inside(region)
        window = np.empty(region.shape, dtype=self.dtype)
        for tile, at in self._tiles(region):
            part = tile.intersect(region)
            slot = self._slots[at]
            window[part.slices_in(region)] = (
                self._values[at] if slot < 0 else self._read_tile(slot)[part.slices_in(tile)]
            )
        return window

    def view(self, region: Region) -> NDArray[Any]:
        """Return the samples of `region`, which are not to be written to: no copy in memory.

        Raises
        ------
        ValueError
            If `region` does not lie inside the array.
        """
        if self._memory is None:
            return self.read(region)
        self._check_inside(region)
        return self._memory[region.slices_in(self.region)]

    def _check_inside(self, region: Region) -> None:
        if region.intersect(self.region) != region:
            raise ValueError(f"{region} is not inside {self.region}")

    def write(self, region: Region, values: NDArray[Any]) -> None:
        """Store `values` in `region`; windows made of whole tiles are written without reading.

        Tiles of one value take no room.
        """
        if self._memory is not None:
            self._memory[region.slices_in(self.region)] = values
            return
        for tile, at in self._tiles(region):
            part, own = tile.intersect(region), tile.intersect(self.region)
            is_whole = part.shape == own.shape
            with self._lock:
                slot = self._slots[at]
                if is_whole or slot < 0:
                    content = np.full((TILE, TILE), self._values[at])
                else:
                    content = self._read_tile_locked(slot)
                content[part.slices_in(tile)] = values[part.slices_in(region)]
                if slot < 0 and _is_one(content[own.slices_in(tile)]):
                    self._values[at] = content[0, 0]
                    if self.is_kept:
                        self._is_there[at] = _OF_ONE_VALUE
                    continue
                if slot < 0:
                    slot = self._n_slots
                    if self.is_kept:
                        slot = at[0] * self._slots.shape[1] + at[1]
                    self._n_slots += 1
                self._write_tile_locked(slot, content)
                self._slots[at] = slot
                if self.is_kept:
                    self._is_there[at] = _IN_FILE

    def fill(self, region: Region, value: Any) -> None:
        """Store one value in a region; whole tiles that were never written take no room.

        Whole tiles that an earlier run has written are left as they are: it wrote over this value.
        """
        if self._memory is not None:
            self._memory[region.slices_in(self.region)] = value
            return
        row, col = region.row - self.origin[0], region.col - self.origin[1]
        ends = row + region.n_rows, col + region.n_cols
        are_whole = row % TILE == col % TILE == 0 and all(
            end % TILE == 0 or end == size for end, size in zip(ends, self.shape, strict=True)
        )
        tiles = np.s_[row // TILE : -(-ends[0] // TILE), col // TILE : -(-ends[1] // TILE)]
        is_written = self._slots[tiles] >= 0
        if self.is_kept:
            is_written &= ~self._was_there[tiles]
        if not are_whole or is_written.any():
            for part in region.tiles(TILE, TILE):
                self.write(part, np.full(part.shape, value, dtype=self.dtype))
            return
        with self._lock:
            is_free = ~self._was_there[tiles] if self.is_kept else True
            np.copyto(self._values[tiles], value, where=is_free)

    def close(self) -> None:
        """Free the memory or delete the file, unless it has a path of its own."""
        self._memory = None
        if self._file is not None:
            self._file.close()
            self._file = self._is_there = self._values = None

    def _tiles(self, region: Region) -> list[tuple[Region, tuple[int, int]]]:
        row, col = region.row - self.origin[0], region.col - self.origin[1]
        rows = range(row // TILE, (row + region.n_rows - 1) // TILE + 1)
        cols = range(col // TILE, (col + region.n_cols - 1) // TILE + 1)
        return [
            (
                Region(self.origin[0] + r * TILE, self.origin[1] + c * TILE, TILE, TILE),
                (r, c),
            )
            for r in rows
            for c in cols
        ]

    def _read_tile(self, number: int) -> NDArray[Any]:
        size, number = TILE * TILE * self.dtype.itemsize, int(number)
        if hasattr(os, "pread"):
            data = os.pread(self._file.fileno(), size, number * size)
            return _tile_from_bytes(data, self.dtype)
        with self._lock:
            return self._read_tile_locked(number)

    def _read_tile_locked(self, number: int) -> NDArray[Any]:
        size = TILE * TILE * self.dtype.itemsize
        self._file.seek(int(number) * size)
        return _tile_from_bytes(self._file.read(size), self.dtype)

    def _write_tile_locked(self, number: int, content: NDArray[Any]) -> None:
        try:
            self._file.seek(int(number) * content.nbytes)
            if self._file.write(content.tobytes()) != content.nbytes:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise cannot_write(self._directory, error, advice=TEMPORARY_ADVICE) from error


def _is_one(values: NDArray[Any]) -> bool:
    """Say whether all values are the same, bit for bit."""
    bits = values.view(f"u{values.itemsize}")
    return bool((bits[0] == bits[0, 0]).all() and (bits == bits[0, 0]).all())


def _tile_from_bytes(data: bytes, dtype: np.dtype[Any]) -> NDArray[Any]:
    tile = np.zeros(TILE * TILE, dtype=dtype)
    present = np.frombuffer(data, dtype=dtype)  # shorter where a write has failed
    tile[: present.size] = present
    return tile.reshape(TILE, TILE)
