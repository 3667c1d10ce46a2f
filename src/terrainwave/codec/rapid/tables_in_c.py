"""A file's tables by the native library: the sums that fit them, and their bytes.

As `fit_stencils`, `fit_weights` and `file_tables` do it.
"""

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.in_c import INT, POINTER, call, function
from terrainwave.codec.planes import MAX_WEIGHT, WHOLE
from terrainwave.codec.rapid import fit_stencils, fit_weights
from terrainwave.codec.rapid.file_tables import MOST_TAPS, N_FEATURES
from terrainwave.codec.rapid.fit_stencils import Reals
from terrainwave.codec.rapid.symbols import N_CLASSES, SINGLES
from terrainwave.codec.refiner import Heights, Mask
from terrainwave.coding.native_library import address
from terrainwave.coding.rangecoder import Coder

_ARRAYS = (
    "stencils", "weights", "cut", "is_own", "codes", "tap_kinds", "skipped", "trained_weights",
    "n_symbols", "rests", "trained",
)  # fmt: skip
_COUNTS = (
    "is_encoder", "n_stencils", "n_planes", "n_taps", "n_weights", "n_features", "n_tables",
    "most_symbols", "n_classes", "singles",
)  # fmt: skip


class _Job(ctypes.Structure):
    """Tables that are coded (tables_job of native/src/encode_tables.h)."""

    _fields_ = [
        ("size", ctypes.c_size_t),
        *((name, POINTER) for name in ("state", "stream")),
        ("n_stream", ctypes.c_uint64),
        *((name, POINTER) for name in ("models", *_ARRAYS)),
        *((name, INT) for name in _COUNTS),
        ("max_weight", ctypes.c_int64),
        ("status", INT),
        ("which", ctypes.c_int64),
    ]


def code_tables(coder: Coder, *arrays: Any) -> tuple[int, int]:
    """Do as `file_tables.code_tables`."""
    numbers = dict(zip(_ARRAYS, arrays, strict=True))
    known = {name: np.ascontiguousarray(array, dtype=np.int64) for name, array in numbers.items()}
    assert all(known[name] is numbers[name] for name in _ARRAYS[:5])  # filled in place
    job = _Job(
        size=ctypes.sizeof(_Job), state=address(coder.state), stream=address(coder.stream),
        n_stream=len(coder.stream), models=address(coder.models),
        is_encoder=coder.is_encoder is not None, n_stencils=len(known["stencils"]),
        n_planes=len(known["tap_kinds"]), n_taps=known["tap_kinds"].shape[1],
        n_weights=len(known["weights"]), n_features=known["weights"].shape[1],
        n_tables=len(known["is_own"]), most_symbols=known["codes"].shape[1], n_classes=N_CLASSES,
        singles=SINGLES, max_weight=MAX_WEIGHT,
        **{name: address(array) for name, array in known.items()},
    )  # fmt: skip
    call("twz_python_code_tables", ctypes.byref(job))
    return job.status, job.which


# Fits -------------------------------------------------------------------------------------------

_LONG, _REAL = ctypes.c_int64, ctypes.c_double
_SIGNATURES: dict[str, tuple[Any, ...]] = {
    "gather_samples": (POINTER,),
    "errors_of": (POINTER, _LONG, _LONG, POINTER, INT, _REAL, _REAL, POINTER),
    "sums_of_bits": (
        POINTER, _LONG, _LONG, POINTER, INT, _REAL, _REAL, POINTER, _REAL, POINTER, POINTER,
    ),
    "products_of": (POINTER, _LONG, _LONG, POINTER, INT, POINTER),
    "solve": (POINTER, _LONG, POINTER),
    "rows_of": (*(POINTER,) * 3, _LONG, _LONG, _REAL, _LONG, POINTER),
    "weighed_products": (POINTER, _LONG, POINTER, _REAL, INT, POINTER, POINTER),
}  # fmt: skip
_BLOCK = 32  # FIT_BLOCK of native/src/encode_fit.h
_RESULTS = {"gather_samples": _LONG, "products_of": INT, "rows_of": _LONG}


class _Gathering(ctypes.Structure):
    """Samples at places (gather_job of native/src/encode_fit.h)."""

    _fields_ = [
        *((name, POINTER) for name in ("heights", "valid", "places", "offsets")),
        ("n_places", _LONG),
        ("n_taps", INT),
        ("core", INT * 4),
        ("factor", _REAL),
        ("most", _REAL),
        ("values", POINTER),
    ]


def _function(name: str) -> Any:
    return function(f"twz_python_{name}", _RESULTS.get(name), *_SIGNATURES[name])


def _address(array: NDArray[Any], dtype: Any, *shape: int) -> int:
    """Return where an array lies; the library reads it as one of a type and shape, without gaps."""
    assert array.dtype == dtype
    assert array.shape == shape
    assert array.flags.c_contiguous
    return address(array)


def gather_at(
    places: NDArray[np.int64], offsets: NDArray[np.int64], core: NDArray[np.int64],
    flat: Heights, valid: Mask | None, step: int, values: Reals,
) -> int:  # fmt: skip
    """Do as `fit_stencils.gather_at`."""
    n, n_taps = len(places), len(offsets) - 1
    if n == 0:
        return 0
    assert places.min() + offsets.min() >= 0
    assert places.max() + offsets.max() < len(flat)
    assert core.max() < n_taps <= MOST_TAPS
    job = _Gathering(
        _address(flat, np.int32, len(flat)),
        None if valid is None else _address(valid, np.bool_, len(flat)),
        _address(places, np.int64, n), _address(offsets, np.int64, n_taps + 1), n, n_taps,
        tuple(core.tolist()), fit_stencils.FINE / step, fit_stencils.MOST,
        _address(values[:n], np.float64, n, MOST_TAPS + 1),
    )  # fmt: skip
    found: int = _function("gather_samples")(ctypes.byref(job))
    return found


def _rows(values: Reals) -> tuple[int, int, int]:
    """Return the address of rows of samples, their number, and of how many they are each first."""
    n, n_columns = values.shape
    every, rest = divmod(values.strides[0], values.itemsize * n_columns)
    assert values.dtype == np.float64
    assert (n_columns, n % _BLOCK, values.strides[1]) == (MOST_TAPS + 1, 0, values.itemsize)
    assert rest == 0 < every
    return address(values), n, every


def _sets(weights: NDArray[np.int64]) -> tuple[Reals, int, int, float]:
    """Return sets of weights as the library takes them, their number, and units of errors."""
    sets = np.zeros((len(weights), MOST_TAPS))
    sets[:, : weights.shape[1]] = weights
    return sets, len(sets), WHOLE, 1.0 / (WHOLE * fit_stencils.FINE)


def errors_of(values: Reals, weights: NDArray[np.int64]) -> Reals:
    """Do as `fit_stencils.errors_of`."""
    (sets, *units), errors = _sets(weights), np.empty((len(weights), len(values)))
    _function("errors_of")(*_rows(values), address(sets), *units, address(errors))
    return errors


def sums_of_bits(values: Reals, weights: NDArray[np.int64], noises: Reals) -> NDArray[np.int64]:
    """Do as `fit_stencils.sums_of_bits`."""
    (sets, *units), sums = _sets(weights), np.zeros(len(weights), dtype=np.int64)
    noises, memory = np.ascontiguousarray(noises), np.empty((len(weights), _BLOCK))
    _function("sums_of_bits")(
        *_rows(values), address(sets), *units, _address(noises, np.float64, len(weights)),
        fit_stencils.MOST_SQUARED,
        address(memory), address(sums),
    )  # fmt: skip
    return sums


def products_of(values: Reals, roots: Reals) -> tuple[Reals, int]:
    """Do as `fit_stencils.products_of`."""
    products = np.empty((MOST_TAPS, MOST_TAPS + 1))
    shift = _function("products_of")(
        *_rows(values), _address(roots, np.float64, len(values)), fit_stencils.MOST_SCALED_BITS,
        address(products),
    )  # fmt: skip
    return products, shift


def solve(systems: Reals) -> Reals:
    """Do as `fit_stencils.solve`."""
    n, solutions = len(systems), np.empty(systems.shape[:2])
    at = _address(systems, np.float64, n, MOST_TAPS, MOST_TAPS + 1)
    _function("solve")(at, n, address(solutions))
    return solutions


def rows_of(
    features: NDArray[np.int32], details: NDArray[np.int32], is_coded: NDArray[np.bool_],
    every: int, unit: float,
) -> Reals:  # fmt: skip
    """Do as `fit_weights.rows_of`."""
    rows = np.empty((N_FEATURES + 1, len(details) // every))
    n, arrays = len(details), [np.ascontiguousarray(own) for own in (features, details, is_coded)]
    found = _function("rows_of")(
        _address(arrays[0], np.int32, N_FEATURES - 1, n), _address(arrays[1], np.int32, n),
        _address(arrays[2], np.bool_, n), n, every, unit, rows.shape[1], address(rows),
    )  # fmt: skip
    return rows[:, :found]


def weighed_products(rows: Reals, weights: Reals) -> Reals:
    """Do as `fit_weights.weighed_products`."""
    rows, weights = np.ascontiguousarray(rows), np.ascontiguousarray(weights)
    parts, products = np.empty_like(rows), np.empty((len(rows), len(rows)))
    n = rows.shape[1]
    _function("weighed_products")(
        _address(rows, np.float64, N_FEATURES + 1, n), n,
        _address(weights, np.float64, N_FEATURES), fit_weights.LEAST_EXPECTED,
        fit_weights.SCALED_BITS, address(parts), address(products),
    )  # fmt: skip
    return products
