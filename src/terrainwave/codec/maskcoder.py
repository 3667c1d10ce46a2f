"""Lossless coding of a unit's validity mask (FORMAT.md §5.2).

One adaptive bit per sample that the parent does not already imply to be void, in raster order. The
context is six causal neighbours, where each axis lies relative to the parent's samples, and how
many of the two nearest samples to come are already known to be void.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave._jit import kernel
from terrainwave._status import Status, raise_for_status
from terrainwave.codec.refiner import Mask
from terrainwave.coding.rangecoder import (
    BYTE_POS,
    CODE,
    LOW,
    RANGE,
    decode_step,
    encode_step,
    finish_decoder,
    finish_encoder,
    new_models,
    start_decoder,
    start_encoder,
)

_N_CAUSAL, _N_AHEAD, _N_PHASES = 64, 3, 4
N_MASK_MODELS = _N_CAUSAL * _N_AHEAD * _N_PHASES
# An adaptive bit costs at most 16 bits, so this is room for any mask.
_BYTES_PER_SAMPLE = 2


def encode_mask(mask: Mask, implied: Mask) -> bytes:
    """Return the bytes of `mask`, which must be False wherever `implied` is True.

    Parameters
    ----------
    mask, implied : ndarray of bool, shape (n_rows, n_cols)
        Valid samples, and samples known to be void without a bit.
    """
    state = start_encoder()
    out = np.empty(_BYTES_PER_SAMPLE * mask.size + 8, dtype=np.uint8)
    n_bytes = _encode_mask(mask, implied, state, out, new_models(N_MASK_MODELS))
    return out[:n_bytes].tobytes()


def decode_mask(data: bytes, implied: Mask) -> Mask:
    """Undo `encode_mask`.

    Raises
    ------
    CorruptStreamError
        If the bytes are not exactly one mask.
    """
    mask = np.zeros(implied.shape, dtype=np.bool_)
    stream: NDArray[np.uint8] = np.frombuffer(data, dtype=np.uint8)
    state = start_encoder()
    status, byte_pos = _decode_mask(stream, implied, state, new_models(N_MASK_MODELS), mask)
    raise_for_status(status, byte_pos)
    return mask


@kernel
def _row_contexts(padded, implied, row, contexts):
    """Fill `contexts` with the part of each sample's model that its own row does not decide.

    `padded` holds the mask behind two rows and columns of voids: samples outside the unit count as
    void.
    """
    n_cols = contexts.shape[0]
    above, above2 = padded[row + 1], padded[row]
    phase = 2 * (row & 1)
    for col in range(n_cols):
        causal = (
            16 * above[col + 2]
            + 8 * above[col + 1]
            + 4 * above[col + 3]
            + np.int64(above2[col + 2])
        )
        contexts[col] = causal * (_N_AHEAD * _N_PHASES) + phase + (col & 1)
    if row + 1 < implied.shape[0]:
        for col in range(n_cols):
            contexts[col] += _N_PHASES * np.int64(implied[row + 1, col])
    for col in range(n_cols - 1):
        contexts[col] += _N_PHASES * np.int64(implied[row, col + 1])


@kernel
def _encode_mask(mask, implied, state, out, models):
    """Encode in raster order; return the number of bytes."""
    n_rows, n_cols = mask.shape
    padded = np.zeros((n_rows + 2, n_cols + 3), dtype=np.bool_)
    contexts = np.empty(n_cols, dtype=np.int64)
    span, low = state[RANGE], state[LOW]
    for row in range(n_rows):
        _row_contexts(padded, implied, row, contexts)
        west = west2 = np.int64(0)
        for col in range(n_cols):
            bit = np.int64(mask[row, col])
            if not implied[row, col]:
                model = contexts[col] + (32 * west + 2 * west2) * (_N_AHEAD * _N_PHASES)
                span, low = encode_step(span, low, state, out, models, model, bit)
            padded[row + 2, col + 2] = mask[row, col]
            west2, west = west, bit
    state[RANGE], state[LOW] = span, low
    return finish_encoder(state, out)


@kernel
def _decode_mask(data, implied, state, models, mask):
    """Fill `mask`; return (status, position)."""
    n_rows, n_cols = mask.shape
    padded = np.zeros((n_rows + 2, n_cols + 3), dtype=np.bool_)
    contexts = np.empty(n_cols, dtype=np.int64)
    start_decoder(state, data)
    span, code, pos = state[RANGE], state[CODE], state[BYTE_POS]
    for row in range(n_rows):
        _row_contexts(padded, implied, row, contexts)
        west = west2 = np.int64(0)
        for col in range(n_cols):
            bit = np.int64(0)
            if not implied[row, col]:
                model = contexts[col] + (32 * west + 2 * west2) * (_N_AHEAD * _N_PHASES)
                bit, span, code, pos = decode_step(span, code, pos, data, models, model)
                mask[row, col] = bit == 1
            padded[row + 2, col + 2] = bit == 1
            west2, west = west, bit
        if pos > data.shape[0] + 4:
            return Status.TRUNCATED, data.shape[0]
    state[RANGE], state[CODE], state[BYTE_POS] = span, code, pos
    return finish_decoder(state, data)
