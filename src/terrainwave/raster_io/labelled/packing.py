"""Scale and offset of an array that its numbers still need."""

import contextlib
import re
from typing import Any, NamedTuple

import numpy as np

from terrainwave.errors import InvalidHeightsError
from terrainwave.raster_io.labelled.signs import title


class Packing(NamedTuple):
    """Scale and offset of an array's numbers.

    `applied` are those of the attributes if they have been applied already.
    """

    scale: float
    offset: float
    applied: tuple[float, float] | None
    notes: list[str]


def packing_of(array: Any) -> Packing:
    """Return scale and offset by attributes and encoding of a DataArray.

    xarray moves both from the attributes to the encoding when it applies them; a calculation keeps
    them in the attributes, and drops the encoding. So floats are packed only if the encoding gives
    float as their type in the file.
    """
    attrs, encoding = array.attrs, getattr(array, "encoding", {})
    found = number_of(attrs, "scale_factor", 1.0), number_of(attrs, "add_offset", 0.0)
    if found == (1.0, 0.0) or array.dtype.kind != "f":
        return Packing(*found, None, [])
    what = (
        f"{title(array)} has heights of type {array.dtype} and the attributes scale_factor"
        f" {found[0]:g}, add_offset {found[1]:g}"
    )
    if _is_as_opened(array.dtype, encoding):
        return Packing(*found, None, [f"{what}: applied, as its encoding says that it is packed"])
    note = (
        f"{what}: not applied, as calculated heights keep attributes; if these are packed, open the"
        " file with mask_and_scale=True"
    )
    return Packing(1.0, 0.0, found, [note])


def _is_as_opened(dtype: Any, encoding: Any) -> bool:
    """Return whether floats have the file's type, or are rioxarray's masked whole numbers."""
    in_file = encoding.get("rasterio_dtype", encoding.get("dtype"))
    is_masked = {"rasterio_dtype", "dtype"} <= set(encoding)
    return in_file is not None and (is_masked or np.dtype(in_file) == dtype)


def numbers_of(value: Any) -> list[int | float]:
    """Return the numbers of an attribute, which may be one, several, or text."""
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
    if name not in fields:
        return default
    numbers = numbers_of(fields[name])
    if len(numbers) != 1:
        raise InvalidHeightsError(
            f"the attribute {name} is {str(fields[name])[:40]!r}; expected a number: correct it"
        )
    return float(numbers[0])
