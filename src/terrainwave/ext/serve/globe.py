"""A terrain on the globe: heights in metres at longitude and latitude."""

import contextlib
import math
import warnings
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidHeightsError, TerrainwaveWarning
from terrainwave.raster_io.crs import parse_crs
from terrainwave.terrain import Terrain
from terrainwave.tri.frames import metres_per_unit

if TYPE_CHECKING:
    from rasterio.crs import CRS

# Of a pixel: forgives the rounding of coordinates at the outermost samples.
_SLACK = 1e-6


class GeographicBounds(NamedTuple):
    """Degrees; `west` is at least -180 and below 180, `east` may pass 180."""

    west: float
    south: float
    east: float
    north: float


class GlobeTerrain:
    """Heights of an open `Terrain` at longitude and latitude (degrees, WGS 84).

    Parameters
    ----------
    terrain : Terrain
        With a coordinate reference system, or without one where its coordinates fit degrees.

    Raises
    ------
    InvalidHeightsError
        If the terrain has no place on the globe.
    """

    def __init__(self, terrain: Terrain) -> None:
        self.terrain = terrain
        self._crs = parse_crs(terrain.crs)
        a, b, c, d, e, f = terrain.transform()
        if a * e == b * d or not all(map(math.isfinite, (a, b, c, d, e, f))):
            raise InvalidHeightsError(
                f"found the affine transform {(a, b, c, d, e, f)}, expected one that can be"
                " inverted: the terrain has no place on the globe"
            )
        if self._crs is None:
            left, bottom, right, top = terrain.bounds
            # A grid of samples on the poles and both ends of the date line has pixels beyond them.
            margin = max(abs(a), abs(e)) / 2 + 1e-9
            if not (
                left >= -360 - margin and right <= 360 + margin
                and bottom >= -90 - margin and top <= 90 + margin
            ):  # fmt: skip
                raise InvalidHeightsError(
                    "the terrain has no coordinate reference system and its coordinates are not"
                    " degrees: it has no place on the globe (compress a raster that has one)"
                )
            warnings.warn(
                "there is no coordinate reference system; the coordinates fit degrees and are"
                " taken for longitude and latitude on the Earth",
                TerrainwaveWarning,
                stacklevel=2,
            )
        self.metres = metres_per_unit(terrain.raster_info.units)

    @property
    def is_geographic(self) -> bool:
        """True if the terrain's own coordinates are longitude and latitude."""
        return self._crs is None or bool(self._crs.is_geographic)

    @cached_property
    def is_global(self) -> bool:
        """True if the columns go all the way round: the last is followed by the first."""
        a, b, _, d, _, _ = self.terrain.transform()
        return (
            self.is_geographic and b == 0 == d
            and abs(abs(a) * self.terrain.shape[1] - 360) <= 0.5 * abs(a)
        )  # fmt: skip

    @cached_property
    def lowest(self) -> float:
        """Return the lowest height in metres, 0 if there is none."""
        return (self.terrain.info().minimum or 0.0) * self.metres

    @cached_property
    def bounds(self) -> GeographicBounds:
        """Degrees that the terrain's pixels cover."""
        left, bottom, right, top = self.terrain.bounds
        if not self.is_geographic:
            from rasterio.warp import transform_bounds

            left, bottom, right, top = transform_bounds(self._crs, _wgs84(), *self.terrain.bounds)
            right += 360 * (right < left)
        turns = math.floor((left + 180) / 360) * 360
        if self.is_global:
            left, right, turns = -180.0, 180.0, 0
        return GeographicBounds(
            left - turns, max(bottom, -90.0), right - turns, min(top, 90.0)
        )  # fmt: skip

    def spacing(self, longitude: float, latitude: float, step: float) -> float:
        """Return how many samples of the full grid a step of `step` degrees of longitude crosses.

        The smaller of a step to the east and a step of the same length to the north; 0 where
        the coordinate reference system does not reach.
        """
        west, south, east, north = self.bounds
        small = min(step, (east - west) / 16, (north - south) / 16)
        upward = small * max(math.cos(math.radians(latitude)), 1e-3)
        longitudes = longitude + np.array([0.0, small, 0.0])
        rows, cols = self.places(longitudes, latitude + np.array([0.0, 0.0, -upward]))
        steps = np.hypot(rows[1:] - rows[0], cols[1:] - cols[0])
        return float(steps.min() * step / small) if np.isfinite(steps).all() else 0.0

    def heights(
        self, longitudes: NDArray[np.float64], latitudes: NDArray[np.float64], level: int = -1
    ) -> NDArray[np.float64]:
        """Return bilinear heights in metres, NaN outside the terrain's pixels and in voids.

        Parameters
        ----------
        longitudes, latitudes : ndarray of float64, shape (n,)
            Degrees; any turn of longitude.
        level : int
            Of the samples between which heights are interpolated. Where they do not reach (half a
            pixel inside the outermost pixels, the last partial cells of coarse levels, beside
            voids) finer levels stand in, at last the full grid with its outermost samples repeated.
        """
        terrain = self.terrain
        rows, cols = self.places(longitudes, latitudes)
        n_rows, n_cols = terrain.shape
        last = (n_rows - 1, n_cols - 1)
        reach = 0.5 + _SLACK
        rows, cols = np.nan_to_num(rows, nan=-np.inf), np.nan_to_num(cols, nan=-np.inf)
        inside = (rows >= -reach) & (rows <= last[0] + reach)
        if self.is_global:
            cols = np.mod(cols, n_cols)
        inside &= (cols >= -reach) & (cols <= last[1] + reach + 0.5 * self.is_global)
        heights = np.full(rows.shape, np.nan)
        rows = np.clip(rows, 0, last[0])
        seam = inside & (cols > last[1]) if self.is_global else np.zeros_like(inside)
        cols = np.clip(cols, 0, n_cols if self.is_global else last[1])
        todo = inside & ~seam
        for finer in range(terrain.level_index(level), terrain.n_levels):
            if not todo.any():
                break
            heights[todo] = terrain.sample(self._crs_points(rows[todo], cols[todo]), level=finer)
            todo &= np.isnan(heights)
        if seam.any():
            share = cols[seam] - last[1]
            ends = [np.zeros(share.size), np.full(share.size, float(last[1]))]
            first, final = (
                terrain.sample(self._crs_points(rows[seam], end), level=-1) for end in ends
            )
            heights[seam] = final * (1 - share) + first * share
        return heights * self.metres

    def places(
        self, longitudes: NDArray[np.float64], latitudes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return fractional (rows, cols) on the full grid; integers are samples.

        Not finite where the terrain's coordinate reference system does not reach.
        """
        x, y = np.asarray(longitudes, dtype=np.float64), np.asarray(latitudes, dtype=np.float64)
        if self.is_geographic:
            left = self.terrain.bounds[0]
            x = left + np.mod(x - left, 360.0)
        else:
            x, y = self._project(x, y)
        a, b, c, d, e, f = self.terrain.transform()
        determinant = a * e - b * d
        with np.errstate(all="ignore"):
            x, y = x - c, y - f
            return (a * y - d * x) / determinant - 0.5, (e * x - b * y) / determinant - 0.5

    def _project(
        self, longitudes: NDArray[np.float64], latitudes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (x, y) in the terrain's system, NaN far from the terrain: there it may fail."""
        from rasterio._err import CPLE_BaseError
        from rasterio.warp import transform

        west, south, east, north = self.bounds
        around = max(east - west, north - south, 1e-6) / 4
        turned = (west - around) + np.mod(longitudes - (west - around), 360.0)
        near = (turned <= east + around) & (np.abs(latitudes - (south + north) / 2) <= around * 3)
        x, y = np.full(turned.shape, np.nan), np.full(turned.shape, np.nan)
        with contextlib.suppress(CPLE_BaseError):
            x[near], y[near] = transform(_wgs84(), self._crs, turned[near], latitudes[near])
        return x, y

    def _crs_points(
        self, rows: NDArray[np.float64], cols: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return (x, y) of fractional rows and columns, moved inwards by rounding."""
        n_rows, n_cols = self.terrain.shape
        rows = np.clip(rows, _SLACK * (n_rows > 1), n_rows - 1 - _SLACK) + 0.5
        cols = np.clip(cols, _SLACK * (n_cols > 1), n_cols - 1 - _SLACK) + 0.5
        a, b, c, d, e, f = self.terrain.transform()
        return np.stack([a * cols + b * rows + c, d * cols + e * rows + f], axis=-1)


def _wgs84() -> "CRS":
    from rasterio.crs import CRS

    return CRS.from_epsg(4326)
