"""Train the tables of the `cdf97` method from a directory of rasters.

    python tools/train_cdf97.py DIR cdf97.bin [--leave-out NAME,NAME]

Three stages, each from what the earlier ones give and nothing else: sets of weights of the
residuals' prediction (clusters of least-squares fits over units), weights of the expected magnitude
(a non-negative fit to residuals), start values of the models (what they adapt to). Needs scipy. The
result is the annex of FORMAT.md §7.8; a file that is in use is never changed.
"""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls
from train_stencils import load, start_values, steps_of

from terrainwave.codec.cdf97 import refiner as cdf97
from terrainwave.codec.cdf97 import trained as tables97
from terrainwave.codec.cdf97.residual import (
    BASE_BITS,
    CODED,
    CURVES,
    FRAME,
    N_FEATURES,
    N_RESIDUAL_MODELS,
    N_TERMS,
    PLACES,
    VOID,
    WEIGHT_BITS,
)
from terrainwave.codec.cdf97.zerotree import N_TREE_MODELS
from terrainwave.codec.refiner import Decoded, Validity
from terrainwave.codec.shared_lines import N_BORDER_MODELS
from terrainwave.codec.unit_specs import block_of_unit, unit_spec
from terrainwave.coding.filters import lowpass_analysis
from terrainwave.coding.rangecoder import new_models
from terrainwave.grid.parameters import CodecParameters
from terrainwave.grid.quadtree import Grid

N_SETS = 16
N_SAMPLES = 600
N_ROUNDS = 6
N_ROWS = 48
FEATURE_SHARE = 0.05
# Prediction and contexts are fitted to many small units, models to units of the usual size.
SMALL_SIDE, SMALL_BLOCK, BLOCK = 513, 128, 256
SIZES = {
    "_residuals": N_RESIDUAL_MODELS, "_trees": N_TREE_MODELS, "_border": N_BORDER_MODELS
}  # fmt: skip
# Errors of prediction are in 1/32 step, features' weights in 1/128.
ERROR_UNIT, E_UNIT = 32, 128


class Coded(NamedTuple):
    """What the residual coder was given and made, in one unit."""

    target: np.ndarray
    heights: np.ndarray
    kinds: np.ndarray
    base: np.ndarray
    step: int
    weights: np.ndarray


class Recorder:
    """Runs the encoder over rasters and keeps what the best attempts used and ended with."""

    def __init__(self):
        self.coded = []
        self.models = []
        self._last = self._trees = self._residuals = self._border = None

    def __enter__(self):
        self._real = (
            cdf97.code_residuals, cdf97._Encoder.attempt, cdf97._Encoder.run,
            tables97.start_tree_models, tables97.start_residual_models,
            tables97.start_border_models,
        )  # fmt: skip
        recorder = self
        code_residuals, attempt, run, *_ = self._real

        def recorded_residuals(*args):
            code_residuals(*args)
            target, heights, kinds, base, step, _, weights = args[:7]
            recorder._last = Coded(target, heights.copy(), kinds, base.copy(), step, weights)

        def recorded_attempt(encoder, step_code):
            recorder._last = recorder._trees = recorder._residuals = None
            before = encoder.best
            attempt(encoder, step_code)
            if encoder.best is not before:
                encoder.kept = recorder._last, recorder._trees, recorder._residuals

        def recorded_run(encoder):
            border = recorder._border
            result = run(encoder)
            coded, trees, residuals = encoder.kept
            if coded is not None:
                recorder.coded.append(coded)
            recorder.models.append((residuals, trees, border))
            return result

        def starting(kind):
            def start():
                models = new_models(SIZES[kind])
                setattr(recorder, kind, models)
                return models

            return start

        cdf97.code_residuals = recorded_residuals
        cdf97._Encoder.attempt, cdf97._Encoder.run = recorded_attempt, recorded_run
        tables97.start_tree_models = starting("_trees")
        tables97.start_residual_models = starting("_residuals")
        tables97.start_border_models = starting("_border")
        return self

    def __exit__(self, *_):
        (
            cdf97.code_residuals, cdf97._Encoder.attempt, cdf97._Encoder.run,
            tables97.start_tree_models, tables97.start_residual_models,
            tables97.start_border_models,
        ) = self._real  # fmt: skip


def encode(heights, mask, step, block):
    """Encode all units of a raster with `cdf97`; return the bytes."""
    grid = Grid(*heights.shape, block)
    levels, masks = [heights], [mask]
    for level in range(grid.k_max - 1, -1, -1):
        fine = levels[-1]
        levels.append(lowpass_analysis(fine, (0, 0), fine.shape, (0, 0), grid.level_shape(level)))
        masks.append(np.ascontiguousarray(masks[-1][::2, ::2]))
    parameters = CodecParameters(step, int(heights.min()), int(heights.max()), (1, 0), 1, 1)
    total = 0
    pending = [(key, None) for key in grid.root_keys()]
    while pending:
        key, parent = pending.pop()
        spec = unit_spec(grid, parameters, key)
        region = spec.region
        at = np.s_[region.row : region.row + region.n_rows, region.col : region.col + region.n_cols]
        back = grid.k_max - spec.level
        valid = np.ascontiguousarray(masks[back][at])
        payload, decoded, _ = cdf97.Cdf97().encode(
            spec, parent, np.ascontiguousarray(levels[back][at]), valid
        )
        total += len(payload)
        unit = Decoded(decoded, Validity.of(valid))
        if spec.level < grid.k_max:
            for block in grid.key_blocks(key):
                pending.append((block, block_of_unit(grid, spec, unit, block).heights))
    return total


# Prediction ------------------------------------------------------------------------------------


def terms_of(coded):
    """Return the terms, (N_TERMS, n_rows, n_cols), and the targets less the base, in 1/64."""
    n_rows, n_cols = coded.target.shape

    def base_at(row, col):
        return coded.base[FRAME + row :, FRAME + col :][:n_rows, :n_cols]

    here = base_at(0, 0)
    terms = []
    for row, col in CURVES:
        mirrored = {(r, c) for r in (-row, row) for c in (-col, col)}
        terms.append(sum(base_at(*place) for place in mirrored) - len(mirrored) * here)
    errors = np.pad((coded.heights.astype(np.int64) << BASE_BITS) - here, FRAME)
    terms += [errors[FRAME + r :, FRAME + c :][:n_rows, :n_cols] for r, c in PLACES]
    return np.stack(terms), (coded.target.astype(np.int64) << BASE_BITS) - here


def samples_of(coded, rng):
    """Return (terms, targets) in steps of some samples of each phase, None if too few."""
    terms, target = terms_of(coded)
    unit = coded.step << BASE_BITS
    phases = []
    for phase in range(4):
        row, col = phase >> 1, phase & 1
        places = np.flatnonzero(coded.kinds[row::2, col::2] == CODED)
        if places.size < 50:
            return None
        places = rng.choice(places, min(N_SAMPLES, places.size), replace=False)
        part = terms[:, row::2, col::2].reshape(N_TERMS, -1)[:, places].T
        goal = target[row::2, col::2].ravel()[places]
        phases.append(((part / unit).astype(np.float32), (goal / unit).astype(np.float32)))
    return phases


def fit(units):
    """Return robust least-squares weights, (4, N_TERMS), for samples of several units."""
    result = np.zeros((4, N_TERMS))
    for phase in range(4):
        solution = None
        for _ in range(4):
            normal = np.eye(N_TERMS) * 1e-4 * len(units)
            right = np.zeros(N_TERMS)
            for unit in units:
                terms, target = (part.astype(np.float64) for part in unit[phase])
                if solution is None:
                    influence = np.full(target.size, 1 / (np.mean(np.abs(target)) + 0.3) ** 2)
                else:
                    influence = 1 / (np.abs(target - terms @ solution) + 0.3) ** 1.5
                influence /= target.size
                normal += (terms * influence[:, None]).T @ terms
                right += (terms * influence[:, None]).T @ target
            solution = np.linalg.solve(normal, right)
        result[phase] = solution
    return result


def cost(unit, weights):
    """Return about the mean bits of a residual, as `residual.open_loop_costs`."""
    total = 0.0
    for (terms, target), part in zip(unit, weights.astype(np.float32), strict=True):
        errors = np.minimum(np.abs(target - terms @ part), 64)
        total += float(np.mean(np.log2(1 + (2 * errors) ** 2)))
    return total / 4


def train_sets(units):
    """Return integer weights, (N_SETS, 4, N_TERMS); the first set is the best single one."""
    rough = [float(np.mean(np.abs(unit[3][1]))) for unit in units]
    group = np.argsort(np.argsort(rough)) * N_SETS // len(units)
    sets = [np.zeros((4, N_TERMS))] * N_SETS
    best = None
    for turn in range(N_ROUNDS):
        for k in range(N_SETS):
            mine = [unit for unit, own in zip(units, group, strict=True) if own == k]
            if mine:
                sets[k] = fit(mine)
        costs = np.array([[cost(unit, weights) for weights in sets] for unit in units])
        group = costs.argmin(1)
        found = costs.min(1).mean()
        print("sets", turn, found, costs.mean(0).min(), np.bincount(group, minlength=N_SETS))
        if best is None or found < best[0]:
            best = found, list(sets), costs.mean(0)
    _, sets, means = best
    limit = (1 << 12) - 1
    ordered = [sets[k] for k in np.argsort(means)]
    return np.clip(np.rint(np.stack(ordered) * (1 << WEIGHT_BITS)), -limit, limit).astype(np.int32)


# Contexts --------------------------------------------------------------------------------------


def features_of(coded, rng):
    """Return features in 1/32 step and the magnitudes in steps of some coded samples."""
    terms, _ = terms_of(coded)
    n_rows, n_cols = coded.target.shape
    weights = np.empty((N_TERMS, n_rows, n_cols), dtype=np.int64)
    for phase in range(4):
        row, col = phase >> 1, phase & 1
        weights[:, row::2, col::2] = coded.weights[phase][:, None, None]
    change = (terms * weights).sum(0) >> WEIGHT_BITS
    here = coded.base[FRAME:-FRAME, FRAME:-FRAME]
    predicted = here + change
    unit = coded.step << BASE_BITS
    mags = np.abs((coded.heights.astype(np.int64) << BASE_BITS) - predicted) * ERROR_UNIT // unit
    mags[coded.kinds == VOID] = 0
    framed = np.pad(mags, FRAME)
    errors = np.pad((coded.heights.astype(np.int64) << BASE_BITS) - here, FRAME)

    def at(array, row, col):
        return array[FRAME + row :, FRAME + col :][:n_rows, :n_cols]

    slope = np.abs(at(errors, -1, 0) - at(errors, -1, -1))
    slope += np.abs(at(errors, -1, 1) - at(errors, -1, 0))
    places = ((0, -1), (0, -2), (-1, 0), (-1, -1), (-1, 1), (-2, 0))
    features = [at(framed, *place) for place in places]
    features += [slope * ERROR_UNIT // unit, np.full_like(mags, 1 / E_UNIT, dtype=np.float64)]
    keep = (coded.kinds == CODED) & (rng.random(mags.shape) < FEATURE_SHARE)
    off = np.abs(coded.target.astype(np.int64) - ((predicted + 32) >> BASE_BITS))
    residuals = (off + (coded.step >> 1)) // coded.step
    return np.stack([f[keep] for f in features], 1).astype(np.float64), residuals[keep]


def train_expectation(parts):
    """Return the weights of the expected magnitude in 1/128."""
    features = np.concatenate([part[0] for part in parts])
    goal = np.concatenate([part[1] for part in parts]) * float(ERROR_UNIT)
    influence = np.ones(goal.size)
    for _ in range(5):
        solution, _ = nnls(features * influence[:, None], goal * influence)
        influence = 1 / (features @ solution + 3)
    weights = np.rint(solution * E_UNIT).astype(np.int64)
    # The constant's feature is 1/128 already: its weight counts whole units.
    weights[-1] = max(1, round(float(solution[-1])))
    print("expectation", weights)
    return weights


def train_models(models):
    """Return start values of the residual, tree and border models, one after another."""
    found = []
    for kind in range(3):
        arrays = [unit[kind] for unit in models if unit[kind] is not None]
        sums = np.zeros((4, arrays[0].size))
        for array in arrays:
            count = np.clip((array & 1023).astype(np.float64), 0, 60)
            probability = (array >> 10) / float(1 << 22)
            sums[0] += count
            sums[1] += count * probability
            sums[2] += count * probability**2
            sums[3] += count > 0
        found.append(start_values(sums))
    return found


def run(rasters, rng, block, part):
    """Encode all rasters at all steps; return what `part` makes of the units, and the models."""
    results, models = [], []
    for _, heights, mask, quantum in rasters:
        for step in steps_of(quantum):
            with Recorder() as recorder:
                encode(heights, mask, step, block)
            results += [part(coded, rng) for coded in recorder.coded]
            models += recorder.models
    return results, models


def crop(raster, side):
    """Return the middle of a raster."""
    name, heights, mask, quantum = raster
    top, left = (max(0, size - side) // 2 for size in heights.shape)
    at = np.s_[top : top + side, left : left + side]
    return name, np.ascontiguousarray(heights[at]), np.ascontiguousarray(mask[at]), quantum


def both(coded, rng):
    """Return samples and features of some rows of a unit."""
    n_rows = coded.target.shape[0]
    if n_rows > N_ROWS:
        top = 2 * int(rng.integers(0, (n_rows - N_ROWS) // 2 + 1))
        at = slice(top, top + N_ROWS)
        kinds = coded.kinds[at].copy()
        kinds[:FRAME] = VOID  # their neighbours above are not seen
        base = coded.base[top : top + N_ROWS + 2 * FRAME]
        coded = coded._replace(
            target=coded.target[at], heights=coded.heights[at], kinds=kinds, base=base
        )
    return samples_of(coded, rng), features_of(coded, rng)


def train(rasters, rng):
    """Set the tables of `tables97`; return the start values."""
    tables97.TERM_WEIGHTS = np.zeros((1, 4, N_TERMS), dtype=np.int32)
    tables97.E_WEIGHTS = FIRST_GUESS
    small = [crop(raster, SMALL_SIDE) for raster in rasters]
    for _ in range(2):
        parts, _ = run(small, rng, SMALL_BLOCK, both)
        tables97.TERM_WEIGHTS = train_sets([p for p, _ in parts if p is not None])
        tables97.E_WEIGHTS = train_expectation([f for _, f in parts])
    _, models = run(rasters, rng, BLOCK, lambda *_: None)
    return train_models(models)


def annex(starts):
    """Return the bytes of the annex (§7.8); a list with a number that does not fit raises."""
    parts = np.zeros((), tables97.LAYOUT)
    parts["w"], parts["W"] = tables97.TERM_WEIGHTS.tolist(), tables97.E_WEIGHTS.tolist()
    parts["residuals"], parts["trees"], parts["border"] = starts
    return parts.tobytes()


FIRST_GUESS = np.array((24, 22, 9, 9, 11, 21, 8, 70), dtype=np.int64)
assert FIRST_GUESS.size == N_FEATURES


def main():
    """Train and store."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--leave-out", default="", help="parts of names, comma between")
    options = parser.parse_args()
    left_out = [name for name in options.leave_out.split(",") if name]
    rasters = [load(path) for path in sorted(options.directory.glob("*.tif"))]
    rasters = [r for r in rasters if not any(name in r[0] for name in left_out)]
    print([r[0] for r in rasters], file=sys.stderr)
    starts = train(rasters, np.random.default_rng(1))
    options.out.write_bytes(annex(starts))


if __name__ == "__main__":
    main()
