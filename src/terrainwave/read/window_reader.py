"""Windows and samples of a level: units decoded in threads, quanta converted to heights.

A sample of a coarse level is valid if any full-grid sample near it is: *any*. The codec and meshes
use these. If the full-grid sample at its position is void, its height is a fill. *Exact* voids
exclude fills, by information in the payloads.
"""

import contextlib
import logging
import threading
import warnings
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import ANY, EXACT
from terrainwave.codec.refiner import Decoded, Raw, Refiner
from terrainwave.codec.registry import refiner_by_name
from terrainwave.coding.native_library import NativeError
from terrainwave.container.header import Header
from terrainwave.errors import CorruptStreamError, StorageError, TerrainwaveWarning
from terrainwave.forks import renew_after_fork
from terrainwave.grid.crew import Crew
from terrainwave.grid.quadtree import Block, Region
from terrainwave.grid.quantum import Quantizer
from terrainwave.grid.remainders import restored
from terrainwave.names import METHODS
from terrainwave.read.decoder import TreeDecoder, unit_key, units_of
from terrainwave.read.fetched import Payloads

if TYPE_CHECKING:
    from terrainwave.read.lost import Lost
    from terrainwave.read.native import NativeFile

_log = logging.getLogger(__name__)

# Payloads fetched ahead of decoding, in one coalesced request.
_BATCH = 64
# Stack level of the caller of an open file's method.
_STACK = 4

# Raw heights, and voids or None.
_Heights = tuple[NDArray[Any], NDArray[np.bool_] | None]
_Found = TypeVar("_Found")


def make_decoder(
    header: Header,
    payloads: Payloads,
    cache_bytes: int,
    *,
    refiner: Refiner | None = None,
    are_prefixes: bool = False,
) -> TreeDecoder:
    """Return the decoder of a file with this header.

    Its tables are parsed unless `refiner` is given. With `are_prefixes`, payloads may end early
    (`Terrain.read_early`).
    """
    grid, parameters = header.grid, header.codec_parameters
    if METHODS[header.method].is_tiled:
        from terrainwave.codec.cdf53.refiner import decode_tile  # what most files do not need
        from terrainwave.read.tile_decoder import TiledDecoder

        decode = partial(decode_tile, is_prefix=are_prefixes)
        return TiledDecoder(grid, parameters, payloads, cache_bytes, decode)
    refiner = refiner or refiner_by_name(header.method, header.file_tables)
    return TreeDecoder(grid, parameters, refiner, payloads, cache_bytes)


class WindowReader:
    """Reads windows and samples of levels of one open file, with its threads.

    Parameters
    ----------
    name : str
        Name of the file in messages.
    n_threads : int
        Threads that decode; none are started for one.
    decoder : callable
        Returns the decoder of the file's units, created on first use.
    native : NativeFile, optional
        Reader with the native library, for what it supports.
    """

    def __init__(
        self,
        name: str,
        header: Header,
        n_threads: int,
        decoder: Callable[[], TreeDecoder],
        native: "NativeFile | None" = None,
    ) -> None:
        self._name = name
        self._grid, self._quantizer = header.grid, header.quantizer
        self._dtype = np.dtype(header.dtype)
        self._n_threads = n_threads
        self._decoder = decoder
        self._native = native
        self._problems: dict[Block, str] = {}
        self._is_closed = False
        self.renew()
        renew_after_fork(self)

    def renew(self) -> None:
        """Reset after a fork, which copies no threads: the first read starts some."""
        self._crew = Crew(self._n_threads)

    def close(self) -> None:
        self._is_closed = True
        self._crew.shutdown()
        if self._native is not None:
            self._native.close()

    @property
    def lost(self) -> "list[Lost]":
        """Return the damaged units that reads have left void, coarse levels first."""
        from terrainwave.read.lost import Lost

        found = []
        for key, problem in sorted(self._problems.copy().items()):
            if key.is_root_key:
                region = self._grid.block_region(Block(0, key.row, key.col))
            else:
                region = self._grid.group_region(key)
            row, col, n_rows, n_cols = map(int, region)
            found.append(Lost(key.level + 1, (row, col, n_rows, n_cols), problem))
        return found

    def read(
        self,
        level: int,
        region: Region,
        on_error: str = "raise",
        voids: str = EXACT,
        decoder: TreeDecoder | None = None,
        void_value: float | None = None,
    ) -> _Heights:
        """Return raw heights of a region of a level and the voids, None without voids.

        With `on_error` ``"mask"``, damaged units read as void. `decoder` replaces the file's own.
        With `void_value`, voids get that height and are not returned.
        """
        is_own = voids != ANY

        def by_units(units: TreeDecoder) -> _Heights:
            return self._decoded(units, level, region, on_error, is_own, void_value)

        if decoder is not None:
            return by_units(decoder)
        return self._either(
            lambda native: native.window(level, region, is_own=is_own), by_units, on_error
        )

    def _either(
        self,
        by_library: Callable[["NativeFile"], _Found],
        by_units: Callable[[TreeDecoder], _Found],
        on_error: str = "raise",
    ) -> _Found:
        """Read with the native library; if it is missing or fails, with the file's decoder.

        That decoder decides what is damaged, and gives the message.
        """
        contradicts = ""
        if self._native is not None:
            try:
                return by_library(self._native)
            except NativeError as error:
                contradicts = str(error) if error.is_damage and on_error == "raise" else ""
            except CorruptStreamError:
                pass
        found = by_units(self._decoder())
        if contradicts:
            warnings.warn(
                f"the native library cannot read {self._name} ({contradicts}), and terrainwave"
                " itself can: heights are good; please report it with the file",
                TerrainwaveWarning,
                stacklevel=_STACK,
            )
        return found

    def _decoded(
        self,
        decoder: TreeDecoder,
        level: int,
        region: Region,
        on_error: str,
        is_own: bool,
        void_value: float | None,
    ) -> _Heights:
        """Do as `read`; with `is_own`, samples that are not valid by themselves are voids, too."""
        # A part of a flat array, as units that write to it take it.
        heights = np.zeros(region.n_rows * region.n_cols, dtype=self._dtype).reshape(region.shape)
        base, out = self._quantizer.shift, None
        if base is not None and self._dtype in (np.int16, np.int32):  # kernels for few types
            out = Raw(heights, base)
        voids = _Voids(heights, void_value, are_all=on_error == "mask")
        keys = units_of(decoder.grid, level, region)
        _log.debug("level %d, window %s: %d units", level, tuple(region), len(keys))
        for first in range(0, len(keys), _BATCH):
            batch = keys[first : first + _BATCH]
            missing, rows = decoder.prefetch_for(batch, region)
            wanted = set(batch)

            def work(key: Block) -> None:
                if key not in wanted:  # noqa: B023  called at once
                    # Damage above a key is reported with the key.
                    with contextlib.suppress(CorruptStreamError):
                        decoder.unit(key, rows)  # noqa: B023
                    return
                try:
                    there, unit = decoder.part_once(key, region, rows, out)  # noqa: B023
                    if not unit.is_raw:
                        self._fill(unit, heights[there])
                    voids.note(there, unit.validity.own_mask if is_own else unit.validity.mask)
                except CorruptStreamError as error:
                    if on_error == "raise":
                        raise
                    _log.info("read as void: %s", error)
                    self._problems.setdefault(key, str(error))

            # The units above a single unit are a chain, in which threads would only wait for one
            # another.
            if len(batch) == 1 or self._n_threads == 1:
                for key in batch:
                    work(key)
            else:
                self._work_down(work, list(dict.fromkeys([*missing, *batch])))
        return heights, voids.marked

    def bilinear(
        self, level: int, rows: NDArray[np.float64], cols: NDArray[np.float64], voids: str
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return bilinear raw heights at positions inside a level, and which involve a void."""
        return self._either(
            lambda native: native.bilinear(level, rows, cols, is_own=voids != ANY),
            lambda decoder: self._bilinear(decoder, level, rows, cols, is_own=voids != ANY),
        )

    def _bilinear(
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

    def _work_down(self, work: Callable[[Block], None], keys: list[Block]) -> None:
        """Call `work` for every unit in the threads, ancestors first."""
        first: list[Block] = []
        below: dict[Block, list[Block]] = {key: [] for key in keys}
        for key in keys:
            parent = None if key.is_root_key else unit_key(key)
            (first if parent is None else below.get(parent, first)).append(key)

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
    """Return the raw heights of a unit that has remainders (FORMAT.md §5.3)."""
    assert unit.remainders is not None
    heights = restored(quantizer.dequantize(unit.heights), unit.remainders)
    if not np.isfinite(heights[unit.mask]).all():
        raise CorruptStreamError("remainders make a height that is not finite")
    return heights


class _Voids:
    """Voids of a region of heights: they get a value, or are marked; None before the first.

    With `are_all`, samples count as void until they are noted. A value is set unit by unit, while
    the heights are in the processor's cache.
    """

    def __init__(self, heights: NDArray[Any], value: float | None, *, are_all: bool) -> None:
        self.marked: NDArray[np.bool_] | None = None
        self._heights, self._value, self._are_all = heights, value, are_all
        self._lock = threading.Lock()
        if are_all and value is None:
            self.marked = np.ones(heights.shape, dtype=np.bool_)
        elif are_all:
            heights[:] = value

    def note(self, there: tuple[slice, slice], valid: NDArray[np.bool_] | None) -> None:
        """Record the valid samples of a part whose heights are set; None: all are."""
        if self._value is not None:
            if valid is not None:
                # After the heights, so that samples shared by two threads' units end up equal.
                np.copyto(self._heights[there], self._value, where=np.logical_not(valid))
            return
        if valid is None and not self._are_all:
            return
        with self._lock:
            if self.marked is None:
                self.marked = np.zeros(self._heights.shape, dtype=np.bool_)
        if valid is None:
            self.marked[there] = False
        else:
            np.logical_not(valid, out=self.marked[there])
