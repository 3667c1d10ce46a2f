"""`RasterBackend`: what a mosaic needs of each of its rasters; `Readers` of one in threads."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Region
from terrainwave.place.meaning import Told
from terrainwave.raster_io.earlier_loss import EarlierLoss
from terrainwave.raster_io.even import Even


class RasterBackend(Protocol):
    """One band of a raster that lies somewhere: a dataset of GDAL's, or a .twz file.

    `undeclared` are values that it declares to be void and that `nodata` makes heights of;
    `is_lost` says that nothing tells where its samples lie, `has_mask` that `read` knows voids that
    no nodata value marks. `told` is what it says of its numbers.
    """

    name: str
    n_rows: int
    n_cols: int
    dtype: np.dtype[Any]
    nodata: Any
    undeclared: tuple[int | float, ...]
    block_shape: tuple[int, int]
    transform: tuple[float, ...]
    crs: Any
    is_file: bool
    is_lost: bool
    has_mask: bool
    earlier: EarlierLoss | None
    told: Told

    def notes(self) -> Iterator[str]:
        """Yield what is left out or was chosen, one sentence each."""

    def remarks(self) -> Iterator[str]:
        """Yield the notes without the raster's name."""

    def asides(self) -> Iterator[str]:
        """Yield what is no reason for a warning, one sentence each."""

    def tags(self) -> dict[str, Any]:
        """Return the fields of RasterInfo that do not bear on the heights."""

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return heights (a copy) and False where a mask says void."""

    def even(self, region: Region) -> Even | None:
        """Return what all samples of a region are without reading them; None: only that tells."""

    def close(self) -> None:
        """Close what was opened here."""


class Readable(Protocol):
    """What of a raster can be used by one thread at a time."""

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Do as `RasterBackend.read`."""

    def even(self, region: Region) -> Even | None:
        """Do as `RasterBackend.even`."""

    def close(self) -> None:
        """Close what was opened here."""


@runtime_checkable
class Reopening(Readable, Protocol):
    """What can be opened once more, for another thread."""

    def again(self) -> Readable | None:
        """Return the same raster, opened once more; None if that is not sure to be the same."""


class Readers:
    """A raster, opened once more for each further thread that reads it, where that can be.

    Threads take turns with one that cannot.
    """

    def __init__(self, first: Readable) -> None:
        self._first = first
        self._lock = threading.Lock()
        self._others: list[Readable] = []
        self._idle: list[Readable] = []

    @contextmanager
    def lent(self) -> Iterator[Readable]:
        """Lend the raster, as it was opened at any time, to one thread."""
        other = None
        if not self._lock.acquire(blocking=False):
            other = self._other()
            if other is None:
                self._lock.acquire()
        try:
            yield self._first if other is None else other
        finally:
            if other is None:
                self._lock.release()
            else:
                self._idle.append(other)

    def _other(self) -> Readable | None:
        with suppress(IndexError):
            return self._idle.pop()
        other = self._first.again() if isinstance(self._first, Reopening) else None
        if other is not None:
            self._others.append(other)
        return other

    def close(self) -> None:
        """Close all that was opened."""
        for backend in (self._first, *self._others):
            backend.close()
