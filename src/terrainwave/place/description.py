"""Description of a coordinate reference system: axes, units, the vertical part, the body.

Read from its PROJJSON, which GDAL writes; needs no pyproj. GDAL and PROJ order axes as on maps: x
is the second axis if the first one points north and the second one east; all other orders are kept.
"""

import contextlib
import math
import warnings
from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

from terrainwave.errors import TerrainwaveWarning

GEOGRAPHIC, DERIVED, PROJECTED, OTHER = "geographic", "derived", "projected", "other"
_KINDS = {
    "GeographicCRS": GEOGRAPHIC,
    "DerivedGeographicCRS": DERIVED,
    "DerivedGeodeticCRS": DERIVED,
    "ProjectedCRS": PROJECTED,
    "DerivedProjectedCRS": PROJECTED,
}
_INNER = ("source_crs", "base_crs")
# Names of ellipsoidal vertical systems and datums, in GeoTIFF's keys and ESRI's WKT.
_ELLIPSOIDAL = ("ellipsoid", "ellipsoidal")
_HORIZONTAL = {"east": (1.0, 0.0), "west": (-1.0, 0.0), "north": (0.0, 1.0), "south": (0.0, -1.0)}
_UNIT_LABELS = {"metre": "m", "meter": "m", "degree": "degrees", "unknown": "unit unknown"}
_CACHED = 64
# Degrees, and the share of a pixel by which samples may lie beyond the pole.
_POLE, _OF_A_PIXEL = 90.0, 0.1
# Degrees: rasters from 180 to 540 are whole turns, too.
_MOST_LONGITUDE = 540.0


class Axis(NamedTuple):
    """Axis of x or y: its name, direction and unit, and metres or degrees per unit."""

    name: str
    direction: str
    unit: str
    factor: float

    @property
    def label(self) -> str:
        name = self.name.split("(")[0].strip().lower().removeprefix("geodetic ")
        return f"{name or 'coordinate'}, {_UNIT_LABELS.get(self.unit.lower(), self.unit)}"


class Vertical(NamedTuple):
    """Vertical axis of a CRS, with metres per unit.

    `name` is that of the vertical CRS, such as ``NAVD88 height``; of a CRS with three axes that of
    the axis, and `datum` is empty. `is_down`: numbers are depths; `is_ellipsoidal`: heights are
    above the ellipsoid, not above a geoid or a tide.
    """

    name: str
    unit: str
    metres: float
    is_down: bool
    is_ellipsoidal: bool
    datum: str = ""


class Description(NamedTuple):
    """Properties of a CRS, as plain values; x and y in the order of GDAL's coordinates.

    `kind` is ``geographic``: plain longitudes and latitudes; ``derived``: those of a rotated pole
    or another derived system; ``projected``; or ``other``: local and geocentric ones. `iau_code` is
    the code if the authority is the IAU, `radius` the ellipsoid's semi-major axis in metres.
    """

    kind: str
    x: Axis
    y: Axis
    vertical: Vertical | None
    iau_code: int | None
    radius: float | None = None

    @property
    def in_degrees(self) -> bool:
        return self.kind in (GEOGRAPHIC, DERIVED)

    @property
    def directions(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return (east, north) of steps along x and y; right and up if they are not stated."""
        along_x, along_y = (_HORIZONTAL.get(axis.direction) for axis in (self.x, self.y))
        if along_x is None or along_y is None or 0 == _cross(along_x, along_y):
            return (1.0, 0.0), (0.0, 1.0)
        return along_x, along_y


def _cross(a: tuple[float, float], b: tuple[float, float]) -> float:
    return a[0] * b[1] - a[1] * b[0]


def describe_crs(crs_text: str | None) -> Description | None:
    """Return the description of a CRS; None, with `parse_crs`'s warning, if it cannot be read."""
    found = describe_quietly(crs_text)
    if found is None:
        from terrainwave.place.crs import parse_crs

        parse_crs(crs_text)
    return found


def describe_quietly(crs_text: str | None) -> Description | None:
    """Return `describe_crs`'s result without a warning, which opening the file has issued."""
    return None if crs_text is None else _described(crs_text)


@lru_cache(_CACHED)
def _described(crs_text: str) -> Description | None:
    from rasterio.errors import CRSError

    from terrainwave.place.crs import parse_crs

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TerrainwaveWarning)
        crs = parse_crs(crs_text)
    told = dict[str, Any]()
    with contextlib.suppress(CRSError, ValueError, TypeError):
        told = {} if crs is None else crs.to_dict(projjson=True)
    return None if crs is None else read_projjson(told)


def read_projjson(told: dict[str, Any]) -> Description:
    flat, vertical = _parts(told)
    axes = flat.get("coordinate_system", {}).get("axis", [])
    x, y = (
        [_axis(axis) for axis in axes[:2]]
        if len(axes) > 1
        else [Axis("easting", "east", "unknown", 1.0), Axis("northing", "north", "unknown", 1.0)]
    )
    are_swapped = x.name.lower().startswith("northing") and y.name.lower().startswith("easting")
    around_pole = are_swapped and x.direction == y.direction
    if (x.direction, y.direction) == ("north", "east") or around_pole:
        x, y = y, x
    kind = _KINDS.get(str(flat.get("type")), OTHER)
    if flat.get("coordinate_system", {}).get("subtype") == "spherical" and len(axes) == 2:
        kind = GEOGRAPHIC  # longitudes and planetocentric latitudes
    return Description(kind, x, y, _vertical(vertical, axes), _iau_code(told), _radius(flat))


def added_vertical(one: Any, other: Any) -> tuple[str, str] | None:
    told = [crs.to_dict(projjson=True) for crs in (one, other)]
    for compound, plain in (told, told[::-1]):
        parts = compound.get("components", [])
        if len(parts) == 2 and "components" not in plain and _core(parts[0]) == _core(plain):
            own, first, second = (
                part.get("id", {}) for part in (compound, parts[0] | plain, parts[1])
            )
            text = "with the WKT of the other"
            if own:
                text = f"{own['authority']}:{own['code']}"
            elif first and second and first["authority"] == second["authority"]:
                text = f"{first['authority']}:{first['code']}+{second['code']}"
            return str(parts[1].get("name", "")), text
    return None


def _core(told: Any) -> Any:
    if isinstance(told, dict):
        left_out = ("$schema", "id", "ids", "scope", "area", "bbox", "usages", "remarks")
        return {key: _core(value) for key, value in told.items() if key not in left_out}
    return [_core(value) for value in told] if isinstance(told, list) else told


def _parts(told: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any] | None]:
    while told.get("type") == "BoundCRS":
        told = told.get("source_crs", {})
    if told.get("type") != "CompoundCRS":
        return told, None
    components = told.get("components") or [{}]
    vertical = components[1] if len(components) > 1 else None
    while vertical is not None and vertical.get("type") == "BoundCRS":
        vertical = vertical.get("source_crs", {})
    return _parts(components[0])[0], vertical


def _axis(axis: dict[str, Any]) -> Axis:
    unit = axis.get("unit", "unknown")
    if isinstance(unit, dict):
        name, factor = str(unit.get("name", "unknown")), float(unit.get("conversion_factor", 1.0))
        if unit.get("type") == "AngularUnit":
            factor = math.degrees(factor)
    else:
        name, factor = str(unit), 1.0
    usable = math.isfinite(factor) and factor > 0
    direction = str(axis.get("direction", "")).lower()
    return Axis(str(axis.get("name", "")), direction, name, factor if usable else 1.0)


def _vertical(vertical: dict[str, Any] | None, axes: list[dict[str, Any]]) -> Vertical | None:
    if vertical is not None:
        own = vertical.get("coordinate_system", {}).get("axis", [])
        if not own:
            return None
        axis, name = _axis(own[0]), str(vertical.get("name", ""))
        about = vertical.get("datum") or vertical.get("datum_ensemble") or {}
        datum = str(about.get("name", ""))
        words = f"{name} {datum}".lower().replace("_", " ").split()
        is_ellipsoidal = any(word in words for word in _ELLIPSOIDAL)
    elif len(axes) > 2 and str(axes[2].get("direction")).lower() in ("up", "down"):
        axis = _axis(axes[2])
        name, datum, is_ellipsoidal = axis.name, "", True
    else:
        return None
    is_down = axis.direction == "down"
    return Vertical(name, axis.unit, axis.factor, is_down, is_ellipsoidal, datum)


def _radius(told: dict[str, Any]) -> float | None:
    for owner in (told.get("datum"), told.get("datum_ensemble")):
        ellipsoid = (owner or {}).get("ellipsoid", {})
        axis = ellipsoid.get("semi_major_axis", ellipsoid.get("radius"))
        if isinstance(axis, dict):
            unit = axis.get("unit")
            factor = unit.get("conversion_factor", 1.0) if isinstance(unit, dict) else 1.0
            axis = float(axis.get("value", math.nan)) * float(factor)
        if isinstance(axis, int | float) and math.isfinite(axis) and axis > 0:
            return float(axis)
    inner = (told[key] for key in _INNER if key in told)
    return next((radius for part in inner if (radius := _radius(part)) is not None), None)


def _iau_code(told: dict[str, Any]) -> int | None:
    """Return the code of the first system, from the outside in, whose authority is the IAU."""
    name = told.get("id") or {}
    if str(name.get("authority", "")).upper().startswith("IAU"):
        with contextlib.suppress(TypeError, ValueError):
            return int(name["code"])
    inner = [told[key] for key in _INNER if key in told] + told.get("components", [])[:1]
    return next((code for part in inner if (code := _iau_code(part)) is not None), None)


def impossible_places(
    crs_text: str | None,
    transform: Sequence[float],
    shape: tuple[int, int],
    *,
    is_placed: bool = True,
) -> str | None:
    """Return a sentence with the likely cause if samples lie at impossible degrees.

    Centres of samples may lie a tenth of a pixel beyond a pole, which rounding explains; outer
    edges of a grid with samples on the pole lie half a pixel beyond it.
    """
    import numpy as np  # help texts of commands need none

    told = describe_quietly(crs_text)
    if told is None or not told.in_degrees or not is_placed:
        return None
    a, b, c, d, e, f = transform[:6]
    rows, cols = np.array(list(product((0.5, shape[0] - 0.5), (0.5, shape[1] - 0.5)))).T
    to_degrees = np.array(told.directions) * [[told.x.factor], [told.y.factor]]
    places = np.stack([a * cols + b * rows + c, d * cols + e * rows + f], axis=1)
    lon, lat = (places @ to_degrees).T
    steps = np.abs([[a, d], [b, e]] @ to_degrees)
    slack = _OF_A_PIXEL * float(steps[:, 1].max())
    farthest, widest = float(np.abs(lat).max()), float(np.abs(lon).max())
    if farthest <= _POLE + slack and widest <= _MOST_LONGITUDE:
        return None
    name, values = ("longitudes", lon) if farthest <= _POLE + slack else ("latitudes", lat)
    found = f"{name} of {values[np.abs(values).argmax()]:.10g}"
    correct = "correct the place, for example by gdal_edit -a_ullr"
    if max(farthest, widest) > _MOST_LONGITUDE:
        cause = (
            "they look like metres or feet of a map: name its CRS, for example by gdal_edit -a_srs"
        )
    elif widest > _POLE:
        cause = f"the transform is wrong: {correct}"
    elif float(np.abs(lat).min()) > _POLE:
        cause = f"x and y look swapped: {correct}"
    else:
        cause = f"the transform is wrong, or x and y are swapped: {correct}"
    return f"samples lie at {found} degrees, which no globe has; {cause}"
