"""The accessor ``da.terrainwave`` of xarray's DataArrays; importing this module registers it.

xarray loads it with the backend when it first opens a file of any kind without ``engine=``.
"""

import os
from typing import Any

import xarray as xr

from terrainwave.ext.xarray_backend import TerrainwaveBackend
from terrainwave.write.compress import CompressResult, compress

__all__ = ["TerrainwaveAccessor", "TerrainwaveBackend"]


@xr.register_dataarray_accessor("terrainwave")
class TerrainwaveAccessor:
    """What terrainwave adds to a DataArray."""

    def __init__(self, array: xr.DataArray) -> None:
        self._array = array

    def to_twz(self, path: str | os.PathLike[str], **options: Any) -> CompressResult:
        """Compress the array to a .twz file; see `terrainwave.compress` for the options.

        Place, CRS and voids are taken from coordinates, attributes and encoding, as rioxarray and
        ``open_dataset`` write them. Heights as they were opened from a .twz file add the bound of
        that one to the new one. A lazy array is computed window by window: three times, as
        `compress` scans, codes and proves, and once more where it came from a .twz file, so persist
        it if that is dear.
        """
        return compress(self._array, path, **options)
