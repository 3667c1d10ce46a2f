"""Write a .twz file back to a GeoTIFF or COG, in bounded memory; or as a 16-bit height tile."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from terrainwave.container.publish import refuse_own_source
from terrainwave.errors import InvalidHeightsError
from terrainwave.export.height_tiles import EXTENSIONS as TILE_EXTENSIONS
from terrainwave.export.height_tiles import write_height_tile
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.raster_io.sink import RasterSink
from terrainwave.terrain import Terrain

# Samples of one window: whole rows of groups where they fit, 32 MiB of float64.
_WINDOW_SAMPLES = 4 << 20


def decompress(
    src: Any,
    dst: str | os.PathLike[str],
    *,
    window: Any = None,
    bounds: Sequence[float] | None = None,
    level: int = -1,
    cog: bool = False,
    size: int | str | None = None,
    quality: float | None = None,
    threads: int | None = None,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> str:
    """Write heights of a .twz file as a GeoTIFF or 16-bit height tile; return its path.

    Parameters
    ----------
    src : path, URL, bytes or binary file object
        The .twz file.
    dst : path
        The file to make. It appears complete or not at all. A name ending in ``.r16`` or ``.png``
        makes a 16-bit height tile for game engines, with a ``.json`` beside it that tells scale
        and place; any other name a GeoTIFF.
    window, bounds, level
        Part and resolution to write, as in `Terrain.read`. A level is samples at positions.
    cog : bool
        Make a cloud-optimised GeoTIFF; its overviews are averages of the decoded grid.
    size : int or "window", optional
        Of a height tile: samples on a side, 2ⁿ + 1; the window is resampled bilinearly to that
        square. ``"window"`` writes the window's own samples. By default the largest 2ⁿ + 1 that
        is not larger than the window.
    quality : float, optional
        Of a file of method cdf53: read only so many bits per sample, as in `Terrain.read_early`.
    threads : int, optional
        Threads that decode; the number of processors by default.
    overwrite : bool
        Replace an existing `dst`.

    Raises
    ------
    InvalidHeightsError
        If an option does not fit the kind of file.
    CorruptStreamError
        If a block is damaged; `dst` is untouched.
    StorageError
        If `dst` cannot be written or is `src`; it is untouched.
    """
    reporter = Reporter(progress)
    is_tile = Path(dst).suffix.lower() in TILE_EXTENSIONS
    if is_tile and cog:
        raise InvalidHeightsError(f"{os.fspath(dst)}: a height tile cannot be a COG")
    if is_tile and quality is not None:
        raise InvalidHeightsError(f"{os.fspath(dst)}: a height tile cannot be read in part")
    if size is not None and not is_tile:
        raise InvalidHeightsError(
            f"{os.fspath(dst)}: a size is for height tiles, expected a name ending in"
            f" {' or '.join(TILE_EXTENSIONS)}"
        )
    refuse_own_source(src, dst)
    with Terrain(src, threads=threads) as terrain:
        region = terrain.region(window, bounds=bounds, level=level)
        if is_tile:
            return write_height_tile(
                terrain,
                dst,
                region,
                level=level,
                size=size,
                overwrite=overwrite,
                reporter=reporter,
            )
        info = replace(
            terrain.raster_info,
            n_rows=region.n_rows,
            n_cols=region.n_cols,
            transform=terrain.transform(level, region),
        )
        total = region.n_rows * region.n_cols
        done = 0
        with RasterSink(dst, info, cog=cog, overwrite=overwrite, n_threads=threads or 1) as sink:
            side = 2 * terrain.grid.block
            n_rows = max(side, _WINDOW_SAMPLES // max(region.n_cols, 1) // side * side)
            n_cols = max(side, _WINDOW_SAMPLES // n_rows // side * side)
            # Along the borders of groups, so that each is decoded once.
            for part in region.tiles(n_rows, n_cols, is_aligned=True):
                if quality is None:
                    heights, valid = terrain.read_with_mask(part, level=level)
                else:
                    heights, valid, _ = terrain.read_early(part, level=level, quality=quality)
                sink.write(part.row - region.row, part.col - region.col, heights, valid)
                done += part.n_rows * part.n_cols
                reporter.report("decoding", done, total, done * heights.dtype.itemsize)
    return os.fspath(dst)
