"""A .twz file as a raster source, like a GeoTIFF: for another bound, method, or mosaic."""

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.file import TerrainFile
from terrainwave.grid.affine import IDENTITY
from terrainwave.grid.quadtree import Region
from terrainwave.place.meaning import Told
from terrainwave.raster_io.backend import RasterBackend
from terrainwave.raster_io.even import Even
from terrainwave.raster_io.raster_info import EarlierFile, EarlierLoss, earlier_files, stored_nodata
from terrainwave.raster_io.source import RasterSource


def raster_source(source: Any, **options: Any) -> RasterSource:
    """Return a `RasterSource` that also opens .twz files; options as it has them."""
    return RasterSource(source, open_terrain=TerrainBackend, **options)


class TerrainBackend(RasterBackend):
    """A .twz file as a backend that reads decoded heights; an open file is not closed."""

    def __init__(self, source: Any, *, georeference: bool = True) -> None:
        self._owned = not isinstance(source, TerrainFile)
        terrain: TerrainFile = TerrainFile(source) if self._owned else source
        self._terrain = terrain
        info = self._info = terrain.raster_info
        self.name = str(terrain.name)
        self.n_rows, self.n_cols = terrain.shape
        self.dtype = terrain.dtype
        self.nodata = info.nodata
        side = 2 * terrain.grid.block
        self.block_shape = (side, side)
        self.is_lost = info.crs is None and tuple(info.transform) == IDENTITY
        self._is_placed = georeference and not self.is_lost
        self.transform = tuple(info.transform) if self._is_placed else IDENTITY
        self.crs = info.rasterio_crs() if self._is_placed else None
        self.has_mask = info.mask_kind == "mask"
        self.told = Told(info.heights_are, "its metadata")
        if info.heights_are is None:
            self.told = info.told
        bound = terrain.effective_error
        own = EarlierFile(os.path.basename(self.name), bound)
        files = (*earlier_files(terrain.header.metadata), own) if bound else ()
        self.earlier = EarlierLoss(bound, files)

    def tags(self) -> dict[str, Any]:
        names = ("units", "scale", "offset", "area_or_point", "description", "color_interpretation")
        fields = {name: getattr(self._info, name) for name in (*names, "tags", "band_tags")}
        placed = {name: getattr(self._info, name) for name in ("crs", "coordinate_epoch")}
        return fields | (placed if self._is_placed else dict.fromkeys(placed))

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        return self._terrain.read_with_mask((row, col, n_rows, n_cols))

    def even(self, region: Region) -> Even | None:
        if next(self._terrain.coded_parts(region), None) is not None:
            return None
        return Even(stored_nodata(self._info.void_value, self.dtype), False)

    def close(self) -> None:
        if self._owned:
            self._terrain.close()
