"""Measured errors and ranges of blocks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel

Heights = NDArray[np.int32]
Mask = NDArray[np.bool_]


@dataclass
class BlockStats:
    """What is known of the originals under a block: their range, and the error of its heights.

    In quanta; an empty block (all void) has ``z_low > z_high``. `apart`, in 1/4 quanta, is how far
    the next level is from the block's surface (`distance_of_children`), where that is asked for.
    """

    z_low: int = 1 << 31
    z_high: int = -(1 << 31)
    error: int = 0
    apart: int = 0

    @property
    def is_empty(self) -> bool:
        """Say whether no valid sample lies under the block."""
        return self.z_low > self.z_high

    def merge(self, other: "BlockStats") -> None:
        """Take in what was measured on another part of the block."""
        self.z_low = min(self.z_low, other.z_low)
        self.z_high = max(self.z_high, other.z_high)
        self.error = max(self.error, other.error)
        self.apart = max(self.apart, other.apart)


def with_outside(heights: Heights, n_rows: int, n_cols: int) -> Heights:
    """Extend `heights` to (n_rows, n_cols), linearly from the last two rows and columns.

    A coarse level's last row or column may lie past the raster's edge; it is never coded.
    """
    if heights.shape == (n_rows, n_cols):
        return np.ascontiguousarray(heights)
    wide = np.empty((n_rows, n_cols), dtype=np.int32)
    rows, cols = heights.shape
    wide[:rows, :cols] = heights
    for col in range(cols, n_cols):
        wide[:rows, col] = 2 * wide[:rows, col - 1] - wide[:rows, max(col - 2, 0)]
    for row in range(rows, n_rows):
        wide[row] = 2 * wide[row - 1] - wide[max(row - 2, 0)]
    return wide


def measure_block(
    heights: Heights, stride: int, originals: Heights, mask: Mask, row: int, col: int
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

    Returns
    -------
    int
        Error in quanta, rounded up.
    """
    last_row, last_col = row + originals.shape[0] - 1, col + originals.shape[1] - 1
    needed = (
        max(-(-last_row // stride) + 1, heights.shape[0]),
        max(-(-last_col // stride) + 1, heights.shape[1]),
    )
    wide = with_outside(heights, *needed)
    shift = stride.bit_length() - 1
    lowest = min(int(wide.min()), int(originals.min()))
    span = max(int(wide.max()), int(originals.max())) - lowest
    # Twice the span in the units of the surface must fit.
    dtype = np.int32 if span << 2 * shift + 1 < 1 << 31 else np.int64
    n_places = (last_col // stride - col // stride + 1) * stride + 1
    lines = np.empty((2, n_places), dtype=dtype)
    scaled = _largest_deviation(wide, shift, originals, mask, row, col, lowest, lines)
    return int(-(-scaled // (stride * stride)))


@kernel
def _largest_deviation(heights, shift, originals, mask, first_row, first_col, lowest, lines):
    """Return the largest deviation times stride^2; the stride is 2^shift.

    `lines` is scratch for two rows of the surface, int32 or int64. Heights less `lowest` are in
    units of 1 / stride^2: below 2^62, as heights are below 2^31 and strides up to 2^15. Halving the
    distance of places `shift` times is exact, and a loop that vectorises.
    """
    cast = lines.dtype.type
    n_rows, n_cols = originals.shape
    stride = np.int64(1) << shift
    first_cell = first_col >> shift
    n_cells = ((first_col + n_cols - 1) >> shift) - first_cell + 1
    skipped = first_col - (first_cell << shift)
    now, then = lines[0], lines[1]
    largest, twice = cast(0), cast(2 * shift)
    one, two = np.uint64(1), np.uint64(2)
    for row in range(n_rows):
        place = first_row + row
        above = place >> shift
        part = place - (above << shift)
        below = above + 1 if part else above
        for k in range(n_cells + 1):
            cell = min(first_cell + k, heights.shape[1] - 1)
            up = np.int64(heights[above, cell]) - lowest
            down = np.int64(heights[below, cell]) - lowest
            now[k] = cast((up * (stride - part) + down * part) << shift)
        n = n_cells
        for _ in range(shift):
            for k in range(np.uint64(n)):
                then[two * k] = now[k]
                then[two * k + one] = cast(cast(now[k] + now[k + one]) >> 1)
            then[2 * n] = now[n]
            n *= 2
            now, then = then, now
        here, is_valid, surface = originals[row], mask[row], now[skipped:]
        for col in range(np.uint64(n_cols)):
            height = cast(cast(np.int64(here[col]) - lowest) << twice)
            deviation = cast(abs(cast(surface[col] - height)))
            largest = max(largest, deviation if is_valid[col] else cast(0))
    return np.int64(largest)


def distance_of_children(heights: Heights, finer: Heights, mask: Mask) -> int:
    """Return how far samples of a block's children are from its bilinear surface: Err_Int.

    D. Yusov, V. Turlapov 2010, §2.2.

    Parameters
    ----------
    heights : ndarray of int32
        The block's samples in quanta.
    finer, mask : ndarray, shape (n_rows, n_cols)
        Those of the next level, the first ones at the same place, and which are valid. Samples past
        the block's last row or column inside the raster are left out.

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


def measure_samples(originals: Heights, mask: Mask, decoded: Heights) -> BlockStats:
    """Return the range of valid originals and their largest distance from `decoded`."""
    return BlockStats(*(int(number) for number in _range_and_error(originals, mask, decoded)))


@kernel
def _range_and_error(originals, mask, decoded):
    """Return (lowest, highest, largest error) of valid samples; 2^31, -2^31, 0 without any."""
    low, high, error = np.int64(1 << 31), np.int64(-(1 << 31)), np.int64(0)
    for row in range(originals.shape[0]):
        here, other, is_valid = originals[row], decoded[row], mask[row]
        for col in range(originals.shape[1]):
            height = np.int64(here[col])
            low = min(low, height if is_valid[col] else low)
            high = max(high, height if is_valid[col] else high)
            error = max(error, abs(height - other[col]) if is_valid[col] else np.int64(0))
    return low, high, error
