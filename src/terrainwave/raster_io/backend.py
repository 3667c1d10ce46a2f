"""`RasterBackend`: a raster of a mosaic; `Readers`: one raster in several threads."""

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
    """One band of a raster with a position: a dataset of GDAL, or a .twz file.

    `undeclared` are values that the raster declares void and that `nodata` turns into heights;
    `is_lost` is true if its position is unknown, `has_mask` if `read` finds voids without a nodata
    value. `told` is its statement on the meaning of its numbers.
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
        """Yield notes on omissions and choices, one sentence each."""

    def remarks(self) -> Iterator[str]:
        """Yield the notes without the raster's name."""

    def asides(self) -> Iterator[str]:
        """Yield notes that need no warning, one sentence each."""

    def tags(self) -> dict[str, Any]:
        """Return the fields of RasterInfo that do not concern the heights."""

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return heights (a copy) and validity by the mask."""

    def even(self, region: Region) -> Even | None:
        """Return the content of a region if the index gives it; None if only reading can tell."""

    def close(self) -> None: ...


class Readable(Protocol):
    """Reader of a raster for one thread at a time."""

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]: ...

    def even(self, region: Region) -> Even | None: ...

    def close(self) -> None: ...


@runtime_checkable
class Reopening(Readable, Protocol):
    """Raster that can be opened again for another thread."""

    def again(self) -> Readable | None:
        """Return the raster opened again; None if the file may have changed."""


class Readers:
    """A raster, opened again for each further thread that reads it.

    If it cannot be opened again, threads take turns.
    """

    def __init__(self, first: Readable) -> None:
        self._first = first
        self._lock = threading.Lock()
        self._others: list[Readable] = []
        self._idle: list[Readable] = []

    @contextmanager
    def lent(self) -> Iterator[Readable]:
        """Yield a reader for the use of one thread."""
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
        for backend in (self._first, *self._others):
            backend.close()
