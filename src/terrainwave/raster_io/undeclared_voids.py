"""Values that look like voids but are not declared."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from terrainwave.arguments import count_of
from terrainwave.errors import InvalidHeightsError
from terrainwave.raster_io.raster_info import stored_nodata
from terrainwave.raster_io.source import RasterSource

# Values that programs write for unknown heights: limits of integer types, and rows of nines.
_MARKS = (
    -9999, -32768, -32767, -99999, -999999, -2147483648, -2147483647,
    9999, 32767, 65535, 99999, 999999, 2147483647,
)  # fmt: skip
# Programs number several kinds of unknown heights consecutively: ISIS writes -32768 to -32764.
_NEAR = 4
# Not a height on any body in any unit: ±3.4e38 of float32, 1e30, netCDF's 9.97e36, ±1.8e308.
_BEYOND = 1e30


class _Found(NamedTuple):
    """Samples of one value: their number, and the position of the first."""

    value: Any
    n_samples: int
    row: int
    col: int

    def __str__(self) -> str:
        are = "is" if self.n_samples == 1 else "are"
        return (
            f"{count_of(self.n_samples, 'height')} {are} {self.value!s}, the first at row"
            f" {self.row}, column {self.col}"
        )


class _Survey(NamedTuple):
    """Values near a mark, and the ranges of all other heights, with and without 0."""

    found: list[_Found]
    ranges: list[tuple[float, float]]

    def stands_apart(self, value: float) -> bool:
        """Return True if all other heights are closer to one another than to the value."""
        return any(
            low <= high and min(abs(value - low), abs(value - high)) > high - low
            for low, high in self.ranges
        )


def note_on_marks(source: RasterSource, minimum: float, maximum: float) -> list[str]:
    """Return a sentence for each value that looks like an undeclared void.

    Reads the raster again only if an extreme, as stored, is close to a common marker of voids.
    """
    ends = dict.fromkeys((minimum, maximum))
    for end in ends:
        if np.isfinite(end) and abs(end) >= _BEYOND:
            number = np.dtype(source.info.dtype).type(end)
            found = _survey(source, partial(np.equal, number)).found[0]
            raise InvalidHeightsError(
                f"{found}, which is no height: if this marks voids, declare the nodata value"
                f" {found.value!s}"
            )
    if minimum >= maximum or not any(_is_near_mark(np.float64(end)) for end in ends):
        return []
    survey = _survey(source, _is_near_mark)
    apart = [found for found in survey.found if survey.stands_apart(float(found.value))]
    # Values next to a mark are suspect only together with it.
    if not any(found.value in _MARKS for found in apart):
        return []
    return [
        f"{found}, far from all others: if this marks voids, declare the nodata value"
        f" {found.value!s}"
        for found in apart
    ]


def note_on_undeclared(
    source: RasterSource, minimum: float = -np.inf, maximum: float = np.inf
) -> list[str]:
    """Return a sentence that counts heights that would be voids without `nodata`.

    Reads the raster again only if such a value can lie between the extremes, as stored.
    """
    dtype = np.dtype(source.info.dtype)
    values = source.undeclared_values
    # Compared as stored: heights of float32 with the value's float32.
    if not any(minimum <= float(stored_nodata(value, dtype)) <= maximum for value in values):
        return []
    count = 0
    for region in source.blocks():
        found = source.undeclared(region)
        count += 0 if found is None else int(np.count_nonzero(found))
    if not count:
        return []
    are = "sample is a height" if count == 1 else "samples are heights"
    shown = ", ".join(f"{value:g}" for value in values)
    return [
        f"{source.name}: {count:,} {are}, although the source declares {shown} as nodata, which"
        " `nodata` overrides"
    ]


def _is_near_mark(heights: Any) -> Any:
    near = np.zeros(np.shape(heights), dtype=np.bool_)
    for mark in _MARKS:
        near |= (heights >= mark - _NEAR) & (heights <= mark + _NEAR)
    return near


def _survey(source: RasterSource, is_suspect: Any) -> _Survey:
    found: dict[Any, _Found] = {}
    ranges = {True: (np.inf, -np.inf), False: (np.inf, -np.inf)}
    for region, even in source.parts():
        if even is not None and not even.is_valid:
            continue
        heights, valid = source.read(*region)
        suspect = valid & is_suspect(heights)
        for has_zero in ranges:
            rest = heights[valid & ~suspect & (has_zero | (heights != 0))]
            if rest.size:
                low, high = ranges[has_zero]
                ranges[has_zero] = min(low, float(rest.min())), max(high, float(rest.max()))
        if not suspect.any():
            continue
        places = np.flatnonzero(suspect)
        values, first, counts = np.unique(
            heights.ravel()[places], return_index=True, return_counts=True
        )
        for value, at, count in zip(values, places[first].tolist(), counts.tolist(), strict=True):
            row, col = divmod(at, region.n_cols)
            there = region.row + row, region.col + col
            known = found.get(value, _Found(value, 0, *there))
            there = min(there, known[2:])
            found[value] = _Found(value, known.n_samples + count, *there)
    return _Survey([found[value] for value in sorted(found)], list(ranges.values()))
