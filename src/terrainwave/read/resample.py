"""Resample windows to a given shape, reading only as much of the file as needed."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import LimitExceededError
from terrainwave.grid.quadtree import Grid, Region

RESAMPLING = ("nearest", "bilinear", "average")

# Samples in memory while averaging: 32 MiB of float64, several times over.
_BAND_SAMPLES = 4 << 20

# Heights, and voids or None.
_Heights = tuple[NDArray[Any], NDArray[np.bool_] | None]
# Returns a region of the level `shift` steps coarser than the requested one.
ReadLevel = Callable[[int, Region], _Heights]


def resample(
    read: ReadLevel,
    region: Region,
    out_shape: tuple[int, int],
    method: str,
    level: int,
    grid: Grid,
    max_bytes: int,
) -> _Heights:
    """Return heights of `region` of `level`, resampled to `out_shape`, and the voids.

    Output pixel i covers the samples from ``i * scale`` to ``(i + 1) * scale``, as in rasterio.
    ``nearest`` and ``bilinear`` take samples of the coarsest level that is not coarser than the
    output; ``average`` is the mean of the valid samples that each output pixel covers.
    """
    n_rows, n_cols = out_shape
    if method == "average":
        return _average(read, region, (n_rows, n_cols), max_bytes)
    row_scale, col_scale = region.n_rows / n_rows, region.n_cols / n_cols
    shift = min(max(int(math.log2(max(min(row_scale, col_scale), 1.0))), 0), level)
    rows = (region.row + (np.arange(n_rows) + 0.5) * row_scale - 0.5) / (1 << shift)
    cols = (region.col + (np.arange(n_cols) + 0.5) * col_scale - 0.5) / (1 << shift)
    shape = grid.level_shape(level - shift)
    if method == "nearest":
        return _nearest(read, shift, rows, cols, shape)
    return _bilinear(read, shift, rows, cols, shape)


def _window(rows: NDArray[np.int64], cols: NDArray[np.int64]) -> Region:
    return Region(
        int(rows.min()),
        int(cols.min()),
        int(rows.max() - rows.min()) + 1,
        int(cols.max() - cols.min()) + 1,
    )


def _nearest(
    read: ReadLevel,
    shift: int,
    rows: NDArray[np.float64],
    cols: NDArray[np.float64],
    shape: tuple[int, int],
) -> _Heights:
    at_rows = np.clip(np.floor(rows + 0.5), 0, shape[0] - 1).astype(np.int64)
    at_cols = np.clip(np.floor(cols + 0.5), 0, shape[1] - 1).astype(np.int64)
    window = _window(at_rows, at_cols)
    heights, void = read(shift, window)
    at = np.ix_(at_rows - window.row, at_cols - window.col)
    return heights[at], None if void is None else void[at]


def _bilinear(
    read: ReadLevel,
    shift: int,
    rows: NDArray[np.float64],
    cols: NDArray[np.float64],
    shape: tuple[int, int],
) -> _Heights:
    rows, cols = np.clip(rows, 0, shape[0] - 1), np.clip(cols, 0, shape[1] - 1)
    top, left = np.floor(rows).astype(np.int64), np.floor(cols).astype(np.int64)
    below, right = np.minimum(top + 1, shape[0] - 1), np.minimum(left + 1, shape[1] - 1)
    window = _window(np.concatenate([top, below]), np.concatenate([left, right]))
    heights, void = read(shift, window)
    valid = np.ones(heights.shape, dtype=np.bool_) if void is None else ~void
    total, weights = bilinear_sums(heights, valid, rows - window.row, cols - window.col)
    return _weighted(total, weights, heights.dtype)


def bilinear_sums(
    heights: NDArray[Any],
    valid: NDArray[np.bool_],
    rows: NDArray[np.float64],
    cols: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the weighted sums of the valid ones of four neighbours, and the sums of weights.

    For all pairs of `rows` and `cols`, which lie between the first and the last sample.
    """
    top, left = rows.astype(np.int64), cols.astype(np.int64)
    below = np.minimum(top + 1, heights.shape[0] - 1)
    right = np.minimum(left + 1, heights.shape[1] - 1)
    down, across = (rows - top)[:, None], (cols - left)[None, :]
    known = np.where(valid, heights, 0)
    total, weights = np.zeros((rows.size, cols.size)), np.zeros((rows.size, cols.size))
    for at_rows, row_weight in ((top, 1 - down), (below, down)):
        for at_cols, col_weight in ((left, 1 - across), (right, across)):
            at = np.ix_(at_rows, at_cols)
            weight = row_weight * col_weight * valid[at]
            total += weight * known[at]
            weights += weight
    return total, weights


def _average(
    read: ReadLevel, region: Region, out_shape: tuple[int, int], max_bytes: int
) -> _Heights:
    """Average in bands of input rows, so that the window is never held whole."""
    n_rows, n_cols = out_shape
    row_edges = np.linspace(0, region.n_rows, n_rows + 1)
    col_edges = np.linspace(0, region.n_cols, n_cols + 1)
    if region.n_cols * 8 > max_bytes:
        raise LimitExceededError(
            f"one row of {region.n_cols:,} samples is more than max_bytes = {max_bytes:,}"
        )
    rows_per_band = max(1, _BAND_SAMPLES // max(region.n_cols, n_cols))
    total, weights = np.zeros(out_shape), np.zeros(out_shape)
    for start in range(0, region.n_rows, rows_per_band):
        stop = min(start + rows_per_band, region.n_rows)
        heights, void = read(0, Region(region.row + start, region.col, stop - start, region.n_cols))
        # The output rows that touch the band, each with its part of the band.
        first = int(np.searchsorted(row_edges, start, side="right")) - 1
        last = int(np.searchsorted(row_edges, stop, side="left"))
        edges = np.clip(row_edges[first : last + 1], start, stop) - start
        valid = np.ones(heights.shape)
        if void is not None:
            heights[void] = valid[void] = 0
        known = heights.astype(np.float64)
        total[first:last] += _integrate(edges, _integrate(col_edges, known.T).T)
        weights[first:last] += _integrate(edges, _integrate(col_edges, valid.T).T)
    return _weighted(total, weights, heights.dtype)


def _integrate(edges: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integrate the first axis of piecewise constant `values` between the edges."""
    n_samples = values.shape[0]
    cumulated = np.zeros((n_samples + 1, *values.shape[1:]))
    np.cumsum(values, axis=0, out=cumulated[1:])
    whole = np.minimum(np.floor(edges).astype(np.int64), n_samples)
    part = (edges - whole)[:, None]
    beyond = values[np.minimum(whole, n_samples - 1)]
    at_edges = cumulated[whole] + part * beyond
    result: NDArray[np.float64] = np.diff(at_edges, axis=0)
    return result


def weighted_means(
    total: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return means, and where they exist: without weight there is a void."""
    valid = weights > 1e-9
    return np.divide(total, weights, out=np.zeros_like(total), where=valid), valid


def _weighted(
    total: NDArray[np.float64], weights: NDArray[np.float64], dtype: np.dtype[Any]
) -> _Heights:
    means, valid = weighted_means(total, weights)
    means = np.rint(means) if dtype.kind in "iu" else means
    return means.astype(dtype), ~valid


def fill_voids(
    heights: NDArray[np.float64], valid: NDArray[np.bool_], n_rounds: int
) -> NDArray[np.float64]:
    """Return a copy of heights with voids filled between the valid ones around, within their range.

    Means of 2 x 2 samples fill as many as they can, those of coarser levels the rest; on each level
    `n_rounds` of averaging with the neighbours smooth the filled part. Without valid samples,
    heights are unchanged.
    """
    if valid.all() or not valid.any():
        return heights.copy()
    padding = tuple((0, n % 2) for n in heights.shape)
    n_rows, n_cols = ((n + 1) // 2 for n in heights.shape)
    fours = np.pad(valid, padding).reshape(n_rows, 2, n_cols, 2)
    known = np.pad(np.where(valid, heights, 0.0), padding).reshape(fours.shape)
    counts, sums = fours.sum(axis=(1, 3)), known.sum(axis=(1, 3))
    coarse = fill_voids(sums / np.maximum(counts, 1), counts > 0, n_rounds)
    filled = np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1)
    filled = np.where(valid, heights, filled[: heights.shape[0], : heights.shape[1]])
    for _ in range(n_rounds):
        around = np.pad(filled, 1, mode="edge")
        mean = (around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]) / 4
        filled = np.where(valid, heights, mean)
    return filled
