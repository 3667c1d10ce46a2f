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
    RANGE,
    decode_step,
    encode_bit,
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
def _mask_context(mask, implied, row, col):
    """Return the model of sample (row, col); samples outside the unit count as void."""
    n_rows, n_cols = mask.shape
    west = col >= 1 and mask[row, col - 1]
    west2 = col >= 2 and mask[row, col - 2]
    north = row >= 1 and mask[row - 1, col]
    north2 = row >= 2 and mask[row - 2, col]
    north_west = row >= 1 and col >= 1 and mask[row - 1, col - 1]
    north_east = row >= 1 and col + 1 < n_cols and mask[row - 1, col + 1]
    causal = 32 * west + 16 * north + 8 * north_west + 4 * north_east + 2 * west2 + north2
    ahead = 0
    if row + 1 < n_rows and implied[row + 1, col]:
        ahead += 1
    if col + 1 < n_cols and implied[row, col + 1]:
        ahead += 1
    phase = 2 * (row & 1) + (col & 1)
    return (causal * _N_AHEAD + ahead) * _N_PHASES + phase


@kernel
def _encode_mask(mask, implied, state, out, models):
    """Encode in raster order; return the number of bytes."""
    for row in range(mask.shape[0]):
        for col in range(mask.shape[1]):
            if not implied[row, col]:
                encode_bit(
                    state,
                    out,
                    models,
                    _mask_context(mask, implied, row, col),
                    np.int64(mask[row, col]),
                )
    return finish_encoder(state, out)


@kernel
def _decode_mask(data, implied, state, models, mask):
    """Fill `mask`; return (status, position)."""
    start_decoder(state, data)
    span, code, pos = state[RANGE], state[CODE], state[BYTE_POS]
    for row in range(mask.shape[0]):
        for col in range(mask.shape[1]):
            if not implied[row, col]:
                model = _mask_context(mask, implied, row, col)
                bit, span, code, pos = decode_step(span, code, pos, data, models, model)
                mask[row, col] = bit == 1
        if pos > data.shape[0] + 4:
            return Status.TRUNCATED, data.shape[0]
    state[RANGE], state[CODE], state[BYTE_POS] = span, code, pos
    return finish_decoder(state, data)
