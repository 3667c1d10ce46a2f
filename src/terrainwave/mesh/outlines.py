"""Heights with simpler outlines of voids, for meshes of fewer triangles than the outlines have.

A level's samples are valid wherever a valid original touches their cells, so coarse levels cover
every original, and also small voids. Areas that a coarse level covers are covered on the finer ones
too: a void sample there gets the mean of the samples around it one level coarser, level by level,
so that filled heights join the real ones. Below level 0 more levels are made, down to two by two
samples. Filled heights represent no original; a mesh covers voids there.
"""

import threading
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.refiner import Heights, Mask
from terrainwave.grid.quadtree import Grid, Region
from terrainwave.read.decoder import TreeDecoder

# Rows and columns to process at a time, and of the coarsest level that is made.
_WINDOW, _SMALLEST = 512, 2


class _Samples(NamedTuple):
    heights: Heights
    mask: Mask


class CoveredSamples:
    """Windows of a file's levels, with voids covered if a coarse level has no void.

    `outline` is the level whose outlines are kept; below 0 for levels coarser than the file has.
    Windows of this level and coarser ones are not changed.
    """

    def __init__(self, grid: Grid, decoder: TreeDecoder, outline: int) -> None:
        self._grid = grid
        self._decoder = decoder
        self.outline = outline
        self._lock = threading.Lock()
        self._first: _Samples | None = None

    def window(self, level: int, region: Region) -> tuple[Heights, Mask]:
        if self.outline < 0 and level == 0:
            whole = self._first_level()
            at = region.slices_in(Region(0, 0, *self._grid.level_shape(0)))
            return whole.heights[at], whole.mask[at]
        heights, mask = self._decoder.window(level, region)
        if level <= self.outline or mask.all():
            return heights, mask
        row, col = region.row >> 1, region.col >> 1
        n_rows, n_cols = self._grid.level_shape(level - 1)
        above = Region(
            row,
            col,
            min((region.row + region.n_rows) >> 1, n_rows - 1) - row + 1,
            min((region.col + region.n_cols) >> 1, n_cols - 1) - col + 1,
        )
        coarse = _Samples(*self.window(level - 1, above))
        return _covered(_Samples(heights, mask), coarse, region.row & 1, region.col & 1)

    def _first_level(self) -> _Samples:
        with self._lock:
            if self._first is None:
                region = Region(0, 0, *self._grid.level_shape(0))
                levels = [_Samples(*self._decoder.window(0, region))]
                for _ in range(-self.outline):
                    levels.append(_halved(levels[-1]))
                covered = levels.pop()
                while levels:
                    covered = _covered(levels.pop(), covered, 0, 0)
                self._first = covered
        return self._first


def finest_outline(
    grid: Grid, decoder: TreeDecoder, level: int, region: Region, n_most: int
) -> int:
    """Return the finest level whose outlines of voids have at most `n_most` edges in a region.

    An edge is a pair of a void and a valid neighbour. The region is in samples of `level`, the
    finest candidate. Below 0 for a level coarser than the file's; see `CoveredSamples`.
    """

    def n_edges(k: int) -> int:
        return sum(
            _n_edges(decoder.window(k, window)[1]) for window in _tiles(_coarser(region, level - k))
        )

    if n_edges(0) > n_most:
        samples, k = _Samples(*decoder.window(0, Region(0, 0, *grid.level_shape(0)))), 0
        while _n_edges(_cut(samples.mask, _coarser(region, level - k))) > n_most:
            if max(samples.mask.shape) <= _SMALLEST:
                break
            samples, k = _halved(samples), k - 1
        return k
    k = 0
    while k < level and n_edges(k + 1) <= n_most:
        k += 1
    return k


def _coarser(region: Region, shift: int) -> Region:
    """Return the samples of a level `shift` coarser that lie in a region, and those before them."""
    row, col = region.row >> shift, region.col >> shift
    last_row, last_col = region.row + region.n_rows - 1, region.col + region.n_cols - 1
    return Region(row, col, (last_row >> shift) - row + 1, (last_col >> shift) - col + 1)


def _tiles(region: Region) -> Iterator[Region]:
    """Yield windows that share their borders."""
    for tile in region.tiles(_WINDOW, _WINDOW):
        yield Region(tile.row, tile.col, tile.n_rows + 1, tile.n_cols + 1).intersect(region)


def _cut(mask: Mask, region: Region) -> Mask:
    return mask[region.slices_in(Region(0, 0, *mask.shape))]


def _n_edges(mask: Mask) -> int:
    """Return the number of neighbouring pairs with one void."""
    across, down = mask[:, 1:] != mask[:, :-1], mask[1:] != mask[:-1]
    return int(np.count_nonzero(across)) + int(np.count_nonzero(down))


def _covered(own: _Samples, coarse: _Samples, row: int, col: int) -> _Samples:
    """Return a level's samples; voids get the means of valid coarser ones.

    `row` and `col` are 1 if the first sample lies between two of the coarser level.
    """
    rows = np.arange(row, row + own.mask.shape[0])
    cols = np.arange(col, col + own.mask.shape[1])
    last_row, last_col = (n - 1 for n in coarse.mask.shape)
    above, below = rows >> 1, np.minimum((rows + 1) >> 1, last_row)
    left, right = cols >> 1, np.minimum((cols + 1) >> 1, last_col)

    def corners(values: NDArray[np.int64]) -> NDArray[np.int64]:
        beside = values[:, left] + values[:, right]
        total: NDArray[np.int64] = beside[above] + beside[below]
        return total

    mask = own.mask | (corners(coarse.mask.astype(np.int64)) == 4)
    means = (corners(coarse.heights.astype(np.int64)) >> 2).astype(np.int32)
    return _Samples(np.where(own.mask, own.heights, means), mask)


def _halved(samples: _Samples) -> _Samples:
    """Return every other sample; voids get the mean of the valid ones that touch them."""
    shape = tuple(n + 2 + (n & 1 ^ 1) for n in samples.mask.shape)
    heights, mask = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    inner = slice(1, samples.mask.shape[0] + 1), slice(1, samples.mask.shape[1] + 1)
    heights[inner], mask[inner] = np.where(samples.mask, samples.heights, 0), samples.mask

    def around(values: NDArray[np.int64]) -> NDArray[np.int64]:
        beside = values[:, :-2:2] + values[:, 1:-1:2] + values[:, 2::2]
        total: NDArray[np.int64] = beside[:-2:2] + beside[1:-1:2] + beside[2::2]
        return total

    count = around(mask)
    means = around(heights) // np.maximum(count, 1)
    own = samples.heights[::2, ::2], samples.mask[::2, ::2]
    kept = np.where(own[1], own[0], means[: own[0].shape[0], : own[0].shape[1]])
    return _Samples(kept.astype(np.int32), (count > 0)[: own[0].shape[0], : own[0].shape[1]])
