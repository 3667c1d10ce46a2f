"""Local metres: x east, y north, z up, from the middle of the raster."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError, InvalidHeightsError
from terrainwave.grid.affine import (
    IDENTITY,
    pixels_to_places,
    places_to_pixels,
    samples_to_places,
)
from terrainwave.grid.quadtree import Region
from terrainwave.place.bodies import UNKNOWN
from terrainwave.place.position import LocalAxes, place_of
from terrainwave.place.units import height_unit

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile

Numbers = TypeVar("Numbers", float, NDArray[np.float64])

# Depth of the block's base below the lowest height, as a share of the raster's extent; at least
# these metres.
_BASE_SHARE, _LEAST_DEPTH = 0.035, 1.0
_SEEN_RELIEF = 0.004
_LEAST_RELIEF, _MOST_DETAIL = 0.02, 1 / 256
# Assumed range of sight, in the eye's heights over the lowest ground; more than in any view of all.
_SEEN_HEIGHTS = 8.0
# Degrees: rasters around a pole are drawn with the length of degrees here.
_MOST_LATITUDE = 89.9


@dataclass(frozen=True)
class Frame:
    """Conversion of samples and world coordinates to local metres."""

    centre: tuple[float, float]  # x, y in the CRS of the local origin
    # metres per unit of x, y and height, without exaggeration; > 0, except for heights that are
    # depths: up is positive in local metres
    metres: tuple[float, float, float]
    # (a, b, c, d, e, f): local x = a col + b row + c, y = d col + e row + f of full-grid samples
    sample_matrix: tuple[float, float, float, float, float, float]
    shape: tuple[int, int]  # rows and columns of the full grid
    heights: tuple[float, float]  # lowest and highest height in the file's unit
    exaggeration: float = 1.0  # local z is the height in metres times this
    body: str = UNKNOWN  # one of `place.bodies`' names
    # in degrees, at the middle of the lower and the upper side
    latitudes: tuple[float, float] | None = None
    # metres to the east and north of steps along x and y; by default x points east and y north
    axes: LocalAxes | None = None
    zero: float = 0.0  # the number in the file's unit at local z 0: for radii the body's own

    @cached_property
    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lowest and highest corner of the terrain in local metres, read-only."""
        first, last = self.sides_of(Region(0, 0, *self.shape))
        z = np.array(self.height_range) * self.exaggeration
        low, high = np.array([*first, z.min()]), np.array([*last, z.max()])
        low.flags.writeable = high.flags.writeable = False
        return low, high

    def sides_of(self, region: Region, stride: int = 1) -> tuple[list[float], list[float]]:
        """Return the lowest and highest local x, y of a region of every `stride`-th sample."""
        rows = np.array([region.row, region.row + region.n_rows - 1]) * stride
        cols = np.array([region.col, region.col + region.n_cols - 1]) * stride
        xy = self.samples_to_local(np.repeat(rows, 2), np.tile(cols, 2))
        return xy.min(axis=0).tolist(), xy.max(axis=0).tolist()

    def to_metres(self, heights: Numbers) -> Numbers:
        """Return metres upwards, without exaggeration, of numbers in the file's unit."""
        return (heights - self.zero) * self.metres[2]

    @property
    def height_range(self) -> tuple[float, float]:
        """Return the metres of the lowest and the highest place, without exaggeration."""
        low, high = sorted(self.to_metres(height) for height in self.heights)
        return low, high

    @property
    def error_metres(self) -> float:
        """Return the metres per unit of an error: > 0, also for depths."""
        return abs(self.metres[2])

    @cached_property
    def spacing(self) -> float:
        """Return the distance of full-grid samples, local metres; the larger of two."""
        a, b, _, d, e, _ = self.sample_matrix
        return max(math.hypot(a, d), math.hypot(b, e))

    @property
    def base(self) -> float:
        """Return the local z of the plane on which the terrain stands as a block."""
        low, high = self.box
        width, length = (high - low)[:2]
        return float(low[2]) - max(_BASE_SHARE * math.sqrt(width * length), _LEAST_DEPTH)

    @property
    def solid_box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        low, high = self.box
        return np.array([low[0], low[1], self.base]), high.copy()

    @property
    def outline(self) -> NDArray[np.float64]:
        """Return local x, y of the raster's four corners, in order around it, shape (4, 2)."""
        n_rows, n_cols = self.shape
        return self.samples_to_local(
            np.array([0, 0, n_rows - 1, n_rows - 1]), np.array([0, n_cols - 1, n_cols - 1, 0])
        )

    def detail(self, eye: NDArray[np.float64]) -> float:
        """Return the factor of τ for the flatness of the terrain seen from an eye, at most 1.

        Blocks selected by τ also carry light and colours, and there are mountains and coasts to see
        even if the relief is tiny, as on a planet: errors count as if the relief was a fiftieth of
        the visible extent, which is that of the raster, or of the surroundings of an eye near the
        ground.
        """
        relief, extent = self._relief_and_extent
        above = max(float(eye[2]) - float(self.box[0][2]), 0.0)
        seen = min(extent, _SEEN_HEIGHTS * above)
        if not 0 < relief < _LEAST_RELIEF * seen:
            return 1.0
        return max(relief / (_LEAST_RELIEF * seen), _MOST_DETAIL)

    @property
    def suggested_exaggeration(self) -> float | None:
        """Return a factor for heights too small to be visible, such as a planet's.

        With it they are a fiftieth of the raster's extent, or slightly less. None if they are
        visible, or already exaggerated.
        """
        relief, extent = self._relief_and_extent
        if self.exaggeration != 1.0 or not 0 < relief < _SEEN_RELIEF * extent:
            return None
        return round_length(_LEAST_RELIEF * extent / relief)

    @property
    def _relief_and_extent(self) -> tuple[float, float]:
        low, high = self.box
        return float(high[2] - low[2]), math.hypot(*(high - low)[:2])

    def matrix_of(self, region: Region, stride: int) -> tuple[float, ...]:
        """Return `sample_matrix` of every `stride`-th sample, counted from a region's first."""
        a, b, c, d, e, f = self.sample_matrix
        row, col = region.row * stride, region.col * stride
        x, y = a * col + b * row + c, d * col + e * row + f
        return a * stride, b * stride, x, d * stride, e * stride, y

    def samples_to_local(self, rows: NDArray[Any], cols: NDArray[Any]) -> NDArray[np.float64]:
        """Return local x, y of full-grid samples, shape (n, 2)."""
        return np.column_stack(pixels_to_places(self.sample_matrix, rows, cols))

    def samples_at(self, xy: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return rows and columns of the full grid under local x, y; the inverse."""
        return places_to_pixels(self.sample_matrix, xy[:, 0], xy[:, 1])

    def to_local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return local metres of (x, y, height) in the file's CRS and unit."""
        shift = np.array([*self.centre, self.zero])
        local: NDArray[np.float64] = (points - shift) @ self._matrix.T
        return local

    def to_world(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (x, y, height) in the file's CRS and unit; the inverse of `to_local`."""
        world: NDArray[np.float64] = points @ np.linalg.inv(self._matrix).T
        return world + np.array([*self.centre, self.zero])

    @cached_property
    def _matrix(self) -> NDArray[np.float64]:
        per_x, per_y, per_height = self.metres
        matrix = np.diag([per_x, per_y, per_height * self.exaggeration])
        if self.axes is not None:
            matrix[:2, :2] = self.axes.matrix
        return matrix

    def exaggerated(self, factor: float) -> "Frame":
        """Return the frame with another vertical exaggeration."""
        if not (math.isfinite(factor) and factor > 0):
            raise InvalidArgumentError(f"found `exaggeration` {factor}, expected a number > 0")
        return replace(self, exaggeration=float(factor))


def round_length(largest: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above `largest` (> 0)."""
    power = 10.0 ** math.floor(math.log10(largest))
    return max(digit * power for digit in (1, 2, 5) if digit * power <= largest * (1 + 1e-12))


def check_drawable(terrain: "TerrainFile") -> None:
    """Raise `InvalidHeightsError` for a terrain below 2 x 2 samples or without a valid one."""
    n_rows, n_cols = terrain.shape
    if min(n_rows, n_cols) < 2:
        raise InvalidHeightsError(
            f"there is nothing to draw: a surface needs 2 x 2 samples, the raster has {n_rows} x"
            f" {n_cols}"
        )
    if terrain.info().minimum is None:
        raise InvalidHeightsError("there is nothing to draw: the raster has voids only")


def frame_of(
    terrain: "TerrainFile", *, radius: float | None = None, exaggeration: float = 1.0
) -> Frame:
    """Return the frame of a terrain.

    Degrees are scaled at the centre by the radii of the CRS's ellipsoid, or of a sphere of `radius`
    metres; feet become metres.
    """
    raster = terrain.raster_info
    a, b, _, d, e, _ = raster.transform
    n_rows, n_cols = terrain.shape
    rows = np.array([0, 0, n_rows - 1, n_rows - 1], dtype=np.float64)
    cols = np.array([0, n_cols - 1, 0, n_cols - 1], dtype=np.float64)
    x, y = samples_to_places(raster.transform, rows, cols)
    outline = float(x.min()), float(y.min()), float(x.max()), float(y.max())
    is_placed = tuple(raster.transform) != IDENTITY
    place = place_of(terrain.crs, outline, is_placed=is_placed, radius=radius)
    left, bottom, right, top = outline
    centre_x, centre_y = (left + right) / 2, (bottom + top) / 2
    axes = place.local_axes(centre_x, centre_y, most=_MOST_LATITUDE)
    linear = axes.matrix @ np.array([[a, b], [d, e]])
    first = axes.matrix @ np.array([x[0] - centre_x, y[0] - centre_y])
    info = terrain.info()
    unit = height_unit(raster.units, raster.crs, raster.heights_are)
    unit.note_kind()
    zero = place.surface_radius(centre_x, centre_y) / unit.metres if unit.is_radius else 0.0
    frame = Frame(
        (centre_x, centre_y),
        (*axes.lengths, unit.metres),
        (*linear[0].tolist(), float(first[0]), *linear[1].tolist(), float(first[1])),
        terrain.shape,
        (info.minimum or 0.0, info.maximum or 0.0),
        body=place.body,
        latitudes=place.side_latitudes(outline),
        axes=axes,
        zero=zero,
    )
    return frame.exaggerated(exaggeration)
