"""Values that look like voids and are not declared: what a scan's extremes may be."""

from typing import NamedTuple

import numpy as np

from terrainwave.arguments import count_of
from terrainwave.errors import InvalidHeightsError
from terrainwave.raster_io.source import RasterSource

# What programs write where they know nothing: ends of integer types, and rows of nines.
_MARKS = (-9999, -32768, -32767, -99999, -999999, 9999, 32767, 65535, 99999)
# No height, on any body in any unit: ±3.4e38 of float32, 1e30, netCDF's 9.97e36, ±1.8e308.
_BEYOND = 1e30


class _Mark(NamedTuple):
    """Where a value is, and what lies next to it."""

    value: np.generic
    n_samples: int
    row: int
    col: int
    others: tuple[float, float]

    @property
    def stands_apart(self) -> bool:
        """Say whether all other heights are closer to one another than to the value."""
        low, high = self.others
        return (
            low <= high
            and min(abs(float(self.value) - low), abs(float(self.value) - high)) > high - low
        )

    def __str__(self) -> str:
        are = "is" if self.n_samples == 1 else "are"
        return (
            f"{count_of(self.n_samples, 'height')} {are} {self.value!s}, the first at row"
            f" {self.row}, column {self.col}"
        )


def note_on_marks(source: RasterSource, minimum: float, maximum: float) -> list[str]:
    """Return a sentence for each end of the heights that looks like an undeclared void.

    Reads the raster again where an end is a number that programs write for voids, else nothing.

    Parameters
    ----------
    minimum, maximum : float
        Of all valid heights, as stored.

    Raises
    ------
    InvalidHeightsError
        If an end is far beyond any height.
    """
    notes = []
    for end in dict.fromkeys((minimum, maximum)):
        if np.isfinite(end) and abs(end) >= _BEYOND:
            mark = _find(source, end)
            raise InvalidHeightsError(
                f"{mark}, which is no height: if this marks voids, declare the nodata value"
                f" {mark.value!s}"
            )
        if end in _MARKS and minimum < maximum:
            mark = _find(source, end)
            if mark.stands_apart:
                notes.append(
                    f"{mark}, far from all others: if this marks voids, declare the nodata value"
                    f" {mark.value!s}"
                )
    return notes


def _find(source: RasterSource, value: float) -> _Mark:
    number = np.dtype(source.info.dtype).type(value)
    n_samples, row, col, low, high = 0, 0, 0, np.inf, -np.inf
    for region, even in source.parts():
        if even is not None and not even.is_valid:
            continue
        heights, valid = source.read(*region)
        found = valid & (heights == number)
        rest = heights[valid & ~found]
        if rest.size:
            low, high = min(low, float(rest.min())), max(high, float(rest.max()))
        if not found.any():
            continue
        there_row, there_col = divmod(int(np.argmax(found)), region.n_cols)
        there = (region.row + there_row, region.col + there_col)
        row, col = there if not n_samples else min((row, col), there)
        n_samples += int(np.count_nonzero(found))
    return _Mark(
        number.item() if number.dtype.kind != "f" else number, n_samples, row, col, (low, high)
    )
