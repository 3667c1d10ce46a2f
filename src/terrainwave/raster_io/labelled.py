"""What the names and attributes of xarray's objects say: which dimension is x, where samples lie.

By names alone, as xarray is no dependency: `array` is whatever has dims, coords and attrs. What is
said is taken as the CF conventions and rioxarray mean it; what is not said is refused or noted,
never guessed.
"""

import contextlib
import math
import re
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.errors import CRSError

from terrainwave.errors import InvalidArgumentError, InvalidHeightsError
from terrainwave.grid.affine import (
    IDENTITY,
    Fit,
    Transform,
    coordinates,
    grid_of_axes,
    grid_of_places,
    is_turned,
    of_steps,
    steps_on,
)
from terrainwave.place.crs import crs_of_grid_mapping, format_crs, parse_crs
from terrainwave.place.description import describe_quietly

# What says that a coordinate is x or y, strongest first: attributes of the CF conventions, names.
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
# Metres in units that coordinates of projected systems are in; an angle has none.
_METRES = (
    dict.fromkeys(("m", "metre", "meter", "metres", "meters"), 1.0)
    | dict.fromkeys(("km", "kilometre", "kilometer", "kilometres", "kilometers"), 1000.0)
    | dict.fromkeys(("ft", "foot", "feet"), 0.3048)
    | dict.fromkeys(("us_ft", "ftus", "us survey foot", "us survey feet"), 1200 / 3937)
    | dict.fromkeys(("rad", "radian", "radians", "degree", "degrees"), math.inf)
)
_RADIANS = ("rad", "radian", "radians")
_NO_PLACE = "take the heights without place and CRS by georeference=False"

_DEPTHS = (
    "{} says that its numbers are depths (positive: down); they are taken as they are, so terrain"
    " made of them is upside down: give the array negated, without that attribute"
)


class Layer(NamedTuple):
    """Rows and columns of one array, and what its coordinates, attributes and accessor say."""

    array: Any  # rows, then columns
    transform: Transform
    crs: str | None
    notes: list[str]


def layer_of(array: Any, source: Any, band: int, *, georeference: bool) -> Layer:
    """Return the one layer of heights that a DataArray holds; `source` is what it was taken from.

    Raises
    ------
    InvalidHeightsError
        If there are several layers, or nothing says which dimension is x, or where samples lie.
    InvalidArgumentError
        If there is no such band.
    """
    crs, notes = _crs(array, source)
    goes_down = str(array.attrs.get("positive", "")).lower() == "down"
    depth_notes = [_DEPTHS.format(_title(array))] * goes_down
    roles = _roles(array, source)
    if len(roles) < 2:
        roles = _unnamed(array, roles, may_guess=not georeference or crs is None)
    layer, band_notes = _only_layer(array, roles, band)
    if tuple(layer.dims) != (roles["y"], roles["x"]):
        layer = layer.transpose(roles["y"], roles["x"])
    if 0 in layer.shape:
        raise InvalidHeightsError(
            f"{_title(array)} has the dimensions {_sizes(array)}; expected at least one sample"
            " along each: choose another part"
        )
    if not georeference:
        return Layer(layer, IDENTITY, None, [*band_notes, *depth_notes])
    transform = _transform(layer, crs)
    notes = [*band_notes, *depth_notes, *notes]
    if transform is None:
        if crs is not None:
            notes.append(
                f"no transform says where the samples of {_title(array)} lie, so its CRS is"
                " dropped: give it coordinates, or a transform by array.rio.write_transform"
            )
        return Layer(layer, IDENTITY, None, notes)
    return Layer(layer, transform, format_crs(crs), notes)


def _title(array: Any) -> str:
    name = getattr(array, "name", None)
    return "the DataArray" if name is None else f"the DataArray {name}"


# Which variable.


def variable_of(source: Any) -> Any:
    """Return the DataArray of heights: `source` itself, or the only such variable that it has.

    Raises
    ------
    InvalidHeightsError
        If a Dataset or a node of a DataTree has several or none.
    """
    if hasattr(source, "to_dataset") and hasattr(source, "children"):
        kind, groups = "DataTree", list(map(str, source.children))
        source = source.to_dataset()
    else:
        kind, groups = "Dataset", []
    if not hasattr(source, "data_vars"):
        return source
    described = _describing(source)
    found = [
        name
        for name, variable in source.data_vars.items()
        if variable.ndim >= 2 and variable.dtype.kind in "iufb" and name not in described
    ]
    if len(found) == 1:
        array = source[found[0]]
        mapping = _mapping_name(array)
        # As opened without decode_coords="all": the CRS lies beside the heights.
        if mapping in source.variables and mapping not in array.coords:
            array = array.assign_coords({mapping: source[mapping].variable})
        return array
    if found:
        names = ", ".join(map(str, found))
        raise InvalidHeightsError(
            f"the {kind} has the variables {names}; expected one: choose it, for example"
            f" dataset[{str(found[0])!r}]"
        )
    if groups:
        raise InvalidHeightsError(
            f"the {kind}'s root has no variable of rows and columns, its groups are"
            f" {', '.join(groups)}; expected one: choose it, for example tree[{groups[-1]!r}]"
        )
    others = ", ".join(map(str, source.data_vars)) or "none"
    raise InvalidHeightsError(
        f"the {kind} has no variable of rows and columns; found {others}; expected one of heights"
    )


def _describing(dataset: Any) -> set[str]:
    """Return the names of variables that only describe others: grid mappings, bounds of cells."""
    names = set()
    for variable in dataset.variables.values():
        for fields in (variable.attrs, variable.encoding):
            for key in ("grid_mapping", "bounds", "climatology"):
                names |= set(re.split(r"[\s:]+", str(fields.get(key, "")))) - {""}
    return names


# Which dimension.


def _roles(array: Any, source: Any) -> dict[str, Any]:
    """Return the dimensions that are x and y, as far as anything says so, by the strongest sign."""
    roles = _by_accessor(array, source)
    for sign in (_by_axis, _by_standard_name, _by_units, None, _by_name):
        found: dict[str, list[Any]] = {"x": [], "y": []}
        for dim in array.dims:
            if sign is None:  # the dimension's own name, before those of coordinates along it
                said = set(_by_name(dim, None))
            else:
                said = {role for coord in _along(array, dim) for role in sign(*coord)}
            for role in said - set(roles):
                if dim not in roles.values():
                    found[role].append(dim)
        for role, dims in found.items():
            if len(dims) > 1:
                raise InvalidHeightsError(
                    f"{_title(array)}: the dimensions {' and '.join(map(str, dims))} both say that"
                    f" they are {role}; expected one: {_how_to_tell(array)}"
                )
            if dims and dims[0] not in roles.values():
                roles[role] = dims[0]
    return roles


def _by_accessor(array: Any, source: Any) -> dict[str, Any]:
    """Return what rioxarray was told, or finds."""
    roles: dict[str, Any] = {}
    for owner in (array, source):
        accessor = getattr(owner, "rio", None)
        for role in ("x", "y"):
            # A RuntimeError of rioxarray's own, where it knows of none.
            with contextlib.suppress(AttributeError, RuntimeError):
                dim = getattr(accessor, f"{role}_dim")
                if dim in array.dims:
                    roles.setdefault(role, dim)
    return roles


def _along(array: Any, dim: Any) -> list[tuple[Any, Any]]:
    """Return names and coordinates along a dimension alone, its own one first."""
    found = [
        (name, coord)
        for name, coord in array.coords.items()
        if tuple(getattr(coord, "dims", (name,))) == (dim,)
    ]
    return sorted(found, key=lambda pair: pair[0] != dim)


def _by_axis(name: Any, coord: Any) -> list[str]:
    return _said(coord.attrs.get("axis"), _AXIS)


def _by_standard_name(name: Any, coord: Any) -> list[str]:
    return _said(coord.attrs.get("standard_name"), _STANDARD_NAMES)


def _by_units(name: Any, coord: Any) -> list[str]:
    return _said(coord.attrs.get("units"), _UNITS)


def _by_name(name: Any, coord: Any) -> list[str]:
    """Take a name as it is, its first word (easting_m), or its end (nav_lat, XLONG, TLAT)."""
    first, last = (re.split(r"[^A-Za-z]", str(name))[at] for at in (0, -1))
    end = _LAST_SYLLABLE.search(last.lower())
    return _said(name, _NAMES) or _said(first, _NAMES) or _said(end and end[0], _NAMES)


def _said(text: Any, table: dict[str, set[str]]) -> list[str]:
    return [role for role, words in table.items() if str(text).lower() in words]


def _unnamed(array: Any, roles: dict[str, Any], *, may_guess: bool) -> dict[str, Any]:
    """Return the roles of dimensions that nothing names: by places of samples, or their order."""
    dims = tuple(dim for dim in array.dims if dim != "band")
    places = _places(array)
    if places is not None:
        dims = tuple(dim for dim in array.dims if dim in places[0].dims)
    elif not may_guess or any(_along(array, dim) for dim in dims) or _stored(array):
        raise InvalidHeightsError(
            f"{_title(array)} has the dimensions {_sizes(array)}, and nothing says which of them"
            f" are x and y; expected rows and columns: {_how_to_tell(array)}"
        )
    long = [dim for dim, size in zip(array.dims, array.shape) if size > 1 and dim in dims]
    if len(dims) != 2 and len(long) == 2:
        dims = tuple(long)
    if len(dims) < 2:
        raise InvalidHeightsError(
            f"{_title(array)} has the dimensions {_sizes(array)}; expected rows and columns"
        )
    row, col = dims[-2:]
    if roles.get("x") == row or roles.get("y") == col:
        row, col = col, row
    return {"y": row, "x": col}


def _sizes(array: Any) -> str:
    return ", ".join(f"{dim} ({size})" for dim, size in zip(array.dims, array.shape))


def _how_to_tell(array: Any) -> str:
    y, x = map(str, (*array.dims, "y", "x")[:2])
    return (
        'name them y and x, or give their coordinates the attribute axis, "Y" and "X", or'
        f" array.rio.set_spatial_dims(x_dim={x!r}, y_dim={y!r})"
    )


def _only_layer(array: Any, roles: dict[str, Any], band: int) -> tuple[Any, list[str]]:
    """Return the array without dimensions besides x and y: the band asked for, or the only one."""
    key: list[Any] = []
    notes: list[str] = []
    has_bands = False
    for dim, size in zip(array.dims, array.shape):
        if dim in roles.values():
            key.append(slice(None))
        elif dim == "band":
            if not 1 <= band <= size:
                raise InvalidArgumentError(
                    f"`band` {band} does not exist, {_title(array)} has {size}"
                )
            if size > 1 and band == 1:
                notes.append(f"{_title(array)} has {size} bands; using band 1 (choose with `band`)")
            key.append(band - 1)
            has_bands = True
        elif size == 1:
            key.append(0)
        else:
            raise InvalidHeightsError(
                f"{_title(array)} has the dimensions {_sizes(array)}; expected rows and columns:"
                f" choose one layer of {dim}, for example array.isel({dim}=0)"
            )
    if band != 1 and not has_bands:
        raise InvalidArgumentError(f"`band` {band} does not exist, {_title(array)} has 1")
    return (array if len(key) == 2 else array[tuple(key)]), notes


# Where.


def _mapping_name(array: Any) -> str:
    name = "spatial_ref"
    for fields in (getattr(array, "encoding", {}), array.attrs):
        name = str(fields.get("grid_mapping", name))
    return re.split(r"[\s:]+", name)[0]  # CF's extended form: "crs: x y"


def _mapping(array: Any) -> dict[str, Any]:
    """Return the attributes of the coordinate that holds CRS and transform."""
    name = _mapping_name(array)
    return dict(array.coords[name].attrs) if name in array.coords else {}


def _crs(array: Any, source: Any) -> tuple[CRS | None, list[str]]:
    """Return the CRS, and what should be known of it."""
    for owner in (array, source):
        with contextlib.suppress(AttributeError):
            if owner.rio.crs is not None:
                return CRS.from_user_input(owner.rio.crs), []
    mapping = _mapping(array)
    text = mapping.get("crs_wkt", mapping.get("spatial_ref"))
    if text is not None:
        return parse_crs(str(text)), []
    name = mapping.get("grid_mapping_name")
    if name is not None:
        return _crs_of_mapping(mapping)
    asked = {"grid_mapping"} & {*getattr(array, "encoding", {}), *array.attrs}
    if asked and not mapping:
        return None, [
            f"{_title(array)} names the grid mapping {_mapping_name(array)} and does not hold it,"
            ' so there is no CRS: open the file with decode_coords="all", or give the Dataset'
        ]
    return None, []


def _crs_of_mapping(mapping: dict[str, Any]) -> tuple[CRS | None, list[str]]:
    """Return the CRS of a CF grid mapping without WKT."""
    try:
        return crs_of_grid_mapping(mapping), []
    except ImportError:
        reason = "pyproj is not installed, which reads it"
    except (CRSError, KeyError, RuntimeError, TypeError, ValueError) as error:
        reason = f"PROJ does not understand it: {error}"
    return None, [f"the grid mapping {mapping['grid_mapping_name']} is ignored, {reason}"]


def _stored(array: Any) -> Transform | None:
    """Return the transform that is stored beside the CRS, in the order of `affine`."""
    text = str(_mapping(array).get("GeoTransform", "")).split()
    if len(text) != 6:
        return None
    with contextlib.suppress(ValueError):
        c, a, b, f, d, e = map(float, text)  # GDAL's order
        if all(map(math.isfinite, (a, b, c, d, e, f))):
            return a, b, c, d, e, f
    return None


def _transform(array: Any, crs: CRS | None) -> Transform | None:
    """Return where the pixels are, by the coordinates of their centres and the stored transform.

    The stored one is exact, but stays as it was when the array is cut, turned over or thinned
    out: the centres then tell which samples these are. None if nothing says where they lie.

    Raises
    ------
    InvalidHeightsError
        If the coordinates follow no affine transform, or are no numbers of the CRS.
    """
    shape = array.shape[0], array.shape[1]
    stored = _stored(array)
    axes = [_centres(array, dim, crs) for dim in array.dims]
    places = _places(array)
    if all(centres is None for _, centres in axes):
        if places is None:
            return None if stored == IDENTITY else stored
        fit = grid_of_places(_reader(places, array.dims), shape)
        for place in places:
            _check_unit(array, str(place.name), place, crs)
        names = " and ".join(str(place.name) for place in places)
        _check_even(array, f"{names} are", fit)
    elif stored is not None and is_turned(stored, shape):
        return stored  # as rioxarray does: coordinates of one number can't tell a turned grid
    else:
        (y_name, y), (x_name, x) = axes
        if stored is not None:
            rows, cols = np.arange(shape[0]), np.arange(shape[1])
            x = coordinates(stored, 0.0 * cols, cols)[0] if x is None else x
            y = coordinates(stored, rows, 0.0 * rows)[1] if y is None else y
        if x is None or y is None:
            missing = array.dims[1] if x is None else array.dims[0]
            raise InvalidHeightsError(
                f"{_title(array)} has no coordinate of {missing}; expected one of each dimension:"
                f" give it one, or {_NO_PLACE}"
            )
        fit, y_fit = grid_of_axes(x, y)
        _check_even(array, f"{x_name} is", fit)
        _check_even(array, f"{y_name} is", y_fit)
    steps = None if stored is None else steps_on(fit.transform, shape, stored)
    if stored is not None and steps is not None:
        # The identity is what rasterio gives where a file has none.
        return None if stored == IDENTITY else of_steps(stored, *steps)
    for size, dim in zip(shape, array.dims):
        if size == 1:
            raise InvalidHeightsError(
                f"{_title(array)} has one sample along {dim}, whose coordinate does not say how far"
                f" it reaches; expected a transform too: write one by array.rio.write_transform, or"
                f" {_NO_PLACE}"
            )
    return fit.transform


def _centres(array: Any, dim: Any, crs: CRS | None) -> tuple[str, NDArray[np.generic] | None]:
    """Return the name and the numbers of a dimension's coordinate."""
    for name, coord in _along(array, dim):
        centres = np.asarray(coord.values)
        if centres.dtype.kind in "iuf":
            _check_unit(array, str(name), coord, crs)
            return str(name), centres
        if name == dim:
            raise InvalidHeightsError(
                f"{_title(array)}: the coordinate {name} is of type {centres.dtype}; expected"
                f" numbers: assign others, or {_NO_PLACE}"
            )
    return str(dim), None


def _places(array: Any) -> tuple[Any, Any] | None:
    """Return the coordinates that give each sample an x and a y, as turned and curved grids have.

    Projected ones first: there may be longitudes and latitudes besides.
    """
    both = [coord for coord in array.coords.values() if len(tuple(getattr(coord, "dims", ()))) == 2]
    for sign in (_by_standard_name, _by_axis, _by_units, _by_name):
        found: dict[str, list[Any]] = {"x": [], "y": []}
        for coord in sorted(both, key=_is_degrees):
            for role in sign(coord.name, coord):
                found[role].append(coord)
        for x in found["x"]:
            for y in found["y"]:
                if set(x.dims) == set(y.dims) and _is_degrees(x) == _is_degrees(y):
                    return x, y
    return None


def _reader(places: tuple[Any, Any], dims: tuple[Any, Any]) -> Any:
    """Return a function that gives x and y of some rows."""
    turned = [place.transpose(*dims) for place in places]
    return lambda row, n: tuple(place[row : row + n].values for place in turned)


def _is_degrees(coord: Any) -> bool:
    """Say whether a coordinate calls itself a longitude or a latitude."""
    name = str(coord.attrs.get("standard_name")).lower()
    return bool(_by_units("", coord)) or name in ("longitude", "latitude")


def _check_unit(array: Any, name: str, coord: Any, crs: CRS | None) -> None:
    """Raise `InvalidHeightsError` if a coordinate is in another unit than the CRS.

    Attributes stay when somebody writes another CRS: its numbers have to fit what it says.
    """
    unit = str(coord.attrs.get("units", "")).lower()
    if crs is None:
        if unit in _RADIANS:  # they would pass for degrees
            raise InvalidHeightsError(
                f"{_title(array)}: the coordinate {name} is in {unit}, and no CRS says of what;"
                f" expected degrees or a CRS: assign them, or {_NO_PLACE}"
            )
        return
    largest = float(np.abs(np.asarray(coord.values)).max(initial=0))
    said = describe_quietly(format_crs(crs))
    if said is None:
        return
    counts_radians = said.in_degrees and abs(said.x.factor / math.degrees(1) - 1) < 1e-5
    crs_unit, in_metres = said.x.unit, math.inf if said.in_degrees else said.x.factor
    if said.in_degrees and unit in _RADIANS:
        is_other = not counts_radians
    elif _is_degrees(coord):
        is_other, unit = not said.in_degrees and largest <= 360, "degrees"
    elif said.in_degrees:
        is_other = math.isfinite(_METRES.get(unit, math.inf)) and largest > 360
    else:
        is_other = abs(_METRES.get(unit, in_metres) / in_metres - 1) > 1e-5
    if is_other:
        raise InvalidHeightsError(
            f"{_title(array)}: the coordinate {name} is in {unit}, the unit of its CRS is"
            f" {crs_unit}; expected coordinates of the CRS: assign them, or {_NO_PLACE}"
        )


def _check_even(array: Any, what: str, fit: Fit) -> None:
    """Raise `InvalidHeightsError` unless coordinates follow their grid."""
    if fit.is_even:
        return
    how_far = (
        f"samples lie up to {fit.deviation:.3g} pixels beside an even grid"
        if math.isfinite(fit.deviation)
        else "samples follow no grid"
    )
    raise InvalidHeightsError(
        f"{_title(array)}: {what} not evenly spaced, {how_far}; expected at most {fit.allowed:.2g}:"
        f" resample the heights first, for example by array.interp or gdalwarp, or {_NO_PLACE}"
    )


# Which samples are void.


class Voids(NamedTuple):
    """The values that mark voids, in stored units, and the range of all others."""

    values: list[int | float]
    valid_range: tuple[float, float] | None
    notes: list[str]


def voids_of(array: Any, band: int) -> Voids:
    """Return what the accessor, attributes and encoding of a DataArray declare to be void.

    As the CF conventions allow, several values may. `array` is the very object that was given: what
    its accessor was told, no part of it knows.
    """
    attrs, encoding = array.attrs, getattr(array, "encoding", {})
    declared: list[Any] = []
    # rioxarray converts to the array's type, which may not hold it.
    with contextlib.suppress(AttributeError, OverflowError, RuntimeError, TypeError, ValueError):
        if array.rio.nodata == array.rio.nodata:  # NaN stands for one of the encoding
            declared.append(array.rio.nodata)
    # Those of an encoding with a scale count in packed numbers: none of these is left.
    is_packed = bool({"scale_factor", "add_offset"} & set(encoding)) or _is_unsigned(encoding)
    if _is_unsigned(attrs) and array.dtype.kind == "i":
        raise InvalidHeightsError(
            f"{_title(array)}: the attribute _Unsigned says that its numbers of type {array.dtype}"
            " have no sign; expected them as they are meant: open the file with"
            f" mask_and_scale=True, or array.astype('u{array.dtype}') without that attribute"
        )
    for fields in (attrs, {} if is_packed else encoding):
        declared += [fields.get(name) for name in _FILL_NAMES]
        per_band = np.atleast_1d(np.asarray(fields.get("nodatavals", ()), dtype=object))
        declared += list(per_band[band - 1 : band] if per_band.size > 1 else per_band)
    values: dict[Any, int | float] = {}
    for value in declared:
        for number in _numbers(value):
            values.setdefault("nan" if number != number else number, number)
    return Voids(list(values.values()), *_valid_range(attrs, encoding, array.dtype))


def _is_unsigned(fields: Any) -> bool:
    """Tell whether the convention of netCDF-3, which has no types without sign, is followed."""
    return str(fields.get("_Unsigned", "")).lower() == "true"


_FILL_NAMES = ("_FillValue", "missing_value", "fill_value", "nodata")


def _numbers(value: Any) -> list[int | float]:
    """Return the numbers of an attribute, which may be one or several, or text."""
    if value is None or isinstance(value, bool):
        return []
    with contextlib.suppress(TypeError, ValueError):
        words = re.split(r"[\s,;]+", value.strip("[](){} ")) if isinstance(value, str) else value
        numbers = np.atleast_1d(np.asarray(words))
        if numbers.dtype.kind not in "iuf":
            numbers = numbers.astype(np.float64)
        return [number.item() for number in numbers.ravel()]
    return []


def number_of(fields: Any, name: str, default: float) -> float:
    """Return the one number that an attribute has.

    Raises
    ------
    InvalidHeightsError
        If it has another value.
    """
    if name not in fields:
        return default
    numbers = _numbers(fields[name])
    if len(numbers) != 1:
        raise InvalidHeightsError(
            f"the attribute {name} is {str(fields[name])[:40]!r}; expected a number: correct it"
        )
    return float(numbers[0])


def _valid_range(
    attrs: Any, encoding: Any, dtype: np.dtype[Any]
) -> tuple[tuple[float, float] | None, list[str]]:
    """Return the range of valid values, in the numbers that the array holds, and a note.

    The range is of packed numbers, unless it is of a wider type than these (CF 1.11, 2.5.1).
    """
    ends = _numbers(attrs.get("valid_range"))
    if len(ends) != 2:
        low, high = (_numbers(attrs.get(name)) for name in ("valid_min", "valid_max"))
        ends = [low[0] if len(low) == 1 else -math.inf, high[0] if len(high) == 1 else math.inf]
    if ends == [-math.inf, math.inf] or any(end != end for end in ends):
        return None, []
    is_decoded = bool({"scale_factor", "add_offset"} & set(encoding)) or _is_unsigned(encoding)
    packing = encoding if is_decoded else attrs
    packed_type = np.dtype(encoding.get("dtype", dtype)) if is_decoded else dtype
    stated = [end for end in ends if math.isfinite(end)]
    is_wide = packed_type.kind in "iu" and any(isinstance(end, float) for end in stated)
    if is_decoded and _is_unsigned(encoding) and packed_type.kind in "iu" and not is_wide:
        ends = [end % (1 << 8 * packed_type.itemsize) if end in stated else end for end in ends]
    scale = number_of(packing, "scale_factor", 1.0)
    offset = number_of(packing, "add_offset", 0.0)
    if is_decoded and not is_wide:
        ends = [end * scale + offset for end in ends]
    elif not is_decoded and is_wide and math.isfinite(scale) and scale != 0:
        ends = [(end - offset) / scale for end in ends]
    low_end, high_end = sorted(map(float, ends))
    return (low_end, high_end), [
        f"samples outside the valid range that the attributes state, {low_end:g} to {high_end:g},"
        " are voids"
    ]
