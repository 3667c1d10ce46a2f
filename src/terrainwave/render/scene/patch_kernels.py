"""Kernels for building patches: heights at points of meshes, texels, edges on borders."""

import numpy as np

from terrainwave.coding.jit import inlined_kernel, kernel

SKIRT_FLAG = 1 << 15


@kernel
def bilinear_at(rows, cols, heights, mask, first_row, first_col, fallback, out):
    """Fill `out`, float64, with heights of a coarser level at vertices, between its samples.

    `rows` and `cols` are those of vertices, in half samples from their block's first, which is
    `first_row` and `first_col` half samples after the first of `heights` and `mask`, the level
    above. Past their sides the last two are continued linearly. Next to voids `fallback` is used.
    """
    last_row, last_col = max(heights.shape[0] - 2, 0), max(heights.shape[1] - 2, 0)
    step_row, step_col = min(heights.shape[0] - 1, 1), min(heights.shape[1] - 1, 1)
    for k in range(rows.shape[0]):
        at_row, at_col = rows[k] + first_row, cols[k] + first_col
        row, col = min(at_row >> 2, last_row), min(at_col >> 2, last_col)
        down, right = (at_row - 4 * row) / 4, (at_col - 4 * col) / 4
        below, beside = row + step_row, col + step_col
        if mask[row, col] and mask[row, beside] and mask[below, col] and mask[below, beside]:
            upper = heights[row, col] * (1 - right) + heights[row, beside] * right
            lower = heights[below, col] * (1 - right) + heights[below, beside] * right
            out[k] = upper * (1 - down) + lower * down
        else:
            out[k] = fallback[k]


@kernel
def fill_texels(heights, mask, first_row, first_col, n_rows, n_cols, slopes_of, colors_of, out):
    """Fill `out` with slopes to the east and north and heights for colouring, as float16.

    `heights` and `mask` are samples around a block. Position (r, c) of `out` is sample (first_row +
    r, first_col + c), or the nearest one of the `n_rows` x `n_cols` from (max(first_row, 0),
    max(first_col, 0)) on. Slopes are ``(a c + b r, d c + e r)`` of differences per column c and row
    r, 0 below the fifth number of `slopes_of`; `colors_of` are factor, shift and largest value of
    heights. `out`, uint16 (m, 3 n), has bits of float16; values below 2⁻¹⁴ become 0.
    """
    texels = np.empty(out.shape[1], dtype=np.float32)
    bits = texels.view(np.uint32)
    is_valid = mask.all()
    a, b, d, e, least = slopes_of
    factor, shift, most = colors_of
    low_row, low_col = max(first_row, 0), max(first_col, 0)
    last_row, last_col = heights.shape[0] - 1, heights.shape[1] - 1
    for r in range(out.shape[0]):
        row = min(max(first_row + r, low_row), low_row + n_rows - 1)
        above, below = max(row - 1, 0), min(row + 1, last_row)
        for c in range(out.shape[1] // 3):
            col = min(max(first_col + c, low_col), low_col + n_cols - 1)
            left, right = max(col - 1, 0), min(col + 1, last_col)
            across, down = 0.0, 0.0
            if is_valid:
                height = float(heights[row, col]) * factor + shift
                if right > left:
                    across = (float(heights[row, right]) - float(heights[row, left])) / (
                        right - left
                    )
                if below > above:
                    down = (float(heights[below, col]) - float(heights[above, col])) / (
                        below - above
                    )
            elif mask[row, col]:
                height = float(heights[row, col]) * factor + shift
                across = _difference(heights, mask, row, left, row, col, row, right)
                down = _difference(heights, mask, above, col, row, col, below, col)
            else:
                height = _mean_around(heights, mask, row, col, factor, shift)
            east, north = a * across + b * down, d * across + e * down
            texels[3 * c] = min(max(east, -most), most) if abs(east) >= least else 0.0
            texels[3 * c + 1] = min(max(north, -most), most) if abs(north) >= least else 0.0
            texels[3 * c + 2] = min(max(height, -most), most)
        for k in range(out.shape[1]):
            out[r, k] = _half(bits[k])


@inlined_kernel
def _half(bits):
    """Return the bits of a float16, rounded to even, from those of a float32; 0 below 2⁻¹⁴."""
    whole = np.int64(bits)
    magnitude = whole & 0x7FFFFFFF
    if magnitude < 0x38800000:
        return np.uint16(0)
    rounded = (magnitude + 0x0FFF + ((magnitude >> 13) & 1)) >> 13
    return np.uint16((rounded - 0x1C000) | ((whole >> 16) & 0x8000))


@kernel
def _difference(heights, mask, row_0, col_0, row, col, row_1, col_1):
    """Return the difference per sample over a valid one: central, one-sided, or 0."""
    low = high = float(heights[row, col])
    n = 0
    if (row_0 != row or col_0 != col) and mask[row_0, col_0]:
        low = float(heights[row_0, col_0])
        n += 1
    if (row_1 != row or col_1 != col) and mask[row_1, col_1]:
        high = float(heights[row_1, col_1])
        n += 1
    return (high - low) / n if n else 0.0


@kernel
def _mean_around(heights, mask, row, col, factor, shift):
    """Return the mean of valid samples around a void one, so that colours don't change next to it.

    Samples past the side count as those at it; 0 if none is valid.
    """
    total, n = 0.0, 0
    for r in range(row - 1, row + 2):
        for c in range(col - 1, col + 2):
            at = min(max(r, 0), heights.shape[0] - 1), min(max(c, 0), heights.shape[1] - 1)
            if mask[at]:
                total += float(heights[at]) * factor + shift
                n += 1
    return total / n if n else 0.0
