"""Errors of decoded heights, accumulated window by window."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class ErrorReport:
    """Errors over all samples that are valid in both rasters.

    `n_valid`: number of compared samples.
    `max_error`: largest absolute difference, in the units given to `ErrorSum`; 0 if nothing was
        compared.
    `rmse`: root of the mean squared difference; 0 if nothing was compared.
    `worst_row`, `worst_col`: the first sample with the largest difference; None if all are equal.
    `n_mask_differences`: samples that are valid in one raster and void in the other.
    """

    n_valid: int
    max_error: float
    rmse: float
    worst_row: int | None
    worst_col: int | None
    n_mask_differences: int


class ErrorSum:
    """Adds up differences over windows; `report` gives the result.

    Differences are taken in float64, and of short integers in int32 (exact for every integer type,
    and for float32 unless the two heights are more than 2^29 times apart), and multiplied by
    `scale` afterwards.
    """

    def __init__(self, scale: float = 1.0) -> None:
        self._scale = abs(scale)
        self._n_valid = 0
        self._squares = 0.0
        self._largest = 0.0
        self._worst: tuple[int, int] | None = None
        self._n_mask_differences = 0

    def add(
        self,
        row: int,
        col: int,
        original: np.ndarray,
        decoded: np.ndarray,
        valid: np.ndarray,
        decoded_valid: np.ndarray,
        n_alike: int = 1,
    ) -> np.ndarray:
        """Add a window; a sample stands for `n_alike`. Return unscaled absolute differences."""
        both = valid & decoded_valid
        n_both, n_one = np.count_nonzero(both), np.count_nonzero(valid != decoded_valid)
        self._n_mask_differences += n_alike * int(n_one)
        self._n_valid += n_alike * int(n_both)
        if original.dtype.kind in "iu" and original.dtype.itemsize <= 2:
            differences = _small_differences(original, decoded, both, is_whole=n_both == both.size)
        else:
            differences = _differences(original, decoded, both)
        if not differences.size:
            return differences
        at = int(np.argmax(differences))
        largest = float(differences.flat[at])
        self._squares += n_alike * _sum_of_squares(differences, largest)
        if largest > self._largest:
            self._largest = largest
            at_row, at_col = divmod(at, differences.shape[1])
            self._worst = row + at_row, col + at_col
        return differences

    def is_within(self, bound: float, dtype: np.dtype[Any]) -> bool:
        """Return whether all unscaled differences are within a bound, also rounded to a type."""
        rounded = float(dtype.type(self._largest)) if dtype.kind == "f" else self._largest
        return max(self._largest, rounded) <= bound

    def report(self) -> ErrorReport:
        worst_row, worst_col = self._worst or (None, None)
        return ErrorReport(
            n_valid=self._n_valid,
            max_error=self._largest * self._scale,
            rmse=math.sqrt(self._squares / max(self._n_valid, 1)) * self._scale,
            worst_row=worst_row,
            worst_col=worst_col,
            n_mask_differences=self._n_mask_differences,
        )


def _differences(original: np.ndarray, decoded: np.ndarray, both: np.ndarray) -> np.ndarray:
    differences = np.zeros(both.shape, dtype=np.float64)
    # Voids may hold infinities and NaN: they are never subtracted.
    with np.errstate(invalid="ignore"):
        np.subtract(decoded, original, out=differences, where=both, dtype=np.float64)
    np.abs(differences, out=differences)
    # NaN or infinity on one side, which no bound covers and no comparison would find.
    differences[np.isnan(differences)] = np.inf
    return differences


def _small_differences(
    original: np.ndarray, decoded: np.ndarray, both: np.ndarray, *, is_whole: bool
) -> np.ndarray:
    differences: np.ndarray = np.subtract(decoded, original, dtype=np.int32)
    if not is_whole:
        np.copyto(differences, 0, where=~both)
    return np.abs(differences, out=differences)


def _sum_of_squares(differences: np.ndarray, largest: float) -> float:
    if largest == 0:
        return 0.0
    if differences.dtype.kind == "i" and largest**2 * differences.shape[1] < 2**31:
        return float(np.einsum("ij,ij->i", differences, differences).sum(dtype=np.int64))
    return float(np.vdot(differences, differences.astype(np.float64, copy=False)))
