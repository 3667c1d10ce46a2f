"""16-bit height tiles for game engines: raw little-endian (.r16) or PNG, with a JSON file.

A tile's samples lie on the corners of its cells, the outermost on its edge, as engines expect: 2ⁿ +
1 samples on a side. ``height = offset + scale * sample``.
"""

import json
import math
import os
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave._version import __version__
from terrainwave.arguments import FILLINGS, MAX_TILE_SIZE, checked_number, checked_tile_size
from terrainwave.container.spool import cannot_write, storage_errors
from terrainwave.container.targets.publication import publish
from terrainwave.errors import (
    InvalidArgumentError,
    LimitExceededError,
    TerrainwaveError,
    TerrainwaveWarning,
)
from terrainwave.file import TerrainFile
from terrainwave.grid.affine import IDENTITY, Transform, bounds, pixel_size
from terrainwave.grid.quadtree import Region
from terrainwave.place.position import place_of
from terrainwave.progress import Reporter
from terrainwave.raster_io.gdal import GDAL_ERRORS, bounded_env, one_line
from terrainwave.read.resample import bilinear_sums, fill_voids, weighted_means

_MAX_SAMPLES = MAX_TILE_SIZE**2
_HIGHEST = 65535
_SMOOTHING_ROUNDS = 4
# Beyond this the drawn shape changes visibly.
_LARGEST_STRETCH = 0.005
# Samples to read at a time: 32 MiB of float64.
_BAND_SAMPLES = 4 << 20


class _Quantized(NamedTuple):
    samples: NDArray[np.uint16]
    scale: float
    offset: float
    error: float


def write_height_tile(
    terrain: TerrainFile,
    path: str | os.PathLike[str],
    region: Region,
    *,
    level: int,
    size: int | str | None,
    voids: str | float,
    overwrite: bool,
    reporter: Reporter,
) -> str:
    """Write a window as a 16-bit tile and its JSON; return the tile's path.

    The path ends in ``.r16`` or ``.png``; the JSON has the same name plus ``.json``. Both appear
    complete or not at all. The window, at least 2 x 2 samples, is resampled bilinearly to a square
    of `size` samples a side, 2ⁿ + 1, corner sample to corner sample. ``"window"`` writes the
    window's samples without resampling; None too if they form such a square, else it selects the
    largest tile within the window's size. `voids` is the height of voids: the lowest of the tile,
    that of their surroundings (``"fill"``), or a number.
    """
    shape = _tile_shape(region, size)
    filling = checked_voids(voids)
    heights, valid = _read(terrain, region, level, shape, reporter)
    scale, offset = terrain.raster_info.scale, terrain.raster_info.offset
    heights = heights * scale + offset
    if terrain.height_unit.is_depth:  # programs for such tiles only know heights
        terrain.height_unit.note_kind()
        heights = -heights
    _warn_of_aspect(terrain, region, level, shape)
    # A float replaces all voids; without voids the range must not be stretched to it.
    if filling == "fill":
        heights = fill_voids(heights, valid, _SMOOTHING_ROUNDS)
    elif isinstance(filling, float):
        heights = np.where(valid, heights, filling)
    has_heights = valid if filling == "lowest" else np.ones_like(valid)
    tile = _quantize(heights, has_heights if valid.any() else valid)
    name = Path(path)
    about = {"generator": f"terrainwave {__version__}", "file": name.name}
    about |= _describe(terrain, region, level, shape, valid, tile, filling)
    if name.suffix.lower() == ".png":
        data = _png(tile.samples, name)
    else:
        data = tile.samples.astype("<u2").tobytes()
    text = json.dumps(about, indent=2, allow_nan=False) + "\n"
    beside = name.with_name(f"{name.name}.json")
    with publish(beside, overwrite) as sidecar, publish(path, overwrite) as part:
        with storage_errors(f"cannot write {path}"):
            part.file.write(data)
            sidecar.file.write(text.encode())
    return os.fspath(path)


def _tile_shape(region: Region, size: int | str | None) -> tuple[int, int]:
    shorter = min(region.shape)
    if shorter < 2:
        raise InvalidArgumentError(
            f"found a `window` of {region.n_rows} x {region.n_cols} samples, expected at least"
            " 2 x 2"
        )
    if size == "window":
        if region.n_rows * region.n_cols > _MAX_SAMPLES:
            raise LimitExceededError(
                f"the window holds {region.n_rows} x {region.n_cols} samples, more than"
                f" {MAX_TILE_SIZE} x {MAX_TILE_SIZE}: take a smaller one or a size"
            )
        return region.shape
    if size is None:
        power = 1 << (max(shorter - 1, 2).bit_length() - 1)
        size = min(power + 1, MAX_TILE_SIZE)
    side = checked_tile_size("size", size)
    return side, side


def _read(
    terrain: TerrainFile, region: Region, level: int, shape: tuple[int, int], reporter: Reporter
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    rows = np.linspace(0, region.n_rows - 1, shape[0])
    cols = np.linspace(0, region.n_cols - 1, shape[1])
    heights, valid = np.empty(shape), np.empty(shape, dtype=bool)
    for start, stop in _bands(rows, region.n_cols):
        first = int(rows[start])
        last = min(int(rows[stop - 1]) + 1, region.n_rows - 1)
        part = Region(region.row + first, region.col, last - first + 1, region.n_cols)
        samples, is_valid = terrain.read_with_mask(part, level=level)
        heights[start:stop], valid[start:stop] = weighted_means(
            *bilinear_sums(samples, is_valid, rows[start:stop] - first, cols)
        )
        reporter.report("decoding", stop * shape[1], shape[0] * shape[1], 0)
    return heights, valid


def _bands(rows: NDArray[np.float64], n_cols: int) -> Iterator[tuple[int, int]]:
    """Yield runs of output rows whose input rows fit into memory."""
    n_held = max(_BAND_SAMPLES // n_cols, 2)
    start = 0
    while start < len(rows):
        stop = int(np.searchsorted(rows, rows[start] + n_held - 1, side="right"))
        yield start, max(stop, start + 1)
        start = max(stop, start + 1)


def _quantize(heights: NDArray[np.float64], valid: NDArray[np.bool_]) -> _Quantized:
    """Spread the valid heights over 0 … 65535; voids get the lowest."""
    if not valid.any():
        return _Quantized(np.zeros(heights.shape, dtype=np.uint16), 1.0, 0.0, 0.0)
    low, high = float(heights[valid].min()), float(heights[valid].max())
    scale = (high - low) / _HIGHEST if high > low else 1.0
    samples = np.rint((np.where(valid, heights, low) - low) / scale)
    samples = np.clip(samples, 0, _HIGHEST).astype(np.uint16)
    error = np.abs(low + scale * samples[valid] - heights[valid]).max()
    return _Quantized(samples, scale, low, float(error))


def _describe(
    terrain: TerrainFile,
    region: Region,
    level: int,
    shape: tuple[int, int],
    valid: NDArray[np.bool_],
    tile: _Quantized,
    filling: str | float,
) -> dict[str, Any]:
    """Return the fields of the JSON file; docs/meshes.md lists them."""
    raster = terrain.raster_info
    is_resampled = shape != region.shape
    is_full = terrain.level_index(level) == terrain.n_levels - 1
    bound = terrain.effective_error if is_full else None
    transform = _tile_transform(terrain.transform_of(level, region)[:6], region, shape)
    return {
        "rows": shape[0],
        "columns": shape[1],
        "sample": "uint16, little-endian, rows from the raster's first one",
        "scale": tile.scale,
        "offset": tile.offset,
        "minimum": tile.offset,
        "maximum": tile.offset + tile.scale * int(tile.samples.max()),
        "unit": terrain.units,
        "n_void": int(valid.size - np.count_nonzero(valid)),
        "void": {"lowest": "the lowest height", "fill": "filled from around"}.get(
            str(filling), filling
        ),
        "resampled": "bilinear" if is_resampled else None,
        "level": terrain.level_index(level),
        "error": {
            "decoded": bound,
            "quantisation": tile.error,
            "sum": None if bound is None else bound + tile.error,
        },
        "crs": raster.crs,
        "transform": None if raster.transform == IDENTITY else list(transform),
        "pixel_size": list(pixel_size(transform)),
        "pixel_metres": _metres(terrain, transform),
        "bounds": list(bounds(transform, shape, inset=0.5)),
    }


def _metres(terrain: TerrainFile, transform: Transform) -> list[float] | None:
    raster = terrain.raster_info
    if raster.crs is None:
        return None
    left, bottom, right, top = terrain.bounds
    try:
        place = place_of(raster.crs, terrain.bounds)
        per_x, per_y = place.local_axes((left + right) / 2, (bottom + top) / 2).lengths
    except TerrainwaveError:  # pyproj is not installed, or at a pole
        return None
    a, b, _, d, e, _ = transform
    return [math.hypot(a * per_x, d * per_y), math.hypot(b * per_x, e * per_y)]


def _warn_of_aspect(
    terrain: TerrainFile, region: Region, level: int, shape: tuple[int, int]
) -> None:
    """Warn if a landscape is stretched: engines assume square cells."""
    by_row, by_col = (region.n_rows - 1) / (shape[0] - 1), (region.n_cols - 1) / (shape[1] - 1)
    if abs(by_row / by_col - 1) <= _LARGEST_STRETCH:
        return
    width, height = pixel_size(terrain.transform_of(level, region)[:6])
    warnings.warn(
        f"the window of {region.n_rows} x {region.n_cols} samples is stretched to {shape[0]} x"
        f" {shape[1]}: cells are {width * by_col:.6g} wide and {height * by_row:.6g} high, and were"
        f" {width:.6g} and {height:.6g}; `size` window keeps the raster's own, a square window its"
        " aspect",
        TerrainwaveWarning,
        stacklevel=2,
    )


def checked_voids(voids: str | float) -> str | float:
    if isinstance(voids, str):
        if voids in FILLINGS:
            return voids
        # The command line passes texts.
        with suppress(ValueError):
            voids = float(voids)
    return checked_number("voids", voids, expected="lowest, fill or a height")


def _tile_transform(
    transform: tuple[float, ...], region: Region, shape: tuple[int, int]
) -> tuple[float, ...]:
    """Return the affine of the tile's pixels, around its samples, from that of the region's."""
    a, b, c, d, e, f = transform
    by_col, by_row = (region.n_cols - 1) / (shape[1] - 1), (region.n_rows - 1) / (shape[0] - 1)
    x, y = c + (a + b) / 2, f + (d + e) / 2  # of the first sample, which does not move
    a, b, d, e = a * by_col, b * by_row, d * by_col, e * by_row
    return a, b, x - (a + b) / 2, d, e, y - (d + e) / 2


def _png(samples: NDArray[np.uint16], path: Path) -> bytes:
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.io import MemoryFile

    profile = {"driver": "PNG", "count": 1, "dtype": "uint16"}
    try:
        with bounded_env(), warnings.catch_warnings(), MemoryFile() as memory:
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            rows, cols = samples.shape
            with memory.open(height=rows, width=cols, **profile) as dataset:
                dataset.write(samples, 1)
            return bytes(memory.read())
    except GDAL_ERRORS as error:
        raise cannot_write(path, one_line(error)) from error
