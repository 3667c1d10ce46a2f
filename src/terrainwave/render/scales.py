"""From quanta of a file to metres of a frame, and to slopes and heights as textures hold them."""

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
_LEAST_SLOPE, _LARGEST_HEIGHT = 2.0**-14, 6e4


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

    def terms(self, factor: float) -> NDArray[np.float64]:
        """Return what `kernels.fill_texels` takes for slopes of heights in a unit.

        `factor`: metres of a unit, per sample of the full grid between two samples.
        """
        a, b, _, d, e, _ = self.frame.sample_matrix
        inverse = np.linalg.inv(np.array([[a, b], [d, e]])) * factor
        return np.array([*inverse.T.ravel(), _LEAST_SLOPE])


@dataclass(frozen=True)
class HeightTexels:
    """Heights as a texture of float16 holds them, to colour by: (metres - reference) / scale.

    Half a metre in a thousand is lost, but next to the reference: the sea's level where the raster
    has one, else what is nearest to it.
    """

    reference: float
    scale: float

    @classmethod
    def of(cls, frame: Frame) -> Self:
        """Return the one that fits the heights of a frame."""
        low, high = sorted(height * frame.metres[2] for height in frame.heights)
        reference = min(max(0.0, low), high)
        largest = max(reference - low, high - reference)
        return cls(reference, max(largest / _LARGEST_HEIGHT, 1.0))

    def terms(self, heights: HeightScale) -> NDArray[np.float64]:
        """Return what `kernels.fill_texels` takes for heights in quanta."""
        shift = (heights.zero - self.reference) / self.scale
        return np.array([heights.per_quantum / self.scale, shift, _LARGEST_HEIGHT])
