"""What heights had lost before: those of a .twz file, or of an array that came out of one.

Of a .twz file the bound is known, and what `compress` is asked for is the bound from the original:
the new loss may be what is left of it.

An array says how far it may be from the original (``max_error``), and goes on saying so when its
heights have become others: xarray keeps attributes. So the bound counts only where the heights are
compared with those of the file, and are the same. It adds to the bound that is asked for.
"""

import os
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError, TerrainwaveError
from terrainwave.file import TerrainFile
from terrainwave.grid.affine import steps_on
from terrainwave.grid.quantum import as_fraction
from terrainwave.raster_io.earlier import NO_LOSS, EarlierLoss, Step, steps_of
from terrainwave.raster_io.source import RasterSource
from terrainwave.write.options import Options


def for_heights_of(source: RasterSource, options: Options) -> Options:
    """Return the options with the bound from the heights as they are; as given for rasters.

    Without a bound, heights of .twz files are kept as they are.

    Raises
    ------
    InvalidArgumentError
        If .twz files have lost more than the bound already.
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
            f" {loss.max_error:g} of their original, expected at least {loss.max_error:g}: what is"
            " lost does not come back; a smaller bound needs the original raster"
        )
    return replace(options, max_error=float(left))


def earlier_loss(source: RasterSource, asked: Options) -> tuple[EarlierLoss, list[str]]:
    """Return how far heights may be from an original already, and notes.

    Where an array claims something, reads the heights once more, and the file; else nothing.
    """
    if source.earlier is not None:
        return source.earlier, _notes_on(source, source.earlier, asked)
    claim = source.claim
    if claim is None:
        return NO_LOSS, []
    reason = "and no .twz file to compare them with"
    if claim.path is not None:
        try:
            with TerrainFile(claim.path) as terrain:
                if _has_same_heights(terrain, source):
                    bound = terrain.effective_error
                    own = Step(os.path.basename(claim.path), bound)
                    return EarlierLoss(bound, (*steps_of(terrain.header.metadata), own)), [
                        f"the heights are those of {claim.path}, within"
                        f" {terrain.effective_error:.6g} of an original: the file's bound is larger"
                        " by this"
                    ]
            reason = f"and are not those of {claim.path}"
        except TerrainwaveError as error:
            reason = f"and cannot be compared: {error}"
    return NO_LOSS, [
        f"the heights came with the attribute max_error, {claim.max_error:.6g}, {reason}: the"
        " file's bound is from the heights as they are now"
    ]


def _notes_on(source: RasterSource, loss: EarlierLoss, asked: Options) -> list[str]:
    if asked.max_error is None and not asked.is_embedded:
        within = f", within {loss.max_error:.6g} of an original" if loss.max_error else ""
        return [f"no --max-error given: the heights are those of {source.name}{within}"]
    if not loss.max_error:
        return []
    share = "is added to the file's bound" if asked.is_embedded else "is part of the file's bound"
    return [
        f"the heights of {source.name} are within {loss.max_error:.6g} of an original: this {share}"
    ]


def _has_same_heights(terrain: TerrainFile, source: RasterSource) -> bool:
    """Say whether all of an array is samples of a file, at the places that it says."""
    info, theirs = source.info, terrain.raster_info
    is_stored = (info.scale, info.offset) == (theirs.scale, theirs.offset)
    if not is_stored and (info.scale, info.offset) != (1.0, 0.0):
        return False
    steps = steps_on(info.transform, (info.n_rows, info.n_cols), theirs.transform)
    if steps is None:
        return False
    for region in source.blocks():
        heights, valid = source.read(*region)
        rows = _samples(steps.row, steps.row_step, region.row, region.n_rows)
        cols = _samples(steps.col, steps.col_step, region.col, region.n_cols)
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


def _samples(first: int, step: int, begin: int, n: int) -> NDArray[np.int64]:
    """Return the file's rows or columns that a window of the array is of."""
    return first + step * np.arange(begin, begin + n, dtype=np.int64)


def _are_within(samples: NDArray[np.int64], size: int) -> bool:
    return bool(samples.min() >= 0 and samples.max() < size)
