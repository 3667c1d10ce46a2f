"""Scale and offset that an array's numbers still need, and the values that mark its voids."""

import contextlib
import math
import re
from typing import Any, NamedTuple

import numpy as np

from terrainwave.errors import InvalidHeightsError
from terrainwave.raster_io.labelled.signs import title


class Packing(NamedTuple):
    """Scale and offset of an array's numbers; `applied` are those that are applied already."""

    scale: float
    offset: float
    applied: tuple[float, float] | None
    notes: list[str]


def packing_of(array: Any) -> Packing:
    """Return scale and offset by attributes and encoding of a DataArray.

    xarray moves both from the attributes to the encoding when it applies them; a calculation keeps
    them in the attributes. So floats are packed only if that is their type in the file.
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


class Voids(NamedTuple):
    """Values that mark voids, in stored units, and the valid range."""

    values: list[int | float]
    valid_range: tuple[float, float] | None
    notes: list[str]


def voids_of(array: Any, band: int, packing: Packing) -> Voids:
    """Return the values that accessor, attributes and encoding of a DataArray declare void.

    `array` must be the object that the user gave: parts of it lack settings of its accessor.
    """
    attrs, encoding = array.attrs, getattr(array, "encoding", {})
    declared: list[Any] = []
    # rioxarray converts to the array's type, which may not hold it.
    with contextlib.suppress(AttributeError, OverflowError, RuntimeError, TypeError, ValueError):
        if array.rio.nodata == array.rio.nodata:  # NaN stands for a value in the encoding
            declared.append(array.rio.nodata)
    # With a scale, the nodata values of the encoding are packed numbers: no height equals them.
    is_packed = bool({"scale_factor", "add_offset"} & set(encoding)) or _is_unsigned(encoding)
    if _is_unsigned(attrs) and array.dtype.kind == "i":
        raise InvalidHeightsError(
            f"{title(array)}: the attribute _Unsigned says that its numbers of type {array.dtype}"
            " have no sign; expected them as they are meant: open the file with"
            f" mask_and_scale=True, or array.astype('u{array.dtype}') without that attribute"
        )
    for fields in (attrs, {} if is_packed else encoding):
        declared += [fields.get(name) for name in _FILL_NAMES]
        per_band = np.atleast_1d(np.asarray(fields.get("nodatavals", ()), dtype=object))
        declared += list(per_band[band - 1 : band] if per_band.size > 1 else per_band)
    numbers = [number for value in declared for number in numbers_of(value)]
    if packing.applied is not None:  # also applied to voids
        scale, offset = packing.applied
        numbers += [number * scale + offset for number in numbers]
    values: dict[Any, int | float] = {}
    for number in numbers:
        values.setdefault("nan" if number != number else number, number)
    by_hand = packing.applied is not None
    return Voids(list(values.values()), *_valid_range(attrs, encoding, array.dtype, by_hand))


def _is_unsigned(fields: Any) -> bool:
    return str(fields.get("_Unsigned", "")).lower() == "true"


_FILL_NAMES = ("_FillValue", "missing_value", "fill_value", "nodata")


def _valid_range(
    attrs: Any, encoding: Any, dtype: np.dtype[Any], by_hand: bool
) -> tuple[tuple[float, float] | None, list[str]]:
    """Return the range of valid values, in the numbers of the array, and a note.

    It is in packed numbers, unless its type is wider than theirs (CF 1.11, 2.5.1).
    """
    ends = numbers_of(attrs.get("valid_range"))
    if len(ends) != 2:
        low, high = (numbers_of(attrs.get(name)) for name in ("valid_min", "valid_max"))
        ends = [low[0] if len(low) == 1 else -math.inf, high[0] if len(high) == 1 else math.inf]
    if ends == [-math.inf, math.inf] or any(end != end for end in ends):
        return None, []
    is_decoded = bool({"scale_factor", "add_offset"} & set(encoding)) or _is_unsigned(encoding)
    packing = encoding if is_decoded else attrs
    packed_type = np.dtype(encoding.get("dtype", dtype)) if is_decoded else dtype
    if by_hand:
        is_decoded, packed_type = True, np.dtype(np.int64)
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
