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

from terrainwave.codec.planes import HH, HL, LH, A

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
SIDE = _rows.take()  # its sign: towards which side errors are likelier
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
N_LOW = _rows.take()  # raw bits of a detail
LINE = _rows.take()
RESULT = _rows.take()
_weights = _rows.take()
WORKSPACE_SIZE = _ROW_BUFFERS + _rows.n * STRIDE

MAX_TAPS = 23
N_FEATURES = 9
ON_LINE = 4  # features of lines stand after those of the planes


def place(plane: int, row: int, col: int) -> np.uint64:
    """Return where a plane's sample lies, counted from the corner of a row's neighbourhood."""
    return np.uint64(plane * PLANE + (row + ROWS_ABOVE) * STRIDE + col + PAD)


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
_E_HH, _E_HL, _E_LH = HH + ERRORS, HL + ERRORS, LH + ERRORS
# Features in the order of the weights; those of errors and those of ranges have different units.
F_CONST, F_NORTH, F_DIAGONAL, F_NORTH_2, F_RANGE, F_TWIST, F_BEND, F_NEAR, F_FAR = range(9)


def _above(plane: int) -> dict[int, tuple[tuple[int, int, int], ...]]:
    """Return the errors of the same plane that features add up."""
    return {
        F_NORTH: ((plane, -1, 0),),
        F_DIAGONAL: ((plane, -1, -1), (plane, -1, 1)),
        F_NORTH_2: ((plane, -2, 0),),
    }


# What features add up: errors of the plane and of those before, curvatures of plane A.
FEATURE_TAPS = {
    HH: {
        **_above(_E_HH),
        F_BEND: ((BENDS, 0, 0), (BENDS, 0, 1), (BENDS, 1, 0), (BENDS, 1, 1)),
    },
    HL: {
        **_above(_E_HL),
        F_BEND: ((BENDS, 0, 0), (BENDS, 0, 1)),
        F_NEAR: ((_E_HH, -1, 0), (_E_HH, 0, 0)),
        F_FAR: ((_E_HH, -1, -1), (_E_HH, 0, -1), (_E_HH, -1, 1), (_E_HH, 0, 1)),
    },
    LH: {
        **_above(_E_LH),
        F_BEND: ((BENDS, 0, 0), (BENDS, 1, 0)),
        F_NEAR: (
            *((_E_HH, 0, -1), (_E_HH, 0, 0)),
            *((_E_HL, 0, -1), (_E_HL, 0, 0), (_E_HL, 1, -1), (_E_HL, 1, 0)),
        ),
        F_FAR: ((_E_HH, -1, -1), (_E_HH, -1, 0), (_E_HH, 1, -1), (_E_HH, 1, 0)),
    },
}

# Kernels take a stencil's taps, then those of features, in their order.
N_STENCIL_TAPS = tuple(np.uint64(len(TAPS.get(plane, ()))) for plane in range(4))
FEATURE_ORDER = (F_NORTH, F_DIAGONAL, F_NORTH_2, F_BEND, F_NEAR, F_FAR)


def _tap_places() -> NDArray[np.uint64]:
    """Return the places of all taps, by plane."""
    taps = [
        [*TAPS[plane], *(tap for f in FEATURE_ORDER for tap in FEATURE_TAPS[plane].get(f, ()))]
        if plane in TAPS
        else []
        for plane in range(4)
    ]
    places = np.zeros((4, max(map(len, taps))), dtype=np.uint64)
    for plane, own in enumerate(taps):
        places[plane, : len(own)] = [place(*tap) for tap in own]
    return places


TAP_PLACES = _tap_places()
# The core: twist is |first + second - third - fourth|.
CORE_PLACES = np.array(
    [
        (place(0, 0, 0),) * 4,
        tuple(place(*CORES[HH][k]) for k in (0, 3, 1, 2)),
        tuple(place(*tap) for tap in CORES[HL]),
        tuple(place(*tap) for tap in CORES[LH]),
    ],
    dtype=np.uint64,
)

# In the workspace from `WEIGHTS` on: of each plane, then of lines, the weights of its stencil's
# taps, then from `OF_FEATURES` on those of features.
OF_FEATURES = np.uint64(MAX_TAPS)
N_WEIGHTS = MAX_TAPS + N_FEATURES
WEIGHTS = tuple(np.uint64(int(_weights) + N_WEIGHTS * plane) for plane in range(ON_LINE + 1))
# After them, shift counts. Of 32 bits and less than 32, they let compilers shift 32 bits, where
# others would be shifts of 64, of which most processors have no vectors.
RANGE_SHIFT, ERROR_SHIFT, SIDE_SHIFT, END_SHIFT = (
    np.uint64(int(WEIGHTS[ON_LINE]) + N_WEIGHTS + k) for k in range(4)
)
SHIFT_MASK = 31


class Scale(NamedTuple):
    """What follows from the step and the range of heights (R.4)."""

    step: int
    error_shift: int
    range_shift: int
    most_range: int
    side_shift: int
    side_scale: int
    far_scale: int
    is_fine: bool
    is_by_reach: bool
    most_detail: int
    low: int
    high: int


def arranged_weights(
    stencils: NDArray[np.int64], features: NDArray[np.int64], scale: Scale
) -> NDArray[np.int64]:
    """Return the weights of a lattice as the workspace has them, from ``WEIGHTS[HH]`` on.

    Parameters
    ----------
    stencils : ndarray of int64, shape (3, MAX_TAPS)
    features : ndarray of int64, shape (4, N_FEATURES)
        Of the planes, then of lines.
    """
    weights = np.zeros((ON_LINE, N_WEIGHTS), dtype=np.int64)
    weights[:LH, :MAX_TAPS] = stencils
    weights[:, MAX_TAPS:] = features
    end_shift = 2 + scale.error_shift - scale.side_shift
    shifts = [scale.range_shift, scale.error_shift, scale.side_shift, end_shift]
    return np.concatenate([weights.ravel(), np.array(shifts, dtype=np.int64)])


class Workspace(NamedTuple):
    """The arrays that a thread codes in, one unit after the other."""

    m: NDArray[Any]  # int32 or int64
    reals: NDArray[np.float32]
    bits_of_reals: NDArray[np.int32]


def new_workspace(dtype: type[np.int32] | type[np.int64]) -> Workspace:
    """Return a workspace for heights of 32 or 64 bits."""
    reals = np.zeros(STRIDE, dtype=np.float32)
    return Workspace(np.zeros(WORKSPACE_SIZE, dtype=dtype), reals, reals.view(np.int32))
