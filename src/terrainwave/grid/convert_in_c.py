"""Quanta and fills by the native library, as `convert` makes them by kernels of numba."""

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.native_library import loaded

_POINTER, _INT, _LONG = ctypes.c_void_p, ctypes.c_int32, ctypes.c_int64
# Types by their places in RAW_I1 ... of native/src/encode_pyramid.h.
_TYPES = {np.dtype(name): k for k, name in enumerate("i1 u1 i2 u2 i4 u4 i8 f4 f8".split())}
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "quantise": (
        ctypes.c_int, _POINTER, _POINTER, ctypes.c_size_t, ctypes.c_int, *(_LONG,) * 3, _POINTER,
    ),
    "push": (_POINTER, *(_INT,) * 4, _POINTER, _INT, _INT, _POINTER, _POINTER),
    "pull": (_POINTER, *(_INT,) * 6, _POINTER, _POINTER),
}  # fmt: skip


@cache
def _function(name: str) -> Any:
    library = loaded()
    assert library is not None
    return library.plain(f"twz_python_{name}", None, *_SIGNATURES[name])


def _quantise(
    raw: NDArray[Any], valid: NDArray[np.bool_], scale: tuple[int, int], base: int,
    quanta: NDArray[np.int32], *, is_whole: bool,
) -> None:  # fmt: skip
    raw, valid = np.ascontiguousarray(raw), np.ascontiguousarray(valid)
    assert quanta.flags.c_contiguous
    _function("quantise")(
        _TYPES[raw.dtype.newbyteorder("=")], raw.ctypes.data, valid.ctypes.data, raw.size, is_whole,
        *scale, base, quanta.ctypes.data,
    )  # fmt: skip


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
        fine.ctypes.data, *fine.shape, first_row, first_col, lines.ctypes.data, *values.shape,
        values.ctypes.data, known.ctypes.data,
    )  # fmt: skip


def pull(
    coarse: NDArray[np.int32], first_row: int, first_col: int, known: NDArray[np.bool_],
    values: NDArray[np.int32],
) -> None:  # fmt: skip
    """Do as `convert.pull`."""
    coarse, known = np.ascontiguousarray(coarse), np.ascontiguousarray(known)
    assert values.flags.c_contiguous
    _function("pull")(
        coarse.ctypes.data, *coarse.shape, first_row, first_col, *values.shape,
        known.ctypes.data, values.ctypes.data,
    )  # fmt: skip
