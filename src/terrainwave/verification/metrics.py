"""How far decoded heights are from the original ones, summed up window by window."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class ErrorReport:
    """Errors over all samples that are valid in both rasters.

    Attributes
    ----------
    n_valid : int
        Number of samples compared.
    max_error : float
        Largest absolute difference, in the units given to `ErrorSum`; 0 if nothing was compared.
    rmse : float
        Root of the mean squared difference; 0 if nothing was compared.
    worst_row, worst_col : int or None
        The first sample with the largest difference; None if all are equal.
    n_mask_differences : int
        Samples that are valid in one raster and void in the other.
    """

    n_valid: int
    max_error: float
    rmse: float
    worst_row: int | None
    worst_col: int | None
    n_mask_differences: int

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain values for JSON."""
        return asdict(self)


class ErrorSum:
    """Adds up differences over windows; `report` gives the result.

    Differences are taken in float64 (exact for every integer type, and for float32 unless the two
    heights are more than 2^29 times apart) and multiplied by `scale` afterwards.
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
    ) -> np.ndarray:
        """Add the window at (row, col).

        Returns
        -------
        differences : ndarray of float64, shape of the window
            Absolute unscaled differences; 0 where a sample is void in either raster.
        """
        both = valid & decoded_valid
        self._n_mask_differences += int(np.count_nonzero(valid != decoded_valid))
        differences = np.zeros(both.shape, dtype=np.float64)
        # Voids may hold infinities and NaN: they are never subtracted.
        with np.errstate(invalid="ignore"):
            np.subtract(decoded, original, out=differences, where=both, dtype=np.float64)
        np.abs(differences, out=differences)
        # NaN or infinity on one side, which no bound covers and no comparison would find.
        differences[np.isnan(differences)] = np.inf
        self._n_valid += int(np.count_nonzero(both))
        self._squares += float(np.vdot(differences, differences))
        at = int(np.argmax(differences)) if differences.size else 0
        if differences.size and differences.flat[at] > self._largest:
            self._largest = float(differences.flat[at])
            at_row, at_col = divmod(at, differences.shape[1])
            self._worst = row + at_row, col + at_col
        return differences

    def is_within(self, bound: float, dtype: np.dtype[Any]) -> bool:
        """Say whether all unscaled differences are within a bound, rounded to a type as well."""
        rounded = float(dtype.type(self._largest)) if dtype.kind == "f" else self._largest
        return max(self._largest, rounded) <= bound

    def report(self) -> ErrorReport:
        """Return the report so far."""
        worst_row, worst_col = self._worst or (None, None)
        return ErrorReport(
            n_valid=self._n_valid,
            max_error=self._largest * self._scale,
            rmse=math.sqrt(self._squares / max(self._n_valid, 1)) * self._scale,
            worst_row=worst_row,
            worst_col=worst_col,
            n_mask_differences=self._n_mask_differences,
        )
