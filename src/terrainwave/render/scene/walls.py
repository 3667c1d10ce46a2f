"""Block with the terrain as its upper side: walls, a floor, and lids over voids.

Walls stand on the raster's outline and reach down to a base plane; the floor is that plane under
the raster. A lid covers the voids, at heights between those around them, so that a hole is shown as
a hatch and not as the sky below it. None of them is data: they never write where `Canvas.pick` and
`Canvas.is_blank` read.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.file import TerrainFile
from terrainwave.read.resample import fill_voids
from terrainwave.render.scene.frame import Frame

# Kinds of vertices; the shader's numbers.
TOP, BASE, FLOOR, LID = 0.0, 1.0, 2.0, 3.0
VERTEX = np.dtype(
    [("col", "<f4"), ("row", "<f4"), ("height", "<f4"), ("kind", "<f4"), ("normal", "<f4", 2)]
)
# Samples along the longer side of the levels that walls and lids are made from: as many as pictures
# have pixels; of lids only the outline is visible.
_WALL_SIDE, _LID_SIDE = 2049, 641
_SMOOTHINGS = 6
_HAZE_AT_GROUND, _HAZE_ABOVE = 3.3, 1.3


class Solid(NamedTuple):
    """Triangles of walls, floor and lids."""

    # shape (n,); column and row of the full grid, height in metres without exaggeration (of tops
    # and lids), and the direction outwards in local metres (of walls)
    vertices: NDArray[np.void]
    triangles: NDArray[np.uint32]  # shape (n, 3)

    @property
    def has_lids(self) -> bool:
        """Return whether there are voids to cover."""
        return bool((self.vertices["kind"] == LID).any())


class _Overview(NamedTuple):
    """A level extended to the full grid's last row and column."""

    # positions of its samples on the full grid
    rows: NDArray[np.float64]
    cols: NDArray[np.float64]
    # shape (n_rows, n_cols); metres; in voids, values between those around
    heights: NDArray[np.float64]
    valid: NDArray[np.bool_]  # shape (n_rows, n_cols)
    is_full: bool  # it is the full grid


def build_solid(terrain: TerrainFile, frame: Frame) -> Solid:
    """Return the solid of a terrain; reads a level of at most 641 samples a side, and a border."""
    has_voids = terrain.info().voids != "none"
    overview = _read_overview(terrain, frame) if has_voids else None
    parts = [_floor(terrain.shape), *_walls(terrain, frame, overview)]
    if overview is not None and not overview.valid.all():
        parts.append(_lid(overview))
    firsts = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    return Solid(
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate(
            [triangles + first for (_, triangles), first in zip(parts, firsts, strict=True)]
        ).astype(np.uint32),
    )


_Faces = tuple[NDArray[np.void], NDArray[np.int64]]


def level_within(terrain: TerrainFile, side: int) -> int:
    """Return the finest level with at most `side` samples per side, or the coarsest."""
    level = terrain.n_levels - 1
    while level and max(terrain.grid.level_shape(level)) > side:
        level -= 1
    return level


def read_metres(
    terrain: TerrainFile, frame: Frame, window: tuple[int, int, int, int] | None, level: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return heights in metres, 0 in voids, and validity."""
    raw, valid = terrain.read_with_mask(window, level=level, on_error="mask", voids="any")
    raster = terrain.raster_info
    metres = frame.to_metres(raw.astype(np.float64) * raster.scale + raster.offset)
    return np.where(valid, metres, 0.0), valid


def _places(terrain: TerrainFile, level: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rows and columns of a level's samples, and finally those of the full grid's border."""
    stride = terrain.grid.stride(level)
    n_rows, n_cols = terrain.shape
    return _along_axis(n_rows, stride), _along_axis(n_cols, stride)


def _along_axis(n_full: int, stride: int) -> NDArray[np.float64]:
    places = np.arange(0, n_full, stride, dtype=np.float64)
    return places if places[-1] == n_full - 1 else np.append(places, n_full - 1.0)


def _read_overview(terrain: TerrainFile, frame: Frame) -> _Overview:
    level = level_within(terrain, _LID_SIDE)
    heights, valid = read_metres(terrain, frame, None, level)
    rows, cols = _places(terrain, level)
    beyond = (0, len(rows) - heights.shape[0]), (0, len(cols) - heights.shape[1])
    heights, valid = np.pad(heights, beyond, mode="edge"), np.pad(valid, beyond, mode="edge")
    return _Overview(
        rows, cols, fill_voids(heights, valid, _SMOOTHINGS), valid, level == terrain.n_levels - 1
    )  # fmt: skip


def _vertices(col: Any, row: Any, height: Any, kind: float, normal: Any = 0.0) -> NDArray[np.void]:
    vertices = np.zeros(np.broadcast(col, row, height, kind).shape, dtype=VERTEX)
    vertices["col"], vertices["row"] = col, row
    vertices["height"], vertices["kind"] = height, kind
    vertices["normal"] = normal
    return vertices


def _floor(shape: tuple[int, int]) -> _Faces:
    n_rows, n_cols = shape
    cols = np.array([0, n_cols - 1, n_cols - 1, 0])
    rows = np.array([0, 0, n_rows - 1, n_rows - 1])
    return _vertices(cols, rows, 0.0, FLOOR), np.array([[0, 1, 2], [0, 2, 3]])


def _walls(terrain: TerrainFile, frame: Frame, overview: _Overview | None) -> list[_Faces]:
    """Return the walls on the four sides."""
    level = level_within(terrain, _WALL_SIDE)
    n_rows, n_cols = terrain.grid.level_shape(level)
    rows, cols = _places(terrain, level)
    corner, across, down = frame.samples_to_local(np.array([0, 0, 1]), np.array([0, 1, 0]))
    sides = [
        ((0, 0, 1, n_cols), cols, 0.0 * cols, corner - down),
        ((n_rows - 1, 0, 1, n_cols), cols, 0.0 * cols + rows[-1], down - corner),
        ((0, 0, n_rows, 1), 0.0 * rows, rows, corner - across),
        ((0, n_cols - 1, n_rows, 1), 0.0 * rows + cols[-1], rows, across - corner),
    ]
    parts = []
    for window, at_cols, at_rows, outwards in sides:
        read, is_valid = read_metres(terrain, frame, window, level)
        beyond = (0, len(at_cols) - read.size)
        heights = np.pad(read.ravel(), beyond, mode="edge")
        valid = np.pad(is_valid.ravel(), beyond, mode="edge")
        if overview is not None:
            heights = np.where(valid, heights, _along(overview, at_rows, at_cols))
        if level < terrain.n_levels - 1:
            # Between these samples the terrain may be lower, and a wall must not hide it.
            around = np.pad(heights, 1, mode="edge")
            heights = np.minimum(heights, np.minimum(around[:-2], around[2:]))
        normal = outwards / np.linalg.norm(outwards)
        tops = _vertices(at_cols, at_rows, heights, TOP, normal)
        bases = _vertices(at_cols, at_rows, 0.0, BASE, normal)
        n = len(tops)
        a, b = np.arange(n - 1), np.arange(1, n)
        quads = np.concatenate([np.column_stack([a, b, a + n]), np.column_stack([b, b + n, a + n])])
        parts.append((np.concatenate([tops, bases]), quads))
    return parts


def _along(
    overview: _Overview, rows: NDArray[np.float64], cols: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the overview's heights along a side of the raster."""
    if rows[0] == rows[-1]:
        line = overview.heights[0 if rows[0] == 0 else -1]
        return np.interp(cols, overview.cols, line)
    line = overview.heights[:, 0 if cols[0] == 0 else -1]
    return np.interp(rows, overview.rows, line)


def _lid(overview: _Overview) -> _Faces:
    """Return the triangles over voids.

    A void sample of a coarse level makes everything up to its neighbours void (FORMAT.md §5.1), so
    no valid sample is below a lid. On the full grid the triangles of three valid samples belong to
    the terrain.
    """
    valid = overview.valid
    numbers = np.arange(valid.size).reshape(valid.shape)
    a, b, c, d = (
        corner.ravel()
        for corner in (numbers[:-1, :-1], numbers[:-1, 1:], numbers[1:, 1:], numbers[1:, :-1])
    )
    is_valid = valid.ravel()
    n_valid = sum(is_valid[corner].astype(int) for corner in (a, b, c, d))
    whole = n_valid < (3 if overview.is_full else 4)
    quads = [np.column_stack([a, d, b])[whole], np.column_stack([b, d, c])[whole]]
    if overview.is_full:
        for corner, left, right in ((a, d, b), (b, a, c), (c, b, d), (d, c, a)):
            lone = (n_valid == 3) & ~is_valid[corner]
            quads.append(np.column_stack([left, right, corner])[lone])
    triangles = np.concatenate(quads)
    used, triangles = np.unique(triangles, return_inverse=True)
    rows, cols = np.divmod(used, valid.shape[1])
    vertices = _vertices(overview.cols[cols], overview.rows[rows], overview.heights.ravel()[used],
                         LID)  # fmt: skip
    return vertices, triangles.reshape(-1, 3)


def distance_to_walls(frame: Frame, eye: NDArray[np.float64]) -> float:
    """Return the least distance of walls and floor from an eye, local metres."""
    ends = frame.outline
    low, high = frame.solid_box
    beside = max(float(eye[2] - high[2]), float(low[2] - eye[2]), 0.0)
    first, along = ends, np.roll(ends, -1, axis=0) - ends
    share = ((eye[:2] - first) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-300)
    nearest = first + along * np.clip(share, 0, 1)[:, None]
    across = float(np.linalg.norm(nearest - eye[:2], axis=1).min())
    return min(float(np.hypot(across, beside)), abs(float(eye[2] - low[2])))


def haze_of(frame: Frame, eye: NDArray[np.float64], haze: float) -> tuple[float, float]:
    """Return the start of haze and its density per metre, local metres.

    It begins at the nearest part of the terrain's box and thickens towards the farthest, so that a
    hill and a planet look alike: with 0.25, the default, the farthest part is half haze from the
    ground, an eighth from as far above as the terrain is wide.
    """
    low, high = frame.box
    nearest = float(np.linalg.norm(np.maximum(np.maximum(low - eye, eye - high), 0)))
    farthest = float(np.linalg.norm(np.maximum(np.abs(low - eye), np.abs(high - eye))))
    extent = max(float(np.linalg.norm(high - low)), 1.0)
    above = max(float(eye[2] - high[2]), 0.0)
    thickness = _HAZE_AT_GROUND * haze / (1 + _HAZE_ABOVE * above / extent)
    return nearest, thickness / max(farthest - nearest, 1.0)
