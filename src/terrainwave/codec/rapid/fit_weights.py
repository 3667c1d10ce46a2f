"""Fit the weights of the expected magnitude to a file of method `rapid` (encoder only).

Windows that have been coded tell how large details were, and what was known around them. Sums are
of whole numbers below 2**53, held in float64, and all else is single operations in a fixed order:
the same raster gives the same weights on every machine.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.planes import HH, A, parity
from terrainwave.codec.rapid.file_tables import (
    CODE_OF_FREQ,
    FREQ_OF_CODE,
    MAX_CODE,
    N_CLASSES,
    PLANES,
    USUAL_WEIGHTS,
    WEIGHT_SHIFTS,
    Tables,
    are_sound,
)
from terrainwave.codec.rapid.fit_stencils import CLASS_DEPTHS
from terrainwave.codec.rapid.layout import (
    BENDS,
    CORES,
    ERRORS,
    F_BEND,
    F_CONST,
    F_RANGE,
    F_TWIST,
    FEATURE_TAPS,
    MAX_TAPS,
    N_FEATURES,
    TAPS,
    Scale,
)
from terrainwave.codec.rapid.magnitude import MOST_ERROR, scale_of
from terrainwave.codec.refiner import Heights, Mask

Reals = NDArray[np.float64]

# Rows and columns of planes left out at the sides: all that is looked at lies inside.
_TOP, _BOTTOM, _SIDE = 4, 3, 3
# Of more than so many windows, the finest class takes so many rows and columns.
_FEW, _FINEST = 4, 129
_MOST_SAMPLES = 1 << 13
_AT_A_TIME = 128  # products of so many samples are small enough for BLAS to use one thread
_MIN_SAMPLES = _AT_A_TIME
# Scaled to whole numbers of so many bits, products of this many samples have sums below 2**53.
_SCALED_BITS = 18
# Samples count by the inverse square of what was expected of them, in steps, and this.
_LEAST_EXPECTED = 0.15
_TURNS = 3
_RIDGE = 1e-9
_MOST_CHANGES, _LEAST_SLOPE = 30, 1e-5
_OF_ONE = 1 << 24
_IN_FRACTIONS = 64  # errors are in 1/64 quanta


def fit_magnitude(
    decoded: Heights, masks: Mask, tables: Tables, step: int
) -> NDArray[np.int64] | None:
    """Return codes of the weights that tell best how large details are, None if there are none.

    Shape (N_CLASSES, 3, N_FEATURES). Where there are too few samples, they are those of the finer
    class, so that they cost little.

    Parameters
    ----------
    decoded : ndarray of int32, shape (n, n_rows, n_cols)
        Windows of the full grid, coded with `tables`.
    masks : ndarray of bool, shape (n, n_rows, n_cols)
    """
    scale = scale_of(step, 0, 0, False)
    codes = np.empty((N_CLASSES, len(PLANES), N_FEATURES), dtype=np.int64)
    for which in range(N_CLASSES):
        found: list[list[Reals]] = [[] for _ in PLANES]
        for depth in CLASS_DEPTHS[which]:
            stop = _FINEST if depth == 0 and len(decoded) > _FEW else None
            part = np.s_[:, : stop : 1 << depth, : stop : 1 << depth]
            for index, rows in enumerate(
                _samples(decoded[part], masks[part], tables.stencils[which], scale)
            ):
                found[index].append(rows)
        for index in range(len(PLANES)):
            rows = np.concatenate(found[index], axis=1)
            n = rows.shape[1]
            every = max(-(-n // _MOST_SAMPLES), 1)
            usual = codes[which - 1, index] if which else USUAL_WEIGHTS[index]
            codes[which, index] = usual
            if n >= _MIN_SAMPLES * every:
                first = tables.features[which, index] / _OF_ONE
                codes[which, index] = _codes_of(_fitted(rows[:, ::every], first))
    return codes if are_sound(codes) else None


def _samples(
    heights: Heights, mask: Mask, stencils: NDArray[np.int64], scale: Scale
) -> list[Reals]:
    """Return of each plane of a lattice its samples' features, then their errors in steps.

    Shape (N_FEATURES + 1, n); without those of void samples.
    """
    n_rows, n_cols = (size >> 1 for size in heights.shape[1:])
    if n_rows <= _TOP + _BOTTOM or n_cols <= 2 * _SIDE:
        return [np.zeros((N_FEATURES + 1, 0))] * len(PLANES)
    seen: dict[int, NDArray[np.int64]] = {
        plane: heights[:, row::2, col::2][:, :n_rows, :n_cols].astype(np.int64)
        for plane, (row, col) in ((plane, parity(plane)) for plane in (A, *PLANES))
    }

    def near(plane: int, row: int, col: int) -> NDArray[np.int64]:
        rows = slice(2 + row, n_rows - 2 + row)
        return seen[plane][:, rows, 2 + col : n_cols - 2 + col]

    def padded(inner: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.pad(inner, ((0, 0), (2, 2), (2, 2)))

    def ranged(values: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.minimum(values >> scale.range_shift, scale.most_range)

    def bend(row: int, col: int) -> NDArray[np.int64]:
        far = near(A, -2 * row, -2 * col) + near(A, 2 * row, 2 * col)
        return abs(far - 4 * (near(A, -row, -col) + near(A, row, col)) + 6 * near(A, 0, 0))

    seen[BENDS] = padded(ranged(bend(0, 1) + bend(1, 0)))
    of_range, of_error = (
        2.0**shift / scale.step for shift in (scale.range_shift, scale.error_shift)
    )
    inner = np.s_[:, _TOP - 2 : n_rows - 2 - _BOTTOM, _SIDE - 2 : n_cols - 2 - _SIDE]
    found = []
    for index, plane in enumerate(PLANES):
        predicted = np.full(near(plane, 0, 0).shape, 32, dtype=np.int64)
        for weight, tap in zip(stencils[index, :MAX_TAPS].tolist(), TAPS[plane], strict=False):
            predicted += weight * near(*tap)
        core = [near(*tap) for tap in CORES[plane]]
        least, most = np.minimum.reduce(core), np.maximum.reduce(core)
        predicted = np.clip(predicted >> 6, 64 * least, 64 * most)
        errors = abs(64 * near(plane, 0, 0) - predicted) >> scale.error_shift
        seen[plane + ERRORS] = padded(np.minimum(errors, MOST_ERROR))
        first, second, third, fourth = core if plane != HH else [core[k] for k in (0, 3, 1, 2)]
        twist = abs(first + second - third - fourth)
        row, col = parity(plane)
        valid = mask[:, row::2, col::2][:, :n_rows, :n_cols]
        kept = valid[:, 2 : n_rows - 2, 2 : n_cols - 2][inner]
        rows = np.zeros((N_FEATURES + 1, int(np.count_nonzero(kept))))
        rows[F_CONST] = 1
        rows[F_RANGE] = ranged(most - least)[inner][kept] * of_range
        rows[F_TWIST] = ranged(twist)[inner][kept] * of_range
        for feature, taps in FEATURE_TAPS[plane].items():
            total = np.add.reduce([near(*tap) for tap in taps])
            rows[feature] = total[inner][kept] * (of_range if feature == F_BEND else of_error)
        rows[N_FEATURES] = near(plane + ERRORS, 0, 0)[inner][kept] * (of_error / _IN_FRACTIONS)
        found.append(rows)
    return found


def _fitted(rows: Reals, first: Reals) -> list[float]:
    """Return weights of features, none negative, by which they expect the errors.

    Reweighted least squares, from the weights `first` on.
    """
    weights = first.tolist()
    rows = rows[:, : rows.shape[1] // _AT_A_TIME * _AT_A_TIME]
    for _ in range(_TURNS):
        expected = np.full(rows.shape[1], _LEAST_EXPECTED)
        for weight, feature in zip(weights, rows, strict=False):
            expected += weight * feature
        whole = rows / expected
        units = np.ldexp(1.0, _SCALED_BITS - np.frexp(whole.max(1))[1])
        whole = np.rint(whole * units[:, None])
        parts = whole.reshape(len(rows), -1, _AT_A_TIME).transpose(1, 0, 2)
        products = np.matmul(parts, parts.transpose(0, 2, 1)).sum(0)
        solution = _not_negative(products)
        weights = (np.array(solution) * units[:N_FEATURES] / units[N_FEATURES]).tolist()
    return weights


def _not_negative(products: Reals) -> list[float]:
    """Return the solution of normal equations without negative numbers.

    `products` are those of the features and of what they are to expect, in this order. By Lawson
    and Hanson: numbers are let in one by one, the one that helps most first, and leave where
    others take them below 0.
    """
    systems, wanted = products[:N_FEATURES, :N_FEATURES], products[N_FEATURES, :N_FEATURES]
    solution, used = np.zeros(N_FEATURES), np.zeros(N_FEATURES, dtype=np.bool_)
    sizes = np.sqrt(np.diag(systems))
    sizes[sizes == 0] = np.inf
    least = _LEAST_SLOPE * np.sqrt(products[N_FEATURES, N_FEATURES])
    for _ in range(_MOST_CHANGES):
        slopes = (wanted - np.cumsum(systems * solution, axis=1)[:, -1]) / sizes
        slopes[used] = 0
        best = int(slopes.argmax())
        if slopes[best] <= least:
            break
        used[best] = True
        while used.any():
            places = np.flatnonzero(used)
            found = np.zeros(N_FEATURES)
            found[places] = _solved(
                systems[np.ix_(places, places)].tolist(), wanted[places].tolist()
            )
            below = places[found[places] <= 0]
            if not len(below):
                solution = found
                break
            shares = solution[below] / (solution[below] - found[below])
            solution = solution + shares.min() * (found - solution)
            used[below[int(shares.argmin())]] = False
            solution[~used] = 0
    weights: list[float] = solution.tolist()
    return weights


def _solved(rows: list[list[float]], wanted: list[float]) -> list[float]:
    """Return the solution of positive definite equations, by elimination."""
    n = len(wanted)
    for k in range(n):
        rows[k][k] += rows[k][k] * _RIDGE
    for k in range(n):
        for below in range(k + 1, n):
            factor = rows[below][k] / rows[k][k]
            for j in range(k, n):
                rows[below][j] -= factor * rows[k][j]
            wanted[below] -= factor * wanted[k]
    for k in reversed(range(n)):
        for j in range(k + 1, n):
            wanted[k] -= rows[k][j] * wanted[j]
        wanted[k] /= rows[k][k]
    return wanted


def _codes_of(weights: list[float]) -> NDArray[np.int64]:
    """Return the codes nearest to weights."""
    whole = np.rint(np.array(weights) * _OF_ONE / (1 << WEIGHT_SHIFTS))
    return CODE_OF_FREQ[np.minimum(whole, FREQ_OF_CODE[MAX_CODE]).astype(np.int64)]


def weights_bits(codes: NDArray[np.int64] | None) -> float:
    """Return about how many bits codes of weights take in a file."""
    if codes is None:
        return 0.0
    changes = np.diff(codes, axis=0, prepend=USUAL_WEIGHTS[None])
    return float((1 + np.frexp(np.abs(changes).astype(np.float64))[1] * 2).sum())
