"""Corrections in the loop: heights that a patch restores before others use them (FORMAT.md §5.4).

A lossy file reaches multiples of its step from each prediction. If a prediction changes, because a
neighbour has changed, the old height of a sample that must stay is no longer one of these: the
correction is the difference. Refiners add it before the sample is used, so changes end within a
stencil's reach of their cause.

The section codes an array of the unit's region, nearly all 0: pieces of rows that have corrections,
in these the corrected samples, and their signs and magnitudes.
"""

from typing import Any

import numpy as np

from terrainwave.codec.refiner import (
    FREE,
    MAX_CORRECTION,
    NO_CORRECTIONS,
    Corrections,
    GroupSpec,
    Heights,
)
from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.jit import inlined_kernel, kernel
from terrainwave.coding.rangecoder import (
    N_PREFIX,
    N_UNARY,
    code_magnitude_step,
    code_raw_step,
    code_step,
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
    new_models,
    put_back,
    take_out,
)
from terrainwave.coding.status import raise_for_status
from terrainwave.errors import CorruptStreamError

# Columns of a piece, from the region's first column on.
PIECE = 32
# By the parity of the row; the previous piece, the one above, the one above that.
_PIECES = 0
# By the parities of row and column; numbers of corrected samples among two neighbours to the west,
# two to the north, and two next to the nearest of these.
_SAMPLES = _PIECES + 16
_SIZES = _SAMPLES + 4 * 27
_PREFIX = _SIZES + N_UNARY
N_MODELS = _PREFIX + N_PREFIX
# Rows above and columns to the sides that contexts use.
_ABOVE, _LEFT, _RIGHT = 2, 2, 1
# Estimate; of a correction without context.
_BYTES_OF_SAMPLE = 8


def correct(height: Any, kept: Any, added: Any, place: Any, limits: Any, shown: Any) -> Any:
    """Return a height, corrected and within limits if there are corrections; of flat arrays.

    An encoder computes the correction of a kept height here: none if the clamped height equals it
    already.
    """
    if added.shape[0] == 0:
        return height
    if kept.shape[0] > 0:
        goal = np.int64(kept[place])
        if goal != FREE:
            is_right = min(max(height, shown[0]), shown[1]) == goal
            missing = np.int64(0) if is_right else goal - height
            added[place] = np.int32(min(max(missing, -MAX_CORRECTION), MAX_CORRECTION))
    return min(max(height + np.int64(added[place]), limits[0]), limits[1])


corrected = inlined_kernel(correct)  # for kernels


def encode_corrections(added: Heights, spec: GroupSpec) -> bytes:
    """Return the section of corrections; empty if all are 0."""
    if not added.any():
        return b""
    padded = np.zeros(_padded_shape(added.shape), dtype=np.int32)
    padded[_ABOVE:, _LEFT:-_RIGHT] = added
    n_bytes = added.size + _BYTES_OF_SAMPLE * int(np.count_nonzero(added)) + 64
    while True:  # again with twice the room if needed
        out = np.empty(n_bytes, dtype=np.uint8)
        coder = new_encoder(out, new_models(N_MODELS))
        _code(coder, padded, *_geometry(spec))
        n_bytes = finish_encoder(coder.state, out)
        if n_bytes <= out.size:
            return out[:n_bytes].tobytes()


def decode_corrections(section: bytes, spec: GroupSpec) -> Corrections:
    """Undo `encode_corrections`."""
    coder = new_decoder(section, new_models(N_MODELS))
    padded = np.zeros(_padded_shape(spec.region.shape), dtype=np.int32)
    most = _code(coder, padded, *_geometry(spec))
    raise_for_status(*finish_decoder(coder.state, coder.stream))
    if not 0 < most <= MAX_CORRECTION:
        raise CorruptStreamError(
            f"the largest correction of a unit is {most}, expected 1 to {MAX_CORRECTION}"
        )
    return NO_CORRECTIONS._replace(added=np.ascontiguousarray(padded[_ABOVE:, _LEFT:-_RIGHT]))


def _padded_shape(shape: tuple[int, ...]) -> tuple[int, int]:
    return shape[0] + _ABOVE, shape[1] + _LEFT + _RIGHT


def _geometry(spec: GroupSpec) -> tuple[int, int, bool, int]:
    """Return the geometric arguments of `_code`.

    They are the parities of the region's first row and column, whether samples on even rows and
    columns are the parent's, and the number of raw low bits of a magnitude.
    """
    is_group = spec.parent_region is not None
    shift = max(spec.step.bit_length() - 5, 0)
    return spec.region.row & 1, spec.region.col & 1, is_group, shift


@kernel
def _code(coder, padded, first_row, first_col, is_group, shift):
    """Encode the corrections in `padded`, or decode them into it; return the largest magnitude."""
    coder, padded = borrowed((coder, padded))
    state, stream, models, is_encoder = coder
    n_rows, n_cols = padded.shape[0] - _ABOVE, padded.shape[1] - _LEFT - _RIGHT
    n_pieces = (n_cols + PIECE - 1) // PIECE
    had = np.zeros((3, n_pieces + 1), dtype=np.uint8)  # three rows in rotation
    at = take_out(state)
    largest = np.int64(0)
    for row in range(n_rows):
        odd_row = (first_row + row) & 1
        here, above, above2 = had[row % 3], had[(row + 2) % 3], had[(row + 1) % 3]
        for piece in range(n_pieces):
            begin, end = piece * PIECE, min((piece + 1) * PIECE, n_cols)
            has_any = np.int64(0)
            if is_encoder is not None:
                for col in range(begin, end):
                    if padded[row + _ABOVE, col + _LEFT] != 0:
                        has_any = np.int64(1)
            model = 8 * odd_row + 4 * here[piece] + 2 * above[piece + 1] + above2[piece + 1]
            has_any, at = code_step(at, state, stream, models, is_encoder, _PIECES + model, has_any)
            here[piece + 1] = has_any
            if has_any == 0:
                continue
            for col in range(begin, end):
                odd_col = (first_col + col) & 1
                if is_group and odd_row == 0 and odd_col == 0:
                    continue
                r, c = row + _ABOVE, col + _LEFT
                west = np.int64(padded[r, c - 1] != 0) + (padded[r, c - 2] != 0)
                north = np.int64(padded[r - 1, c] != 0) + (padded[r - 2, c] != 0)
                beside = np.int64(padded[r - 1, c - 1] != 0) + (padded[r - 1, c + 1] != 0)
                model = 27 * (2 * odd_row + odd_col) + 9 * west + 3 * north + beside
                value = np.int64(padded[r, c])
                is_any, at = code_step(
                    at, state, stream, models, is_encoder, _SAMPLES + model, np.int64(value != 0)
                )
                if is_any == 0:
                    continue
                is_negative, at = code_raw_step(
                    at, state, stream, is_encoder, 1, np.int64(value < 0)
                )
                size, at = code_magnitude_step(
                    at, state, stream, models, is_encoder, _SIZES, _PREFIX, shift, abs(value) - 1
                )
                largest = max(largest, size + 1)
                size = min(size + 1, np.int64(MAX_CORRECTION))
                padded[r, c] = -size if is_negative else size
        if is_encoder is None and at[2] > stream.shape[0] + 4:
            break  # `finish_decoder` reports it
    put_back(at, state)
    return largest
