"""Choose and fit the stencils of a file (encoder only).

Open loop: samples of the raster itself stand for decoded ones, with noise as quantising adds it.
All sums are of whole numbers up to 2**53, held in float64: they are exact in whatever order a
machine adds them, and single operations round alike everywhere. So the same raster gives the same
stencils on every machine, at the speed of its matrix products.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.planes import WHOLE, FileStencil, parity
from terrainwave.codec.rapid.file_tables import (
    MOST_TAPS,
    PLANES,
    annex,
    core_taps,
    missing_tap,
)
from terrainwave.codec.rapid.layout import HH, MAX_SUM, N_LEVEL_CLASSES, TAPS
from terrainwave.codec.refiner import Each, Heights, Mask
from terrainwave.coding.native_library import also_in_c

Reals = NDArray[np.float64]
Stencils = tuple[tuple[FileStencil, ...], ...]

# Levels below the full grid of each class, and how many samples are taken of a plane there.
CLASS_DEPTHS = ((0,), (1,), (2,), (3, 4))
_WANTED = (8192, 4096, 2048, 1536)
# Products of so many samples at a time are small enough for BLAS to use one thread.
_AT_A_TIME = 128
_JUDGED = 2048  # samples that stencils are compared by
_MIN_SAMPLES = 256
_MARGIN = 4  # no tap is further away, in samples of the lattice
# Samples are whole numbers of 1/64 step, at most 2**17; scaled by their influence at most 2**20.
FINE = 64
MOST, MOST_SCALED_BITS = 1 << 17, 20
_INFLUENCE = 1 << 20
# Products of so many samples have a sum below 2**53, those of twice as many are two of these.
_EXACT = 8192
# One sample of so many in each turn of a fit: early turns only find the weights of the samples.
_EVERY_OF_TURN = (4, 2, 1)
# Of the noise of decoded samples that an open loop estimates, what is tried.
_TIMES_NOISE = (0.3, 1.0, 3.0)
# The last weight follows from the others, rounded.
_MAX_WANTED, _MOST_IN_ALL, _FAR = 28000, MAX_SUM - (1 << 13), 1e6
# Deltas of a file are whole numbers of 2**shift.
_SHIFTS = (0, 2, 3, 4, 5)
# Costs are in 1/64 bit.
COST_UNIT = 64
_BITS_OF_ONE = 127 << 23  # of float32
_IN_C = also_in_c("terrainwave.codec.rapid.tables_in_c")
MOST_SQUARED = 16777216.0
# A stencil must save so many times its own bits.
_WORTH = 1.5


class FitSamples(NamedTuple):
    """Taps less the core's mean, then what they are to predict: shape (n, MOST_TAPS + 1).

    In whole 1/64 steps. Each stands for `every` samples of the windows.
    """

    values: Reals
    every: float

    @property
    def goals(self) -> Reals:
        """Return what taps are to predict."""
        return self.values[:, MOST_TAPS]


def candidates(
    windows: Heights, masks: Mask, step: int, share: float, each: Each = map
) -> list[Stencils]:
    """Return stencils to try, for each class and plane: trained ones, then fitted ones.

    Parameters
    ----------
    windows : ndarray of int32, shape (n, n_rows, n_cols)
    masks : ndarray of bool, shape (n, n_rows, n_cols)
        Validity.
    share : float
        How many samples of the raster one of the windows stands for.
    """
    keys = [(which, plane) for which in range(N_LEVEL_CLASSES) for plane in PLANES]
    gathered = each(lambda key: gather(key[1], windows, masks, key[0], step), keys)
    samples = {key: found for key, found in zip(keys, gathered, strict=True) if found is not None}
    some = {key: judged(found) for key, found in samples.items()}
    best = {key: _best(key[1], found) for key, found in some.items()}
    noise = _noise(some, best) if step > 1 else 0.0
    tried = [_stencils({key: FileStencil(base) for key, base in best.items()})]
    noises = [times * noise for times in _TIMES_NOISE] if step > 1 else [0.0]
    fitted = fit_weights(samples, noises, each)

    def cheapest_of(key: tuple[int, int]) -> list[FileStencil]:
        weights = [found.get(key) for found in fitted]
        return _cheapest(key[1], some[key], best[key], weights, noises, share)

    cheapest = dict(zip(some, each(cheapest_of, some), strict=True))
    for index in range(len(noises)):
        tried.append(_stencils({key: found[index] for key, found in cheapest.items()}))
    return tried


def _stencils(chosen: dict[tuple[int, int], FileStencil]) -> Stencils:
    """Return stencils by class and plane; the first trained one where none was chosen."""
    return tuple(
        tuple(chosen.get((which, plane), FileStencil(0)) for plane in PLANES)
        for which in range(N_LEVEL_CLASSES)
    )


def gather(plane: int, windows: Heights, masks: Mask, which: int, step: int) -> FitSamples | None:
    """Collect samples of a plane and class from windows; None if there are too few."""
    offsets = _offsets(plane)
    in_flat = np.append(offsets[:, 0] * windows.shape[2] + offsets[:, 1], 0)
    core = np.flatnonzero(core_taps(plane))
    flat, valid = windows.ravel(), None if masks.all() else masks.ravel()
    at = [_places(plane, windows.shape, depth, _WANTED[which]) for depth in CLASS_DEPTHS[which]]
    values = np.empty((sum(len(places) for places, _ in at), MOST_TAPS + 1))
    n_found = 0
    for depth, (places, _) in zip(CLASS_DEPTHS[which], at, strict=True):
        more = gather_at(places, in_flat << depth, core, flat, valid, step, values[n_found:])
        n_found += more
    if n_found < _MIN_SAMPLES:
        return None
    n_found -= n_found % _AT_A_TIME
    return FitSamples(values[:n_found], sum(n for _, n in at) / n_found)


@_IN_C
def gather_at(
    places: NDArray[np.int64], offsets: NDArray[np.int64], core: NDArray[np.int64],
    flat: Heights, valid: Mask | None, step: int, values: Reals,
) -> int:  # fmt: skip
    """Collect the samples at places, with their taps, where all are valid; return their number.

    Parameters
    ----------
    places : ndarray of int64, shape (n,)
        In flat windows.
    offsets : ndarray of int64, shape (n_taps + 1,)
        Of taps from the place, and 0.
    core : ndarray of int64, shape (4,)
        Taps of the core.
    flat, valid : ndarray of int32 and of bool, shape (n_samples,)
    values : ndarray of float64, shape (n or more, MOST_TAPS + 1)
        `FitSamples.values`, written.
    """
    near = places[:, None] + offsets
    if valid is not None:
        near = near[valid.take(near).all(1)]
    heights, found, n_taps = flat.take(near), values[: len(near)], len(offsets) - 1
    found[:, :n_taps], found[:, n_taps:] = heights[:, :n_taps], heights[:, n_taps:]
    first, second, third, fourth = found[:, core].T
    # Quarters of quanta, so that no sum is rounded.
    found -= (0.25 * (first + second + third + fourth))[:, None]
    found *= FINE / step
    found[:, n_taps:MOST_TAPS] = 0
    np.rint(found, out=found)
    np.clip(found, -MOST, MOST, out=found)
    return len(near)


def judged(samples: FitSamples) -> FitSamples:
    """Return some of the samples: enough to compare stencils by."""
    every = max(1, len(samples.goals) // _JUDGED)
    n = len(samples.goals) // (every * _AT_A_TIME) * _AT_A_TIME * every
    return FitSamples(
        np.ascontiguousarray(samples.values[:n:every]),
        samples.every * len(samples.goals) * every / n,
    )


def _places(
    plane: int, shape: tuple[int, ...], depth: int, n_wanted: int
) -> tuple[NDArray[np.int64], int]:
    """Return the places in flat windows of some of a plane's samples, and how many it has.

    Only of those with all taps inside. `depth` levels below the full grid.
    """
    n, n_rows, n_cols = shape[0], *(-(-size >> depth) for size in shape[1:])
    row, col = parity(plane)
    rows = len(range(_MARGIN + row, n_rows - _MARGIN, 2))
    cols = len(range(_MARGIN + col, n_cols - _MARGIN, 2))
    n_places = n * rows * cols
    every = max(1, n_places // n_wanted)
    # One of each `every` places, not always in the same column.
    picks = np.arange(n_places // every, dtype=np.int64)
    picks = picks * every + (picks * 40503 >> 4) % every
    by_row, at_col = np.divmod(picks, max(cols, 1))
    window, at_row = np.divmod(by_row, max(rows, 1))
    at_row, at_col = 2 * at_row + _MARGIN + row, 2 * at_col + _MARGIN + col
    return (window * shape[1] + (at_row << depth)) * shape[2] + (at_col << depth), n_places


@cache
def _offsets(plane: int) -> NDArray[np.int64]:
    """Return the places of taps around a sample, as rows and columns of the lattice."""
    row, col = parity(plane)
    return np.array(
        [(2 * r + parity(p)[0] - row, 2 * c + parity(p)[1] - col) for p, r, c in TAPS[plane]],
        dtype=np.int64,
    )


@_IN_C
def errors_of(values: Reals, weights: NDArray[np.int64]) -> Reals:
    """Return the errors of weights, shape (sets, taps), in steps: shape (sets, n)."""
    n_sets, n_taps = weights.shape
    parts = values.reshape(-1, _AT_A_TIME, MOST_TAPS + 1)
    sums = np.matmul(weights.astype(np.float64), parts[:, :, :n_taps].transpose(0, 2, 1))
    errors: Reals = parts[:, None, :, MOST_TAPS] * WHOLE - sums
    errors *= 1.0 / (WHOLE * FINE)
    return errors.transpose(1, 0, 2).reshape(n_sets, -1)


def costs_of(samples: FitSamples, weights: NDArray[np.int64], noises: Reals) -> NDArray[np.int64]:
    """Return about what each set of weights makes samples cost, in 1/64 bit, with its noise.

    Half the logarithm of the squared error, from the exponent and mantissa of a float32.
    """
    power = np.cumsum((weights / WHOLE) ** 2, axis=1)[:, -1]
    # One is 2**-23 of an octave above 2**-127.
    costs = sums_of_bits(samples.values, weights, noises * power)
    costs -= _BITS_OF_ONE * len(samples.values)
    return costs // (1 << 24) * COST_UNIT + costs % (1 << 24) * COST_UNIT // (1 << 24)


@_IN_C
def sums_of_bits(values: Reals, weights: NDArray[np.int64], noises: Reals) -> NDArray[np.int64]:
    """Return sums of squared errors with noise, as bits of float32: shape (sets,)."""
    errors = errors_of(values, weights)
    errors *= errors
    errors += noises[:, None]
    np.minimum(errors, MOST_SQUARED, out=errors)
    errors *= 4.0
    errors += 1.0
    sums: NDArray[np.int64] = errors.astype(np.float32).view(np.int32).sum(1, dtype=np.int64)
    return sums


def _best(plane: int, samples: FitSamples) -> int:
    """Return the trained set that predicts best."""
    sets = _trained(plane)
    return int(costs_of(samples, sets, np.zeros(len(sets))).argmin())


def _noise(samples: dict[tuple[int, int], FitSamples], best: dict[tuple[int, int], int]) -> float:
    """Return the variance of decoded samples around those given, in steps squared.

    The remainder of a prediction's error after the nearest multiple of the step.
    """
    total, n = 0.0, 0
    for key, found in samples.items():
        errors = errors_of(found.values, _trained(key[1])[best[key], None])[0]
        rest = np.rint((errors - np.rint(errors)) * 1024)
        total += float((rest * rest).sum())
        n += len(rest)
    return total / (max(n, 1) * 1024.0 * 1024.0)


def fit_weights(
    samples: dict[tuple[int, int], FitSamples], noises: list[float], each: Each = map
) -> list[dict[tuple[int, int], NDArray[np.int64]]]:
    """Return for each noise weights fitted to samples, by class and plane.

    A robust least-squares fit: after the first turn, samples count by 1 / (|error| + 1/2).
    Weights apply to heights less the core's mean; what they lack to a sum of 1 is shared by the
    core, and quantising adds noise to every tap: hence the penalty on the squared sum of the
    weights that result. Without weights that cannot be stored.
    """
    keys = list(samples)
    is_core = np.zeros((len(keys), MOST_TAPS))
    has_tap = np.zeros((len(keys), MOST_TAPS))
    for index, (_, plane) in enumerate(keys):
        is_core[index, : len(TAPS[plane])] = core_taps(plane)
        has_tap[index, : len(TAPS[plane])] = 1
    wanted: Reals | None = None
    for every in _EVERY_OF_TURN:
        before = [None] * len(keys) if wanted is None else list(wanted)
        tasks = zip(samples.values(), before, [every] * len(keys), strict=True)
        found = list(each(lambda task: _normal(*task), tasks))
        systems = np.array([own for own, _ in found]).reshape(-1, MOST_TAPS, MOST_TAPS + 1)
        totals = np.array([total for _, total in found])
        middle = noises[len(noises) // 2]
        wanted = _weights(systems, totals * middle, is_core, has_tap)
    n = len(noises)
    of_all = _weights(
        np.tile(systems, (n, 1, 1)),
        (totals * np.array(noises)[:, None]).ravel(),
        np.tile(is_core, (n, 1)),
        np.tile(has_tap, (n, 1)),
    )
    return [
        {
            key: weights.astype(np.int64)
            for key, weights in zip(keys, wanted, strict=True)
            if np.abs(weights).max() < _MAX_WANTED and np.abs(weights).sum() < _MOST_IN_ALL
        }
        for wanted in of_all.reshape(n, len(keys), MOST_TAPS)
    ]


def _normal(samples: FitSamples, weights: Reals | None, every: int) -> tuple[Reals, float]:
    """Return the normal equations of a turn, and what a unit of noise adds to them.

    The right side is the last column. `weights` are those of the turn before.
    """
    every = min(every, len(samples.goals) // _AT_A_TIME)
    n_parts = len(samples.goals) // (_AT_A_TIME * every)
    values = samples.values[: n_parts * _AT_A_TIME * every : every]
    if weights is None:
        size = np.abs(values[:, MOST_TAPS]) * (1.0 / FINE) + 0.5
    else:
        size = np.abs(errors_of(values, weights.astype(np.int64)[None])[0]) + 0.5
    influence = 1.0 / size
    products, shift = products_of(values, np.sqrt(influence))
    unit = float(np.ldexp(float(FINE), shift))
    total = float(np.rint(influence * _INFLUENCE).sum()) / _INFLUENCE
    return products, total * unit * unit


@_IN_C
def products_of(values: Reals, roots: Reals) -> tuple[Reals, int]:
    """Return products of samples times `roots`, scaled to few bits, and by how many bits.

    Shape (MOST_TAPS, MOST_TAPS + 1).
    """
    both = values * roots[:, None]
    largest = max(float(both.max()), -float(both.min()))
    shift = min(MOST_SCALED_BITS - int(np.frexp(largest)[1]), MOST_SCALED_BITS)
    both *= 2.0**shift
    np.rint(both, out=both)
    parts = both.reshape(-1, _AT_A_TIME, MOST_TAPS + 1)
    products = np.matmul(parts[:, :, :MOST_TAPS].transpose(0, 2, 1), parts)
    first, rest = np.split(products, [_EXACT // _AT_A_TIME])
    return first.sum(0) + rest.sum(0), shift


def _weights(systems: Reals, penalties: Reals, is_core: Reals, has_tap: Reals) -> Reals:
    """Return the whole weights in 1/4096 that solve normal equations with a penalty."""
    systems = systems.copy()
    diagonal = np.arange(MOST_TAPS)
    traces = np.cumsum(systems[:, diagonal, diagonal], axis=1)[:, -1]
    part = 0.25 * penalties[:, None]
    systems[:, :, MOST_TAPS] -= part * (is_core - 1.0)
    systems[:, :, :MOST_TAPS] += part[:, :, None] * (1.0 - is_core[:, :, None] - is_core[:, None])
    systems[:, diagonal, diagonal] += (penalties + 1e-7 * traces)[:, None] + 1e-12
    # Taps that a plane does not have.
    systems *= has_tap[:, :, None]
    systems[:, :, :MOST_TAPS] *= has_tap[:, None]
    systems[:, diagonal, diagonal] += 1.0 - has_tap
    solution = solve(systems)
    with np.errstate(invalid="ignore", over="ignore"):
        rest = 1.0 - np.cumsum(solution, axis=1)[:, -1:]
        wanted = np.rint(WHOLE * (solution + is_core * (rest / 4)))
    return np.clip(np.where(np.isfinite(wanted), wanted, _FAR), -_FAR, _FAR)


@_IN_C
def solve(systems: Reals) -> Reals:
    """Return the solutions of symmetric positive definite systems, shape (n, size, size + 1).

    Systems change. By elimination without a sum: each operation rounds alike on every machine.
    What has no solution, as its taps are all 0, is not finite.
    """
    size = systems.shape[1]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for k in range(size):
            # Columns before are those of the unit matrix.
            row = systems[:, k, k:] / systems[:, k, k : k + 1]
            systems[:, :, k:] -= systems[:, :, k : k + 1] * row[:, None]
            systems[:, k, k:] = row
    return systems[:, :, size].copy()


def stencils_cost(stencils: Stencils) -> float:
    """Return about what a file's stencils cost, in 1/64 bit."""
    deltas = [own.deltas for row in stencils for own in row if own.deltas]
    return COST_UNIT * _WORTH * sum(int(_bits_of(np.array([own]))[0]) for own in deltas)


def _bits_of(deltas: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return about how many bits each row of deltas takes: two and its digits for each."""
    digits = np.frexp(np.abs(deltas).astype(np.float64))[1]
    bits: NDArray[np.int64] = (2 + digits).sum(1, dtype=np.int64)
    return bits


def _trained(plane: int) -> NDArray[np.int64]:
    """Return the trained weights of a plane."""
    return annex().stencils[plane - HH, :, : len(TAPS[plane])].astype(np.int64)


def _cheapest(
    plane: int,
    samples: FitSamples,
    base: int,
    fitted: list[NDArray[np.int64] | None],
    noises: list[float],
    share: float,
) -> list[FileStencil]:
    """Return for each noise the stencil that costs least with its own bits.

    Of the trained one and those near the weights that are `fitted`, from the finest to the
    coarsest.
    """
    known = _trained(plane)[base]
    rounding = np.array(_SHIFTS, dtype=np.int64)[:, None]
    tried = []
    for wanted in fitted:
        deltas = np.zeros((1 + len(rounding), len(known)), dtype=np.int64)
        if wanted is not None:
            near = (wanted[: len(known)] - known + (1 << rounding >> 1)) >> rounding
            near[:, missing_tap(plane)] = 0
            deltas[1:] = near
        tried.append(deltas)
    deltas = np.concatenate(tried)
    shifts = np.tile(np.concatenate([np.zeros((1, 1), dtype=np.int64), rounding]), (len(tried), 1))
    weights = known + (deltas << shifts)
    weights[:, missing_tap(plane)] += WHOLE - weights.sum(1)
    costs = costs_of(samples, weights, np.repeat(noises, len(tried[0]))) * (samples.every * share)
    # Where no delta is left it is the trained one, which takes none.
    n_bits = np.where(deltas.any(1), _bits_of(deltas), 0)
    best = (costs + COST_UNIT * _WORTH * n_bits).reshape(len(tried), -1).argmin(1)
    return [
        FileStencil(base, int(shifts[index, 0]), tuple(own[index].tolist()))
        if own[index].any()
        else FileStencil(base)
        for own, index in zip(tried, best.tolist(), strict=True)
    ]
