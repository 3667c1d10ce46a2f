"""Fit what details are expected to be, and count their symbols by it (encoder only).

Coded windows give the sizes of details and the features around them. Weights decide how details
are written, not what they are: a window need not be coded again for each. Sums are of whole numbers
below 2**53, and all else is single operations in a fixed order: the same raster gives the same
weights on every machine.
"""

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.rapid.details import count_seen, look
from terrainwave.codec.rapid.file_tables import (
    N_FEATURES,
    N_PAIR_SYMBOLS,
    N_SINGLE_SYMBOLS,
    NEAR,
    NUMBER_OF_CODE,
    PLANES,
    codes_of,
)
from terrainwave.codec.rapid.layout import (
    HH,
    HL,
    LH,
    N_LEVEL_CLASSES,
    Lattice,
    Workspace,
    plane_shape,
)
from terrainwave.codec.rapid.symbols import N_CLASSES
from terrainwave.codec.rapid.tables import WEIGHT_UNIT_BITS, Tables, weights_of
from terrainwave.codec.rapid.unit import LEAST_SIDE, UnitCoder
from terrainwave.coding.native_library import also_in_c

Whole = NDArray[np.int64]
Reals = NDArray[np.float64]

# Of range, bend and what is near, each alone as what is expected (`tables.weights_of`).
_EACH_ALONE = np.eye(5, dtype=np.int32)[1:4]
_AT_A_TIME = 1 << 10
count_samples = also_in_c("terrainwave.codec.rapid.unit_in_c")(count_seen)
_IN_C = also_in_c("terrainwave.codec.rapid.tables_in_c")
# Samples of a class and plane that weights are fitted to, and how many are too few.
_MOST_SAMPLES, _MIN_SAMPLES = 1 << 13, 128
# Scaled to whole numbers of so many bits, products of this many samples have sums below 2**53.
SCALED_BITS = 18
_N_TURNS, _N_SWEEPS = 3, 16
# Samples count by the inverse square of what was expected of them, in steps, and this.
LEAST_EXPECTED = 0.2
_RIDGE = 1e-7
# Codes end here: what one feature cannot expect, others have to.
_LARGEST = float(NUMBER_OF_CODE[-1]) / (1 << WEIGHT_UNIT_BITS)


class Seen(NamedTuple):
    """Samples of a plane of a lattice of coded windows, two of a pair side by side.

    Attributes
    ----------
    which, plane, shift : int
        Class of levels and plane, and how far heights were shifted.
    features : ndarray of int32, shape (3, n)
        Range, bend, and what is near; the first two of shifted heights.
    details : ndarray of int32, shape (n,)
    is_coded : ndarray of bool, shape (n,)
    """

    which: int
    plane: int
    shift: int
    features: NDArray[np.int32]
    details: NDArray[np.int32]
    is_coded: NDArray[np.bool_]


class Observer(UnitCoder):
    """A coder that keeps the samples of the units that it encodes; one thread has one."""

    def __init__(self, tables: Tables) -> None:
        super().__init__(tables)
        self.samples: list[Seen] = []

    def _see(self, which: int, lattice: Lattice, work: Workspace, valid: NDArray[np.uint8]) -> None:
        for plane in PLANES:
            n_rows, n_cols = plane_shape(plane, (lattice.n_rows, lattice.n_cols))
            if min(n_rows, n_cols) < LEAST_SIDE:
                continue
            # An odd end is a pair with a sample like it, which is not coded.
            features = np.empty((3, n_rows, n_cols + (n_cols & 1)), dtype=np.int32)
            look(plane, (work.ranges, work.bends, work.near), _EACH_ALONE, features[:, :, :n_cols])
            features[:, :, n_cols:] = features[:, :, n_cols - 1 : n_cols][:, :, : n_cols & 1]
            is_coded = np.zeros(features.shape[1:], dtype=np.bool_)
            is_coded[:, :n_cols] = True
            if lattice.has_void:
                is_coded[:, :n_cols] = valid[int(plane != HL) :: 2, int(plane != LH) :: 2]
            details = work.details[plane - HH, : is_coded.size].copy()
            flat = features.reshape(3, -1), details, is_coded.ravel()
            self.keep(which, plane, lattice.shift, *flat)

    def keep(
        self, which: int, plane: int, shift: int, features: NDArray[np.int32],
        details: NDArray[np.int32], is_coded: NDArray[np.bool_],
    ) -> None:  # fmt: skip
        """Keep the samples of a plane of a lattice; see `Seen`."""
        self.samples.append(Seen(which, plane, shift, features, details, is_coded))


# Weights ----------------------------------------------------------------------------------------


def fit_magnitude(seen: list[Seen], trained: Whole, step: int) -> NDArray[np.int64]:
    """Return codes of the weights that tell best how large details are, shape (4, 3, 4).

    Where there are too few samples, they are those of the finer class, or the trained ones.
    """
    n_seen: Counter[tuple[int, int]] = Counter()
    for found in seen:
        n_seen[found.which, found.plane - HH] += len(found.details)
    parts: dict[tuple[int, int], list[Reals]] = {}
    for found in seen:
        key = found.which, found.plane - HH
        parts.setdefault(key, []).append(_in_steps(found, -(-n_seen[key] // _MOST_SAMPLES), step))
    joined = {key: np.concatenate(rows, axis=1) for key, rows in parts.items()}
    fitting = {key: rows for key, rows in joined.items() if rows.shape[1] >= _MIN_SAMPLES}
    first = np.array([NUMBER_OF_CODE[trained[key]] for key in fitting]).reshape(-1, N_FEATURES)
    fitted = _fitted(list(fitting.values()), first / (1 << WEIGHT_UNIT_BITS))
    whole = np.rint(fitted * (1 << WEIGHT_UNIT_BITS))
    codes = trained.copy()
    for which in range(N_LEVEL_CLASSES):
        for index in range(len(PLANES)):
            if (which, index) in fitting:
                own = np.minimum(whole[list(fitting).index((which, index))], NUMBER_OF_CODE[-1])
                codes[which, index] = codes_of(own.astype(np.int64))
            elif which:
                codes[which, index] = codes[which - 1, index]
    codes[:, 0, NEAR] = 0
    return codes


def _in_steps(seen: Seen, every: int, step: int) -> Reals:
    """Return rows of 1, of the features, and of sizes of details in steps, of some samples."""
    return rows_of(seen.features, seen.details, seen.is_coded, every, 2.0**seen.shift / step)


@_IN_C
def rows_of(
    features: NDArray[np.int32], details: NDArray[np.int32], is_coded: NDArray[np.bool_],
    every: int, unit: float,
) -> Reals:  # fmt: skip
    """Return the rows of `_in_steps`; the range and the bend are times `unit`."""
    # Not always in the same column.
    turns = np.arange(len(details) // every)
    picks = turns * every + (turns * 40503 >> 4) % every
    coded = picks[is_coded[picks]]
    rows = np.ones((N_FEATURES + 1, len(coded)))
    rows[1:3] = features[:2, coded] * unit
    rows[3] = features[2, coded]
    rows[4] = np.abs(details[coded], dtype=np.float64)
    return rows


def _fitted(samples: list[Reals], weights: Reals) -> Reals:
    """Return weights, none negative, by which features expect the sizes in the last row of samples.

    Details whose sizes are as if by chance around what is expected: the likeliest weights are those
    of least squares in which samples count by the inverse square of what these weights expect.
    """
    for _ in range(_N_TURNS):
        found = [weighed_products(rows, own) for rows, own in zip(samples, weights, strict=True)]
        products = np.array(found).reshape(-1, N_FEATURES + 1, N_FEATURES + 1)
        weights = _in_range(products, weights)
    return weights


@_IN_C
def weighed_products(rows: Reals, weights: Reals) -> Reals:
    """Return the normal equations of a turn; the last row and column are of the sizes."""
    expected = np.full(rows.shape[1], LEAST_EXPECTED)
    for weight, row in zip(weights.tolist(), rows, strict=False):
        expected += weight * row
    whole = rows / expected
    most = whole.max(1)
    units = np.ldexp(1.0, SCALED_BITS - np.frexp(np.where(most > 0, most, 1.0))[1])
    whole *= units[:, None]
    np.rint(whole, out=whole)
    products: Reals = whole @ whole.T / units[:, None] / units
    return products


def _in_range(products: Reals, weights: Reals) -> Reals:
    """Return the solutions of normal equations within the range of codes, one number at a time."""
    systems, found = products[:, :N_FEATURES, :N_FEATURES], weights.copy()
    diagonal = systems[:, np.arange(N_FEATURES), np.arange(N_FEATURES)]
    # A feature that is always 0 has no weight.
    scale = np.where(diagonal > 0, diagonal * (1 + _RIDGE), np.inf)
    for _ in range(_N_SWEEPS):
        for k in range(N_FEATURES):
            rest = products[:, k, N_FEATURES].copy()
            for j in range(N_FEATURES):
                if j != k:
                    rest -= systems[:, k, j] * found[:, j]
            found[:, k] = np.clip(rest / scale[:, k], 0.0, _LARGEST)
    return found


# Symbols ----------------------------------------------------------------------------------------


class Counts(NamedTuple):
    """Counts of symbols by class of pairs.

    Attributes
    ----------
    pairs : ndarray of int64, shape (N_CLASSES, N_PAIR_SYMBOLS)
    singles : ndarray of int64, shape (N_CLASSES, N_CLASSES, N_SINGLE_SYMBOLS)
        Of both samples of a pair, by its class and their own, were they coded by themselves.
    escaped : ndarray of int64, shape (N_CLASSES, N_SINGLE_SYMBOLS)
        Of both samples of pairs that have no symbol.
    """

    pairs: Whole
    singles: Whole
    escaped: Whole


def count_by_class(seen: list[Seen], weights: Whole, step: int) -> Counts:
    """Count the symbols of samples with weights of what is expected (`Tables.weights`)."""
    counts = Counts(
        np.zeros((N_CLASSES, N_PAIR_SYMBOLS), dtype=np.int64),
        np.zeros((N_CLASSES, N_CLASSES, N_SINGLE_SYMBOLS), dtype=np.int64),
        np.zeros((N_CLASSES, N_SINGLE_SYMBOLS), dtype=np.int64),
    )
    expected, floats = np.zeros(_AT_A_TIME, np.int32), np.zeros(_AT_A_TIME, np.float32)
    classes = np.zeros((2, _AT_A_TIME), dtype=np.int8)
    memory = expected, floats, floats.view(np.int32), classes[0], classes[1]
    for found in seen:
        made = weights_of(weights[found.which], step, found.shift)[found.plane - HH]
        count_samples(found.features, found.details, found.is_coded, made, memory, *counts)
    return counts
