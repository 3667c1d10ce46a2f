"""Windows of levels with the voids that a reader asks for.

A sample of a coarse level is valid where any full-grid sample near it is; that is what the codec
and meshes work with: *any*. Where the full-grid sample at its place is void, its height is a fill.
*Exact* leaves these out, as the payloads tell, or in older files the masks of the full grid.
"""

import warnings
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import VOIDS
from terrainwave.container.header import Header
from terrainwave.errors import CorruptStreamError, TerrainwaveWarning
from terrainwave.grid.quadtree import Region
from terrainwave.read.decoder import TreeDecoder
from terrainwave.read.fetched import Payloads
from terrainwave.read.lost import Lost
from terrainwave.read.native import NativeError, NativeFile
from terrainwave.read.window_reader import WindowReader, bilinear

if TYPE_CHECKING:
    from terrainwave.read.finest import FinestMasks

EXACT, ANY = VOIDS
# Raw heights, and what is void; None where nothing is.
_Heights = tuple[NDArray[Any], NDArray[np.bool_] | None]
# Raw heights, and which are valid.
_Samples = tuple[NDArray[Any], NDArray[np.bool_]]
_Found = TypeVar("_Found")
# To the frame that called a method of an open file.
_STACK = 4


class LevelReader:
    """Reads windows and samples of levels of one open file.

    Parameters
    ----------
    name : str
        What messages call the file.
    decoder : callable
        Returns the decoder of the file's units, made when it is first needed.
    native : NativeFile, optional
        What reads the file by the native library, as far as that can.
    may_have_voids : bool
        Whether the file has a way to mark voids.
    n_threads : int
        Threads that decode.
    """

    def __init__(
        self,
        name: str,
        header: Header,
        n_threads: int,
        payloads: Payloads,
        decoder: Callable[[], TreeDecoder],
        native: NativeFile | None,
        *,
        may_have_voids: bool,
    ) -> None:
        self._name = name
        self._decoder = decoder
        self._native = native
        self._windows = WindowReader(name, header.grid, header.quantizer, n_threads)
        self._header = header
        self._payloads = payloads
        self._may_have_voids = may_have_voids
        self._has_told = False

    def close(self) -> None:
        """Stop the threads."""
        self._windows.close()
        if self._native is not None:
            self._native.close()

    @property
    def lost(self) -> list[Lost]:
        """Return the damaged units that reads have left void."""
        return self._windows.lost.list()

    @cached_property
    def _finest(self) -> "FinestMasks":
        from terrainwave.read.finest import FinestMasks  # numba, which not every reader needs

        return FinestMasks(self._header, self._payloads, self._windows.lost)

    def _is_by_finest(self, level: int, voids: str | None) -> bool:
        """Say whether the masks of the full grid have to be read."""
        return voids == EXACT and self._is_untold(level)

    def _is_untold(self, level: int) -> bool:
        """Say whether fills may be among the samples of a level, and the file does not tell."""
        is_coarse = level < self._header.grid.k_max
        return is_coarse and self._may_have_voids and not self._header.has_fills

    def _tell(self) -> None:
        """Note once that heights may be fills."""
        if not self._has_told:
            self._has_told = True
            warnings.warn(
                "the file is of format 1.0, which does not tell which heights of coarse levels are"
                " fills of voids beside valid samples: `voids` 'exact' finds them in the finest"
                " payloads, `voids` 'any' takes them without this note, and a file that is"
                " compressed again tells them",
                TerrainwaveWarning,
                stacklevel=_STACK,
            )

    def read(
        self,
        level: int,
        region: Region,
        on_error: str,
        voids: str | None,
        decoder: TreeDecoder | None = None,
        void_value: float | None = None,
    ) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Return raw heights of a region of a level and what is void; None where nothing is.

        `decoder` decodes them, where it is not the file's own. With `void_value`, voids that are
        not told have that height already.
        """
        is_by_finest, is_own = self._is_by_finest(level, voids), voids != ANY
        filled_with = None if self._is_untold(level) else void_value

        def by_library(native: NativeFile) -> _Heights:
            return native.read(level, region, is_own=is_own)

        def by_units(units: TreeDecoder) -> _Heights:
            return self._windows.read(
                units, level, region, on_error, is_own=is_own, void_value=filled_with
            )

        if decoder is not None:
            heights, void = by_units(decoder)
        else:
            heights, void = self._either(by_library, by_units, on_error)
        if is_by_finest:
            valid = np.ones(region.shape, dtype=np.bool_) if void is None else ~void
            own = self._finest.own(level, region, valid, on_error)
            return heights, None if own.all() else ~own
        if voids is None and void is not None and self._is_untold(level):
            self._tell()
        return heights, void

    def _either(
        self,
        by_library: Callable[[NativeFile], _Found],
        by_units: Callable[[TreeDecoder], _Found],
        on_error: str = "raise",
    ) -> _Found:
        """Read by the native library; where it is missing or fails, by the file's decoder.

        That decoder has the last word, and the words, on what is damaged.
        """
        if self._native is None:
            return by_units(self._decoder())
        contradicts = ""
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

    def bilinear(
        self,
        level: int,
        rows: NDArray[np.float64],
        cols: NDArray[np.float64],
        voids: str | None,
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return bilinear raw heights at places inside a level, and where a void takes part."""
        is_by_finest, is_own = self._is_by_finest(level, voids), voids != ANY
        may_tell = voids is None and self._is_untold(level)

        def samples(row: NDArray[np.int64], col: NDArray[np.int64]) -> _Samples:
            raw, valid = self._either(
                lambda native: native.samples(level, row, col, is_own=is_own),
                lambda decoder: self._windows.samples(decoder, level, row, col, is_own=is_own),
            )
            if is_by_finest:
                return raw, self._finest.samples(level, row, col)
            if may_tell and not valid.all():
                self._tell()
            return raw, valid

        return bilinear(self._header.grid.level_shape(level), rows, cols, samples)
