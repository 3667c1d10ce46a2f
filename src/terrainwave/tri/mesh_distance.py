"""Distance of samples from a mesh, measured at every sample that it covers."""

import math

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import inlined_kernel, kernel
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh
from terrainwave.tri.triangle import area_of

_MAX_EXACT_AREA = 1 << 25
# Upper bound on float64's error for heights below 2^36.
_ROUNDING = 2.0**-10
# Share of a triangle's area: points this close outside count as on its edge.
_ON_EDGE = 1e-9


def largest_deviation(
    mesh: BlockMesh,  # its first sample lies on sample (0, 0) of the window's grid
    stride: int,  # samples of the window's grid per sample of the mesh's level
    # `heights, mask`: shape (n_rows, n_cols); quanta and validity of a window whose first sample is
    # (`row`, `col`)
    heights: NDArray[np.int32],
    mask: NDArray[np.bool_],
    row: int,
    col: int,
) -> int:
    """Return the largest distance of valid samples from a mesh, rounded up, in 1/16 quanta.

    0 if the mesh covers no valid sample of the window.
    """
    return int(
        _largest_deviation(
            mesh.rows, mesh.cols, mesh.heights, mesh.triangles, stride, heights, mask, row, col
        )
    )


@kernel
def _covered(weight_0, growth_0, weight_1, growth_1, weight_2, growth_2, last):
    """Return the range, within 0 ... last, in which no weight is negative.

    Weights, at position 0, grow by their steps. They are below 2^53, so the float64 quotients round
    to the right floor and ceiling (`tri.halves.height_fit`), faster than integer division.
    """
    first = np.int64(0)
    for k in range(3):
        weight = weight_0 if k == 0 else (weight_1 if k == 1 else weight_2)
        growth = growth_0 if k == 0 else (growth_1 if k == 1 else growth_2)
        if growth > 0:
            if weight < 0:
                first = max(first, np.int64(np.ceil(float(-weight) / float(growth))))
        elif weight < 0:
            last = np.int64(-1)
        elif growth < 0:
            last = min(last, np.int64(np.floor(float(weight) / float(-growth))))
    return first, last


@inlined_kernel
def _exceeds(samples, mask, row, col, count, level, slope, limit):
    """Return whether valid samples from (row, col) on may be further than `limit` from a surface.

    It begins at height `level` and rises by `slope`. A vectorisable loop.
    """
    n_beyond = 0
    for k in range(count):
        sample = float(samples[np.uint64(row), np.uint64(col + k)]) * float(1 << FRACTION_BITS)
        apart = abs(level + float(np.int32(k)) * slope - sample)
        is_beyond = (apart > limit) & mask[np.uint64(row), np.uint64(col + k)]
        n_beyond += 1 if is_beyond else 0
    return n_beyond > 0


@kernel
def _largest_deviation(rows, cols, heights, triangles, stride, samples, mask, first_row, first_col):
    n_rows, n_cols = samples.shape
    largest = np.int64(0)
    for t in range(triangles.shape[0]):
        p_0, p_1, p_2 = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        # Doubled positions relative to the window's first sample.
        row_0 = np.int64(rows[p_0]) * stride - 2 * first_row
        row_1 = np.int64(rows[p_1]) * stride - 2 * first_row
        row_2 = np.int64(rows[p_2]) * stride - 2 * first_row
        top = max((min(row_0, row_1, row_2) + 1) >> 1, 0)
        bottom = min(max(row_0, row_1, row_2) >> 1, n_rows - 1)
        if top > bottom:
            continue
        col_0 = np.int64(cols[p_0]) * stride - 2 * first_col
        col_1 = np.int64(cols[p_1]) * stride - 2 * first_col
        col_2 = np.int64(cols[p_2]) * stride - 2 * first_col
        left = max((min(col_0, col_1, col_2) + 1) >> 1, 0)
        right = min(max(col_0, col_1, col_2) >> 1, n_cols - 1)
        if left > right:
            continue
        area = area_of(row_0, col_0, row_1, col_1, row_2, col_2)
        if area <= 0:
            continue
        z_0 = heights[p_0]
        rise_1, rise_2 = heights[p_1] - z_0, heights[p_2] - z_0
        # Integers while products of an area and a difference of heights, below 2^36, fit.
        is_exact = area < _MAX_EXACT_AREA
        growth_0, growth_1 = -2 * (row_2 - row_1), -2 * (row_0 - row_2)
        growth_2 = -(growth_0 + growth_1)
        fall_1, fall_2 = float(rise_1) / float(area), float(rise_2) / float(area)
        slope = growth_1 * fall_1 + growth_2 * fall_2
        for row in range(top, bottom + 1):
            weight_0 = area_of(2 * row, 2 * left, row_1, col_1, row_2, col_2)
            weight_1 = area_of(row_0, col_0, 2 * row, 2 * left, row_2, col_2)
            weight_2 = area - weight_0 - weight_1
            skip, most = _covered(
                weight_0, growth_0, weight_1, growth_1, weight_2, growth_2, right - left
            )
            share_1, share_2 = weight_1 + skip * growth_1, weight_2 + skip * growth_2
            level = float(z_0) + (share_1 * fall_1 + share_2 * fall_2)
            if not _exceeds(
                samples, mask, row, left + skip, most - skip + 1, level, slope,
                float(largest) - _ROUNDING,
            ):  # fmt: skip
                continue
            for place in range(skip, most + 1):
                if not mask[row, left + place]:
                    continue
                share_1, share_2 = weight_1 + place * growth_1, weight_2 + place * growth_2
                sample = (np.int64(samples[row, left + place]) << FRACTION_BITS) - z_0
                if is_exact:
                    apart = abs(share_1 * rise_1 + share_2 * rise_2 - sample * area)
                    if apart > largest * area:
                        largest = (apart + area - 1) // area
                else:
                    surface = float(share_1) * float(rise_1) + float(share_2) * float(rise_2)
                    apart_float = abs(surface / float(area) - float(sample)) + _ROUNDING
                    if apart_float > float(largest):
                        largest = np.int64(np.ceil(apart_float))
    return largest


def deviation_from_bilinear(
    mesh: BlockMesh, heights: NDArray[np.int32], mask: NDArray[np.bool_]
) -> int:
    """Return the largest distance of a mesh from its samples' bilinear surface, in 1/16 quanta.

    Rounded up; at valid samples, and everywhere in cells without voids: with the error of the
    bilinear surface this bounds the error of the mesh, whatever lies between the samples.

    In a triangle's part of a cell the distance is a saddle: it is largest on the edge of that part,
    and along lines of the grid at their ends. So samples and the edges of triangles suffice; along
    an edge the distance is a parabola from one line of the grid to the next.
    """
    whole = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1] & mask[1:, 1:]
    arrays = mesh.rows, mesh.cols, mesh.heights, mesh.triangles
    at_samples = _largest_at_samples(*arrays, heights, mask)
    along_edges = _largest_along_edges(*arrays, heights, whole)
    return math.ceil(max(at_samples, along_edges) + _ROUNDING)


@kernel
def _largest_at_samples(rows, cols, heights, triangles, samples, mask):
    largest = 0.0
    for t in range(triangles.shape[0]):
        p_0, p_1, p_2 = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        row_0, row_1, row_2 = np.int64(rows[p_0]), np.int64(rows[p_1]), np.int64(rows[p_2])
        col_0, col_1, col_2 = np.int64(cols[p_0]), np.int64(cols[p_1]), np.int64(cols[p_2])
        area = area_of(row_0, col_0, row_1, col_1, row_2, col_2)
        if area <= 0:
            continue
        top, bottom = (min(row_0, row_1, row_2) + 1) >> 1, max(row_0, row_1, row_2) >> 1
        left, right = (min(col_0, col_1, col_2) + 1) >> 1, max(col_0, col_1, col_2) >> 1
        z_0 = float(heights[p_0])
        fall_1 = (float(heights[p_1]) - z_0) / float(area)
        fall_2 = (float(heights[p_2]) - z_0) / float(area)
        growth_0, growth_1 = -2 * (row_2 - row_1), -2 * (row_0 - row_2)
        growth_2 = -(growth_0 + growth_1)
        for row in range(top, bottom + 1):
            weight_0 = area_of(2 * row, 2 * left, row_1, col_1, row_2, col_2)
            weight_1 = area_of(row_0, col_0, 2 * row, 2 * left, row_2, col_2)
            weight_2 = area - weight_0 - weight_1
            skip, most = _covered(
                weight_0, growth_0, weight_1, growth_1, weight_2, growth_2, right - left
            )
            for place in range(skip, most + 1):
                if not mask[row, left + place]:
                    continue
                rise = float(weight_1 + place * growth_1) * fall_1
                rise += float(weight_2 + place * growth_2) * fall_2
                sample = float(np.int64(samples[row, left + place]) << FRACTION_BITS)
                largest = max(largest, abs(z_0 + rise - sample))
    return largest


@inlined_kernel
def _to_next_line(start, change):
    """Return the shares of an edge up to the first line of the grid, and from line to line.

    Start and change are in half samples.
    """
    if change > 0:
        return float(2 * (start >> 1) + 2 - start) / float(change), 2.0 / float(change)
    if change < 0:
        return float(start - 2 * ((start - 1) >> 1)) / float(-change), 2.0 / float(-change)
    return 2.0, 0.0


@kernel
def _largest_along_edges(rows, cols, heights, triangles, samples, is_whole):
    n_rows, n_cols = is_whole.shape
    unit = float(1 << FRACTION_BITS)
    largest = 0.0
    for t in range(triangles.shape[0]):
        for k in range(3):
            p, q = triangles[t, k], triangles[t, (k + 1) % 3]
            row, col = np.int64(rows[p]), np.int64(cols[p])
            down, right = np.int64(rows[q]) - row, np.int64(cols[q]) - col
            z, rise = float(heights[p]), float(heights[q]) - float(heights[p])
            next_row, step_row = _to_next_line(row, down)
            next_col, step_col = _to_next_line(col, right)
            # An edge on a line of the grid belongs to the cells on both sides.
            above = 1 if down == 0 and row & 1 == 0 else 0
            beside = 1 if right == 0 and col & 1 == 0 else 0
            start = 0.0
            while start < 1.0:
                end = min(next_row, next_col, 1.0)
                middle = 0.5 * (start + end)
                cell_row = np.int64(np.floor((float(row) + middle * float(down)) * 0.5))
                cell_col = np.int64(np.floor((float(col) + middle * float(right)) * 0.5))
                cell_row = min(max(cell_row, 0), n_rows - 1)
                cell_col = min(max(cell_col, 0), n_cols - 1)
                if not is_whole[cell_row, cell_col]:
                    cell_row, cell_col = max(cell_row - above, 0), max(cell_col - beside, 0)
                if is_whole[cell_row, cell_col]:
                    a = float(samples[cell_row, cell_col])
                    b = float(samples[cell_row, cell_col + 1]) - a
                    d = float(samples[cell_row + 1, cell_col]) - a
                    twist = float(samples[cell_row + 1, cell_col + 1]) - a - b - d
                    y = (float(row) + start * float(down)) * 0.5 - float(cell_row)
                    x = (float(col) + start * float(right)) * 0.5 - float(cell_col)
                    first = z + start * rise - unit * (a + b * x + d * y + twist * x * y)
                    y_2 = y + (end - start) * float(down) * 0.5
                    x_2 = x + (end - start) * float(right) * 0.5
                    last = z + end * rise - unit * (a + b * x_2 + d * y_2 + twist * x_2 * y_2)
                    largest = max(largest, abs(first), abs(last))
                    bend = unit * twist * (x_2 - x) * (y_2 - y)
                    slope = last - first + bend  # first + slope s - bend s^2, s from 0 to 1
                    if abs(bend) > 0 and 0 < slope / (2.0 * bend) < 1:
                        largest = max(largest, abs(first + slope * slope / (4.0 * bend)))
                if next_row <= end:
                    next_row += step_row
                if next_col <= end:
                    next_col += step_col
                start = end
    return largest


def deviation_at_points(
    mesh: BlockMesh,  # its positions may be fractions of half samples
    is_counted: NDArray[np.bool_],  # shape (n_triangles,); True for triangles to use
    # `rows, cols, heights`: shape (n_points,); points in samples, 0 … side, and 1/16 quanta
    rows: NDArray[np.float64],
    cols: NDArray[np.float64],
    heights: NDArray[np.float64],
    side: int,  # cells of the mesh's square
) -> tuple[float, int]:
    """Return the largest vertical distance of points from triangles, and the number on them."""
    # Points by cell, so that a triangle only tests points in its own cells.
    cell_rows = np.clip(np.floor(rows).astype(np.int64), 0, side - 1)
    cell_cols = np.clip(np.floor(cols).astype(np.int64), 0, side - 1)
    cells = cell_rows * side + cell_cols
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], np.arange(side * side + 1))
    is_covered = np.zeros(len(rows), dtype=np.bool_)
    worst = _deviation_at_points(
        mesh.rows / 2, mesh.cols / 2, mesh.heights.astype(np.float64),
        mesh.triangles[is_counted], rows[order], cols[order], heights[order], starts, side,
        is_covered,
    )  # fmt: skip
    return float(worst), int(np.count_nonzero(is_covered))


@kernel
def _deviation_at_points(
    rows, cols, heights, triangles, point_rows, point_cols, point_heights, starts, side, is_covered
):
    worst = 0.0
    for t in range(triangles.shape[0]):
        p, q, s = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        r_0, r_1, r_2 = rows[p], rows[q], rows[s]
        c_0, c_1, c_2 = cols[p], cols[q], cols[s]
        area = area_of(r_0, c_0, r_1, c_1, r_2, c_2)
        # A point on a cell's lower or right edge belongs to the cell beyond.
        top, bottom = int(min(r_0, r_1, r_2)), min(int(max(r_0, r_1, r_2)), side - 1)
        left, right = int(min(c_0, c_1, c_2)), min(int(max(c_0, c_1, c_2)), side - 1)
        slack = _ON_EDGE * area
        for row in range(max(top, 0), bottom + 1):
            first = starts[row * side + max(left, 0)]
            for k in range(first, starts[row * side + right + 1]):
                x, y = point_cols[k], point_rows[k]
                w_0 = area_of(y, x, r_1, c_1, r_2, c_2)
                w_1 = area_of(y, x, r_2, c_2, r_0, c_0)
                w_2 = area - w_0 - w_1
                if w_0 < -slack or w_1 < -slack or w_2 < -slack:
                    continue
                height = (w_0 * heights[p] + w_1 * heights[q] + w_2 * heights[s]) / area
                worst = max(worst, abs(height - point_heights[k]))
                is_covered[k] = True
    return worst
