"""Coefficients on the borders of a tile, exact and first (format-cdf53.md, C.4).

Two tiles share the samples of a border, whose lines are transformed only along themselves. Both
code the same coefficients, wherever their streams are cut, so shared samples stay equal.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.coding.lifting53 import HELD_BOTTOM, HELD_LEFT, HELD_RIGHT, HELD_TOP, level_shapes
from terrainwave.coding.rangecoder import (
    MAGNITUDE_MODELS,
    N_UNARY,
    code_magnitude,
    code_raw,
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
    new_models,
)
from terrainwave.coding.status import raise_for_status
from terrainwave.errors import InvalidHeightsError

_N_CONTEXTS = 24
_MAX_COEFFICIENT = 1 << 32


def border_lines(
    field: NDArray[np.int64], n_transforms: int, held: int
) -> Iterator[NDArray[np.int64]]:
    """Yield the coefficients of each held side of a transformed field, coarse to fine; views."""
    shapes = level_shapes(field.shape, n_transforms)
    for side in (HELD_TOP, HELD_LEFT, HELD_BOTTOM, HELD_RIGHT):
        if not held & side:
            continue
        for t in range(n_transforms - 1, -1, -1):
            (n_rows, n_cols), (low_rows, low_cols) = shapes[t], shapes[t + 1]
            if side in (HELD_TOP, HELD_BOTTOM):
                yield field[0 if side == HELD_TOP else low_rows - 1, low_cols:n_cols]
            else:
                yield field[low_rows:n_rows, 0 if side == HELD_LEFT else low_cols - 1]


def encode_borders(field: NDArray[np.int64], n_transforms: int, held: int) -> bytes:
    """Return the stream of the coefficients of `border_lines` and set them to zero."""
    lines = list(border_lines(field, n_transforms, held))
    n_coefficients = sum(line.size for line in lines)
    stream = np.empty(16 + 16 * n_coefficients, dtype=np.uint8)
    coder = new_encoder(stream, new_models(_N_CONTEXTS * MAGNITUDE_MODELS))
    for line in lines:
        values = line.copy()
        if np.abs(values).max(initial=0) > _MAX_COEFFICIENT:
            raise InvalidHeightsError("found heights too far apart for method cdf53")
        _code_line(values, coder, np.empty_like(values))
        line[:] = 0
    return stream[: finish_encoder(coder.state, stream)].tobytes()


def decode_borders(stream: bytes, field: NDArray[np.int64], n_transforms: int, held: int) -> None:
    """Set the coefficients that `encode_borders` took from the field."""
    coder = new_decoder(stream, new_models(_N_CONTEXTS * MAGNITUDE_MODELS))
    for line in border_lines(field, n_transforms, held):
        values = np.empty(line.size, dtype=np.int64)
        _code_line(None, coder, values)
        line[:] = values
    raise_for_status(*finish_decoder(coder.state, coder.stream))


@kernel
def _context(last, before):
    """Return the first model for a magnitude after two others: the bits of their weighted sum."""
    total, n_bits = 2 * last + before, 0
    while total >> n_bits and n_bits < _N_CONTEXTS - 1:
        n_bits += 1
    return n_bits * MAGNITUDE_MODELS


@kernel
def _code_line(goal, coder, values):
    """Encode the coefficients `goal`, or decode if it is None; in both cases into `values`."""
    last = before = value = np.int64(0)
    for at in range(values.shape[0]):
        if goal is not None:
            value = goal[at]
        first = _context(last, before)
        magnitude = code_magnitude(coder, first, first + N_UNARY, np.int64(0), abs(value))
        values[at] = magnitude
        if magnitude and code_raw(coder, np.int64(1), np.int64(value < 0)):
            values[at] = -magnitude
        last, before = magnitude, last
