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

    In quanta; an empty block (all void) has ``z_low > z_high``.
    """

    z_low: int = 1 << 31
    z_high: int = -(1 << 31)
    error: int = 0

    @property
    def is_empty(self) -> bool:
        """Say whether no valid sample lies under the block."""
        return self.z_low > self.z_high

    def merge(self, other: "BlockStats") -> None:
        """Take in what was measured on another part of the block."""
        self.z_low = min(self.z_low, other.z_low)
        self.z_high = max(self.z_high, other.z_high)
        self.error = max(self.error, other.error)


def with_outside(heights: Heights, n_rows: int, n_cols: int) -> Heights:
    """Extend `heights` to (n_rows, n_cols), linearly from the last two rows and columns.

    A coarse level's last row or column may lie past the raster's edge; it is never coded.
    """
    if heights.shape == (n_rows, n_cols):
        return heights
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
    scaled = _largest_deviation(
        with_outside(heights, *needed),
        stride,
        originals,
        mask,
        row,
        col,
        np.empty(needed[1], dtype=np.int64),
        np.empty(originals.shape[1], dtype=np.int64),
    )
    return int(-(-scaled // (stride * stride)))


@kernel
def _largest_deviation(heights, stride, originals, mask, first_row, first_col, line, surface):
    """Return the largest deviation times stride^2; stride is a power of two.

    `line` and `surface` are int64 scratch, one per column of the block and of the window.
    |heights| < 2^31 and stride <= 2^15 keep every product below 2^62.
    """
    n_rows, n_cols = originals.shape
    square = np.int64(stride) * stride
    first_cell = first_col // stride
    last_cell = (first_col + n_cols - 1) // stride
    last_line = min(last_cell + 1, heights.shape[1] - 1)
    largest = np.int64(0)
    for row in range(n_rows):
        place = first_row + row
        above = place // stride
        part = place - above * stride
        below = above + 1 if part else above
        for cell in range(first_cell, last_line + 1):
            line[cell] = (
                np.int64(heights[above, cell]) * (stride - part)
                + np.int64(heights[below, cell]) * part
            )
        for cell in range(first_cell, last_cell + 1):
            start = max(cell * stride, first_col)
            stop = min((cell + 1) * stride, first_col + n_cols)
            slope = line[cell + 1] - line[cell] if cell < last_line else np.int64(0)
            value = line[cell] * stride + slope * (start - cell * stride)
            for col in range(start - first_col, stop - first_col):
                surface[col] = value
                value += slope
        here, is_valid = originals[row], mask[row]
        for col in range(n_cols):
            deviation = abs(surface[col] - np.int64(here[col]) * square)
            largest = max(largest, deviation if is_valid[col] else np.int64(0))
    return largest


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
