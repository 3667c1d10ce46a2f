"""A PMTiles archive (version 3) of a terrain's terrain-RGB tiles: one file for a static host.

The package ``pmtiles`` of the format's authors writes directories and header. Tiles are stored in
the order of the format's curve, so that readers fetch neighbours in one request.
"""

import logging
import math
import os
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from typing import Any

from terrainwave._version import __version__
from terrainwave.arguments import (
    ARCHIVE_ENDING,
    check_ending,
    check_flags,
    checked_number,
    checked_threads,
    checked_whole,
)
from terrainwave.container.spool import storage_errors
from terrainwave.container.targets.publication import publish
from terrainwave.errors import InvalidHeightsError, TerrainwaveWarning
from terrainwave.extras import need, with_extra
from terrainwave.file import TerrainFile
from terrainwave.globe import terrain_rgb as tiling
from terrainwave.globe.lonlat import Globe
from terrainwave.globe.tile_scheme import in_order
from terrainwave.progress import ProgressCallback, Reporter

_log = logging.getLogger(__name__)

# Tiles per thread that are in progress or wait to be written.
_AHEAD = 4


@dataclass(frozen=True)
class ArchivedZoom:
    """Summary of one zoom; errors in metres, the largest of its tiles (`RgbTile`)."""

    zoom: int
    n_tiles: int
    n_bytes: int
    step: float  # heights are multiples of it
    surface_error: float  # from resampling to Web Mercator and the steps of heights
    # largest distance of originals from the level that the tiles were made from
    terrain_error: float
    # largest distance of a pixel's height from the bilinear surface of the originals: half a step,
    # what the encoding cannot hold, and `terrain_error`
    error: float


@with_extra("pmtiles")
def write_pmtiles(
    terrain: TerrainFile,
    target: str | os.PathLike[str],
    *,
    min_zoom: int = 0,
    max_zoom: int | None = None,
    rim: int = 0,
    void_height: float | None = None,
    radius: float | None = None,
    attribution: str = "",
    threads: int | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
    **options: Any,
) -> list[ArchivedZoom]:
    """Write a terrain's terrain-RGB tiles as one PMTiles archive.

    Parameters
    ----------
    terrain : TerrainFile
    target : path
        Its name ends in ``.pmtiles``; it appears complete or not at all.
    min_zoom, max_zoom : int, optional
        The first zoom, and the last: by default the first one whose pixels are no larger than the
        raster's, which is the largest allowed.
    rim : int
        Pixels by which heights are continued beyond the terrain's edges and into voids
        (`rgb_tile`).
    void_height : float, optional
        Height in metres of voids, which the format lacks; by default 1 m below the lowest height.
    radius : float, optional
        Radius in metres of the body that degrees lie on, instead of the CRS's ellipsoid.
    attribution : str
        Owner of the data, for the metadata.
    threads : int, optional
        All processors by default; the bytes don't depend on it.
    overwrite : bool
        Replace an existing file.
    options
        Of `terrain_rgb.look_of`; `image` is WebP by default, smaller than PNG.
        A warning lists heights outside the encoding's range.

    Raises
    ------
    InvalidHeightsError
        If an argument is out of range, or the raster has no valid height, or no position on a
        globe.
    CorruptStreamError
        If a block is damaged.
    StorageError
        If something cannot be written.
    TerrainwaveError
        If pmtiles or pillow is missing.

    Notes
    -----
    Tiles without terrain are left out. While it runs, a temporary file holds the tiles as well.
    """
    check_ending(target, (ARCHIVE_ENDING,))
    need("PIL", extra="pmtiles", purpose="a terrain-RGB tile")
    writing = need("pmtiles.writer", extra="pmtiles", purpose="a PMTiles archive")
    globe = Globe(terrain, radius=radius)
    rim = checked_whole("rim", rim, least=0, most=tiling.MAX_RIM)
    check_flags(overwrite=overwrite)
    look = tiling.look_of(**{"image": tiling.WEBP} | options)
    zooms = _checked_zooms(globe, min_zoom, max_zoom, look.tile_size)
    if void_height is not None:
        void_height = checked_number("void_height", void_height)
        tiling.check_void_height(void_height, look.encoding)
    if note := tiling.note_on_range(globe, look.encoding):
        warnings.warn(note, TerrainwaveWarning, stacklevel=2)
    numbers = {zoom: tile_numbers(globe, zoom, rim / look.tile_size) for zoom in zooms}
    place_of = need("pmtiles.tile", extra="pmtiles").tileid_to_zxy

    def make(number: int) -> tiling.RgbTile | None:
        z, x, y = place_of(number)
        return tiling.rgb_tile(globe, z, x, y, rim, look, void_height=void_height)

    reporter, n_done, total = Reporter(progress), 0, sum(map(len, numbers.values()))
    n_threads = checked_threads(threads)
    summaries = []
    with (
        publish(target, overwrite) as part,
        ExitStack() as temporary,
        ThreadPoolExecutor(n_threads, thread_name_prefix="terrainwave") as executor,
        storage_errors(f"cannot write {os.fspath(target)}"),
    ):
        writer = writing.Writer(part.file)
        temporary.enter_context(closing(writer.tile_f))  # the writer leaves it open after a failure
        for zoom in zooms:
            written = []
            for number, tile in in_order(executor, make, numbers[zoom], _AHEAD * n_threads):
                if tile is not None:
                    writer.write_tile(number, tile.image)
                    written.append((len(tile.image), tile.error, tile.terrain_error))
                n_done += 1
                reporter.report("writing tiles", n_done, total)
            if written:
                n_bytes, errors, terrain_errors = zip(*written, strict=True)
                _log.info("zoom %d: %d tiles, %d bytes", zoom, len(written), sum(n_bytes))
                pixels = look.pixels(globe, zoom)
                rounding = max(pixels.step / 2, pixels.beyond(*globe.height_range))
                of_terrain = max(terrain_errors)
                summaries.append(
                    ArchivedZoom(
                        zoom, len(written), sum(n_bytes), pixels.step, max(errors), of_terrain,
                        rounding + of_terrain,
                    )
                )  # fmt: skip
        if not summaries:
            raise InvalidHeightsError("there is no valid height: an archive would have no tile")
        writer.finalize(*_description(globe, summaries, attribution, look))
    return summaries


def _checked_zooms(globe: Globe, first: int, last: int | None, tile_size: int) -> range:
    """Return the zooms to write."""
    finest = tiling.max_zoom(globe, tile_size)
    expected = f"0 … {finest}: pixels of the last are no larger than the raster's"
    if last is None:
        last = finest
    last = checked_whole("max_zoom", last, least=0, most=finest, expected=expected)
    first = checked_whole("min_zoom", first, least=0, most=last, expected=f"0 … {last}")
    return range(first, last + 1)


def tile_numbers(globe: Globe, zoom: int, far: float) -> list[int]:
    """Return the numbers of a zoom's tiles at most `far` tiles from the terrain, ascending."""
    number_of = need("pmtiles.tile", extra="pmtiles").zxy_to_tileid
    last = (1 << zoom) - 1
    west, south, east, north = globe.extent
    top, bottom = tiling.row_of(zoom, north) - far, tiling.row_of(zoom, south) + far
    left, right = tiling.column_of(zoom, west) - far, tiling.column_of(zoom, east) + far
    columns = {x % (last + 1) for x in range(math.floor(left), math.floor(right) + 1)}
    return sorted(
        number_of(zoom, x, y)
        for x in columns
        for y in range(max(int(top), 0), min(int(bottom), last) + 1)
        if tiling.meets(globe, zoom, x, y, far)
    )


def _description(
    globe: Globe, summaries: list[ArchivedZoom], attribution: str, look: tiling.Look
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return an archive's header and its metadata."""
    kinds = need("pmtiles.tile", extra="pmtiles")
    west, south, east, north = tiling.bounds_of(globe)
    longitude, latitude = globe.extent.centre
    header = {
        "tile_type": kinds.TileType[look.image.upper()],
        "tile_compression": kinds.Compression.NONE,
        "min_lon_e7": round(west * 1e7),
        "min_lat_e7": round(south * 1e7),
        "max_lon_e7": round(east * 1e7),
        "max_lat_e7": round(north * 1e7),
        "center_zoom": max(summaries[-1].zoom - 3, summaries[0].zoom),
        "center_lon_e7": round(longitude * 1e7),
        "center_lat_e7": round(min(max(latitude, south), north) * 1e7),
    }
    metadata = {
        "type": "baselayer",
        "format": look.image,
        "encoding": look.encoding,
        "tileSize": look.tile_size,
        "generator": f"terrainwave {__version__}",
        "attribution": attribution,
        "units": globe.units,
        "zooms": [asdict(zoom) for zoom in summaries],
    }
    return header, metadata
