"""Heights of a tile at its cells, in whole units, and the tolerance of its mesh."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import check_vertical, checked_number
from terrainwave.errors import InvalidHeightsError
from terrainwave.export.quantized_mesh import STEPS
from terrainwave.globe.lonlat import Window
from terrainwave.globe.tile_scheme import TileScheme
from terrainwave.place.vertical import describe_as_is, describe_radii

# Share of Cesium's assumed error that a mesh may take; at most 1/16 of the terrain's range of
# heights.
_TOLERANCE_SHARE = 2
_RANGE_SHARE = 16
# Metres of a unit.
UNIT = 1.0 / 256
_MAX_HEIGHT = 1 << 30
# Bits of a number that float32 holds, less one for the sum of two.
_FLOAT_BITS = 22
_POLE = 90.0
# Points along a parallel whose mean is the height of a pole.
_N_AT_POLE = 64


class TileSamples(NamedTuple):
    """A tile's heights in whole units at (N + 3) x (N + 3) positions: the tile's and one around.

    `exact` are the heights in metres before they were rounded; NaN where void. `holes` are the void
    positions in the raster, unless voids are filled.
    """

    heights: NDArray[np.int32]
    exact: NDArray[np.float64]
    valid: NDArray[np.bool_]
    exists: NDArray[np.bool_]
    holes: NDArray[np.bool_]
    window: Window | None


class TileHeights:
    """Heights of the tiles of a scheme; the other arguments are those of `TilePyramid`."""

    def __init__(
        self, scheme: TileScheme, void_height: float, vertical: str, *, fill_voids: bool
    ) -> None:
        void_height = checked_number("void_height", void_height)
        self._scheme, self._globe = scheme, scheme.globe
        self._ellipsoidal = self._globe.onto_ellipsoid() if check_vertical(vertical) else None
        low, high = self._globe.height_range
        if self._ellipsoidal is not None:
            low, high = self._globe.range_on(self._ellipsoidal)
        self._low = math.floor(min(low, void_height) / UNIT)
        self._high = math.ceil(max(high, void_height) / UNIT)
        if max(-self._low, self._high) > _MAX_HEIGHT:
            raise InvalidHeightsError(
                f"found heights of {low:g} to {high:g} m, expected at most 4,000 km"
            )
        self._void = round(void_height / UNIT)
        self._fill_voids = fill_voids

    @property
    def vertical(self) -> dict[str, Any]:
        if self._ellipsoidal is not None:
            return self._ellipsoidal.describe()
        if self._globe.has_radii:
            return describe_radii()
        return describe_as_is(self._globe.terrain.crs)

    def tolerance(self, zoom: int) -> float:
        """Return the largest distance of a tile's mesh from the heights at its cells, in metres."""
        of_range = (self._high - self._low) * UNIT / _RANGE_SHARE
        return min(self._scheme.geometric_error(zoom) / _TOLERANCE_SHARE, of_range)

    def edge_tolerance(self, zoom: int) -> float:
        """Return the largest distance of a tile's mesh from the heights on its edges, in metres.

        On the finest zoom also from the raster's samples inside: by half of the file's bound, or by
        the resolution of a tile.
        """
        return min(self.tolerance(zoom), self.curvature_tolerance(zoom))

    def curvature_tolerance(self, zoom: int) -> float:
        """Return the largest distance of edges below the globe, in metres."""
        if not self._scheme.is_finest(zoom):
            return self._scheme.geometric_error(zoom) / _TOLERANCE_SHARE
        return max(self._globe.effective_error / 2, self.edge_step(zoom) * UNIT)

    def samples(self, zoom: int, x: int, y: int) -> TileSamples:
        """Return a tile's heights; those of its edges are the same in all adjacent tiles."""
        lon, lat = self._scheme.places(zoom, x, y)
        shape = len(lat), len(lon)
        exists = np.repeat(np.isfinite(lat)[:, None], len(lon), axis=1)
        level = self._globe.level_for(self._scheme.cell_size(zoom))
        # One height for each pole, where all longitudes meet.
        poles = np.flatnonzero(np.abs(lat) == _POLE)
        lats = np.where(np.isfinite(lat), lat, 0.0)
        rows, cols = self._globe.to_samples(np.tile(lon, len(lat)), np.repeat(lats, len(lon)))
        rows[~exists.ravel()] = np.nan
        surface, window = self._heights_at(rows, cols, level)
        exact = surface.reshape(shape)
        for row in poles:
            exact[row] = self._pole(float(lat[row]), level)
        exact[~exists] = np.nan
        valid = np.isfinite(exact)
        holes = np.isfinite(rows).reshape(shape) & ~valid & (not self._fill_voids)
        whole = np.where(valid, np.rint(np.where(valid, exact, 0.0) / UNIT), self._void)
        heights = np.clip(whole, self._low, self._high).astype(np.int32)
        step = self.edge_step(zoom)
        for edge in (heights[1], heights[-2], heights[:, 1], heights[:, -2]):
            edge[:] = (edge.astype(np.int64) + step // 2) // step * step
        return TileSamples(heights, exact, valid, exists, holes, window)

    def _heights_at(
        self, rows: NDArray[np.float64], cols: NDArray[np.float64], level: int
    ) -> tuple[NDArray[np.float64], Window | None]:
        heights, window = self._globe.heights_at(rows, cols, level)
        if self._ellipsoidal is not None:
            heights = self._globe.heights_on(self._ellipsoidal, rows, cols, heights)
        return heights, window

    def _pole(self, lat: float, level: int) -> float:
        lon = np.linspace(-180.0, 180.0, _N_AT_POLE, endpoint=False)
        rows, cols = self._globe.to_samples(lon, np.full(_N_AT_POLE, lat))
        heights, _ = self._heights_at(rows, cols, level)
        known = heights[np.isfinite(heights)]
        return float(known.mean()) if len(known) else math.nan

    def edge_step(self, zoom: int) -> int:
        """Return the quantum of heights on edges, in units: a power of two.

        Every tile of the zoom can represent it, whatever its range of heights.
        """
        reach = self._high - self._low + 2 * math.ceil(self.tolerance(zoom) / UNIT) + 2
        needed = max(
            -(-2 * reach // STEPS), max(-self._low, self._high, 1) + reach >> _FLOAT_BITS, 1
        )
        return 1 << (needed - 1).bit_length()

    def samples_in_tile(
        self, window: Window, zoom: int, x: int, y: int
    ) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]:
        """Return rows, columns (in cells) and heights of the samples of a window in a tile."""
        (lon, lat), heights = self._globe.places_of(window, self._ellipsoidal)
        size = 180 / (1 << zoom)
        rows = ((y + 1) * size - 90 - lat) / size * self._scheme.cells
        cols = np.mod(lon + 180 - x * size, 360) / size * self._scheme.cells
        inside = (rows >= 0) & (rows <= self._scheme.cells) & (cols <= self._scheme.cells)
        return (rows[inside], cols[inside]), heights[inside]
