"""Write a .twz file to a GeoTIFF or COG, in bounded memory; or to a 16-bit height tile."""

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import (
    AS_IS,
    EXACT,
    GEOTIFF_ENDINGS,
    HEIGHT_TILE_ENDINGS,
    MASK,
    RAISE,
    VOIDS,
    check_callback,
    check_ending,
    check_flags,
    check_vertical,
    checked_number,
    checked_threads,
    one_of,
    shown,
)
from terrainwave.container.targets.publication import refuse_own_source
from terrainwave.errors import CorruptStreamError, InvalidArgumentError, TerrainwaveWarning
from terrainwave.export.georeference import info_to_write, keep_place
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Region
from terrainwave.progress import ProgressCallback, Reporter
from terrainwave.raster_io.geotiff.sink import RasterSink
from terrainwave.read.lost import Losses

if TYPE_CHECKING:
    from terrainwave.export.ellipsoidal import AboveEllipsoid

# Samples of one window: whole rows of groups if they fit, 32 MiB of float64.
_WINDOW_SAMPLES = 4 << 20
# Number of damaged blocks that warnings name.
_MOST_NAMED = 10

# Heights and validity.
_Samples = tuple[NDArray[Any], NDArray[np.bool_]]


def decompress(
    src: Any,
    dst: str | os.PathLike[str],
    *,
    window: Any = None,
    bounds: Sequence[float] | None = None,
    level: int = -1,
    cog: bool = False,
    size: int | str | None = None,
    voids: str | float | None = None,
    quality: float | None = None,
    vertical: str = AS_IS,
    on_error: str = RAISE,
    on_lost: Callable[[Losses], None] | None = None,
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
        Output file. It appears complete or not at all. A name that ends in ``.tif`` or ``.tiff``
        makes a GeoTIFF; ``.r16`` or ``.png`` a 16-bit height tile for game engines, with its scale
        and georeference in a ``.json`` next to it. Other names are refused.
    window, bounds, level
        Part and resolution to write, as in `Terrain.read`. Levels are samples, not averages.
    cog : bool
        Make a cloud-optimised GeoTIFF; its overviews are averages of the decoded grid.
    size : int or "window", optional
        For height tiles: samples on a side, 2ⁿ + 1. The window is resampled bilinearly to that
        square. ``"window"`` writes the window's own samples. By default the largest 2ⁿ + 1 that
        fits into the window.
    voids : {"exact", "any", "lowest", "fill"} or float, optional
        For a GeoTIFF, ``"exact"`` or ``"any"``: voids of a coarse level, as in `Terrain.read`. For
        a height tile, the height of voids: the tile's lowest (default), that of their surroundings
        (``"fill"``), or a height in physical units.
    quality : float, optional
        For files of method cdf53: read only this number of bits per sample, as in
        `Terrain.read_early`.
    vertical : {"as-is", "ellipsoid"}
        ``"ellipsoid"`` converts heights from the CRS's vertical datum with PROJ's grid. It writes
        metres above the ellipsoid, as float32 or float64, and the CRS with ellipsoidal heights.
        The tag TERRAINWAVE_VERTICAL names the conversion. The band's tag MAX_ERROR in the domain
        TERRAINWAVE is the bound, for the full grid and not in a COG.
    on_error : {"raise", "mask"}
        ``"mask"``: damaged blocks become void, and a warning names each of them; a file that ends
        too early is read as far as possible. A raster without nodata value gets a mask.
    on_lost : callable, optional
        With `on_error` ``"mask"``: called once with the `Losses`, at the end, if there are any.
    threads : int, optional
        Threads that decode; the number of processors by default.
    overwrite : bool
        Replace an existing `dst`.

    Raises
    ------
    InvalidArgumentError
        If an option does not fit the kind of file.
    InvalidHeightsError
        If heights cannot be converted.
    CorruptStreamError
        If a block is damaged; `dst` is untouched.
    StorageError
        If `dst` cannot be written or is `src`; it is untouched.
    """
    check_flags(cog=cog, overwrite=overwrite)
    check_callback(on_lost, "on_lost", "Losses")
    reporter = Reporter(progress)
    n_threads = 1 if threads is None else checked_threads(threads)
    check_ending(dst, (*GEOTIFF_ENDINGS, *HEIGHT_TILE_ENDINGS))
    is_tile = Path(dst).suffix.lower() in HEIGHT_TILE_ENDINGS
    if quality is not None:
        quality = checked_number("quality", quality, above=0)
    is_converted = check_vertical(vertical)
    if is_tile:
        _check_height_tile(dst, cog=cog, quality=quality, is_converted=is_converted)
    else:
        _check_geotiff(dst, voids, size)
    refuse_own_source(src, dst)
    with TerrainFile(src, threads=threads, on_error=on_error) as terrain:
        asked = terrain.checked_window(window, bounds=bounds, level=level)
        region = asked.region
        if note := asked.note_on_cut(terrain.res):
            warnings.warn(note, TerrainwaveWarning, stacklevel=2)
        if is_tile:
            from terrainwave.export.height_tiles import write_height_tile

            path = write_height_tile(
                terrain,
                dst,
                region,
                level=level,
                size=size,
                voids="lowest" if voids is None else voids,
                overwrite=overwrite,
                reporter=reporter,
            )
            _tell_lost(terrain, level, region, on_lost)
            return path
        info = info_to_write(terrain)
        if on_error == MASK and info.mask_kind == "none":
            info = replace(info, mask_kind="mask")
        info = replace(
            info,
            n_rows=region.n_rows,
            n_cols=region.n_cols,
            transform=terrain.transform_of(level, region)[:6],
        )
        wanted = EXACT if voids is None else str(voids)

        def read(part: Region) -> _Samples:
            if quality is None:
                return terrain.read_with_mask(part, level=level, voids=wanted)
            return terrain.read_early(part, level=level, quality=quality, voids=wanted)[:2]

        stated: dict[str, str] = {}
        if is_converted:
            # Few conversions need it.
            from terrainwave.export.ellipsoidal import above_ellipsoid

            converted = above_ellipsoid(terrain, info, level, is_early=quality is not None)
            info, stated = converted.info, converted.stated
            read = partial(_converted, converted, read, region)
        with RasterSink(
            dst, info, cog=cog, overwrite=overwrite, n_threads=n_threads, stated=stated
        ) as sink:
            has_heights = (
                partial(_may_have_heights, terrain, asked.level) if sink.may_be_sparse else None
            )
            _write(sink, read, region, 2 * terrain.grid.block, reporter, has_heights)
        keep_place(dst, info)
        _tell_lost(terrain, level, region, on_lost)
    return os.fspath(dst)


def _tell_lost(
    terrain: TerrainFile, level: int, region: Region, on_lost: Callable[[Losses], None] | None
) -> None:
    """Warn of the damaged blocks that became void; of many, name the first."""
    lost, missing = terrain.lost, terrain.container.n_missing
    if not lost and not missing:
        return
    index = terrain.level_index(level)
    windows = [Region(*one.window) for one in lost if one.level == index]
    n_lost = sum(_n_samples(window.intersect(region)) for window in windows)
    share = min(n_lost / _n_samples(region), 1)
    lines = [f"lost: {one}" for one in lost[:_MOST_NAMED]]
    if missing:
        n_bytes = terrain.container.extents.file_size
        lines.insert(
            0,
            f"{terrain.name} has {n_bytes - missing:,} of its {n_bytes:,} bytes and was read as far"
            " as it goes",
        )
    if len(lost) > _MOST_NAMED:
        lines.append(f"lost: {len(lost) - _MOST_NAMED} more parts, which verify lists")
    if windows:
        lines.append(f"lost: {100 * share:.3g} % of the samples, which are void now")
    for line in lines:
        warnings.warn(line, TerrainwaveWarning, stacklevel=3)
    if on_lost is not None:
        on_lost(Losses(share, missing, tuple(lost)))


def _n_samples(region: Region) -> int:
    return max(region.n_rows, 0) * max(region.n_cols, 0)


def _check_height_tile(
    dst: str | os.PathLike[str], *, cog: bool, quality: float | None, is_converted: bool
) -> None:
    """Raise `InvalidArgumentError` for options of GeoTIFFs."""
    if cog:
        raise InvalidArgumentError(f"{os.fspath(dst)}: a height tile cannot be a COG")
    if quality is not None:
        raise InvalidArgumentError(f"{os.fspath(dst)}: a height tile cannot be read in part")
    if is_converted:
        raise InvalidArgumentError(
            f"{os.fspath(dst)}: found `vertical` ellipsoid for a height tile, which keeps the"
            " file's datum; expected a GeoTIFF"
        )


def _check_geotiff(
    dst: str | os.PathLike[str], voids: str | float | None, size: int | str | None
) -> None:
    """Raise `InvalidArgumentError` for options of height tiles."""
    if not (voids is None or (isinstance(voids, str) and voids in VOIDS)):
        raise InvalidArgumentError(
            f"{os.fspath(dst)}: found `voids` {shown(voids)}, which is for height tiles, expected"
            f" {one_of(VOIDS)}, or a name ending in {one_of(HEIGHT_TILE_ENDINGS)}"
        )
    if size is not None:
        raise InvalidArgumentError(
            f"{os.fspath(dst)}: `size` is for height tiles, expected a name ending in"
            f" {one_of(HEIGHT_TILE_ENDINGS)}"
        )


def _may_have_heights(terrain: TerrainFile, level: int, region: Region) -> bool:
    """Return whether a region of a level may have heights; reading it reports damage."""
    try:
        return next(terrain.coded_parts(region, level), None) is not None
    except CorruptStreamError:
        return True


def _converted(
    converted: "AboveEllipsoid", read: Callable[[Region], _Samples], region: Region, part: Region
) -> _Samples:
    """Return a part of a region, converted to heights above the ellipsoid."""
    heights, valid = read(part)
    return converted.heights(part, region, heights, valid), valid


def _write(
    sink: RasterSink,
    read: Callable[[Region], _Samples],
    region: Region,
    side: int,
    reporter: Reporter,
    has_heights: Callable[[Region], bool] | None = None,
) -> None:
    """Write a region in parts along the borders of groups, so that each is decoded once.

    Parts known to have no heights are skipped.
    """
    itemsize = np.dtype(sink.info.dtype).itemsize
    n_rows = max(side, _WINDOW_SAMPLES // max(region.n_cols, 1) // side * side)
    n_cols = max(side, _WINDOW_SAMPLES // n_rows // side * side)
    total, done = region.n_rows * region.n_cols, 0
    for part in region.tiles(n_rows, n_cols, is_aligned=True):
        if has_heights is None or has_heights(part):
            sink.write(part.row - region.row, part.col - region.col, *read(part))
        done += part.n_rows * part.n_cols
        reporter.report("decoding", done, total, done * itemsize)
