"""`Place`: position of coordinates on a body, for all other packages."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import checked_number
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError, TerrainwaveWarning
from terrainwave.place.bodies import EARTH as THE_EARTH
from terrainwave.place.bodies import UNKNOWN, body_of_radius
from terrainwave.place.description import DERIVED, GEOGRAPHIC, OTHER, describe_quietly
from terrainwave.place.ellipsoid import EARTH, Ellipsoid
from terrainwave.place.system import System, system_of

Numbers = NDArray[np.float64]

_EAST_NORTH = (1.0, 0.0), (0.0, 1.0)
# Degrees: pixels of a raster of the whole Earth extend half a pixel beyond it.
_BEYOND_THE_POLE = 2.0
# Degrees: beyond this a degree of longitude has almost no length.
_NEAR_THE_POLE = 89.99
# Columns by which a raster may differ from a whole turn.
_SAME_COLUMN = 0.01


class LocalAxes(NamedTuple):
    """Metres to the east and to the north of a step along x and along y."""

    x: tuple[float, float]
    y: tuple[float, float]

    @property
    def matrix(self) -> Numbers:
        """Return M, so that (east, north) = M (x, y), shape (2, 2)."""
        return np.array([self.x, self.y]).T

    @property
    def lengths(self) -> tuple[float, float]:
        return math.hypot(*self.x), math.hypot(*self.y)

    @property
    def is_mirrored(self) -> bool:
        return self.x[0] * self.y[1] < self.x[1] * self.y[0]

    @property
    def names(self) -> tuple[str, str]:
        return _direction(*self.x), _direction(*self.y)


def _direction(east: float, north: float) -> str:
    if abs(east) >= abs(north):
        return "east" if east > 0 else "west"
    return "north" if north > 0 else "south"


@dataclass(frozen=True)
class Place:
    """Position of coordinates on a body.

    `kind` is that of `description`; `unit` degrees or metres per unit of x and y; `ellipsoid` that
    of the CRS, or a sphere chosen by the user (`has_own_radius`: degrees stay unchanged);
    `directions` those of steps along x and along y; `system` None without a CRS.
    """

    kind: str
    unit: float
    ellipsoid: Ellipsoid
    body: str
    directions: tuple[tuple[float, float], tuple[float, float]] = _EAST_NORTH
    system: System | None = None
    has_own_radius: bool = False

    @property
    def in_degrees(self) -> bool:
        return self.kind in (GEOGRAPHIC, DERIVED)

    @property
    def is_plain(self) -> bool:
        return self.kind == GEOGRAPHIC

    @property
    def has_globe(self) -> bool:
        return self.in_degrees or self.system is not None

    @property
    def longitude_axis(self) -> int | None:
        """Return which of x (0) and y (1) is a longitude, also of a derived system."""
        if not self.in_degrees:
            return None
        return 0 if self.directions[0][0] else 1

    @property
    def globe_ellipsoid(self) -> Ellipsoid:
        """Return the ellipsoid of `to_lonlat`'s degrees: for the Earth always WGS 84."""
        return EARTH if self.body in (THE_EARTH, UNKNOWN) else self.ellipsoid

    @cached_property
    def is_lonlat(self) -> bool:
        """Return whether `to_lonlat` changes nothing but the unit."""
        if self.kind != GEOGRAPHIC or self.directions != _EAST_NORTH:
            return False
        if self.system is None or self.has_own_radius:
            return True
        system = self.system
        return bool(self.unit == 1 and system.flat.equals(system.globe, ignore_axis_order=True))

    def to_lonlat(self, xy: Numbers) -> Numbers:
        """Return longitudes and latitudes of points in degrees, NaN if one has none.

        On WGS 84 for the Earth, else on the datum of the CRS.
        """
        if self.is_lonlat:
            return xy * self.unit
        if self._is_turned_lonlat:
            return (xy * self.unit) @ np.array(self.directions)
        return self._system().to_globe(xy)

    def from_lonlat(self, lonlat: Numbers) -> Numbers:
        if self.is_lonlat:
            return lonlat / self.unit
        if self._is_turned_lonlat:
            return lonlat @ np.array(self.directions).T / self.unit
        return self._system().from_globe(lonlat)

    @property
    def _is_turned_lonlat(self) -> bool:
        return self.kind == GEOGRAPHIC and self.has_own_radius

    def _system(self) -> System:
        if self.system is None:
            raise InvalidHeightsError(
                "there is no coordinate reference system to tell longitudes and latitudes from"
            )
        return self.system

    def note_sphere(self) -> None:
        """Warn if degrees of a sphere are taken for those of WGS 84."""
        if self.body == THE_EARTH and self.ellipsoid.e2 == 0:
            warnings.warn(
                f"the coordinates are counted on a sphere of {self.ellipsoid.axis:,.10g} m, which"
                " is taken for the Earth; latitudes are kept as they are, as PROJ and GDAL do",
                TerrainwaveWarning,
                stacklevel=3,
            )

    def latitude(self, x: float, y: float) -> float:
        return self.unit * (x * self.directions[0][1] + y * self.directions[1][1])

    def local_axes(self, x: float, y: float, *, most: float | None = None) -> LocalAxes:
        """Return the metres of steps along x and along y at a point.

        Degrees use the ellipsoid's radii of curvature there; lengths on maps are used directly.
        `most` is a latitude in degrees that replaces all beyond it. Without it points at a pole,
        where degrees of longitude have no length, raise `InvalidArgumentError`.
        """
        east = north = self.unit
        if self.in_degrees:
            latitude = self.latitude(x, y)
            if most is not None:
                latitude = min(max(latitude, -most), most)
            elif abs(latitude) > _NEAR_THE_POLE:
                raise InvalidArgumentError(
                    f"the middle of the mesh is at latitude {latitude:g}, where degrees of"
                    " longitude have no length; expected `frame` ecef or native"
                )
            meridian, normal = self.ellipsoid.radii(latitude)
            east *= math.radians(normal) * math.cos(math.radians(latitude))
            north *= math.radians(meridian)
        along_x, along_y = self.directions
        return LocalAxes(
            (along_x[0] * east, along_x[1] * north), (along_y[0] * east, along_y[1] * north)
        )

    def surface_radius(self, x: float, y: float) -> float:
        if self.ellipsoid.e2 == 0 or not self.has_globe:
            return self.ellipsoid.axis
        latitude = self.to_lonlat(np.array([[x, y]]))[:, 1]
        return float(self.ellipsoid.surface_radius(np.nan_to_num(latitude))[0])

    def side_latitudes(
        self, bounds: tuple[float, float, float, float]
    ) -> tuple[float, float] | None:
        """Return the latitudes at the middle of the southern and the northern side of bounds.

        In degrees; for a map around a pole those of the lower and the upper side. None if they are
        unknown.
        """
        left, bottom, right, top = bounds
        points = np.array([[(left + right) / 2, (bottom + top) / 2]] * 2)
        axis = 1 if self.directions[1][1] else 0
        points[:, axis] = bounds[axis], bounds[axis + 2]
        if self.directions[axis][1] < 0:
            points = points[::-1]
        try:
            south, north = self.to_lonlat(points)[:, 1].tolist()
        except InvalidHeightsError:
            return None
        if not max(abs(south), abs(north)) <= 90 + _BEYOND_THE_POLE:  # also NaN
            return None
        return min(max(south, -90.0), 90.0), min(max(north, -90.0), 90.0)


def place_of(
    crs_text: str | None,
    bounds: Sequence[float],
    *,
    is_placed: bool = True,
    radius: float | None = None,
    has_frames: bool = False,
) -> Place:
    """Return the position of coordinates by their CRS; without one, guess by `bounds` and warn.

    `is_placed` is false for an array without georeference. Degrees lie on a sphere of `radius`
    metres, if given, instead of the CRS's ellipsoid. With `has_frames` the warning names `frame`,
    too.
    """
    if radius is not None:
        radius = checked_number("radius", radius, above=0, expected="metres > 0")
    system = system_of(crs_text)
    if system is None:
        place = _guess(bounds, is_placed, radius, has_frames)
    else:
        told = system.description
        place = Place(
            told.kind, told.x.factor, system.ellipsoid, system.body, told.directions, system
        )
    if radius is None:
        return place
    if not place.in_degrees:
        raise InvalidArgumentError(
            f"found `radius` {radius:g}, but the coordinates are not degrees: it has no use"
        )
    sphere = Ellipsoid(float(radius), 0.0)
    return replace(place, ellipsoid=sphere, body=body_of_radius(radius), has_own_radius=True)


_AS_THEY_ARE = ", `frame` native leaves them as they are"


def _guess(
    bounds: Sequence[float], is_placed: bool, radius: float | None, has_frames: bool
) -> Place:
    left, bottom, right, top = bounds
    fits = -360 <= left and right <= 360 and -90 <= bottom and top <= 90
    if not (fits and is_placed):
        return Place(OTHER, 1.0, EARTH, UNKNOWN)
    body = "the Earth" if radius is None else f"a sphere of {radius:g} m"
    warnings.warn(
        f"there is no coordinate reference system; the coordinates fit degrees on {body} and are"
        f" taken for them (`radius` gives another body{_AS_THEY_ARE * has_frames})",
        TerrainwaveWarning,
        stacklevel=3,
    )
    return Place(GEOGRAPHIC, 1.0, EARTH, UNKNOWN)


def axis_labels(crs_text: str | None, *, is_placed: bool = True) -> tuple[str, str]:
    if not is_placed:
        return "x, samples", "y, samples"
    told = describe_quietly(crs_text)
    if told is None:
        return "x, unit unknown", "y, unit unknown"
    prefix = "grid " if told.kind == DERIVED else ""
    return prefix + told.x.label, prefix + told.y.label


def axis_attributes(crs_text: str | None) -> tuple[dict[str, str], dict[str, str]]:
    x_attrs, y_attrs = {"axis": "X"}, {"axis": "Y"}
    told = describe_quietly(crs_text)
    if told is not None and told.in_degrees:
        names = {"longitude": "degrees_east", "latitude": "degrees_north"}
        if told.kind == DERIVED:
            names = {"grid_longitude": "degrees", "grid_latitude": "degrees"}
        order = list(names.items())
        if not told.directions[0][0]:
            order.reverse()
        for attrs, (name, unit) in zip((x_attrs, y_attrs), order, strict=True):
            attrs |= {"standard_name": name, "units": unit}
        return x_attrs, y_attrs
    x_attrs["standard_name"] = "projection_x_coordinate"
    y_attrs["standard_name"] = "projection_y_coordinate"
    if told is not None and told.kind != OTHER:
        x_attrs["units"], y_attrs["units"] = told.x.unit, told.y.unit
    return x_attrs, y_attrs


class Turn(NamedTuple):
    """The longitude among x (0) and y (1), and the number of its units in a whole turn."""

    axis: int
    length: float

    def is_whole(self, transform: tuple[float, ...], n_cols: int) -> bool:
        """Return whether rows are parallels around the whole globe, within `_SAME_COLUMN`."""
        a, b, _, d, _, _ = transform
        if self.axis != 0 or not b == d == 0:
            return False
        return abs(self.length / abs(a) - n_cols) < _SAME_COLUMN

    def near(
        self, places: NDArray[np.float64], bounds: tuple[float, float, float, float]
    ) -> NDArray[np.float64]:
        """Return points moved to longitudes within half a turn of the bounds' middle; copies."""
        middle = (bounds[self.axis] + bounds[self.axis + 2]) / 2
        moved = places.copy()
        with np.errstate(invalid="ignore"):
            turns = np.rint((places[:, self.axis] - middle) / self.length)
            is_far = np.abs(places[:, self.axis] - middle) > self.length / 2
            moved[is_far, self.axis] -= turns[is_far] * self.length
        return moved


def longitude_turn(crs_text: str | None) -> Turn | None:
    """Return the period of a CRS's longitudes; None if it has none. Needs no pyproj."""
    told = describe_quietly(crs_text)
    if told is None or not told.in_degrees:
        return None
    axis = 0 if told.directions[0][0] else 1
    return Turn(axis, 360 / (told.x, told.y)[axis].factor)
