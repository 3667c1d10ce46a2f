"""Meshes from cuts: every sample moves to its root, degenerate triangles are dropped.

A. Pereberin's rule, as described by E. Yusov 2006 (§3.5.1) and E. Yusov, V. Turlapov 2010 (§2.4):
triangulate as if in the full grid every vertex had moved to the root of the tree that holds it,
then drop the triangles two of whose corners have become one. No crack for any difference of
heights. The papers don't mention that three different roots may lie on one line or in the wrong
order. `unfold` splits the tallest of their trees until none do; a mesh of a cut from the guaranteed
triangulation or `unfold` covers the area once.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh
from terrainwave.tri.quads import Keep, build_mesh, corner_of_quad, triangles_of_quad, void_edges
from terrainwave.tri.triangle import area_of, deviation
from terrainwave.tri.zerotree.labels import Cut, Trees, promote, root_along, set_node
from terrainwave.tri.zerotree.labels import zero_tree_cut as _zero_tree_cut


class LooseMesh(NamedTuple):
    """The triangulation without guarantee, and its error.

    `error` is measured: the largest vertical deviation over all covered samples, in 1/16 quanta,
    rounded up. `n_folded` triangles of the bare rule had no positive area; splitting their trees
    (`unfold`) has removed them.
    """

    mesh: BlockMesh
    cut: Cut
    error: int
    n_folded: int


def loose_mesh(
    heights: NDArray[np.int32],  # shape (n_rows, n_cols); decoded heights of the block, in quanta
    mask: NDArray[np.bool_],  # True for valid samples
    trees: Trees,  # zero trees of the group that refines the block (`coding.zerotrees`)
    keep: Keep | None = None,  # samples that must be vertices besides those at voids
) -> LooseMesh:
    mask = np.ascontiguousarray(mask)
    kept = void_edges(mask)
    if keep is not None:
        kept |= keep
    cut = _zero_tree_cut(trees, kept)
    n_folded = unfold(mask, cut)
    mesh = mesh_of_cut(heights, mask, cut)
    return LooseMesh(mesh, cut, mesh_error(heights, mesh), n_folded)


def unfold(mask: NDArray[np.bool_], cut: Cut) -> int:
    """Split nodes in place until every triangle has positive area; return how many had not.

    In a bad triangle the tallest nodes are split. Nodes of height 0 give triangles of area 1, so
    this ends.
    """
    n_first = n_found = _split_folds(mask, cut)
    while n_found:
        n_found = _split_folds(mask, cut)
    promote(cut)
    return int(n_first)


def mesh_of_cut(heights: NDArray[np.int32], mask: NDArray[np.bool_], cut: Cut) -> BlockMesh:
    """Return the triangles of a cut; vertices in the order of their samples, row by row."""
    vertex_of = np.full(heights.shape, -1, dtype=np.int32)
    corners = np.empty((2 * max(heights.size, 1), 3), dtype=np.int64)
    n_triangles = _collect(np.ascontiguousarray(mask), cut, vertex_of, corners)
    return build_mesh(heights, vertex_of, corners[:n_triangles])


def mesh_error(heights: NDArray[np.int32], mesh: BlockMesh) -> int:
    """Return the largest vertical deviation of covered samples, in 1/16 quanta, rounded up.

    For meshes whose vertices are samples, and whose triangles have positive area.
    """
    worst = _largest_error(
        np.ascontiguousarray(heights), mesh.rows >> 1, mesh.cols >> 1, mesh.triangles
    )
    return int(worst)


@kernel
def _collect(mask, cut, vertex_of, corners):
    n_rows, n_cols = mask.shape
    count = 0
    for row in range(n_rows - 1):
        for col in range(n_cols - 1):
            kinds = triangles_of_quad(mask, row, col)
            for shift in range(4):
                if not (kinds >> shift) & 1:
                    continue
                for k in range(3):
                    down, right = corner_of_quad(1 << shift, k)
                    i, j = row + down, col + right
                    height = np.int64(cut[i, j])
                    i, j = root_along(i, n_rows, height), root_along(j, n_cols, height)
                    corners[count, k] = i * n_cols + j
                a, b, c = corners[count, 0], corners[count, 1], corners[count, 2]
                if a == b or b == c or a == c:
                    continue
                for k in range(3):
                    vertex_of[corners[count, k] // n_cols, corners[count, k] % n_cols] = 0
                count += 1
    return count


@kernel
def _split_folds(mask, cut):
    """Split the tallest nodes of triangles without positive area; return the number of these."""
    n_rows, n_cols = mask.shape
    count = 0
    rows, cols = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    heights = np.zeros(3, dtype=np.int64)
    for row in range(n_rows - 1):
        for col in range(n_cols - 1):
            kinds = triangles_of_quad(mask, row, col)
            for shift in range(4):
                if not (kinds >> shift) & 1:
                    continue
                for k in range(3):
                    down, right = corner_of_quad(1 << shift, k)
                    heights[k] = cut[row + down, col + right]
                    rows[k] = root_along(row + down, n_rows, heights[k])
                    cols[k] = root_along(col + right, n_cols, heights[k])
                is_degenerate = False
                for k in range(3):
                    other = (k + 1) % 3
                    if rows[k] == rows[other] and cols[k] == cols[other]:
                        is_degenerate = True
                if is_degenerate:
                    continue
                if area_of(rows[0], cols[0], rows[1], cols[1], rows[2], cols[2]) > 0:
                    continue
                count += 1
                tallest = max(heights[0], heights[1], heights[2])
                for k in range(3):
                    if heights[k] == tallest:
                        set_node(cut, rows[k], cols[k], tallest, tallest - 1)
    return count


@kernel
def _largest_error(heights, rows, cols, triangles):
    """Return ceil(16 * largest deviation) over all triangles."""
    worst = np.int64(0)
    for t in range(triangles.shape[0]):
        r0, c0 = np.int64(rows[triangles[t, 0]]), np.int64(cols[triangles[t, 0]])
        r1, c1 = np.int64(rows[triangles[t, 1]]), np.int64(cols[triangles[t, 1]])
        r2, c2 = np.int64(rows[triangles[t, 2]]), np.int64(cols[triangles[t, 2]])
        area = area_of(r0, c0, r1, c1, r2, c2)
        error = deviation(heights, r0, c0, r1, c1, r2, c2, np.int64(1) << 62)
        worst = max(worst, -((-(error << FRACTION_BITS)) // area))
    return worst
