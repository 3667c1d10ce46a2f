"""Windows of levels with the voids that a reader wants.

A sample of a coarse level is valid if any full-grid sample near it is: *any*. The codec and meshes
use these. If the full-grid sample at its position is void, its height is a fill. *Exact* voids
exclude fills, by information in the payloads.
"""

import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import ANY
from terrainwave.container.header import Header
from terrainwave.errors import CorruptStreamError, TerrainwaveWarning
from terrainwave.grid.quadtree import Region
from terrainwave.read.decoder import TreeDecoder
from terrainwave.read.lost import Lost
from terrainwave.read.native import NativeError, NativeFile
from terrainwave.read.window_reader import WindowReader

# Raw heights, and voids or None.
_Heights = tuple[NDArray[Any], NDArray[np.bool_] | None]
# Raw heights at points, and which involve a void.
_Points = tuple[NDArray[np.float64], NDArray[np.bool_]]
_Found = TypeVar("_Found")
# Stack level of the caller of an open file's method.
_STACK = 4


class LevelReader:
    """Reads windows and samples of levels of one open file.

    Parameters
    ----------
    name : str
        Name of the file in messages.
    decoder : callable
        Returns the decoder of the file's units, created on first use.
    native : NativeFile, optional
        Reader with the native library, for what it supports.
    n_threads : int
        Threads that decode.
    """

    def __init__(
        self,
        name: str,
        header: Header,
        n_threads: int,
        decoder: Callable[[], TreeDecoder],
        native: NativeFile | None,
    ) -> None:
        self._name = name
        self._decoder = decoder
        self._native = native
        self._windows = WindowReader(name, header.grid, header.quantizer, n_threads)

    def close(self) -> None:
        self._windows.close()
        if self._native is not None:
            self._native.close()

    @property
    def lost(self) -> list[Lost]:
        """Return the damaged units that reads have left void."""
        return self._windows.lost.list()

    def read(
        self,
        level: int,
        region: Region,
        on_error: str,
        voids: str,
        decoder: TreeDecoder | None = None,
        void_value: float | None = None,
    ) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Return raw heights of a region of a level and the voids, None without voids.

        `decoder` replaces the file's own. With `void_value`, voids get that height and are not
        returned.
        """
        is_own = voids != ANY

        def by_library(native: NativeFile) -> _Heights:
            return native.read(level, region, is_own=is_own)

        def by_units(units: TreeDecoder) -> _Heights:
            return self._windows.read(
                units, level, region, on_error, is_own=is_own, void_value=void_value
            )

        if decoder is not None:
            return by_units(decoder)
        return self._either(by_library, by_units, on_error)

    def _either(
        self,
        by_library: Callable[[NativeFile], _Found],
        by_units: Callable[[TreeDecoder], _Found],
        on_error: str = "raise",
    ) -> _Found:
        """Read with the native library; if it is missing or fails, with the file's decoder.

        That decoder decides what is damaged, and gives the message.
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
        voids: str,
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return bilinear raw heights at positions inside a level, and which involve a void."""
        is_own = voids != ANY

        def by_library(native: NativeFile) -> _Points:
            heights, valid = native.bilinear(level, rows, cols, is_own=is_own)
            return heights, ~valid

        return self._either(
            by_library,
            lambda decoder: self._windows.bilinear(decoder, level, rows, cols, is_own=is_own),
        )
