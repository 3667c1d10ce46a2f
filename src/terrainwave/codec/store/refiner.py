"""Method ``store``: raw indices on a fixed grid, bit-packed (FORMAT.md §8).

It validates the refiner interface, serves as test double, and bounds the size of any file. Levels
are nested: a sample on an even row and column is its parent's and is not stored again.
"""

import struct

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.refiner import GroupSpec, Heights, Labels, Mask
from terrainwave.errors import CorruptStreamError, TruncatedStreamError

_HEAD = struct.Struct("<iB")
_MAX_BITS = 31


class StoreRefiner:
    """Trivial refiner: samples that the parent lacks, as fixed-width indices."""

    name = "store"

    def encode(
        self, spec: GroupSpec, parent: Heights | None, target: Heights, mask: Mask | None
    ) -> tuple[bytes, Heights, Labels | None]:
        stored = _stored(spec, parent, mask)
        indices = (target[stored].astype(np.int64) - spec.z_min) // spec.step
        low = int(indices.min()) if indices.size else 0
        n_bits = int(indices.max() - low).bit_length() if indices.size else 0
        payload = _HEAD.pack(low, n_bits) + _pack_bits(indices - low, n_bits)
        heights, labels = self.decode(spec, parent, mask, payload)
        return payload, heights, labels

    def decode(
        self, spec: GroupSpec, parent: Heights | None, mask: Mask | None, payload: bytes
    ) -> tuple[Heights, Labels | None]:
        if len(payload) < _HEAD.size:
            raise TruncatedStreamError(
                f"a stored unit needs {_HEAD.size} bytes, found {len(payload)}"
            )
        low, n_bits = _HEAD.unpack_from(payload)
        if n_bits > _MAX_BITS:
            raise CorruptStreamError(
                f"a stored unit has {n_bits} bits per sample, at most {_MAX_BITS} are legal"
            )
        stored = _stored(spec, parent, mask)
        indices = _unpack_bits(payload[_HEAD.size :], int(np.count_nonzero(stored)), n_bits) + low
        heights = _inherited(spec, parent)
        values = spec.z_min + indices * spec.step + spec.half
        heights[stored] = np.clip(values, spec.z_min, spec.z_max)
        return heights, None


def _inherited(spec: GroupSpec, parent: Heights | None) -> Heights:
    """Return the region with the parent's samples in place and 0 elsewhere."""
    heights = np.zeros(spec.region.shape, dtype=np.int32)
    if parent is not None:
        rows, cols, source = _even_positions(spec)
        heights[rows, cols] = parent[source]
    return heights


def _stored(spec: GroupSpec, parent: Heights | None, mask: Mask | None) -> NDArray[np.bool_]:
    stored = np.ones(spec.region.shape, dtype=np.bool_) if mask is None else mask.copy()
    if parent is not None:
        rows, cols, _ = _even_positions(spec)
        stored[rows, cols] = False
    return stored


def _even_positions(spec: GroupSpec) -> tuple[slice, slice, tuple[slice, slice]]:
    """Return where the parent's samples lie in this region, and their indices in the parent."""
    region, outer = spec.region, spec.parent_region
    assert outer is not None
    row, col = region.row + (region.row & 1), region.col + (region.col & 1)
    rows = slice(row - region.row, region.n_rows, 2)
    cols = slice(col - region.col, region.n_cols, 2)
    n_rows, n_cols = (
        len(range(*rows.indices(region.n_rows))),
        len(range(*cols.indices(region.n_cols))),
    )
    first_row, first_col = (row >> 1) - outer.row, (col >> 1) - outer.col
    return rows, cols, (slice(first_row, first_row + n_rows), slice(first_col, first_col + n_cols))


def _pack_bits(values: NDArray[np.int64], n_bits: int) -> bytes:
    """Pack non-negative `values`, `n_bits` each, most significant bit first."""
    shifts = np.arange(n_bits - 1, -1, -1)
    return np.packbits((values[:, None] >> shifts & 1).astype(np.uint8)).tobytes()


def _unpack_bits(data: bytes, n_values: int, n_bits: int) -> NDArray[np.int64]:
    """Undo `_pack_bits`; the data must have exactly the bytes needed."""
    n_bytes = (n_values * n_bits + 7) // 8
    if len(data) < n_bytes:
        raise TruncatedStreamError(f"stored heights need {n_bytes} bytes, found {len(data)}")
    if len(data) > n_bytes:
        raise CorruptStreamError(
            f"{len(data) - n_bytes} bytes are left over after the stored heights"
        )
    bits = np.unpackbits(np.frombuffer(data, dtype=np.uint8), count=n_values * n_bits)
    weights = np.int64(1) << np.arange(n_bits - 1, -1, -1, dtype=np.int64)
    values: NDArray[np.int64] = bits.reshape(n_values, n_bits).astype(np.int64) @ weights
    return values
