"""Conversion of windows, bounds and world coordinates to samples of a level."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import checked_numbers, shown
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError
from terrainwave.grid.affine import EVEN, Transform, determinant, places_to_samples
from terrainwave.grid.quadtree import Region

# Samples: allowed deviation of rounded coordinates from pixel edges.
_FORGIVEN = 0.001


class LevelPlace(NamedTuple):
    """Shape and position of a level; `own` are the raster's bounds."""

    level: int
    shape: tuple[int, int]
    transform: Transform
    own: tuple[float, float, float, float]

    def window(self, window: Any, bounds: Sequence[float] | None) -> "LevelWindow":
        """Return the part that a window or bounds name, checked; all by default."""
        whole = Region(0, 0, *self.shape)
        if bounds is None:
            asked = whole if window is None else region_of_window(window, self.shape)
        elif window is not None:
            raise InvalidArgumentError("found both `window` and `bounds`, expected one of them")
        else:
            asked = region_of_bounds(bounds, self.transform)
        region = asked.intersect(whole)
        if region.n_rows > 0 and region.n_cols > 0:
            return LevelWindow(self, region, asked, bounds)
        if min(asked.n_rows, asked.n_cols) < 1 and bounds is None:
            raise InvalidArgumentError(
                f"found a `window` of {asked.n_rows} x {asked.n_cols} samples, expected at least 1"
                " x 1"
            )
        if bounds is not None:
            raise InvalidArgumentError(
                f"the `bounds` {_in_words(bounds)} lie outside the raster's, {_in_words(self.own)}"
                " (left, bottom, right, top)"
            )
        raise InvalidArgumentError(
            f"the `window` (row {asked.row}, column {asked.col}, {asked.n_rows} x {asked.n_cols})"
            f" lies outside the level, which has {self.shape[0]} x {self.shape[1]} samples"
        )


class LevelWindow(NamedTuple):
    """Checked part of a level: inside the level, and not empty.

    Only `LevelPlace.window` makes it, so it need not be checked again. `asked` is the part before
    clipping, given by `bounds` or not.
    """

    place: LevelPlace
    region: Region
    asked: Region
    bounds: Sequence[float] | None

    @property
    def level(self) -> int:
        return self.place.level

    def note_on_cut(self, pixel: tuple[float, float]) -> str | None:
        """Return a note if the part was clipped, else None.

        `pixel` is the size of the finest pixels: a cut that rounding of coordinates explains is not
        noted.
        """
        region, shape = self.region, self.place.shape
        left = (
            f"what lies inside it is taken, {region.n_rows} x {region.n_cols} samples from row"
            f" {region.row}, column {region.col} on"
        )
        if self.bounds is not None:
            beyond = np.subtract(self.place.own, self.bounds) * (1, 1, -1, -1)
            if (beyond <= EVEN * min(pixel)).all():
                return None
            return f"the `bounds` reach beyond the raster's, {_in_words(self.place.own)}: {left}"
        if self.asked == region:
            return None
        return f"the `window` reaches beyond the level's {shape[0]} x {shape[1]} samples: {left}"


def region_of_window(window: Any, shape: tuple[int, int]) -> Region:
    """Return the region of a window of a level of `shape`, not clipped.

    A window is (row, col, n_rows, n_cols), a rasterio Window, or a slice of rows and one of
    columns. Slices count as in Python: from the end if negative, at most to the end.

    A `Region` is already checked.
    """
    if isinstance(window, Region):
        return window
    if hasattr(window, "row_off"):  # rasterio.windows.Window
        return _of_rasterio(window)
    try:
        if any(isinstance(part, slice) for part in window):
            rows, cols = (_of_slice(part, size) for part, size in zip(window, shape, strict=True))
            return Region(rows.start, cols.start, len(rows), len(cols))
        return Region(*checked_numbers("window", window, "row, col, n_rows, n_cols", is_whole=True))
    except (TypeError, ValueError):  # no iterable of four whole numbers
        raise InvalidArgumentError(
            f"found `window` {shown(window)}, expected (row, col, n_rows, n_cols) in whole samples,"
            " a rasterio Window, or two slices without a step: rows, columns"
        ) from None


def _of_rasterio(window: Any) -> Region:
    """Return a Window's samples; rounding of `rasterio.windows.from_bounds` is ignored."""
    given = (window.row_off, window.col_off, window.height, window.width)
    if not all(
        math.isfinite(number) and abs(number - round(number)) <= _FORGIVEN for number in given
    ):
        raise InvalidArgumentError(
            f"found `window` {window!r}, expected whole samples: window.round_offsets()"
            ".round_lengths() makes some, or read by bounds"
        )
    return Region(*map(round, given))


def _of_slice(part: slice, size: int) -> range:
    chosen = range(size)[part]
    if not isinstance(chosen, range) or chosen.step != 1:
        raise ValueError("no slice, or one with a step")
    return chosen


def region_of_bounds(bounds: Sequence[float], transform: Transform) -> Region:
    """Return the samples whose pixels touch (left, bottom, right, top), not clipped."""
    left, bottom, right, top = checked_numbers("bounds", bounds, "left, bottom, right, top")
    if not (left < right and bottom < top):
        raise InvalidArgumentError(
            f"found `bounds` {shown(tuple(bounds))}, expected left < right and bottom < top"
        )
    corners = np.array([(x, y) for x in (left, right) for y in (bottom, top)])
    rows, cols = to_samples(corners, transform)
    if not (np.isfinite(rows).all() and np.isfinite(cols).all()):
        raise InvalidArgumentError(
            f"found `bounds` {tuple(bounds)}, expected finite ones that the affine transform"
            f" {tuple(transform)} can place; read by window instead"
        )
    # Samples are pixel centres: the next pixel begins half a pixel away.
    first_row, first_col = (_round_half_up(ends.min() + _FORGIVEN) for ends in (rows, cols))
    last_row, last_col = (_round_half_up(ends.max() - _FORGIVEN) for ends in (rows, cols))
    return Region(first_row, first_col, last_row - first_row + 1, last_col - first_col + 1)


def to_samples(
    places: NDArray[np.float64], transform: Transform
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return fractional (rows, cols) of world coordinates; integers are pixel centres."""
    if determinant(transform) == 0:
        raise InvalidHeightsError("the affine transform cannot be inverted; read by window instead")
    # Extreme numbers of a file or a caller become NaN or infinite: outside the raster.
    with np.errstate(all="ignore"):
        return places_to_samples(transform, places[:, 0], places[:, 1])


def _round_half_up(value: float) -> int:
    return int(np.floor(value + 0.5))


def places_of(points: Any) -> NDArray[np.float64]:
    """Return points as an array of shape (n_points, 2)."""
    try:
        listed = points if isinstance(points, np.ndarray) else list(points)
        given = np.asarray(listed)
        places = given.astype(np.float64) if given.dtype.kind in "iuf" else None
    except (TypeError, ValueError):  # not iterable, or pairs of several lengths
        places = None
    if places is not None and places.size == 0:
        return np.empty((0, 2))
    if places is not None and places.shape == (2,):  # a single point
        return places[None]
    if places is None or places.ndim != 2 or places.shape[1] != 2:
        raise InvalidArgumentError(
            f"found `points` {shown(points)}, expected pairs of numbers (x, y)"
        )
    return places


def _in_words(box: Sequence[float]) -> str:
    return ", ".join(f"{float(value):.10g}" for value in box)
