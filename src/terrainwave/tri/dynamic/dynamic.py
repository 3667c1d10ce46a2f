"""Dynamic triangulation: selection of a Haar quadtree's nodes to draw, and their mesh.

E. Yusov, V. Turlapov, "Dynamic terrain simplification based on Haar transform and vertices
quadtree" (Graphicon 2006), §3.3-3.6. Each sample has one root above it: a node whose error on
screen is below τ, and that of all nodes below it. The mesh is the full grid's in which every sample
has moved to its root, without the triangles that have become degenerate. Neighbours may differ by
any number of heights, in one patch and across patches, without cracks. Nothing folds: around a
corner of cells, their centres lie in one quadrant each, on its diagonal.

Marking: from the leaves up over all nodes, once (`mark_bottom_up`); then, from frame to frame, from
the patches' roots down to what may change (`mark_top_down`): one height at a time, as printed in
the paper, or until nothing changes. With the measured error all three
give the same result from any state, because no node's error on screen is below that of one under
it.

Fans (`fans`) join the roots of one mesh, and of meshes side by side (`draw_together`).

Where we depart from the paper: the morph lies below the threshold of merging, τ / λ … τ, so that it
keeps within τ (as printed it goes to λτ and beyond), and ends where the parent is drawn, which may
be moving itself (as printed it ends at the parent's position and jumps if that one moves).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import inlined_kernel, kernel
from terrainwave.tri.dynamic.fans import (
    BELOW,
    INNER,
    NOBODY,
    ROOT,
    VOID,
    Forest,
    count_corners,
    draw_fans,
    fill_rim,
    forest_of,
    leave_rings,
    number_corners,
)
from terrainwave.tri.dynamic.haar import (
    ERROR,
    FIRST,
    HIGH,
    LOW,
    N_COLS,
    N_ROWS,
    HaarTree,
    build_tree,
)
from terrainwave.tri.followed import CLOSED, Eye, Followed, FollowingMesh, Marked
from terrainwave.tri.scratch import Scratch

# Fields of a view as an array: position and direction of the eye; focal length; largest distance by
# depth; factor of heights; addend of errors; half the width of boxes in cells; whether errors are
# bounds; x and y of samples.
_X, _Y, _Z, _FORWARD, _FOCAL, _SLANT, _Z_SCALE, _BASE, _REACH = 0, 1, 2, 3, 6, 7, 8, 9, 10
_IS_BOUND, _MATRIX = 11, 12
_FIRST_CAPACITY = 4096


class DynamicFrame(NamedTuple):
    """A mesh for one view; the last four fields are those of `Followed`."""

    vertices: NDArray[np.float64]  # shape (n_vertices, 3); heights times the view's factor
    # shape (n_triangles, 3); counter-clockwise seen from above; a root's fan is consecutive
    triangles: NDArray[np.int32]
    nodes: NDArray[np.int32]  # shape (n_vertices, 3); height, row and column of each one's node
    edges: NDArray[np.int32]  # shape (n_edges, 2); vertices of the edges along open sides
    threshold: float
    tau: float
    n_touched: int
    n_changed: int


class DynamicMesh(FollowingMesh[DynamicFrame]):
    """A raster's mesh that follows a camera. Used by one thread.

    `update` costs O(nodes on screen).
    """

    def __init__(
        self,
        heights: NDArray[np.floating],  # shape (n_rows, n_cols)
        *,
        mask: NDArray[np.bool_] | None = None,  # True for valid samples; None: all that are finite
        sample_matrix: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0),
        patch: int = 256,  # samples per side of a patch: a power of two
        # {"measured", "paper"}; see `haar`: a bound for every sample, with the worst direction and
        # distance of the node's box; or Haar coefficients with the direction to the node, as
        # printed
        error: str = "measured",
        # largest distance of `heights` from the reference of errors; added to measured errors
        base_error: float = 0.0,
        # `open_sides, is_surface`: see `haar.build_tree`
        open_sides: tuple[bool, bool, bool, bool] = CLOSED,
        is_surface: bool = False,
        scratch: Scratch | None = None,
    ) -> None:
        super().__init__(sample_matrix, scratch)
        self.tree: HaarTree = build_tree(
            heights, mask, patch=patch, error=error, open_sides=open_sides, is_surface=is_surface
        )
        # shape (n_nodes,); `INNER`, `ROOT` or, below a root, `BELOW`
        self.marks: NDArray[np.uint8] = np.full(len(self.tree.z), BELOW, dtype=np.uint8)
        layout = self.tree.layout
        self.marks[layout[-1, FIRST] :] = ROOT
        self._is_bound, self._open_sides = error == "measured", open_sides
        self.base_error = base_error + self.tree.rounding if self._is_bound else 0.0
        self._stack = np.empty((4 * len(layout), 3), dtype=np.int64)
        self._places = np.empty((4 * len(layout), 4))
        # shape (patch rows, patch columns); patches with changed marks; cleared by the user of a
        # copy of the marks
        self.has_changed: NDArray[np.uint8] = np.ones(
            tuple(layout[-1, N_ROWS:].tolist()), dtype=np.uint8
        )
        self._is_marked = False

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns of samples, including those that fill the last patches up."""
        n_rows, n_cols = self.tree.layout[0, N_ROWS:].tolist()
        return n_rows, n_cols

    @property
    def n_nodes(self) -> int:
        return len(self.marks)

    @property
    def least_vertices(self) -> int:
        return int(self.tree.layout[-1, N_ROWS] * self.tree.layout[-1, N_COLS])

    def largest_error(self, eye: Eye, followed: Followed) -> float:
        """Return the largest vertical distance of the drawn mesh in view from `heights`.

        0 without open sides. In their unit, without the view's factor. If errors are not bounds,
        the largest range of heights under one triangle.
        """
        tree = self.tree
        error: float = largest_error_in_view(
            any(self._open_sides), tree.layout, tree.z, tree.bounds, self._view(eye), eye.planes,
            followed.tau, self._stack, self.marks,
        )  # fmt: skip
        return error

    def draw(self, eye: Eye, followed: Followed) -> DynamicFrame:
        (frame,) = draw_together([ForestPart(self, followed)], eye)
        return frame

    def _mark(self, eye: Eye, threshold: float, limit: int, is_stepwise: bool) -> Marked:  # noqa: ARG002
        tree, view, planes = self.tree, self._view(eye), eye.planes
        if not self._is_marked:
            self._is_marked = True
            mark_bottom_up(tree.layout, tree.z, tree.bounds, view, planes, threshold, self.marks)
            self._n_vertices = int(np.count_nonzero((self.marks == ROOT) & ~np.isnan(tree.z)))
            self.has_changed[...] = True
            return self.n_nodes, int(np.count_nonzero(self.marks == ROOT)), 0.0
        n_touched, n_changed, n_more, largest = mark_top_down(
            tree.layout, tree.z, tree.bounds, view, planes, threshold, is_stepwise, self._stack,
            self.marks, self.has_changed,
        )  # fmt: skip
        self._n_vertices += n_more
        return n_touched, n_changed, largest

    def place(
        self,
        eye: Eye,
        followed: Followed,
        is_drawn: NDArray[np.bool_],
        first_vertex: int,
        vertex_of: NDArray[np.int32],
    ) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Return the vertices of roots in some trees, and their nodes; then void roots.

        Fills `vertex_of`, with numbers from `first_vertex`.
        """
        tree, capacity = self.tree, max(2 * self._n_vertices, _FIRST_CAPACITY)
        while True:
            nodes = self._scratch.take("nodes", (capacity, 3), np.int32)
            vertices = self._scratch.take("vertices", (capacity, 3), np.float64)
            n_vertices, n_voids = place_vertices(
                tree.layout, tree.z, tree.bounds, self.marks, (self._view(eye), eye.planes),
                (followed.threshold, followed.tau), (self._stack, self._places),
                (is_drawn, first_vertex), vertex_of, (nodes, vertices),
            )  # fmt: skip
            if n_vertices + n_voids <= capacity:
                break
            capacity = 2 * (n_vertices + n_voids)
        both = np.concatenate([nodes[:n_vertices], nodes[capacity - n_voids :]])
        return vertices[:n_vertices].copy(), both

    def _view(self, eye: Eye) -> NDArray[np.float64]:
        numbers = (
            *eye.position, *eye.forward, eye.focal, eye.slant, eye.z_scale, self.base_error,
            self.tree.reach, self._is_bound,
        )  # fmt: skip
        return np.array([*numbers, *self.matrix], dtype=np.float64)


class ForestPart(NamedTuple):
    """A mesh among others of the same samples, next to each other."""

    mesh: DynamicMesh  # all have trees of one size, arranged in the plane like their trees
    followed: Followed  # what `follow` returned
    first: tuple[int, int] = (0, 0)  # row and column of its first tree, from a common origin
    # rows and columns of the trees that only this mesh draws. Adjacent ones are drawn where no mesh
    # owns a tree. Measured errors equal those of a single mesh if the mesh has the trees next to
    # these, too.
    owned: tuple[slice, slice] = (slice(None), slice(None))


def draw_together(parts: list[ForestPart], eye: Eye) -> list[DynamicFrame]:
    """Return one mesh of the marks of several, a frame for each.

    Where they meet, fans join them as they join the trees of each, without gaps or overlaps. Of
    trees without an owner only the triangles with a corner in an owned tree are drawn: they cover
    the owned trees, and end at most half a tree beyond them.

    The triangles of a fan belong to its root. Vertices from another mesh come last in the frame,
    with nodes that count from its own first one; they lie where that mesh has them.
    """
    meshes = [part.mesh for part in parts]
    mesh, top = meshes[0], meshes[0].tree.top
    layouts = [mesh.tree.layout for mesh in meshes]
    starts = np.cumsum([0, *(len(mesh.marks) for mesh in meshes)])
    vertex_of = mesh._scratch.take("vertex_of", (int(starts[-1]),), np.int32)
    forest, firsts = forest_of(
        layouts, [part.first for part in parts], [part.owned for part in parts],
        [mesh.marks for mesh in meshes], vertex_of,
    )  # fmt: skip
    vertices, nodes, numbers = [], [], [0]
    for k, (part, (row, col)) in enumerate(zip(parts, firsts, strict=True)):
        n_rows, n_cols = layouts[k][-1, N_ROWS:]
        is_drawn = forest.owners[row : row + n_rows, col : col + n_cols] == k
        own, own_nodes = part.mesh.place(
            eye, part.followed, is_drawn.ravel(), numbers[-1], vertex_of[starts[k] : starts[k + 1]]
        )
        vertices.append(own)
        nodes.append(_moved(own_nodes, top, row, col))
        numbers.append(numbers[-1] + len(own))
    is_ring = np.concatenate(
        [_are_in_rings(forest, n[: len(v)], top) for n, v in zip(nodes, vertices, strict=True)]
    )
    rims = _rims(forest, mesh._open_sides)
    triangles, ends, gone = [], [rims[~is_ring[rims[:, :2]].all(axis=1)]], [rims[:, :2]]
    for k, (layout, own_nodes) in enumerate(zip(layouts, nodes, strict=True)):
        # Neighbours along all sides may be samples.
        capacity = 2 * (len(own_nodes) + 2 * int(layout[0, N_ROWS:].sum()) + 8)
        room = mesh._scratch.take("triangles", (capacity, 3), np.int32)
        n = draw_fans(forest, own_nodes, mesh.is_mirrored, mesh._stack, room)
        edges = mesh._scratch.take("edges", (4 * n, 2), np.int32)
        n, n_ends, n_gone = leave_rings(room[:n], is_ring, edges)
        triangles.append(room[:n].copy())
        ends.append(np.insert(edges[:n_ends], 2, k, axis=1))
        gone.append(edges[len(edges) - n_gone :].copy())
    edges = np.concatenate(ends)
    is_end = np.isin(_keys(edges[:, :2], len(is_ring)), _keys(np.concatenate(gone), len(is_ring)))
    edges = edges[is_end]
    all_vertices = np.concatenate(vertices)
    all_nodes = np.concatenate([n[: len(v)] for n, v in zip(nodes, vertices, strict=True)])
    number_of = mesh._scratch.take("number_of", (len(is_ring),), np.int32)
    which = mesh._scratch.take("which", (len(is_ring),), np.int32)
    frames = []
    for k, (part, (row, col)) in enumerate(zip(parts, firsts, strict=True)):
        own_edges = edges[edges[:, 2] == k, :2].copy()
        n = count_corners(numbers[k], numbers[k + 1], is_ring, number_of, which)
        n = number_corners(triangles[k], n, number_of, which)
        n = number_corners(own_edges, n, number_of, which)
        frames.append(
            DynamicFrame(
                all_vertices[which[:n]],
                triangles[k],
                _moved(all_nodes[which[:n]], top, -row, -col),
                own_edges,
                *part.followed[:2],
                part.followed.n_touched,
                part.followed.n_changed,
            )
        )
    return frames


def _are_in_rings(forest: Forest, nodes: NDArray[np.int32], top: int) -> NDArray[np.bool_]:
    """Return which nodes' trees are in rings."""
    if not forest.is_ring.any():
        return np.zeros(len(nodes), dtype=np.bool_)
    shift = top - nodes[:, 0]
    found: NDArray[np.bool_] = forest.is_ring[nodes[:, 1] >> shift, nodes[:, 2] >> shift]
    return found


def _keys(edges: NDArray[np.int32], n_vertices: int) -> NDArray[np.int64]:
    """Return a number for each edge, independent of its direction."""
    a, b = edges.T.astype(np.int64)
    return np.minimum(a, b) * n_vertices + np.maximum(a, b)


def _moved(nodes: NDArray[np.int32], top: int, row: int, col: int) -> NDArray[np.int32]:
    """Return nodes moved by `row` and `col` trees."""
    shift = top - nodes[:, :1]
    return nodes + np.concatenate([0 * shift, row << shift, col << shift], axis=1)


def _rims(forest: Forest, open_sides: tuple[bool, bool, bool, bool]) -> NDArray[np.int32]:
    if not any(open_sides):
        return np.empty((0, 3), dtype=np.int32)
    is_here = np.pad(forest.owners != NOBODY, 1)
    n_sides = sum(
        int((is_here & ~np.roll(is_here, by, axis)).sum()) for by in (1, -1) for axis in (0, 1)
    )
    top = forest.places.shape[1] - 1
    edges = np.empty((n_sides * ((1 << top) + 2), 3), dtype=np.int32)
    return edges[: fill_rim(open_sides, forest, edges)]


@inlined_kernel
def screen_error(height, row, col, layout, z, bounds, view, planes):
    """Return the error on screen of a node of height >= 1, in pixels; 0 outside the view (§3.3).

    ε_scr = f ε √(1 - (e_P · e_h)²) / d, d from the eye to the nearest point of the node's box, e_P
    the direction to the node and e_h up. That is exact on the axis of the view. For a bound, the
    root is that of the box's point seen most from the side, and d becomes depth² / distance: the
    largest singular value of a projection's derivative is f distance / depth².
    """
    node = layout[height, FIRST] + row * layout[height, N_COLS] + col
    middle = z[node]
    if np.isnan(middle):
        return 0.0
    inner = node - layout[1, FIRST]
    error, z_scale = np.float64(bounds[inner, ERROR]), view[_Z_SCALE]
    low, high = bounds[inner, LOW] * z_scale, bounds[inner, HIGH] * z_scale
    side = 1 << height
    down, right = (row + 0.5) * side - 0.5, (col + 0.5) * side - 0.5
    x = view[_MATRIX] * right + view[_MATRIX + 1] * down + view[_MATRIX + 2]
    y = view[_MATRIX + 3] * right + view[_MATRIX + 4] * down + view[_MATRIX + 5]
    half = side * view[_REACH]
    half_x = (abs(view[_MATRIX]) + abs(view[_MATRIX + 1])) * half
    half_y = (abs(view[_MATRIX + 3]) + abs(view[_MATRIX + 4])) * half
    if _is_hidden(planes, x, y, half_x, half_y, low, high, view[_IS_BOUND] == 0):
        return 0.0
    away_x, away_y = x - view[_X], y - view[_Y]
    apart_x, apart_y = abs(away_x), abs(away_y)
    near_x, near_y = max(apart_x - half_x, 0.0), max(apart_y - half_y, 0.0)
    near_z = max(low - view[_Z], view[_Z] - high, 0.0)
    distance = np.sqrt(near_x * near_x + near_y * near_y + near_z * near_z)
    if distance == 0:
        return np.inf
    half_z = (high - low) / 2
    size = np.sqrt(half_x * half_x + half_y * half_y + 4 * half_z * half_z)
    if view[_IS_BOUND] == 0:
        if error < 0:
            return view[_FOCAL] * size / distance
        across = np.sqrt(apart_x * apart_x + apart_y * apart_y)
        along = middle * z_scale - view[_Z]
        sine = across / max(np.sqrt(across * across + along * along), distance)
        return view[_FOCAL] * error * z_scale * sine / distance
    far_x, far_y = apart_x + half_x, apart_y + half_y
    far_z = max(high - view[_Z], view[_Z] - low)
    across = far_x * far_x + far_y * far_y
    depth = view[_FORWARD] * away_x + view[_FORWARD + 1] * away_y
    depth += view[_FORWARD + 2] * (low + half_z - view[_Z])
    depth -= abs(view[_FORWARD]) * half_x + abs(view[_FORWARD + 1]) * half_y
    depth = max(depth - abs(view[_FORWARD + 2]) * half_z, distance / view[_SLANT])
    ratio = min(np.sqrt(across + far_z * far_z) / depth, view[_SLANT])
    scale = view[_FOCAL] * ratio / depth
    base = view[_BASE] * z_scale
    if error < 0:
        return scale * (size + base)
    return scale * (error * z_scale + base) * np.sqrt(across / (across + near_z * near_z))


@inlined_kernel
def _is_hidden(planes, x, y, half_x, half_y, low, high, is_sphere):
    """Return whether a box, or the sphere around it, lies wholly behind one of the planes."""
    mid_z, half_z = (low + high) / 2, (high - low) / 2
    radius = np.sqrt(half_x * half_x + half_y * half_y + half_z * half_z) if is_sphere else 0.0
    for k in range(planes.shape[0]):
        most = planes[k, 0] * x + planes[k, 1] * y + planes[k, 2] * mid_z + planes[k, 3]
        if is_sphere:
            most += radius
        else:
            most += abs(planes[k, 0]) * half_x + abs(planes[k, 1]) * half_y
            most += abs(planes[k, 2]) * half_z
        if most < 0:
            return True
    return False


@kernel
def _first_child(height, row, col, layout):
    """Return the number of a node's first child, and the offset of its third."""
    n_cols = layout[height - 1, N_COLS]
    return layout[height - 1, FIRST] + 2 * row * n_cols + 2 * col, n_cols


@kernel
def _are_roots(child, down, marks):
    return (
        marks[child] == ROOT
        and marks[child + 1] == ROOT
        and marks[child + down] == ROOT
        and marks[child + down + 1] == ROOT
    )


@kernel
def _mark_children(child, down, mark, marks):
    marks[child] = marks[child + 1] = marks[child + down] = marks[child + down + 1] = mark


@kernel
def _n_valid(child, down, z):
    """Return the number of valid ones among four children."""
    n_void = int(np.isnan(z[child])) + int(np.isnan(z[child + 1]))
    return 4 - n_void - int(np.isnan(z[child + down])) - int(np.isnan(z[child + down + 1]))


@kernel
def _merge(node, child, down, z, marks):
    """Make a node the root of its children; return the change in the number of valid roots."""
    marks[node] = ROOT
    _mark_children(child, down, BELOW, marks)
    return 0 if np.isnan(z[node]) else 1 - _n_valid(child, down, z)


@kernel
def _split(node, child, down, z, marks):
    """Make the children of a valid root roots; return as `_merge`."""
    marks[node] = INNER
    _mark_children(child, down, ROOT, marks)
    return _n_valid(child, down, z) - 1


@kernel
def mark_bottom_up(layout, z, bounds, view, planes, tau, marks):
    """Mark all nodes (NonRecursiveDetermineNullSubTrees, §3.4)."""
    marks[: layout[1, FIRST]] = ROOT
    for height in range(1, layout.shape[0]):
        first, n_rows, n_cols = layout[height]
        for row in range(n_rows):
            for col in range(n_cols):
                node = first + row * n_cols + col
                child, down = _first_child(height, row, col, layout)
                marks[node] = INNER
                if _are_roots(child, down, marks) and (
                    screen_error(height, row, col, layout, z, bounds, view, planes) < tau
                ):
                    marks[node] = ROOT
                    _mark_children(child, down, BELOW, marks)


@kernel
def _push_patch(patch, layout, stack):
    """Push the root of a patch, counted row by row, on the empty stack."""
    n_cols = layout[-1, N_COLS]
    stack[0, 0] = layout.shape[0] - 1
    stack[0, 1], stack[0, 2] = patch // n_cols, patch % n_cols
    return 1


@kernel
def _push_children(height, row, col, stack, depth):
    for k in range(4):
        stack[depth + k, 0] = height - 1
        stack[depth + k, 1], stack[depth + k, 2] = 2 * row + (k >> 1), 2 * col + (k & 1)
    return depth + 4


@kernel
def mark_top_down(
    layout, z, bounds, view, planes, tau, is_stepwise, stack, marks, has_changed
):  # fmt: skip
    """Change marks until a step would change nothing, in one walk (§3.4).

    With `is_stepwise` by one height at most (RecursiveDetermineNullSubTrees). Otherwise a node that
    is no longer a root is visited again with its children; a node whose children all became roots
    is visited again after them: `~row` on the stack means "after".

    Return the numbers of touched nodes and of changed roots, the change in the number of valid
    roots, and the largest error of divided roots whose children were not visited: those below them
    have no larger one if errors are bounds. `has_changed` is set for patches with changes.
    """
    n_touched = n_changed = n_more = 0
    largest = 0.0
    for patch in range(layout[-1, N_ROWS] * layout[-1, N_COLS]):
        n_before = n_changed
        depth = _push_patch(patch, layout, stack)
        while depth > 0:
            depth -= 1
            height, row, col = stack[depth, 0], stack[depth, 1], stack[depth, 2]
            is_after = row < 0
            if is_after:
                row = ~row
            else:
                n_touched += 1
            if height == 0:
                continue
            node = layout[height, FIRST] + row * layout[height, N_COLS] + col
            child, down = _first_child(height, row, col, layout)
            is_root = marks[node] == ROOT
            may_merge = (is_after or is_stepwise) and not is_root
            may_merge = may_merge and _are_roots(child, down, marks)
            if is_root or may_merge:
                error = screen_error(height, row, col, layout, z, bounds, view, planes)
                if may_merge and error < tau:
                    n_more += _merge(node, child, down, z, marks)
                    n_changed += 5
                if is_after or error < tau:
                    continue
                if is_root and is_stepwise and not error > tau:
                    continue
                if is_root:
                    n_more += _split(node, child, down, z, marks)
                    n_changed += 5
                    if is_stepwise:
                        largest = max(largest, error)
                        continue
            elif is_after:
                continue
            elif not is_stepwise:
                stack[depth, 0], stack[depth, 1], stack[depth, 2] = height, ~row, col
                depth += 1
            if height > 1 or is_stepwise:
                depth = _push_children(height, row, col, stack, depth)
        if n_changed > n_before:
            has_changed[patch // layout[-1, N_COLS], patch % layout[-1, N_COLS]] = 1
    return n_touched, n_changed, n_more, largest


@kernel
def largest_error_in_view(
    is_needed, layout, z, bounds, view, planes, tau, stack, marks
):  # fmt: skip
    """Return the largest error of nodes in view that are drawn, or that others move to.

    These are roots and nodes whose error on screen is below `tau`; no node below them has a larger
    error. Near an outline, and if errors are not bounds, the range of heights counts.
    """
    largest = 0.0
    if not is_needed:
        return largest
    for patch in range(layout[-1, N_ROWS] * layout[-1, N_COLS]):
        depth = _push_patch(patch, layout, stack)
        while depth > 0:
            depth -= 1
            height, row, col = stack[depth, 0], stack[depth, 1], stack[depth, 2]
            if height == 0:
                continue
            on_screen = screen_error(height, row, col, layout, z, bounds, view, planes)
            if on_screen == 0:
                continue
            node = layout[height, FIRST] + row * layout[height, N_COLS] + col
            if marks[node] == INNER and on_screen >= tau:
                depth = _push_children(height, row, col, stack, depth)
                continue
            inner = node - layout[1, FIRST]
            error = np.float64(bounds[inner, ERROR])
            if error < 0 or view[_IS_BOUND] == 0:
                error = np.float64(bounds[inner, HIGH]) - np.float64(bounds[inner, LOW])
            largest = max(largest, error)
    return largest


@kernel
def place_vertices(
    layout, z, bounds, marks, sight, morph, scratch, trees, vertex_of, roots
):  # fmt: skip
    """Fill nodes and positions of roots; return the number of vertices, and of void roots.

    A node whose parent P has the error ε on screen is drawn at α of its own position and 1 - α of
    the drawn position of P, α = (ε - start) / (end - start) within 0 … 1 (§3.6). `sight` is the
    view and the planes, `morph` start and end, `scratch` the stack and positions that wait on it;
    `trees` selects the trees, and gives the number of the first vertex. Void roots come last in
    `nodes`, from its end backwards. If both together exceed it, some are not written.
    """
    (view, planes), (start, end), (stack, places) = sight, morph, scratch
    (is_drawn, first_vertex), (nodes, vertices) = trees, roots
    count, n_voids, limit = 0, 0, nodes.shape[0]
    z_scale = view[_Z_SCALE]
    for patch in range(layout[-1, N_ROWS] * layout[-1, N_COLS]):
        if not is_drawn[patch]:
            continue
        depth = _push_patch(patch, layout, stack)
        places[0, 3] = 1.0
        while depth > 0:
            depth -= 1
            height, row, col = stack[depth, 0], stack[depth, 1], stack[depth, 2]
            node = layout[height, FIRST] + row * layout[height, N_COLS] + col
            if np.isnan(z[node]):  # a root: its error is 0
                vertex_of[node] = VOID
                if n_voids < limit:
                    place = limit - 1 - n_voids
                    nodes[place, 0], nodes[place, 1], nodes[place, 2] = height, row, col
                n_voids += 1
                continue
            share = places[depth, 3]
            side = 1 << height
            down, right = (row + 0.5) * side - 0.5, (col + 0.5) * side - 0.5
            x = view[_MATRIX] * right + view[_MATRIX + 1] * down + view[_MATRIX + 2]
            y = view[_MATRIX + 3] * right + view[_MATRIX + 4] * down + view[_MATRIX + 5]
            up = z[node] * z_scale
            if share < 1:
                x = share * x + (1 - share) * places[depth, 0]
                y = share * y + (1 - share) * places[depth, 1]
                up = share * up + (1 - share) * places[depth, 2]
            if marks[node] == ROOT:
                if count < limit:
                    vertex_of[node] = first_vertex + count
                    nodes[count, 0], nodes[count, 1], nodes[count, 2] = height, row, col
                    vertices[count, 0], vertices[count, 1], vertices[count, 2] = x, y, up
                count += 1
                continue
            share = 1.0
            if end > start:
                error = screen_error(height, row, col, layout, z, bounds, view, planes)
                share = min(max((error - start) / (end - start), 0.0), 1.0)
            for k in range(4):
                places[depth + k, 0], places[depth + k, 1] = x, y
                places[depth + k, 2], places[depth + k, 3] = up, share
            depth = _push_children(height, row, col, stack, depth)
    return count, n_voids
