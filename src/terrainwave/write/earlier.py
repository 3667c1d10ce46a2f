"""Earlier losses of heights: of those in a .twz file, and of arrays read from one.

A .twz file states its bound, and `max_error` is the bound from its original: the new loss may use
the rest.

An array names the file that it came from, even after its heights have changed, because xarray keeps
encodings. So that bound counts only if the heights equal those of the file. It is added to the
requested bound.
"""

import os
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError, TerrainwaveError
from terrainwave.file import TerrainFile
from terrainwave.grid.affine import Strides, strides_on
from terrainwave.grid.quantum import as_fraction, rounded_up
from terrainwave.grid.steps import FixedSteps
from terrainwave.place.crs import format_crs
from terrainwave.place.units import height_unit, meeting
from terrainwave.raster_io.raster_info import EarlierFile, RasterInfo, earlier_files
from terrainwave.raster_io.source import RasterSource
from terrainwave.write.compress_options import Options


class Earlier(NamedTuple):
    """Earlier loss of some heights.

    Parameters
    ----------
    error : float
        Largest distance from the original so far, in physical units.
    is_still : bool
        The heights lie on fixed steps already: the new file loses nothing.
    note : str
        Remark for the user; empty if no loss is known.
    files : tuple of EarlierFile
        The .twz files that they went through.
    asked : Options, optional
        Options with the bound from the original; None if that is unknown, and the requested bound
        is the one from the heights.
    """

    error: float = 0.0
    is_still: bool = False
    note: str = ""
    files: tuple[EarlierFile, ...] = ()
    asked: Options | None = None

    def beyond(self, own: float) -> tuple[float, list[str]]:
        """Return the amount to add to `own`, the bound from the heights; and notes."""
        if not self.error:
            return 0.0, [self.note] * bool(self.note)
        if self.asked is not None and not self.asked.is_embedded:
            return self.error, [f"{self.note}: the file's bound includes this"]
        more = max(self.error - own, 0.0) if self.is_still else self.error
        size = "this" if more == self.error else f"{more:.6g}"
        end = f"the file's bound is larger by {size}" if more else "the file's bound holds for it"
        return more, [f"{self.note}: {end}"]


NOTHING = Earlier()


def for_heights_of(source: RasterSource, options: Options) -> Options:
    """Return the options with the bound from the given heights; unchanged for rasters.

    Without a bound, heights of .twz files are stored without loss.
    """
    loss = source.earlier
    if loss is None or options.is_embedded:
        return options
    if options.stable and loss.max_error:
        raise InvalidArgumentError(
            f"found `stable` and heights of {source.name} within {loss.max_error:g} of their"
            " original, expected the original raster: fixed steps would round them once more, by"
            " more than the bound leaves"
        )
    if options.max_error is None:
        return replace(options, max_error=0.0)
    left = as_fraction(options.max_error) - as_fraction(loss.max_error)
    if left < 0:
        raise InvalidArgumentError(
            f"found `max_error` {options.max_error:g} and heights of {source.name} within"
            f" {loss.max_error:g} of their original, expected at least"
            f" {rounded_up(as_fraction(loss.max_error))}: what is lost does not come back; a"
            " smaller bound needs the original raster"
        )
    return replace(options, max_error=float(left))


def earlier_of(source: RasterSource, asked: Options, steps: FixedSteps | None) -> Earlier:
    """Return the earlier loss of heights.

    For an array from a lossy file this reads the heights, and the file. `steps` are the steps that
    heights will be rounded to.
    """
    loss = source.earlier
    if loss is not None:
        note = f"the heights are those of {source.name}"
        if loss.max_error:
            note += f", within {loss.max_error:.6g} of an original"
        elif asked.max_error is not None or asked.is_embedded:
            note = ""
        if asked.max_error is None and not asked.is_embedded:
            note = f"no --max-error given: {note}"
        return Earlier(loss.max_error, note=note, files=loss.files, asked=asked)
    path = source.came_from
    if path is None:
        return NOTHING
    try:
        with TerrainFile(path) as terrain:
            # Coarse levels of a lossless file have errors, but reading its full grid for them costs
            # too much; they lack neighbouring samples.
            at = _strides(terrain, terrain.n_levels - 1, source.info)
            is_full = at is not None and abs(at.row_stride) == abs(at.col_stride) == 1
            if not terrain.effective_error and is_full:
                return NOTHING
            bound = _bound_of(terrain, source)
            if bound is not None:
                return _of_file(terrain, bound, steps is not None and _is_on(source, steps))
            if not terrain.effective_error:
                return NOTHING
        reason = "and are not its heights at their place any more"
    except TerrainwaveError as error:
        reason = f"and cannot be compared with it: {error}"
    return Earlier(
        note=f"the heights came from {path}, {reason}: the file's bound is from the heights as they"
        " are now"
    )


def _of_file(terrain: TerrainFile, bound: float, is_still: bool) -> Earlier:
    if not bound:
        return NOTHING
    return Earlier(
        bound,
        is_still,
        f"the heights are those of {terrain.name}, within"
        f" {bound:.6g} of an original{', and do not move' * is_still}",
        (
            *earlier_files(terrain.header.metadata),
            EarlierFile(os.path.basename(str(terrain.name)), bound),
        ),
    )


def bound_of(source: RasterSource) -> float | None:
    """Return the bound of an array's heights if they equal those of the file that it came from.

    Reads both. The bound is from the file's original, in its unit. None if values, voids or
    position differ, or the array names no file.
    """
    if source.came_from is None:
        return None
    with TerrainFile(source.came_from) as terrain:
        return _bound_of(terrain, source)


def _bound_of(terrain: TerrainFile, source: RasterSource) -> float | None:
    info, theirs = source.info, terrain.raster_info
    is_scaled = (info.scale, info.offset) != (1.0, 0.0)
    if is_scaled and (info.scale, info.offset) != (theirs.scale, theirs.offset):
        return None
    # Missing units may have got lost on the way.
    if info.units is not None:
        unit, own = height_unit(info.units, info.crs), height_unit(theirs.units, theirs.crs)
        if own.name is None or meeting(source.name, unit, str(terrain.name), own).problem:
            return None
    if info.crs is not None and info.crs != format_crs(theirs.rasterio_crs()):
        return None
    finest = terrain.n_levels - 1
    for level in range(finest, -1, -1):
        if _has_same_heights(terrain, level, source):
            return terrain.effective_error if level == finest else terrain.level_errors()[level]
    return None


def _strides(terrain: TerrainFile, level: int, info: RasterInfo) -> Strides | None:
    """Return the position of an array on the samples of a level; None if it has none."""
    place = tuple(terrain.transform_of(level)[:6])
    return strides_on(info.transform, (info.n_rows, info.n_cols), place)


def _has_same_heights(terrain: TerrainFile, level: int, source: RasterSource) -> bool:
    """Return whether an array equals samples of a level at the positions that it states."""
    info, theirs = source.info, terrain.raster_info
    is_stored = (info.scale, info.offset) == (theirs.scale, theirs.offset)
    n_rows, n_cols = terrain.level_shape(level)
    strides = _strides(terrain, level, info)
    if strides is None:
        return False
    for region in source.blocks():
        heights, valid = source.read(*region)
        rows = _samples(strides.row, strides.row_stride, region.row, region.n_rows)
        cols = _samples(strides.col, strides.col_stride, region.col, region.n_cols)
        if not (_are_within(rows, n_rows) and _are_within(cols, n_cols)):
            return False
        window = (rows.min(), cols.min(), np.ptp(rows) + 1, np.ptp(cols) + 1)
        stored, is_valid = terrain.read_with_mask(tuple(map(int, window)), level=level)
        at = np.ix_(rows - rows.min(), cols - cols.min())
        if not np.array_equal(is_valid[at], valid):
            return False
        physical = stored[at] if is_stored else theirs.to_physical(stored[at])
        # Compared as numbers: voids or a scale may have changed the array's type.
        if not np.array_equal(physical[valid], heights[valid]):
            return False
    return True


def _is_on(source: RasterSource, steps: FixedSteps) -> bool:
    for region in source.blocks():
        heights, valid = source.read(*region)
        if not np.array_equal(steps.rounded(heights)[valid], heights[valid]):
            return False
    return True


def _samples(first: int, stride: int, begin: int, n: int) -> NDArray[np.int64]:
    return first + stride * np.arange(begin, begin + n, dtype=np.int64)


def _are_within(samples: NDArray[np.int64], size: int) -> bool:
    return bool(samples.min() >= 0 and samples.max() < size)
