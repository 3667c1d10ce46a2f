"""Which samples of a level a window, bounds or places in the world name."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import (
    InvalidArgumentError,
    InvalidHeightsError,
)
from terrainwave.grid.affine import Transform, determinant, places_to_samples
from terrainwave.grid.quadtree import Region


def region_of_window(window: Any) -> Region:
    """Return the region that (row, col, n_rows, n_cols) or a rasterio Window names, not clipped.

    Raises
    ------
    InvalidHeightsError
        If it is neither, or not in whole samples.
    """
    try:
        if hasattr(window, "row_off"):  # rasterio.windows.Window
            window = (window.row_off, window.col_off, window.height, window.width)
        row, col, n_rows, n_cols = (int(number) for number in window)
        is_whole = (row, col, n_rows, n_cols) == tuple(window)
    except (TypeError, ValueError, OverflowError):  # no numbers, not four, NaN, infinite
        is_whole = False
    if not is_whole:
        raise InvalidArgumentError(
            f"found `window` {window!r}, expected (row, col, n_rows, n_cols) in whole samples"
        )
    return Region(row, col, n_rows, n_cols)


def region_of_bounds(bounds: Sequence[float], transform: Transform) -> Region:
    """Return the samples whose pixels touch (left, bottom, right, top), not clipped.

    Raises
    ------
    InvalidHeightsError
        If the bounds are empty, or the transform cannot place them.
    """
    left, bottom, right, top = (float(value) for value in bounds)
    if not (left < right and bottom < top):
        raise InvalidArgumentError(
            f"found `bounds` {tuple(bounds)}, expected left < right and bottom < top"
        )
    corners = np.array([(x, y) for x in (left, right) for y in (bottom, top)])
    rows, cols = to_samples(corners, transform)
    if not (np.isfinite(rows).all() and np.isfinite(cols).all()):
        raise InvalidArgumentError(
            f"found `bounds` {tuple(bounds)}, expected finite ones that the affine transform"
            f" {tuple(transform)} can place; read by window instead"
        )
    # Samples are pixel centres: half a pixel away begins the next pixel. A thousandth of a
    # pixel forgives the rounding of coordinates that name pixel edges.
    first_row, last_row = _round_half_up(rows.min() + 0.001), _round_half_up(rows.max() - 0.001)
    first_col, last_col = _round_half_up(cols.min() + 0.001), _round_half_up(cols.max() - 0.001)
    return Region(first_row, first_col, last_row - first_row + 1, last_col - first_col + 1)


def to_samples(
    places: NDArray[np.float64], transform: Transform
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return fractional (rows, cols) of world coordinates; integers are pixel centres.

    Raises
    ------
    InvalidHeightsError
        If the transform has no inverse.
    """
    if determinant(transform) == 0:
        raise InvalidHeightsError("the affine transform cannot be inverted; read by window instead")
    # Extreme numbers of a file or a caller become NaN or infinite: no place in the raster.
    with np.errstate(all="ignore"):
        return places_to_samples(transform, places[:, 0], places[:, 1])


def _round_half_up(value: float) -> int:
    return int(np.floor(value + 0.5))
