"""Distances and profiles between selected points."""

import csv
import io
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.file import TerrainFile
from terrainwave.grid.affine import IDENTITY
from terrainwave.place.position import Place, place_of
from terrainwave.place.units import unit_text

# A profile has a sample per pixel of the raster, up to this number.
_MOST_SAMPLES = 2048


class Profile(NamedTuple):
    """Heights along a line of points, straight between them in the file's coordinates."""

    places: NDArray[np.float64]  # shape (n, 2); x, y in the file's coordinates
    # shape (n,); metres from the first, on the ellipsoid or the map, without heights
    distances: NDArray[np.float64]
    heights: NDArray[np.float64]  # shape (n,); in the file's unit; NaN in voids and outside
    metres_per_height: float  # metres per unit of height; negative for depths
    word: str = "height"  # their meaning: ``height``, ``depth`` or ``radius``

    @property
    def upwards(self) -> NDArray[np.float64]:
        """Return the heights in the file's unit, with depths negated."""
        return self.heights if self.metres_per_height > 0 else -self.heights

    @property
    def horizontal(self) -> float:
        """Return the length in metres, without heights."""
        return float(self.distances[-1])

    @property
    def along_surface(self) -> float:
        """Return the length in metres over the surface; level across voids."""
        rises = np.nan_to_num(np.diff(self.heights) * self.metres_per_height)
        return float(np.hypot(np.diff(self.distances), rises).sum())

    @property
    def rise(self) -> float:
        """Return the height of the last point above the first, in the file's unit."""
        return float(self.upwards[-1] - self.upwards[0])

    def csv(self) -> str:
        """Return a table of distances, positions and heights, in the file's units."""
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(["distance_m", "x", "y", self.word])
        for distance, (x, y), height in zip(
            self.distances.tolist(), self.places.tolist(), self.heights.tolist(), strict=True
        ):
            shown = "" if math.isnan(height) else f"{height:.10g}"
            table.writerow([f"{distance:.3f}", repr(x), repr(y), shown])
        return text.getvalue()


class Ruler:
    """Metres of a terrain's coordinates; `radius` as in `frame_of`."""

    def __init__(self, terrain: TerrainFile, radius: float | None = None) -> None:
        raster = terrain.raster_info
        is_placed = tuple(raster.transform) != IDENTITY
        self._place: Place = place_of(
            terrain.crs, terrain.bounds, is_placed=is_placed, radius=radius
        )

    def lengths(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the metres from each point to the next, which is near it; shape (n - 1,).

        On an ellipsoid by its radii of curvature halfway.
        """
        lengths = np.diff(places, axis=0) * self._place.unit
        axis = self._place.longitude_axis
        if axis is None:
            return np.hypot(lengths[:, 0], lengths[:, 1])
        middles = (places[:-1, 1 - axis] + places[1:, 1 - axis]) / 2 * self._place.unit
        radii = np.array([self._place.ellipsoid.radii(latitude) for latitude in middles])
        east = np.radians(lengths[:, axis]) * radii[:, 1] * np.cos(np.radians(middles))
        return np.hypot(east, np.radians(lengths[:, 1 - axis]) * radii[:, 0])


def read_profile(terrain: TerrainFile, ruler: Ruler, points: list[tuple[float, float]]) -> Profile:
    """Return the heights of the finest level along two or more points, read now."""
    corners = np.array(points, dtype=np.float64)
    n_pixels = np.abs(np.diff(corners, axis=0) / terrain.res).max(axis=1)
    shrink = min(1.0, _MOST_SAMPLES / max(float(n_pixels.sum()), 1.0))
    parts = [corners[:1]]
    for start, end, pixels in zip(corners[:-1], corners[1:], n_pixels * shrink, strict=True):
        n = max(math.ceil(pixels), 1)
        parts.append(start + (end - start) * (np.arange(1, n + 1) / n)[:, None])
    places = np.concatenate(parts)
    distances = np.concatenate([[0.0], np.cumsum(ruler.lengths(places))])
    unit = terrain.height_unit
    return Profile(places, distances, terrain.sample(places), unit.metres, unit.word)


def describe_place(terrain: TerrainFile, x: float, y: float, height: float) -> str:
    """Return coordinates, height and the file's bound as a line."""
    place = f"{x:.10g}, {y:.10g}"
    if math.isnan(height):
        return f"{place}: no data"
    return f"{place}: {with_bound(height, terrain.effective_error, _unit(terrain))}"


def describe_profile(terrain: TerrainFile, profile: Profile) -> list[str]:
    lines = [
        f"{distance_text(profile.horizontal)} horizontal,"
        f" {distance_text(profile.along_surface)} along the surface"
    ]
    if np.isnan(profile.heights).any():
        lines[0] += " (level across no data)"
    if not math.isnan(profile.rise):
        bound = 2 * terrain.effective_error
        lines.append(f"height difference {with_bound(profile.rise, bound, _unit(terrain))}")
    return lines


def _unit(terrain: TerrainFile) -> str:
    return unit_text(terrain.units) if terrain.units else ""


def distance_text(length: float) -> str:
    """Return a length in metres as people write it."""
    return f"{length:,.1f} m" if length < 1e5 else f"{length / 1000:,.2f} km"


def with_bound(height: float, bound: float, unit: str) -> str:
    """Return a height with its bound, to two digits of the bound."""
    unit = f" {unit}" if unit else ""
    if not bound:
        return f"{height:.2f}{unit} ± 0{unit}"
    digits = min(max(1 - math.floor(math.log10(bound)), 0), 9)
    return f"{height:.{digits}f}{unit} ± {bound:.{digits}f}{unit}"
