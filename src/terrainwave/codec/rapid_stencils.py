"""Choose and fit the stencils of a file of method `rapid` (encoder only).

Open loop: samples of the raster itself stand for decoded ones, with noise as quantising adds it.
All sums are of whole numbers below 2**53, held in float64: they are exact in whatever order a
machine adds them, and single operations round alike everywhere. So the same raster gives the same
stencils on every machine, at the speed of its matrix products.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec import rapid_tables
from terrainwave.codec.lattice import parity
from terrainwave.codec.rapid_layout import MAX_TAPS, TAPS
from terrainwave.codec.rapid_parameters import (
    N_CLASSES,
    PLANES,
    SHIFTS,
    WHOLE,
    FileStencil,
    core_taps,
    missing_tap,
)
from terrainwave.codec.refiner import Heights, Mask

Reals = NDArray[np.float64]
Stencils = tuple[tuple[FileStencil, ...], ...]

# Levels below the full grid of each class, and how many samples are taken of a plane there.
CLASS_DEPTHS = ((0,), (1,), (2,), (3, 4))
_WANTED = (3072, 2048, 1536, 1536)
# Products of so many samples at a time are small enough for BLAS to use one thread.
_AT_A_TIME = 128
_JUDGED = 1024  # samples that stencils are compared by
_MIN_SAMPLES = 256
_MARGIN = 4  # no tap is further away, in samples of the lattice
# Samples are whole numbers of 1/64 step, at most 2**17; scaled by their influence at most 2**20.
_FINE = 64
_MOST, _MOST_SCALED_BITS = 1 << 17, 20
_INFLUENCE = 1 << 20
# One sample of so many in each turn of a fit: early turns only find the weights of the samples.
_EVERY_OF_TURN = (4, 2, 1)
# Of the noise of decoded samples that an open loop estimates, what is tried.
_TIMES_NOISE = (0.5, 1.5, 4.0)
_MAX_WANTED, _FAR = 28000, 1e6  # the last weight follows from the others, rounded
# Costs are in 1/64 bit.
COST_UNIT = 64
_BITS_OF_ONE = 127 << 23  # of float32
_MOST_SQUARED = 16777216.0
# A stencil must save so many times its own bits.
_WORTH = 1.5


class Samples(NamedTuple):
    """Taps less the core's mean, shape (n, MAX_TAPS), and what they are to predict.

    In whole 1/64 steps. Each stands for `every` samples of the windows.
    """

    taps: Reals
    goals: Reals
    every: float


def candidates(windows: Heights, masks: Mask, step: int, share: float) -> list[Stencils]:
    """Return stencils to try, for each class and plane: trained ones, then fitted ones.

    Parameters
    ----------
    windows : ndarray of int32, shape (n, n_rows, n_cols)
    masks : ndarray of bool, shape (n, n_rows, n_cols)
        Validity.
    share : float
        How many samples of the raster one of the windows stands for.
    """
    samples = {
        (which, plane): found
        for which in range(N_CLASSES)
        for plane in PLANES
        if (found := gather(plane, windows, masks, which, step)) is not None
    }
    some = {key: judged(found) for key, found in samples.items()}
    best = {key: _best(key[1], found) for key, found in some.items()}
    noise = _noise(some, best) if step > 1 else 0.0
    tried = [_stencils({key: FileStencil(base) for key, base in best.items()})]
    noises = [times * noise for times in _TIMES_NOISE] if step > 1 else [0.0]
    for noise, fitted in zip(noises, fit_weights(samples, noises), strict=True):
        stencils = {
            key: _cheapest(key[1], own, best[key], fitted.get(key), noise, share)
            for key, own in some.items()
        }
        tried.append(_stencils(stencils))
    return tried


def _stencils(chosen: dict[tuple[int, int], FileStencil]) -> Stencils:
    """Return stencils by class and plane; the first trained one where none was chosen."""
    return tuple(
        tuple(chosen.get((which, plane), FileStencil(0)) for plane in PLANES)
        for which in range(N_CLASSES)
    )


def gather(plane: int, windows: Heights, masks: Mask, which: int, step: int) -> Samples | None:
    """Collect samples of a plane and class from windows; None if there are too few."""
    offsets = _offsets(plane)
    is_core = np.array(core_taps(plane))
    has_void = not masks.all()
    rows, goals, n_places = [], [], 0
    for depth in CLASS_DEPTHS[which]:
        at = np.s_[:, :: 1 << depth, :: 1 << depth]
        flat = np.ascontiguousarray(windows[at]).ravel()
        places = _places(plane, windows[at].shape)
        every = max(1, len(places) // _WANTED[which])
        n_places += len(places)
        # One of each `every` places, not always in the same column.
        picks = np.arange(len(places) // every, dtype=np.int64)
        places = places[picks * every + (picks * 40503 >> 4) % every]
        near = places[:, None] + (offsets[:, 0] * windows[at].shape[2] + offsets[:, 1])
        if has_void:
            valid = np.ascontiguousarray(masks[at]).ravel()
            is_valid = valid[near].all(1) & valid[places]
            near, places = near[is_valid], places[is_valid]
        values = flat[near].astype(np.int64)
        total = values[:, is_core].sum(1)
        rows.append(4 * values - total[:, None])
        goals.append(4 * flat[places].astype(np.int64) - total)
    n_found = sum(len(part) for part in goals)
    if n_found < _MIN_SAMPLES:
        return None
    n_found -= n_found % _AT_A_TIME
    taps = np.zeros((n_found, MAX_TAPS), dtype=np.float64)
    taps[:, : len(offsets)] = _in_steps(np.concatenate(rows)[:n_found], step)
    return Samples(taps, _in_steps(np.concatenate(goals)[:n_found], step), n_places / n_found)


def judged(samples: Samples) -> Samples:
    """Return some of the samples: enough to compare stencils by."""
    every = max(1, len(samples.goals) // _JUDGED)
    n = len(samples.goals) // (every * _AT_A_TIME) * _AT_A_TIME * every
    return Samples(
        np.ascontiguousarray(samples.taps[:n:every]),
        samples.goals[:n:every].copy(),
        samples.every * len(samples.goals) * every / n,
    )


def _places(plane: int, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the places in flat windows of a plane's samples with all taps inside."""
    n, n_rows, n_cols = shape
    row, col = parity(plane)
    rows = np.arange(_MARGIN + row, n_rows - _MARGIN, 2, dtype=np.int64)
    cols = np.arange(_MARGIN + col, n_cols - _MARGIN, 2, dtype=np.int64)
    first = np.arange(n, dtype=np.int64) * (n_rows * n_cols)
    places = first[:, None, None] + (rows * n_cols)[:, None] + cols
    return places.ravel()


@cache
def _offsets(plane: int) -> NDArray[np.int64]:
    """Return the places of taps around a sample, as rows and columns of the lattice."""
    row, col = parity(plane)
    return np.array(
        [(2 * r + parity(p)[0] - row, 2 * c + parity(p)[1] - col) for p, r, c in TAPS[plane]],
        dtype=np.int64,
    )


def _in_steps(quarters: NDArray[np.int64], step: int) -> Reals:
    """Return quarters of quanta in whole 1/64 steps."""
    return np.clip(np.rint(quarters * (_FINE / (4.0 * step))), -_MOST, _MOST)


def _errors(samples: Samples, weights: NDArray[np.int64]) -> Reals:
    """Return the errors of weights, shape (sets, taps), in steps: shape (sets, n)."""
    parts = samples.taps.reshape(-1, _AT_A_TIME, MAX_TAPS)[:, :, : weights.shape[1]]
    sums = np.matmul(parts, weights.astype(np.float64).T).reshape(len(samples.goals), -1)
    return (samples.goals * WHOLE - sums.T) * (1.0 / (WHOLE * _FINE))


def costs_of(samples: Samples, weights: NDArray[np.int64], noise: float) -> NDArray[np.int64]:
    """Return about what each set of weights makes samples cost, in 1/64 bit.

    Half the logarithm of the squared error, as exponent and mantissa of float32 tell it.
    """
    power = np.cumsum((weights / WHOLE) ** 2, axis=1)[:, -1:]
    errors = _errors(samples, weights)
    squared = np.minimum(errors * errors + noise * power, _MOST_SQUARED)
    # One is 2**-23 of an octave above 2**-127.
    octaves = (1.0 + 4.0 * squared).astype(np.float32).view(np.int32)
    costs: NDArray[np.int64] = octaves.sum(1, dtype=np.int64) - (_BITS_OF_ONE * errors.shape[1])
    return costs // (1 << 24) * COST_UNIT + costs % (1 << 24) * COST_UNIT // (1 << 24)


def _best(plane: int, samples: Samples) -> int:
    """Return the trained set that predicts best."""
    return int(costs_of(samples, _trained(plane), 0.0).argmin())


def _noise(samples: dict[tuple[int, int], Samples], best: dict[tuple[int, int], int]) -> float:
    """Return the variance of decoded samples around those given, in steps squared.

    What is left of a prediction's error when the nearest multiple of the step is taken off.
    """
    total, n = 0.0, 0
    for key, found in samples.items():
        errors = _errors(found, _trained(key[1])[best[key], None])[0]
        rest = np.rint((errors - np.rint(errors)) * 1024)
        total += float((rest * rest).sum())
        n += len(rest)
    return total / (max(n, 1) * 1024.0 * 1024.0)


def fit_weights(
    samples: dict[tuple[int, int], Samples], noises: list[float]
) -> list[dict[tuple[int, int], NDArray[np.int64]]]:
    """Return for each noise weights fitted to samples, by class and plane.

    A robust least-squares fit: after the first turn, samples count by 1 / (|error| + 1/2)**1.5.
    Weights apply to heights less the core's mean; what they lack to a sum of 1 is shared by the
    core, and quantising adds noise to every tap: hence the penalty on the squared sum of the
    weights that result. Without weights that cannot be stored.
    """
    keys = list(samples)
    is_core = np.zeros((len(keys), MAX_TAPS))
    has_tap = np.zeros((len(keys), MAX_TAPS))
    for index, (_, plane) in enumerate(keys):
        is_core[index, : len(TAPS[plane])] = core_taps(plane)
        has_tap[index, : len(TAPS[plane])] = 1
    wanted: Reals | None = None
    for every in _EVERY_OF_TURN:
        systems = np.zeros((len(keys), MAX_TAPS, MAX_TAPS + 1))
        totals = np.zeros(len(keys))
        for index, key in enumerate(keys):
            weights = None if wanted is None else wanted[index]
            systems[index], totals[index] = _normal(samples[key], weights, every)
        middle = noises[len(noises) // 2]
        wanted = _weights(systems, totals * middle, is_core, has_tap)
    found = []
    for noise in noises:
        wanted = _weights(systems, totals * noise, is_core, has_tap)
        found.append(
            {
                key: weights.astype(np.int64)
                for key, weights in zip(keys, wanted, strict=True)
                if np.abs(weights).max() < _MAX_WANTED
            }
        )
    return found


def _normal(samples: Samples, weights: Reals | None, every: int) -> tuple[Reals, float]:
    """Return the normal equations of a turn, and what a unit of noise adds to them.

    The right side is the last column. `weights` are those of the turn before.
    """
    every = min(every, len(samples.goals) // _AT_A_TIME)
    n_parts = len(samples.goals) // (_AT_A_TIME * every)
    picked = slice(0, n_parts * _AT_A_TIME * every, every)
    some = samples._replace(taps=samples.taps[picked], goals=samples.goals[picked])
    if weights is None:
        size = np.abs(some.goals) * (1.0 / _FINE) + 0.5
        influence = 1.0 / size
    else:
        size = np.abs(_errors(some, weights.astype(np.int64)[None])[0]) + 0.5
        influence = 1.0 / (size * np.sqrt(size))
    both = np.concatenate([some.taps, some.goals[:, None]], axis=1)
    both *= np.sqrt(influence)[:, None]
    shift = min(_MOST_SCALED_BITS - int(np.frexp(np.abs(both).max())[1]), _MOST_SCALED_BITS)
    both = np.rint(np.ldexp(both, shift))
    parts = both.reshape(-1, _AT_A_TIME, MAX_TAPS + 1)
    products: Reals = np.matmul(parts[:, :, :MAX_TAPS].transpose(0, 2, 1), parts).sum(0)
    unit = float(np.ldexp(float(_FINE), shift))
    total = float(np.rint(influence * _INFLUENCE).sum()) / _INFLUENCE
    return products, total * unit * unit


def _weights(systems: Reals, penalties: Reals, is_core: Reals, has_tap: Reals) -> Reals:
    """Return the whole weights in 1/4096 that solve normal equations with a penalty."""
    systems = systems.copy()
    diagonal = np.arange(MAX_TAPS)
    traces = np.cumsum(systems[:, diagonal, diagonal], axis=1)[:, -1]
    part = 0.25 * penalties[:, None]
    systems[:, :, MAX_TAPS] -= part * (is_core - 1.0)
    systems[:, :, :MAX_TAPS] += part[:, :, None] * (1.0 - is_core[:, :, None] - is_core[:, None])
    systems[:, diagonal, diagonal] += (penalties + 1e-7 * traces)[:, None] + 1e-12
    # Taps that a plane does not have.
    systems *= has_tap[:, :, None]
    systems[:, :, :MAX_TAPS] *= has_tap[:, None]
    systems[:, diagonal, diagonal] += 1.0 - has_tap
    solution = _solved(systems)
    with np.errstate(invalid="ignore", over="ignore"):
        rest = 1.0 - np.cumsum(solution, axis=1)[:, -1:]
        wanted = np.rint(WHOLE * (solution + is_core * (rest / 4)))
    return np.clip(np.where(np.isfinite(wanted), wanted, _FAR), -_FAR, _FAR)


def _solved(systems: Reals) -> Reals:
    """Return the solutions of symmetric positive definite systems, shape (n, size, size + 1).

    By elimination without a sum: each operation rounds alike on every machine. What has no
    solution, as its taps are all 0, is not finite.
    """
    size = systems.shape[1]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for k in range(size):
            row = systems[:, k] / systems[:, k, k : k + 1]
            systems -= systems[:, :, k : k + 1] * row[:, None]
            systems[:, k] = row
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


@cache
def _trained(plane: int) -> NDArray[np.int64]:
    """Return the trained weights of a plane."""
    return rapid_tables.STENCILS[plane].astype(np.int64)


def _cheapest(
    plane: int,
    samples: Samples,
    base: int,
    wanted: NDArray[np.int64] | None,
    noise: float,
    share: float,
) -> FileStencil:
    """Return the stencil that costs least with its own bits, of the trained and the fitted.

    Those near the wanted weights are tried from the finest to the coarsest.
    """
    trained = _trained(plane)[base]
    deltas, shifts = np.zeros((1, len(trained)), dtype=np.int64), np.zeros((1, 1), dtype=np.int64)
    if wanted is not None:
        rounding = np.array(SHIFTS, dtype=np.int64)[:, None]
        near = (wanted[: len(trained)] - trained + (1 << rounding >> 1)) >> rounding
        near[:, missing_tap(plane)] = 0
        is_other = near.any(1)
        deltas = np.concatenate([deltas, near[is_other]])
        shifts = np.concatenate([shifts, rounding[is_other]])
    weights = trained + (deltas << shifts)
    weights[:, missing_tap(plane)] += WHOLE - weights.sum(1)
    costs = costs_of(samples, weights, noise) * (samples.every * share)
    n_bits = _bits_of(deltas)
    n_bits[0] = 0
    best = int((costs + COST_UNIT * _WORTH * n_bits).argmin())
    if best == 0:
        return FileStencil(base)
    return FileStencil(base, int(shifts[best, 0]), tuple(deltas[best].tolist()))
