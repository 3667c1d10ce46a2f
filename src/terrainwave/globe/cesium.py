"""Cesium terrain: a pyramid of quantized-mesh tiles of a terrain, one at a time or all of them.

Tiles are squares of longitude and latitude in the TMS scheme: 2 x 1 on zoom 0, rows from the south,
each cut into four on the next zoom. A tile's heights are the terrain's at N x N cells, on the level
whose samples are just as near; its mesh is the `halves` of these heights within a tolerance. The
cells along an edge have the same places, heights and neighbours in both tiles beside it, and border
lines follow from these alone, so both have the same vertices on it.
"""

import json
import math
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import AS_IS, checked_number, checked_threads, checked_whole
from terrainwave.container.publish import publish_directory
from terrainwave.container.spool import storage_errors
from terrainwave.errors import (
    InvalidArgumentError,
    InvalidHeightsError,
)
from terrainwave.export.quantized_mesh import STEPS, tile_bytes
from terrainwave.extras import need
from terrainwave.globe.lonlat import Extent, Globe, Window
from terrainwave.mesh.blocks import BlockSamples, SideTolerances, border_lines
from terrainwave.place.vertical import check_vertical, describe_as_is, note_as_is
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.tri.halves.borders import beside_void
from terrainwave.tri.halves.halves import triangulate
from terrainwave.tri.mesh import FRACTION_BITS, BlockMesh
from terrainwave.tri.surface import deviation_at_points

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile

# Cells along a tile's side.
CELLS = 128
MAX_ZOOM = 24
LAYER = "layer.json"
# Tiles under work or waiting to be written, per thread.
_AHEAD = 4
# Cesium takes the error of zoom 0 for a quarter of the spacing of 65 cells along a tile's edge. A
# mesh may take half of it, and no more than 1/16 of the terrain's range of heights.
_CESIUM_CELLS, _CESIUM_QUALITY = 65, 0.25
_TOLERANCE_SHARE = 2
_RANGE_SHARE = 16
# Heights are whole 1/256 metres.
_UNIT = 1.0 / 256
_SMALLEST_STEP = 1.0 / (1 << FRACTION_BITS)
_MAX_HEIGHT = 1 << 30
# Bits of a number that float32 holds, less one for the sum of two.
_FLOAT_BITS = 22
_POLE = 90.0
# Places along a parallel whose mean is the height of a pole.
_N_AT_POLE = 64


class TileMesh(NamedTuple):
    """A tile and what is known of it.

    Parameters
    ----------
    data : bytes
        The .terrain file.
    n_vertices, n_triangles : int
    surface_error : float or None
        Metres. No sample of the level read, and no bilinear height at the tile's cells, is further
        from the tile's surface; None where no triangle has valid heights at all its corners.
    error : float or None
        The same, and what originals can be from the level's bilinear surface.
    """

    data: bytes
    n_vertices: int
    n_triangles: int
    surface_error: float | None
    error: float | None


@dataclass(frozen=True)
class TileRange:
    """Tiles of one zoom, both ends included."""

    first_x: int
    first_y: int
    last_x: int
    last_y: int

    def contains(self, x: int, y: int) -> bool:
        """Say whether a tile is among them."""
        return self.first_x <= x <= self.last_x and self.first_y <= y <= self.last_y

    @property
    def n_tiles(self) -> int:
        """Return how many they are."""
        return (self.last_x - self.first_x + 1) * (self.last_y - self.first_y + 1)

    def tiles(self) -> Iterator[tuple[int, int]]:
        """Yield (x, y) of all of them, row by row."""
        for y in range(self.first_y, self.last_y + 1):
            for x in range(self.first_x, self.last_x + 1):
                yield x, y


class _Samples(NamedTuple):
    """A tile's heights in whole units at (N + 3) x (N + 3) places: the tile's and one around.

    `exact` are the heights in metres before they were rounded; NaN where void.
    """

    heights: NDArray[np.int32]
    exact: NDArray[np.float64]
    valid: NDArray[np.bool_]
    exists: NDArray[np.bool_]
    window: Window | None


class TilePyramid:
    """The tiles of a terrain.

    Parameters
    ----------
    terrain : TerrainFile or Globe
        Stays open and belongs to the caller.
    void_height : float
        Height in metres above the ellipsoid of voids and of what the raster does not cover.
    cells : int
        Cells along a tile's side: a power of two.
    radius : float, optional
        Radius in metres of the body that degrees lie on, instead of the CRS's ellipsoid; a `Globe`
        has its own.
    max_zoom : int, optional
        The finest zoom; by default the first one whose cells are no larger than pixels.
    vertical : {"as-is", "ellipsoid"}
        Take heights as above the ellipsoid, or convert them from the CRS's vertical datum by PROJ's
        grid.

    Raises
    ------
    InvalidHeightsError
        If the raster has no place on a globe, heights cannot be converted or are beyond ±4000 km,
        or (when tiles are asked for) `max_zoom` is out of range.

    Notes
    -----
    Thread-safe. The same file gives the same bytes on any number of threads.
    """

    def __init__(
        self,
        terrain: "TerrainFile | Globe",
        *,
        void_height: float = 0.0,
        cells: int = CELLS,
        radius: float | None = None,
        max_zoom: int | None = None,
        vertical: str = AS_IS,
    ) -> None:
        expected = "a power of two, 2 … 1024"
        cells = checked_whole("cells", cells, least=2, most=1024, expected=expected)
        if cells & (cells - 1):
            raise InvalidArgumentError(f"found `cells` {cells}, expected {expected}")
        void_height = checked_number("void_height", void_height)
        self.globe = terrain if isinstance(terrain, Globe) else Globe(terrain, radius=radius)
        self._cells, self._asked = cells, max_zoom
        self._ellipsoidal = self.globe.onto_ellipsoid() if check_vertical(vertical) else None
        low, high = self.globe.height_range
        if self._ellipsoidal is not None:
            low, high = self.globe.range_on(self._ellipsoidal)
        self._low = math.floor(min(low, void_height) / _UNIT)
        self._high = math.ceil(max(high, void_height) / _UNIT)
        if max(-self._low, self._high) > _MAX_HEIGHT:
            raise InvalidHeightsError(
                f"found heights of {low:g} to {high:g} m, expected at most 4,000 km"
            )
        self._void = round(void_height / _UNIT)

    # The scheme

    @property
    def extent(self) -> Extent:
        """Return the part of the globe that has heights."""
        return self.globe.extent

    def _cell_size(self, zoom: int) -> float:
        """Return the size of a cell in metres, along a meridian."""
        return math.radians(180 / (self._cells << zoom)) * self.globe.ellipsoid.axis

    @cached_property
    def max_zoom(self) -> int:
        """Return the finest zoom there is."""
        finest = self._finest
        if self._asked is None:
            return finest
        expected = f"0 … {finest}: cells of the last are no larger than pixels"
        return checked_whole("max_zoom", self._asked, least=0, most=finest, expected=expected)

    @cached_property
    def _finest(self) -> int:
        """Return the first zoom whose cells are not larger than the raster's pixels."""
        zoom = 0
        while self._cell_size(zoom) > self.globe.pixel * 1.001 and zoom < MAX_ZOOM:
            zoom += 1
        return zoom

    def geometric_error(self, zoom: int) -> float:
        """Return the error in metres that Cesium takes a tile of this zoom to have.

        ``a * 2π * 0.25 / (65 * 2)`` on zoom 0, half of it on each next one.
        """
        around = 2 * math.pi * self.globe.ellipsoid.axis
        return around * _CESIUM_QUALITY / (_CESIUM_CELLS * 2) / (1 << zoom)

    def tolerance(self, zoom: int) -> float:
        """Return how far a tile's mesh may be from the heights at its cells, in metres."""
        height_range = (self._high - self._low) * _UNIT
        return min(self.geometric_error(zoom) / _TOLERANCE_SHARE, height_range / _RANGE_SHARE)

    def available(self, zoom: int) -> list[TileRange]:
        """Return the tiles of a zoom that there are; on zoom 0 both, as Cesium needs them."""
        if zoom == 0:
            return [TileRange(0, 0, 1, 0)]
        if not 0 < zoom <= self.max_zoom:
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
        """Return the number of tiles of a zoom."""
        return sum(tiles.n_tiles for tiles in self.available(zoom))

    def layer(
        self,
        *,
        version: str = "1.0.0",
        attribution: str = "",
    ) -> dict[str, Any]:
        """Return the content of ``layer.json``, as plain values.

        Cesium takes a metadata extension in tiles for part of what tells which tiles there are:
        ``metadataAvailability`` says that the root tiles tell it for all zooms.
        """
        west, south, east, north = self.extent
        if east > 180:
            west, east = -180.0, 180.0
        description = self.globe.terrain.raster_info.description
        return {
            "tilejson": "2.1.0",
            "name": "terrain",
            "description": description or "",
            "version": version,
            "format": "quantized-mesh-1.0",
            "attribution": attribution,
            "scheme": "tms",
            "tiles": ["{z}/{x}/{y}.terrain?v={version}"],
            "projection": "EPSG:4326",
            "bounds": [west, south, east, north],
            "minzoom": 0,
            "maxzoom": self.max_zoom,
            "metadataAvailability": self.max_zoom + 1,
            "available": self._availability(0),
            "vertical": self.vertical,
        }

    @property
    def vertical(self) -> dict[str, Any]:
        """Return what heights in tiles are."""
        if self._ellipsoidal is not None:
            return self._ellipsoidal.describe()
        return describe_as_is(self.globe.terrain.crs)

    def _availability(self, first: int) -> list[list[dict[str, int]]]:
        """Return the tiles of each zoom from `first` on, as JSON tells them."""
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

    # Tiles

    def tile(self, zoom: int, x: int, y: int) -> TileMesh | None:
        """Return a tile; None if there is none.

        Parameters
        ----------
        zoom, x, y : int
            x counts from longitude -180 eastwards, y from latitude -90 northwards.

        Raises
        ------
        CorruptStreamError
            If a block is damaged.
        """
        if not any(tiles.contains(x, y) for tiles in self.available(zoom)):
            return None
        samples = self._samples(zoom, x, y)
        mesh = self._mesh(samples, zoom)
        return self._encoded(mesh, samples, zoom, x, y)

    def _places(self, zoom: int, x: int, y: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return longitudes and latitudes (NaN beyond a pole) of a tile's lines, one around.

        They follow from a line's number on the globe alone.
        """
        n_lines = self._cells << zoom
        steps = np.arange(-1, self._cells + 2)
        lon = -180 + 180 * (np.mod(x * self._cells + steps, 2 * n_lines) / n_lines)
        line = (y + 1) * self._cells - steps
        lat = np.where((line >= 0) & (line <= n_lines), -90 + 180 * (line / n_lines), np.nan)
        return lon, lat

    def _samples(self, zoom: int, x: int, y: int) -> _Samples:
        lon, lat = self._places(zoom, x, y)
        shape = len(lat), len(lon)
        exists = np.repeat(np.isfinite(lat)[:, None], len(lon), axis=1)
        level = self.globe.level_for(self._cell_size(zoom))
        # One height for each pole: all longitudes meet there.
        poles = np.flatnonzero(np.abs(lat) == _POLE)
        lats = np.where(np.isfinite(lat), lat, 0.0)
        rows, cols = self.globe.to_samples(np.tile(lon, len(lat)), np.repeat(lats, len(lon)))
        rows[~exists.ravel()] = np.nan
        surface, window = self._heights_at(rows, cols, level)
        exact = surface.reshape(shape)
        for row in poles:
            exact[row] = self._pole(float(lat[row]), level)
        exact[~exists] = np.nan
        valid = np.isfinite(exact)
        whole = np.where(valid, np.rint(np.where(valid, exact, 0.0) / _UNIT), self._void)
        heights = np.clip(whole, self._low, self._high).astype(np.int32)
        step = self._edge_step(zoom)
        for edge in (heights[1], heights[-2], heights[:, 1], heights[:, -2]):
            edge[:] = (edge.astype(np.int64) + step // 2) // step * step
        return _Samples(heights, exact, valid, exists, window)

    def _heights_at(
        self, rows: NDArray[np.float64], cols: NDArray[np.float64], level: int
    ) -> tuple[NDArray[np.float64], Window | None]:
        """Return `Globe.heights_at`, above what tiles count from."""
        heights, window = self.globe.heights_at(rows, cols, level)
        if self._ellipsoidal is not None:
            heights = self.globe.heights_on(self._ellipsoidal, rows, cols, heights)
        return heights, window

    def _pole(self, lat: float, level: int) -> float:
        lon = np.linspace(-180.0, 180.0, _N_AT_POLE, endpoint=False)
        rows, cols = self.globe.to_samples(lon, np.full(_N_AT_POLE, lat))
        heights, _ = self._heights_at(rows, cols, level)
        known = heights[np.isfinite(heights)]
        return float(known.mean()) if len(known) else math.nan

    def _edge_step(self, zoom: int) -> int:
        """Return the quantum of heights on edges, in units: a power of two.

        Every tile of the zoom can tell them, whatever its lowest and highest height.
        """
        reach = self._high - self._low + 2 * math.ceil(self.tolerance(zoom) / _UNIT) + 2
        needed = max(
            -(-2 * reach // STEPS), max(-self._low, self._high, 1) + reach >> _FLOAT_BITS, 1
        )
        return 1 << (needed - 1).bit_length()

    def _mesh(self, samples: _Samples, zoom: int) -> BlockMesh:
        """Return the mesh of a tile's heights, places in half cells from its north-west corner."""
        inner = slice(1, -1)
        heights = np.ascontiguousarray(samples.heights[inner, inner])
        # Vertices stay on both sides of a void's edge, so that it is as steep as the cells allow.
        locked = np.where(
            samples.valid[inner, inner],
            beside_void(samples.valid | ~samples.exists),
            beside_void(~samples.valid | ~samples.exists),
        )
        spacing = self._lattice(zoom)
        locked[::spacing, ::spacing] = True
        tolerance = math.floor(self.tolerance(zoom) / _UNIT * (1 << FRACTION_BITS))
        lines = border_lines(
            BlockSamples(heights, samples.valid[inner, inner], locked),
            SideTolerances(tolerance, tolerance, tolerance, tolerance),
            self._cells,
        )
        everywhere = np.ones_like(locked)
        mesh = triangulate(heights, everywhere, locked, lines, tolerance)
        if (_areas(_rounded(mesh, self._cells)) <= 0).any():
            # Rounding has turned a sliver over: then all cells.
            mesh = triangulate(heights, everywhere, everywhere, lines, tolerance)
        return mesh

    def _lattice(self, zoom: int) -> int:
        """Return the distance of cells' corners that stay vertices, a power of two.

        A merged cell holds none, so that it is at most one lattice cell by half of one and no edge
        is longer than one and a half of them in either direction: e = 1.5√2 * π/(m 2^zoom) radians
        on the globe for m of them along a tile. It lies R e²/8 below the globe, which may be half
        of the zoom's geometric error.
        """
        squared = 9 / 8 * math.pi**2 * self.globe.ellipsoid.axis
        squared /= 4**zoom * self.geometric_error(zoom)
        needed = 1 << max(math.ceil(math.log2(max(squared, 1.0)) / 2), 0)
        return max(self._cells // needed, 1)

    def _encoded(self, mesh: BlockMesh, samples: _Samples, zoom: int, x: int, y: int) -> TileMesh:
        size = 180 / (1 << zoom)
        west, south = -180 + x * size, -90 + y * size
        mesh = _in_order_of_use(mesh)
        low, step = self._height_steps(mesh, zoom)
        steps = np.rint((mesh.heights / (1 << FRACTION_BITS) - low) / step)
        whole = np.rint((low + steps * step) * (1 << FRACTION_BITS)).astype(np.int64)
        mesh = _rounded(mesh, self._cells)._replace(heights=whole)
        u = mesh.cols / (2 * self._cells) * STEPS
        v = STEPS - mesh.rows / (2 * self._cells) * STEPS
        quantized = np.rint(np.stack([u, v, steps], axis=1)).astype(np.int16)
        points = np.stack(
            [
                west + quantized[:, 0] / STEPS * size,
                south + quantized[:, 1] / STEPS * size,
                (low + steps * step) * _UNIT,
            ],
            axis=1,
        )
        surface_error, error = self._errors(mesh, samples, zoom, x, y)
        heights = low * _UNIT, (low + STEPS * step) * _UNIT
        about: dict[str, Any] = {
            "bounds": [west, south, west + size, south + size],
            "geometricerror": error,
            "surfaceerror": surface_error,
        }
        if zoom == 0:
            about["available"] = self._availability(1)
        triangles = mesh.triangles[:, ::-1].astype(np.int64)
        data = tile_bytes(points, quantized, triangles, heights, self.globe.ellipsoid, about)
        return TileMesh(data, len(points), len(triangles), surface_error, error)

    def _height_steps(self, mesh: BlockMesh, zoom: int) -> tuple[int, float]:
        """Return the lowest height and the step that a tile counts in, in units.

        The step is the edges' or that halved as often as the tile's range, and float32, allow.
        """
        edge_step = self._edge_step(zoom)
        low = math.floor(int(mesh.heights.min()) / (edge_step << FRACTION_BITS)) * edge_step
        highest = int(mesh.heights.max()) / (1 << FRACTION_BITS)
        step = float(edge_step)
        while (
            step > _SMALLEST_STEP
            and highest - low <= STEPS * step / 2
            and np.float32((low + STEPS * step / 2) * _UNIT) == (low + STEPS * step / 2) * _UNIT
        ):
            step /= 2
        return low, step

    def _errors(
        self, mesh: BlockMesh, samples: _Samples, zoom: int, x: int, y: int
    ) -> tuple[float | None, float | None]:
        """Return `TileMesh.surface_error` and `TileMesh.error` of a mesh as it is written."""
        if samples.window is None:
            return None, None
        inner = slice(1, -1)
        rows, cols = np.nonzero(samples.valid[inner, inner])
        at_cells = rows.astype(np.float64), cols.astype(np.float64)
        at_samples, heights = self._samples_in_tile(samples.window, zoom, x, y)
        rows_, cols_ = (np.concatenate(pair) for pair in zip(at_cells, at_samples, strict=True))
        there = np.concatenate([samples.exact[inner, inner][rows, cols], heights])
        # A vertex of a merged cell stands for valid heights only, or for voids only.
        places = (
            np.rint(mesh.rows).astype(np.int64) >> 1,
            np.rint(mesh.cols).astype(np.int64) >> 1,
        )
        is_valid = samples.valid[inner, inner][places]
        worst, n_points = deviation_at_points(
            mesh,
            is_valid[mesh.triangles].all(axis=1),
            rows_,
            cols_,
            there / _UNIT * (1 << FRACTION_BITS),
            self._cells,
        )
        if not n_points:
            return None, None
        error = worst / (1 << FRACTION_BITS) * _UNIT
        return error, error + self.globe.heights_error(samples.window)

    def _samples_in_tile(
        self, window: Window, zoom: int, x: int, y: int
    ) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]:
        """Return rows and columns in cells of the samples of a window in a tile; their heights."""
        (lon, lat), heights = self.globe.places_of(window, self._ellipsoidal)
        size = 180 / (1 << zoom)
        rows = ((y + 1) * size - 90 - lat) / size * self._cells
        cols = np.mod(lon + 180 - x * size, 360) / size * self._cells
        inside = (rows >= 0) & (rows <= self._cells) & (cols <= self._cells)
        return (rows[inside], cols[inside]), heights[inside]


def _tile_at(place: float, n_tiles: int, *, ends: bool = False) -> int:
    """Return the tile at a place counted in tiles; on a border the next one, or the one before."""
    number = math.ceil(place - 1e-9) - 1 if ends else math.floor(place + 1e-9)
    return min(max(number, 0), n_tiles - 1)


def _rounded(mesh: BlockMesh, cells: int) -> BlockMesh:
    """Return a mesh at the places that a tile can tell."""
    scale = STEPS / (2 * cells)
    rows = (STEPS - np.rint(STEPS - mesh.rows * scale)) / scale
    return mesh._replace(rows=rows, cols=np.rint(mesh.cols * scale) / scale)


def _areas(mesh: BlockMesh) -> NDArray[np.float64]:
    r, c = mesh.rows[mesh.triangles], mesh.cols[mesh.triangles]
    areas: NDArray[np.float64] = (c[:, 1] - c[:, 0]) * (r[:, 2] - r[:, 0])
    areas -= (c[:, 2] - c[:, 0]) * (r[:, 1] - r[:, 0])
    return areas


def _in_order_of_use(mesh: BlockMesh) -> BlockMesh:
    """Return a mesh whose vertices come as triangles, turned over, first use them."""
    turned = mesh.triangles[:, ::-1]
    used, first, places = np.unique(turned.ravel(), return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    triangles = rank[places.reshape(-1, 3)][:, ::-1]
    at = used[order]
    return BlockMesh(mesh.rows[at], mesh.cols[at], mesh.heights[at], triangles)


def terrain_tile(
    terrain: "TerrainFile", zoom: int, x: int, y: int, *, void_height: float = 0.0
) -> bytes | None:
    """Return one quantized-mesh tile of a terrain; None if there is none.

    Parameters
    ----------
    terrain : TerrainFile
    zoom, x, y : int
        TMS: x from longitude -180 eastwards, y from latitude -90 northwards.
    void_height : float
        Height in metres above the ellipsoid of voids and of what the raster does not cover.

    Raises
    ------
    InvalidHeightsError
        If the raster has no place on a globe.
    CorruptStreamError
        If a block is damaged.
    TerrainwaveError
        If quantized-mesh-encoder is missing.

    Notes
    -----
    For many tiles keep a `TilePyramid`.
    """
    tile = TilePyramid(terrain, void_height=void_height).tile(zoom, x, y)
    return None if tile is None else tile.data


def layer_json(terrain: "TerrainFile", *, attribution: str = "") -> dict[str, Any]:
    """Return the content of ``layer.json`` for a terrain's tiles, as plain values."""
    return TilePyramid(terrain).layer(attribution=attribution)


@dataclass(frozen=True)
class ZoomSummary:
    """What was written of one zoom; errors in metres.

    Parameters
    ----------
    zoom, n_tiles, n_triangles, n_bytes : int
    geometric_error : float
        What Cesium takes a tile's error for.
    surface_error : float or None
        Largest one of the tiles: how far the heights of the level read, which are bilinear between
        samples, are from them; see `TileMesh`.
    error : float or None
        Largest one of the tiles: the same, and what originals can be from these heights.
    """

    zoom: int
    n_tiles: int
    n_triangles: int
    n_bytes: int
    geometric_error: float
    surface_error: float | None
    error: float | None


def write_tiles(
    terrain: "TerrainFile",
    directory: str | os.PathLike[str],
    *,
    max_zoom: int | None = None,
    void_height: float = 0.0,
    cells: int = CELLS,
    radius: float | None = None,
    vertical: str = AS_IS,
    attribution: str = "",
    threads: int | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> list[ZoomSummary]:
    """Write all tiles of a terrain and ``layer.json`` into a new directory.

    Parameters
    ----------
    terrain : TerrainFile
    directory : path
        ``{z}/{x}/{y}.terrain`` and ``layer.json``; it appears complete or not at all.
    max_zoom : int, optional
        The finest zoom; by default the first one whose cells are no larger than pixels.
    void_height, cells, radius, vertical
        As in `TilePyramid`.
    attribution : str
        For ``layer.json``: whose data these are.
    threads : int, optional
        All processors by default; the bytes don't depend on it.
    overwrite : bool
        Replace an existing directory of tiles.

    Raises
    ------
    InvalidHeightsError
        If an option is out of range, or the raster has no place on a globe.
    CorruptStreamError
        If a block is damaged.
    StorageError
        If something cannot be written.
    TerrainwaveError
        If quantized-mesh-encoder is missing.
    """
    need("quantized_mesh_encoder", extra="mesh")
    pyramid = TilePyramid(
        terrain,
        void_height=void_height,
        cells=cells,
        radius=radius,
        max_zoom=max_zoom,
        vertical=vertical,
    )
    if vertical == AS_IS:
        note_as_is(terrain.crs)
    last = pyramid.max_zoom
    n_threads = checked_threads(threads)
    total = sum(pyramid.n_tiles(zoom) for zoom in range(last + 1))
    reporter, n_done, summaries = Reporter(progress), 0, []
    with (
        publish_directory(directory, LAYER, overwrite) as new,
        ThreadPoolExecutor(n_threads, thread_name_prefix="terrainwave") as executor,
        storage_errors(f"cannot write {os.fspath(directory)}"),
    ):
        for zoom in range(last + 1):
            n_tiles, n_triangles, n_bytes = 0, 0, 0
            surface_errors, errors = [], []
            for x, y, tile in _tiles_of(pyramid, zoom, executor, _AHEAD * n_threads):
                place = new / str(zoom) / str(x) / f"{y}.terrain"
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(tile.data)
                n_tiles += 1
                n_triangles += tile.n_triangles
                n_bytes += len(tile.data)
                if tile.surface_error is not None and tile.error is not None:
                    surface_errors.append(tile.surface_error)
                    errors.append(tile.error)
                n_done += 1
                reporter.report("writing tiles", n_done, total)
            summaries.append(
                ZoomSummary(
                    zoom,
                    n_tiles,
                    n_triangles,
                    n_bytes,
                    pyramid.geometric_error(zoom),
                    max(surface_errors, default=None),
                    max(errors, default=None),
                )
            )
        layer = pyramid.layer(attribution=attribution)
        (new / LAYER).write_text(json.dumps(layer, indent=1) + "\n", encoding="utf-8")
    return summaries


def _tiles_of(
    pyramid: TilePyramid, zoom: int, executor: ThreadPoolExecutor, n_ahead: int
) -> Iterator[tuple[int, int, TileMesh]]:
    """Yield x, y and the tile, for all of a zoom in order; few wait at a time."""
    places = (place for area in pyramid.available(zoom) for place in area.tiles())
    while batch := list(islice(places, n_ahead)):
        tiles = executor.map(lambda place: pyramid.tile(zoom, *place), batch)
        for (x, y), tile in zip(batch, tiles, strict=True):
            if tile is not None:
                yield x, y, tile
