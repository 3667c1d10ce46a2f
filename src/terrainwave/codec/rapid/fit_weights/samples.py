"""Samples of coded windows as a decoder meets them (encoder only).

What is known of each before it is decoded, and its detail. From these follow the weights of
features (`fit_weights`), and what a file costs with any tables of the same stencils, without coding
the windows once more: contexts decide how details are written, not what they are. In whole numbers,
as in the kernels.
"""

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.planes import HH, A, parity
from terrainwave.codec.rapid.file_tables import N_CLASSES, PLANES, Tables
from terrainwave.codec.rapid.fit_stencils import CLASS_DEPTHS
from terrainwave.codec.rapid.layout import (
    BENDS,
    CORES,
    ERRORS,
    F_CONST,
    F_RANGE,
    F_TWIST,
    FEATURE_TAPS,
    MAX_TAPS,
    N_FEATURES,
    TAPS,
    Scale,
)
from terrainwave.codec.rapid.magnitude import (
    DROPPED,
    EXACT,
    EXPECTED_SHIFT,
    FIRST_BIN,
    FIRST_COARSE,
    MOST_ERROR,
    MOST_FAR,
    N_BINS,
    N_CONTEXTS,
    scale_of,
    scaled_features,
)
from terrainwave.codec.rapid.symbols import ESCAPE, N_SYMBOLS, ZERO, low_bits
from terrainwave.codec.refiner import Each, Heights, Mask
from terrainwave.coding.rans import SYMBOL_BITS

Whole = NDArray[np.int64]
Reals = NDArray[np.float64]
Integers: TypeAlias = NDArray[np.signedinteger]

# Rows and columns of planes left out at the sides: all that is looked at lies inside.
_TOP, _BOTTOM, _SIDE = 4, 3, 3
_MOST_SAMPLES = 1 << 12  # of a class and plane, about
# One row of at most so many, which those of planes are worked out for.
_MOST_APART = 16
_PREDICTED = BENDS + 1
_LIMIT32 = (1 << 31) - 64
_LOW_BITS = np.array([low_bits(context) for context in range(N_CONTEXTS)], dtype=np.int64)


class PlaneSamples(NamedTuple):
    """Samples of a class and plane.

    Attributes
    ----------
    features : ndarray of float64, shape (N_FEATURES, n)
        Whole numbers, in the units of the kernels.
    known : ndarray of int64, shape (5, n)
        The prediction in 1/64 quanta, the least, the largest and the sum of the core, and the
        sample itself.
    every : int
        Each stands for so many.
    """

    features: Reals
    known: Whole
    every: int

    @property
    def errors(self) -> Whole:
        """Return how far predictions are from the samples, in 1/64 quanta."""
        return np.abs(64 * self.known[4] - self.known[0])


Seen = dict[tuple[int, int], PlaneSamples]


def look_at(decoded: Heights, masks: Mask, tables: Tables, step: int, each: Each = map) -> Seen:
    """Return samples of each class and plane of windows that have been coded with `tables`.

    Not those near the sides, nor void ones; some of them where there are many.

    Parameters
    ----------
    decoded : ndarray of int32, shape (n, n_rows, n_cols)
        Windows of the full grid.
    masks : ndarray of bool, shape (n, n_rows, n_cols)
    """
    scale = scale_of(step, 0, 0, False)
    # Predictions move with the heights; near 0 they fit into 32 bits.
    middle = (int(decoded.min()) + int(decoded.max())) >> 1
    widest = int(np.abs(tables.stencils).sum(-1).max())
    farthest = max(int(decoded.max()) - middle, middle - int(decoded.min()))
    dtype = np.int32 if farthest * max(widest, 64) < _LIMIT32 else np.int64
    heights = np.subtract(decoded, middle, dtype=dtype)

    def see(which: int) -> Seen:
        found: list[list[Integers]] = [[] for _ in PLANES]
        n_rows = heights.shape[1]
        every = max(-(-heights[:, :: 1 << which, :: 1 << which].size // (4 * _MOST_SAMPLES)), 1)
        if every > _MOST_APART:
            n_rows = -(-n_rows * _MOST_APART // every)
            every = _MOST_APART
        for depth in CLASS_DEPTHS[which]:
            part = np.s_[:, : n_rows : 1 << depth, :: 1 << depth]
            lattice = _of_lattice(heights[part], masks[part], tables.stencils[which], scale, every)
            for index, rows in enumerate(lattice):
                found[index].append(rows)
        seen: Seen = {}
        for index in range(len(PLANES)):
            rows = np.concatenate(found[index], axis=1)
            features, known = rows[:N_FEATURES], rows[N_FEATURES:]
            seen[which, index] = PlaneSamples(
                features.astype(np.float64), known.astype(np.int64), every
            )
        return seen

    return {key: found for seen in each(see, range(N_CLASSES)) for key, found in seen.items()}


def _of_lattice(
    heights: Integers, mask: Mask, stencils: Whole, scale: Scale, every: int
) -> list[Integers]:
    """Return of each plane of a lattice its samples' features, then what is `known` of them.

    Shape (N_FEATURES + 5, n), of one row of so many.
    """
    n_rows, n_cols = (size >> 1 for size in heights.shape[1:])
    if n_rows <= _TOP + _BOTTOM or n_cols <= 2 * _SIDE:
        return [np.zeros((N_FEATURES + 5, 0), dtype=heights.dtype)] * len(PLANES)
    seen = {
        plane: np.ascontiguousarray(heights[:, row::2, col::2][:, :n_rows, :n_cols])
        for plane, (row, col) in ((plane, parity(plane)) for plane in (A, *PLANES))
    }
    cast = heights.dtype.type
    around = slice(2, n_rows - 2), slice(2, n_cols - 2)
    inner = slice(_TOP, n_rows - _BOTTOM, every), slice(_SIDE, n_cols - _SIDE)

    def near(tap: tuple[int, int, int], of: tuple[slice, slice] = around) -> Integers:
        plane, row, col = tap
        rows, cols = of
        return seen[plane][
            :,
            slice(rows.start + row, rows.stop + row, rows.step),
            cols.start + col : cols.stop + col,
        ]

    def padded(values: Integers) -> Integers:
        whole = np.zeros((len(values), n_rows, n_cols), dtype=values.dtype)
        whole[:, *around] = values
        return whole

    def ranged(values: Integers) -> Integers:
        return np.minimum(values >> scale.range_shift, cast(scale.most_range))

    def bend(row: int, col: int) -> Integers:
        far = near((A, -2 * row, -2 * col)) + near((A, 2 * row, 2 * col))
        return abs(far - 4 * (near((A, -row, -col)) + near((A, row, col))) + 6 * near((A, 0, 0)))

    seen[BENDS] = padded(ranged(bend(0, 1) + bend(1, 0)))
    found = []
    for index, plane in enumerate(PLANES):
        predicted = np.full(near((A, 0, 0)).shape, 32, dtype=heights.dtype)
        for weight, tap in zip(stencils[index, :MAX_TAPS].tolist(), TAPS[plane], strict=False):
            if weight:
                predicted += cast(weight) * near(tap)
        predicted >>= 6
        core = [near(tap) for tap in CORES[plane]]
        np.maximum(predicted, np.minimum.reduce(core) << 6, out=predicted)
        np.minimum(predicted, np.maximum.reduce(core) << 6, out=predicted)
        errors = abs((near((plane, 0, 0)) << 6) - predicted) >> scale.error_shift
        seen[plane + ERRORS] = padded(np.minimum(errors, cast(MOST_ERROR)))
        core = [near(tap, inner) for tap in CORES[plane]]
        least, most = np.minimum.reduce(core), np.maximum.reduce(core)
        first, second, third, fourth = core if plane != HH else [core[k] for k in (0, 3, 1, 2)]
        rows = np.zeros((N_FEATURES + 5, *least.shape), dtype=heights.dtype)
        rows[F_CONST] = 1
        rows[F_RANGE] = ranged(most - least)
        rows[F_TWIST] = ranged(abs(first + second - third - fourth))
        for feature, taps in FEATURE_TAPS[plane].items():
            for tap in taps:
                rows[feature] += near(tap, inner)
        seen[_PREDICTED] = padded(predicted)
        known = near((_PREDICTED, 0, 0), inner), least, most, first + second + third + fourth
        for to, values in enumerate((*known, near((plane, 0, 0), inner))):
            rows[N_FEATURES + to] = values
        row, col = parity(plane)
        valid = mask[:, row::2, col::2][:, *inner]
        found.append(rows.reshape(len(rows), -1) if valid.all() else rows[:, valid])
    return found


class Counter:
    """Counts contexts and symbols of samples with any tables of the same stencils."""

    def __init__(self, seen: Seen, step: int) -> None:
        self._keys = list(seen)
        self._features = [seen[key].features for key in self._keys]
        self._step = step
        self._scale = scale_of(step, 0, 0, False)
        predicted, least, most, core, own = np.concatenate(
            [seen[key].known for key in self._keys], axis=1
        )
        self._every = np.repeat(
            [float(seen[key].every) for key in self._keys],
            [seen[key].known.shape[1] for key in self._keys],
        )
        whole = (predicted + 32) >> 6
        # What was clamped to the range of heights may be no whole step away.
        self._detail = (own - whole + (step >> 1)) // step
        self._middle = 16 * core - predicted
        self._fraction = predicted - 64 * whole
        scale = self._scale
        quarter = np.abs(self._fraction) * scale.side_scale >> 16
        self._quarter = np.minimum(quarter, 3)
        reach = np.where(self._middle < 0, 64 * most - predicted, predicted - 64 * least)
        self._far = {True: self._scaled(reach), False: self._scaled(np.abs(self._middle))}
        # By the weights of features, with the kind of contexts: several tables have the same.
        self._expected: dict[bytes, tuple[Whole, Whole]] = {}
        self._counts: dict[tuple[bytes, bool], Whole] = {}

    @property
    def n_samples(self) -> int:
        """Return how many samples there are."""
        return len(self._every)

    @property
    def n_counted(self) -> int:
        """Return how many samples they stand for, all of which `counts` counts."""
        return int(self._every.sum())

    def _scaled(self, far: Whole) -> Whole:
        scale = self._scale
        far = np.minimum(far >> scale.side_shift, MOST_FAR) * scale.far_scale
        return far >> (2 + scale.error_shift - scale.side_shift)

    def counts(self, tables: Tables) -> Whole:
        """Return how often each symbol comes: shape (N_CONTEXTS, N_SYMBOLS)."""
        key = tables.features.tobytes(), tables.is_by_reach
        if key not in self._counts:
            self._counts[key] = self._counted(tables)
        return self._counts[key]

    def _expect(self, features: Whole) -> tuple[Whole, Whole]:
        """Return the expected magnitude of each sample, and its bin."""
        key = features.tobytes()
        if key not in self._expected:
            weights = [scaled_features(own, self._scale) for own in features]
            sums = [
                weights[which][index].astype(np.float64) @ own
                for (which, index), own in zip(self._keys, self._features, strict=True)
            ]
            expected = np.concatenate(sums).astype(np.int64) >> EXPECTED_SHIFT
            exact = np.where(expected >= EXACT, expected & ~DROPPED, expected).astype(np.float32)
            bins = np.clip((exact.view(np.int32) >> 22) - FIRST_BIN, 0, N_BINS - 1)
            self._expected[key] = expected, bins.astype(np.int64)
        return self._expected[key]

    def _counted(self, tables: Tables) -> Whole:
        expected, bins = self._expect(tables.features)
        far = self._far[tables.is_by_reach]
        side = self._middle
        limits = (2, 6, 12) if tables.is_by_reach else (1, 2.75, 6)
        quarter = np.add.reduce([far > limit * expected for limit in limits], dtype=np.int64)
        if self._scale.is_fine:
            is_fine = (4 * bins < FIRST_COARSE) if tables.is_by_reach else np.True_
            fine = np.where(4 * bins < FIRST_COARSE, self._quarter, 0)
            quarter = np.where(is_fine, fine, quarter)
            side = np.where(is_fine, self._fraction, side)
        contexts = 4 * bins + quarter
        upper = np.where(side < 0, -self._detail, self._detail) >> _LOW_BITS[contexts]
        symbols = np.where((upper > -ZERO) & (upper <= ZERO), upper + ZERO, ESCAPE)
        counts = np.bincount(
            contexts << SYMBOL_BITS | symbols, self._every, N_CONTEXTS << SYMBOL_BITS
        )
        by_context = counts.reshape(N_CONTEXTS, -1)[:, :N_SYMBOLS]
        return by_context.astype(np.int64)
