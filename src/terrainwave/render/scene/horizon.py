"""Occlusion by nearer ground: blocks wholly below it are neither drawn nor requested.

Zheng, Wang and Wang mention it as future work. Here a horizon is a table of slopes above which an
eye sees past the drawn ground. A column of it is a narrow fan of directions, a row is a depth:
ground that ends before that depth counts. Anything behind a depth, and below the horizon of that
depth in all of its directions, is hidden.

A direction is u = right / depth and a slope t = rise / depth, both of the level view with the
camera's heading, so that lines of sight are straight everywhere and nothing is an angle.

It is conservative: a cell of ground counts with the least height of its surface as drawn
(`FLOORS`), hides only in columns that it spans, and hides nothing where it has voids.
"""

import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.render.scene.camera import Camera, Viewport

# Cells per side of a piece, and the number of samples that cells overlap their borders, so that
# adjacent pieces leave no gap.
SIDE, OVERLAP = 16, 2
N_COLUMNS, N_ROWS = 512, 96
# Ratio of the depths of consecutive rows, and the first depth as a share of the last.
_RATIO = 1.1
# Least depth of a point at unit distance in view: with more ground below in view, there is little
# to hide.
_LEAST_DEPTH = 0.3
# Fields of `Horizon.aim`: eye; right and forward, level; least u; columns per u; depth of row 0;
# rows per e-fold of depth; metres per metre by which surfaces may be lower (`margin`).
EYE_X, EYE_Y, EYE_Z, RIGHT_X, RIGHT_Y, AHEAD_X, AHEAD_Y = range(7)
FIRST_U, PER_U, FIRST_DEPTH, PER_FOLD, MARGIN, N_AIM = range(7, 13)


# Lower limits of a piece's surface, for cells of it. Fields: (a, b, c, d, e, f) of local x = a col
# + b row + c, y = d col + e row + f; starts and ends of cells; heights in metres without
# exaggeration, -inf if unknown, as in voids.
FLOORS = np.dtype(
    [("matrix", "f8", 6), ("rows", "f8", (SIDE, 2)), ("cols", "f8", (SIDE, 2)),
     ("heights", "f8", (SIDE, SIDE))]
)  # fmt: skip
Floors = NDArray[np.void]


class Horizon(NamedTuple):
    """Slopes above which an eye sees past nearer ground, shape (rows, columns); empty: sees all."""

    slopes: NDArray[np.float64]
    aim: NDArray[np.float64]

    @classmethod
    def none(cls) -> Self:
        """Return the one that hides nothing."""
        return cls(np.empty((0, 0)), np.empty(N_AIM))

    @classmethod
    def of(
        cls,
        camera: Camera,
        viewport: Viewport,
        floors: Floors,  # shape (n,); of the drawn pieces
        *,
        exaggeration: float,
        reach: float,  # depth of the furthest piece, metres
        # how far drawn surfaces may be below those of `floors`, per metre of distance
        margin: float,
    ) -> Self:
        """Return the horizon of an eye above the ground."""
        aim = _aim_of(camera, viewport, reach, margin)
        if aim is None or not len(floors):
            return cls.none()
        slopes = np.full((N_ROWS, N_COLUMNS), -np.inf)
        parts = (floors[name] for name in FLOORS.names or ())
        fill_horizon(*parts, exaggeration, aim, slopes)
        return cls(np.maximum.accumulate(slopes, axis=0), aim)


def _aim_of(
    camera: Camera, viewport: Viewport, reach: float, margin: float
) -> NDArray[np.float64] | None:
    """Return the fields of `Horizon.aim`; None if the view is too steep."""
    pitch, tangent = math.radians(camera.pitch), math.tan(math.radians(camera.fov) / 2)
    least = math.cos(pitch) - tangent * abs(math.sin(pitch))
    if least < _LEAST_DEPTH:
        return None
    widest = tangent * viewport.aspect / least
    sine, cosine = math.sin(math.radians(camera.heading)), math.cos(math.radians(camera.heading))
    first_depth = reach / _RATIO**N_ROWS
    return np.array([
        *camera.position, cosine, -sine, sine, cosine, -widest, N_COLUMNS / (2 * widest),
        first_depth, 1 / math.log(_RATIO), margin,
    ])  # fmt: skip


@kernel
def fill_horizon(matrices, rows, cols, heights, z_scale, aim, slopes):
    """Fill a horizon, initially -inf, from `FLOORS` of pieces."""
    for k in range(matrices.shape[0]):
        _raise_horizon(matrices[k], rows[k], cols[k], heights[k], z_scale, aim, slopes)


@kernel
def _raise_horizon(matrix, rows, cols, heights, z_scale, aim, slopes):
    """Raise a horizon by cells of ground: each in the first row after its end.

    A line of sight in a column that a cell spans crosses it between its least and largest depth,
    and is below its floor there if it is below the floor at one of them: the nearer one if the
    floor is below the eye, else the further one.
    """
    n_rows, n_columns = slopes.shape
    for i in range(rows.shape[0]):
        for j in range(cols.shape[0]):
            if heights[i, j] == -np.inf:
                continue
            near, far, first, last = np.inf, 0.0, np.inf, -np.inf
            for k in range(4):
                row, col = rows[i, k & 1], cols[j, k >> 1]
                x = matrix[0] * col + matrix[1] * row + matrix[2] - aim[EYE_X]
                y = matrix[3] * col + matrix[4] * row + matrix[5] - aim[EYE_Y]
                depth = aim[AHEAD_X] * x + aim[AHEAD_Y] * y
                near, far = min(near, depth), max(far, depth)
                if near > aim[FIRST_DEPTH]:
                    u = (aim[RIGHT_X] * x + aim[RIGHT_Y] * y) / depth
                    first, last = min(first, u), max(last, u)
            if near <= aim[FIRST_DEPTH]:
                continue
            start = max(int(np.ceil((first - aim[FIRST_U]) * aim[PER_U])), 0)
            end = min(int(np.floor((last - aim[FIRST_U]) * aim[PER_U])), n_columns)
            ring = int(np.floor(np.log(far / aim[FIRST_DEPTH]) * aim[PER_FOLD])) + 1
            if start >= end or ring >= n_rows:
                continue
            rise = heights[i, j] * z_scale - aim[EYE_Z]
            slope = rise / (near if rise < 0 else far)
            widest = max(first * first, last * last)
            slope -= aim[MARGIN] * (1 + widest) * (1 + (rise / near) ** 2)
            for column in range(start, end):
                slopes[ring, column] = max(slopes[ring, column], slope)


@kernel
def is_below(slopes, aim, low_x, low_y, high_x, high_y, high_z):
    """Return whether a box lies below the horizon of nearer ground wherever it is in view."""
    n_rows, n_columns = slopes.shape
    if n_rows == 0:
        return False
    near, far, first, last = np.inf, 0.0, np.inf, -np.inf
    for k in range(4):
        x = (high_x if k & 1 else low_x) - aim[EYE_X]
        y = (high_y if k & 2 else low_y) - aim[EYE_Y]
        depth = aim[AHEAD_X] * x + aim[AHEAD_Y] * y
        if depth <= aim[FIRST_DEPTH]:
            return False
        u = (aim[RIGHT_X] * x + aim[RIGHT_Y] * y) / depth
        near, far, first, last = min(near, depth), max(far, depth), min(first, u), max(last, u)
    ring = int(np.floor(np.log(near / aim[FIRST_DEPTH]) * aim[PER_FOLD]))
    ring = min(ring, n_rows - 1)
    rise = high_z - aim[EYE_Z]
    slope = rise / (near if rise > 0 else far)
    start = max(int(np.floor((first - aim[FIRST_U]) * aim[PER_U])), 0)
    end = min(int(np.floor((last - aim[FIRST_U]) * aim[PER_U])) + 1, n_columns)
    for column in range(start, end):
        if slope >= slopes[ring, column]:
            return False
    return start < end


def floors_of(
    # lower limits of the surface in metres, at samples of a piece and up to `OVERLAP` around it;
    # -inf in voids
    heights: NDArray[np.float64],
    matrix: NDArray[np.float64],  # shape (6,); positions of samples, counted from the first
    cells: tuple[int, int],  # between samples of the piece, rows and columns
    ring: tuple[int, int],  # rows and columns of samples before the piece's own first ones
) -> Floors:
    """Return the floors of samples, FLOORS without a dimension."""
    edges = []
    for n, before, most in zip(cells, ring, heights.shape, strict=True):
        ends = before + np.linspace(0, n, SIDE + 1).round().astype(np.intp)
        first, last = np.maximum(ends[:-1] - OVERLAP, 0), np.minimum(ends[1:] + OVERLAP, most - 1)
        edges.append(np.column_stack([first, last]))
    rows, cols = edges
    least = np.stack([heights[first : last + 1].min(axis=0) for first, last in rows])
    least = np.stack([least[:, first : last + 1].min(axis=1) for first, last in cols], axis=1)
    floors = np.empty((), FLOORS)
    floors["matrix"], floors["rows"], floors["cols"], floors["heights"] = matrix, rows, cols, least
    return floors


def floor_at(floors: Floors, x: float, y: float) -> float | None:
    """Return the value of a piece's `FLOORS` at a point, None if it has no cell there."""
    a, b, c, d, e, f = floors["matrix"]
    col, row = np.linalg.solve(np.array([[a, b], [d, e]]), np.array([x - c, y - f]))
    rows, cols = floors["rows"], floors["cols"]
    if not (rows[0, 0] <= row <= rows[-1, 1] and cols[0, 0] <= col <= cols[-1, 1]):
        return None
    i, j = np.searchsorted(rows[:, 1], row), np.searchsorted(cols[:, 1], col)
    return float(floors["heights"][i, j])
