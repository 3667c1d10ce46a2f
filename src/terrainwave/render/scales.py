"""From quanta of a file to metres of a frame, and from slopes per sample to slopes per metre."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.render.frame import Frame

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile

# Half of float32's spacing, relative.
FLOAT32_ROUNDING = 2.0**-24
# What float16 holds.
_LEAST_SLOPE, _LARGEST_SLOPE = 2.0**-14, 6e4


@dataclass(frozen=True)
class HeightScale:
    """Metres, without exaggeration, of decoded quanta.

    Parameters
    ----------
    per_quantum : float
        Negative where the raster's scale is.
    zero : float
        Metres of quantum 0.
    """

    per_quantum: float
    zero: float

    @classmethod
    def of(cls, terrain: "TerrainFile", frame: Frame) -> Self:
        """Return the scale of a file."""
        header, raster = terrain.header, terrain.raster_info
        quantum = header.quantum.numerator / header.quantum.denominator
        per_unit = frame.metres[2]
        return cls(
            quantum * raster.scale * per_unit,
            (header.base * quantum * raster.scale + raster.offset) * per_unit,
        )

    def metres(self, quanta: NDArray[Any]) -> NDArray[np.float64]:
        """Return heights in metres."""
        return quanta * self.per_quantum + self.zero


@dataclass(frozen=True)
class SlopeScale:
    """Slopes to the east and north of slopes along columns and rows."""

    frame: Frame

    def texels(self, per_sample: NDArray[Any]) -> NDArray[np.float16]:
        """Return slopes per metre as the GPU takes them, of metres per sample of the full grid.

        Both have shape (..., 2).
        """
        a, b, _, d, e, _ = self.frame.sample_matrix
        # The inverse of the transposed matrix.
        slopes = per_sample @ np.linalg.inv(np.array([[a, b], [d, e]]))
        slopes[np.abs(slopes) < _LEAST_SLOPE] = 0
        return np.clip(slopes, -_LARGEST_SLOPE, _LARGEST_SLOPE).astype(np.float16)
