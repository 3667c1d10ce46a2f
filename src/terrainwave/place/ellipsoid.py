"""Ellipsoids of revolution: radii of curvature, geocentric coordinates."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# WGS 84: assumed for the Earth if nothing else is stated.
_EARTH_AXIS = 6378137.0
_EARTH_INVERSE_FLATTENING = 298.257223563


class Ellipsoid(NamedTuple):
    """An ellipsoid of revolution: semi-major axis in metres, squared eccentricity."""

    axis: float
    e2: float

    def radii(self, latitude: float) -> tuple[float, float]:
        """Return the radii of curvature (meridian M, prime vertical N) in metres.

        M = a(1 − e²)/(1 − e² sin² φ)^(3/2), N = a/√(1 − e² sin² φ); φ in degrees.
        """
        root = math.sqrt(1 - self.e2 * math.sin(math.radians(latitude)) ** 2)
        return self.axis * (1 - self.e2) / root**3, self.axis / root

    def surface_radius(self, latitudes: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.axis * np.sqrt(self._of_radii(latitudes)[1])

    def heights_of_radii(
        self, latitudes: NDArray[np.float64], radii: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the heights along the normal of points `radii` metres from the centre.

        With N the normal's length, h² + 2 h N (1 − e² sin² φ) + ρ² = r², ρ the ellipsoid's own.
        """
        normal, share = self._of_radii(latitudes)
        surface = self.axis**2 * share
        heights: NDArray[np.float64] = (radii**2 - surface) / (
            normal + np.sqrt(normal**2 + radii**2 - surface)
        )
        return heights

    def _of_radii(
        self, latitudes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return N (1 − e² sin² φ) in metres and (ρ/a)², ρ the distance from the centre."""
        sine = np.sin(np.radians(latitudes)) ** 2
        shrunk = 1 - self.e2 * sine
        return self.axis * np.sqrt(shrunk), (1 - sine * (2 * self.e2 - self.e2**2)) / shrunk

    def geocentric(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return geocentric x, y, z in metres of (longitude, latitude in degrees, height in m)."""
        longitude, latitude = np.radians(points[:, 0]), np.radians(points[:, 1])
        normal = self.axis / np.sqrt(1 - self.e2 * np.sin(latitude) ** 2)
        from_axis = (normal + points[:, 2]) * np.cos(latitude)
        return np.column_stack(
            [
                from_axis * np.cos(longitude),
                from_axis * np.sin(longitude),
                (normal * (1 - self.e2) + points[:, 2]) * np.sin(latitude),
            ]
        )


EARTH = Ellipsoid(
    _EARTH_AXIS, (2 - 1 / _EARTH_INVERSE_FLATTENING) / _EARTH_INVERSE_FLATTENING
)  # e² = f(2 − f)
