"""Fit stencils to a raster before it is coded (encoder only; docs/decisions/0006).

Weighted least squares on samples chosen by position, with the noise that quantisation adds to the
taps; float64 in a fixed order, so that the same raster gives the same weights everywhere.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.magnitudes import log8
from terrainwave.codec.planes import CORES, PAD, TAPS, WEIGHT_BITS, FileStencil, Pass
from terrainwave.codec.predictive import trained
from terrainwave.codec.predictive.file_tables import (
    MAX_FEATURE_WEIGHT,
    MAX_SETS,
    PLANES,
    FileTables,
    missing_tap,
    weights_of,
)
from terrainwave.codec.predictive.passes import (
    CODED,
    E_WEIGHT_BITS,
    F_ACTIVITY,
    F_BEND,
    F_CONST,
    F_FAR,
    F_LINES,
    F_MEAN,
    F_MEDIAN,
    F_MIDDLE,
    F_N,
    F_NE,
    F_NEAR,
    F_NN,
    F_NW,
    F_OTHERS,
    F_RANGE,
    F_TWIST,
    F_W,
    F_WW,
    N_FEATURES,
    Arrays,
    PassTables,
)
from terrainwave.codec.refiner import Heights, Mask
from terrainwave.coding.jit import kernel
from terrainwave.grid.quadtree import Grid, Region
from terrainwave.grid.sample_windows import HeightsOf, MaskOf

# Levels below the full grid that share a stencil.
_CLASSES = ((0,), (1,), (2, 3, 4))
_MIN_SAMPLES = 300
_MAX_SAMPLES = 8000
_MAX_JUDGED = 2000
# Sampling interval in a plane, and the largest side of the sampled windows.
_EVERY = 12
_WINDOW = 128
_MARGIN = 4
# Variance of the noise of decoded heights in steps squared: some details are 0, so it is below the
# 1/12 of uniform noise.
_NOISE = 0.06
_N_TURNS = 3
# A stencil must save this multiple of its own bits.
_WORTH = 1.5
_SHIFTS = (0, 2, 3, 4, 5)
_COST_PER_BIT = 16
_MAX_WANTED = 28000  # the last weight follows from the others, rounded
_OWN_ERRORS = {
    F_W: (0, -1), F_WW: (0, -2), F_N: (-1, 0), F_NW: (-1, -1), F_NE: (-1, 1), F_NN: (-2, 0),
}  # fmt: skip
_PARITY = {1: (1, 1), 2: (0, 1), 3: (1, 0)}


class _Samples(NamedTuple):
    """Taps less the core's mean, shape (n, taps), and their target values, in steps."""

    taps: NDArray[np.float64]
    goals: NDArray[np.float64]
    n_in_file: float


def fit_tables(grid: Grid, step: int, heights: HeightsOf, mask: MaskOf) -> FileTables:
    """Return the stencils worth storing for a raster.

    Parameters
    ----------
    heights, mask : callable
        Targets (int32 quanta) and validity of a region of a level.
    """
    stencils: dict[int, list[FileStencil]] = {plane: [] for plane in PLANES}
    noise = _NOISE * (1 - 1 / step**2)
    for levels in _CLASSES:
        if levels[0] > grid.k_max or grid.n_rows * grid.n_cols >> 2 * levels[0] < 1 << 14:
            continue
        windows = [window for level in levels for window in windows_of(grid, level, heights, mask)]
        n_samples = sum(grid.n_rows * grid.n_cols / 4 ** (1 + level) for level in levels)
        for plane in PLANES:
            samples = _gather(plane, windows, n_samples, step)
            if samples is None:
                continue
            stencil = _fit_stencil(plane, samples, noise)
            if (
                stencil is not None
                and len(trained.STENCILS[plane]) + len(stencils[plane]) < MAX_SETS
            ):
                stencils[plane].append(stencil)
    return FileTables(stencils, dict.fromkeys(PLANES))


def windows_of(
    grid: Grid, depth: int, heights: HeightsOf, mask: MaskOf, window: int = _WINDOW
) -> list[tuple[Heights, Mask]]:
    """Return windows spread over the level `depth` below the full grid, in an order of neighbours.

    Each has up to `window` samples per side.
    """
    level = max(grid.k_max - depth, 0)
    stride = 1 << max(depth - grid.k_max, 0)
    n_rows, n_cols = grid.level_shape(level)
    side = window * stride
    places = []
    counts = [min(4, max(1, -(-n // (2 * side)))) for n in (n_rows, n_cols)]
    for i in range(counts[0]):
        # Rows alternate in direction, so that every second window has one colour of a chessboard.
        for j in range(counts[1]) if i % 2 == 0 else range(counts[1] - 1, -1, -1):
            row = max(0, n_rows - side) * (2 * i + 1) // (2 * counts[0])
            col = max(0, n_cols - side) * (2 * j + 1) // (2 * counts[1])
            places.append((row // (2 * stride) * 2 * stride, col // (2 * stride) * 2 * stride))
    windows = []
    for row, col in places:
        region = Region(row, col, min(side, n_rows - row), min(side, n_cols - col))
        windows.append(
            (
                np.ascontiguousarray(heights(level, region)[::stride, ::stride], dtype=np.int32),
                np.ascontiguousarray(mask(level, region)[::stride, ::stride], dtype=np.bool_),
            )
        )
    return windows


def _gather(
    plane: int, windows: list[tuple[Heights, Mask]], n_in_file: float, step: int
) -> _Samples | None:
    """Collect samples of a plane from windows; None if there are too few."""
    taps, core = _offsets(plane, TAPS[plane]), _offsets(plane, CORES[plane])
    n_places = sum(heights.size >> 2 for heights, _ in windows)
    n_wanted = min(_MAX_SAMPLES, int(n_in_file) // _EVERY)
    if n_wanted < _MIN_SAMPLES:
        return None
    every = max(1, n_places // n_wanted)
    rows, goals, n_before = [], [], 0
    for heights, mask in windows:
        (row, col), (n_rows, n_cols) = _PARITY[plane], heights.shape
        grid = np.mgrid[row + _MARGIN : n_rows - _MARGIN : 2, col + _MARGIN : n_cols - _MARGIN : 2]
        places = grid.reshape(2, -1).T
        chosen = places[(np.arange(1, len(places) + 1) + n_before) % every == 0]
        n_before += len(places)
        chosen = chosen[_at(mask, chosen) & _at(mask, chosen[:, None] + taps).all(axis=1)]
        means = _at(heights, chosen[:, None] + core).sum(axis=1, dtype=np.int64) * 0.25
        rows.append((_at(heights, chosen[:, None] + taps) - means[:, None]) * (1.0 / step))
        goals.append((_at(heights, chosen) - means) * (1.0 / step))
    found = np.ascontiguousarray(np.concatenate(rows))
    if len(found) < _MIN_SAMPLES:
        return None
    n_valid = n_in_file * len(found) * every / n_places
    return _Samples(found, np.concatenate(goals), min(n_valid, n_in_file))


def _at(samples: NDArray[Any], places: NDArray[np.int64]) -> NDArray[Any]:
    return samples[places[..., 0], places[..., 1]]


def _offsets(plane: int, resolved: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return (plane, row, column) in planes as offsets in the lattice."""
    own = _PARITY[plane]
    parities = {0: (0, 0), **_PARITY}
    return np.array(
        [
            (2 * row + parities[int(p)][0] - own[0], 2 * col + parities[int(p)][1] - own[1])
            for p, row, col in resolved
        ],
        dtype=np.int64,
    )


def _fit_stencil(plane: int, samples: _Samples, noise: float) -> FileStencil | None:
    """Return a stencil fitted to samples, or None if it is not worth its bytes."""
    n_taps = samples.taps.shape[1]
    is_core = np.zeros(n_taps, dtype=np.float64)
    resolved = [tuple(tap) for tap in TAPS[plane]]
    for tap in CORES[plane]:
        is_core[resolved.index(tuple(tap))] = 1
    solution = np.zeros(n_taps, dtype=np.float64)
    if not fit_weights(samples.taps, samples.goals, is_core, noise, _N_TURNS, solution):
        return None
    rest = 1 - float(np.cumsum(solution)[-1])
    wanted = 4096 * (solution + is_core * (rest / 4))
    if not (np.abs(wanted) < _MAX_WANTED).all():
        return None
    sets = trained.STENCILS[plane]
    every = max(1, len(samples.goals) // _MAX_JUDGED)
    judged = np.ascontiguousarray(samples.taps[::every]), samples.goals[::every].copy()
    costs = [stencil_cost(*judged, weights, noise) for weights in sets]
    base = min(range(len(costs)), key=costs.__getitem__)
    missing = missing_tap(plane)
    scale = samples.n_in_file / (_COST_PER_BIT * len(judged[1]))
    best, most_saved = None, 0.0
    for shift in _SHIFTS:
        deltas = np.floor((wanted - sets[base]) / 2**shift + 0.5).astype(np.int64)
        deltas[missing] = 0
        stencil = FileStencil(base, shift, tuple(deltas.tolist()))
        cost = stencil_cost(*judged, weights_of(plane, stencil), noise)
        n_bits = 8 + sum(2 + abs(delta).bit_length() for delta in stencil.deltas)
        saved = (costs[base] - cost) * scale - _WORTH * n_bits
        if saved > most_saved:
            best, most_saved = stencil, saved
    return best


@kernel
def fit_weights(taps, goals, is_core, noise, n_turns, solution):
    """Fill `solution` with a robust least-squares fit of `goals` by `taps`; False if it fails.

    Weights apply to heights less the core's mean. The core shares their difference from a sum of 1,
    and quantisation adds noise of variance `noise` to every tap: hence the penalty on the squared
    sum of the resulting weights.
    """
    n, n_taps = taps.shape
    normal = np.empty((n_taps, n_taps), dtype=np.float64)
    right = np.empty(n_taps, dtype=np.float64)
    for turn in range(n_turns):
        normal[:] = 0.0
        right[:] = 0.0
        total = 0.0
        # Early turns only find the weights of the samples, for which fewer samples suffice.
        for i in range(0, n, 1 << (n_turns - 1 - turn)):
            error = goals[i]
            if turn:
                for k in range(n_taps):
                    error -= solution[k] * taps[i, k]
            size = abs(error) + 0.5
            influence = 1.0 / (size * np.sqrt(size)) if turn else 1.0 / size
            total += influence
            values = taps[i]
            for k in range(n_taps):
                weighted = influence * values[k]
                right[k] += weighted * goals[i]
                line = normal[k]
                for m in range(k + 1):  # symmetric: the lower triangle suffices
                    line[m] += weighted * values[m]
        trace = 0.0
        for k in range(n_taps):
            trace += normal[k, k]
        for k in range(n_taps):
            right[k] -= total * noise * 0.25 * (is_core[k] - 1.0)
            for m in range(k + 1):
                penalty = 0.25 * (1.0 - is_core[k] - is_core[m])
                normal[k, m] += total * noise * penalty
            normal[k, k] += total * noise + 1e-7 * trace + 1e-12
        if not _solve(normal, right, solution):
            return False
    return True


@kernel
def _solve(normal, right, solution):
    """Solve a symmetric positive definite system by Cholesky, in place of its lower triangle."""
    n = right.shape[0]
    for i in range(n):
        for j in range(i + 1):
            value = normal[i, j]
            for k in range(j):
                value -= normal[i, k] * normal[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                normal[i, i] = np.sqrt(value)
            else:
                normal[i, j] = value / normal[j, j]
    for i in range(n):
        value = right[i]
        for k in range(i):
            value -= normal[i, k] * solution[k]
        solution[i] = value / normal[i, i]
    for i in range(n - 1, -1, -1):
        value = solution[i]
        for k in range(i + 1, n):
            value -= normal[k, i] * solution[k]
        solution[i] = value / normal[i, i]
    return True


@kernel
def stencil_cost(taps, goals, weights, noise):
    """Return the cost of integer weights over samples, in about 1/16 bit."""
    n, n_taps = taps.shape
    power = 0.0
    for k in range(n_taps):
        power += (weights[k] / 4096.0) * (weights[k] / 4096.0)
    total = np.int64(0)
    for i in range(n):
        error = 0.0
        for k in range(n_taps):
            error += weights[k] * taps[i, k]
        error = goals[i] - error / 4096.0
        squared = min(error * error + noise * power, 16777216.0)
        total += log8(np.int64(256.0 + 1024.0 * squared))
    return total


# Weights of the expected magnitude --------------------------------------------------------------


def features_of(
    kinds: NDArray[np.uint8], arrays: Arrays, geometry: Pass, tables: PassTables, step: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (features, |detail|) in steps of a coded plane's samples away from its rim.

    Shapes (n, N_FEATURES) and (n,). As `passes.code_pass` computes them, but for rounding.
    """
    n_rows, n_cols = kinds.shape
    own = geometry.plane
    planes, errors, activity, bends = arrays

    def shifted(array: NDArray[Any], row: int, col: int) -> NDArray[np.float64]:
        at = np.s_[PAD + row : PAD + row + n_rows, PAD + col : PAD + col + n_cols]
        return array[at].astype(np.float64)

    value = np.zeros(kinds.shape)
    for weight, (p, r, c) in zip(tables.weights, geometry.taps, strict=True):
        value += weight * shifted(planes[p], r, c) / (1 << WEIGHT_BITS)
    a, b, c, d = (shifted(planes[p], r, q) for p, r, q in geometry.core)
    core = np.sort(np.stack([a, b, c, d]), 0)
    features = np.zeros((N_FEATURES, n_rows, n_cols))
    for index, (row, col) in _OWN_ERRORS.items():
        features[index] = shifted(errors[own], row, col) / 32
    for index, places in ((F_NEAR, geometry.near), (F_FAR, geometry.far)):
        for p, r, q in places:
            features[index] += shifted(errors[p], r, q) / 32
    features[F_MEAN] = np.abs(value - (a + b + c + d) / 4) / step
    if tables.clamp:
        value = np.minimum(np.maximum(value, core[0]), core[3])
    for _, r, q in geometry.bends:
        features[F_BEND] += shifted(bends, r, q) / step
    features[F_RANGE] = (core[3] - core[0]) / step
    features[F_MEDIAN] = np.abs((core[1] + core[2]) / 2 - value) / step
    features[F_MIDDLE] = np.abs((core[0] + core[3]) / 2 - value) / step
    features[F_TWIST] = np.abs(a + d - b - c if own == 1 else a + b - c - d) / step
    for k in range(0, len(geometry.lines), 4):
        e, f, g, h = (shifted(planes[p], r, q) for p, r, q in geometry.lines[k : k + 4])
        features[F_LINES] += np.abs(e - f - g + h) / step
    features[F_ACTIVITY] = shifted(activity[own], -1, 0) / 32
    for other in range(1, own):
        features[F_OTHERS] += shifted(activity[other], int(other == 2), 0) / 32
    features[F_CONST] = 1 / 32  # so that its weight is in 1/16384
    details = np.abs(np.rint((shifted(planes[own], 0, 0) - np.rint(value)) / step))
    inside = np.s_[2:-2, 2:-2]
    use = (kinds == CODED)[inside].ravel()
    rows = features[(slice(None), *inside)].reshape(N_FEATURES, -1)[:, use].T
    return np.ascontiguousarray(rows), np.ascontiguousarray(details[inside].ravel()[use])


def fit_features(
    features: NDArray[np.float64], details: NDArray[np.float64]
) -> NDArray[np.int64] | None:
    """Return weights that give the expected |detail| from features, in 1/512; None if too few."""
    if len(details) < 20 * N_FEATURES:
        return None
    solution = np.zeros(N_FEATURES, dtype=np.float64)
    fit_non_negative(features, details, solution)
    scaled = np.minimum(np.floor(solution * (1 << E_WEIGHT_BITS) + 0.5), MAX_FEATURE_WEIGHT)
    weights = scaled.astype(np.int64)
    weights[F_CONST] = max(1, weights[F_CONST])
    return weights


@kernel
def fit_non_negative(features, details, solution):
    """Fill `solution` with non-negative weights, by coordinate descent on the normal equations.

    Four fits; after the first, samples count by the inverse of their expected value squared.
    """
    n, n_features = features.shape
    normal = np.empty((n_features, n_features), dtype=np.float64)
    right = np.empty(n_features, dtype=np.float64)
    for turn in range(4):
        normal[:] = 0.0
        right[:] = 0.0
        for i in range(n):
            influence = 1.0
            if turn:
                expected = 0.1
                for k in range(n_features):
                    expected += solution[k] * features[i, k]
                influence = 1.0 / (expected * expected)
            for k in range(n_features):
                weighted = influence * features[i, k]
                right[k] += weighted * details[i]
                for m in range(k + 1):
                    normal[k, m] += weighted * features[i, m]
        for k in range(n_features):
            for m in range(k):
                normal[m, k] = normal[k, m]
        for _ in range(300):
            for k in range(n_features):
                if normal[k, k] <= 0.0:
                    continue
                slope = right[k]
                for m in range(n_features):
                    slope -= normal[k, m] * solution[m]
                solution[k] = max(0.0, solution[k] + slope / normal[k, k])
