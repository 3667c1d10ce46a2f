"""Units encoded by the native library, as `unit.UnitCoder` does it with kernels of numba."""

import ctypes
import threading
from collections import OrderedDict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.in_c import ENCODERS, INT, POINTER, Owned, call, function, padded
from terrainwave.codec.memory import flat, new_heights
from terrainwave.codec.rapid.details import LEAST_CUT, MOST_CUT
from terrainwave.codec.rapid.layout import HH, HL, LH, plane_shape
from terrainwave.codec.rapid.tables import Tables
from terrainwave.codec.rapid.unit import LEAST_SIDE, UnitCoder
from terrainwave.codec.refiner import (
    ALL_ROWS,
    NO_CORRECTIONS,
    Corrections,
    GroupSpec,
    Heights,
    Labels,
    Mask,
    Raw,
    Rows,
)
from terrainwave.coding.native_library import address
from terrainwave.forks import renew_after_fork

_MOST_TABLES = 8  # Python's have 2 MB each
_N_SEEN = 5
_PLANES = HH, HL, LH


class _Job(ctypes.Structure):
    """A unit that is encoded (encode_job of native/src/encode.h)."""

    _fields_ = [
        ("size", ctypes.c_size_t),
        *((name, INT) for name in ("level", "step", "z_min", "z_max", "n_rows", "n_cols")),
        ("shared", INT * 4),
        ("parent_rows", INT),
        ("parent_cols", INT),
        ("parent_stride", ctypes.c_int64),
        *(
            (name, POINTER)
            for name in (
                "parent", "target", "valid", "kept", "added", "out", "counts", "seen", "payload",
            )
        ),
        ("n_payload", ctypes.c_uint64),
        ("shift", INT),
    ]  # fmt: skip


class _KnownTables:
    """Tables as the library has them, by those of Python that they were made of."""

    def __init__(self) -> None:
        self.renew()
        renew_after_fork(self)

    def renew(self) -> None:
        """Begin anew after a fork, which may have left the lock held."""
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[int, bool], tuple[Tables, Owned]] = OrderedDict()

    def of(self, tables: Tables, *, is_read: bool) -> Owned:
        """Return the library's tables; Python's stay with them, so that no others get their id."""
        with self._lock:
            key = id(tables), is_read
            if key not in self._known:
                self._known[key] = tables, _new_tables(tables, is_read=is_read)
            self._known.move_to_end(key)
            while len(self._known) > _MOST_TABLES:
                self._known.popitem(last=False)
            return self._known[key][1]


def _new_tables(tables: Tables, *, is_read: bool) -> Owned:
    arrays: list[NDArray[Any]] = [
        np.ascontiguousarray(tables.stencils, dtype=np.int64),
        np.ascontiguousarray(tables.weights, dtype=np.int64),
        np.ascontiguousarray(tables.frequencies.freqs, dtype=np.uint32),
        np.ascontiguousarray(tables.frequencies.starts, dtype=np.uint32),
    ]
    return Owned(
        "twz_python_tables_new", "twz_python_tables_free", tables.k_max, tables.frequencies.cut,
        is_read, *(address(array) for array in arrays),
    )  # fmt: skip


_TABLES = _KnownTables()


def encode(
    coder: UnitCoder,
    spec: GroupSpec,
    parent: Heights | None,
    target: Heights,
    mask: Mask | None,
    corrections: Corrections = NO_CORRECTIONS,
) -> tuple[bytes, Heights, Labels | None]:
    """Do as `UnitCoder.encode`."""
    job, arrays = _new_job(spec, parent, target, mask, corrections)
    with ENCODERS.lent() as encoder:
        _run(encoder, coder, job)
        payload = ctypes.string_at(job.payload, job.n_payload)
    return payload, arrays[0], None


def decode_into(
    coder: UnitCoder,
    spec: GroupSpec,
    parent: Heights | None,
    mask: Mask | None,
    payload: bytes,
    out: Heights,
    corrections: Corrections = NO_CORRECTIONS,
    rows: Rows = ALL_ROWS,
    raw: Raw | None = None,
) -> bool:
    """Do as `UnitCoder.decode_into`, which decodes parts, and says what is wrong with others."""
    if rows == ALL_ROWS or parent is None:
        job, arrays = _new_job(spec, parent, None, mask, corrections, out)
        data = padded(payload)
        job.payload, job.n_payload = address(data), len(payload)
        tables = _TABLES.of(coder.tables(job.step), is_read=True)
        try:
            with ENCODERS.lent() as decoder:
                call("twz_python_decode", decoder.address, tables.address, ctypes.byref(job))
        except ValueError:
            pass
        else:
            if arrays[0] is not out:
                out[:] = arrays[0]
            return False
    by_numba: bool = UnitCoder.decode_into.__wrapped__(  # type: ignore[attr-defined]
        coder, spec, parent, mask, payload, out, corrections, rows, raw
    )
    return by_numba


def count(
    coder: UnitCoder,
    spec: GroupSpec,
    parent: Heights | None,
    target: Heights,
    mask: Mask | None,
    counts: NDArray[np.int64],
) -> Heights:
    """Do as `UnitCoder.count`."""
    job, arrays = _new_job(spec, parent, target, mask, NO_CORRECTIONS)
    assert counts.flags.c_contiguous
    job.counts = address(counts)
    keep, shapes = coder.keep, _lattices(spec, parent)
    if keep is not None:
        sizes = [_N_SEEN * n_rows * n_cols for _, shape in shapes for *_, n_rows, n_cols in shape]
        seen = np.empty(sum(sizes), dtype=np.int32)
        job.seen = address(seen)
    with ENCODERS.lent() as encoder:
        _run(encoder, coder, job)
    if keep is not None:
        at = 0
        for level, planes in shapes:
            which = coder.tables(spec.step).level_class(level)
            for plane, n_rows, n_cols in planes:
                end = at + _N_SEEN * n_rows * n_cols
                own = seen[at:end].reshape(_N_SEEN, -1)
                keep(which, plane, job.shift, own[:3], own[3], own[4].astype(np.bool_))
                at = end
    return arrays[0]


def count_seen(
    features: NDArray[np.int32], details: NDArray[np.int32], is_coded: NDArray[np.bool_],
    weights: NDArray[np.int32], _memory: Any, *counts: NDArray[np.int64],
) -> None:  # fmt: skip
    """Do as `details.count_seen`."""
    features = np.ascontiguousarray(features)
    details, is_coded = np.ascontiguousarray(details), np.ascontiguousarray(is_coded)
    weights = np.ascontiguousarray(weights, dtype=np.int32)
    assert all(array.flags.c_contiguous for array in counts)
    do = function(
        "twz_python_count_seen", None, *(POINTER,) * 3, ctypes.c_size_t, POINTER, INT, INT,
        *(POINTER,) * 3,
    )  # fmt: skip
    do(
        address(features), address(details), address(is_coded), len(details),
        address(weights), LEAST_CUT, MOST_CUT, *(address(array) for array in counts),
    )  # fmt: skip


def _lattices(
    spec: GroupSpec, parent: Heights | None
) -> list[tuple[int, list[tuple[int, int, int]]]]:
    """Return the level of each lattice of a unit, and its planes that are kept: rows, and columns.

    Columns of an odd number have one more, which makes a pair of the last one.
    """
    n_rows, n_cols = spec.region.shape
    strides = [1]
    if parent is None:
        strides = []
        while 1 << len(strides) < max(n_rows, n_cols) - 1:
            strides.insert(0, 1 << len(strides))
    found = []
    for stride in strides:
        shape = (n_rows - 1) // stride + 1, (n_cols - 1) // stride + 1
        planes = [(plane, *plane_shape(plane, shape)) for plane in _PLANES]
        own = [(plane, n, m + (m & 1)) for plane, n, m in planes if min(n, m) >= LEAST_SIDE]
        found.append((spec.level - (stride.bit_length() - 1), own))
    return found


def _new_job(
    spec: GroupSpec, parent: Heights | None, target: Heights | None, mask: Mask | None,
    corrections: Corrections, out: Heights | None = None,
) -> tuple[_Job, list[NDArray[Any]]]:  # fmt: skip
    """Return a unit as the library takes it, and the arrays it refers to; the first has heights.

    It is `out`, if C can write there.
    """
    if out is None or not (out.flags.carray and out.dtype == np.int32):
        out = new_heights(spec.region.shape)
    arrays: list[NDArray[Any]] = [out]
    job = _Job(
        size=ctypes.sizeof(_Job), level=spec.level, step=spec.step, z_min=spec.z_min,
        z_max=spec.z_max, n_rows=out.shape[0], n_cols=out.shape[1], shared=tuple(spec.shared),
        out=address(out),
    )  # fmt: skip
    if target is not None:
        arrays.append(np.ascontiguousarray(target, dtype=np.int32))
        job.target = address(arrays[-1])
    if parent is not None:
        source, job.parent_stride = flat(parent)
        job.parent, (job.parent_rows, job.parent_cols) = address(source), parent.shape
        arrays.append(source)
    if mask is not None:
        valid = np.ascontiguousarray(mask)
        job.valid = address(valid)
        arrays.append(valid)
    if corrections.added.size:
        kept = np.ascontiguousarray(corrections.kept, dtype=np.int32)
        assert corrections.added.flags.c_contiguous
        job.kept, job.added = address(kept), address(corrections.added)
        arrays += [kept, corrections.added]
    return job, arrays


def _run(encoder: Owned, coder: UnitCoder, job: _Job) -> None:
    tables = _TABLES.of(coder.tables(job.step), is_read=False)
    call("twz_python_encode", encoder.address, tables.address, ctypes.byref(job))
