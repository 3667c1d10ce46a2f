"""Representative windows of the full grid, chosen only by position (encoder only)."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Grid, Region

Heights: TypeAlias = NDArray[np.int32]
Mask: TypeAlias = NDArray[np.bool_]
# Returns targets, int32 quanta, and validity of a region of a level.
HeightsOf: TypeAlias = Callable[[int, Region], Heights]
MaskOf: TypeAlias = Callable[[int, Region], Mask]

# Candidates per window, to find windows that are not mostly void.
_PLACES_PER_WINDOW = 4


def spread_windows(
    grid: Grid, heights: HeightsOf, mask: MaskOf, side: int, n_windows: int
) -> tuple[Heights, Mask]:
    """Return windows of the full grid, spread evenly: heights and validity.

    Shapes (n, n_rows, n_cols), up to `side` samples per side; fewer than `n_windows` if more would
    coincide. Mostly void windows are left out if there are others.
    """
    places = _places(grid, side, n_windows)
    n_wanted = max(1, len(places) // _PLACES_PER_WINDOW)
    found: list[tuple[Region, Mask]] = []
    mostly_void: list[tuple[Region, Mask]] = []
    for region in places:
        valid = np.ascontiguousarray(mask(grid.k_max, region), dtype=np.bool_)
        is_full = 2 * int(np.count_nonzero(valid)) >= valid.size
        (found if is_full else mostly_void).append((region, valid))
        if len(found) == n_wanted:
            break
    kept = (found + mostly_void)[:n_wanted]
    targets = [np.asarray(heights(grid.k_max, region), dtype=np.int32) for region, _ in kept]
    return np.stack(targets), np.stack([valid for _, valid in kept])


def _places(grid: Grid, side: int, n_windows: int) -> list[Region]:
    """Return `_PLACES_PER_WINDOW` candidates for each window, the likeliest first."""
    n = _PLACES_PER_WINDOW * n_windows
    shape = min(side, grid.n_rows), min(side, grid.n_cols)
    rows, cols = grid.n_rows - shape[0], grid.n_cols - shape[1]
    found = []
    for turn in (2, 0, 3, 1):
        for i in range(turn, n, _PLACES_PER_WINDOW):
            # Evenly down the rows; across by the golden section, of 2**16.
            across = (2 * i + 1) * 20251 & 0xFFFF
            found.append(Region(rows * (2 * i + 1) // (2 * n), cols * across >> 16, *shape))
    return list(dict.fromkeys(found))
