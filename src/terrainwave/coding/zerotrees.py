"""Joint zero trees shared by codec and triangulation: one byte per finest node.

Node grids halve, rounding up, from the finest to 1 x 1; node (i, j) of *height* h above the finest
grid has the descendants (i << h … ) x (j << h … ) there. A map of zero trees is a uint8 array over
the finest nodes: 0 where the node is significant, else 1 + the height of the root of the maximal
tree without a significant node that holds it. It determines all nodes (Yusov & Turlapov 2010,
§2.4): the node of height h above finest node f is

* JS, significant or with a significant descendant, where ``trees[f] <= h`` (the node's tree cannot
  be part of a zero tree then; for h = 0: where ``trees[f] == 0``);
* JZTR, root of a maximal zero tree, where ``trees[f] == h + 1``;
* JZTC, inside one, where ``trees[f] > h + 1``.

The finest nodes of a group are the samples of the block it refines, one to one.
"""

from terrainwave.coding.jit import kernel

JZTR, JS, JZTC = 0, 1, 2


@kernel
def tree_height(n_rows, n_cols):
    """Return the height of the root of a tree over n_rows x n_cols finest nodes; its grid is 1 x 1.

    ``tree_height(1, 1)`` is 0.
    """
    height = 0
    while max(n_rows - 1, n_cols - 1) >> height > 0:
        height += 1
    return height


@kernel
def map_of_labels(labels, offsets, count, trees):
    """Fill `trees` (uint8) from labels of `count` node grids, coarsest first, grid g at offsets[g].

    Labels as `codec.cdf97.zerotree` leaves them.
    """
    n_rows, n_cols = trees.shape
    for i in range(n_rows):
        for j in range(n_cols):
            trees[i, j] = 0
    for grid in range(count):
        height = count - 1 - grid
        size = 1 << height
        rows, cols = ((n_rows - 1) >> height) + 1, ((n_cols - 1) >> height) + 1
        for i in range(rows):
            for j in range(cols):
                if labels[offsets[grid] + i * cols + j] == JZTR:
                    fill_node(trees, i * size, j * size, size, height + 1)


@kernel
def fill_node(values, row, col, size, value):
    """Set the part of a square of `values` that exists."""
    n_rows, n_cols = values.shape
    for i in range(row, min(row + size, n_rows)):
        line = values[i]
        for j in range(col, min(col + size, n_cols)):
            line[j] = value


@kernel
def mark_zero_trees(field, thresholds, trees):
    """Fill `trees` from coefficients: a node is significant if one of its three is not small.

    Parameters
    ----------
    field : ndarray of int64, shape (n_rows, n_cols)
        As `filters.forward_transform` leaves it.
    thresholds : ndarray of int64, shape (at least n_transforms, 4)
        By transform and band (LL, which counts for nothing, HL, LH, HH): the smallest magnitude
        that is significant.
    trees : ndarray of uint8, shape (ceil(n_rows / 2), ceil(n_cols / 2))
        A map of zero trees, with coarse nodes that are significant above ones that are not.
    """
    n_rows, n_cols = field.shape
    tallest = 0
    for height in range(tree_height(trees.shape[0], trees.shape[1]) + 1):
        rows, cols = ((n_rows - 1) >> (height + 1)) + 1, ((n_cols - 1) >> (height + 1)) + 1
        high_rows = (((n_rows - 1) >> height) + 1) >> 1
        high_cols = (((n_cols - 1) >> height) + 1) >> 1
        is_any = False
        for i in range(rows):
            for j in range(cols):
                row, col = i << height, j << height
                if height == 0:
                    trees[row, col] = 0
                elif not _are_children_zero(trees, row, col, height):
                    continue
                is_zero = True
                if j < high_cols:
                    is_zero = abs(field[2 * row, cols + j]) < thresholds[height, 1]
                if i < high_rows:
                    high_row = (2 * i + 1) << height
                    is_zero = is_zero and abs(field[high_row, j]) < thresholds[height, 2]
                    if j < high_cols:
                        is_zero = is_zero and abs(field[high_row, cols + j]) < thresholds[height, 3]
                if is_zero:
                    is_any = True
                    trees[row, col] = height + 1
        if not is_any:
            break
        tallest = height
    _fill_trees(trees, tallest)


@kernel
def _are_children_zero(trees, row, col, height):
    """Return whether all nodes directly below that of `height` at (row, col) are zero trees."""
    n_rows, n_cols = trees.shape
    half = 1 << (height - 1)
    is_zero = trees[row, col] == height
    if col + half < n_cols:
        is_zero = is_zero and trees[row, col + half] == height
    if row + half < n_rows:
        is_zero = is_zero and trees[row + half, col] == height
        if col + half < n_cols:
            is_zero = is_zero and trees[row + half, col + half] == height
    return is_zero


@kernel
def _fill_trees(trees, tallest):
    """Copy the value of a zero tree's first node to all its nodes, the tallest trees first."""
    n_rows, n_cols = trees.shape
    for height in range(tallest, 0, -1):
        size = 1 << height
        for row in range(0, n_rows, size):
            for col in range(0, n_cols, size):
                if trees[row, col] == height + 1:
                    fill_node(trees, row, col, size, height + 1)
