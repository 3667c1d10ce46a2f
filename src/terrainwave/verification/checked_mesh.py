"""A mesh to check, and the distance of samples from it.

With integers all of it is exact; with floats (meshes cut along a window), points within 1e-6 of an
edge count as on it.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel

FLOAT_TOLERANCE = 1e-6
# Bound on float64's error for heights below 2^40 sixteenths, in 1/16 quanta.
_FLOAT_LOSS = 2.0**-8
_MAX_PRODUCT = 1 << 61


class CheckedMesh(NamedTuple):
    """A mesh to check; integers or floats.

    `rows`, `cols` are in half samples of the grid used for the check, `heights` in 1/16 quanta.
    `triangles` are clockwise with columns to the right and rows downwards.
    """

    rows: NDArray[Any]
    cols: NDArray[Any]
    heights: NDArray[Any]
    triangles: NDArray[np.integer]

    def on_grid(self, stride: int) -> "CheckedMesh":
        return self._replace(rows=self.rows * stride, cols=self.cols * stride)

    @property
    def is_exact(self) -> bool:
        """Return whether positions and heights are integers, small enough for exact products."""
        if any(v.dtype.kind == "f" for v in (self.rows, self.cols, self.heights)):
            return False
        if not len(self.rows):
            return True
        corners = self.rows[self.triangles], self.cols[self.triangles]
        longest = [int((c.max(axis=1) - c.min(axis=1)).max(initial=0)) for c in corners]
        reach = int(np.abs(self.heights).max()) + (1 << 36)
        return 2 * (longest[0] + 1) * (longest[1] + 1) * reach < _MAX_PRODUCT


@dataclass(frozen=True)
class Deviation:
    """Distance of samples from a mesh; `worst` in 1/16 quanta, rounded up, at (`row`, `col`)."""

    worst: int
    row: int
    col: int
    n_beyond: int
    is_covered: NDArray[np.bool_]


def deviation(
    surface: CheckedMesh,
    samples: NDArray[np.int64],
    valid: NDArray[np.bool_],
    limit: float,
    place: tuple[int, int] = (0, 0),
) -> Deviation:
    """Return the largest vertical distance of valid samples from a surface, in 1/16 quanta.

    Exact, rounded up, if `CheckedMesh.is_exact`; otherwise it may be up to 2^-8 too small. Samples
    further away than `limit` are counted; the first sample lies at `place`.
    """
    kind = np.int64 if surface.is_exact else np.float64
    loss = 0 if surface.is_exact else _FLOAT_LOSS
    covered = np.zeros(samples.shape, dtype=np.bool_)
    beyond = np.zeros(samples.shape, dtype=np.bool_)
    typed = CheckedMesh(
        surface.rows.astype(kind), surface.cols.astype(kind), surface.heights.astype(kind),
        np.ascontiguousarray(surface.triangles),
    )  # fmt: skip
    worst, row, col = _deviation(
        typed, samples, np.ascontiguousarray(valid), float(limit), (kind(place[0]), kind(place[1])),
        kind(0) if surface.is_exact else FLOAT_TOLERANCE, kind(loss), covered, beyond,
    )  # fmt: skip
    return Deviation(int(worst), int(row), int(col), int(np.count_nonzero(beyond)), covered)


@kernel
def _deviation(surface, samples, valid, limit, place, tolerance, loss, covered, beyond):
    rows, cols, heights, triangles = surface
    first_row, first_col = place
    n_rows, n_cols = samples.shape
    worst, worst_row, worst_col = np.float64(0), -1, -1
    for t in range(triangles.shape[0]):
        p, q, s = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        r_0, r_1, r_2 = rows[p] - 2 * first_row, rows[q] - 2 * first_row, rows[s] - 2 * first_row
        top = max(int(np.ceil(min(r_0, r_1, r_2) / 2)), 0)
        bottom = min(int(np.floor(max(r_0, r_1, r_2) / 2)), n_rows - 1)
        if top > bottom:
            continue
        c_0, c_1, c_2 = cols[p] - 2 * first_col, cols[q] - 2 * first_col, cols[s] - 2 * first_col
        left = max(int(np.ceil(min(c_0, c_1, c_2) / 2)), 0)
        right = min(int(np.floor(max(c_0, c_1, c_2) / 2)), n_cols - 1)
        area = (c_1 - c_0) * (r_2 - r_0) - (c_2 - c_0) * (r_1 - r_0)
        if area <= 0:
            continue
        for row in range(top, bottom + 1):
            for col in range(left, right + 1):
                # Twice the areas of the triangles of the sample with each edge.
                w_0 = (c_1 - 2 * col) * (r_2 - 2 * row) - (c_2 - 2 * col) * (r_1 - 2 * row)
                w_1 = (c_2 - 2 * col) * (r_0 - 2 * row) - (c_0 - 2 * col) * (r_2 - 2 * row)
                w_2 = area - w_0 - w_1
                if w_0 < -tolerance or w_1 < -tolerance or w_2 < -tolerance:
                    continue
                if not valid[row, col]:
                    continue
                covered[row, col] = True
                sample = samples[row, col]
                apart = abs(
                    w_0 * (heights[p] - sample) + w_1 * (heights[q] - sample)
                    + w_2 * (heights[s] - sample)
                ) - loss * area  # fmt: skip
                # Integers: exact, as limit is one; floats: less their possible error.
                up = -(-apart // area)
                if up > worst:
                    worst, worst_row, worst_col = np.float64(up), row, col
                if up > limit:
                    beyond[row, col] = True
    return worst, worst_row, worst_col
