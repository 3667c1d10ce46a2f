"""Bodies: the planet or moon of a CRS."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from terrainwave.place.description import Description
    from terrainwave.place.ellipsoid import Ellipsoid

EARTH, MOON, MARS, OTHER, UNKNOWN = "earth", "moon", "mars", "other", "unknown"
# Bodies by NAIF number, the first digits of the IAU's codes: 49900 is Mars, a sphere.
_IAU = {399: EARTH, 301: MOON, 499: MARS}
# PROJ takes a body for the Earth if its radius is within 0.7 % of this one (0.5 % in PROJ 8); so a
# sphere of 6,370 km is the Earth, as in weather models. Radii of 6,343 to 6,407 km are the Earth's
# by both rules, and no other body is within 4 %.
_EARTH_RADIUS, _EARTH_SHARE = 6_375_000.0, 0.007
# Equatorial radii in metres of other bodies with colours of their own: least and largest.
_RADII = {MOON: (1.730e6, 1.745e6), MARS: (3.36e6, 3.42e6)}


def body_of(description: "Description | None", ellipsoid: "Ellipsoid") -> str:
    if description is not None and description.iau_code is not None:
        return _IAU.get(description.iau_code // 100, OTHER)
    return body_of_radius(ellipsoid.axis)


def body_of_radius(radius: float) -> str:
    if abs(radius - _EARTH_RADIUS) <= _EARTH_SHARE * _EARTH_RADIUS:
        return EARTH
    for name, (least, largest) in _RADII.items():
        if least <= radius <= largest:
            return name
    return OTHER
