"""Conversion of a file's quanta to metres of a frame, and to slopes and heights in textures."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.file import TerrainFile
from terrainwave.render.scene.frame import Frame
from terrainwave.render.scene.patch_kernels import fill_texels

# Half of float32's spacing, relative.
FLOAT32_ROUNDING = 2.0**-24
# Limits of float16.
_LEAST_SLOPE, _LARGEST_HEIGHT = 2.0**-14, 6e4


@dataclass(frozen=True)
class HeightScale:
    """Metres, without exaggeration, of decoded quanta."""

    per_quantum: float  # negative if the raster's scale is
    zero: float  # metres of quantum 0

    @classmethod
    def of(cls, terrain: TerrainFile, frame: Frame) -> Self:
        header, raster = terrain.header, terrain.raster_info
        quantum = header.quantum.numerator / header.quantum.denominator
        return cls(
            quantum * raster.scale * frame.metres[2],
            frame.to_metres(header.base * quantum * raster.scale + raster.offset),
        )

    def metres(self, quanta: NDArray[Any]) -> NDArray[np.float64]:
        return quanta * self.per_quantum + self.zero


@dataclass(frozen=True)
class HeightTexels:
    """Heights in a float16 texture, for colouring: (metres - reference) / scale.

    Half a metre in a thousand is lost, except near the reference: the sea's level if the raster
    includes it, else the nearest height.
    """

    reference: float
    scale: float

    @classmethod
    def of(cls, frame: Frame) -> Self:
        low, high = frame.height_range
        reference = min(max(0.0, low), high)
        largest = max(reference - low, high - reference)
        return cls(reference, max(largest / _LARGEST_HEIGHT, 1.0))


class Texels:
    """Slopes and heights of samples as stored in textures. Thread-safe.

    The frame's east and north are the directions of slopes.
    """

    def __init__(self, frame: Frame, scale: HeightScale) -> None:
        a, b, _, d, e, _ = frame.sample_matrix
        self._slopes = np.linalg.inv(np.array([[a, b], [d, e]])).T.ravel() * scale.per_quantum
        heights = HeightTexels.of(frame)
        shift = (scale.zero - heights.reference) / heights.scale
        self._heights = np.array([scale.per_quantum / heights.scale, shift, _LARGEST_HEIGHT])

    def of(
        self,
        samples: tuple[NDArray[Any], NDArray[np.bool_]],  # quanta of a level, and validity
        # row and column in them at which the texture begins; may be negative
        first: tuple[int, int],
        # rows and columns for which the texture has values of its own; the nearest of these are
        # repeated
        inner: tuple[int, int],
        shape: tuple[int, int],  # of the texture
        stride: int,  # samples of the full grid between two
    ) -> NDArray[np.float16]:
        """Return a texture of a part of samples, float16 (n_rows, n_cols, 3).

        Metres per metre to the east and to the north, and heights (`HeightTexels`).
        """
        texels = np.empty((shape[0], 3 * shape[1]), dtype=np.uint16)
        slopes_of = np.array([*self._slopes / stride, _LEAST_SLOPE])
        fill_texels(*samples, *first, *inner, slopes_of, self._heights, texels)
        return texels.view(np.float16).reshape(*shape, 3)
