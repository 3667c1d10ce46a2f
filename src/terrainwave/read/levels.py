"""Windows of levels with the voids that a reader asks for.

A sample of a coarse level is valid where any full-grid sample near it is; that is what the codec
and meshes work with: *any*. Where the full-grid sample at its place is void, its height is a fill.
*Exact* leaves these out, as the payloads tell, or in older files the masks of the full grid.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import VOIDS, one_of
from terrainwave.codec.refiner import Decoded
from terrainwave.container.header import Header
from terrainwave.errors import InvalidArgumentError, TerrainwaveWarning
from terrainwave.grid.quadtree import Block, Region
from terrainwave.read.decoder import TreeDecoder
from terrainwave.read.finest import FinestMasks
from terrainwave.read.windows import WindowReader

EXACT, ANY = VOIDS
# To the frame that called a method of an open file.
_STACK = 4


class LevelReader:
    """Reads windows and samples of levels of one open file.

    Parameters
    ----------
    name : str
        What messages call the file.
    may_have_voids : bool
        Whether the file has a way to mark voids.
    n_threads : int
        Threads that decode.
    payloads : callable
        Returns the checked payloads of several units, near ones in one request.
    """

    def __init__(
        self,
        name: str,
        header: Header,
        n_threads: int,
        payloads: Callable[[Sequence[Block]], list[bytes]],
        *,
        may_have_voids: bool,
    ) -> None:
        self._windows = WindowReader(name, header.quantizer, n_threads)
        self._header = header
        self._payloads = payloads
        self._may_have_voids = may_have_voids
        self._has_told = False

    def close(self) -> None:
        """Stop the threads."""
        self._windows.close()

    @cached_property
    def _finest(self) -> FinestMasks:
        return FinestMasks(self._header, self._payloads)

    def _is_by_finest(self, level: int, voids: str | None) -> bool:
        """Say whether the masks of the full grid have to be read.

        Raises
        ------
        InvalidArgumentError
            If `voids` is neither None nor one of `VOIDS`.
        """
        if voids not in (None, *VOIDS):
            raise InvalidArgumentError(f"found `voids` {voids!r}, expected {one_of(VOIDS)}")
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
        decoder: TreeDecoder,
        level: int,
        region: Region,
        on_error: str,
        voids: str | None,
    ) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Return raw heights of a region of a level and what is void; None where nothing is."""
        is_by_finest = self._is_by_finest(level, voids)
        heights, void = self._windows.read(decoder, level, region, on_error, is_own=voids != ANY)
        if is_by_finest:
            valid = np.ones(region.shape, dtype=np.bool_) if void is None else ~void
            own = self._finest.own(level, region, valid, on_error)
            return heights, None if own.all() else ~own
        if voids is None and void is not None and self._is_untold(level):
            self._tell()
        return heights, void

    def bilinear(
        self,
        decoder: TreeDecoder,
        level: int,
        rows: NDArray[np.float64],
        cols: NDArray[np.float64],
        voids: str | None,
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return bilinear raw heights at places inside a level, and where a void takes part."""
        is_by_finest = self._is_by_finest(level, voids)
        may_tell = voids is None and self._is_untold(level)

        def valid_of(
            row: NDArray[np.int64], col: NDArray[np.int64], samples: Decoded
        ) -> NDArray[np.bool_]:
            if is_by_finest:
                return self._finest.samples(level, row, col)
            valid = (samples.mask if voids == ANY else samples.own_mask)[0]
            if may_tell and not valid.all():
                self._tell()
            return valid

        return self._windows.bilinear(decoder, level, rows, cols, valid_of)
