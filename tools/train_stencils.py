"""Train the tables of the `predictive` method from a directory of rasters.

    python tools/train_stencils.py DIR predictive.bin [--leave-out NAME]

Three stages, each from what the earlier ones give and nothing else: stencil sets (clusters of
least-squares fits over rasters, bounds and levels), weights of the expected magnitude (non-negative
fits to details the encoder really makes), start values of the models (what they adapt to). Needs
scipy. The result is the annex of docs/format-predictive.md P.9; a file that is in use is never
changed.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import rasterio
from scipy.optimize import nnls

from terrainwave.codec import planes as lattice
from terrainwave.codec.magnitudes import N_DETAIL_MODELS
from terrainwave.codec.planes import CORES, TAPS
from terrainwave.codec.predictive import passes as nested
from terrainwave.codec.predictive import refiner as predictive
from terrainwave.codec.predictive import trained as tables
from terrainwave.codec.predictive.fit import features_of
from terrainwave.codec.refiner import Decoded, Validity
from terrainwave.codec.shared_lines import N_BORDER_MODELS
from terrainwave.codec.unit_specs import (
    CodecParameters,
    block_of_unit,
    unit_spec,
)
from terrainwave.coding.rangecoder import new_models
from terrainwave.grid.quadtree import Grid

SIDE = 1025
BOUNDS = (0, 1, 3, 10)
N_SETS = 8
N_SAMPLES = 4000
N_ROUNDS = 6


def load(path):
    """Return (name, heights in quanta, mask, quantum)."""
    with rasterio.open(path) as raster:
        heights = raster.read(1)
        nodata = raster.nodata
    mask = np.ones(heights.shape, dtype=bool) if nodata is None else heights != nodata
    mask &= np.isfinite(heights.astype(np.float64))
    quantum = 1.0 if heights.dtype.kind in "iu" else 0.01
    top, left = max(0, heights.shape[0] - SIDE) // 2, max(0, heights.shape[1] - SIDE) // 2
    at = np.s_[top : top + SIDE, left : left + SIDE]
    quanta = np.where(mask, np.rint(heights / quantum), 0)[at].astype(np.int32)
    mask = mask[at]
    quanta[~mask] = int(quanta[mask].mean())
    return path.stem, quanta, np.ascontiguousarray(mask), quantum


def steps_of(quantum):
    """Return the quantiser widths to train for."""
    bounds = (0.1, 0.5, 1, 3, 10) if quantum < 1 else BOUNDS
    return [2 * round(bound / quantum) + 1 for bound in bounds]


# Stencils --------------------------------------------------------------------------------------


def samples_of(pass_, heights, mask, step, rng):
    """Return (tap values relative to the core's mean, targets, mean), in steps."""
    noise = rng.integers(-(step // 2), step // 2 + 1, heights.shape)
    seen = heights + noise
    planes, clean, valid = [], [], []
    for row, col in ((0, 0), (1, 1), (0, 1), (1, 0)):
        planes.append(seen[row::2, col::2])
        clean.append(heights[row::2, col::2])
        valid.append(mask[row::2, col::2])
    n_rows, n_cols = min(p.shape[0] for p in planes), min(p.shape[1] for p in planes)
    if n_rows < 8 or n_cols < 8:
        return None
    rows = rng.integers(2, n_rows - 3, 2 * N_SAMPLES)
    cols = rng.integers(2, n_cols - 3, 2 * N_SAMPLES)
    keep = valid[pass_][rows, cols]
    for plane, row, col in TAPS[pass_]:
        keep &= valid[plane][rows + row, cols + col]
    rows, cols = rows[keep][:N_SAMPLES], cols[keep][:N_SAMPLES]
    if rows.size < 50:
        return None
    mean = sum(planes[p][rows + r, cols + c] for p, r, c in CORES[pass_]) / 4
    taps = np.stack([planes[p][rows + r, cols + c] - mean for p, r, c in TAPS[pass_]], 1)
    target = clean[pass_][rows, cols] - mean
    return (taps / step).astype(np.float32), (target / step).astype(np.float32)


def fit(items, weights, start=None):
    """Return a robust least-squares fit over samples of several items."""
    n_taps = items[0][0].shape[1]
    solution = np.zeros(n_taps) if start is None else start
    for turn in range(3):
        normal, right = np.zeros((n_taps, n_taps)), np.zeros(n_taps)
        for (taps, target), weight in zip(items, weights, strict=True):
            taps, target = taps.astype(np.float64), target.astype(np.float64)
            if turn == 0 and start is None:
                # Rasters of any roughness count alike.
                influence = np.full(target.size, 1 / (np.mean(np.abs(target)) + 0.5) ** 2)
            else:
                influence = 1 / (np.abs(target - taps @ solution) + 0.5) ** 1.5
            influence *= weight / target.size
            normal += (taps * influence[:, None]).T @ taps
            right += (taps * influence[:, None]).T @ target
        normal += np.eye(n_taps) * 1e-4 * sum(weights)
        solution = np.linalg.solve(normal, right)
    return solution


def cost(item, solution):
    """Return about the mean bits of a detail, as `nested.open_loop_cost`."""
    taps, target = item
    errors = np.abs(target - taps @ solution.astype(np.float32))
    return float(np.mean(np.log2(1 + (2 * np.minimum(errors, 64)) ** 2)))


def train_stencils(rasters, rng):
    """Return {pass: integer weights (N_SETS, n_taps)}."""
    result = {}
    for pass_ in (lattice.HH, lattice.HL, lattice.LH):
        items, weights = [], []
        for _, heights, mask, quantum in rasters:
            for step in steps_of(quantum):
                for level in range(4):
                    at = np.s_[:: 1 << level, :: 1 << level]
                    item = samples_of(pass_, heights[at], mask[at], step, rng)
                    if item is not None:
                        items.append(item)
                        weights.append(0.5**level)
        rough = [float(np.mean(np.abs(target))) for _, target in items]
        order = np.argsort(rough)
        group = np.zeros(len(items), dtype=int)
        group[order] = np.arange(len(items)) * N_SETS // len(items)
        solutions = [None] * N_SETS
        best = None
        for turn in range(N_ROUNDS):
            for k in range(N_SETS):
                mine = [i for i in range(len(items)) if group[i] == k]
                if mine:
                    solutions[k] = fit([items[i] for i in mine], [weights[i] for i in mine])
            costs = np.array([[cost(item, s) for s in solutions] for item in items])
            group = costs.argmin(1)
            found = np.average(costs.min(1), weights=weights)
            if best is None or found < best[0]:
                best = found, list(solutions), costs
            print(
                pass_,
                turn,
                np.average(costs.min(1), weights=weights),
                np.bincount(group, minlength=N_SETS),
            )
        # The first set serves small lattices: the best single one.
        _, solutions, costs = best
        order = np.argsort(np.average(costs, axis=0, weights=weights))
        result[pass_] = np.stack([to_integers(pass_, solutions[k]) for k in order])
    return result


def to_integers(pass_, solution):
    """Return weights in 1/4096 on absolute heights; their sum is 4096."""
    weights = np.rint(solution * 4096).astype(np.int64)
    rest = 4096 - int(weights.sum())
    taps = [tuple(t) for t in TAPS[pass_]]
    places = [taps.index(tuple(core)) for core in CORES[pass_]]
    for i, place in enumerate(places):
        weights[place] += (rest * (i + 1) >> 2) - (rest * i >> 2)
    assert weights.sum() == 4096
    assert np.abs(weights).max() < 1 << 15
    return weights


# Contexts --------------------------------------------------------------------------------------


class Recorder:
    """Runs the encoder over rasters and keeps what its passes and models ended with."""

    def __init__(self):
        self.passes = []
        self.models = []
        self.keep_passes = False

    def code_pass(self, *args):
        """Stand in for `nested.code_pass`."""
        _, kinds, arrays, geometry, tables, heights = args[:6]
        _REAL_PASS(*args)
        if self.keep_passes and kinds.size > 256:
            features, details = features_of(kinds, arrays, geometry, tables, heights.step)
            self.passes.append(
                (geometry.plane, features.astype(np.float32), details.astype(np.float32))
            )

    def new_unit(self, *args):
        """Stand in for `predictive._new_unit`."""
        unit = _REAL_UNIT(*args)
        self.models.append((unit.coder.models, unit.border.models))
        return unit

    def run(self, heights, mask, step, effort=1):
        """Encode all units of a raster."""
        grid = Grid(*heights.shape, 256)
        low, high = int(heights.min()), int(heights.max())
        parameters = CodecParameters(step, low, high, (1, 0), 1, effort)
        refiner = predictive.Predictive()
        total = 0
        pending = [(key, None) for key in grid.root_keys()]
        while pending:
            key, parent = pending.pop()
            spec = unit_spec(grid, parameters, key)
            stride = grid.stride(spec.level)
            region = spec.region
            at = np.s_[
                region.row * stride : (region.row + region.n_rows - 1) * stride + 1 : stride,
                region.col * stride : (region.col + region.n_cols - 1) * stride + 1 : stride,
            ]
            target = np.ascontiguousarray(heights[at])
            payload, back, _ = refiner.encode(spec, parent, target, np.ascontiguousarray(mask[at]))
            total += len(payload)
            decoded = Decoded(back, Validity.of(mask[at]))
            if spec.level < grid.k_max:
                for block in grid.key_blocks(key):
                    pending.append((block, block_of_unit(grid, spec, decoded, block).heights))
        return total


def train_expectation(rasters, rng):
    """Return {pass: feature weights in 1/64}."""
    recorder = Recorder()
    recorder.keep_passes = True
    predictive.code_pass = recorder.code_pass
    keys = [(own, k) for own in (1, 2, 3) for k in range(3)]
    rows, values = {key: [] for key in keys}, {key: [] for key in keys}
    for _, heights, mask, quantum in rasters:
        for step in steps_of(quantum):
            recorder.passes.clear()
            recorder.run(heights, mask, step)
            for own, features, details in recorder.passes:
                keep = rng.random(details.size) < 0.04
                mean = 256 * float(details.mean()) if details.size else 0
                key = own, sum(mean >= limit for limit in predictive.CLASS_LIMITS)
                rows[key].append(features[keep])
                values[key].append(details[keep])
    predictive.code_pass = _REAL_PASS
    result = {own: np.zeros((3, nested.N_FEATURES), dtype=np.int64) for own in (1, 2, 3)}
    for own, k in keys:
        features = np.concatenate(rows[own, k]).astype(np.float64)
        details = np.concatenate(values[own, k]).astype(np.float64)
        influence = np.ones(details.size)
        for _ in range(4):
            solution, _ = nnls(features * influence[:, None], details * influence)
            influence = 1 / (features @ solution + 0.1)
        scaled = np.rint(solution * (1 << nested.E_WEIGHT_BITS))
        result[own][k] = np.clip(scaled, 0, 1 << 14).astype(np.int64)
        result[own][k, nested.F_CONST] = max(1, result[own][k, nested.F_CONST])
        print("expectation", own, k, details.mean(), result[own][k])
    return result


def train_models(rasters):
    """Return the mean states of the models: probability (22 bits), spread, weight."""
    recorder = Recorder()
    tables.start_models = tables.start_border_models = new_models  # nothing from older tables
    predictive._new_unit = recorder.new_unit
    starts = np.concatenate(
        [tables.start_models(N_DETAIL_MODELS), tables.start_border_models(N_BORDER_MODELS)]
    )
    sums = np.zeros((4, starts.size))
    for _, heights, mask, quantum in rasters:
        for step in steps_of(quantum):
            recorder.models.clear()
            recorder.run(heights, mask, step)
            for models in map(np.concatenate, recorder.models):
                count = (models & 1023).astype(np.float64)
                count -= (starts & 1023) * 1.0
                count = np.clip(count, 0, 60)
                probability = (models >> 10) / float(1 << 22)
                sums[0] += count
                sums[1] += count * probability
                sums[2] += count * probability**2
                sums[3] += count > 0
    predictive._new_unit = _REAL_UNIT
    return sums


def start_values(sums):
    """Return the start of each model as one byte pair: probability in 1/4096, count."""
    seen = sums[0] > 20
    weight = np.maximum(sums[0], 1)
    mean = (sums[1] + 0.5) / (weight + 1)
    variance = np.maximum(sums[2] / weight - mean**2, 1e-6)
    count = np.clip(mean * (1 - mean) / variance, 2, MAX_START)
    probability = np.clip(np.rint(mean * 4096), 8, 4088).astype(np.int64)
    count = np.rint(count).astype(np.int64)
    probability[~seen], count[~seen] = 2048, 0
    return (probability << 4 | np.minimum(count >> 1, 15)).astype("<u2")


def annex(stencils, expectation, starts):
    """Return the bytes of the annex (P.9); a list with a number that does not fit raises."""
    parts = np.zeros((), tables.LAYOUT)
    for i, plane in enumerate(("HH", "HL", "LH")):
        parts[plane], parts["W"][i] = stencils[i + 1].tolist(), expectation[i + 1].tolist()
    parts["starts"] = starts
    return parts.tobytes()


MAX_START = 24
N_GUESSES = 2
FIRST_GUESS = np.zeros(nested.N_FEATURES, dtype=np.int64)
FIRST_GUESS[[nested.F_W, nested.F_N, nested.F_NEAR, nested.F_TWIST, nested.F_CONST]] = (
    40, 30, 30, 12, 1,
)  # fmt: skip

_REAL_PASS, _REAL_UNIT = predictive.code_pass, predictive._new_unit


def main():
    """Train and store."""
    parser = argparse.ArgumentParser()
    parser.add_argument("directory", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--leave-out", default="")
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    rasters = [load(p) for p in sorted(options.directory.glob("*.tif"))]
    rasters = [r for r in rasters if not options.leave_out or options.leave_out not in r[0]]
    print([r[0] for r in rasters], file=sys.stderr)
    stencils = train_stencils(rasters, rng)
    tables.STENCILS = stencils
    # Nothing comes from the tables in use: a plain guess first, then from what that gives.
    tables.start_models = tables.start_border_models = new_models
    tables.E_WEIGHTS = {own: np.stack([FIRST_GUESS] * 3) for own in (1, 2, 3)}
    for _ in range(N_GUESSES):
        expectation = train_expectation(rasters, rng)
        tables.E_WEIGHTS = expectation
    models = train_models(rasters)
    options.out.write_bytes(annex(stencils, expectation, start_values(models)))


if __name__ == "__main__":
    main()
