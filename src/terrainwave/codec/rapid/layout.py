"""Planes of a unit and the samples that predict each of them.

The even rows and columns of a unit are its parent's samples (plane A). The others are coded plane
by plane: HH (odd row, odd column), HL (even row, odd column), LH (odd row, even column), each from
A and from planes before it, none from its own samples. So each plane is one pass over arrays.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

A, HH, HL, LH = 0, 1, 2, 3
N_PLANES = 3
# Samples around each plane that taps and features reach.
PAD = 4
# Rows are worked on in so many samples at once; memory goes on for as many behind a row.
LANES = 32
# Heights of planes are kept within this, less the origin and shifted: their quarters fit int16.
LIMIT = 8191
WEIGHT_BITS = 12
MAX_WEIGHT = (1 << 15) - 1
# A stencil's absolute weights have at most this sum: no sum of a prediction reaches 2**31.
MAX_SUM = 1 << 18
# Classes of levels that have stencils and weights of their own; the last one is of all coarser.
N_LEVEL_CLASSES = 4
# Rows of a plane that are coded together. Those of LH lie one row further up: they see HL below.
STRIP_ROWS = 8

# Taps (plane, row, column) from the sample's place in its plane.
TAPS: dict[int, list[tuple[int, int, int]]] = {
    HH: [(A, row, col) for row in (-1, 0, 1, 2) for col in (-1, 0, 1, 2)],
    HL: [
        *((A, row, col) for row in (-1, 0, 1) for col in (-1, 0, 1, 2)),
        *((HH, -2, 0), (HH, -1, -1), (HH, -1, 0), (HH, -1, 1)),
        *((HH, 0, -1), (HH, 0, 0), (HH, 0, 1), (HH, 1, 0)),
    ],
    LH: [
        *((A, row, col) for row in (-1, 0, 1, 2) for col in (-1, 0, 1)),
        *((HH, -1, -1), (HH, -1, 0), (HH, 0, -2), (HH, 0, -1)),
        *((HH, 0, 0), (HH, 0, 1), (HH, 1, -1), (HH, 1, 0)),
        *((HL, 0, -1), (HL, 0, 0), (HL, 1, -1), (HL, 1, 0)),
    ],
}
# The four nearest known samples: a prediction stays between them.
CORES: dict[int, list[tuple[int, int, int]]] = {
    HH: [(A, 0, 0), (A, 0, 1), (A, 1, 0), (A, 1, 1)],
    HL: [(A, 0, 0), (A, 0, 1), (HH, -1, 0), (HH, 0, 0)],
    LH: [(A, 0, 0), (A, 1, 0), (HH, 0, -1), (HH, 0, 0)],
}
N_TAPS = {plane: len(taps) for plane, taps in TAPS.items()}


def plane_shape(plane: int, shape: tuple[int, int]) -> tuple[int, int]:
    """Return rows and columns of a plane of a lattice."""
    n_rows, n_cols = shape
    odd_row, odd_col = plane in (HH, LH), plane in (HH, HL)
    return (n_rows + (not odd_row)) // 2, (n_cols + (not odd_col)) // 2


class Lattice(NamedTuple):
    """Numbers of a lattice for kernels: a group, or the samples of a root block at one stride.

    Heights are within ``low`` ... ``high``, details within ±most. Planes hold
    ``(height - origin) >> shift``, and no more than heights without a shift if it `is_narrow`.
    """

    n_rows: int
    n_cols: int
    step: int
    low: int
    high: int
    most: int
    origin: int
    shift: int
    is_narrow: bool
    has_void: bool


class Workspace(NamedTuple):
    """Arrays that lattices take turns with, of at most `side` samples a side in each plane."""

    side: int
    planes: NDArray[np.int16]  # with PAD samples outside; A, HH, HL, LH
    ranges: NDArray[np.int16]  # of cells of A, and bends of its samples, with one more outside
    bends: NDArray[np.int16]
    near: NDArray[np.int16]  # magnitudes of details of HH and HL, with one more outside
    details: NDArray[np.int32]  # of HH, HL, LH, rows without a gap but of an even length
    predicted: NDArray[np.int32]  # of a row, and what follows
    sides: NDArray[np.int32]
    heights: NDArray[np.int32]
    expected: NDArray[np.int32]
    floats: NDArray[np.float32]
    bits: NDArray[np.int32]  # the same memory
    pairs: NDArray[np.int8]  # of a strip, and what follows
    singles: NDArray[np.int8]
    entries: NDArray[np.uint8]
    symbols: NDArray[np.uint8]
    more: NDArray[np.int32]


def new_workspace(side: int) -> Workspace:
    """Return memory for planes of `side` samples a side."""
    high, wide, n = side + 2 * PAD, side + 2 * PAD + LANES, STRIP_ROWS * (side + 1)
    floats = np.zeros(side + 1, dtype=np.float32)
    return Workspace(
        side=side,
        planes=np.zeros((1 + N_PLANES, high, wide), dtype=np.int16),
        ranges=np.zeros((side + 2, side + 2), dtype=np.int16),
        bends=np.zeros((side + 2, side + 2), dtype=np.int16),
        near=np.zeros((2, side + 2, side + 2), dtype=np.int16),
        details=np.zeros((N_PLANES, (side + 1) * (side + 2) + LANES), dtype=np.int32),
        predicted=np.zeros(side + LANES, dtype=np.int32),
        sides=np.zeros(side + LANES, dtype=np.int32),
        heights=np.zeros(side + LANES, dtype=np.int32),
        expected=np.zeros(side + 1, dtype=np.int32),
        floats=floats,
        bits=floats.view(np.int32),
        pairs=np.zeros(n // 2, dtype=np.int8),
        singles=np.zeros(n, dtype=np.int8),
        entries=np.zeros(n + 1, dtype=np.uint8),
        symbols=np.zeros(n + 1, dtype=np.uint8),
        more=np.zeros(n + 1, dtype=np.int32),
    )
