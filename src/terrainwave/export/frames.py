"""Coordinate frames of exported meshes: the CRS itself, local metres, geocentric metres."""

import contextlib
import math
import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import (
    InvalidArgumentError,
    InvalidHeightsError,
    TerrainwaveWarning,
)
from terrainwave.export.mesh import Mesh
from terrainwave.extras import need

if TYPE_CHECKING:
    from rasterio.crs import CRS

FRAMES = ("local", "native", "ecef")

# WGS 84: taken for the Earth where nothing says otherwise.
_EARTH_AXIS = 6378137.0
_EARTH_INVERSE_FLATTENING = 298.257223563

_SURVEY_FOOT = 1200 / 3937
_METRES = {
    "m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0,
    "cm": 0.01, "centimetre": 0.01, "centimetres": 0.01, "centimeter": 0.01, "centimeters": 0.01,
    "dm": 0.1, "mm": 0.001, "km": 1000.0, "kilometre": 1000.0, "kilometer": 1000.0,
    "ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "international foot": 0.3048,
    "ftus": _SURVEY_FOOT, "us-ft": _SURVEY_FOOT, "us survey foot": _SURVEY_FOOT,
    "us survey feet": _SURVEY_FOOT, "foot_us": _SURVEY_FOOT, "us_survey_foot": _SURVEY_FOOT,
    "survey foot": _SURVEY_FOOT, "foot (us survey)": _SURVEY_FOOT, "sftus": _SURVEY_FOOT,
    "yd": 0.9144, "yard": 0.9144,
}  # fmt: skip


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


@dataclass(frozen=True)
class Place:
    """How the coordinates of a mesh lie on a body.

    Parameters
    ----------
    is_geographic : bool
        x and y are longitude and latitude.
    unit : float
        Degrees (geographic) or metres (else) per unit of x and y.
    ellipsoid : Ellipsoid
    crs : rasterio CRS, optional
    """

    is_geographic: bool
    unit: float
    ellipsoid: Ellipsoid
    crs: "CRS | None"


def find_place(mesh: Mesh, *, radius: float | None = None, has_frames: bool = False) -> Place:
    """Say how the mesh's coordinates are meant; see `place_of`."""
    is_placed = mesh.attributes.get("is_placed") is not False
    return place_of(
        mesh.crs, mesh.bounds, is_placed=is_placed, radius=radius, has_frames=has_frames
    )


def place_of(
    crs_text: str | None,
    bounds: tuple[float, float, float, float],
    *,
    is_placed: bool = True,
    radius: float | None = None,
    has_frames: bool = False,
) -> Place:
    """Say how coordinates are meant, from their CRS; guess and warn where there is none.

    Parameters
    ----------
    crs_text : str, optional
        ``AUTH:CODE`` or WKT.
    bounds : (left, bottom, right, top)
        What the coordinates span; told from where there is no CRS.
    is_placed : bool
        False for an array without a place, whose columns and rows are no degrees.
    radius : float, optional
        Radius in metres of the sphere that geographic coordinates lie on, instead of the CRS's
        ellipsoid.
    has_frames : bool
        Whether who asks has an argument `frame` too, which the warning can name.

    Raises
    ------
    InvalidHeightsError
        If `radius` is not positive, or is given for coordinates that are not geographic.
    """
    if radius is not None and not (math.isfinite(radius) and radius > 0):
        raise InvalidArgumentError(f"found `radius` {radius}, expected metres > 0")
    crs = _parsed(crs_text)
    if crs is None:
        place = _guess(bounds, is_placed, radius, has_frames)
    elif crs.is_geographic:
        unit = math.degrees(float(crs.units_factor[1]))
        place = Place(True, unit, ellipsoid_of(crs), crs)
    else:
        place = Place(False, _metres_of_crs(crs), ellipsoid_of(crs), crs)
    if radius is not None:
        if not place.is_geographic:
            raise InvalidArgumentError(
                f"found `radius` {radius:g}, but the coordinates are not degrees: it has no use"
            )
        place = replace(place, ellipsoid=Ellipsoid(float(radius), 0.0))
    return place


def _parsed(crs_text: str | None) -> "CRS | None":
    if crs_text is None:
        return None
    from terrainwave.raster_io.crs import parse_crs

    return parse_crs(crs_text)


_AS_THEY_ARE = ", `frame` native leaves them as they are"


def _guess(
    bounds: tuple[float, float, float, float],
    is_placed: bool,
    radius: float | None,
    has_frames: bool,
) -> Place:
    left, bottom, right, top = bounds
    fits = -360 <= left and right <= 360 and -90 <= bottom and top <= 90
    if not (fits and is_placed):
        return Place(False, 1.0, EARTH, None)
    body = "the Earth" if radius is None else f"a sphere of {radius:g} m"
    warnings.warn(
        f"there is no coordinate reference system; the coordinates fit degrees on {body} and are"
        f" taken for them (`radius` gives another body{_AS_THEY_ARE * has_frames})",
        TerrainwaveWarning,
        stacklevel=2,
    )
    return Place(True, 1.0, EARTH, None)


def ellipsoid_of(crs: "CRS") -> Ellipsoid:
    """Return the ellipsoid of a CRS; WGS 84 where it has none.

    Raises
    ------
    TerrainwaveError
        If pyproj is missing: rasterio does not say.
    """
    known = _by_pyproj(crs)
    ellipsoid = None if known is None else known.ellipsoid
    if ellipsoid is None or not ellipsoid.semi_major_metre > 0:
        return EARTH
    inverse = ellipsoid.inverse_flattening  # 0: a sphere
    flattening = 1 / inverse if inverse > 1 else 0.0
    return Ellipsoid(ellipsoid.semi_major_metre, flattening * (2 - flattening))


def _by_pyproj(crs: "CRS") -> Any:
    """Return pyproj's CRS, or None if it does not read what rasterio writes."""
    from rasterio.errors import CRSError

    pyproj = need("pyproj", extra="mesh", purpose="a coordinate reference system")
    for version in ("WKT2_2019", "WKT1_GDAL"):
        with contextlib.suppress(CRSError, pyproj.exceptions.CRSError):
            return pyproj.CRS.from_wkt(crs.to_wkt(version=version))
    return None


def _metres_of_crs(crs: "CRS") -> float:
    """Return the metres per unit of a CRS that is not geographic."""
    from rasterio.errors import CRSError

    try:
        factor = float(crs.linear_units_factor[1])
    except (CRSError, ValueError):
        return 1.0
    return factor if factor > 0 else 1.0


def metres_per_unit(units: str | None) -> float:
    """Return the metres of one vertical unit; 1 where it is not told, or (warned) not known."""
    if units is None or not units.strip():
        return 1.0
    name = " ".join(units.lower().replace("[", " ").replace("]", " ").split())
    if name not in _METRES:
        warnings.warn(
            f"the vertical unit {units!r} is not known and taken for metres",
            TerrainwaveWarning,
            stacklevel=2,
        )
    return _METRES.get(name, 1.0)


def unit_text(units: str | None) -> str:
    """Return a vertical unit as labels have it."""
    return units.strip() if units and units.strip() else "unit unknown"


def axis_labels(crs_text: str | None, *, is_placed: bool = True) -> tuple[str, str]:
    """Return the names of x and y of a CRS, with their unit."""
    if not is_placed:
        return "x, samples", "y, samples"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)  # opening the file has told it
        crs = _parsed(crs_text)
    if crs is None:
        return "x, unit unknown", "y, unit unknown"
    if crs.is_geographic:
        return "longitude, degrees", "latitude, degrees"
    unit = (crs.linear_units or "").strip()
    unit = "m" if unit.lower() in ("metre", "meter") else unit_text(unit.replace("unknown", ""))
    return f"easting, {unit}", f"northing, {unit}"


def to_frame(
    mesh: Mesh,
    frame: str | None = None,
    *,
    z_scale: float = 1.0,
    radius: float | None = None,
) -> Mesh:
    """Return the mesh in a frame; `error` stays in the file's unit.

    Parameters
    ----------
    mesh : Mesh
        In the coordinates of its CRS.
    frame : {"local", "native", "ecef"}, optional
        ``local``: metres from the middle of the mesh, x to the east, y to the north, z the height.
        Degrees are scaled by the ellipsoid's radii of curvature there; feet become metres.
        ``native``: coordinates of the CRS, heights in the file's unit. ``ecef``: geocentric metres
        on the ellipsoid of the CRS, heights taken as above that ellipsoid. By default ``local``
        for geographic coordinates, else ``native``.
    z_scale : float
        Heights are multiplied by it; > 0.
    radius : float, optional
        Radius of the sphere in metres that degrees lie on, instead of the CRS's ellipsoid.

    Returns
    -------
    mesh : Mesh
        ``attributes["frame"]`` tells what was done: ``name``, ``z_scale``, ``unit`` and, for
        ``local``, ``centre`` in the CRS and ``metres`` per unit of x, y and height.

    Raises
    ------
    InvalidHeightsError
        If an option is out of range or the frame cannot be had.
    """
    if frame is not None and frame not in FRAMES:
        raise InvalidArgumentError(f"found `frame` {frame!r}, expected one of {', '.join(FRAMES)}")
    if not (math.isfinite(z_scale) and z_scale > 0):
        raise InvalidArgumentError(f"found `z_scale` {z_scale}, expected a number > 0")
    if not mesh.n_triangles:
        raise InvalidHeightsError("the mesh is empty: there are no valid heights under it")
    if frame == "native" and radius is None:
        return _native(mesh, z_scale)
    place = find_place(mesh, radius=radius, has_frames=True)
    frame = frame or ("local" if place.is_geographic else "native")
    if frame == "native":
        return _native(mesh, z_scale)
    if frame == "local":
        return _local(mesh, place, z_scale)
    return _ecef(mesh, place, z_scale)


def _native(mesh: Mesh, z_scale: float) -> Mesh:
    x, y, height = mesh.origin
    return replace(
        mesh,
        vertices=mesh.vertices * (1.0, 1.0, z_scale),
        origin=(x, y, height * z_scale),
        attributes=_attributes(mesh, "native", z_scale, mesh.units),
    )


def _local(mesh: Mesh, place: Place, z_scale: float) -> Mesh:
    left, bottom, right, top = mesh.bounds
    centre = ((left + right) / 2, (bottom + top) / 2)
    if place.is_geographic:
        latitude = centre[1] * place.unit
        meridian, normal = place.ellipsoid.radii(latitude)
        per_x = math.radians(place.unit) * normal * math.cos(math.radians(latitude))
        per_y = math.radians(place.unit) * meridian
        if abs(latitude) > 89.99:
            raise InvalidArgumentError(
                f"the middle of the mesh is at latitude {latitude:g}, where degrees of longitude"
                " have no length; expected `frame` ecef or native"
            )
    else:
        per_x = per_y = place.unit
    per_z = metres_per_unit(mesh.units)
    # The origin is subtracted last but one: vertices are small numbers, the origin is not.
    shift = np.array([mesh.origin[0] - centre[0], mesh.origin[1] - centre[1], mesh.origin[2]])
    vertices = (mesh.vertices + shift) * (per_x, per_y, per_z * z_scale)
    attributes = _attributes(mesh, "local", z_scale, "m")
    attributes["frame"] |= {"centre": list(centre), "metres": [per_x, per_y, per_z]}
    return replace(mesh, vertices=vertices, origin=(0.0, 0.0, 0.0), attributes=attributes)


def _ecef(mesh: Mesh, place: Place, z_scale: float) -> Mesh:
    points = geographic_points(mesh, place)
    points[:, 2] *= z_scale
    vertices = place.ellipsoid.geocentric(points)
    centre = np.round((vertices.min(axis=0) + vertices.max(axis=0)) / 2)
    attributes = _attributes(mesh, "ecef", z_scale, "m")
    return replace(
        mesh,
        vertices=vertices - centre,
        origin=(float(centre[0]), float(centre[1]), float(centre[2])),
        attributes=attributes,
    )


def geographic_points(mesh: Mesh, place: Place, target: "CRS | None" = None) -> NDArray[np.float64]:
    """Return (longitude, latitude in degrees, height in metres) of the vertices.

    Parameters
    ----------
    mesh : Mesh
    place : Place
        `find_place` of the mesh.
    target : rasterio CRS, optional
        Geographic system to go to; by default the one that the mesh's CRS is based on.

    Raises
    ------
    InvalidHeightsError
        If the mesh has no CRS that could be told from, or a point cannot be transformed.
    """
    points = mesh.points
    points[:, 2] *= metres_per_unit(mesh.units)
    if place.is_geographic and (target is None or place.crs is None):
        points[:, :2] *= place.unit
        return points
    if place.crs is None:
        raise InvalidHeightsError(
            "there is no coordinate reference system to tell longitudes and latitudes from"
        )
    points[:, :2] = _transform(points[:, :2], place.crs, target or geographic_base(place.crs))
    return points


def geographic_base(crs: "CRS") -> "CRS":
    """Return the geographic CRS that a projected or compound CRS is based on."""
    from rasterio.crs import CRS

    known = _by_pyproj(crs)
    base = None if known is None else known.geodetic_crs
    if base is None or not base.is_geographic:
        raise InvalidHeightsError(
            "the coordinate reference system has no longitudes and latitudes behind it"
        )
    return CRS.from_wkt(base.to_2d().to_wkt())


def _transform(xy: NDArray[np.float64], source: "CRS", target: "CRS") -> NDArray[np.float64]:
    moved = transform_points(xy, source, target)
    if not np.isfinite(moved).all():
        raise InvalidHeightsError(
            "a part of the mesh has no longitude and latitude in its coordinate reference system"
        )
    return moved


def transform_points(xy: NDArray[np.float64], source: "CRS", target: "CRS") -> NDArray[np.float64]:
    """Return points of one CRS in another, shape (n_points, 2).

    Raises
    ------
    InvalidHeightsError
        If a point has no place there.
    """
    from rasterio.warp import transform

    from terrainwave.raster_io.gdal import GDAL_ERRORS, one_line

    try:
        moved: Any = np.array(transform(source, target, xy[:, 0], xy[:, 1])).T
    except GDAL_ERRORS as error:
        raise InvalidHeightsError(f"cannot transform coordinates: {one_line(error)}") from error
    return np.asarray(moved, dtype=np.float64).reshape(-1, 2)


def transform_where_possible(
    xy: NDArray[np.float64], source: "CRS", target: "CRS"
) -> NDArray[np.float64]:
    """Return points of one CRS in another; NaN where one has no place there.

    PROJ gives up on all points for one: their halves are tried apart.
    """
    if not len(xy):
        return xy
    try:
        moved = transform_points(xy, source, target)
    except InvalidHeightsError:
        if len(xy) == 1:
            return np.full((1, 2), np.nan)
        half = len(xy) // 2
        parts = (xy[:half], xy[half:])
        return np.concatenate([transform_where_possible(part, source, target) for part in parts])
    moved[~np.isfinite(moved).all(axis=1)] = np.nan
    return moved


def _attributes(mesh: Mesh, name: str, z_scale: float, unit: str | None) -> dict[str, Any]:
    return mesh.attributes | {"frame": {"name": name, "z_scale": z_scale, "unit": unit}}


def areas(mesh: Mesh) -> NDArray[np.float64]:
    """Return twice the areas of the triangles seen from above; positive is counter-clockwise."""
    xy = mesh.vertices[:, :2]
    a, b, c = (xy[mesh.triangles[:, corner]] for corner in range(3))
    along, across = b - a, c - a
    twice: NDArray[np.float64] = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    return twice


def steepest(mesh: Mesh) -> tuple[float, float]:
    """Return the largest |∂z/∂x| and |∂z/∂y| of the triangles that face upwards."""
    corners = mesh.vertices[mesh.triangles[areas(mesh) > 0]]
    if not len(corners):
        return 0.0, 0.0
    along, across = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(along, across)
    slopes = np.abs(normals[:, :2] / normals[:, 2:])
    return float(slopes[:, 0].max()), float(slopes[:, 1].max())
