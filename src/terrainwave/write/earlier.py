"""What heights had lost before: those of an array that came out of a .twz file.

Such an array says how far it may be from the original (``max_error``), and goes on saying so when
its heights have become others: xarray keeps attributes. So the bound counts only where the heights
are compared with those of the file, and are the same.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import TerrainwaveError
from terrainwave.file import TerrainFile
from terrainwave.grid.affine import strides_on
from terrainwave.grid.steps import FixedSteps
from terrainwave.raster_io.source import RasterSource


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
    """

    error: float = 0.0
    is_still: bool = False
    note: str = ""

    def beyond(self, own: float) -> tuple[float, list[str]]:
        """Return what a file's bound is larger by than `own`, that from the heights; and notes."""
        if not self.error:
            return 0.0, [self.note] * bool(self.note)
        more = max(self.error - own, 0.0) if self.is_still else self.error
        size = "this" if more == self.error else f"{more:.6g}"
        end = f"the file's bound is larger by {size}" if more else "the file's bound holds for it"
        return more, [f"{self.note}: {end}"]


NOTHING = Earlier()


def earlier_error(source: RasterSource, steps: FixedSteps | None) -> Earlier:
    """Return how far heights may be from an original already.

    Reads the heights once more, and the file, where something is claimed; else nothing. `steps` are
    those that heights will be rounded to.
    """
    claim = source.claim
    if claim is None:
        return NOTHING
    reason = "and no .twz file to compare them with"
    if claim.path is not None:
        try:
            with TerrainFile(claim.path) as terrain:
                if _has_same_heights(terrain, source):
                    is_still = steps is not None and _is_on(source, steps)
                    return Earlier(
                        terrain.effective_error,
                        is_still,
                        f"the heights are those of {claim.path}, within"
                        f" {terrain.effective_error:.6g} of an original"
                        + ", and do not move"
                        * is_still,
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
