"""Water in a raster of the Earth, derived only from its heights.

Water is level ground at 0, and ground below 0 that is connected to heights below `DEEPEST_LAND`,
under which there is no dry land.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.file import TerrainFile
from terrainwave.place.bodies import EARTH, UNKNOWN
from terrainwave.render.look.ramps import DEEPEST_LAND
from terrainwave.render.scene.frame import Frame
from terrainwave.render.scene.walls import level_within, read_metres
from terrainwave.tri.quads import grown

# Values of `Water.cells`: no water; water where heights are 0; water at and below 0.
LAND, LEVEL, DEEP = 0, 128, 255

_SIDE = 1025
_MOST_WAVES, _ROUNDED = 1.0, 0.02  # metres
# Share of the sides of an area level at 0 with lower ground next to them. Above it, as where land
# slopes through 0, the area is water only if it is this number of samples wide (the sea before
# polders).
_MOST_LOWER, _LEAST_WIDTH = 0.25, 32
# Coasts lie between samples: cells extend this number of samples beyond the water found.
_RIM = 2


class Water(NamedTuple):
    """Water mask."""

    # shape (n_rows, n_cols); `LAND`, `LEVEL` or `DEEP` around every `stride`-th sample of the full
    # grid
    cells: NDArray[np.uint8]
    stride: int

    def lowest(self, sea: float) -> float:
        """Return the lowest height that is water somewhere; infinite if none is."""
        if (self.cells == DEEP).any():
            return -math.inf
        return -sea if (self.cells == LEVEL).any() else math.inf


# For a picture with a given sea level, or without water.
EVERYWHERE = Water(np.array([[DEEP]], dtype=np.uint8), 1)
NOWHERE = Water(np.array([[LAND]], dtype=np.uint8), 1)


def waves_of(terrain: TerrainFile, frame: Frame) -> float:
    """Return the metres around 0 that are level water.

    These are heights that decode to 0 within the bound, and float32 rounding.
    """
    error = terrain.effective_error * frame.error_metres
    return min(error, _MOST_WAVES) + _ROUNDED


def may_have_water(terrain: TerrainFile, frame: Frame) -> bool:
    lowest = float(frame.box[0][2]) / frame.exaggeration
    return frame.body in (EARTH, UNKNOWN) and lowest <= waves_of(terrain, frame)


def read_water(terrain: TerrainFile, frame: Frame) -> Water:
    """Return the water of a terrain; reads one level of at most 1025 samples a side."""
    if not may_have_water(terrain, frame):
        return NOWHERE
    level = level_within(terrain, _SIDE)
    heights, valid = read_metres(terrain, frame, None, level)
    stride = 1 << (terrain.n_levels - 1 - level)
    return Water(find_water(heights, valid, waves_of(terrain, frame)), stride)


def find_water(
    heights: NDArray[np.float64], valid: NDArray[np.bool_], waves: float
) -> NDArray[np.uint8]:
    """Return `Water.cells` of heights in metres, with a rim of two samples around all water.

    A sample is level if it lies in a 3 x 3 square with all heights within `waves` of 0 or void.
    Land that slopes through 0 has such samples, too: an area of them is land if it is narrow and
    has much lower ground next to it.
    """
    is_level = valid & (np.abs(heights) <= waves)
    is_low = valid & (heights <= waves)
    labels = _labels(is_low)
    has_depth = _chosen(labels, np.bincount(labels[valid & (heights < DEEPEST_LAND)]) > 0)
    area = is_level & grown(is_level & ~grown(valid & ~is_level, 1), 1)
    labels = _labels(area)
    n_samples = np.bincount(labels.ravel())
    n_beside = _beside(labels, valid & ~is_level)
    n_lower = _beside(labels, is_low & ~is_level)
    is_sea = (n_lower <= _MOST_LOWER * n_beside) | (n_samples >= _LEAST_WIDTH * n_lower)
    cells = np.full(heights.shape, LAND, dtype=np.uint8)
    cells[grown(_chosen(labels, is_sea), _RIM)] = LEVEL
    cells[grown(has_depth, _RIM)] = DEEP
    return cells


def _chosen(labels: NDArray[np.int64], is_chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    table = np.zeros(labels.size + 1, dtype=np.bool_)
    table[1 : len(is_chosen)] = is_chosen[1:]
    found: NDArray[np.bool_] = table[labels]
    return found


def _beside(labels: NDArray[np.int64], found: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of sides that areas share with samples of `found`, by label."""
    sides = [
        (labels[:-1], found[1:]), (labels[1:], found[:-1]),
        (labels[:, :-1], found[:, 1:]), (labels[:, 1:], found[:, :-1]),
    ]  # fmt: skip
    n_labels = int(labels.max(initial=0)) + 1
    counts = [np.bincount(inside[is_found], minlength=n_labels) for inside, is_found in sides]
    total: NDArray[np.int64] = np.sum(counts, axis=0)
    return total


def _labels(area: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return equal numbers > 0 for samples of an area connected by sides, 0 outside."""
    labels = np.where(area, np.arange(1, area.size + 1).reshape(area.shape), 0)
    rows, columns = _Runs(area), _Runs(area.T)
    while True:
        joined = columns.least(rows.least(labels).T).T
        if (joined == labels).all():
            return joined
        labels = joined


class _Runs:
    """The runs of an area's samples in its rows."""

    def __init__(self, area: NDArray[np.bool_]) -> None:
        self._area = area
        # One more column, so that no run continues in the next row.
        line = np.pad(area, ((0, 0), (0, 1))).ravel()
        is_first = line.copy()
        is_first[1:] &= ~line[:-1]
        self._runs = np.cumsum(is_first).reshape(len(area), -1)[:, :-1][area] - 1
        self._starts = np.flatnonzero(np.diff(self._runs, prepend=-1))

    def least(self, values: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the least value of each run, in all of its samples; 0 outside."""
        out = np.zeros(values.shape, dtype=np.int64)
        if len(self._starts):
            out[self._area] = np.minimum.reduceat(values[self._area], self._starts)[self._runs]
        return out
