"""Measured errors and ranges of blocks."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.coding.native_library import also_in_c
from terrainwave.grid.quadtree import Region

_IN_C = "terrainwave.grid.convert_in_c"
Heights = NDArray[np.int32]
Mask = NDArray[np.bool_]
Number = TypeVar("Number", np.int32, np.float64)


@dataclass
class BlockStats:
    """Statistics of a block: the range of the originals under it, and the error of its heights.

    In quanta; an empty block (all void) has ``z_low > z_high``. `apart`, in 1/4 quanta, is the
    distance of the next level from the block's surface (`distance_of_children`), if requested.
    `has_mesh`: its decoded samples have triangles.
    """

    z_low: int = 1 << 31
    z_high: int = -(1 << 31)
    error: int = 0
    apart: int = 0
    has_mesh: bool = False

    @property
    def is_empty(self) -> bool:
        """Return whether no valid sample lies under the block."""
        return self.z_low > self.z_high

    def merge(self, other: "BlockStats") -> None:
        """Merge statistics of another part of the block."""
        self.z_low = min(self.z_low, other.z_low)
        self.z_high = max(self.z_high, other.z_high)
        self.error = max(self.error, other.error)
        self.apart = max(self.apart, other.apart)
        self.has_mesh |= other.has_mesh


def with_outside(heights: NDArray[Number], n_rows: int, n_cols: int) -> NDArray[Number]:
    """Extend `heights` to (n_rows, n_cols), linearly from the last two rows and columns.

    A coarse level's last row or column may lie past the raster's edge; it is never coded.
    """
    if heights.shape == (n_rows, n_cols):
        return np.ascontiguousarray(heights)
    wide = np.empty((n_rows, n_cols), dtype=heights.dtype)
    rows, cols = heights.shape
    wide[:rows, :cols] = heights
    for col in range(cols, n_cols):
        wide[:rows, col] = 2 * wide[:rows, col - 1] - wide[:rows, max(col - 2, 0)]
    for row in range(rows, n_rows):
        wide[row] = 2 * wide[row - 1] - wide[max(row - 2, 0)]
    return wide


def measure_block(
    heights: Heights,
    stride: int,
    originals: Heights,
    mask: Mask,
    row: int,
    col: int,
    limits: tuple[int, int] | None = None,
) -> int:
    """Return the largest distance of valid originals from the block's bilinear surface.

    Parameters
    ----------
    heights : ndarray of int32
        The block's samples in quanta; its first one lies on full-grid sample (0, 0).
    stride : int
        Full-grid samples per cell of the block.
    originals, mask : ndarray, shape (n_rows, n_cols)
        Full-grid quanta and validity of a window whose first sample is (`row`, `col`).
    limits : tuple of int, optional
        Range of the valid originals, if known.

    Returns
    -------
    int
        Error in quanta, rounded up.
    """
    n_rows, n_cols = originals.shape
    shift = stride.bit_length() - 1
    first_cells = row >> shift, col >> shift
    last_cells = -(-(row + n_rows - 1) // stride), -(-(col + n_cols - 1) // stride)
    needed = max(last_cells[0] + 1, heights.shape[0]), max(last_cells[1] + 1, heights.shape[1])
    heights = with_outside(heights, *needed)
    rows, cols = (slice(one, other + 1) for one, other in zip(first_cells, last_cells, strict=True))
    under = heights[rows, cols]
    low, high = limits or (int(originals.min()), int(originals.max()))
    lowest = min(int(under.min()), low)
    span = max(int(under.max()), high) - lowest
    # Twice the span in the units of the surface must fit.
    dtype = np.int32 if span << 2 * shift + 1 < 1 << 31 else np.int64
    n_places = ((col + n_cols - 1 >> shift) - first_cells[1] + 1) * stride + 1
    # Not empty: a row of the surface above the first one is computed, but not used.
    lines = np.zeros(_N_LINES * n_places, dtype=dtype)
    scaled = largest_deviation(
        heights,
        shift,
        np.ascontiguousarray(originals),
        np.ascontiguousarray(mask),
        row,
        col,
        lowest,
        lines,
        n_places,
    )
    return int(-(-scaled // (stride * stride)))


# Rows of scratch lines in `largest_deviation`: two for halving distances, then `_UPPER` …
_UPPER, _RISE, _SURFACE, _N_LINES = 2, 3, 4, 5


@also_in_c(_IN_C)
@kernel
def largest_deviation(
    heights, shift, originals, mask, first_row, first_col, lowest, lines, n_places
):
    """Return the largest deviation times stride^2; the stride is 2^shift.

    The first original is (`first_row`, `first_col`). `lines` is scratch for `_N_LINES` rows of
    `n_places`, int32 or int64, from that one's cell on. Heights less `lowest` are in units of
    1 / stride^2: below 2^62, as heights are below 2^31 and strides up to 2^15. Halving the distance
    of places `shift` times is exact, and a loop that vectorises, as is going down from one row of
    the surface to the next.
    """
    cast = lines.dtype.type
    n_rows, n_cols = originals.shape
    one, two, twice = np.uint64(1), np.uint64(2), cast(2 * shift)
    first_cell = first_col >> shift
    n, skipped = np.uint64(n_places), np.uint64(first_col - (first_cell << shift))
    upper, rise, surface = n * np.uint64(_UPPER), n * np.uint64(_RISE), n * np.uint64(_SURFACE)
    n_cells = (n_places - 1) >> shift
    # What lies beyond is not in the range that `lines` have room for.
    last_row = (first_row + n_rows - 1 + (1 << shift) - 1) >> shift
    last_col = (first_col + n_cols - 1 + (1 << shift) - 1) >> shift
    largest = cast(0)
    for row in range(-1, n_rows):
        place = first_row + max(row, 0)
        part = place - ((place >> shift) << shift)
        if row <= 0 or part == 0:
            # The row of samples above the first one, then always the one below.
            cell_row = np.uint64(min((place >> shift) + np.int64(row >= 0), last_row))
            now, then = np.uint64(0), n
            for k in range(np.uint64(n_cells + 1)):
                cell = np.uint64(min(first_cell + np.int64(k), last_col))
                lines[now + k] = cast((np.int64(heights[cell_row, cell]) - lowest) << shift)
            n_between = np.uint64(n_cells)
            for _ in range(shift):
                for k in range(n_between):
                    left, right = lines[now + k], lines[now + k + one]
                    lines[then + two * k] = left
                    lines[then + two * k + one] = cast(cast(left + right) >> 1)
                lines[then + two * n_between] = lines[now + n_between]
                n_between = two * n_between
                now, then = then, now
            for k in range(n):
                high, low = lines[upper + k], lines[now + k]
                lines[rise + k] = low - high
                lines[surface + k] = cast(high << cast(shift)) + cast(part) * cast(low - high)
                lines[upper + k] = low
        else:
            for k in range(n):
                lines[surface + k] += lines[rise + k]
        if row < 0:
            continue
        at = np.uint64(row)
        for col in range(np.uint64(n_cols)):
            height = cast(cast(np.int64(originals[at, col]) - lowest) << twice)
            deviation = cast(abs(cast(lines[surface + skipped + col] - height)))
            largest = max(largest, deviation if mask[at, col] else cast(0))
    return np.int64(largest)


def distance_of_children(heights: Heights, finer: Heights, mask: Mask) -> int:
    """Return the largest distance of children's samples from a block's surface: Err_Int.

    E. Yusov, V. Turlapov 2010, §2.2.

    Parameters
    ----------
    heights : ndarray of int32
        The block's samples in quanta.
    finer, mask : ndarray, shape (n_rows, n_cols)
        Heights and validity on the next level; the first samples coincide. Samples past the block's
        last row or column inside the raster are left out.

    Returns
    -------
    int
        In 1/4 quanta, exactly.
    """
    surface = _twice_as_fine(_twice_as_fine(heights.astype(np.int64)).T).T
    n_rows, n_cols = min(surface.shape[0], finer.shape[0]), min(surface.shape[1], finer.shape[1])
    part = np.s_[:n_rows, :n_cols]
    apart = np.abs(surface[part] - 4 * finer[part].astype(np.int64))
    return int(apart[mask[part]].max(initial=0))


def _twice_as_fine(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the rows of `values` and the means of each two between them, all times two."""
    rows = np.repeat(2 * values, 2, axis=0)[:-1]
    rows[1::2] = values[:-1] + values[1:]
    return rows


def measure_samples(originals: Heights, mask: Mask, decoded: Heights, at: Region) -> BlockStats:
    """Return the range of valid originals and their largest distance from `decoded`.

    Uses the region `at` of all three, which begin at sample (0, 0).
    """
    low, high, error = range_and_error(
        np.ascontiguousarray(originals),
        np.ascontiguousarray(mask),
        np.ascontiguousarray(decoded),
        *at,
    )
    return BlockStats() if low > high else BlockStats(int(low), int(high), int(error))


@also_in_c(_IN_C)
@kernel
def range_and_error(originals, mask, decoded, first_row, first_col, n_rows, n_cols):
    """Return (lowest, highest, largest error) of valid samples; without any, lowest > highest.

    Quanta and their differences have 32 bits.
    """
    short = np.int32
    highest, lowest = short((1 << 31) - 1), short(-(1 << 31))
    low, high, error = highest, lowest, short(0)
    for row in range(np.uint64(first_row), np.uint64(first_row + n_rows)):
        for col in range(np.uint64(first_col), np.uint64(first_col + n_cols)):
            height, is_valid = originals[row, col], mask[row, col]
            apart = short(abs(short(height - decoded[row, col])))
            low = min(low, height if is_valid else highest)
            high = max(high, height if is_valid else lowest)
            error = max(error, apart if is_valid else short(0))
    return low, high, error
