"""The largest error of each level: as stored in the file, or by the recursion of Y10 §2.2.

Stored is the measured one: how far any valid original under a block is from the bilinear surface
of the block's decoded samples. The recursion needs no original: Err(B) = the bound on the full
grid, and above it the largest Err of B's children + the largest distance of their decoded samples
from B's bilinear surface. It is an upper bound of the measured error.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.grid.quadtree import Region


def level_errors(terrain: Any, kind: str) -> list[float]:
    """Return the largest error of each level in physical units, the coarsest level first.

    ``"measured"`` reads the index; ``"recursive"`` decodes all levels, windows at a time.
    """
    if kind == "measured":
        return terrain.level_errors()
    return [float(errors.max()) for errors in recursive_errors(terrain)]


def recursive_errors(
    terrain: Any, *, as_printed: bool = False, count: Callable[[int], None] = lambda _: None
) -> list[NDArray[np.float64]]:
    """Follow Y10 equation (2) block by block, from the full grid up: Err_Appr of every block.

    Parameters
    ----------
    as_printed : bool
        Add the bound on every level, as Y10 does because its children's errors are relative to the
        pyramid. Here they are relative to the full grid's originals on every level, so it is left
        out by default; with it the errors are upper bounds all the same.
    count : callable
        Called with numbers of samples of the full grid as they have been looked at.

    Returns
    -------
    list of ndarray of float64, shape (block rows, block columns) each
        In physical units, the coarsest level first.

    Notes
    -----
    Decodes all levels, windows at a time.
    """
    side = terrain.grid.block
    scale = abs(terrain.raster_info.scale)
    added = terrain.quanta_error if as_printed else 0.0
    levels = [np.full(terrain.grid.level_blocks(terrain.n_levels - 1), terrain.quanta_error)]
    for level in range(terrain.n_levels - 2, -1, -1):
        finer = levels[-1]
        errors = np.zeros(terrain.grid.level_blocks(level))
        for row, col in np.ndindex(errors.shape):
            children = finer[2 * row : 2 * row + 2, 2 * col : 2 * col + 2]
            apart = _interpolation_error(terrain, level, row * side, col * side) * scale
            errors[row, col] = children.max(initial=0.0) + apart + added
            if level == terrain.n_levels - 2:
                count(4 * side * side)
        levels.append(errors)
    return levels[::-1]


def _interpolation_error(terrain: Any, level: int, row: int, col: int) -> float:
    """Return how far the next level is from the bilinear surface of the block at (row, col)."""
    side = terrain.grid.block
    n_rows, n_cols = terrain.level_shape(level + 1)
    fine_region = Region(2 * row, 2 * col, 2 * side + 1, 2 * side + 1).intersect(
        Region(0, 0, n_rows, n_cols)
    )
    if 0 in fine_region.shape:
        return 0.0
    fine, fine_valid = terrain.read_with_mask(fine_region, level=level + 1, voids="any")
    coarse_region = Region(row, col, fine_region.n_rows // 2 + 1, fine_region.n_cols // 2 + 1)
    coarse, valid = terrain.read_with_mask(coarse_region, level=level, voids="any")
    surface = _doubled(_doubled(np.where(valid, coarse, 0).astype(np.float64)).T).T
    known = _doubled(_doubled(valid.astype(np.float64)).T).T == 1
    n_rows, n_cols = min(surface.shape[0], fine.shape[0]), min(surface.shape[1], fine.shape[1])
    part = np.s_[:n_rows, :n_cols]
    both = fine_valid[part] & known[part]
    heights = np.where(both, fine[part], 0).astype(np.float64)
    return float(np.abs(np.where(both, surface[part] - heights, 0)).max(initial=0.0))


def _doubled(values: np.ndarray) -> np.ndarray:
    """Return the rows of `values` with the mean of each two between them."""
    doubled = np.repeat(values, 2, axis=0)[:-1]
    doubled[1::2] = (values[:-1] + values[1:]) / 2
    return doubled
