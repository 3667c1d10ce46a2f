"""Joint zero trees as codec and triangulation share them: one byte per finest node.

Node grids halve, rounding up, from the finest to 1 x 1; node (i, j) of *height* h above the finest
grid has the descendants (i << h … ) x (j << h … ) there. A map of zero trees is a uint8 array over
the finest nodes: 0 where the node is significant, else 1 + the height of the root of the maximal
tree without a significant node that holds it. It says everything about all nodes (Yusov & Turlapov
2010, §2.4): the node of height h above finest node f is

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

    Labels as `codec.zerotree` leaves them.
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
def grow_zero_trees(trees):
    """Turn flags of significant finest nodes (uint8, 1 = significant) into zero trees, in place."""
    n_rows, n_cols = trees.shape
    for i in range(n_rows):
        for j in range(n_cols):
            trees[i, j] = 0 if trees[i, j] else 1
    # Upwards, the first node of a tree stands for all; then trees are filled, tallest first.
    tallest = 0
    for height in range(1, tree_height(n_rows, n_cols) + 1):
        size = 1 << height
        half = size >> 1
        for row in range(0, n_rows, size):
            for col in range(0, n_cols, size):
                is_zero = trees[row, col] == height
                if col + half < n_cols:
                    is_zero = is_zero and trees[row, col + half] == height
                if row + half < n_rows:
                    is_zero = is_zero and trees[row + half, col] == height
                    if col + half < n_cols:
                        is_zero = is_zero and trees[row + half, col + half] == height
                if is_zero:
                    tallest = height
                    trees[row, col] = height + 1
        if tallest < height:
            break
    for height in range(tallest, 0, -1):
        size = 1 << height
        for row in range(0, n_rows, size):
            for col in range(0, n_cols, size):
                if trees[row, col] == height + 1:
                    fill_node(trees, row, col, size, height + 1)
