"""Four interleaved planes of a nested lattice, and stencils over them (FORMAT.md: predictive).

The samples of a unit on every s-th row and column form a lattice. Its even rows and columns are the
coarse samples (plane A); the others are coded in three passes, HH (odd row, odd column), HL (even
row, odd column) and LH (odd row, even column), each from everything before it. In four separate
planes, every tap of a stencil is a shifted row, so a pass works on whole rows.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.errors import CorruptStreamError

PAD = 2  # samples around each plane that taps reach past its edge
A, HH, HL, LH = 0, 1, 2, 3
WEIGHT_BITS = 12
MAX_BEND = (1 << 31) - 1
# Sum of a stencil's weights; none is larger.
WHOLE = 4096
MAX_WEIGHT = (1 << 15) - 1

# Taps (row, column) in lattice steps from the sample; the first is its western neighbour of the
# same pass, the next three are the row above in the same pass, the rest are known before the pass.
_OWN = ((0, -2), (-2, 0), (-2, -2), (-2, 2))
_HH_TAPS = _OWN + tuple((row, col) for row in (-3, -1, 1, 3) for col in (-3, -1, 1, 3))
_HL_KNOWN = (
    *((0, -1), (0, 1), (0, -3), (0, 3), (-1, 0), (1, 0), (-1, -2), (-1, 2), (1, -2), (1, 2)),
    *((-2, -1), (-2, 1), (2, -1), (2, 1), (-3, 0), (3, 0)),
)
_HL_TAPS = _OWN + _HL_KNOWN
_LH_TAPS = (
    *_OWN,
    *((col, row) for row, col in _HL_KNOWN),
    *((-1, -1), (-1, 1), (1, -1), (1, 1)),
)
_PASS_PARITY = {A: (0, 0), HH: (1, 1), HL: (0, 1), LH: (1, 0)}


def _resolve(pass_: int, offsets: tuple[tuple[int, int], ...]) -> NDArray[np.int64]:
    """Return (plane, row offset, column offset) of lattice offsets from a pass's sample."""
    row_parity, col_parity = _PASS_PARITY[pass_]
    planes = {parity: plane for plane, parity in _PASS_PARITY.items()}
    taps = []
    for row, col in offsets:
        row, col = row + row_parity, col + col_parity
        taps.append((planes[row & 1, col & 1], row >> 1, col >> 1))
    return np.array(taps, dtype=np.int64)


TAPS = {HH: _resolve(HH, _HH_TAPS), HL: _resolve(HL, _HL_TAPS), LH: _resolve(LH, _LH_TAPS)}
_DIAGONAL = ((-1, -1), (-1, 1), (1, -1), (1, 1))
_ALONG_ROW, _ALONG_COL = ((0, -1), (0, 1), (-1, 0), (1, 0)), ((-1, 0), (1, 0), (0, -1), (0, 1))
# The four nearest known samples.
CORES = {HH: _resolve(HH, _DIAGONAL), HL: _resolve(HL, _ALONG_ROW), LH: _resolve(LH, _ALONG_COL)}
# Samples of the same lattice with known errors of prediction: near ones, then far ones.
NEAR = {
    HH: np.zeros((0, 3), dtype=np.int64),
    HL: _resolve(HL, ((-1, 0), (1, 0))),
    LH: _resolve(LH, ((0, -1), (0, 1), *_DIAGONAL)),
}
FAR = {
    HH: np.zeros((0, 3), dtype=np.int64),
    HL: _resolve(HL, ((-1, -2), (-1, 2), (1, -2), (1, 2))),
    LH: _resolve(LH, ((-2, -1), (2, -1), (-2, 1), (2, 1))),
}
# Coarse samples whose curvature is used.
BENDS = {
    HH: _resolve(HH, _DIAGONAL),
    HL: _resolve(HL, ((0, -1), (0, 1))),
    LH: _resolve(LH, ((-1, 0), (1, 0))),
}
# Four samples in a row; the feature is |first - second - third + fourth|.
LINES = {
    HH: _resolve(
        HH,
        (
            *((-1, -3), (-1, -1), (-1, 1), (-1, 3), (1, -3), (1, -1), (1, 1), (1, 3)),
            *((-3, -1), (-1, -1), (1, -1), (3, -1), (-3, 1), (-1, 1), (1, 1), (3, 1)),
        ),
    ),
    HL: _resolve(HL, tuple((0, i) for i in (-3, -1, 1, 3)) + tuple((i, 0) for i in (-3, -1, 1, 3))),
    LH: _resolve(LH, tuple((i, 0) for i in (-3, -1, 1, 3)) + tuple((0, i) for i in (-3, -1, 1, 3))),
}


class Pass(NamedTuple):
    """The geometry of one pass, for kernels; each an int64 array of (plane, row, column)."""

    plane: int
    taps: NDArray[np.int64]
    core: NDArray[np.int64]
    near: NDArray[np.int64]
    far: NDArray[np.int64]
    bends: NDArray[np.int64]
    lines: NDArray[np.int64]


PASSES = tuple(
    Pass(p, TAPS[p], CORES[p], NEAR[p], FAR[p], BENDS[p], LINES[p]) for p in (HH, HL, LH)
)


class FileStencil(NamedTuple):
    """A stencil as a file stores it: trained set `base`, plus ``deltas * 2**shift`` if any.

    The weight of one tap follows from the others, whose sum with it is 4096; its delta is 0.
    """

    base: int
    shift: int = 0
    deltas: tuple[int, ...] = ()

    def weights(self, sets: NDArray[Any], missing: int, plane: int) -> NDArray[np.int64]:
        """Return the weights of a plane with the trained `sets` and the `missing` tap."""
        if self.base >= len(sets):
            raise CorruptStreamError(f"a stencil builds on set {self.base}, which does not exist")
        weights: NDArray[np.int64] = sets[self.base].astype(np.int64)
        if self.deltas:
            weights += np.array(self.deltas, dtype=np.int64) << self.shift
            weights[missing] = 0
            weights[missing] = WHOLE - weights.sum()
            if np.abs(weights).max() > MAX_WEIGHT:
                raise CorruptStreamError(f"a stencil of plane {plane} has a weight beyond 2^15")
        return weights


def plane_sizes(shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Return (n_rows, n_cols) of the planes of a lattice, without padding."""
    even, odd = [(n + 1) >> 1 for n in shape], [n >> 1 for n in shape]
    return [(even[0], even[1]), (odd[0], odd[1]), (even[0], odd[1]), (odd[0], even[1])]


def parity(plane: int) -> tuple[int, int]:
    """Return row and column of a plane's first sample in the lattice."""
    return _PASS_PARITY[plane]


# numpy's copies are some microseconds slower per unit, but need no compilation.


def split(lattice: NDArray[np.int32], planes: NDArray[np.int32]) -> None:
    """Copy the samples of `lattice` into the padded planes."""
    for plane, part in enumerate(_parts(lattice)):
        _inside(planes[plane], part.shape)[...] = part


def merge(planes: NDArray[np.int32], lattice: NDArray[np.int32]) -> None:
    """Copy the samples of the padded planes into `lattice`: undo `split`."""
    for plane, part in enumerate(_parts(lattice)):
        part[...] = _inside(planes[plane], part.shape)


def _parts(lattice: NDArray[np.int32]) -> list[NDArray[np.int32]]:
    """Return the samples of each plane in a lattice."""
    return [lattice[row::2, col::2] for row, col in _PASS_PARITY.values()]


def _inside(plane: NDArray[np.int32], shape: tuple[int, ...]) -> NDArray[np.int32]:
    """Return a padded plane without its padding."""
    return plane[PAD : PAD + shape[0], PAD : PAD + shape[1]]


def reflected(place: Any, n: Any) -> Any:
    """Return the position in 0 … n - 1 that whole-sample symmetry maps to `place`; n >= 1."""
    if n == 1:
        return np.int64(0)
    while place < 0 or place >= n:
        place = -place if place < 0 else 2 * (n - 1) - place
    return np.int64(place)


reflect = kernel(reflected)  # for kernels


def fill_frame(
    plane: NDArray[np.int32],
    row_parity: int,
    col_parity: int,
    n_lattice_rows: int,
    n_lattice_cols: int,
) -> None:
    """Fill the padding of a padded plane by symmetry about the lattice's first and last samples."""
    n_rows = (n_lattice_rows + 1 - row_parity) >> 1
    n_cols = (n_lattice_cols + 1 - col_parity) >> 1
    if n_rows == 0 or n_cols == 0:
        return
    rows = plane[PAD : PAD + n_rows]
    for to, source in _framed(n_cols, col_parity, n_lattice_cols):
        rows[:, to] = rows[:, source]
    cols = plane[:, : n_cols + 2 * PAD]
    for to, source in _framed(n_rows, row_parity, n_lattice_rows):
        cols[to] = cols[source]


@lru_cache(maxsize=256)
def _framed(n: int, parity: int, n_lattice: int) -> list[tuple[int, int]]:
    """Return the positions of padding along an axis of a plane, and the samples they copy."""
    return [
        (PAD + k, PAD + int(reflected(2 * k + parity, n_lattice) >> 1))
        for k in (*range(-PAD, 0), *range(n, n + PAD))
    ]


def fill_between(planes: NDArray[np.int32]) -> None:
    """Fill all of HH, HL and LH with means of the surrounding coarse samples.

    For lattices of a single row or column, where taps reach samples that don't exist.
    """
    here = planes[A].astype(np.int64)
    south = np.concatenate([here[1:], here[-1:]])
    east, south_east = (np.concatenate([one[:, 1:], one[:, -1:]], 1) for one in (here, south))
    planes[HH] = (here + east + south + south_east + 2) >> 2
    planes[HL] = (here + east + 1) >> 1
    planes[LH] = (here + south + 1) >> 1


def fill_bends(coarse: NDArray[np.int32], most: int, bends: NDArray[np.int32]) -> None:
    """Fill `bends` with fourth differences of the coarse plane along its row plus its column.

    Positions closer than two samples to the edge of the padded plane copy their neighbour's.
    Heights lie within +/- `most`; larger differences are clamped to MAX_BEND.
    """
    is_narrow = most < MAX_BEND >> 4  # then 32 bits are enough throughout
    heights = coarse if is_narrow else coarse.astype(np.int64)
    n_rows, n_cols = coarse.shape
    rows, cols = slice(2, n_rows - 2), slice(2, n_cols - 2)
    middle = 6 * heights[rows, cols]
    across = heights[rows, :-4] + heights[rows, 4:] + middle
    across -= 4 * (heights[rows, 1:-3] + heights[rows, 3:-1])
    along = heights[:-4, cols] + heights[4:, cols] + middle
    along -= 4 * (heights[1:-3, cols] + heights[3:-1, cols])
    bends[rows, cols] = np.minimum(abs(across) + abs(along), MAX_BEND)
    bends[rows, 1], bends[rows, n_cols - 2] = bends[rows, 2], bends[rows, n_cols - 3]
    bends[1], bends[n_rows - 2] = bends[2], bends[n_rows - 3]
