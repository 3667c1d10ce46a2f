"""The pyramid of Zhang et al. 2012, §1: Neville filters of order 4 or 2, levels of regular samples.

Here, as there, level 0 is the **finest**. Sample i of level l lies at (i + ½) · 2^l − ½ of the
finest grid, in the middle of the two samples per axis that it replaces, so the levels do not nest
as the file's do and the pyramid is built beside them, in temporary files where it is large.

Zhang, Zhang, Zhang: GPU-based real-time terrain rendering algorithm using batched LOD. Journal of
Image and Graphics 17(4), 2012, pp. 582–588. Kovačević, Sweldens 2000 for the filters.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.errors import InvalidArgumentError
from terrainwave.grid.quadtree import Region
from terrainwave.raster_io.temporary import TILE, Spool

Heights = NDArray[np.float32]
# Metres, NaN in voids; a region inside the finest level.
ReadHeights = Callable[[Region], Heights]

# Of each order: the inner four of the 4 x 4 window, the eight beside them; corners are 0.
WEIGHTS = {2: (0.25, 0.0), 4: (10.0 / 32.0, -1.0 / 32.0)}


@kernel
def filter_rows(fine, inner_weight, outer_weight, coarse):
    """Fill `coarse`, float32 (n, m), from `fine`, float32 (2n + 2, 2m + 2), NaN in voids.

    Sample (r, c) takes rows 2r … 2r + 3 of `fine`, whose first row is 2i − 1 of the paper. Where
    the window has voids the valid ones of its inner four are averaged; without any it is void.
    """
    for r in range(coarse.shape[0]):
        for c in range(coarse.shape[1]):
            total, inner, n_inner, n_all = 0.0, 0.0, 0, 0
            for i in range(4):
                for j in range(4):
                    is_inner = 1 <= i <= 2 and 1 <= j <= 2
                    if not is_inner and i % 3 == 0 and j % 3 == 0:
                        continue
                    value = float(fine[2 * r + i, 2 * c + j])
                    if np.isnan(value):
                        continue
                    n_all += 1
                    if is_inner:
                        n_inner += 1
                        inner += value
                        total += inner_weight * value
                    else:
                        total += outer_weight * value
            if n_all == 12:
                coarse[r, c] = total
            elif n_inner > 0:
                coarse[r, c] = inner / n_inner
            else:
                coarse[r, c] = np.nan


class NevillePyramid:
    """All levels of a terrain's heights.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the finest level.
    read : callable
        Returns heights of a region of the finest level, metres above any zero, NaN in voids.
    n_levels : int
    directory : Path
        For temporary files.
    order : int
        Of the filter: 2 or 4.
    count : callable
        Called with numbers of samples of the finest level as they have been read.

    Notes
    -----
    Building reads every sample once: O(n_rows * n_cols) time; memory is that of some tiles, and of
    small levels.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        read: ReadHeights,
        n_levels: int,
        directory: Path,
        count: Callable[[int], None] = lambda n_samples: None,
        *,
        order: int = 4,
    ) -> None:
        if order not in WEIGHTS:
            raise InvalidArgumentError(f"found `order` {order}, expected 2 or 4")
        self._read, self._weights = read, WEIGHTS[order]
        self.shapes = [(_ceil(shape[0], k), _ceil(shape[1], k)) for k in range(n_levels)]
        self._spools = [Spool(self.shapes[k], np.float32, directory) for k in range(1, n_levels)]
        for level in range(1, n_levels):
            self._fill(level, count if level == 1 else lambda n_samples: None)

    def close(self) -> None:
        """Delete the temporary files."""
        for spool in self._spools:
            spool.close()

    def _fill(self, level: int, count: Callable[[int], None]) -> None:
        for part in Region(0, 0, *self.shapes[level]).tiles(TILE, TILE):
            row, col, n_rows, n_cols = part
            window = Region(2 * row - 1, 2 * col - 1, 2 * n_rows + 2, 2 * n_cols + 2)
            coarse = np.empty(part.shape, dtype=np.float32)
            filter_rows(self.window(level - 1, window, replicate=True), *self._weights, coarse)
            self._spools[level - 1].write(part, coarse)
            count(4 * n_rows * n_cols)

    def window(self, level: int, region: Region, *, replicate: bool) -> Heights:
        """Return heights of a region, which may reach past the level's edges.

        There the border is repeated, or all is void.
        """
        inside = region.intersect(Region(0, 0, *self.shapes[level]))
        heights = self._read(inside) if level == 0 else self._spools[level - 1].read(inside)
        before = inside.row - region.row, inside.col - region.col
        padding = [
            (before[axis], region.shape[axis] - before[axis] - inside.shape[axis])
            for axis in (0, 1)
        ]
        if replicate:
            return np.pad(heights, padding, mode="edge")
        return np.pad(heights, padding, constant_values=np.nan)


def _ceil(n: int, shift: int) -> int:
    return (n + (1 << shift) - 1) >> shift
