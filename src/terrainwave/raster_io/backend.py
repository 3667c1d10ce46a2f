"""`RasterBackend`: what a mosaic needs of each of its rasters."""

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Region
from terrainwave.raster_io.earlier_loss import EarlierLoss
from terrainwave.raster_io.even import Even


class RasterBackend(Protocol):
    """One band of a raster that lies somewhere: a dataset of GDAL's, or a .twz file.

    `is_lost` says that nothing tells where its samples lie, `has_mask` that `read` knows voids that
    no nodata value marks.
    """

    name: str
    n_rows: int
    n_cols: int
    dtype: np.dtype[Any]
    nodata: Any
    block_shape: tuple[int, int]
    transform: tuple[float, ...]
    crs: Any
    is_file: bool
    is_lost: bool
    has_mask: bool
    earlier: EarlierLoss | None

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
