"""Conversion of a raster from heights above a geoid or a tide to heights above the ellipsoid."""

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.crs import CRS

from terrainwave.errors import TerrainwaveWarning
from terrainwave.file import TerrainFile
from terrainwave.grid.affine import IDENTITY, Transform, samples_to_places
from terrainwave.grid.quadtree import Region
from terrainwave.place.crs import format_crs
from terrainwave.place.meaning import MARKS
from terrainwave.place.position import place_of
from terrainwave.place.units import height_unit
from terrainwave.place.vertical import EllipsoidalHeights, on_own_datum, radii_on_own_datum
from terrainwave.raster_io.raster_info import RasterInfo

# Metres per metre by which PROJ's conversion may stretch a difference of heights.
_STRETCH = 1e-6


@dataclass(frozen=True)
class AboveEllipsoid:
    """Metadata of a GeoTIFF with ellipsoidal heights, and the heights of its windows."""

    info: RasterInfo  # in metres, of the CRS with ellipsoidal heights
    # metadata of its heights: the bound of the full grid; none for coarse levels
    stated: dict[str, str]
    _way: EllipsoidalHeights
    _source: RasterInfo
    _metres: float

    def heights(
        self, part: Region, whole: Region, heights: NDArray[Any], valid: NDArray[np.bool_]
    ) -> NDArray[Any]:
        """Return the heights of a window above the ellipsoid; voids are undefined.

        `part` and `whole` are the window and the raster, of the same level; `heights` are those
        stored.
        """
        rows, cols = np.nonzero(valid)
        transform: Transform = self.info.transform
        x, y = samples_to_places(
            transform,
            (rows + part.row - whole.row).astype(np.float64),
            (cols + part.col - whole.col).astype(np.float64),
        )
        stored = heights[rows, cols].astype(np.float64)
        metres = (stored * self._source.scale + self._source.offset) * self._metres
        found = np.zeros(heights.shape, dtype=self.info.dtype)
        found[rows, cols] = self._way.heights(x, y, metres)
        return found


def above_ellipsoid(
    terrain: TerrainFile, info: RasterInfo, level: int, *, is_early: bool
) -> AboveEllipsoid:
    """Return the conversion of a raster to heights above its own CRS's ellipsoid; warn about it.

    `info` is that of the window to write, before the conversion. `is_early`: only a part of the
    bits is read, and the file's bound does not hold.
    """
    is_placed = tuple(info.transform) != IDENTITY
    place = place_of(info.crs, terrain.bounds, is_placed=is_placed)
    unit = height_unit(info.units, info.crs, info.heights_are)
    way = radii_on_own_datum(place) if unit.is_radius else on_own_datum(place, terrain.bounds)
    metres = unit.metres
    dtype = "float64" if info.dtype in ("float64", "int32") else "float32"
    bound = None
    if not is_early and terrain.level_index(level) == terrain.n_levels - 1:
        bound = _bound(terrain, abs(metres), np.dtype(dtype))
    within = "" if bound is None else f", within {bound:.6g} m of the originals"
    warnings.warn(f"{way.words}{within}", TerrainwaveWarning, stacklevel=3)
    tags = dict(info.tags) | {"TERRAINWAVE_VERTICAL": way.words}
    stated = {} if bound is None else {"MAX_ERROR": repr(bound)}
    target = info.crs if way.target is None else format_crs(CRS.from_wkt(way.target))
    converted = replace(
        info,
        dtype=dtype,
        # A number could equal a converted height.
        nodata=None if info.nodata is None else math.nan,
        mask_kind="nan" if info.mask_kind == "nodata" else info.mask_kind,
        units="metre",
        scale=1.0,
        offset=0.0,
        crs=target,
        tags=tuple(sorted(tags.items())),
        band_tags=tuple(tag for tag in info.band_tags if tag[0].lower() not in MARKS),
        heights_are=None,
    )
    return AboveEllipsoid(converted, stated, way, info, metres)


def _bound(terrain: TerrainFile, metres: float, dtype: np.dtype[Any]) -> float:
    """Return the bound of converted heights, in metres: the file's, plus the type's rounding."""
    summary = terrain.info()
    largest = max(abs(summary.minimum or 0.0), abs(summary.maximum or 0.0)) * metres
    spacing = float(np.spacing(dtype.type(2 * largest + 256)))
    return terrain.effective_error * metres * (1 + _STRETCH) + spacing / 2
