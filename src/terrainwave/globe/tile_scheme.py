"""Tiles of a globe: which exist, where they lie, and Cesium's assumptions about their errors."""

import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import checked_whole
from terrainwave.errors import InvalidArgumentError
from terrainwave.globe.lonlat import Extent, Globe

# Cells along a tile's side.
CELLS = 128
MAX_ZOOM = 24
# Cesium assumes for zoom 0 an error of a quarter of the spacing of 65 cells along a tile's edge.
_CESIUM_CELLS, _CESIUM_QUALITY = 65, 0.25


@dataclass(frozen=True)
class TileRange:
    """Tiles of one zoom, both ends included."""

    first_x: int
    first_y: int
    last_x: int
    last_y: int

    def contains(self, x: int, y: int) -> bool:
        return self.first_x <= x <= self.last_x and self.first_y <= y <= self.last_y

    @property
    def n_tiles(self) -> int:
        return (self.last_x - self.first_x + 1) * (self.last_y - self.first_y + 1)

    def tiles(self) -> Iterator[tuple[int, int]]:
        for y in range(self.first_y, self.last_y + 1):
            for x in range(self.first_x, self.last_x + 1):
                yield x, y


class TileScheme:
    """Tiles of `cells` x `cells` cells on zoom 0, and on a requested range of zooms."""

    def __init__(self, globe: Globe, cells: int, asked_zoom: int | None, min_zoom: int = 0) -> None:
        expected = "a power of two, 2 … 1024"
        self.cells = checked_whole("cells", cells, least=2, most=1024, expected=expected)
        if self.cells & (self.cells - 1):
            raise InvalidArgumentError(f"found `cells` {self.cells}, expected {expected}")
        self.globe = globe
        self._asked, self._min_asked = asked_zoom, min_zoom

    @property
    def extent(self) -> Extent:
        return self.globe.extent

    def cell_size(self, zoom: int) -> float:
        return math.radians(180 / (self.cells << zoom)) * self.globe.ellipsoid.axis

    @cached_property
    def max_zoom(self) -> int:
        finest = self._finest
        if self._asked is None:
            return finest
        expected = f"0 … {finest}: tiles of the last hold every sample within its error"
        return checked_whole("max_zoom", self._asked, least=0, most=finest, expected=expected)

    @cached_property
    def min_zoom(self) -> int:
        """Return the coarsest zoom besides zoom 0."""
        expected = f"0 … {self.max_zoom}, the finest zoom"
        return checked_whole(
            "min_zoom", self._min_asked, least=0, most=self.max_zoom, expected=expected
        )

    @property
    def zooms(self) -> list[int]:
        """Return the zooms that have tiles; Cesium always needs zoom 0."""
        return sorted({0, *range(self.min_zoom, self.max_zoom + 1)})

    @cached_property
    def _finest(self) -> int:
        """Return the first zoom whose cells are not larger than the raster's pixels."""
        zoom = 0
        while self.cell_size(zoom) > self.globe.pixel * 1.001 and zoom < MAX_ZOOM:
            zoom += 1
        return zoom

    def is_finest(self, zoom: int) -> bool:
        return zoom == self._finest

    def geometric_error(self, zoom: int) -> float:
        """Return Cesium's assumed error of a tile of this zoom, in metres.

        ``a * 2π * 0.25 / (65 * 2)`` on zoom 0, half of it on each next one.
        """
        around = 2 * math.pi * self.globe.ellipsoid.axis
        return around * _CESIUM_QUALITY / (_CESIUM_CELLS * 2) / (1 << zoom)

    def available(self, zoom: int) -> list[TileRange]:
        """Return the existing tiles of a zoom; on zoom 0 both, as Cesium needs them."""
        if zoom == 0:
            return [TileRange(0, 0, 1, 0)]
        if not max(self.min_zoom, 1) <= zoom <= self.max_zoom:
            return []
        extent, n_x, n_y = self.extent, 2 << zoom, 1 << zoom
        size = 180 / n_y
        first_y = _tile_at((extent.south + 90) / size, n_y)
        last_y = max(_tile_at((extent.north + 90) / size, n_y, ends=True), first_y)
        first_x = _tile_at((extent.west + 180) / size, n_x)
        last_x = max(_tile_at((extent.east + 180) / size, 2 * n_x, ends=True), first_x)
        if last_x < n_x:
            return [TileRange(first_x, first_y, last_x, last_y)]
        if last_x - first_x >= n_x - 1:
            return [TileRange(0, first_y, n_x - 1, last_y)]
        # Across the antimeridian.
        return [
            TileRange(0, first_y, last_x - n_x, last_y),
            TileRange(first_x, first_y, n_x - 1, last_y),
        ]

    def n_tiles(self, zoom: int) -> int:
        return sum(tiles.n_tiles for tiles in self.available(zoom))

    def availability(self, first: int) -> list[list[dict[str, int]]]:
        """Return the tiles of each zoom from `first` on, as values for JSON."""
        return [
            [
                {
                    "startX": tiles.first_x,
                    "startY": tiles.first_y,
                    "endX": tiles.last_x,
                    "endY": tiles.last_y,
                }
                for tiles in self.available(zoom)
            ]
            for zoom in range(first, self.max_zoom + 1)
        ]

    def places(self, zoom: int, x: int, y: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return longitudes and latitudes (NaN beyond a pole) of a tile's lines, plus one around.

        They depend only on a line's number on the globe.
        """
        n_lines = self.cells << zoom
        offsets = np.arange(-1, self.cells + 2)
        lon = -180 + 180 * (np.mod(x * self.cells + offsets, 2 * n_lines) / n_lines)
        line = (y + 1) * self.cells - offsets
        lat = np.where((line >= 0) & (line <= n_lines), -90 + 180 * (line / n_lines), np.nan)
        return lon, lat

    def lattice(self, zoom: int, error: float) -> int:
        """Return the distance of cells' corners that stay vertices, a power of two.

        A merged cell holds none, so that it is at most one lattice cell by half of one and no edge
        is longer than one and a half of them in either direction: e = 1.5√2 * π/(m 2^zoom) radians
        on the globe for m of them along a tile. It lies R e²/8 below the globe, which may be
        `error` in metres. A cell that is too large for it is not merged.
        """
        squared = 9 / 16 * math.pi**2 * self.globe.ellipsoid.axis / (4**zoom * error)
        needed = 1 << max(math.ceil(math.log2(max(squared, 1.0)) / 2), 0)
        return max(self.cells // needed, 1)


def _tile_at(place: float, n_tiles: int, *, ends: bool = False) -> int:
    """Return the tile at a position counted in tiles; on a border one of the two."""
    number = math.ceil(place - 1e-9) - 1 if ends else math.floor(place + 1e-9)
    return min(max(number, 0), n_tiles - 1)


def in_order(
    executor: ThreadPoolExecutor, work: Callable[[Any], Any], items: Iterable[Any], n_ahead: int
) -> Iterator[tuple[Any, Any]]:
    """Yield items and the results of `work`, in order; at most `n_ahead` of them wait at a time."""
    left = iter(items)
    while batch := list(islice(left, n_ahead)):
        yield from zip(batch, executor.map(work, batch), strict=True)
