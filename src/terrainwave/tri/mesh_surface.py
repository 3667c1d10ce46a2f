"""Heights of a mesh at points of a grid."""

import numpy as np

from terrainwave.coding.jit import kernel


@kernel
def surface_at(rows, cols, heights, triangles, factor, first_row, first_col, numbers, out):
    """Fill `out`, float64, with a mesh's heights at points of a grid; uncovered ones do not change.

    `numbers`, int32, numbers the points: position (r, c) is point `numbers[r, c]` at (first_row +
    r, first_col + c), or none if that is < 0. A vertex's rows and columns count `factor` of these
    units each.
    """
    n_rows, n_cols = numbers.shape
    for t in range(triangles.shape[0]):
        p_0, p_1, p_2 = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        row_0 = np.int64(rows[p_0]) * factor - first_row
        row_1 = np.int64(rows[p_1]) * factor - first_row
        row_2 = np.int64(rows[p_2]) * factor - first_row
        top, bottom = max(min(row_0, row_1, row_2), 0), min(max(row_0, row_1, row_2), n_rows - 1)
        if top > bottom:
            continue
        col_0 = np.int64(cols[p_0]) * factor - first_col
        col_1 = np.int64(cols[p_1]) * factor - first_col
        col_2 = np.int64(cols[p_2]) * factor - first_col
        left, right = max(min(col_0, col_1, col_2), 0), min(max(col_0, col_1, col_2), n_cols - 1)
        area = (col_1 - col_0) * (row_2 - row_0) - (col_2 - col_0) * (row_1 - row_0)
        if left > right or area <= 0:
            continue
        z_0 = float(heights[p_0])
        rise_1, rise_2 = float(heights[p_1]) - z_0, float(heights[p_2]) - z_0
        step_1, step_2 = row_2 - row_0, row_0 - row_1
        for row in range(top, bottom + 1):
            weight_1 = (left - col_0) * (row_2 - row_0) - (col_2 - col_0) * (row - row_0)
            weight_2 = (col_1 - col_0) * (row - row_0) - (left - col_0) * (row_1 - row_0)
            for col in range(left, right + 1):
                # All three weights are >= 0.
                if (weight_1 | weight_2 | (area - weight_1 - weight_2)) >= 0:
                    number = numbers[row, col]
                    if number >= 0:
                        out[number] = z_0 + (weight_1 * rise_1 + weight_2 * rise_2) / area
                weight_1 += step_1
                weight_2 += step_2
