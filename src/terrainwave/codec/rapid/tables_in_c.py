"""The bytes of a file's tables by the native library, as `file_tables` codes them."""

import ctypes
from typing import Any

import numpy as np

from terrainwave.codec.in_c import INT, POINTER, call
from terrainwave.codec.planes import MAX_WEIGHT
from terrainwave.codec.rapid.symbols import N_CLASSES, SINGLES
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
        size=ctypes.sizeof(_Job), state=coder.state.ctypes.data, stream=coder.stream.ctypes.data,
        n_stream=len(coder.stream), models=coder.models.ctypes.data,
        is_encoder=coder.is_encoder is not None, n_stencils=len(known["stencils"]),
        n_planes=len(known["tap_kinds"]), n_taps=known["tap_kinds"].shape[1],
        n_weights=len(known["weights"]), n_features=known["weights"].shape[1],
        n_tables=len(known["is_own"]), most_symbols=known["codes"].shape[1], n_classes=N_CLASSES,
        singles=SINGLES, max_weight=MAX_WEIGHT,
        **{name: array.ctypes.data for name, array in known.items()},
    )  # fmt: skip
    call("twz_python_code_tables", ctypes.byref(job))
    return job.status, job.which
