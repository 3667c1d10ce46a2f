"""How far samples are from a mesh, measured at every sample it covers."""

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import inlined_kernel, kernel
from terrainwave.tri.block_mesh import FRACTION_BITS, BlockMesh
from terrainwave.tri.triangle import area_of

_MAX_EXACT_AREA = 1 << 25
# More than float64 loses of heights below 2^36.
_ROUNDING = 2.0**-10
# Of a triangle's area: points so little outside count as on its edge.
_ON_EDGE = 1e-9


def largest_deviation(
    mesh: BlockMesh,
    stride: int,
    heights: NDArray[np.int32],
    mask: NDArray[np.bool_],
    row: int,
    col: int,
) -> int:
    """Return the largest vertical distance of valid samples from a mesh, rounded up.

    Parameters
    ----------
    mesh : BlockMesh
        Its first sample lies on sample (0, 0) of the window's grid.
    stride : int
        Samples of the window's grid per sample of the mesh's level.
    heights, mask : ndarray, shape (n_rows, n_cols)
        Quanta and validity of a window whose first sample is (`row`, `col`).

    Returns
    -------
    int
        In 1/16 quanta; 0 if the mesh covers no valid sample of the window.
    """
    return int(
        _largest_deviation(
            mesh.rows, mesh.cols, mesh.heights, mesh.triangles, stride, heights, mask, row, col
        )
    )


@kernel
def _covered(weight_0, growth_0, weight_1, growth_1, weight_2, growth_2, last):
    """Return from which to which place, 0 ... last, no weight is negative.

    Weights, at place 0, grow by their steps from place to place. They are below 2^53, so that the
    float64 quotients round to the right floor and ceiling (`tri.halves.height_fit`), faster than
    integers divide.
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
    """Say whether valid samples from (row, col) on may be further than `limit` from a surface.

    It begins at height `level` and rises by `slope`. A loop that vectorises.
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
        # Doubled places relative to the window's first sample.
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
    mesh: BlockMesh, stride: int, heights: NDArray[np.int32], mask: NDArray[np.bool_]
) -> int:
    """Return the largest distance of a mesh from its samples' bilinear surface, rounded up.

    Looked at are the places of all full-grid samples, `stride` per sample of the mesh's level, in
    cells without voids: with the error of the bilinear surface this bounds the error of the mesh.

    Parameters
    ----------
    heights, mask : ndarray, shape (n_rows, n_cols)
        The samples that the mesh was made from, quanta.

    Returns
    -------
    int
        In 1/16 quanta.
    """
    whole = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1] & mask[1:, 1:]
    return int(
        _largest_from_bilinear(
            mesh.rows, mesh.cols, mesh.heights, mesh.triangles, stride, heights, whole
        )
    )


@kernel
def _largest_from_bilinear(rows, cols, heights, triangles, stride, samples, is_whole):
    n_rows, n_cols = is_whole.shape
    largest = 0.0
    share = float(1 << FRACTION_BITS) / (float(stride) * float(stride))
    for t in range(triangles.shape[0]):
        p_0, p_1, p_2 = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        row_0, col_0 = np.int64(rows[p_0]) * stride, np.int64(cols[p_0]) * stride
        row_1, col_1 = np.int64(rows[p_1]) * stride, np.int64(cols[p_1]) * stride
        row_2, col_2 = np.int64(rows[p_2]) * stride, np.int64(cols[p_2]) * stride
        area = area_of(row_0, col_0, row_1, col_1, row_2, col_2)
        if area <= 0:
            continue
        top, bottom = (min(row_0, row_1, row_2) + 1) >> 1, max(row_0, row_1, row_2) >> 1
        left, right = (min(col_0, col_1, col_2) + 1) >> 1, max(col_0, col_1, col_2) >> 1
        z_0 = float(heights[p_0])
        rise_1, rise_2 = float(heights[p_1]) - z_0, float(heights[p_2]) - z_0
        growth_0, growth_1 = -2 * (row_2 - row_1), -2 * (row_0 - row_2)
        growth_2 = -(growth_0 + growth_1)
        for row in range(top, bottom + 1):
            weight_0 = area_of(2 * row, 2 * left, row_1, col_1, row_2, col_2)
            weight_1 = area_of(row_0, col_0, 2 * row, 2 * left, row_2, col_2)
            weight_2 = area - weight_0 - weight_1
            skip, most = _covered(
                weight_0, growth_0, weight_1, growth_1, weight_2, growth_2, right - left
            )
            cell_row = min(row // stride, n_rows - 1)
            down = row - cell_row * stride
            for col in range(left + skip, left + most + 1):
                cell = min(col // stride, n_cols - 1)
                if not is_whole[cell_row, cell]:
                    continue
                place = col - cell * stride
                upper = np.int64(samples[cell_row, cell]) * (stride - place)
                upper += np.int64(samples[cell_row, cell + 1]) * place
                lower = np.int64(samples[cell_row + 1, cell]) * (stride - place)
                lower += np.int64(samples[cell_row + 1, cell + 1]) * place
                bilinear = float(upper * (stride - down) + lower * down) * share
                share_1 = float(weight_1 + (col - left) * growth_1)
                share_2 = float(weight_2 + (col - left) * growth_2)
                surface = z_0 + (share_1 * rise_1 + share_2 * rise_2) / float(area)
                largest = max(largest, abs(surface - bilinear))
    return np.ceil(largest + _ROUNDING)


def deviation_at_points(
    mesh: BlockMesh,
    is_counted: NDArray[np.bool_],
    rows: NDArray[np.float64],
    cols: NDArray[np.float64],
    heights: NDArray[np.float64],
    side: int,
) -> tuple[float, int]:
    """Return the largest vertical distance of points from triangles, and how many lie on them.

    Parameters
    ----------
    mesh : BlockMesh
        Its places may be fractions of half samples.
    is_counted : ndarray of bool, shape (n_triangles,)
        Which triangles are looked at.
    rows, cols, heights : ndarray of float64, shape (n_points,)
        Points in samples, 0 … side, and 1/16 quanta.
    side : int
        Cells of the mesh's square.
    """
    # Points by the cell they lie in, so that a triangle looks at its own cells only.
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
