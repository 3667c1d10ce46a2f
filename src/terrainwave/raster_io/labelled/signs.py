"""Signs that a coordinate of an array is x or y, and names of arrays in messages."""

import re
from functools import partial
from typing import Any

# Signs that a coordinate is x or y, strongest first: attributes of the CF conventions, names.
_AXIS = {"x": {"x"}, "y": {"y"}}
_STANDARD_NAMES = {
    "x": {"projection_x_coordinate", "longitude", "grid_longitude"},
    "y": {"projection_y_coordinate", "latitude", "grid_latitude"},
}
_UNITS = {
    role: {f"degree{s}_{end}" for s in ("", "s") for end in ends}
    | {f"degree{s}{end}" for s in ("", "s") for end in ends[-1:]}
    for role, ends in (("x", ("east", "e")), ("y", ("north", "n")))
}
_NAMES = {
    "x": set(
        "x lon long longitude lons longitudes rlon easting eastings east col cols column columns"
        " nx ncol ncols xc xdim west_east projection_x_coordinate grid_longitude".split()
    ),
    "y": set(
        "y lat latitude lats latitudes rlat northing northings north row rows ny nrow nrows yc"
        " ydim south_north projection_y_coordinate grid_latitude".split()
    ),
}
_LAST_SYLLABLE = re.compile(r"(lat|latitude|lon|long|longitude)$")
NO_PLACE = "take the heights without place and CRS by georeference=False"


def title(array: Any) -> str:
    name = getattr(array, "name", None)
    return "the DataArray" if name is None else f"the DataArray {name}"


def mapping_name(array: Any) -> str:
    """Return the name of the coordinate that holds CRS and transform."""
    name = "spatial_ref"
    for fields in (getattr(array, "encoding", {}), array.attrs):
        name = str(fields.get("grid_mapping", name))
    return re.split(r"[\s:]+", name)[0]  # CF's extended form: "crs: x y"


def sizes_of(array: Any) -> str:
    return ", ".join(f"{dim} ({size})" for dim, size in zip(array.dims, array.shape))


def coords_along(array: Any, dim: Any) -> list[tuple[Any, Any]]:
    """Return names and coordinates that depend only on a dimension, its own one first."""
    found = [
        (name, coord)
        for name, coord in array.coords.items()
        if tuple(getattr(coord, "dims", (name,))) == (dim,)
    ]
    return sorted(found, key=lambda pair: pair[0] != dim)


def _by(attribute: str, table: dict[str, set[str]], _: Any, coord: Any) -> list[str]:
    """Return the roles by an attribute of a coordinate."""
    return _said(coord.attrs.get(attribute), table)


by_axis = partial(_by, "axis", _AXIS)
by_standard_name = partial(_by, "standard_name", _STANDARD_NAMES)
by_units = partial(_by, "units", _UNITS)


def by_name(name: Any, _coord: Any) -> list[str]:
    """Return the roles by the name, its first word (easting_m), or its end (nav_lat, XLONG)."""
    first, last = (re.split(r"[^A-Za-z]", str(name))[at] for at in (0, -1))
    end = _LAST_SYLLABLE.search(last.lower())
    return _said(name, _NAMES) or _said(first, _NAMES) or _said(end and end[0], _NAMES)


def _said(text: Any, table: dict[str, set[str]]) -> list[str]:
    return [role for role, words in table.items() if str(text).lower() in words]


def places_of(array: Any) -> tuple[Any, Any] | None:
    """Return the coordinates with x and y of each sample, if any, rather projected ones."""
    both = [coord for coord in array.coords.values() if len(tuple(getattr(coord, "dims", ()))) == 2]
    for sign in (by_standard_name, by_axis, by_units, by_name):
        found: dict[str, list[Any]] = {"x": [], "y": []}
        for coord in sorted(both, key=is_degrees):
            for role in sign(coord.name, coord):
                found[role].append(coord)
        for x in found["x"]:
            for y in found["y"]:
                if set(x.dims) == set(y.dims) and is_degrees(x) == is_degrees(y):
                    return x, y
    return None


def is_degrees(coord: Any) -> bool:
    name = str(coord.attrs.get("standard_name")).lower()
    return bool(by_units("", coord)) or name in ("longitude", "latitude")
