"""Nodes over a block's samples, their labels, and cuts through their tree.

E. Yusov, V. Turlapov 2010, §2.4-2.5. The finest nodes are the block's samples; the node of height h
at sample (row, col), multiples of 2**h, holds the samples of that square and represents its first
one, where a vertex has the block's own height. The **last row and column are nodes of their own**
at every height, so that a border vertex only ever moves along its side. This equals the grids 2, 3,
5, …, N + 1 of a whole block, and it makes blocks clipped at the raster's edge work. Merging stops
where 2 x 2 nodes are left.

A *cut* is a uint8 array over the samples: the height of the node each sample moves to. It
determines the labels of the guaranteed triangulation: the node of height h whose first sample is f
is S where ``cut[f] < h``, TR where equal, TC where greater. A node with a single child is as its
child.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.tri.quads import Keep

Trees = NDArray[np.uint8]
Cut = NDArray[np.uint8]


@kernel
def top_height(n_rows, n_cols):
    """Return the height of the topmost nodes: the least at which at most 2 x 2 are left."""
    height = 0
    while (1 << height) < max(n_rows, n_cols) - 1:
        height += 1
    return height


@kernel
def axis_nodes(n, height):
    """Return the number of nodes of that height along an axis of `n` samples."""
    return ((n - 2) >> height) + 2 if n > 1 else 1


@kernel
def first_sample(node, n, height):
    """Return the first sample of a node along an axis of `n` samples."""
    return min(node << height, n - 1)


@kernel
def end_sample(first, n, height):
    """Return one past the last sample of the node of that height that begins at `first`."""
    return n if first == n - 1 else min(first + (1 << height), n - 1)


@kernel
def root_along(place, n, height):
    """Return the first sample of the node of that height that holds sample `place`."""
    return place if place == n - 1 else (place >> height) << height


@kernel
def second_child(first, n, height):
    """Return the first sample of the second child along an axis; `first` itself if it has one."""
    second = first + (1 << (height - 1))
    return second if first < n - 1 and second < n - 1 else first


def zero_tree_cut(trees: Trees, keep: Keep) -> Cut:
    """Return the cut at the roots of the zero trees, made finer where `keep` has vertices."""
    top = top_height(*trees.shape)
    cut = np.clip(trees.astype(np.int64) - 1, 0, top).astype(np.uint8)
    return refine(cut, keep)


def refine(cut: Cut, keep: Keep) -> Cut:
    """Return the coarsest cut not coarser than `cut` in which every sample of `keep` is a vertex.

    Monotone in both, which border agreement requires.
    """
    cut = cut.copy()
    _split_kept(keep, cut)
    promote(cut)
    return cut


def ceilings(keep: Keep, trees: Trees | None) -> NDArray[np.uint8]:
    """Return, at the first sample of nodes, the greatest height a vertex there may represent.

    A node can be TR only if its height is at most that: it holds no sample of `keep` but its first,
    and no node under it or itself is JS (Algorithm I: "the triangulation cannot be less detailed").
    """
    highest = np.zeros(keep.shape, dtype=np.uint8)
    no_trees = np.zeros((0, 0), dtype=np.uint8)
    _find_ceilings(keep, no_trees if trees is None else trees, highest)
    return highest


@kernel
def _find_ceilings(keep, trees, highest):
    n_rows, n_cols = keep.shape
    has_trees = trees.shape[0] > 0
    for height in range(1, top_height(n_rows, n_cols) + 1):
        for i in range(axis_nodes(n_rows, height)):
            row = first_sample(i, n_rows, height)
            row_2 = second_child(row, n_rows, height)
            for j in range(axis_nodes(n_cols, height)):
                col = first_sample(j, n_cols, height)
                col_2 = second_child(col, n_cols, height)
                below = height - 1
                if highest[row, col] < below:
                    continue
                if row_2 == row and col_2 == col:
                    highest[row, col] = height
                    continue
                if has_trees and trees[row, col] <= height:
                    continue
                if col_2 != col and (highest[row, col_2] < below or keep[row, col_2]):
                    continue
                if row_2 != row:
                    if highest[row_2, col] < below or keep[row_2, col]:
                        continue
                    if col_2 != col and (highest[row_2, col_2] < below or keep[row_2, col_2]):
                        continue
                highest[row, col] = height


@kernel
def set_node(cut, row, col, height, value):
    """Set `cut` on the samples of the node of that height that begins at (row, col)."""
    n_rows, n_cols = cut.shape
    end = end_sample(col, n_cols, height)
    for i in range(row, end_sample(row, n_rows, height)):
        line = cut[i]
        for j in range(col, end):
            line[j] = value


@kernel
def _split_kept(keep, cut):
    """Split nodes until every sample of `keep` is the first of one."""
    n_rows, n_cols = cut.shape
    for row in range(n_rows):
        for col in range(n_cols):
            if not keep[row, col]:
                continue
            height = np.int64(cut[row, col])
            top, left = root_along(row, n_rows, height), root_along(col, n_cols, height)
            while top != row or left != col:
                set_node(cut, top, left, height, height - 1)
                height -= 1
                top, left = root_along(row, n_rows, height), root_along(col, n_cols, height)


@kernel
def promote(cut):
    """Give nodes with a single child the height of the parent, in place: one cut, one array."""
    n_rows, n_cols = cut.shape
    for height in range(1, top_height(n_rows, n_cols) + 1):
        for i in range(axis_nodes(n_rows, height)):
            row = first_sample(i, n_rows, height)
            if second_child(row, n_rows, height) != row:
                continue
            for j in range(axis_nodes(n_cols, height)):
                col = first_sample(j, n_cols, height)
                if second_child(col, n_cols, height) != col:
                    continue
                if cut[row, col] == height - 1:
                    set_node(cut, row, col, height, height)
