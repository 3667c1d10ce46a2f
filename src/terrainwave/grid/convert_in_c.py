"""Quanta, fills and errors by the native library, as `convert` and `block_stats` make them."""

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.native_library import address, loaded

_POINTER, _INT, _LONG = ctypes.c_void_p, ctypes.c_int32, ctypes.c_int64
# Types by their places in RAW_I1 ... of native/src/encode_pyramid.h.
_TYPES = {np.dtype(name): k for k, name in enumerate("i1 u1 i2 u2 i4 u4 i8 f4 f8".split())}
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "quantise": (
        ctypes.c_int, *(_POINTER, ctypes.c_ssize_t) * 2, ctypes.c_size_t, ctypes.c_size_t,
        ctypes.c_int, *(_LONG,) * 3, _POINTER,
    ),
    "dequantise": (ctypes.c_int, _POINTER, ctypes.c_size_t, *(_LONG,) * 5, _POINTER),
    "range_and_error": (*(_POINTER,) * 3, _LONG, _LONG, *(_INT,) * 4, _POINTER),
    "largest_deviation": (_POINTER, ctypes.c_int),
    "push": (_POINTER, *(_INT,) * 4, _POINTER, _INT, _INT, _POINTER, _POINTER),
    "pull": (_POINTER, *(_INT,) * 6, _POINTER, _POINTER),
}  # fmt: skip


@cache
def _function(name: str) -> Any:
    library = loaded()
    assert library is not None
    result = _LONG if name == "largest_deviation" else None
    return library.plain(f"twz_python_{name}", result, *_SIGNATURES[name])


class _Deviation(ctypes.Structure):
    """A window of a raster and a block around it (deviation_job of native/src/encode_measure.h)."""

    _fields_ = [
        *((name, _POINTER) for name in ("heights", "originals", "valid")),
        *((name, _INT) for name in ("height_rows", "height_cols", "n_rows", "n_cols", "shift")),
        *((name, _INT) for name in ("first_row", "first_col", "n_places")),
        ("lowest", _LONG),
        ("lines", _POINTER),
    ]


def _quantise(
    raw: NDArray[Any], valid: NDArray[np.bool_], scale: tuple[int, int], base: int,
    quanta: NDArray[np.int32], *, is_whole: bool,
) -> None:  # fmt: skip
    (raw, *raw_place), (valid, *valid_place) = _rows_of(raw), _rows_of(valid)
    assert quanta.flags.c_contiguous
    assert raw.shape == valid.shape == quanta.shape
    _function("quantise")(
        _TYPES[raw.dtype.newbyteorder("=")], *raw_place, *valid_place, *raw.shape, is_whole,
        *scale, base, address(quanta),
    )  # fmt: skip


def _rows_of(array: NDArray[Any]) -> tuple[NDArray[Any], int, int]:
    """Return an array whose rows are contiguous, its address, and the distance of its rows."""
    are_whole = array.flags.aligned and array.strides[0] % array.itemsize == 0
    if not (array.dtype.isnative and are_whole and array.strides[1] == array.itemsize):
        array = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("="))
    return array, address(array), array.strides[0] // array.itemsize


def quantize_integers(
    raw: NDArray[Any], valid: NDArray[np.bool_], numerator: int, base: int,
    quanta: NDArray[np.int32],
) -> None:  # fmt: skip
    """Do as `convert.quantize_integers`."""
    _quantise(raw, valid, (numerator, 1), base, quanta, is_whole=True)


def quantize_floats(
    raw: NDArray[Any], valid: NDArray[np.bool_], numerator: int, denominator: int, base: int,
    quanta: NDArray[np.int32],
) -> None:  # fmt: skip
    """Do as `convert.quantize_floats`."""
    _quantise(raw, valid, (numerator, denominator), base, quanta, is_whole=False)


def push(
    fine: NDArray[np.int32], first_row: int, first_col: int, lines: NDArray[np.int64],
    values: NDArray[np.int32], known: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Do as `convert.push`."""
    fine = np.ascontiguousarray(fine)
    assert all(array.flags.c_contiguous for array in (lines, values, known))
    _function("push")(
        address(fine), *fine.shape, first_row, first_col, address(lines), *values.shape,
        address(values), address(known),
    )  # fmt: skip


def pull(
    coarse: NDArray[np.int32], first_row: int, first_col: int, known: NDArray[np.bool_],
    values: NDArray[np.int32],
) -> None:  # fmt: skip
    """Do as `convert.pull`."""
    coarse, known = np.ascontiguousarray(coarse), np.ascontiguousarray(known)
    assert values.flags.c_contiguous
    _function("pull")(
        address(coarse), *coarse.shape, first_row, first_col, *values.shape,
        address(known), address(values),
    )  # fmt: skip


def dequantize_integers(
    quanta: NDArray[np.int32], numerator: int, denominator: int, base: int, low: int, high: int,
    out: NDArray[Any],
) -> None:  # fmt: skip
    """Do as `convert.dequantize_integers`."""
    quanta = np.ascontiguousarray(quanta)
    made = out if out.flags.c_contiguous and out.dtype.isnative else np.empty_like(out, order="C")
    made = made.view(made.dtype.newbyteorder("=")) if made is not out else out
    _function("dequantise")(
        _TYPES[made.dtype], address(quanta), quanta.size, numerator, denominator, base, low,
        high, address(made),
    )  # fmt: skip
    if made is not out:
        out[:] = made


def dequantize_floats(
    quanta: NDArray[np.int32], numerator: int, denominator: int, base: int, out: NDArray[Any]
) -> None:
    """Do as `convert.dequantize_floats`."""
    dequantize_integers(quanta, numerator, denominator, base, 0, 0, out)


def range_and_error(
    originals: NDArray[np.int32], mask: NDArray[np.bool_], decoded: NDArray[np.int32],
    first_row: int, first_col: int, n_rows: int, n_cols: int,
) -> tuple[int, int, int]:  # fmt: skip
    """Do as `block_stats.range_and_error`, of contiguous arrays."""
    found = (_INT * 3)()
    _function("range_and_error")(
        address(originals), address(mask), address(decoded), originals.shape[1],
        decoded.shape[1], first_row, first_col, n_rows, n_cols, found,
    )  # fmt: skip
    low, high, error = found
    return low, high, error


def largest_deviation(
    heights: NDArray[np.int32], shift: int, originals: NDArray[np.int32],
    mask: NDArray[np.bool_], first_row: int, first_col: int, lowest: int, lines: NDArray[Any],
    n_places: int,
) -> int:  # fmt: skip
    """Do as `block_stats.largest_deviation`, of contiguous arrays."""
    job = _Deviation(
        address(heights), address(originals), address(mask), *heights.shape,
        *originals.shape, shift, first_row, first_col, n_places, lowest, address(lines),
    )  # fmt: skip
    found: int = _function("largest_deviation")(ctypes.byref(job), lines.dtype == np.int32)
    return found
