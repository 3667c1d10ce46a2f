"""Fit the weights of the expected magnitude to a file of method `rapid` (encoder only).

Windows that have been coded tell how large details were, and what was known around them. Sums are
of whole numbers below 2**53, held in float64, and all else is single operations in a fixed order:
the same raster gives the same weights on every machine.
"""

import numpy as np
from numpy.typing import NDArray

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
from terrainwave.codec.rapid.fit_weights.samples import PlaneSamples, Seen
from terrainwave.codec.rapid.layout import F_CONST, N_FEATURES, Scale
from terrainwave.codec.rapid.magnitude import MOST_ERROR, OF_RANGES, scale_of

Reals = NDArray[np.float64]

_AT_A_TIME = 128  # products of so many samples are small enough for BLAS to use one thread
_MIN_SAMPLES = _AT_A_TIME
# Scaled to whole numbers of so many bits, products of this many samples have sums below 2**53.
_SCALED_BITS = 18
# Samples count by the inverse square of what was expected of them, in steps, and this.
_LEAST_EXPECTED = 0.15
# One sample of so many in each turn: early turns only find how much the samples count.
_EVERY_OF_TURN = (4, 1)
_RIDGE = 1e-9
_MOST_CHANGES, _LEAST_SLOPE = 30, 1e-5
_OF_ONE = 1 << 24
_IN_FRACTIONS = 64  # errors are in 1/64 quanta


def fit_magnitude(seen: Seen, tables: Tables, step: int) -> NDArray[np.int64] | None:
    """Return codes of the weights that tell best how large details are, None if there are none.

    Shape (N_CLASSES, 3, N_FEATURES). Where there are too few samples, they are those of the finer
    class, so that they cost little.

    Parameters
    ----------
    seen
        Samples of windows that were coded with `tables`.
    """
    scale = scale_of(step, 0, 0, False)
    keys = [key for key, found in seen.items() if found.features.shape[1] >= _MIN_SAMPLES]
    rows = [_in_steps(seen[key], scale) for key in keys]
    first = np.array([tables.features[key] for key in keys]).reshape(-1, N_FEATURES) / _OF_ONE
    fitted = dict(zip(keys, _fitted(rows, first), strict=True))
    codes = np.empty((N_CLASSES, len(PLANES), N_FEATURES), dtype=np.int64)
    for which in range(N_CLASSES):
        for index in range(len(PLANES)):
            codes[which, index] = codes[which - 1, index] if which else USUAL_WEIGHTS[index]
            if (which, index) in fitted:
                codes[which, index] = _codes_of(fitted[which, index])
    return codes if are_sound(codes) else None


def _in_steps(samples: PlaneSamples, scale: Scale) -> Reals:
    """Return the features of samples, then their errors, in steps: shape (N_FEATURES + 1, n)."""
    units = np.full(N_FEATURES + 1, 2.0**scale.error_shift / scale.step)
    units[list(OF_RANGES)] = 2.0**scale.range_shift / scale.step
    units[F_CONST] = 1.0
    units[N_FEATURES] /= _IN_FRACTIONS
    errors = np.minimum(samples.errors >> scale.error_shift, MOST_ERROR)
    rows: Reals = np.vstack([samples.features, errors]) * units[:, None]
    return rows


def _fitted(rows: list[Reals], first: Reals) -> Reals:
    """Return weights of features, none negative, by which they expect the errors.

    Reweighted least squares of each array of `rows`, from the weights `first` on.
    """
    weights = first
    parts = [own[:, : own.shape[1] // _AT_A_TIME * _AT_A_TIME] for own in rows]
    for every in _EVERY_OF_TURN:
        found = [_products(own, every, near) for own, near in zip(parts, weights, strict=True)]
        products = np.array([own for own, _ in found]).reshape(-1, N_FEATURES + 1, N_FEATURES + 1)
        units = np.array([own for _, own in found]).reshape(-1, N_FEATURES + 1)
        weights = _not_negative(products) * units[:, :N_FEATURES] / units[:, N_FEATURES:]
    return weights


def _products(rows: Reals, every: int, weights: Reals) -> tuple[Reals, Reals]:
    """Return the normal equations of a turn, and what their rows were scaled by."""
    n = rows.shape[1] // _AT_A_TIME
    rows = rows[:, :: min(every, n)]
    rows = rows[:, : rows.shape[1] // _AT_A_TIME * _AT_A_TIME]
    expected = np.full(rows.shape[1], _LEAST_EXPECTED)
    for weight, feature in zip(weights.tolist(), rows, strict=False):
        if weight:
            expected += weight * feature
    whole = rows / expected
    units = np.ldexp(1.0, _SCALED_BITS - np.frexp(whole.max(1))[1])
    whole *= units[:, None]
    np.rint(whole, out=whole)
    parts = whole.reshape(len(rows), -1, _AT_A_TIME).transpose(1, 0, 2)
    products: Reals = np.matmul(parts, parts.transpose(0, 2, 1)).sum(0)
    return products, units


def _not_negative(products: Reals) -> Reals:
    """Return the solutions of normal equations without negative numbers: shape (n, N_FEATURES).

    `products`, shape (n, N_FEATURES + 1, N_FEATURES + 1), are those of the features and of what
    they are to expect, in this order. From all numbers on, those below 0 leave, and the one that
    helps most comes back, until none does.
    """
    systems, wanted = products[:, :N_FEATURES, :N_FEATURES], products[:, :N_FEATURES, N_FEATURES]
    diagonal = np.arange(N_FEATURES)
    sizes = np.sqrt(systems[:, diagonal, diagonal])
    used = sizes > 0
    sizes[~used] = np.inf
    least = _LEAST_SLOPE * np.sqrt(products[:, N_FEATURES, N_FEATURES])
    every = np.arange(len(products))
    for _ in range(_MOST_CHANGES):
        solution = _solved(systems, wanted, used)
        is_below = used & (solution <= 0)
        used &= ~is_below
        slopes = wanted - np.cumsum(systems * solution[:, None], axis=2)[:, :, -1]
        slopes = np.where(used, 0, slopes / sizes)
        best = slopes.argmax(1)
        helps = ~is_below.any(1) & (slopes[every, best] > least)
        used[every[helps], best[helps]] = True
        if not (is_below.any() or helps.any()):
            return solution
    # Which numbers are above 0 goes round in circles.
    while (is_below := used & (solution <= 0)).any():
        used &= ~is_below
        solution = _solved(systems, wanted, used)
    return solution


def _solved(systems: Reals, wanted: Reals, used: NDArray[np.bool_]) -> Reals:
    """Return the solutions of positive definite equations, 0 where a number is not `used`.

    By elimination without a sum: each operation rounds alike on every machine.
    """
    both = used[:, :, None] & used[:, None]
    rows = np.concatenate([np.where(both, systems, 0.0), wanted[:, :, None] * used[:, :, None]], 2)
    diagonal = np.arange(N_FEATURES)
    rows[:, diagonal, diagonal] = np.where(used, rows[:, diagonal, diagonal] * (1 + _RIDGE), 1.0)
    for k in range(N_FEATURES):
        row = rows[:, k, k:] / rows[:, k, k : k + 1]
        rows[:, :, k:] -= rows[:, :, k : k + 1] * row[:, None]
        rows[:, k, k:] = row
    solution: Reals = rows[:, :, N_FEATURES].copy()
    return solution


def _codes_of(weights: Reals) -> NDArray[np.int64]:
    """Return the codes nearest to weights."""
    whole = np.rint(weights * _OF_ONE / (1 << WEIGHT_SHIFTS))
    return CODE_OF_FREQ[np.minimum(whole, FREQ_OF_CODE[MAX_CODE]).astype(np.int64)]


def weights_bits(codes: NDArray[np.int64] | None) -> float:
    """Return about how many bits codes of weights take in a file."""
    if codes is None:
        return 0.0
    changes = np.diff(codes, axis=0, prepend=USUAL_WEIGHTS[None])
    return float((1 + np.frexp(np.abs(changes).astype(np.float64))[1] * 2).sum())
