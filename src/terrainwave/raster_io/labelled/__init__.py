"""Names and attributes of xarray's objects: dimensions x and y, positions of samples.

xarray is not a dependency: `array` is any object with dims, coords and attrs. Statements are read
as the CF conventions and rioxarray define them; missing ones lead to an error or a note, never to a
guess.
"""

import contextlib
import re
from typing import Any, NamedTuple

from terrainwave.arguments import check_band
from terrainwave.errors import InvalidHeightsError
from terrainwave.grid.affine import IDENTITY, Transform
from terrainwave.place.crs import format_crs
from terrainwave.raster_io.labelled.place import (
    crs_of,
    stored_transform,
    told_transform,
    transform_of,
)
from terrainwave.raster_io.labelled.signs import (
    by_axis,
    by_name,
    by_standard_name,
    by_units,
    coords_along,
    mapping_name,
    places_of,
    sizes_of,
    title,
)


class LabelledArray(NamedTuple):
    """Rows and columns of one array, with its coordinates, attributes and accessor interpreted."""

    array: Any  # rows, then columns
    transform: Transform
    crs: str | None
    notes: list[str]


def layer_of(array: Any, source: Any, band: int, *, georeference: bool) -> LabelledArray:
    """Return the only layer of heights in a DataArray, or its `band`, taken from `source`."""
    crs, notes = crs_of(array, source)
    roles = _roles(array, source)
    if len(roles) < 2:
        roles = _unnamed(array, roles, may_guess=not georeference or crs is None)
    layer, band_notes = _only_layer(array, roles, band)
    if tuple(layer.dims) != (roles["y"], roles["x"]):
        layer = layer.transpose(roles["y"], roles["x"])
    if 0 in layer.shape:
        raise InvalidHeightsError(
            f"{title(array)} has the dimensions {sizes_of(array)}; expected at least one sample"
            " along each: choose another part"
        )
    if not georeference:
        return LabelledArray(layer, IDENTITY, None, band_notes)
    transform, place_notes = transform_of(layer, crs, told_transform(array, source))
    notes = [*band_notes, *notes, *place_notes]
    if transform is None:
        if crs is not None:
            notes.append(
                f"no transform says where the samples of {title(array)} lie, so its CRS is"
                " dropped: give it coordinates, or a transform by array.rio.write_transform"
            )
        return LabelledArray(layer, IDENTITY, None, notes)
    return LabelledArray(layer, transform, format_crs(crs), notes)


def variable_of(source: Any) -> Any:
    """Return the DataArray of heights: `source` itself, or its only variable of heights."""
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
        mapping = mapping_name(array)
        # Opened without decode_coords="all", the Dataset has the CRS as a variable.
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
    names = set()
    for variable in dataset.variables.values():
        for fields in (variable.attrs, variable.encoding):
            for key in ("grid_mapping", "bounds", "climatology"):
                names |= set(re.split(r"[\s:]+", str(fields.get(key, "")))) - {""}
    return names


def _roles(array: Any, source: Any) -> dict[str, Any]:
    roles = _by_accessor(array, source)
    for sign in (by_axis, by_standard_name, by_units, None, by_name):
        found: dict[str, list[Any]] = {"x": [], "y": []}
        for dim in array.dims:
            if sign is None:  # the dimension's own name, before those of coordinates along it
                said = set(by_name(dim, None))
            else:
                said = {role for coord in coords_along(array, dim) for role in sign(*coord)}
            for role in said - set(roles):
                if dim not in roles.values():
                    found[role].append(dim)
        for role, dims in found.items():
            if len(dims) > 1:
                raise InvalidHeightsError(
                    f"{title(array)}: the dimensions {' and '.join(map(str, dims))} both say that"
                    f" they are {role}; expected one: {_how_to_tell(array)}"
                )
            if dims and dims[0] not in roles.values():
                roles[role] = dims[0]
    return roles


def _by_accessor(array: Any, source: Any) -> dict[str, Any]:
    roles: dict[str, Any] = {}
    for owner in (array, source):
        accessor = getattr(owner, "rio", None)
        for role in ("x", "y"):
            # rioxarray raises its own RuntimeError if it finds none.
            with contextlib.suppress(AttributeError, RuntimeError):
                dim = getattr(accessor, f"{role}_dim")
                if dim in array.dims:
                    roles.setdefault(role, dim)
    return roles


def _unnamed(array: Any, roles: dict[str, Any], *, may_guess: bool) -> dict[str, Any]:
    dims = tuple(dim for dim in array.dims if dim != "band")
    places = places_of(array)
    if places is not None:
        dims = tuple(dim for dim in array.dims if dim in places[0].dims)
    elif not may_guess or any(coords_along(array, dim) for dim in dims) or stored_transform(array):
        raise InvalidHeightsError(
            f"{title(array)} has the dimensions {sizes_of(array)}, and nothing says which of them"
            f" are x and y; expected rows and columns: {_how_to_tell(array)}"
        )
    long = [dim for dim, size in zip(array.dims, array.shape) if size > 1 and dim in dims]
    if len(dims) != 2 and len(long) == 2:
        dims = tuple(long)
    if len(dims) < 2:
        raise InvalidHeightsError(
            f"{title(array)} has the dimensions {sizes_of(array)}; expected rows and columns"
        )
    row, col = dims[-2:]
    if roles.get("x") == row or roles.get("y") == col:
        row, col = col, row
    return {"y": row, "x": col}


def _how_to_tell(array: Any) -> str:
    y, x = map(str, (*array.dims, "y", "x")[:2])
    return (
        'name them y and x, or give their coordinates the attribute axis, "Y" and "X", or'
        f" array.rio.set_spatial_dims(x_dim={x!r}, y_dim={y!r})"
    )


def _only_layer(array: Any, roles: dict[str, Any], band: int) -> tuple[Any, list[str]]:
    key: list[Any] = []
    notes: list[str] = []
    has_bands = False
    for dim, size in zip(array.dims, array.shape):
        if dim in roles.values():
            key.append(slice(None))
        elif dim == "band":
            check_band(band, size, title(array))
            if size > 1 and band == 1:
                notes.append(f"{title(array)} has {size} bands; using band 1 (choose with `band`)")
            key.append(band - 1)
            has_bands = True
        elif size == 1:
            key.append(0)
        else:
            raise InvalidHeightsError(
                f"{title(array)} has the dimensions {sizes_of(array)}; expected rows and columns:"
                f" choose one layer of {dim}, for example array.isel({dim}=0)"
            )
    if not has_bands:
        check_band(band, 1, title(array))
    return (array if len(key) == 2 else array[tuple(key)]), notes
