"""A .twz file as a GeoTIFF computed on reading: for GDAL, QGIS and programs that use them.

The bytes are those of a tiled, uncompressed (Big)TIFF. Its head and the positions of all tiles are
known at once; a tile's heights are decoded when its bytes are read.
"""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.cache import Cache
from terrainwave.export.georeference import info_to_write, warn_of_crs
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Region
from terrainwave.raster_io.geotiff.sink import TILE
from terrainwave.raster_io.geotiff.sparse import Plane, sparse_geotiff
from terrainwave.raster_io.raster_info import stored_nodata

# Cache of tiles: GDAL reads heights and mask of an area one after the other.
_CACHE_BYTES = 32 << 20

Tile = tuple[NDArray[Any], NDArray[np.bool_]]


class VirtualGeoTIFF:
    """Bytes of a GeoTIFF of an open terrain, in any order; thread-safe.

    Heights of the full grid are those of `TerrainFile.read`, within its bound. Those of overviews
    are averages, centred in GDAL's pixels, and have no bound.
    """

    def __init__(self, terrain: TerrainFile) -> None:
        self.terrain = terrain
        self._tiles: Cache[tuple[int, int, int], Tile] = Cache(
            _CACHE_BYTES, size_of=lambda tile: tile[0].nbytes + tile[1].nbytes
        )

    @cached_property
    def _layout(self) -> tuple[bytes, list[Plane]]:
        terrain = self.terrain
        n_overviews, side = 0, max(terrain.shape)
        while side > TILE and n_overviews < terrain.n_levels:
            n_overviews += 1
            side = -(-side // 2)
        stated = {
            "MAX_ERROR": repr(terrain.effective_error),
            "METHOD": terrain.header.method,
            "OVERVIEWS": "averages of samples, without a bound",
            **({} if terrain.header.is_proved else {"PROOF": "none"}),
        }
        return sparse_geotiff(info_to_write(terrain), n_overviews, stated)

    def warn_of_crs(self) -> None:
        warn_of_crs(self._layout[0], self.terrain.raster_info)

    @property
    def size(self) -> int:
        return self._layout[1][-1].stop

    def read_at(self, place: int, n_bytes: int) -> bytes:
        """Return `n_bytes` from byte `place` on, fewer at the end."""
        head, planes = self._layout
        stop = min(place + max(n_bytes, 0), self.size)
        parts = [head[place:stop]]
        for plane in planes:
            first = max(place, plane.start)
            while first < min(stop, plane.stop):
                number, skip = divmod(first - plane.start, plane.tile_bytes)
                data = self._tile_bytes(plane, *divmod(number, plane.n_across))
                part = data[skip : skip + min(stop, plane.stop) - first]
                parts.append(part)
                first += len(part)
        return b"".join(parts)

    def _tile_bytes(self, plane: Plane, row: int, col: int) -> bytes:
        """Return the bytes of a tile; samples outside of the raster are void."""
        key = plane.shift, row * plane.tile, col * plane.tile
        heights, valid = self._tiles.get_or_make(key, lambda: self._tile(plane, *key[1:]))
        if plane.is_mask:
            return np.packbits(_padded(valid, plane.tile, False), axis=1).tobytes()
        little = heights.dtype.newbyteorder("<")
        return _padded(heights, plane.tile, 0).astype(little, copy=False).tobytes()

    def _tile(self, plane: Plane, row: int, col: int) -> Tile:
        """Return heights and validity of a plane's samples from (row, col) on."""
        whole = Region(0, 0, *plane.shape)
        region = Region(row, col, plane.tile, plane.tile).intersect(whole)
        terrain = self.terrain
        if plane.shift == 0:
            return terrain.read_with_mask(region)
        level = terrain.n_levels - plane.shift
        stride = 1 << (plane.shift - 1)
        finer = Region(2 * row, 2 * col, 2 * region.n_rows + 1, 2 * region.n_cols + 1)
        finer = finer.intersect(Region(0, 0, *terrain.level_shape(level)))
        heights, valid = terrain.read_with_mask(finer, level=level)
        sums, weights = np.where(valid, heights, 0).astype(np.float64), valid.astype(np.float64)
        for axis, n in enumerate(region.shape):
            sums, weights = (_averaged(values, stride, axis, n) for values in (sums, weights))
        is_valid = weights > 0
        means = np.divide(sums, weights, out=np.zeros_like(sums), where=is_valid)
        return self._stored(means, is_valid), is_valid

    def _stored(self, means: NDArray[np.float64], valid: NDArray[np.bool_]) -> NDArray[Any]:
        """Return averages in the type of the raster; none equals the void value."""
        info, dtype = self.terrain.raster_info, self.terrain.dtype
        void = stored_nodata(info.void_value, dtype)
        if dtype.kind != "f":
            means = np.rint(means)
        heights = means.astype(dtype)
        if info.nodata is not None:
            heights[valid & (heights == void)] = _beside(void)
        heights[~valid] = void
        return heights


def _beside(void: Any) -> Any:
    """Return a value next to the void value, towards 0."""
    if void.dtype.kind == "f":
        return np.nextafter(void, void.dtype.type(0 if void != 0 else 1))
    return void - np.sign(void) if void != 0 else void + 1


def _averaged(values: NDArray[np.float64], stride: int, axis: int, n: int) -> NDArray[np.float64]:
    """Return `n` weighted sums of samples 2i, 2i + 1, 2i + 2 along an axis, centred in their pixel.

    Samples lie `stride` pixels of the full grid apart, in the middle of pixels: pixel i of the
    overview has its centre stride - 1/2 pixels after sample 2i.
    """
    last = (0.5 - 0.5 / stride) / 2
    values = np.moveaxis(values, axis, 0)
    total = np.zeros((n, *values.shape[1:]))
    for k, weight in enumerate((0.5 - last, 0.5, last)):
        part = values[k::2][:n]
        total[: part.shape[0]] += weight * part
    return np.moveaxis(total, 0, axis)


def _padded(values: NDArray[Any], side: int, fill: Any) -> NDArray[Any]:
    """Return values in the top left corner of a square."""
    if values.shape == (side, side):
        return values
    square = np.full((side, side), fill, dtype=values.dtype)
    square[: values.shape[0], : values.shape[1]] = values
    return square
