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
# Heights of planes are kept within this, less the origin and shifted: their quarters fit int16.
LIMIT = 8191
WEIGHT_BITS = 12
MAX_WEIGHT = (1 << 15) - 1
# A stencil's absolute weights have at most this sum: no sum of a prediction reaches 2**31.
MAX_SUM = 1 << 18
# Classes of levels that have stencils and weights of their own; the last one is of all coarser.
N_LEVEL_CLASSES = 4

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


class Runs(NamedTuple):
    """Taps side by side, two at a time: where the first of each run lies, and which taps it has."""

    planes: NDArray[np.int64]
    rows: NDArray[np.int64]
    cols: NDArray[np.int64]
    first: NDArray[np.int64]  # numbers of taps; -1: none
    second: NDArray[np.int64]


def _runs(taps: list[tuple[int, int, int]]) -> Runs:
    runs, left = [], {tap: number for number, tap in enumerate(taps)}
    while left:
        plane, row, col = tap = next(iter(left))
        number = left.pop(tap)
        runs.append((plane, row, col, number, left.pop((plane, row, col + 1), -1)))
    return Runs(*np.array(runs, dtype=np.int64).T.copy())


RUNS = {plane: _runs(taps) for plane, taps in TAPS.items()}
_CORE = {plane: np.array(core, dtype=np.int64) for plane, core in CORES.items()}


def run_weights(plane: int, weights: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the weights of a plane's taps by run, shape (n_runs, 2)."""
    both = np.append(weights[: N_TAPS[plane]], 0)
    runs = RUNS[plane]
    return np.stack([both[runs.first], both[runs.second]], axis=1).astype(np.int32)


def core_of(plane: int) -> NDArray[np.int64]:
    """Return `CORES` as an array, shape (4, 3)."""
    return _CORE[plane]


def plane_shape(plane: int, shape: tuple[int, int]) -> tuple[int, int]:
    """Return rows and columns of a plane of a lattice."""
    n_rows, n_cols = shape
    odd_row, odd_col = plane in (HH, LH), plane in (HH, HL)
    return (n_rows + (not odd_row)) // 2, (n_cols + (not odd_col)) // 2
