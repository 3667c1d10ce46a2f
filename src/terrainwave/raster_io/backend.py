"""`RasterBackend`: a raster behind a source."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.affine import IDENTITY
from terrainwave.grid.quadtree import Region
from terrainwave.place.meaning import Told
from terrainwave.raster_io.even import Even
from terrainwave.raster_io.raster_info import EarlierLoss, stored_nodata


class RasterBackend:
    """One band of a raster: of a dataset of GDAL, a .twz file, an array, or a mosaic of these.

    `undeclared` are values that the raster declares void and that `nodata` turns into heights;
    `has_mask` is true if `read` finds voids without a nodata value. Without `told` it fits any
    file.
    """

    name: str
    n_rows: int
    n_cols: int
    dtype: np.dtype[Any]
    nodata: Any = None
    undeclared: tuple[int | float, ...] = ()
    block_shape: tuple[int, int]
    transform: tuple[float, ...] = IDENTITY
    crs: Any = None
    is_file = True
    is_lost = False
    has_mask = False
    earlier: EarlierLoss | None = None
    told: Told | None
    came_from: str | None = None
    # Whether any raster of several says what its numbers mean.
    is_told = False

    def notes(self) -> Iterator[str]:
        """Yield notes on omissions and choices, one sentence each."""
        return (f"{self.name}: {remark}" for remark in self.remarks())

    def remarks(self) -> Iterator[str]:
        return iter(())

    def asides(self) -> Iterator[str]:
        """Yield notes that need no warning, one sentence each, without the raster's name."""
        return iter(())

    def named_asides(self) -> Iterator[str]:
        return (f"{self.name}: {aside}" for aside in self.asides())

    def tags(self) -> dict[str, Any]:
        raise NotImplementedError

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return heights (a copy) and validity by the mask; for one thread at a time."""
        raise NotImplementedError

    def even(self, region: Region) -> Even | None:  # noqa: ARG002
        """Return the content of a region if the index gives it; None if only reading can tell."""
        return None

    def declared_voids(self, window: Region, heights: NDArray[Any]) -> NDArray[np.bool_]:  # noqa: ARG002
        return np.isin(heights, [stored_nodata(value, self.dtype) for value in self.undeclared])

    def parts(
        self,
        max_samples: int,  # noqa: ARG002
    ) -> Iterator[tuple[str, Told, Iterator[tuple[NDArray[Any], NDArray[np.bool_]]]]]:
        """Yield the name, own meaning and windows of each raster, if there are several."""
        return iter(())

    def again(self) -> "RasterBackend | None":
        return None

    def close(self) -> None:
        """Close the file, unless it belongs to the caller."""
