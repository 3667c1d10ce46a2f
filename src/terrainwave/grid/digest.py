"""Digest of a raster's heights that does not depend on the order of reading.

Each valid sample gives 64 bits that depend on its position and on the bits of its height; the
digest is their sum modulo 2^64. Windows of any shape, threads and machines give the same sum. It
detects changes, not forgeries.

The mixing function is the finaliser of splitmix64 (Steele, Lea & Flood 2014).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_PLACE, _FIRST, _SECOND = (
    np.uint64(number) for number in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
)
# Samples at a time, so that intermediate values stay in the processor's cache.
_CHUNK = 1 << 14
_MASK = (1 << 64) - 1


class HeightDigest:
    """Sum over all windows so far; call `update` with every sample once.

    Parameters
    ----------
    n_cols : int
        Columns of the whole raster.
    """

    def __init__(self, n_cols: int) -> None:
        self._n_cols = n_cols
        self._sum = 0

    def update(
        self, raw: NDArray[np.generic], valid: NDArray[np.bool_], row: int, col: int
    ) -> None:
        """Add the window whose first sample is at (row, col)."""
        bits = np.ascontiguousarray(raw).view(f"u{raw.dtype.itemsize}")
        n_rows, n_cols = raw.shape
        width = min(n_cols, _CHUNK)
        height = max(_CHUNK // max(width, 1), 1)
        # A position beyond 64 bits would need more than 2^50 samples, which no file holds.
        for top in range(0, n_rows, height):
            for left in range(0, n_cols, width):
                part = np.s_[top : top + height, left : left + width]
                self._sum += _sum_of(bits[part], valid[part], row + top, col + left, self._n_cols)
        self._sum &= _MASK

    def merge(self, other: "HeightDigest") -> None:
        """Add another digest of the same raster."""
        self._sum = (self._sum + other._sum) & _MASK

    def take(self, text: str) -> None:
        """Continue from a digest of windows that will not be added again."""
        self._sum = int(text, 16)

    @property
    def text(self) -> str:
        """Return the digest as 16 hexadecimal digits."""
        return f"{self._sum:016x}"


def _sum_of(bits: NDArray[Any], valid: NDArray[np.bool_], row: int, col: int, n_cols: int) -> int:
    """Return the sum over the valid samples of a part; below 2^64 times their number."""
    rows = np.arange(row, row + bits.shape[0], dtype=np.uint64) * np.uint64(n_cols)
    mixed = rows[:, np.newaxis] + np.arange(col + 1, col + 1 + bits.shape[1], dtype=np.uint64)
    # Mixed before and after the height, so that no two samples are interchangeable.
    mixed *= _PLACE
    _mix(mixed)
    mixed ^= bits
    _mix(mixed)
    mixed *= valid
    return int(mixed.sum(dtype=np.uint64))


def _mix(words: NDArray[np.uint64]) -> None:
    """Mix the bits of each word, in place."""
    words ^= words >> np.uint64(30)
    words *= _FIRST
    words ^= words >> np.uint64(27)
    words *= _SECOND
    words ^= words >> np.uint64(31)
