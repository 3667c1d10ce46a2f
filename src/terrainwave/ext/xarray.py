"""The accessor ``da.terrainwave`` of xarray's DataArrays; importing this module registers it.

xarray loads it with the backend when it first opens a file of any kind without ``engine=``.
"""

import os
from typing import Any

import xarray as xr

from terrainwave.errors import TerrainwaveError
from terrainwave.ext.xarray_backend import TerrainwaveBackend
from terrainwave.raster_io.source import RasterSource
from terrainwave.write.compress import CompressResult, compress
from terrainwave.write.earlier import bound_of

__all__ = ["TerrainwaveAccessor", "TerrainwaveBackend"]


@xr.register_dataarray_accessor("terrainwave")
class TerrainwaveAccessor:
    """Methods that terrainwave adds to a DataArray."""

    def __init__(self, array: xr.DataArray) -> None:
        self._array = array

    def to_twz(self, path: str | os.PathLike[str], **options: Any) -> CompressResult:
        """Compress the array to a .twz file; see `terrainwave.compress` for the options.

        Transform, CRS and voids are taken from coordinates, attributes and encoding, as rioxarray
        and ``open_dataset`` write them. If `bound` finds the heights in the .twz file that they
        came from, its bound is added to that of the new file. A lazy array is computed window by
        window: three times, as `compress` scans, codes and proves, and once more for `bound`, so
        persist it if that is expensive.
        """
        return compress(self._array, path, **options)

    def bound(self) -> float | None:
        """Read the array and the .twz file that it came from; return the bound of its heights.

        No valid sample is further from the file's original than the bound, which is in the file's
        unit. It is returned only if the array is a part of the file, or of one of its levels:
        values, voids and position are compared with those of the file in ``encoding["source"]``,
        which xarray keeps when heights change. Otherwise the result is None: for changed or
        resampled heights, several layers, or a file that is missing, damaged or replaced. Call it
        again after each operation; it computes a lazy array.
        """
        try:
            with RasterSource(self._array, warn=False) as source:
                n_layers = self._array.size // (source.info.n_rows * source.info.n_cols)
                return bound_of(source) if n_layers == 1 else None
        except TerrainwaveError:
            return None
