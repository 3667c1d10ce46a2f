"""A terrain on its globe: heights at longitudes and latitudes, and positions of its samples.

Between samples heights are bilinear; beyond the last sample of a coarse level they are continued
linearly, as in a block's error (FORMAT.md §4.4). The outermost half pixel has the heights of the
outermost samples. In a raster around the whole globe the first column follows the last.
"""

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidHeightsError
from terrainwave.file import TerrainFile
from terrainwave.grid.affine import IDENTITY, determinant, places_to_samples, samples_to_places
from terrainwave.grid.quadtree import Block
from terrainwave.place.ellipsoid import Ellipsoid
from terrainwave.place.position import place_of
from terrainwave.place.vertical import EllipsoidalHeights, onto_wgs84

Numbers = NDArray[np.float64]
Places = tuple[Numbers, Numbers]

# Degrees by which a point may differ after conversion to the raster's CRS and back.
_SAME_PLACE = 1e-6
# Share of a pixel that rounding may move a point beyond the raster's edge.
_AT_EDGE = 1e-6
# Largest run of unused columns that is read along with used ones.
_MAX_GAP = 256
# Points along each side of the raster, and inside it, used to find its extent on the globe.
_N_ALONG, _N_INSIDE = 129, 17
# Share of an extent by which a side may bulge between those points.
_BULGE = 0.01
# Points along each side used to find the distance of a datum from the ellipsoid, and the share of
# their difference by which other points may exceed it.
_N_OF_DATUM, _DATUM_SLACK = 65, 0.2
_POLE = 90.0


class Window(NamedTuple):
    """Samples of a level: rows from `row` on, the columns `columns` in ascending order.

    `heights` in metres, float64, radii as such, and `valid` have shape (n_rows, n_columns).
    """

    level: int
    row: int
    columns: NDArray[np.int64]
    heights: Numbers
    valid: NDArray[np.bool_]


class Extent(NamedTuple):
    """Part of the globe that a raster covers, in degrees; `east` may be beyond 180."""

    west: float
    south: float
    east: float
    north: float

    @property
    def centre(self) -> tuple[float, float]:
        """Return the longitude, -180 … 180, and the latitude of the middle."""
        longitude = (self.west + self.east) / 2
        return (longitude + 180) % 360 - 180, (self.south + self.north) / 2

    def holds(self, lon: Numbers, lat: Numbers) -> NDArray[np.bool_]:
        """Return which points lie in it, or close by, as its sides may bulge a little."""
        slack = _BULGE * max(self.east - self.west, self.north - self.south)
        beyond_west = np.mod(lon - self.west + slack, 360)
        return (
            (beyond_west <= self.east - self.west + 2 * slack)
            & (lat >= self.south - slack)
            & (lat <= self.north + slack)
        )


class Globe:
    """A terrain in longitude and latitude in degrees, heights in metres.

    Rasters of the Earth are on WGS 84, others on the datum of their own CRS, or on a sphere of
    `radius` metres. Raises `InvalidHeightsError` if the raster has no possible position there.
    """

    def __init__(self, terrain: TerrainFile, *, radius: float | None = None) -> None:
        raster = terrain.raster_info
        is_placed = raster.transform != IDENTITY
        place = place_of(raster.crs, terrain.bounds, is_placed=is_placed, radius=radius)
        if not place.has_globe:
            raise InvalidHeightsError(
                "the raster has no coordinate reference system, and no coordinates that fit"
                " degrees: it has no place on a globe. Name its CRS, for example by"
                " gdal_edit -a_srs, and compress it again"
            )
        if determinant(raster.transform) == 0:
            raise InvalidHeightsError("the affine transform cannot be inverted")
        if raster.impossible_places is not None:
            raise InvalidHeightsError(raster.impossible_places)
        place.note_sphere()
        self.terrain = terrain
        self._place = place
        self.body = place.body
        self.ellipsoid: Ellipsoid = place.globe_ellipsoid
        a, b, _, d, _, _ = raster.transform
        # Columns of 360 degrees, if rows are parallels.
        rows_are_parallels = place.is_plain and place.longitude_axis == 0 and b == d == 0
        self.turn = 360 / (abs(a) * place.unit) if rows_are_parallels else None
        self.is_whole_turn = self.turn is not None and abs(self.turn - terrain.shape[1]) < 0.01
        # Per unit of height; negative if heights are depths.
        unit = terrain.height_unit
        unit.note_kind()
        self.metres = unit.metres
        self.has_radii = unit.is_radius

    def to_samples(self, lon: Numbers, lat: Numbers) -> Places:
        """Return fractional rows and columns of the full grid; NaN outside the raster's pixels.

        Each depends only on its point, in degrees.
        """
        if self._place.is_lonlat:
            return self._to_samples(lon, lat)
        rows, cols = np.full(lon.shape, np.nan), np.full(lon.shape, np.nan)
        near = self.extent.holds(lon, lat)
        if near.any():
            rows[near], cols[near] = self._to_samples(lon[near], lat[near])
        return rows, cols

    def continued_samples(self, lon: Numbers, lat: Numbers) -> Places:
        """Return fractional rows and columns as if the full grid continued beyond its edges.

        NaN where the raster's system is undefined. For degrees, columns belong to the turn around
        the raster's middle.
        """
        xy = self._place.from_lonlat(np.stack([lon, lat], axis=1))
        axis = self._place.longitude_axis
        if axis is not None:
            turn = 360 / self._place.unit
            start = self._centre[axis] - turn / 2
            xy[:, axis] = start + np.mod(xy[:, axis] - start, turn)
        with np.errstate(all="ignore"):
            return places_to_samples(self.terrain.raster_info.transform, xy[:, 0], xy[:, 1])

    def _to_samples(self, lon: Numbers, lat: Numbers) -> Places:
        rows, cols = self.continued_samples(lon, lat)
        with np.errstate(all="ignore"):
            rows, is_row = _clamped(rows, self.terrain.shape[0])
            if self.is_whole_turn:
                is_col = np.isfinite(cols)
            else:
                cols, is_col = _clamped(cols, self.terrain.shape[1])
        inside = is_row & is_col
        if not self._place.is_lonlat and inside.any():
            # Projections may also give positions to points on the other side of the globe.
            inside[inside] = self._come_back(rows[inside], cols[inside], lon[inside], lat[inside])
        return np.where(inside, rows, np.nan), np.where(inside, cols, np.nan)

    @cached_property
    def _centre(self) -> tuple[float, float]:
        left, bottom, right, top = self.terrain.bounds
        return (left + right) / 2, (bottom + top) / 2

    def _come_back(
        self, rows: Numbers, cols: Numbers, lon: Numbers, lat: Numbers
    ) -> NDArray[np.bool_]:
        """Return which points their samples lead back to; clamping moves at most half a pixel."""
        found_lon, found_lat = self.from_samples(rows, cols)
        slack = max(_SAME_PLACE, math.degrees(2 * self.pixel / self.ellipsoid.axis))
        apart = np.abs(np.mod(found_lon - lon + 180, 360) - 180) * np.cos(np.radians(lat))
        near: NDArray[np.bool_] = (apart < slack) & (np.abs(found_lat - lat) < slack)
        return near

    def from_samples(self, rows: Numbers, cols: Numbers) -> Places:
        x, y = samples_to_places(self.terrain.raster_info.transform, rows, cols)
        lonlat = self._place.to_lonlat(np.stack([x, y], axis=1))
        return lonlat[:, 0], lonlat[:, 1]

    @property
    def units(self) -> str | None:
        """Return m, the unit of heights here; None if it is unknown: then they are as stored."""
        return None if self.terrain.units is None else "m"

    @cached_property
    def pixel(self) -> float:
        """Return the smaller distance of neighbouring samples in the raster's middle, in metres."""
        row, col = ((size - 1) / 2 for size in self.terrain.shape)
        lon, lat = self.from_samples(
            np.array([row, row + 0.5, row]), np.array([col, col, col + 0.5])
        )
        if not (np.isfinite(lon).all() and np.isfinite(lat).all()):
            raise InvalidHeightsError(
                "the raster's middle has no longitude and latitude in its coordinate reference"
                " system"
            )
        places = self.ellipsoid.geocentric(np.stack([lon, lat, np.zeros(3)], axis=1))
        return 2 * float(np.linalg.norm(places[1:] - places[0], axis=1).min())

    @cached_property
    def extent(self) -> Extent:
        n_rows, n_cols = self.terrain.shape
        along, inside = np.linspace(-0.5, 0.5, _N_ALONG), np.linspace(-0.5, 0.5, _N_INSIDE)
        first, last = np.full(_N_ALONG, -0.5), np.full(_N_ALONG, 0.5)
        down, across = np.meshgrid(inside, inside)
        rows = np.concatenate([along, along, first, last, down.ravel()])
        cols = np.concatenate([first, last, along, along, across.ravel()])
        rows, cols = (n_rows - 1) / 2 + n_rows * rows, (n_cols - 1) / 2 + n_cols * cols
        lon, lat = self.from_samples(rows, cols)
        known = np.isfinite(lon) & np.isfinite(lat)
        if not known.any():
            raise InvalidHeightsError("the raster has no place in longitude and latitude")
        middle = self.from_samples(np.array([(n_rows - 1) / 2]), np.array([(n_cols - 1) / 2]))[0][0]
        # Longitudes continuous from the middle, also across the antimeridian.
        if not self._place.is_lonlat:
            lon = middle + np.mod(lon - middle + 180, 360) - 180
        west, east = float(lon[known].min()), float(lon[known].max())
        south, north = float(lat[known].min()), float(lat[known].max())
        if not self._place.is_plain:
            rows, _ = self._to_samples(np.zeros(2), np.array([-_POLE, _POLE]))
            has_south, has_north = np.isfinite(rows)
            south, north = (-_POLE if has_south else south), (_POLE if has_north else north)
            if has_south or has_north:
                west, east = -180.0, 180.0
        if self.is_whole_turn or east - west >= 360 - _SAME_PLACE:
            west, east = -180.0, 180.0
        shift = 360 * math.floor((west + 180) / 360)
        return Extent(west - shift, max(south, -_POLE), east - shift, min(north, _POLE))

    @property
    def effective_error(self) -> float:
        return self.terrain.effective_error * abs(self.metres)

    def level_for(self, spacing: float) -> int:
        """Return the coarsest level whose samples are at most `spacing` metres apart."""
        n_coarser = math.floor(math.log2(max(spacing / self.pixel * (1 + 1e-6), 1.0)))
        return max(self.terrain.grid.k_max - n_coarser, 0)

    def heights_at(self, rows: Numbers, cols: Numbers, level: int) -> tuple[Numbers, Window | None]:
        """Return the bilinear heights of a level at positions of `to_samples`, and the window read.

        Metres; NaN at positions that are NaN, and where a sample needed is void. Each depends only
        on its position. The window is None if no position is in the raster.
        """
        heights = np.full(rows.shape, np.nan)
        inside = np.isfinite(rows)
        if not inside.any():
            return heights, None
        stride, grid = self.terrain.grid.stride(level), self.terrain.grid
        n_rows, n_cols = grid.level_shape(level)
        row, col = rows[inside] / stride, cols[inside] / stride
        # The last cell is continued linearly, with a weight of up to 2.
        top = np.clip(np.floor(row).astype(np.int64), 0, max(n_rows - 2, 0))
        down = row - top if n_rows > 1 else np.zeros_like(row)
        if self.is_whole_turn:
            left, right, across = self._around(col, n_cols, stride)
        else:
            left = np.clip(np.floor(col).astype(np.int64), 0, max(n_cols - 2, 0))
            across = col - left if n_cols > 1 else np.zeros_like(col)
            right = np.minimum(left + 1, n_cols - 1)
        bottom = np.minimum(top + 1, n_rows - 1)
        window = self._read(level, int(top.min()), int(bottom.max()), _distinct(left, right))
        total, is_void = _weighted(
            window,
            ((top - window.row, 1 - down), (bottom - window.row, down)),
            ((_among(window.columns, left), 1 - across), (_among(window.columns, right), across)),
        )
        total = self._above(total, rows[inside], cols[inside])
        heights[inside] = total if is_void is None else np.where(is_void, np.nan, total)
        return heights, window

    def sample(self, lon: Numbers, lat: Numbers) -> Numbers:
        """Return bilinear heights of the full grid at places in degrees, metres.

        NaN outside the raster's pixels and where a sample needed is void.
        """
        rows, cols = self.to_samples(lon, lat)
        heights = self.terrain.heights_at(rows, cols, is_round=self.is_whole_turn)
        return self._above(heights * self.metres, rows, cols)

    def _above(self, metres: Numbers, rows: Numbers, cols: Numbers) -> Numbers:
        """Return heights in metres at samples; for radii, their excess over the body.

        Subtracted after interpolation, as an ellipsoid bends between two samples of a coarse level.
        """
        if not self.has_radii:
            return metres
        if self.ellipsoid.e2 == 0:
            return metres - self.ellipsoid.axis
        return self.ellipsoid.heights_of_radii(self.from_samples(rows, cols)[1], metres)

    def _around(
        self, col: Numbers, n_cols: int, stride: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], Numbers]:
        """Return the columns left and right of positions; the last one's neighbour is the first."""
        turn = self.terrain.shape[1] / stride
        col = np.mod(col, turn)
        left = np.minimum(np.floor(col).astype(np.int64), n_cols - 1)
        is_last = left == n_cols - 1
        across = np.where(is_last, (col - left) / (turn - (n_cols - 1)), col - left)
        return left, np.where(is_last, 0, left + 1), across

    def _read(self, level: int, top: int, bottom: int, needed: NDArray[np.int64]) -> Window:
        parts = np.split(needed, np.flatnonzero(np.diff(needed) > _MAX_GAP) + 1)
        columns, heights, valid = [], [], []
        for part in parts:
            first, n_cols = int(part[0]), int(part[-1] - part[0]) + 1
            samples, is_valid = self.terrain.read_with_mask(
                (top, first, bottom - top + 1, n_cols), level=level, voids="any"
            )
            columns.append(np.arange(first, first + n_cols))
            heights.append(samples)
            valid.append(is_valid)
        raster = self.terrain.raster_info
        mask = np.concatenate(valid, axis=1)
        known = np.where(mask, np.concatenate(heights, axis=1), 0).astype(np.float64)
        metres = (known * raster.scale + raster.offset) * self.metres
        return Window(level, top, np.concatenate(columns), metres, mask)

    def places_of(
        self, window: Window, ellipsoidal: EllipsoidalHeights | None = None
    ) -> tuple[Places, Numbers]:
        """Return longitudes and latitudes of a window's valid samples, and their heights."""
        stride = self.terrain.grid.stride(window.level)
        rows, cols = np.nonzero(window.valid)
        full_rows = stride * (rows + window.row).astype(np.float64)
        full_cols = stride * window.columns[cols].astype(np.float64)
        places = self.from_samples(full_rows, full_cols)
        heights = self._above(window.heights[rows, cols], full_rows, full_cols)
        if ellipsoidal is not None:
            heights = self.heights_on(ellipsoidal, full_rows, full_cols, heights)
        return places, heights

    def onto_ellipsoid(self) -> EllipsoidalHeights:
        if self.has_radii:
            return EllipsoidalHeights.of_radii(self._place)
        return onto_wgs84(self._place, self.terrain.bounds)

    def heights_on(
        self, ellipsoidal: EllipsoidalHeights, rows: Numbers, cols: Numbers, heights: Numbers
    ) -> Numbers:
        """Return heights in metres above the ellipsoid of heights at fractional samples."""
        x, y = samples_to_places(self.terrain.raster_info.transform, rows, cols)
        return ellipsoidal.heights(x, y, heights)

    def range_on(self, ellipsoidal: EllipsoidalHeights) -> tuple[float, float]:
        """Return lower and upper limits of all heights, in metres above the ellipsoid."""
        low, high = self.height_range
        n_rows, n_cols = self.terrain.shape
        rows, cols = np.meshgrid(
            np.linspace(0, n_rows - 1, _N_OF_DATUM), np.linspace(0, n_cols - 1, _N_OF_DATUM)
        )
        flat = np.full(rows.size, (low + high) / 2)
        raised = ellipsoidal.raised(
            *samples_to_places(self.terrain.raster_info.transform, rows.ravel(), cols.ravel()), flat
        )
        most, least = float(np.nanmax(raised)), float(np.nanmin(raised))
        slack = _DATUM_SLACK * (most - least) + 1.0
        return low + least - slack, high + most + slack

    def heights_error(self, window: Window) -> float:
        """Return the largest distance of originals from a window's surface, in metres."""
        grid, terrain = self.terrain.grid, self.terrain
        if window.level == grid.k_max:
            return self.effective_error
        last = grid.level_blocks(window.level)
        bottom = window.row + len(window.heights) - 1
        block_rows = range(
            min(window.row // grid.block, last[0] - 1), min(bottom // grid.block, last[0] - 1) + 1
        )
        block_cols = np.unique(np.minimum(window.columns // grid.block, last[1] - 1)).tolist()
        errors = [
            terrain.block_error(Block(window.level, row, col))
            for row in block_rows
            for col in block_cols
        ]
        return max(errors) * abs(self.metres)

    @cached_property
    def height_range(self) -> tuple[float, float]:
        """Return the lowest and highest decoded height in metres; (0, 0) without heights."""
        info = self.terrain.info()
        if info.minimum is None or info.maximum is None:
            return 0.0, 0.0
        low, high = sorted((info.minimum * self.metres, info.maximum * self.metres))
        if not self.has_radii:
            return low, high
        south, north = self.extent.south, self.extent.north
        nearest = min(max(0.0, south), north)  # to the equator, where the body is widest
        surface = self.ellipsoid.surface_radius(np.array([south, north, nearest]))
        return low - float(surface.max()), high - float(surface.min())


def _distinct(first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the columns that are in one of two arrays, in ascending order, without sorting."""
    least = min(int(first.min()), int(second.min()))
    most = max(int(first.max()), int(second.max()))
    is_there = np.zeros(most - least + 1, dtype=np.bool_)
    is_there[first - least] = is_there[second - least] = True
    return least + np.flatnonzero(is_there)


def _among(columns: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    if columns[-1] - columns[0] == columns.size - 1:
        return wanted - columns[0]
    return np.searchsorted(columns, wanted)


_Weighted = tuple[NDArray[np.int64], Numbers]


def _weighted(
    window: Window, rows: tuple[_Weighted, _Weighted], cols: tuple[_Weighted, _Weighted]
) -> tuple[Numbers, NDArray[np.bool_] | None]:
    """Return weighted sums of four samples of a window, and where one of these is void.

    `rows` and `cols` are positions in the window with their weights. The second result is None if
    nothing in the window is void.
    """
    n_cols = window.columns.size
    is_whole = bool(window.valid.all())
    known = (window.heights if is_whole else np.where(window.valid, window.heights, 0.0)).ravel()
    missing = None if is_whole else ~window.valid.ravel()
    total = np.zeros(rows[0][0].shape)
    is_void = None if is_whole else np.zeros(total.shape, dtype=np.bool_)
    for row, row_weight in rows:
        start = row * n_cols
        for col, col_weight in cols:
            at = start + col
            weight = row_weight * col_weight
            if is_void is not None and missing is not None:
                is_void |= missing[at] & (weight != 0)
            weight *= known[at]
            total += weight
    return total, is_void


def _clamped(places: Numbers, n_samples: int) -> tuple[Numbers, NDArray[np.bool_]]:
    """Return positions clamped to the samples, and which were at most half a pixel off."""
    limit = 0.5 + _AT_EDGE
    inside = (places >= -limit) & (places <= n_samples - 1 + limit)
    return np.clip(places, 0, n_samples - 1), inside
