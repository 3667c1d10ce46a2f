"""Fans: the triangles of the roots of quadtrees, of one mesh or of several adjacent ones.

E. Yusov, V. Turlapov 2006, §3.5. Each root draws the triangles in which it is the largest corner,
or the north-west one of four; its sides in the order top, left, bottom, right. A divided neighbour
gives the nodes along its facing border; a root gives itself; a part of a larger root is left to
that root. So a mesh draws the strips to its right and lower neighbours, and reads only their marks:
a fan does not depend on which mesh owns its nodes' trees.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import inlined_kernel, kernel
from terrainwave.tri.dynamic.haar import FIRST, N_COLS

# NotNullNode, NullSubTreeRoot, NullSubTreeSubNode: nodes above roots, roots, nodes below them.
INNER, ROOT, BELOW = 0, 1, 2
# In `Forest.owners`: there is no tree. In `Forest.vertex_of`: a root is void.
NOBODY, VOID = -1, -1
# Sides of a cell in the order of fans, and the direction of the neighbour.
_TOP, _LEFT, _BOTTOM, _RIGHT = 0, 1, 2, 3
_DOWN, _ACROSS = (-1, 0, 1, 0), (0, -1, 0, 1)


class Forest(NamedTuple):
    """The trees of adjacent meshes, all of one size. Rows and columns count over all of them."""

    # shape (n_tree_rows, n_tree_cols); the mesh that draws a tree, or `NOBODY`
    owners: NDArray[np.int32]
    is_ring: NDArray[np.bool_]  # same shape; trees around those that meshes own
    # shape (n_meshes, top + 1, 2); for each height the number of the forest's first node, and the
    # increment to the next row
    places: NDArray[np.int64]
    marks: NDArray[np.uint8]  # shape (n_nodes,); of the nodes of all meshes
    vertex_of: NDArray[np.int32]  # shape (n_nodes,); for roots; `VOID` for void ones


def forest_of(
    layouts: list[NDArray[np.int64]],
    first_trees: list[tuple[int, int]],
    owned: list[tuple[slice, slice]],
    marks: list[NDArray[np.uint8]],
    vertex_of: NDArray[np.int32],
) -> tuple[Forest, list[tuple[int, int]]]:
    """Return the forest of meshes, and the position of the first tree of each.

    `layouts` and `marks` are those of each mesh, `first_trees` row and column of its first tree
    from a common origin, `owned` the trees, in rows and columns, that it draws in any case.
    Adjacent ones are a ring: drawn where no mesh has a tree of its own; by the first mesh, if there
    are several. Trees further out are not drawn. The caller fills `vertex_of` for all nodes.
    """
    shapes = [tuple(layout[-1, 1:].tolist()) for layout in layouts]
    least = [min(first[axis] for first in first_trees) for axis in (0, 1)]
    firsts = [(row - least[0], col - least[1]) for row, col in first_trees]
    ends = [np.add(first, shape) for first, shape in zip(firsts, shapes, strict=True)]
    owners = np.full(np.max(ends, axis=0), NOBODY, dtype=np.int32)
    wholes = [
        owners[row : row + n_rows, col : col + n_cols]
        for (row, col), (n_rows, n_cols) in zip(firsts, shapes, strict=True)
    ]
    for number, (whole, own) in enumerate(zip(wholes, owned, strict=True)):
        whole[own] = number
    is_ring = owners == NOBODY
    for number, (whole, own) in enumerate(zip(wholes, owned, strict=True)):
        near = whole[tuple(_wider(part) for part in own)]
        near[near == NOBODY] = number
    top = len(layouts[0]) - 1
    places, n_before = np.empty((len(layouts), top + 1, 2), dtype=np.int64), 0
    for number, (layout, (row, col)) in enumerate(zip(layouts, firsts, strict=True)):
        for height in range(top + 1):
            width = int(layout[height, N_COLS])
            skipped = (row << (top - height)) * width + (col << (top - height))
            places[number, height] = n_before + int(layout[height, FIRST]) - skipped, width
        n_before += len(marks[number])
    together = marks[0] if len(marks) == 1 else np.concatenate(marks)
    return Forest(owners, is_ring, places, together, vertex_of), firsts


def _wider(part: slice) -> slice:
    return part if part == slice(None) else slice(max(part.start - 1, 0), part.stop + 1)


@inlined_kernel
def _node(height, row, col, forest):
    """Return the number of a node, -1 if no mesh draws its tree."""
    shift = forest.places.shape[1] - 1 - height
    tree_row, tree_col = row >> shift, col >> shift
    if min(tree_row, tree_col) < 0 or tree_row >= forest.owners.shape[0]:
        return -1
    if tree_col >= forest.owners.shape[1]:
        return -1
    owner = forest.owners[tree_row, tree_col]
    if owner == NOBODY:
        return -1
    return forest.places[owner, height, 0] + row * forest.places[owner, height, 1] + col


@kernel
def _root_beside(height, row, col, is_lower, is_right, forest):
    """Return the root at a corner of a cell: that of the cell, one below it or one above it.

    `is_lower` and `is_right` select the corner. The result is -1 if a larger cell does not have
    that corner, or there is no cell.
    """
    node = _node(height, row, col, forest)
    if node < 0:
        return -1
    while forest.marks[node] == INNER:
        height, row, col = height - 1, 2 * row + is_lower, 2 * col + is_right
        node = _node(height, row, col, forest)
    while forest.marks[node] == BELOW:
        if (row & 1) != is_lower or (col & 1) != is_right:
            return -1
        height, row, col = height + 1, row >> 1, col >> 1
        node = _node(height, row, col, forest)
    return node


@kernel
def _add(a, b, c, is_mirrored, triangles, count):
    if is_mirrored:
        b, c = c, b
    triangles[count, 0], triangles[count, 1], triangles[count, 2] = a, b, c
    return count + 1


@kernel
def _add_side(root, beside, forest, is_mirrored, stack, triangles, count):
    """Append the triangles of a root with the nodes along a divided neighbour's facing border.

    `root` is its vertex, `beside` the side, and the neighbour's height, row and column. Return the
    new count of triangles.
    """
    side, height, row, col = beside
    before = VOID
    stack[0, 0], stack[0, 1], stack[0, 2] = height, row, col
    depth = 1
    while depth > 0:
        depth -= 1
        height, row, col = stack[depth, 0], stack[depth, 1], stack[depth, 2]
        node = _node(height, row, col, forest)
        if forest.marks[node] == INNER:
            # Clockwise around the root: the second on the stack comes first.
            for k in range(2):
                if side == _TOP:
                    down, right = 1, 1 - k
                elif side == _RIGHT:
                    down, right = 1 - k, 0
                elif side == _BOTTOM:
                    down, right = 0, k
                else:
                    down, right = k, 1
                stack[depth + k, 0] = height - 1
                stack[depth + k, 1], stack[depth + k, 2] = 2 * row + down, 2 * col + right
            depth += 2
            continue
        vertex = np.int64(forest.vertex_of[node])
        if before != VOID and vertex != VOID:
            count = _add(root, before, vertex, is_mirrored, triangles, count)
        before = vertex
    return count


@kernel
def _add_corner(nw, ne, se, sw, is_mirrored, triangles, count):
    """Append the triangles of four vertices around a corner, or of the three that are not void."""
    if nw != VOID and se != VOID:
        if ne != VOID:
            count = _add(nw, ne, se, is_mirrored, triangles, count)
        if sw != VOID:
            count = _add(nw, se, sw, is_mirrored, triangles, count)
    elif ne != VOID and sw != VOID:
        if nw != VOID:
            count = _add(nw, ne, sw, is_mirrored, triangles, count)
        elif se != VOID:
            count = _add(ne, se, sw, is_mirrored, triangles, count)
    return count


@kernel
def draw_fans(forest, nodes, is_mirrored, stack, triangles):
    """Fill the triangles of some roots, which may be void; return their number.

    Counter-clockwise in x, y if rows go down; `is_mirrored` if they go up.
    """
    count = 0
    for number in range(nodes.shape[0]):
        height = np.int64(nodes[number, 0])
        row, col = np.int64(nodes[number, 1]), np.int64(nodes[number, 2])
        vertex_of = forest.vertex_of
        root = np.int64(vertex_of[_node(height, row, col, forest)])
        if height > 0 and root != VOID:
            for side in range(4):
                r, c = row + _DOWN[side], col + _ACROSS[side]
                beside = _node(height, r, c, forest)
                if beside >= 0 and forest.marks[beside] == INNER:
                    count = _add_side(
                        root, (side, height, r, c), forest, is_mirrored, stack, triangles, count
                    )
        ne = _root_beside(height, row, col + 1, 1, 0, forest)
        if ne < 0:
            continue
        se = _root_beside(height, row + 1, col + 1, 0, 0, forest)
        sw = _root_beside(height, row + 1, col, 0, 1, forest)
        if se >= 0 and sw >= 0:
            count = _add_corner(
                root, np.int64(vertex_of[ne]), np.int64(vertex_of[se]), np.int64(vertex_of[sw]),
                is_mirrored, triangles, count,
            )  # fmt: skip
    return count


@kernel
def leave_rings(triangles, is_ring, edges):
    """Remove triangles with only ring vertices, in place; return the number left.

    Also return the number of edges between ring vertices of kept triangles, which begin `edges`,
    and of the others, which end it.
    """
    n, n_ends, n_gone = 0, 0, 0
    for number in range(triangles.shape[0]):
        a, b, c = triangles[number, 0], triangles[number, 1], triangles[number, 2]
        is_a, is_b, is_c = is_ring[a], is_ring[b], is_ring[c]
        if is_a and is_b and is_c:
            for k in range(3):
                n_gone += 1
                place = edges.shape[0] - n_gone
                edges[place, 0] = triangles[number, k]
                edges[place, 1] = triangles[number, (k + 1) % 3]
            continue
        triangles[n, 0], triangles[n, 1], triangles[n, 2] = a, b, c
        n += 1
        if int(is_a) + int(is_b) + int(is_c) == 2:
            edges[n_ends, 0], edges[n_ends, 1] = (a if is_a else b), (c if is_c else b)
            n_ends += 1
    return n, n_ends, n_gone


@kernel
def count_corners(first, end, is_ring, number_of, which):
    """Begin `which` with the vertices `first` … `end` that are not in rings; return their number.

    `number_of` receives the index of each.
    """
    n = 0
    for vertex in range(first, end):
        if not is_ring[vertex]:
            number_of[vertex], which[n] = n, vertex
            n += 1
    return n


@kernel
def number_corners(corners, n, number_of, which):
    """Replace vertices by their indices in `which`, in place; return its new length."""
    for row in range(corners.shape[0]):
        for col in range(corners.shape[1]):
            vertex = corners[row, col]
            number = number_of[vertex]
            if number < 0 or number >= n or which[number] != vertex:
                number_of[vertex], which[n] = n, vertex
                number = n
                n += 1
            corners[row, col] = number
    return n


@kernel
def _root_at(row, col, forest):
    """Return height and number of the root that holds a sample; number -1 if no mesh draws it."""
    height = forest.places.shape[1] - 1
    node = _node(height, row >> height, col >> height, forest)
    while node >= 0 and forest.marks[node] == INNER:
        height -= 1
        node = _node(height, row >> height, col >> height, forest)
    return height, node


@kernel
def _add_edge(owner, a, b, forest, edges, count):
    """Append an edge of two roots, unless one is void; return the new count."""
    if forest.vertex_of[a] == VOID or forest.vertex_of[b] == VOID:
        return count
    edges[count, 0], edges[count, 1] = forest.vertex_of[a], forest.vertex_of[b]
    edges[count, 2] = owner
    return count + 1


@kernel
def fill_rim(open_sides, forest, edges):
    """Fill the edges along those sides of trees without a drawn neighbour.

    Each has two vertices, and the mesh it belongs to. Return their number. At the end of a side an
    edge leads on to the next tree along it. If that tree's side is not such a side, the rim turns
    there, and another side continues from that tree.
    """
    top = forest.places.shape[1] - 1
    n_rows, n_cols = forest.owners.shape
    length = 1 << top
    count = 0
    for tree in range(n_rows * n_cols):
        tree_row, tree_col = tree // n_cols, tree % n_cols
        owner = forest.owners[tree_row, tree_col]
        for side in range(4):
            beside = _node(top, tree_row + _DOWN[side], tree_col + _ACROSS[side], forest)
            if owner == NOBODY or not open_sides[side] or beside >= 0:
                continue
            is_upright = side & 1
            row, col = tree_row << top, tree_col << top
            row += length - 1 if side == _BOTTOM else 0
            col += length - 1 if side == _RIGHT else 0
            # The rim turns into this side from the tree before.
            r, c = row - is_upright, col - (1 - is_upright)
            before, at = -1, 0
            if _root_at(r + _DOWN[side], c + _ACROSS[side], forest)[1] >= 0:
                before = _root_at(r, c, forest)[1]
            while at <= length:
                r, c = row + is_upright * at, col + (1 - is_upright) * at
                height, node = _root_at(r, c, forest)
                if node < 0:
                    break
                if before >= 0:
                    count = _add_edge(owner, before, node, forest, edges, count)
                before = node
                at += 1 << height
    return count
