"""Positions of an array's samples: by its coordinates, its grid mapping, its accessor."""

import contextlib
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.errors import CRSError

from terrainwave.errors import InvalidHeightsError
from terrainwave.grid.affine import (
    IDENTITY,
    Fit,
    Transform,
    coordinates,
    determinant,
    grid_of_axes,
    grid_of_places,
    is_turned,
    of_strides,
    of_window,
    strides_on,
)
from terrainwave.place.crs import crs_of_grid_mapping, format_crs, parse_crs
from terrainwave.place.description import describe_quietly
from terrainwave.raster_io.labelled.signs import (
    NO_PLACE,
    coords_along,
    is_degrees,
    mapping_name,
    places_of,
    title,
)
from terrainwave.raster_io.labelled.values import numbers_of

# Metres per unit of projected coordinates; an angle has none.
_METRES = (
    dict.fromkeys(("m", "metre", "meter", "metres", "meters"), 1.0)
    | dict.fromkeys(("km", "kilometre", "kilometer", "kilometres", "kilometers"), 1000.0)
    | dict.fromkeys(("ft", "foot", "feet"), 0.3048)
    | dict.fromkeys(("us_ft", "ftus", "us survey foot", "us survey feet"), 1200 / 3937)
    | dict.fromkeys(("rad", "radian", "radians", "degree", "degrees"), math.inf)
)
_RADIANS = ("rad", "radian", "radians")


def mapping_of(array: Any) -> dict[str, Any]:
    name = mapping_name(array)
    return dict(array.coords[name].attrs) if name in array.coords else {}


def crs_of(array: Any, source: Any) -> tuple[CRS | None, list[str]]:
    for owner in (array, source):
        with contextlib.suppress(AttributeError):
            if owner.rio.crs is not None:
                return CRS.from_user_input(owner.rio.crs), []
    mapping = mapping_of(array)
    text = mapping.get("crs_wkt", mapping.get("spatial_ref"))
    if text is not None:
        return parse_crs(str(text)), []
    name = mapping.get("grid_mapping_name")
    if name is not None:
        return _crs_of_mapping(mapping)
    for owner in (array, source):
        crs = _plain_crs(getattr(owner, "attrs", {}).get("crs"))
        if crs is not None:
            return crs, []
    asked = {"grid_mapping"} & {*getattr(array, "encoding", {}), *array.attrs}
    if asked and not mapping:
        return None, [
            f"{title(array)} names the grid mapping {mapping_name(array)} and does not hold it,"
            ' so there is no CRS: open the file with decode_coords="all", or give the Dataset'
        ]
    return None, []


def _plain_crs(told: Any) -> CRS | None:
    """Return the CRS of an attribute `crs`, which rioxarray reads when it is imported."""
    if hasattr(told, "to_wkt"):
        told = told.to_wkt()
    return parse_crs(told) if isinstance(told, str) else None


def _crs_of_mapping(mapping: dict[str, Any]) -> tuple[CRS | None, list[str]]:
    try:
        return crs_of_grid_mapping(mapping), []
    except ImportError:
        reason = "pyproj is not installed, which reads it"
    except (CRSError, KeyError, RuntimeError, TypeError, ValueError) as error:
        reason = f"PROJ does not understand it: {error}"
    return None, [f"the grid mapping {mapping['grid_mapping_name']} is ignored, {reason}"]


def stored_transform(array: Any) -> Transform | None:
    text = str(mapping_of(array).get("GeoTransform", "")).split()
    if len(text) != 6:
        return None
    with contextlib.suppress(ValueError):
        c, a, b, f, d, e = map(float, text)  # GDAL's order
        if all(map(math.isfinite, (a, b, c, d, e, f))):
            return a, b, c, d, e, f
    return None


class ToldTransform(NamedTuple):
    """The attribute `transform`, and the shape of its raster, if stated."""

    transform: Transform
    shape: tuple[int, int] | None


def told_transform(array: Any, source: Any) -> ToldTransform | None:
    for owner in (array, source):
        attrs = getattr(owner, "attrs", {})
        value = attrs.get("transform")
        if value is not None and not isinstance(value, str):
            with contextlib.suppress(TypeError):
                value = list(value)
        numbers = numbers_of(value)
        if len(numbers) == 6 or (len(numbers) == 9 and numbers[6:] == [0, 0, 1]):
            a, b, c, d, e, f = map(float, numbers[:6])
            transform = (a, b, c, d, e, f)
            if all(map(math.isfinite, transform)) and determinant(transform):
                shape = getattr(attrs.get("spec"), "shape", None)
                return ToldTransform(transform, None if shape is None else tuple(shape))
    return None


def transform_of(
    array: Any, crs: CRS | None, told: ToldTransform | None
) -> tuple[Transform | None, list[str]]:
    """Return the transform, by coordinates and stored transforms, and notes.

    Coordinates are centres of pixels. The transform stored with the CRS is exact, but does not
    change when the array is cut, flipped or thinned: the centres then show which samples these are.
    So they do for `told`, the attribute, with which coordinates may also be corners. None if the
    positions are unknown.
    """
    shape = array.shape[0], array.shape[1]
    stored = stored_transform(array)
    if told is not None and (told.transform == IDENTITY or stored not in (None, told.transform)):
        told = None
    axes = [_centres(array, dim, crs) for dim in array.dims]
    places = places_of(array)
    if all(centres is None for _, centres in axes):
        if places is None and told is not None:
            return _without_coordinates(array, told)
        if places is None:
            return (None if stored == IDENTITY else stored), []
        fit = grid_of_places(_reader(places, array.dims), shape)
        told = None
        for place in places:
            _check_unit(array, str(place.name), place, crs)
        names = " and ".join(str(place.name) for place in places)
        _check_even(array, f"{names} are", fit)
    elif stored is not None and is_turned(stored, shape):
        # As in rioxarray: one coordinate cannot reveal a rotated grid.
        return stored, []
    else:
        (y_name, y), (x_name, x) = axes
        if stored is not None:
            rows, cols = np.arange(shape[0]), np.arange(shape[1])
            x = coordinates(stored, 0.0 * cols, cols)[0] if x is None else x
            y = coordinates(stored, rows, 0.0 * rows)[1] if y is None else y
        if x is None or y is None:
            missing = array.dims[1] if x is None else array.dims[0]
            raise InvalidHeightsError(
                f"{title(array)} has no coordinate of {missing}; expected one of each dimension:"
                f" give it one, or {NO_PLACE}"
            )
        fit, y_fit = grid_of_axes(x, y)
        _check_even(array, f"{x_name} is", fit)
        _check_even(array, f"{y_name} is", y_fit)
    notes: list[str] = []
    if told is not None and shape != (1, 1):
        by_told, notes = _by_told(array, fit.transform, told.transform)
        if by_told is not None:
            return by_told, notes
    strides = None if stored is None else strides_on(fit.transform, shape, stored)
    if stored is not None and strides is not None:
        # rasterio returns the identity if a file has no transform.
        return None if stored == IDENTITY else of_strides(stored, *strides), notes
    for size, dim in zip(shape, array.dims):
        if size == 1:
            raise InvalidHeightsError(
                f"{title(array)} has one sample along {dim}, whose coordinate does not say how far"
                f" it reaches; expected a transform too: write one by array.rio.write_transform, or"
                f" {NO_PLACE}"
            )
    return fit.transform, notes


def _without_coordinates(array: Any, told: ToldTransform) -> tuple[Transform | None, list[str]]:
    """Return the attribute's transform if nothing shows that the array was cut since."""
    shape = tuple(array.shape)
    if told.shape is None:
        return told.transform, [
            f"{title(array)} has no coordinates: its attribute transform places it, which would be"
            " wrong if it was cut since"
        ]
    if told.shape == shape:
        return told.transform, []
    return None, [
        f"{title(array)} has {shape[0]} x {shape[1]} samples, and its attribute transform is of"
        f" {told.shape[0]} x {told.shape[1]}: it is ignored"
    ]


def _by_told(array: Any, fitted: Transform, told: Transform) -> tuple[Transform | None, list[str]]:
    """Return the transform of pixels of the attribute's size with these centres or corners.

    None, with a note, if the coordinates belong to other pixels.
    """
    shape = array.shape[0], array.shape[1]
    for shift in (0.0, -0.5):
        strides = strides_on(fitted, shape, of_window(told, shift, shift))
        if strides is None or {abs(strides.row_stride), abs(strides.col_stride)} != {1}:
            continue
        notes = [
            f"x and y of {title(array)} are corners of pixels by its attribute transform, which"
            " counts: centres are half a pixel further"
        ]
        return of_strides(told, *strides), notes if shift else []
    return None, [
        f"x and y of {title(array)} are not those of its attribute transform; they are taken for"
        " centres of pixels (of stackstac: xy_coords='center')"
    ]


def _centres(array: Any, dim: Any, crs: CRS | None) -> tuple[str, NDArray[np.generic] | None]:
    for name, coord in coords_along(array, dim):
        centres = np.asarray(coord.values)
        if centres.dtype.kind in "iuf":
            _check_unit(array, str(name), coord, crs)
            return str(name), centres
        if name == dim:
            raise InvalidHeightsError(
                f"{title(array)}: the coordinate {name} is of type {centres.dtype}; expected"
                f" numbers: assign others, or {NO_PLACE}"
            )
    return str(dim), None


def _reader(places: tuple[Any, Any], dims: tuple[Any, Any]) -> Any:
    turned = [place.transpose(*dims) for place in places]
    return lambda row, n: tuple(place[row : row + n].values for place in turned)


def _check_unit(array: Any, name: str, coord: Any, crs: CRS | None) -> None:
    """Raise `InvalidHeightsError` if numbers and unit of a coordinate do not fit the CRS."""
    unit = str(coord.attrs.get("units", "")).lower()
    if crs is None:
        if unit in _RADIANS:  # they would pass for degrees
            raise InvalidHeightsError(
                f"{title(array)}: the coordinate {name} is in {unit}, and no CRS says of what;"
                f" expected degrees or a CRS: assign them, or {NO_PLACE}"
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
    elif is_degrees(coord):
        is_other, unit = not said.in_degrees and largest <= 360, "degrees"
    elif said.in_degrees:
        is_other = math.isfinite(_METRES.get(unit, math.inf)) and largest > 360
    else:
        is_other = abs(_METRES.get(unit, in_metres) / in_metres - 1) > 1e-5
    if is_other:
        raise InvalidHeightsError(
            f"{title(array)}: the coordinate {name} is in {unit}, the unit of its CRS is"
            f" {crs_unit}; expected coordinates of the CRS: assign them, or {NO_PLACE}"
        )


def _check_even(array: Any, what: str, fit: Fit) -> None:
    if fit.is_even:
        return
    how_far = (
        f"samples lie up to {fit.deviation:.3g} pixels beside an even grid"
        if math.isfinite(fit.deviation)
        else "samples follow no grid"
    )
    raise InvalidHeightsError(
        f"{title(array)}: {what} not evenly spaced, {how_far}; expected at most {fit.allowed:.2g}:"
        f" resample the heights first, for example by array.interp or gdalwarp, or {NO_PLACE}"
    )
