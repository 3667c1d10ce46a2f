"""Smooth surfaces over voids."""

import numpy as np
from numpy.typing import NDArray


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
