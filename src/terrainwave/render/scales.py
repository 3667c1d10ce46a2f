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
_LEAST_SLOPE, _LARGEST_SLOPE = 2.0**-14, 6e4
_LARGEST_HEIGHT = 6e4


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

    def texels(self, per_sample: NDArray[Any]) -> NDArray[np.float16]:
        """Return slopes per metre as the GPU takes them, of metres per sample of the full grid.

        Both have shape (..., 2).
        """
        a, b, _, d, e, _ = self.frame.sample_matrix
        # The inverse of the transposed matrix.
        slopes = per_sample @ np.linalg.inv(np.array([[a, b], [d, e]]))
        slopes[np.abs(slopes) < _LEAST_SLOPE] = 0
        return np.clip(slopes, -_LARGEST_SLOPE, _LARGEST_SLOPE).astype(np.float16)


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

    def beside(
        self, slopes: NDArray[np.float16], metres: NDArray[np.float64], valid: NDArray[np.bool_]
    ) -> NDArray[np.float16]:
        """Return slopes and heights, shape (n_rows, n_cols, 3).

        `metres` and `valid` have one sample more on each side, (n_rows + 2, n_cols + 2): voids
        take the mean of the valid ones around, so that colours don't change beside them.
        """
        heights = metres[1:-1, 1:-1] - self.reference
        rows, cols = np.nonzero(~valid[1:-1, 1:-1])
        if len(rows):
            total, n_valid = np.zeros(len(rows)), np.zeros(len(rows))
            for row, col in np.ndindex(3, 3):
                beside = rows + row, cols + col
                total += np.where(valid[beside], metres[beside] - self.reference, 0.0)
                n_valid += valid[beside]
            heights[rows, cols] = total / np.maximum(n_valid, 1)
        heights /= self.scale
        texels = np.clip(heights, -_LARGEST_HEIGHT, _LARGEST_HEIGHT, out=heights)
        return np.concatenate([slopes, texels[..., None].astype(np.float16)], axis=-1)


def with_ring(samples: NDArray[Any], inner: tuple[slice, slice]) -> NDArray[Any]:
    """Return a part of samples and one more on each side, the last ones again where they end."""
    padded = np.pad(samples, 1, mode="edge")
    rows, cols = inner
    return padded[rows.start : rows.stop + 2, cols.start : cols.stop + 2]
