"""Which body a raster lies on, and at which latitudes: what its colours depend on."""

import numpy as np

from terrainwave.errors import TerrainwaveError
from terrainwave.export.frames import Place, geographic_base, transform_points

EARTH, MOON, MARS, OTHER, UNKNOWN = "earth", "moon", "mars", "other", "unknown"
# Equatorial radii in metres: the smallest and the largest in use.
_RADII = {EARTH: (6.35e6, 6.39e6), MOON: (1.730e6, 1.745e6), MARS: (3.36e6, 3.42e6)}

# Degrees: pixels of a raster of the whole Earth reach half a pixel too far.
_BEYOND_THE_POLE = 2.0


def body_of(place: Place, radius: float | None) -> str:
    """Return the body that coordinates lie on, by its radius; unknown without CRS and radius."""
    if radius is None and place.crs is None:
        return UNKNOWN
    axis = radius or place.ellipsoid.axis
    for name, (least, largest) in _RADII.items():
        if least <= axis <= largest:
            return name
    return OTHER


def latitudes_of(
    place: Place, bounds: tuple[float, float, float, float]
) -> tuple[float, float] | None:
    """Return the latitudes of the middles of the lower and the upper side of bounds, degrees.

    None where they cannot be told.
    """
    left, bottom, right, top = bounds
    if place.is_geographic:
        south, north = bottom * place.unit, top * place.unit
    elif place.crs is None:
        return None
    else:
        middle = (left + right) / 2
        points = np.array([[middle, bottom], [middle, top]])
        try:
            moved = transform_points(points, place.crs, geographic_base(place.crs))
        except TerrainwaveError:
            return None
        south, north = float(moved[0, 1]), float(moved[1, 1])
    if not max(abs(south), abs(north)) <= 90 + _BEYOND_THE_POLE:  # NaN too
        return None
    return min(max(south, -90.0), 90.0), min(max(north, -90.0), 90.0)
