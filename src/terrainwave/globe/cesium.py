"""Cesium terrain: a pyramid of quantized-mesh tiles of a terrain, one at a time or all of them.

Tiles are squares of longitude and latitude in the TMS scheme: 2 x 1 on zoom 0, rows from the south,
each cut into four on the next zoom. A tile's heights are the terrain's at N x N cells, from the
level of the same spacing; its mesh is the `halves` of these heights within a tolerance. The cells
along an edge have the same positions, heights and neighbours in both adjacent tiles. Border lines
depend only on these, so both tiles have the same vertices there.
"""

import json
import logging
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

from terrainwave.arguments import AS_IS, checked_threads
from terrainwave.container.spool import storage_errors
from terrainwave.container.targets.publication import publish_directory
from terrainwave.extras import need
from terrainwave.file import TerrainFile
from terrainwave.globe.lonlat import Globe
from terrainwave.globe.tile_heights import TileHeights
from terrainwave.globe.tile_mesh import TileMesh, TileMesher
from terrainwave.globe.tile_scheme import CELLS, TileScheme, in_order
from terrainwave.place.vertical import note_as_is
from terrainwave.progress import ProgressCallback, Reporter

_log = logging.getLogger(__name__)

LAYER = "layer.json"
# Tiles per thread that are in progress or wait to be written.
_AHEAD = 4


class TilePyramid(TileScheme):
    """The tiles of a terrain.

    Parameters
    ----------
    terrain : TerrainFile or Globe
        Stays open and belongs to the caller.
    void_height : float
        Height in metres above the ellipsoid outside of the raster.
    fill_voids : bool
        Give voids in the raster the same height. By default they are holes.
    cells : int
        Cells along a tile's side: a power of two.
    radius : float, optional
        Radius in metres of the body that degrees lie on, instead of the CRS's ellipsoid; a `Globe`
        has its own.
    max_zoom : int, optional
        The finest zoom; by default, and at most, the first one whose cells are no larger than
        pixels. Its tiles are within the file's own error of every sample, plus their own.
    min_zoom : int
        The coarsest zoom besides zoom 0, which Cesium begins with.
    vertical : {"as-is", "ellipsoid"}
        Assume that heights are above the ellipsoid, or convert them from the CRS's vertical datum
        by PROJ's grid.

    Raises
    ------
    InvalidHeightsError
        If the raster has no position on a globe, heights cannot be converted or are beyond ±4000
        km, or (when tiles are requested) a zoom is out of range.

    Notes
    -----
    Thread-safe. The same file gives the same bytes on any number of threads.
    """

    def __init__(
        self,
        terrain: TerrainFile | Globe,
        *,
        void_height: float = 0.0,
        fill_voids: bool = False,
        cells: int = CELLS,
        radius: float | None = None,
        max_zoom: int | None = None,
        min_zoom: int = 0,
        vertical: str = AS_IS,
    ) -> None:
        globe = terrain if isinstance(terrain, Globe) else Globe(terrain, radius=radius)
        super().__init__(globe, cells, max_zoom, min_zoom)
        self._heights = TileHeights(self, void_height, vertical, fill_voids=fill_voids)
        self._mesher = TileMesher(self, self._heights)

    def tolerance(self, zoom: int) -> float:
        return self._heights.tolerance(zoom)

    @property
    def vertical(self) -> dict[str, Any]:
        return self._heights.vertical

    def layer(self, *, version: str = "1.0.0", attribution: str = "") -> dict[str, Any]:
        """Return the content of ``layer.json``, as plain values.

        If tiles have a metadata extension, Cesium looks there for the list of available tiles, too:
        ``metadataAvailability`` states that the root tiles list it for all zooms.
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
            "minzoom": self.min_zoom,
            "maxzoom": self.max_zoom,
            "metadataAvailability": self.max_zoom + 1,
            "available": self.availability(0),
            "vertical": self.vertical,
        }

    def tile(self, zoom: int, x: int, y: int) -> TileMesh | None:
        """Return a tile; None if it does not exist.

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
        return self._mesher.tile(zoom, x, y)


@dataclass(frozen=True)
class ZoomSummary:
    """Summary of one zoom; errors in metres."""

    zoom: int
    n_tiles: int
    n_triangles: int
    n_bytes: int
    geometric_error: float  # Cesium's assumption about a tile's error
    # largest one of the tiles: distance of the bilinear heights of the level read from the tile;
    # see `TileMesh`
    surface_error: float | None
    # largest one of the tiles: the same, plus the distance of originals from these heights
    error: float | None


def write_tiles(
    terrain: TerrainFile,
    directory: str | os.PathLike[str],
    *,
    attribution: str = "",
    threads: int | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
    **options: Any,
) -> list[ZoomSummary]:
    """Write all tiles of a terrain and ``layer.json`` into a new directory.

    Parameters
    ----------
    terrain : TerrainFile
    directory : path
        ``{z}/{x}/{y}.terrain`` and ``layer.json``; it appears complete or not at all.
    attribution : str
        Owner of the data, for ``layer.json``.
    threads : int, optional
        All processors by default; the bytes don't depend on it.
    overwrite : bool
        Replace an existing directory of tiles.
    options
        Of `TilePyramid`.

    Raises
    ------
    InvalidHeightsError
        If an option is out of range, or the raster has no position on a globe.
    CorruptStreamError
        If a block is damaged.
    StorageError
        If something cannot be written.
    TerrainwaveError
        If quantized-mesh-encoder is missing.
    """
    need("quantized_mesh_encoder", extra="mesh")
    pyramid = TilePyramid(terrain, **options)
    if options.get("vertical", AS_IS) == AS_IS and not terrain.height_unit.is_radius:
        note_as_is(terrain.crs)
    zooms = pyramid.zooms
    n_threads = checked_threads(threads)
    total = sum(map(pyramid.n_tiles, zooms))
    reporter, n_done, summaries = Reporter(progress), 0, []
    with (
        publish_directory(directory, LAYER, overwrite) as new,
        ThreadPoolExecutor(n_threads, thread_name_prefix="terrainwave") as executor,
        storage_errors(f"cannot write {os.fspath(directory)}"),
    ):
        for zoom in zooms:
            places = (place for area in pyramid.available(zoom) for place in area.tiles())
            make = partial(_tile_at, pyramid, zoom)
            written, errors = [], []
            for (x, y), tile in in_order(executor, make, places, _AHEAD * n_threads):
                if tile is None:
                    continue
                place = new / str(zoom) / str(x) / f"{y}.terrain"
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(tile.data)
                written.append((tile.n_triangles, len(tile.data)))
                if tile.surface_error is not None and tile.error is not None:
                    errors.append((tile.surface_error, tile.error))
                n_done += 1
                reporter.report("writing tiles", n_done, total)
            n_triangles, n_bytes = (sum(column) for column in zip((0, 0), *written, strict=True))
            largest = map(max, zip(*errors, strict=True)) if errors else (None, None)
            _log.info("zoom %d: %d tiles, %d bytes", zoom, len(written), n_bytes)
            geometric_error = pyramid.geometric_error(zoom)
            summaries.append(
                ZoomSummary(zoom, len(written), n_triangles, n_bytes, geometric_error, *largest)
            )
        layer = pyramid.layer(attribution=attribution)
        (new / LAYER).write_text(json.dumps(layer, indent=1) + "\n", encoding="utf-8")
    return summaries


def _tile_at(pyramid: TilePyramid, zoom: int, place: tuple[int, int]) -> TileMesh | None:
    return pyramid.tile(zoom, *place)
