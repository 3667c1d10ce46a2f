"""A restricted quadtree that follows a camera: vertices split and merge from frame to frame.

X. Zheng, Y. Wang, X. Wang, on massive terrain with integer wavelets and restricted quadtrees: a
vertex is split, with all its dependencies, if its coefficient exceeds a threshold that grows with
the distance; it is merged when nothing depends on it any more. `stored` has the triangles, the
dependencies and the sources; here the grid is a row of squares of `tile` cells, whose corners
always are vertices.

Three errors of a vertex, all made no smaller than those of the vertices that depend on it, so that
a front from coarse to fine finds all:

* `"coefficient"`: the magnitude of the wavelet coefficient at its place. No bound.
* `"paper"`: the paper's δ, |h - mean of its four neighbours|; according to the paper, similar to
  the coefficient. No bound.
* `"measured"`: the largest vertical distance of the samples of the two triangles that it splits. No
  sample of a loaded tile is further than τ on screen.

Boxes are nested, too: a vertex is active exactly where its own error on screen
is above τ.

Geomorphs, which the paper does not have: the surface drawn is the mean of those for all thresholds
between τ / λ and τ. Vertices are split above τ / λ; one with the error ε exists for the share (ε -
τ / λ) / (τ - τ / λ) of the thresholds, and for the rest lies on the others' triangles. So it begins
on the edge that it splits and reaches its own height at τ. The bound still holds: each of these
surfaces is within its own threshold, so their mean is within τ. All of them are linear on the drawn
triangles, so the mean is computed only at vertices (`morph`).

At voids and the raster's outline a mesh ends with whole triangles: a vertex whose triangles hold
samples and voids has their size as its error. Such errors are stored negative.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.tri.followed import CLOSED, Eye, Followed, FollowingMesh, Marked
from terrainwave.tri.rqt.morph import place_vertices
from terrainwave.tri.rqt.stored import neighbours, split_top
from terrainwave.tri.rqt.vertex_errors import (
    is_corner,
    measure_tile,
    needs_of,
    rounding_of,
    widen_everywhere,
)
from terrainwave.tri.scratch import Scratch
from terrainwave.tri.triangle import area_of

# Of a view as an array.
_X, _Y, _Z, _FORWARD, _FOCAL, _SLANT, _Z_SCALE, _LOW, _HIGH = 0, 1, 2, 3, 6, 7, 8, 9, 10
# Whether errors are bounds; half the width of boxes along x and y, and how much closer they begin,
# by their reach; x and y of samples.
_IS_BOUND, _WIDTH, _DEPTH_LESS, _MATRIX = 11, 12, 14, 15
# Fields of a plane of the view as an array: the largest n·p + w over all boxes around x, y is
# a x + b y + c + reach d.
_ALONG_X, _ALONG_Y, _CONSTANT, _PER_REACH = 0, 1, 2, 3
# Inactive nodes that one vertex may depend on: at most a few of each stride.
_MOST_DEPENDENCIES = 512
_ROOM = 4 * _MOST_DEPENDENCIES  # for dependents of one vertex


class RestrictedFrame(NamedTuple):
    """A mesh for one view."""

    # shape (n_vertices, 3); heights are multiplied by the view's factor
    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]  # shape (n_triangles, 3); counter-clockwise seen from above
    places: NDArray[np.int32]  # shape (n_vertices, 2); row and column of each vertex's sample
    edges: NDArray[np.int32]  # shape (n_edges, 2); vertices of the edges along open sides
    border_error: float  # vertical distance of edges in view from the samples on them
    n_active: int  # vertices of the quadtree, including those in voids
    n_touched: int  # vertices whose error on screen was computed
    n_changed: int  # vertices that were split or merged
    tau: float  # pixels; above the requested one if the budget requires it


class RestrictedMesh(FollowingMesh[RestrictedFrame]):
    """A raster's restricted quadtree that follows a camera."""

    def __init__(
        self,
        heights: NDArray[np.floating],  # shape (n_rows, n_cols); NaN is void
        *,
        tile: int = 256,  # cells per side of a tile: a power of two
        sample_matrix: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
        error: str = "measured",  # {"measured", "paper", "coefficient"}; see the module's docstring
        # largest distance of the samples' surface from the reference of errors
        base_error: float = 0.0,
        # magnitudes of coefficients, in the unit of heights, only for "coefficient"
        coefficients: NDArray[np.floating] | None = None,
        # whether the raster continues beyond its first row and column, its last row and column
        open_sides: tuple[bool, bool, bool, bool] = CLOSED,
        scratch: Scratch | None = None,
    ) -> None:
        super().__init__(sample_matrix, scratch)
        self.shape, self.tile = (heights.shape[0], heights.shape[1]), tile
        n_rows, n_cols = (max(-(-(n - 1) // tile), 1) for n in self.shape)
        self.n_tiles = n_rows, n_cols
        self._is_bound, self._open_sides = error == "measured", open_sides
        valid = heights[np.isfinite(heights)]
        self._limits = (
            float(valid.min(initial=np.inf)) - base_error if len(valid) else 0.0,
            float(valid.max(initial=-np.inf)) + base_error if len(valid) else 0.0,
        )
        padded = n_rows * tile + 1, n_cols * tile + 1
        self._heights = _padded(heights, padded, np.nan)
        self._errors = self._measure(base_error, coefficients)
        self._n_children = np.zeros(padded, dtype=np.uint8)
        self._is_active = np.zeros(padded, dtype=np.bool_)
        corners = np.indices((n_rows + 1, n_cols + 1)).reshape(2, -1).T * tile
        self._is_active[corners[:, 0], corners[:, 1]] = True
        self._active, self._n_vertices = corners.astype(np.int32), len(corners)
        self._on_screen = np.full(len(corners), np.nan)
        self._reserve()
        self._stack = np.empty((_MOST_DEPENDENCIES, 6), dtype=np.int64)

    def _measure(
        self, base_error: float, coefficients: NDArray[np.floating] | None
    ) -> NDArray[np.float32]:
        errors = np.zeros_like(self._heights)
        own = np.zeros((0, 0), dtype=np.float32)
        if coefficients is not None:
            own = _padded(coefficients, errors.shape, 0.0)
        base = base_error + rounding_of(self._limits) if self._is_bound else 0.0
        for row, col in np.ndindex(self.n_tiles):
            rows, cols = (slice(k * self.tile, (k + 1) * self.tile + 1) for k in (row, col))
            measure_tile(
                rows.start, cols.start, base, self._is_bound, self._heights[rows, cols],
                own[rows, cols], errors[rows, cols],
            )  # fmt: skip
        widen_everywhere(errors, self.tile)
        return errors

    def _reserve(self) -> None:
        """Allocate arrays for twice the active vertices, reused by updates."""
        n = self._n_vertices
        active, on_screen = self._active[:n], self._on_screen[:n]
        capacity = 2 * (n + _ROOM)
        self._active, self._on_screen = np.empty((capacity, 2), dtype=np.int32), np.empty(capacity)
        self._active[:n], self._on_screen[:n] = active, on_screen

    @property
    def least_vertices(self) -> int:
        return (self.n_tiles[0] + 1) * (self.n_tiles[1] + 1)

    def draw(self, eye: Eye, followed: Followed) -> RestrictedFrame:
        view, planes, n = self._view(eye), self._planes(eye), self._n_vertices
        take, active = self._scratch.take, self._active[:n]
        start, end = followed.threshold, followed.tau
        vertex_of = take("vertex_of", self._is_active.shape, np.int32)
        shares, at = take("shares", (n,), np.float64), tuple(active.T)
        vertex_of[at] = np.arange(n)
        heights = self._heights[at].astype(np.float64)
        if end > start:
            fill_shares(
                self._errors, self.tile, active, self._on_screen, vertex_of, view, planes, start,
                end, shares,
            )  # fmt: skip
        else:
            shares[:] = 1.0
        vertices, places = take("vertices", (n, 3), np.float64), take("places", (n, 2), np.int32)
        z_scale, matrix = view[_Z_SCALE], view[_MATRIX:]
        count = place_vertices(
            active, vertex_of, shares, heights, z_scale, matrix, vertices, places
        )
        triangles = take("triangles", (2 * n, 3), np.int32)
        n_triangles = draw_triangles(
            self._heights, self.tile, self._is_active, self.is_mirrored, vertex_of, self._stack,
            triangles,
        )  # fmt: skip
        edges = np.empty((2 * sum(self.shape), 2), dtype=np.int32)
        n_edges, error = follow_borders(
            self._open_sides, self.shape, self._heights, self._is_active, vertex_of, vertices,
            z_scale, matrix, eye.planes, edges,
        )  # fmt: skip
        return RestrictedFrame(
            vertices[:count].copy(), triangles[:n_triangles].copy(), places[:count].copy(),
            edges[:n_edges].copy(), error, followed.n_vertices, followed.n_touched,
            followed.n_changed, followed.tau,
        )  # fmt: skip

    def _mark(self, eye: Eye, threshold: float, limit: int, is_stepwise: bool) -> Marked:  # noqa: ARG002
        view, planes = self._view(eye), self._planes(eye)
        self._n_vertices, n_touched, n_changed = merge_vertices(
            self._errors, self.tile, self._is_active, self._n_children, self._active,
            self._on_screen, self._n_vertices, view, planes, threshold,
        )  # fmt: skip
        done = 0
        while done < self._n_vertices <= limit:
            if self._n_vertices + _ROOM > len(self._active):
                self._reserve()
            done, self._n_vertices, touched, changed = split_vertices(
                self._errors, self.tile, self._is_active, self._n_children, self._active,
                self._on_screen, (done, self._n_vertices), (limit, threshold), (view, planes),
                self._stack,
            )  # fmt: skip
            n_touched, n_changed = n_touched + touched, n_changed + changed
        return n_touched, n_changed, 0.0

    def _view(self, eye: Eye) -> NDArray[np.float64]:
        numbers = (
            *eye.position, *eye.forward, eye.focal, eye.slant, eye.z_scale,
            *self._range(eye), self._is_bound, *self._widths(),
            float(np.abs(eye.forward[:2]) @ self._widths()),
        )  # fmt: skip
        return np.array([*numbers, *self.matrix], dtype=np.float64)

    def _widths(self) -> tuple[float, float]:
        a, b, _, d, e, _ = self.matrix
        return abs(a) + abs(b), abs(d) + abs(e)

    def _range(self, eye: Eye) -> tuple[float, float]:
        """Return the lowest and highest drawn height."""
        low, high = sorted(height * eye.z_scale for height in self._limits)
        return low, high

    def _planes(self, eye: Eye) -> NDArray[np.float64]:
        """Return the view's planes for boxes that reach from the lowest to the highest height."""
        (low, high), normals = self._range(eye), eye.planes[:, :3]
        planes = np.empty((len(normals), 4))
        planes[:, :2] = normals[:, :2]
        planes[:, _CONSTANT] = np.maximum(normals[:, 2] * low, normals[:, 2] * high)
        planes[:, _CONSTANT] += eye.planes[:, 3]
        planes[:, _PER_REACH] = np.abs(normals[:, :2]) @ self._widths()
        return planes

    def screen_error(self, eye: Eye, row: int, col: int) -> float:
        """Return a vertex's error on screen, pixels."""
        error = float(self._errors[row, col])
        return float(screen_error(error, row, col, self.tile, self._view(eye), self._planes(eye)))


def _padded(
    values: NDArray[np.floating], shape: tuple[int, ...], beyond: float
) -> NDArray[np.float32]:
    padded = np.full(shape, beyond, dtype=np.float32)
    padded[: values.shape[0], : values.shape[1]] = values
    return padded


@kernel
def _stride_of(row, col, tile):
    """Return the stride of a vertex by its position; that of a tile's corners is `tile`."""
    both = row | col
    return min(both & -both, tile) if both else tile


@kernel
def screen_error(error, row, col, tile, view, planes):
    """Return the error on screen of a vertex with some error.

    The box covers all dependents of the vertex: 3 strides each way for centres, 2 for edges.
    """
    stride = _stride_of(row, col, tile)
    is_centre = row & stride and col & stride and stride < tile
    return error_in_box(error, row, col, (3 if is_centre else 2) * stride, view, planes)


@kernel
def error_in_box(error, row, col, reach, view, planes):
    """Return the error on screen in a box around a position: f ε / d; 0 outside the view.

    The box covers `reach` rows and columns each way. If errors are bounds, see
    `dynamic.screen_error`.
    """
    if error == 0:
        return 0.0
    x = view[_MATRIX] * col + view[_MATRIX + 1] * row + view[_MATRIX + 2]
    y = view[_MATRIX + 3] * col + view[_MATRIX + 4] * row + view[_MATRIX + 5]
    half_x, half_y = view[_WIDTH] * reach, view[_WIDTH + 1] * reach
    low, high = view[_LOW], view[_HIGH]
    half_z, away_z = (high - low) / 2, (high + low) / 2 - view[_Z]
    away_x, away_y = x - view[_X], y - view[_Y]
    for k in range(planes.shape[0]):
        most = planes[k, _ALONG_X] * x + planes[k, _ALONG_Y] * y + planes[k, _CONSTANT]
        if most + planes[k, _PER_REACH] * reach < 0:
            return 0.0
    near_x, near_y = max(abs(away_x) - half_x, 0.0), max(abs(away_y) - half_y, 0.0)
    near_z = max(abs(away_z) - half_z, 0.0)
    distance = np.sqrt(near_x * near_x + near_y * near_y + near_z * near_z)
    if distance == 0:
        return np.inf
    is_outline, error = error < 0, abs(error) * view[_Z_SCALE]
    if is_outline:
        error = np.sqrt(half_x * half_x + half_y * half_y + error * error)
    if view[_IS_BOUND] == 0:
        return view[_FOCAL] * error / distance
    depth = view[_FORWARD] * away_x + view[_FORWARD + 1] * away_y + view[_FORWARD + 2] * away_z
    depth -= view[_DEPTH_LESS] * reach + abs(view[_FORWARD + 2]) * half_z
    depth = max(depth, distance / view[_SLANT])
    far_x, far_y, far_z = abs(away_x) + half_x, abs(away_y) + half_y, abs(away_z) + half_z
    farthest = np.sqrt(far_x * far_x + far_y * far_y + far_z * far_z)
    return view[_FOCAL] * error * min(farthest / depth, view[_SLANT]) / depth


@kernel
def fill_shares(
    errors, tile, active, on_screen, vertex_of, view, planes, start, end, shares
):  # fmt: skip
    """Fill the share of the thresholds between `start` and `end` for which each vertex exists.

    `on_screen` has errors that are computed already, else NaN. A vertex exists only with all its
    dependencies, which come before it in `active`.
    """
    n_rows, n_cols = vertex_of.shape
    shares[:] = 0.0
    for number in range(active.shape[0] - 1, -1, -1):
        row, col = np.int64(active[number, 0]), np.int64(active[number, 1])
        if is_corner(row, col, tile):
            shares[number] = 1.0
            continue
        share = shares[number]
        if share < 1:
            pixels = on_screen[number]
            if np.isnan(pixels):
                error = np.float64(errors[row, col])
                pixels = screen_error(error, row, col, tile, view, planes)
            share = max(share, min((pixels - start) / (end - start), 1.0))
            shares[number] = share
        r2, c2, r3, c3 = needs_of(row, col, tile)
        for r, c in ((r2, c2), (r3, c3)):
            if 0 <= r < n_rows and 0 <= c < n_cols:
                needed = vertex_of[r, c]
                shares[needed] = max(shares[needed], share)


@kernel
def _child(row, col, tile, k):
    """Return the k-th of the four possible dependents of a vertex; -1 if it does not exist."""
    stride = _stride_of(row, col, tile)
    if not is_corner(row, col, tile) and row & stride and col & stride:
        down, right = ((-1, 0), (0, -1), (1, 0), (0, 1))[k]
        return row + down * stride, col + right * stride
    half = stride // 2
    if half == 0:
        return -1, -1
    return row + half * (2 * (k >> 1) - 1), col + half * (2 * (k & 1) - 1)


@kernel
def merge_vertices(
    errors, tile, is_active, n_children, active, on_screen, n_active, view, planes, tau
):
    """Merge vertices without dependents whose error is not above `tau`, the last first.

    Fill the errors on screen that this needs, NaN elsewhere. Return the numbers of vertices left,
    touched and merged. Dependencies of a merged vertex were split before it and come after it here.
    """
    n_touched = n_changed = 0
    for number in range(n_active - 1, -1, -1):
        row, col = np.int64(active[number, 0]), np.int64(active[number, 1])
        on_screen[number] = np.nan
        if n_children[row, col] or is_corner(row, col, tile):
            continue
        n_touched += 1
        error = np.float64(errors[row, col])
        on_screen[number] = screen_error(error, row, col, tile, view, planes)
        if on_screen[number] > tau:
            continue
        is_active[row, col] = False
        n_changed += 1
        r2, c2, r3, c3 = needs_of(row, col, tile)
        for r, c in ((r2, c2), (r3, c3)):
            if 0 <= r < is_active.shape[0] and 0 <= c < is_active.shape[1]:
                n_children[r, c] -= 1
    kept = 0
    for number in range(n_active):
        if is_active[active[number, 0], active[number, 1]]:
            active[kept, 0], active[kept, 1] = active[number, 0], active[number, 1]
            on_screen[kept] = on_screen[number]
            kept += 1
    return kept, n_touched, n_changed


@kernel
def split_vertices(
    errors, tile, is_active, n_children, active, on_screen, reached, limits, sight, stack
):
    """Split dependents of active vertices whose error is above `tau`, with their dependencies.

    `reached` is the vertex number to continue from and the number of active ones, `limits` the
    largest number and `tau`, `sight` the view and its planes. Continues while there is room in
    `active`. Return the next vertex and the numbers of active, touched and split ones.
    """
    (done, n_active), (limit, tau), (view, planes) = reached, limits, sight
    n_touched = n_changed = 0
    n_rows, n_cols = is_active.shape
    while done < n_active <= limit and n_active + _ROOM <= active.shape[0]:
        at_row, at_col = np.int64(active[done, 0]), np.int64(active[done, 1])
        done += 1
        if n_children[at_row, at_col] == 4:
            continue
        for k in range(4):
            row, col = _child(at_row, at_col, tile, k)
            if row < 0 or col < 0 or row >= n_rows or col >= n_cols or is_active[row, col]:
                continue
            r, c, _, _ = needs_of(row, col, tile)
            if (r != at_row or c != at_col) and 0 <= r < n_rows and 0 <= c < n_cols:
                if is_active[r, c]:
                    continue  # visited from there
            n_touched += 1
            error = np.float64(errors[row, col])
            pixels = screen_error(error, row, col, tile, view, planes)
            if pixels <= tau:
                continue
            n_more = _activate(row, col, tile, is_active, n_children, active, n_active, stack)
            on_screen[n_active : n_active + n_more] = np.nan
            n_active += n_more
            on_screen[n_active - 1] = pixels
            n_changed += n_more
    return done, n_active, n_touched, n_changed


@kernel
def _activate(row, col, tile, is_active, n_children, active, n_active, stack):
    """Append a vertex and all its inactive dependencies; return their number.

    Each one is appended after its own dependencies.
    """
    n_rows, n_cols = is_active.shape
    stack[0, 0], stack[0, 1] = row, col
    count, done = 1, 0
    while done < count:
        row, col = stack[done, 0], stack[done, 1]
        done += 1
        r2, c2, r3, c3 = needs_of(row, col, tile)
        for r, c in ((r2, c2), (r3, c3)):
            is_new = 0 <= r < n_rows and 0 <= c < n_cols and not is_active[r, c]
            for number in range(done, count):
                is_new = is_new and not (stack[number, 0] == r and stack[number, 1] == c)
            if is_new:
                stack[count, 0], stack[count, 1] = r, c
                count += 1
    n_new = 0
    for number in range(count - 1, -1, -1):
        row, col = stack[number, 0], stack[number, 1]
        if is_active[row, col]:
            continue  # reached by another path
        is_active[row, col] = True
        active[n_active + n_new, 0], active[n_active + n_new, 1] = row, col
        n_new += 1
        r2, c2, r3, c3 = needs_of(row, col, tile)
        for r, c in ((r2, c2), (r3, c3)):
            if 0 <= r < n_rows and 0 <= c < n_cols:
                n_children[r, c] += 1
    return n_new


@kernel
def draw_triangles(heights, tile, is_active, is_mirrored, vertex_of, stack, triangles):
    """Fill the triangles of the active vertices; return their number."""
    count = 0
    for row in range(0, is_active.shape[0] - 1, tile):
        for col in range(0, is_active.shape[1] - 1, tile):
            half = tile // 2
            r0, c0, r1, c1, r2, c2, r3, c3 = neighbours(row + half, col + half, half)
            for k in range(2):
                stack[k, 0], stack[k, 1], stack[k, 2], stack[k, 3] = r0, c0, r1, c1
                stack[k, 4], stack[k, 5] = (r3, c3) if k else (r2, c2)
            depth = 2
            while depth > 0:
                depth -= 1
                if split_top(is_active, stack, depth):
                    depth += 2
                    continue
                r0, c0, r1, c1 = stack[depth, 0], stack[depth, 1], stack[depth, 2], stack[depth, 3]
                r2, c2 = stack[depth, 4], stack[depth, 5]
                corners = (r0, c0), (r1, c1), (r2, c2)
                if not ((r0 + r1) & 1 or (c0 + c1) & 1):
                    count = _add(corners, is_mirrored, vertex_of, triangles, count)
                    continue
                r, c = min(r0, r1, r2), min(c0, c1, c2)
                valid = 0
                for k in range(4):
                    valid |= (not np.isnan(heights[r + (k >> 1), c + (k & 1)])) << k
                count = _add_in_quad(
                    corners, valid, is_mirrored, is_active, vertex_of, triangles, count
                )
    return count


@kernel
def _add(corners, is_mirrored, vertex_of, triangles, count):
    """Append a triangle without void corners; return the new count."""
    (r0, c0), (r1, c1), (r2, c2) = corners
    if vertex_of[r0, c0] < 0 or vertex_of[r1, c1] < 0 or vertex_of[r2, c2] < 0:
        return count
    if (area_of(r0, c0, r1, c1, r2, c2) > 0) == is_mirrored:
        r1, c1, r2, c2 = r2, c2, r1, c1
    triangles[count, 0], triangles[count, 1] = vertex_of[r0, c0], vertex_of[r1, c1]
    triangles[count, 2] = vertex_of[r2, c2]
    return count + 1


@kernel
def _add_in_quad(corners, valid, is_mirrored, is_active, vertex_of, triangles, count):
    """Append one half of a quad of samples; with one void corner, the triangle of the other three.

    `valid` has a bit for each valid corner, row by row. That triangle is appended with the first
    half.
    """
    if valid == 15:
        return _add(corners, is_mirrored, vertex_of, triangles, count)
    (r0, c0), (r1, c1), (r2, c2) = corners
    top, left = min(r0, r1, r2), min(c0, c1, c2)
    is_nw, is_ne, is_sw, is_se = valid & 1, valid & 2, valid & 4, valid & 8
    n_valid = int(is_nw != 0) + int(is_ne != 0) + int(is_sw != 0) + int(is_se != 0)
    n_top = int(r0 == top) + int(r1 == top) + int(r2 == top)
    if n_valid < 3 or n_top < 2 or not is_active[top : top + 2, left : left + 2].all():
        return count
    # A void corner is replaced by the opposite one.
    r0, c0 = (top, left) if is_nw else (top + 1, left + 1)
    r1, c1 = (top, left + 1) if is_ne else (top + 1, left)
    r2, c2 = (top + 1, left) if is_sw and is_ne else (top + 1, left + 1)
    return _add(((r0, c0), (r1, c1), (r2, c2)), is_mirrored, vertex_of, triangles, count)


@kernel
def follow_borders(
    open_sides, shape, heights, is_active, vertex_of, vertices, z_scale, matrix, planes, edges
):
    """Fill the edges along open sides; return their number, and the largest error in view.

    Without the factor of heights.
    """
    found = 0, 0.0
    for side in range(4):
        if open_sides[side]:
            place = 0 if side < 2 else shape[side - 2] - 1
            line = place, side & 1, shape[0] if side & 1 else shape[1]
            found = _follow_border(
                line, heights, is_active, vertex_of, vertices, z_scale, matrix, planes, edges, found
            )
    return found[0], found[1] / z_scale


@kernel
def _follow_border(
    line, heights, is_active, vertex_of, vertices, z_scale, matrix, planes, edges, found
):
    """Append the edges along one side; return the new count, and the largest distance.

    `line` is its row or column, whether it goes down, and its number of samples; `found` is the
    result for earlier sides.
    """
    (place, down, n_samples), (count, largest) = line, found
    before, start, right = -1, 0, 1 - down
    first_row, first_col = (0, place) if down else (place, 0)
    ends = np.empty((4, 3))
    for at in range(n_samples):
        row, col = first_row + at * down, first_col + at * right
        if np.isnan(heights[row, col]):
            before = -1
            continue
        if not is_active[row, col]:
            continue
        vertex = vertex_of[row, col]
        if before >= 0:
            edges[count, 0], edges[count, 1] = before, vertex
            count += 1
            rise = (vertices[vertex, 2] - vertices[before, 2]) / (at - start)
            for k in range(start, at):
                apart = 0.0
                for m in range(2):
                    r, c = first_row + (k + m) * down, first_col + (k + m) * right
                    drawn = vertices[before, 2] + (k + m - start) * rise
                    original = heights[r, c] * z_scale
                    ends[m, 2], ends[2 + m, 2] = drawn, original
                    ends[m, 0] = matrix[0] * c + matrix[1] * r + matrix[2]
                    ends[m, 1] = matrix[3] * c + matrix[4] * r + matrix[5]
                    ends[2 + m, 0], ends[2 + m, 1] = ends[m, 0], ends[m, 1]
                    apart = max(apart, abs(drawn - original))
                if apart > largest and not _are_hidden(ends, planes):
                    largest = apart
        before, start = vertex, at
    return count, largest


@kernel
def _are_hidden(points, planes):
    """Return which points lie wholly behind one of the planes."""
    for k in range(planes.shape[0]):
        is_behind = True
        for m in range(points.shape[0]):
            most = planes[k, 0] * points[m, 0] + planes[k, 1] * points[m, 1]
            is_behind = is_behind and most + planes[k, 2] * points[m, 2] + planes[k, 3] < 0
        if is_behind:
            return True
    return False
