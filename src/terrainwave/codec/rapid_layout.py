"""The workspace of `rapid`: where planes and rows lie in one flat array (format-rapid.md, R.5).

Row slices and array arguments cost reference counts, about 1 µs a row in compiled code. So all
planes of a lattice and all row buffers are one array `m`, of int32 or int64, and everything in it
is a place: an unsigned number. Places of neighbours differ by constants, which compilers turn into
plain vector loads.

Of each plane only the rows around those being coded are kept, `N_ROWS` of them; when the last one
is used up, the latest move to the front. Row `i` of a plane is in slot ``i - base + ROWS_ABOVE``.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.lattice import HH, HL, LH, A

PAD = 4  # samples kept free beside each row; taps reach at most 3 past its end
ROWS_ABOVE, ROWS_BELOW = 4, 3  # rows that stay reachable above and below the one at hand
# Widest lattice: two blocks of 1024 cells have planes of 1025. Consecutive rows of usual blocks
# then lie in different sets of a cache of 64 sets of 64 bytes.
MAX_COLS = 1025
STRIDE = 1296
N_ROWS = 40
PLANE = N_ROWS * STRIDE
ERRORS = 3  # the errors of plane p are plane p + ERRORS
BENDS = 7
_ROW_BUFFERS = 8 * PLANE


class _Rows:
    """Hands out places of row buffers, one after the other."""

    def __init__(self) -> None:
        self.n = 0

    def take(self) -> np.uint64:
        self.n += 1
        return np.uint64(_ROW_BUFFERS + (self.n - 1) * STRIDE + PAD)


_rows = _Rows()
PREDICTED = _rows.take()  # in 1/64 quanta
WHOLE = _rows.take()  # the prediction rounded to quanta
SIDE = _rows.take()  # towards which side errors are likelier
LEAST = _rows.take()  # of the core
MOST = _rows.take()
SUM = _rows.take()
TWIST = _rows.take()
EXPECTED = _rows.take()  # the expected magnitude
CONTEXT = _rows.take()
SYMBOL = _rows.take()
DETAIL = _rows.take()  # towards `SIDE`
GOAL = _rows.take()
VALID = _rows.take()
LINE = _rows.take()
RESULT = _rows.take()
_weights = _rows.take()
WORKSPACE_SIZE = _ROW_BUFFERS + _rows.n * STRIDE

MAX_TAPS = 23
N_FEATURES = 9
# Weights of stencils and of features, by plane; the first places are not used.
STENCIL = tuple(np.uint64(int(_weights) + 32 * plane) for plane in range(4))
FEATURE = tuple(np.uint64(int(_weights) + 128 + 16 * plane) for plane in range(5))
ON_LINE = 4  # features of lines stand after those of the planes


def place(plane: int, row: int, col: int) -> np.uint64:
    """Return where a plane's sample lies, counted from the corner of a row's neighbourhood."""
    return np.uint64(plane * PLANE + (row + ROWS_ABOVE) * STRIDE + col + PAD)


def _places(*taps: tuple[int, int, int]) -> tuple[np.uint64, ...]:
    return tuple(place(*tap) for tap in taps)


def _own(plane: int) -> tuple[tuple[int, int, int], ...]:
    return ((plane, -1, -1), (plane, -1, 0), (plane, -1, 1))


# Taps of the stencils as (plane, row, column), rows and columns those of planes (R.6).
TAPS = {
    HH: (*((A, row, col) for row in (-1, 0, 1, 2) for col in (-1, 0, 1, 2)), *_own(HH)),
    HL: (
        *((A, 0, -1), (A, 0, 0), (A, 0, 1), (A, 0, 2)),
        *((A, -1, 0), (A, -1, 1), (A, 1, 0), (A, 1, 1)),
        *((HH, -1, -1), (HH, -1, 0), (HH, -1, 1), (HH, 0, -1), (HH, 0, 0), (HH, 0, 1)),
        *((HH, -2, 0), (HH, 1, 0)),
        *_own(HL),
    ),
    LH: (
        *((A, -1, 0), (A, 0, 0), (A, 1, 0), (A, 2, 0)),
        *((A, 0, -1), (A, 0, 1), (A, 1, -1), (A, 1, 1)),
        *_own(LH),
        *((HH, 0, -2), (HH, 0, -1), (HH, 0, 0), (HH, 0, 1)),
        *((HH, -1, -1), (HH, -1, 0), (HH, 1, -1), (HH, 1, 0)),
        *((HL, 0, -1), (HL, 0, 0), (HL, 1, -1), (HL, 1, 0)),
    ),
}
# The four nearest samples that are known before a plane is coded.
CORES = {
    HH: ((A, 0, 0), (A, 0, 1), (A, 1, 0), (A, 1, 1)),
    HL: ((A, 0, 0), (A, 0, 1), (HH, -1, 0), (HH, 0, 0)),
    LH: ((A, 0, 0), (A, 1, 0), (HH, 0, -1), (HH, 0, 0)),
}
TAPS_HH, TAPS_HL, TAPS_LH = (_places(*TAPS[plane]) for plane in (HH, HL, LH))
CORE_HH, CORE_HL, CORE_LH = (_places(*CORES[plane]) for plane in (HH, HL, LH))
_E_HH, _E_HL, _E_LH = HH + ERRORS, HL + ERRORS, LH + ERRORS
# Errors of the same plane: north, north-west, north-east, two to the north.
ABOVE_HH, ABOVE_HL, ABOVE_LH = (
    _places((plane, -1, 0), (plane, -1, -1), (plane, -1, 1), (plane, -2, 0))
    for plane in (_E_HH, _E_HL, _E_LH)
)
BENDS_HH = _places((BENDS, 0, 0), (BENDS, 0, 1), (BENDS, 1, 0), (BENDS, 1, 1))
BENDS_HL = _places((BENDS, 0, 0), (BENDS, 0, 1))
BENDS_LH = _places((BENDS, 0, 0), (BENDS, 1, 0))
# Errors of the planes before: the nearest ones, then those behind.
NEAR_HL = _places((_E_HH, -1, 0), (_E_HH, 0, 0))
FAR_HL = _places((_E_HH, -1, -1), (_E_HH, 0, -1), (_E_HH, -1, 1), (_E_HH, 0, 1))
NEAR_LH = _places(
    *((_E_HH, 0, -1), (_E_HH, 0, 0), (_E_HL, 0, -1), (_E_HL, 0, 0), (_E_HL, 1, -1), (_E_HL, 1, 0))
)
FAR_LH = _places((_E_HH, -1, -1), (_E_HH, -1, 0), (_E_HH, 1, -1), (_E_HH, 1, 0))


class Scale(NamedTuple):
    """What follows from the step and the range of heights (R.4)."""

    step: int
    error_shift: int
    range_shift: int
    most_range: int
    side_shift: int
    side_scale: int
    is_fine: bool
    most_detail: int
    low: int
    high: int


class Workspace(NamedTuple):
    """The arrays that a thread codes in, one unit after the other."""

    m: NDArray[Any]  # int32 or int64
    reals: NDArray[np.float32]
    bits_of_reals: NDArray[np.int32]


def new_workspace(dtype: type[np.int32] | type[np.int64]) -> Workspace:
    """Return a workspace for heights of 32 or 64 bits."""
    reals = np.zeros(STRIDE, dtype=np.float32)
    return Workspace(np.zeros(WORKSPACE_SIZE, dtype=dtype), reals, reals.view(np.int32))
