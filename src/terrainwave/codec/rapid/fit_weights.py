"""Fit what details are expected to be, and count their symbols by it (encoder only).

Windows that have been coded tell how large details were, and what was known around them. Weights
decide how details are written, not what they are: a window need not be coded again for each. Sums
are of whole numbers below 2**53, and all else is single operations in a fixed order: the same
raster gives the same weights on every machine.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from terrainwave.codec.rapid.symbols import (
    N_CLASSES,
    PAIR_ESCAPE,
    PAIR_LIMIT,
    SINGLE_ESCAPE,
    SINGLE_LIMIT,
    STEP_CLASS,
)
from terrainwave.codec.rapid.tables import WEIGHT_UNIT_BITS, Tables, weights_of
from terrainwave.codec.rapid.unit import UnitCoder

Whole = NDArray[np.int64]
Reals = NDArray[np.float64]

# Of the bits of a float32, those that tell a class.
_TO_CLASS, _CLASS_ZERO = 22, 2 * 127
_RAW_BITS = np.maximum(np.arange(N_CLASSES) - (STEP_CLASS + 4), 0) >> 1
# Samples of a class and plane that weights are fitted to, and how many are too few.
_MOST_SAMPLES, _MIN_SAMPLES = 1 << 13, 128
# Scaled to whole numbers of so many bits, products of this many samples have sums below 2**53.
_SCALED_BITS = 18
_N_TURNS, _N_SWEEPS = 3, 60
# Samples count by the inverse square of what was expected of them, in steps, and this.
_LEAST_EXPECTED = 0.2
_RIDGE = 1e-7


class Seen(NamedTuple):
    """Samples of a class and plane of coded windows, two of a pair side by side.

    Attributes
    ----------
    features : ndarray of int32, shape (3, n)
        Range, bend, and what is near; the first two of heights shifted by `shift`.
    details : ndarray of int32, shape (n,)
    is_coded : ndarray of bool, shape (n,)
    """

    features: NDArray[np.int32]
    details: NDArray[np.int32]
    is_coded: NDArray[np.bool_]


# By class, plane and shift of heights.
Samples = dict[tuple[int, int, int], list[Seen]]


class Observer(UnitCoder):
    """A coder that keeps the samples of the units that it encodes; one thread has one."""

    def __init__(self, tables: Tables) -> None:
        super().__init__(tables)
        self.samples: Samples = {}

    def _see(self, which: int, lattice: Lattice, work: Workspace, valid: NDArray[np.uint8]) -> None:
        for plane in PLANES:
            n_rows, n_cols = plane_shape(plane, (lattice.n_rows, lattice.n_cols))
            if n_rows == 0 or n_cols == 0:
                continue
            seen = np.zeros((5, n_rows, n_cols + (n_cols & 1)), dtype=np.int32)
            seen[:3, :, :n_cols] = _features(plane, work, n_rows, n_cols)
            seen[3] = work.details[plane - HH, : seen[3].size].reshape(seen[3].shape)
            seen[4, :, :n_cols] = 1
            if lattice.has_void:
                seen[4, :, :n_cols] = valid[int(plane != HL) :: 2, int(plane != LH) :: 2]
            # An odd end is a pair with a sample like it, which is not coded.
            seen[:3, :, n_cols:] = seen[:3, :, n_cols - 1 : n_cols][:, :, : n_cols & 1]
            self.keep(which, plane, lattice.shift, seen)

    def keep(self, which: int, plane: int, shift: int, seen: NDArray[np.int32]) -> None:
        """Keep what is known of the samples of a plane."""
        flat = seen.reshape(5, -1)
        found = Seen(flat[:3], flat[3], flat[4].astype(np.bool_))
        self.samples.setdefault((which, plane, shift), []).append(found)


def _features(plane: int, work: Workspace, n_rows: int, n_cols: int) -> NDArray[np.int32]:
    """Return range, bend and what is near of the samples of a plane, as `details` adds them up."""

    def at(source: NDArray[np.int16], row: int, col: int) -> NDArray[np.int32]:
        return source[1 + row :, 1 + col :][:n_rows, :n_cols].astype(np.int32)

    ranges, bends, near = work.ranges, work.bends, work.near
    own = at(ranges, 0, 0)
    if plane == HH:
        bend = at(bends, 0, 0) + at(bends, 0, 1) + at(bends, 1, 0) + at(bends, 1, 1)
        return np.stack([own, bend, np.zeros_like(own)])
    if plane == HL:
        bend = at(bends, 0, 0) + at(bends, 0, 1)
        return np.stack([own + at(ranges, -1, 0), bend, at(near[0], -1, 0) + at(near[0], 0, 0)])
    bend = at(bends, 0, 0) + at(bends, 1, 0)
    around = at(near[0], 0, -1) + at(near[0], 0, 0) + at(near[1], 0, -1) + at(near[1], 0, 0)
    around += at(near[1], 1, -1) + at(near[1], 1, 0)
    return np.stack([own + at(ranges, 0, -1), bend, around])


def gathered(found: list[Samples]) -> dict[tuple[int, int, int], Seen]:
    """Return the samples of several observers together."""
    keys = sorted({key for samples in found for key in samples})
    together = {}
    for key in keys:
        parts = [part for samples in found for part in samples.get(key, [])]
        together[key] = Seen(
            np.concatenate([part.features for part in parts], axis=1),
            np.concatenate([part.details for part in parts]),
            np.concatenate([part.is_coded for part in parts]),
        )
    return together


# Weights ----------------------------------------------------------------------------------------


def fit_magnitude(
    seen: dict[tuple[int, int, int], Seen], trained: Whole, step: int
) -> NDArray[np.int64]:
    """Return codes of the weights that tell best how large details are, shape (4, 3, 4).

    Where there are too few samples, they are those of the finer class, or the trained ones.
    """
    parts: dict[tuple[int, int], list[Reals]] = {}
    for (which, plane, shift), found in seen.items():
        every = -(-len(found.details) // _MOST_SAMPLES)
        parts.setdefault((which, plane - HH), []).append(_in_steps(found, every, shift, step))
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


def _in_steps(seen: Seen, every: int, shift: int, step: int) -> Reals:
    """Return of one sample of so many 1, the features, and the size of its detail, in steps."""
    coded = np.flatnonzero(seen.is_coded)[::every]
    rows = np.ones((N_FEATURES + 1, len(coded)))
    rows[1:3] = seen.features[:2, coded] * (2.0**shift / step)
    rows[3] = seen.features[2, coded]
    rows[4] = np.abs(seen.details[coded])
    return rows


def _fitted(samples: list[Reals], weights: Reals) -> Reals:
    """Return weights, none negative, by which features expect the sizes in the last row of samples.

    Details whose sizes are as if by chance around what is expected: the likeliest weights are those
    of least squares in which samples count by the inverse square of what these weights expect.
    """
    for _ in range(_N_TURNS):
        found = [_products(rows, own) for rows, own in zip(samples, weights, strict=True)]
        products = np.array(found).reshape(-1, N_FEATURES + 1, N_FEATURES + 1)
        weights = _not_negative(products, weights)
    return weights


def _products(rows: Reals, weights: Reals) -> Reals:
    """Return the normal equations of a turn; the last row and column are of the sizes."""
    expected = np.full(rows.shape[1], _LEAST_EXPECTED)
    for weight, row in zip(weights.tolist(), rows, strict=False):
        expected += weight * row
    whole = rows / expected
    most = whole.max(1)
    units = np.ldexp(1.0, _SCALED_BITS - np.frexp(np.where(most > 0, most, 1.0))[1])
    whole *= units[:, None]
    np.rint(whole, out=whole)
    products: Reals = whole @ whole.T / units[:, None] / units
    return products


def _not_negative(products: Reals, weights: Reals) -> Reals:
    """Return the solutions of normal equations without negative numbers, one number at a time."""
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
            found[:, k] = np.maximum(rest / scale[:, k], 0.0)
    return found


# Symbols ----------------------------------------------------------------------------------------


class Counts(NamedTuple):
    """How often symbols come, by class of pairs.

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


def count_by_class(seen: dict[tuple[int, int, int], Seen], weights: Whole, step: int) -> Counts:
    """Count the symbols of samples with weights of what is expected (`Tables.weights`)."""
    n_pairs, n_singles = N_CLASSES * N_PAIR_SYMBOLS, N_CLASSES * N_SINGLE_SYMBOLS
    pairs, escaped = np.zeros(n_pairs, dtype=np.int64), np.zeros(n_singles, dtype=np.int64)
    singles = np.zeros(N_CLASSES * n_singles, dtype=np.int64)
    for (which, plane, shift), found in seen.items():
        v0, v1, v2, v3, more = weights_of(weights[which], step, shift)[plane - HH]
        ranges, bends, near = found.features
        expected = ((v1 * ranges + v2 * bends) >> more) + v3 * near + v0
        halves = expected >> 1
        by_pair = _classes_of(halves[::2] + halves[1::2])
        by_single = _classes_of(expected)
        details, coded = found.details, found.is_coded
        first, second = details[::2], details[1::2]
        has_none = np.maximum(np.abs(first), np.abs(second)) > PAIR_LIMIT
        symbols = (2 * PAIR_LIMIT + 1) * (first + PAIR_LIMIT) + second + PAIR_LIMIT
        symbols[has_none] = PAIR_ESCAPE
        either = coded[::2] | coded[1::2]
        own = N_PAIR_SYMBOLS * by_pair[either] + symbols[either]
        pairs += np.bincount(own, minlength=n_pairs)
        both = np.repeat(has_none & either, 2)
        by_both = np.repeat(by_pair, 2)
        own = N_SINGLE_SYMBOLS * by_both[both] + _single_symbols(details[both])
        escaped += np.bincount(own, minlength=n_singles)
        own = _single_symbols(details >> _RAW_BITS[by_single])
        own += N_SINGLE_SYMBOLS * (N_CLASSES * by_both + by_single)
        singles += np.bincount(own[coded], minlength=len(singles))
    return Counts(
        pairs.reshape(N_CLASSES, -1),
        singles.reshape(N_CLASSES, N_CLASSES, -1),
        escaped.reshape(N_CLASSES, -1),
    )


def _classes_of(expected: NDArray[np.int32]) -> Whole:
    """Return the classes of expected magnitudes, as `details` finds them."""
    value = np.maximum(expected, 1)
    bits = (value & ~(value >> 2)).astype(np.float32).view(np.int32)
    return np.minimum((bits >> _TO_CLASS) - _CLASS_ZERO, N_CLASSES - 1).astype(np.int64)


def _single_symbols(values: NDArray[Any]) -> Whole:
    is_known = np.abs(values) <= SINGLE_LIMIT
    symbols: Whole = np.where(is_known, values + SINGLE_LIMIT, SINGLE_ESCAPE).astype(np.int64)
    return symbols
