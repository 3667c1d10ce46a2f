"""What heights had lost before: those of a .twz file, or of an array that came out of one.

Of a .twz file the bound is known, and what `compress` is asked for is the bound from the original:
the new loss may be what is left of it.

An array says how far it may be from the original (``max_error``), and goes on saying so when its
heights have become others: xarray keeps attributes. So the bound counts only where the heights are
compared with those of the file, and are the same. It adds to the bound that is asked for.
"""

import os
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError, TerrainwaveError
from terrainwave.file import TerrainFile
from terrainwave.grid.affine import strides_on
from terrainwave.grid.quantum import as_fraction, rounded_up
from terrainwave.grid.steps import FixedSteps
from terrainwave.raster_io.earlier_loss import EarlierFile, earlier_files
from terrainwave.raster_io.source import RasterSource
from terrainwave.write.compress_options import Options


class Earlier(NamedTuple):
    """What heights had lost before.

    Parameters
    ----------
    error : float
        How far they may be from an original already, in physical units.
    is_still : bool
        They lie on fixed steps, where they stay: the new file loses nothing of them.
    note : str
        What a user should know of it; empty where nothing is claimed.
    files : tuple of EarlierFile
        The .twz files that they went through.
    asked : Options, optional
        What was asked of the bound from the original; None where that is not known, and the bound
        that is asked for is the one from the heights.
    """

    error: float = 0.0
    is_still: bool = False
    note: str = ""
    files: tuple[EarlierFile, ...] = ()
    asked: Options | None = None

    def beyond(self, own: float) -> tuple[float, list[str]]:
        """Return what a file's bound is larger by than `own`, that from the heights; and notes."""
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
    """Return the options with the bound from the heights as they are; as given for rasters.

    Without a bound, heights of .twz files are kept as they are.

    Raises
    ------
    InvalidArgumentError
        If .twz files have lost more than the bound already, or `stable` would move their heights.
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
    """Return what heights had lost before.

    Where an array claims something, reads the heights once more, and the file; else nothing.
    `steps` are those that heights will be rounded to.
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
    claim = source.claim
    if claim is None:
        return NOTHING
    reason = "and no .twz file to compare them with"
    if claim.path is not None:
        try:
            with TerrainFile(claim.path) as terrain:
                if _has_same_heights(terrain, source):
                    is_still = steps is not None and _is_on(source, steps)
                    bound = terrain.effective_error
                    own = EarlierFile(os.path.basename(claim.path), bound)
                    return Earlier(
                        bound,
                        is_still,
                        f"the heights are those of {claim.path}, within"
                        f" {bound:.6g} of an original{', and do not move' * is_still}",
                        (*earlier_files(terrain.header.metadata), own),
                    )
            reason = f"and are not those of {claim.path}"
        except TerrainwaveError as error:
            reason = f"and cannot be compared: {error}"
    return Earlier(
        note=f"the heights came with the attribute max_error, {claim.max_error:.6g}, {reason}: the"
        " file's bound is from the heights as they are now"
    )


def _has_same_heights(terrain: TerrainFile, source: RasterSource) -> bool:
    """Say whether all of an array is samples of a file, at the places that it says."""
    info, theirs = source.info, terrain.raster_info
    is_stored = (info.scale, info.offset) == (theirs.scale, theirs.offset)
    if not is_stored and (info.scale, info.offset) != (1.0, 0.0):
        return False
    strides = strides_on(info.transform, (info.n_rows, info.n_cols), theirs.transform)
    if strides is None:
        return False
    for region in source.blocks():
        heights, valid = source.read(*region)
        rows = _samples(strides.row, strides.row_stride, region.row, region.n_rows)
        cols = _samples(strides.col, strides.col_stride, region.col, region.n_cols)
        if not (_are_within(rows, theirs.n_rows) and _are_within(cols, theirs.n_cols)):
            return False
        window = (rows.min(), cols.min(), np.ptp(rows) + 1, np.ptp(cols) + 1)
        stored, is_valid = terrain.read_with_mask(tuple(map(int, window)))
        at = np.ix_(rows - rows.min(), cols - cols.min())
        if not np.array_equal(is_valid[at], valid):
            return False
        physical = stored[at] if is_stored else theirs.to_physical(stored[at])
        # As numbers: an array has them in the type that its voids or its scale need.
        if not np.array_equal(physical[valid], heights[valid]):
            return False
    return True


def _is_on(source: RasterSource, steps: FixedSteps) -> bool:
    """Say whether all heights lie on steps already."""
    for region in source.blocks():
        heights, valid = source.read(*region)
        if not np.array_equal(steps.rounded(heights)[valid], heights[valid]):
            return False
    return True


def _samples(first: int, stride: int, begin: int, n: int) -> NDArray[np.int64]:
    """Return the file's rows or columns that a window of the array is of."""
    return first + stride * np.arange(begin, begin + n, dtype=np.int64)


def _are_within(samples: NDArray[np.int64], size: int) -> bool:
    return bool(samples.min() >= 0 and samples.max() < size)
