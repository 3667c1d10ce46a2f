"""Where a raster of the Earth shows water, told by its heights alone. No GPU.

Water is what is level at 0, and what lies below 0 where that hangs together with heights below
`DEEPEST_LAND`, under which there is no dry land.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.render.body import EARTH, UNKNOWN
from terrainwave.render.ramps import DEEPEST_LAND
from terrainwave.render.solid import level_within, read_metres

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile
    from terrainwave.render.frame import Frame

# What `Water.cells` holds: no water; water where heights are 0; water at and below 0.
LAND, LEVEL, DEEP = 0, 128, 255

_SIDE = 1025
_MOST_WAVES, _ROUNDED = 1.0, 0.02  # metres
# Coasts lie between samples: cells reach so many samples beyond what was found.
_RIM = 2


class Water(NamedTuple):
    """Where water is.

    Parameters
    ----------
    cells : ndarray of uint8, shape (n_rows, n_cols)
        `LAND`, `LEVEL` or `DEEP` around every `step`-th sample of the full grid.
    step : int
    """

    cells: NDArray[np.uint8]
    step: int

    def lowest(self, sea: float) -> float:
        """Return the lowest height that is water somewhere; infinite where none is."""
        if (self.cells == DEEP).any():
            return -math.inf
        return -sea if (self.cells == LEVEL).any() else math.inf


# Of a picture whose sea level was given, or that has no water.
EVERYWHERE = Water(np.array([[DEEP]], dtype=np.uint8), 1)
NOWHERE = Water(np.array([[LAND]], dtype=np.uint8), 1)


def waves_of(terrain: "TerrainFile", frame: "Frame") -> float:
    """Return the metres around 0 that are level water.

    What decodes to 0 within the bound is; a float32 on the way has rounded it.
    """
    error = terrain.effective_error * frame.metres[2]
    return min(error, _MOST_WAVES) + _ROUNDED


def may_have_water(terrain: "TerrainFile", frame: "Frame") -> bool:
    """Say whether `read_water` has anything to look for."""
    lowest = min(frame.heights) * frame.metres[2]
    return frame.body in (EARTH, UNKNOWN) and lowest <= waves_of(terrain, frame)


def read_water(terrain: "TerrainFile", frame: "Frame") -> Water:
    """Return where a terrain has water; reads one level of at most 1025 samples a side.

    Raises
    ------
    CorruptStreamError
        If the coarsest level is damaged.
    """
    if not may_have_water(terrain, frame):
        return NOWHERE
    level = level_within(terrain, _SIDE)
    heights, valid = read_metres(terrain, frame, None, level)
    step = 1 << (terrain.n_levels - 1 - level)
    return Water(find_water(heights, valid, waves_of(terrain, frame)), step)


def find_water(
    heights: NDArray[np.float64], valid: NDArray[np.bool_], waves: float
) -> NDArray[np.uint8]:
    """Return `Water.cells` of heights in metres, with a rim of two samples around all water.

    Level is a sample whose neighbours are all within `waves` of 0, too, or void.
    """
    is_level = valid & (np.abs(heights) <= waves)
    is_low = valid & (heights <= waves)
    has_depth = _spread(valid & (heights < DEEPEST_LAND), is_low)
    cells = np.full(heights.shape, LAND, dtype=np.uint8)
    cells[_grown(is_level & ~_grown(valid & ~is_level, 1), 1 + _RIM)] = LEVEL
    cells[_grown(has_depth, _RIM)] = DEEP
    return cells


def _grown(found: NDArray[np.bool_], n_times: int) -> NDArray[np.bool_]:
    """Return samples and, so many times, their eight neighbours."""
    for _ in range(n_times):
        wide = np.pad(found, 1)
        wide = wide[:-2] | wide[1:-1] | wide[2:]
        found = wide[:, :-2] | wide[:, 1:-1] | wide[:, 2:]
    return found


def _spread(found: NDArray[np.bool_], area: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the parts of an area, connected by sides, that have samples of `found`, in it."""
    while True:
        rows = _along_rows(found, area)
        both = _along_rows(rows.T, area.T).T
        if (both == found).all():
            return both
        found = both


def _along_rows(found: NDArray[np.bool_], area: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the runs of an area's samples in rows that have one of `found`."""
    n_rows, n_cols = area.shape
    # A column beside it: no run goes on in the next row.
    line = np.pad(area, ((0, 0), (0, 1))).ravel()
    is_first = line.copy()
    is_first[1:] &= ~line[:-1]
    runs = np.cumsum(is_first)
    is_found = np.zeros(runs[-1] + 1, dtype=np.bool_)
    is_found[runs[np.pad(found, ((0, 0), (0, 1))).ravel()]] = True
    return (is_found[runs] & line).reshape(n_rows, n_cols + 1)[:, :-1]
