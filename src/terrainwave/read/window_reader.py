"""Windows and samples of a level: units decoded in threads, quanta converted to heights."""

import contextlib
import logging
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.refiner import Decoded, Raw
from terrainwave.errors import CorruptStreamError, StorageError
from terrainwave.forks import renew_after_fork
from terrainwave.grid.crew import Crew
from terrainwave.grid.quadtree import Block, Grid, Region
from terrainwave.grid.quantum import Quantizer
from terrainwave.grid.remainders import restored
from terrainwave.read.decoder import RowsOf, TreeDecoder, unit_key
from terrainwave.read.lost import LostUnits

_log = logging.getLogger(__name__)

# Payloads fetched ahead of decoding, in one coalesced request.
_BATCH = 64


class WindowReader:
    """Reads through a decoder, with the threads of one open file.

    Parameters
    ----------
    name : str
        Name of the file in messages.
    n_threads : int
        Threads that decode; none are started for one.
    """

    def __init__(self, name: str, grid: Grid, quantizer: Quantizer, n_threads: int) -> None:
        self._name = name
        self.lost = LostUnits(grid)
        self._quantizer = quantizer
        self._dtype = np.dtype(quantizer.dtype)
        self._n_threads = n_threads
        self._is_closed = False
        self.renew()
        renew_after_fork(self)

    def renew(self) -> None:
        """Reset after a fork, which copies no threads: the first read starts some."""
        self._crew = Crew(self._n_threads)

    def close(self) -> None:
        self._is_closed = True
        self._crew.shutdown()

    def read(
        self,
        decoder: TreeDecoder,
        level: int,
        region: Region,
        on_error: str = "raise",
        *,
        is_own: bool,
        void_value: float | None = None,
    ) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Return raw heights of a region of a level and the voids, None without voids.

        With `on_error` ``"mask"``, damaged units read as void; with `is_own`, so do samples that
        are not valid by themselves. With `void_value` voids have that height, and are not returned.
        """
        # A part of a flat array, as units that write to it take it.
        heights = np.zeros(region.n_rows * region.n_cols, dtype=self._dtype).reshape(region.shape)
        base, out = self._quantizer.shift, None
        if base is not None and self._dtype in (np.int16, np.int32):  # kernels for few types
            out = Raw(heights, base)
        voids: _Voids | _Filled
        if void_value is None:
            voids = _Voids(region, are_all=on_error == "mask")
        else:
            voids = _Filled(heights, void_value)
            if on_error == "mask":
                heights[:] = void_value

        def fill(key: Block, rows: RowsOf) -> None:
            try:
                there, unit = decoder.part_once(key, region, rows, out)
                if not unit.is_raw:
                    self._fill(unit, heights[there])
                voids.note(there, unit.validity.own_mask if is_own else unit.validity.mask)
            except CorruptStreamError as error:
                if on_error == "raise":
                    raise
                _log.info("read as void: %s", error)
                self.lost.note(key, error)

        keys = decoder.keys(level, region)
        _log.debug("level %d, window %s: %d units", level, tuple(region), len(keys))
        for first in range(0, len(keys), _BATCH):
            batch = keys[first : first + _BATCH]
            missing, rows = decoder.prefetch_for(batch, region)
            # The units above a single unit are a chain, in which threads would only wait for one
            # another.
            if len(batch) == 1 or self._n_threads == 1:
                for key in batch:
                    fill(key, rows)
            else:
                needed = list(dict.fromkeys([*missing, *batch]))
                self._run(_fill_or_decode(decoder, set(batch), fill, rows), needed)
        return heights, voids.marked

    def bilinear(
        self,
        decoder: TreeDecoder,
        level: int,
        rows: NDArray[np.float64],
        cols: NDArray[np.float64],
        *,
        is_own: bool,
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return bilinear raw heights at positions inside a level, and which involve a void.

        twz_points adds up in the same order (native/src/points.c), so that heights are equal.
        """
        n_rows, n_cols = decoder.grid.level_shape(level)
        top, left = np.floor(rows).astype(np.int64), np.floor(cols).astype(np.int64)
        bottom, right = np.minimum(top + 1, n_rows - 1), np.minimum(left + 1, n_cols - 1)
        down, across = rows - top, cols - left
        # All at once: units that hold several are decoded once, however small the cache is.
        found = decoder.samples(
            level,
            np.concatenate([top, top, bottom, bottom]),
            np.concatenate([left, right, left, right]),
        )
        raw = np.zeros(found.heights.shape, dtype=self._dtype)
        self._fill(found, raw)
        corners = raw.reshape(4, rows.size)
        valid = (found.own_mask if is_own else found.mask).reshape(4, rows.size)
        total, is_void = np.zeros(rows.size), np.zeros(rows.size, dtype=np.bool_)
        weights = (
            (1 - down) * (1 - across),
            (1 - down) * across,
            down * (1 - across),
            down * across,
        )
        for corner, is_valid, weight in zip(corners, valid, weights, strict=True):
            total += np.where(is_valid, corner.astype(np.float64), 0.0) * weight
            is_void |= ~is_valid & (weight > 0)
        return total, is_void

    def _fill(self, unit: Decoded, out: NDArray[Any]) -> None:
        """Fill `out` with the raw heights of a part of a unit."""
        if unit.remainders is None:
            self._quantizer.dequantize(unit.heights, out)
            return
        # Not in place: another thread fills the samples shared with a neighbouring unit.
        out[...] = exact_heights(self._quantizer, unit)

    def _run(self, work: Callable[[Block], None], keys: list[Block]) -> None:
        """Call `work` for every unit in the threads, ancestors first."""
        first, below = _by_parent(keys)

        def work_through(key: Block) -> list[Block]:
            work(key)
            return below[key]

        try:
            self._crew.grow(work_through, first)
        except RuntimeError as error:  # its threads were stopped
            if not self._is_closed:
                raise
            raise StorageError(f"{self._name} is closed") from error


def exact_heights(quantizer: Quantizer, unit: Decoded) -> NDArray[Any]:
    """Return the raw heights of a unit that has remainders (FORMAT.md §5.3).

    Raises
    ------
    CorruptStreamError
        If one of its valid samples is not finite.
    """
    assert unit.remainders is not None
    heights = restored(quantizer.dequantize(unit.heights), unit.remainders)
    if not np.isfinite(heights[unit.mask]).all():
        raise CorruptStreamError("remainders make a height that is not finite")
    return heights


def _by_parent(keys: list[Block]) -> tuple[list[Block], dict[Block, list[Block]]]:
    """Return the keys of units whose ancestors are not wanted, and the keys below each unit."""
    first: list[Block] = []
    below: dict[Block, list[Block]] = {key: [] for key in keys}
    for key in keys:
        parent = None if key.is_root_key else unit_key(key)
        (first if parent is None else below.get(parent, first)).append(key)
    return first, below


class _Voids:
    """Voids of a region; `marked` is None before the first.

    With `are_all`, samples count as void until they are noted.
    """

    def __init__(self, region: Region, *, are_all: bool) -> None:
        self.marked = np.ones(region.shape, dtype=np.bool_) if are_all else None
        self._are_all = are_all
        self._shape = region.shape
        self._lock = threading.Lock()

    def note(self, there: tuple[slice, slice], valid: NDArray[np.bool_] | None) -> None:
        """Record the valid samples of a part of the region; None: all are."""
        if valid is None and not self._are_all:
            return
        if self.marked is None:
            with self._lock:
                if self.marked is None:
                    self.marked = np.zeros(self._shape, dtype=np.bool_)
        if valid is None:
            self.marked[there] = False
        else:
            np.logical_not(valid, out=self.marked[there])


class _Filled(NamedTuple):
    """Heights whose voids get a value, unit by unit while it is in the processor's cache."""

    heights: NDArray[Any]
    value: float
    marked: None = None

    def note(self, there: tuple[slice, slice], valid: NDArray[np.bool_] | None) -> None:
        """Fill the voids of a part of the region, after its heights are set; None: it has none."""
        if valid is not None:
            # After the heights, so that samples shared by two threads' units end up equal.
            np.copyto(self.heights[there], self.value, where=np.logical_not(valid))


def _fill_or_decode(
    decoder: TreeDecoder,
    keys: set[Block],
    fill: Callable[[Block, RowsOf], None],
    rows: RowsOf,
) -> Callable[[Block], None]:
    """Return a function that fills `keys` and decodes their ancestors."""

    def work(key: Block) -> None:
        if key in keys:
            fill(key, rows)
        else:
            # Damage above a key is reported with the key.
            with contextlib.suppress(CorruptStreamError):
                decoder.unit(key, rows)

    return work
