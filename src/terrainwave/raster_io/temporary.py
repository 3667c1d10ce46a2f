"""Temporary 2-D arrays that stay in memory while small and on disk otherwise."""

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
from terrainwave.raster_io.even import are_bits

# Arrays up to this many bytes stay in memory: the disk would only cost time.
MEMORY_LIMIT = 20 << 20
TILE = 256
# State of a tile: never written, or of one value (neither needs space); else its bytes per sample
# in the file.
_UNWRITTEN, _OF_ONE_VALUE = 0, 255


class Spool:
    """A 2-D array of fixed shape with windowed reads and writes; thread-safe for disjoint writes.

    In its file, a tile of whole numbers with a small range takes one or two bytes per sample, as
    distances from the lowest, if it was written as a whole. Regions are counted from `origin`, as
    those of a larger array. The file at `path` may exist already and is kept; without one a
    temporary file in `directory` is deleted by `close`.
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
        self._lock = threading.Lock()
        self._directory, self._path = directory, path
        self.is_kept = self.was_there = False
        if is_small(shape, dtype):
            self._memory = np.zeros(shape, dtype=self.dtype)
            return
        n_tiles = -(-shape[0] // TILE), -(-shape[1] // TILE)
        if path is not None:
            self._open(path, n_tiles)
            return
        # Unbuffered, and unnamed if the system can: a kill leaves nothing behind.
        self._file = tempfile.TemporaryFile(dir=directory, buffering=0)
        self._states: Any = np.full(n_tiles, _UNWRITTEN, dtype=np.uint8)
        # The only value of a tile that is not in the file, or its lowest value.
        self._values: Any = np.zeros(n_tiles, dtype=self.dtype)
        # Position of a tile in the file, in tiles of one byte per sample.
        self._slots: Any = np.zeros(n_tiles, dtype=np.int32)
        self._n_slots = 0

    def _open(self, path: Path, n_tiles: tuple[int, int]) -> None:
        """Use a file that outlives this object; tiles have fixed places, and holes."""
        states, values = _beside(path)
        is_there = self.was_there = path.exists() and states.exists() and values.exists()
        mode: Any = "r+" if is_there else "w+"
        with storage_errors(f"cannot write {path}"):
            self._file = open(path, f"{mode[0]}+b", buffering=0)
            self._states = np.memmap(states, np.uint8, mode, shape=n_tiles)
            self._values = np.memmap(values, self.dtype, mode, shape=n_tiles)
        self._was_there = self._states != _UNWRITTEN
        self.is_kept = True

    @property
    def region(self) -> Region:
        return Region(*self.origin, *self.shape)

    def read(self, region: Region) -> NDArray[Any]:
        """Return a copy of the samples of `region`, which must lie inside the array."""
        if self._memory is not None:
            return self.view(region).copy()
        self._check_inside(region)
        window = np.empty(region.shape, dtype=self.dtype)
        for tile, at in self._tiles(region):
            part = tile.intersect(region)
            window[part.slices_in(region)] = (
                self._read_tile(at, part.slices_in(tile))
                if _is_in_file(self._states[at])
                else self._values[at]
            )
        return window

    def view(self, region: Region) -> NDArray[Any]:
        """Return the samples of `region`, read-only; not copied if they are in memory."""
        if self._memory is None:
            return self.read(region)
        self._check_inside(region)
        return self._memory[region.slices_in(self.region)]

    def _check_inside(self, region: Region) -> None:
        if region.intersect(self.region) != region:
            raise ValueError(f"{region} is not inside {self.region}")

    def write(self, region: Region, values: NDArray[Any]) -> None:
        """Store `values` in `region`; whole tiles are written without reading."""
        if self._memory is not None:
            self._memory[region.slices_in(self.region)] = values
            return
        for tile, at in self._tiles(region):
            part, own = tile.intersect(region), tile.intersect(self.region)
            new = values[part.slices_in(region)]
            if part.shape == own.shape:
                content = new.astype(self.dtype, copy=False)
                low, n_bytes = _narrowest(content)
                with self._lock:
                    self._write_tile(at, content, low, n_bytes)
                continue
            with self._lock:
                content = self._whole_tile(at)
                content[part.slices_in(tile)] = new
                # Tiles written in parts keep their place and their old samples.
                is_one = _is_one(content[own.slices_in(tile)])
                is_one &= not _is_in_file(self._states[at])
                low = content[0, 0]
                self._write_tile(at, content, low, 0 if is_one else self.dtype.itemsize)

    def fill(self, region: Region, value: Any) -> None:
        """Store one value in a region, in no space if whole tiles were never written.

        Whole tiles from an earlier run are not changed: that run wrote them after filling.
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
        is_written = _is_in_file(self._states[tiles])
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
            self._file = self._states = self._values = self._slots = None

    def drop(self) -> None:
        """Free the memory or delete the file, also one that has a path of its own."""
        self.close()
        if self.is_kept and self._path is not None:
            with storage_errors(f"cannot use {self._path}"):
                for path in (self._path, *_beside(self._path)):
                    path.unlink(missing_ok=True)

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

    def _offset(self, at: tuple[int, int]) -> int:
        if self.is_kept:
            number = (at[0] * self._states.shape[1] + at[1]) * self.dtype.itemsize
        else:
            number = int(self._slots[at])
        return number * TILE * TILE

    def _whole_tile(self, at: tuple[int, int]) -> NDArray[Any]:
        if not _is_in_file(self._states[at]):
            return np.full((TILE, TILE), self._values[at])
        n_bytes = int(self._states[at])
        self._file.seek(self._offset(at))
        data = self._file.read(TILE * TILE * n_bytes)
        return self._samples(at, data, n_bytes, np.s_[:, :])

    def _read_tile(self, at: tuple[int, int], part: tuple[slice, slice]) -> NDArray[Any]:
        n_bytes = int(self._states[at])
        if hasattr(os, "pread"):
            data = os.pread(self._file.fileno(), TILE * TILE * n_bytes, self._offset(at))
            return self._samples(at, data, n_bytes, part)
        with self._lock:
            return self._whole_tile(at)[part]

    def _samples(
        self, at: tuple[int, int], data: bytes, n_bytes: int, part: tuple[slice, slice]
    ) -> NDArray[Any]:
        """Return samples of a tile from bytes, which may end early after a failed write."""
        is_narrow = n_bytes < self.dtype.itemsize
        stored = np.dtype(f"u{n_bytes}") if is_narrow else self.dtype
        tile = np.frombuffer(data.ljust(TILE * TILE * n_bytes, b"\0"), dtype=stored)
        samples = tile.reshape(TILE, TILE)[part].astype(self.dtype)
        if is_narrow:
            samples += self._values[at]
        return samples

    def _write_tile(
        self, at: tuple[int, int], content: NDArray[Any], low: Any, n_bytes: int
    ) -> None:
        """Store a tile with `n_bytes` per sample (0: all are `low`); the caller holds the lock."""
        if n_bytes:
            if n_bytes < self.dtype.itemsize:
                content = (content - low).astype(f"u{n_bytes}")
            if content.shape != (TILE, TILE):  # cut by the array's edge
                content = np.pad(content, [(0, TILE - n) for n in content.shape])
            n_before = self._states[at] if _is_in_file(self._states[at]) else 0
            if not self.is_kept and n_bytes > n_before:
                self._slots[at] = self._n_slots
                self._n_slots += n_bytes
            try:
                self._file.seek(self._offset(at))
                if self._file.write(content.tobytes()) != content.nbytes:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            except OSError as error:
                raise cannot_write(self._directory, error, advice=TEMPORARY_ADVICE) from error
        self._values[at] = low
        self._states[at] = n_bytes or _OF_ONE_VALUE


def is_small(shape: tuple[int, int], dtype: DTypeLike) -> bool:
    return shape[0] * shape[1] * np.dtype(dtype).itemsize <= MEMORY_LIMIT


def _beside(path: Path) -> list[Path]:
    """Return the accompanying files of a kept spool: states and values of tiles."""
    return [path.with_name(f"{path.stem}-{name}{path.suffix}") for name in ("tiles", "values")]


def _is_in_file(states: Any) -> Any:
    return (states != _UNWRITTEN) & (states != _OF_ONE_VALUE)


def _narrowest(values: NDArray[Any]) -> tuple[Any, int]:
    """Return the lowest value, and the bytes for each distance from it: 0 if all are equal."""
    if _is_one(values):
        return values[0, 0], 0
    if values.dtype.kind in "iu":
        low = values.min()
        distance = int(values.max()) - int(low)
        for n_bytes in (1, 2):
            if distance >> 8 * n_bytes == 0 and n_bytes < values.dtype.itemsize:
                return low, n_bytes
    return values[0, 0], values.dtype.itemsize


def _is_one(values: NDArray[Any]) -> bool:
    first = values[0, 0]
    return bool(are_bits(values[0], first).all() and are_bits(values, first).all())
