"""A quadtree of vertices over a raster: means, Haar coefficients, measured errors.

E. Yusov, V. Turlapov, "Dynamic terrain simplification based on Haar transform and vertices
quadtree" (Graphicon 2006), §3.1-3.3. The samples are the leaves; four neighbours have a parent at
the centre of their cell, whose height is their mean. A forest of trees, the patches, of ``2**top``
samples per side covers the raster; positions past its last row and column are void like nodata.
Heights of nodes count from the leaves: the paper's level i is height n - i.

Two errors of a node that represents all samples below it:

* the paper's (§3.2.4): the largest of its three Haar coefficients. No bound.
* the measured one. Every triangle of a mesh has a largest corner M, whose cell has a side of
  s samples; its other corners are nodes that touch M and are not larger. It lies in one of four
  squares of side s beside M's centre, the quadrants, or, where its other corners meet half way
  along a side of M, in one of four strips s/2 wide from M's centre to the neighbour's. For each
  window let S be the interval of distances of its samples from some plane, and V that of all nodes
  that may be corners there. Then no sample is vertically further from the triangle than the larger
  of max V - min S and max S - min V. This also holds while corners move from nodes below M to M:
  then triangles inside M's cell, a ninth window, count too. The plane is the least squares plane of
  the window's samples, or a level one if that is better. Errors of parents are made no smaller than
  their children's.

At voids and the raster's outline the mesh ends at the centres of cells. A node that touches the
outline therefore has the diagonal of its box as its error (`OUTLINE`). So has a node next to a void
with the paper's errors, which ignore voids. Where the raster continues (`open_sides`) the mesh ends
at most half a patch before its last samples, and there is no outline: the neighbour's mesh overlaps
this one.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.tri.followed import CLOSED
from terrainwave.tri.quads import grown

# Rows of `HaarTree.layout`, one per height: first node, rows and columns of nodes.
FIRST, N_ROWS, N_COLS = 0, 1, 2
# Columns of `HaarTree.bounds`.
ERROR, LOW, HIGH = 0, 1, 2
# Replaces an error: the node touches the outline.
OUTLINE = -1.0
# A float32 is within this share of what it was rounded from.
_ROUNDING = 2.0**-23


class HaarTree(NamedTuple):
    """A forest of quadtrees; nodes are numbered height by height, row by row."""

    # shape (top + 1, 3); first node, rows and columns of nodes of each height; 0 are the samples
    layout: NDArray[np.int64]
    z: NDArray[np.float32]  # shape (n_nodes,); mean heights; NaN where all samples are void
    # shape (n_nodes - layout[1, 0], 3); of nodes of height 1 and more: error, or `OUTLINE`; lowest
    # and highest of what its error compares
    bounds: NDArray[np.float32]
    reach: float  # half the width of a node's box, in widths of its cell
    rounding: float  # largest difference between a height and its float32

    @property
    def top(self) -> int:
        """Return the height of the patches' roots."""
        return len(self.layout) - 1


def build_tree(
    heights: NDArray[np.floating],
    mask: NDArray[np.bool_] | None = None,
    *,
    patch: int = 256,
    error: str = "measured",
    open_sides: tuple[bool, bool, bool, bool] = CLOSED,
    is_surface: bool = False,
) -> HaarTree:
    """Return the tree of a raster.

    `mask` is true for valid samples; None: all that are finite. `patch` is a power of two, 2 to
    4096: samples per side of a patch. `open_sides` are those on which the raster continues, beyond
    its first row and column, its last row and column; beyond the last ones, whole patches must fit.
    With `is_surface` errors hold for the whole bilinear surface of the samples, not only at
    samples. The measured error takes O(n log(patch)) for n samples, some 0.1 µs each and height.
    """
    valid = np.isfinite(heights)
    if mask is not None:
        valid &= mask
    layout = _layout(heights.shape, patch)
    counts = layout[:, N_ROWS] * layout[:, N_COLS]
    z = np.empty(int(counts.sum()), dtype=np.float32)
    leaves = z[: counts[0]].reshape(layout[0, N_ROWS], layout[0, N_COLS])
    leaves[...] = np.nan
    leaves[: heights.shape[0], : heights.shape[1]] = np.where(valid, heights, np.nan)
    rounding = float(np.abs(heights[valid]).max(initial=0)) * _ROUNDING
    bounds = np.empty((len(z) - leaves.size, 3), dtype=np.float32)
    is_near_void = np.empty(len(z), dtype=np.bool_)
    near = np.zeros(leaves.shape, dtype=np.bool_)
    # The paper's errors do not consider the outline.
    shape = heights.shape if error == "paper" else leaves.shape
    near[: shape[0], : shape[1]] = grown(np.isnan(leaves[: shape[0], : shape[1]]), 1)
    if error != "paper":
        for line, is_open in zip(
            (near[0], near[:, 0], near[-1], near[:, -1]), open_sides, strict=True
        ):
            line |= not is_open
    is_near_void[: leaves.size] = near.ravel()
    for height in range(1, len(layout)):
        _average(height, layout, z, is_near_void)
        if error == "paper":
            _haar_errors(height, layout, z, is_near_void, bounds)
        else:
            _measured_errors(height, is_surface, layout, z, is_near_void, bounds)
    return HaarTree(layout, z, bounds, 0.5 if error == "paper" else 1.0, rounding)


def _layout(shape: tuple[int, ...], patch: int) -> NDArray[np.int64]:
    """Return the layout of a forest that covers a raster."""
    top = patch.bit_length() - 1
    patches = [-(-n // patch) for n in shape]
    layout = np.zeros((top + 1, 3), dtype=np.int64)
    first = 0
    for height in range(top + 1):
        n_rows, n_cols = (n << (top - height) for n in patches)
        layout[height] = first, n_rows, n_cols
        first += n_rows * n_cols
    return layout


@kernel
def _average(height, layout, z, is_near_void):
    """Fill the means of a height's nodes, over those of their four children that are not void."""
    first, n_rows, n_cols = layout[height]
    below, _, n_cols_below = layout[height - 1]
    for row in range(n_rows):
        for col in range(n_cols):
            total, count, is_near = 0.0, 0, False
            for k in range(4):
                child = below + (2 * row + (k >> 1)) * n_cols_below + 2 * col + (k & 1)
                is_near = is_near or is_near_void[child]
                if not np.isnan(z[child]):
                    total += z[child]
                    count += 1
            node = first + row * n_cols + col
            z[node] = total / count if count else np.nan
            is_near_void[node] = is_near


@kernel
def _haar_errors(height, layout, z, is_near_void, bounds):
    """Fill the paper's errors; a void child counts as the mean of the others.

    The box holds the samples below the node.
    """
    first, n_rows, n_cols = layout[height]
    below, _, n_cols_below = layout[height - 1]
    first_inner = layout[1, FIRST]
    values = np.empty(4)
    for row in range(n_rows):
        for col in range(n_cols):
            node = first + row * n_cols + col
            low, high = np.inf, -np.inf
            for k in range(4):
                child = below + (2 * row + (k >> 1)) * n_cols_below + 2 * col + (k & 1)
                is_void = np.isnan(z[child])
                values[k] = z[node] if is_void else z[child]
                if is_void:
                    continue
                if height > 1:
                    low = min(low, bounds[child - first_inner, LOW])
                    high = max(high, bounds[child - first_inner, HIGH])
                else:
                    low, high = min(low, z[child]), max(high, z[child])
            a, b, c, d = values
            largest = max(abs(a - b + c - d), abs(a + b - c - d), abs(a - b - c + d)) / 4
            inner = node - first_inner
            error = OUTLINE if is_near_void[node] else largest
            if np.isnan(z[node]):
                error, low, high = 0.0, 0.0, 0.0
            bounds[inner, ERROR], bounds[inner, LOW], bounds[inner, HIGH] = error, low, high


@kernel
def _measured_errors(height, is_surface, layout, z, is_near_void, bounds):
    """Fill the measured errors of a height's nodes."""
    first, n_rows, n_cols = layout[height]
    below, _, n_cols_below = layout[height - 1]
    first_inner = layout[1, FIRST]
    corners = np.empty((16 << height, 3))
    bound = np.empty(3)
    for row in range(n_rows):
        for col in range(n_cols):
            node = first + row * n_cols + col
            inner = node - first_inner
            if np.isnan(z[node]):
                bounds[inner, ERROR], bounds[inner, LOW], bounds[inner, HIGH] = 0.0, 0.0, 0.0
                continue
            bound[ERROR], bound[LOW], bound[HIGH] = 0.0, z[node], z[node]
            if _has_voids(height, row, col, layout, z):
                _measure_all(height, row, col, is_surface, layout, z, corners, bound)
            else:
                _measure_windows(height, row, col, is_surface, layout, z, corners, bound)
            if height > 1:
                for k in range(4):
                    child = below + (2 * row + (k >> 1)) * n_cols_below + 2 * col + (k & 1)
                    if not np.isnan(z[child]):
                        bound[ERROR] = max(bound[ERROR], bounds[child - first_inner, ERROR])
                        bound[LOW] = min(bound[LOW], bounds[child - first_inner, LOW])
                        bound[HIGH] = max(bound[HIGH], bounds[child - first_inner, HIGH])
            bounds[inner, ERROR] = OUTLINE if is_near_void[node] else bound[ERROR] * (1 + _ROUNDING)
            bounds[inner, LOW] = bound[LOW] - abs(bound[LOW]) * _ROUNDING
            bounds[inner, HIGH] = bound[HIGH] + abs(bound[HIGH]) * _ROUNDING


@kernel
def _has_voids(height, row, col, layout, z):
    """Return whether a sample within a cell's side of its centre is void or outside."""
    side, half = 1 << height, 1 << (height - 1)
    n_rows, n_cols = layout[0, N_ROWS], layout[0, N_COLS]
    first_row, first_col = row * side - half, col * side - half
    if min(first_row, first_col) < 0 or first_row + 2 * side > n_rows:
        return True
    if first_col + 2 * side > n_cols:
        return True
    for r in range(first_row, first_row + 2 * side):
        for c in range(first_col, first_col + 2 * side):
            if np.isnan(z[r * n_cols + c]):
                return True
    return False


@kernel
def _measure_windows(height, row, col, is_surface, layout, z, corners, bound):
    """Widen error and heights by those of the nine windows of a node without voids around it.

    Smaller corners than the listed ones lie below nodes whose samples are all in the window: they
    are means of them.
    """
    middle = np.float64(z[layout[height, FIRST] + row * layout[height, N_COLS] + col])
    side, half, fourth = 1 << height, 1 << (height - 1), max((1 << height) // 4, 1)
    mid_row, mid_col = row * side + half, col * side + half
    window = mid_row - half, mid_col - half, side, side
    _measure(window, is_surface, layout, z, middle, corners, 0, bound)
    for k in range(4):
        down, right = k >> 1, k & 1
        n = _add_node(height, row, col, layout, z, corners, 0)
        n = _add_node(height, row + 2 * down - 1, col, layout, z, corners, n)
        n = _add_node(height, row, col + 2 * right - 1, layout, z, corners, n)
        n = _add_node(height, row + 2 * down - 1, col + 2 * right - 1, layout, z, corners, n)
        r, c = mid_row - side * (1 - down), mid_col - side * (1 - right)
        _measure((r, c, side, side), is_surface, layout, z, middle, corners, n, bound)
    for k in range(4):
        away, is_across = 2 * (k >> 1) - 1, k & 1
        beside_row, beside_col = (row, col + away) if is_across else (row + away, col)
        n = _add_node(height, row, col, layout, z, corners, 0)
        n = _add_node(height, beside_row, beside_col, layout, z, corners, n)
        for m in range(2):
            near, far = (away + 1) // 2, (1 - away) // 2  # halves of the cells that touch
            down, right = (m, near) if is_across else (near, m)
            n = _add_node(height - 1, 2 * row + down, 2 * col + right, layout, z, corners, n)
            down, right = (m, far) if is_across else (far, m)
            r, c = 2 * beside_row + down, 2 * beside_col + right
            n = _add_node(height - 1, r, c, layout, z, corners, n)
        start = -side if away < 0 else 0
        if is_across:
            r, c, n_r, n_c = mid_row - fourth, mid_col + start, 2 * fourth, side
        else:
            r, c, n_r, n_c = mid_row + start, mid_col - fourth, side, 2 * fourth
        _measure((r, c, n_r, n_c), is_surface, layout, z, middle, corners, n, bound)


@kernel
def _measure_all(height, row, col, is_surface, layout, z, corners, bound):
    """Widen error and heights by those of one window around a node, with or without voids.

    All nodes that touch it and are not larger are listed.
    """
    middle = np.float64(z[layout[height, FIRST] + row * layout[height, N_COLS] + col])
    side, half = 1 << height, 1 << (height - 1)
    n = 0
    for h in range(height + 1):
        inside = side >> h
        for r in range(row * inside - 1, (row + 1) * inside + 1):
            is_across = r < row * inside or r >= (row + 1) * inside
            for c in range(
                col * inside - 1, (col + 1) * inside + 1, 1 if is_across else inside + 1
            ):
                n = _add_node(h, r, c, layout, z, corners, n)
    first_row, first_col = max(row * side - half, 0), max(col * side - half, 0)
    end_row = min((row + 1) * side + half, layout[0, N_ROWS])
    end_col = min((col + 1) * side + half, layout[0, N_COLS])
    window = first_row, first_col, end_row - first_row, end_col - first_col
    _measure(window, is_surface, layout, z, middle, corners, n, bound)


@kernel
def _add_node(height, row, col, layout, z, corners, n):
    """Append position and height of a node, if it exists; return the new count."""
    if row < 0 or col < 0 or row >= layout[height, N_ROWS] or col >= layout[height, N_COLS]:
        return n
    value = z[layout[height, FIRST] + row * layout[height, N_COLS] + col]
    if np.isnan(value):
        return n
    side = 1 << height
    corners[n, 0], corners[n, 1] = (row + 0.5) * side - 0.5, (col + 0.5) * side - 0.5
    corners[n, 2] = value
    return n + 1


@kernel
def _place_around(k, first_row, first_col, end_row, end_col):
    """Return the samples whose mean is the k-th half way to those around a window.

    The result is their first row and column, and their numbers: 2 and 1, 1 and 2, or 2 and 2 at
    corners.
    """
    if k < 4:
        return (end_row if k & 1 else first_row - 1), (end_col if k & 2 else first_col - 1), 2, 2
    k -= 4
    n_cols = end_col - first_col + 1
    if k < 2 * n_cols:
        return (end_row if k & 1 else first_row - 1), first_col + k // 2, 2, 1
    k -= 2 * n_cols
    return first_row + k // 2, (end_col if k & 1 else first_col - 1), 1, 2


@kernel
def _measure(window, is_surface, layout, z, middle, corners, n_corners, bound):
    """Widen an error and heights by those of a window (row, col, n_rows, n_cols).

    `middle` is a height near the window's. With `is_surface` the bilinear surface counts up to half
    way to the samples around.
    """
    first_row, first_col, n_rows, n_cols = window
    width = layout[0, N_COLS]
    mid_row, mid_col = first_row + (n_rows - 1) / 2, first_col + (n_cols - 1) / 2
    n = 0
    mean, down, right, across, along = 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(first_row, first_row + n_rows):
        for c in range(first_col, first_col + n_cols):
            value = np.float64(z[r * width + c]) - middle
            if np.isnan(value):
                continue
            n += 1
            mean += value
            down += value * (r - mid_row)
            right += value * (c - mid_col)
            across += (r - mid_row) * (r - mid_row)
            along += (c - mid_col) * (c - mid_col)
    # The least squares plane if there are no voids; otherwise an approximation.
    mean, down, right = middle + mean / max(n, 1), down / max(across, 1.0), right / max(along, 1.0)
    low, high, least, largest = np.inf, -np.inf, np.inf, -np.inf
    for r in range(first_row, first_row + n_rows):
        start = mean + down * (r - mid_row)
        for c in range(first_col, first_col + n_cols):
            value = np.float64(z[r * width + c])
            if np.isnan(value):
                continue
            least, largest = min(least, value), max(largest, value)
            value -= start + right * (c - mid_col)
            low, high = min(low, value), max(high, value)
    if is_surface:
        end_row, end_col = first_row + n_rows - 1, first_col + n_cols - 1
        for k in range(2 * (n_rows + n_cols) + 4):
            r, c, n_r, n_c = _place_around(k, first_row, first_col, end_row, end_col)
            if r < 0 or c < 0 or r + n_r > layout[0, N_ROWS] or c + n_c > width:
                continue
            value = np.float64(z[r * width + c]) + z[(r + n_r - 1) * width + c + n_c - 1]
            value += np.float64(z[r * width + c + n_c - 1]) + z[(r + n_r - 1) * width + c]
            value /= 4
            if np.isnan(value):
                continue
            least, largest = min(least, value), max(largest, value)
            value -= mean + down * (r + (n_r - 1) / 2 - mid_row)
            value -= right * (c + (n_c - 1) / 2 - mid_col)
            low, high = min(low, value), max(high, value)
    sample_low, sample_high = low, high
    for k in range(n_corners):
        value = corners[k, 2]
        least, largest = min(least, value), max(largest, value)
        value -= mean + down * (corners[k, 0] - mid_row) + right * (corners[k, 1] - mid_col)
        low, high = min(low, value), max(high, value)
    error = max(high - sample_low, sample_high - low)
    bound[ERROR] = max(bound[ERROR], min(error, largest - least))
    bound[LOW], bound[HIGH] = min(bound[LOW], least), max(bound[HIGH], largest)
