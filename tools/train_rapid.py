"""Train the annex of the `rapid` method on rasters.

    python tools/train_rapid.py OUT RASTER ...
    python tools/train_rapid.py OUT RASTER ... --leave-one-out

Writes OUT/rapid.bin, with --leave-one-out also OUT/NAME.bin, which is trained without the raster
NAME: what it makes of that raster says how well an annex serves rasters that it never saw. Beside
the rasters, synthetic terrain is trained on. Nothing of an annex that was there before is used.

Stencils are fitted to each raster, bound, class of levels and plane, and those kept that together
serve all of them best. Then windows are coded, and tell the weights of what details are expected to
be, and frequencies. The two families of a kind of step share the rasters out by what they cost.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rasterio

from terrainwave.codec.planes import WHOLE
from terrainwave.codec.rapid import file_tables, fit, fit_stencils
from terrainwave.codec.rapid.file_tables import (
    N_FEATURES,
    N_PAIR_SYMBOLS,
    N_SETS,
    N_SINGLE_SYMBOLS,
    PLANES,
    Annex,
    codes_of,
    family_of,
    freqs_of,
    missing_tap,
    packed,
    plain_tables,
)
from terrainwave.codec.rapid.fit_stencils import costs_of, fit_weights, gather, judged
from terrainwave.codec.rapid.fit_weights import count_by_class
from terrainwave.codec.rapid.layout import CORES, HH, N_LEVEL_CLASSES, N_TAPS, TAPS
from terrainwave.codec.rapid.symbols import (
    ESCAPED,
    N_CLASSES,
    N_SLOTS,
    N_SYMBOLS,
    N_TABLES,
    PAIR_LIMIT,
    SINGLE_LIMIT,
    SINGLES,
    STEP_CLASS,
)

# Of rasters of whole metres, and of those that have centimetres.
BOUNDS, FINE_BOUNDS = (0, 1, 2, 5, 10, 30), (0.01, 0.1, 0.3, 1, 10)
WINDOW, MOST_WINDOWS = 257, 6
N_STEPS, N_KINDS = 3, 2
NOISES = (0.0048, 0.0208, 0.0533)  # of ±0.12, ±0.25 and ±0.4 step, in steps squared
LEAST_COST = 1 / 16  # bits a sample: what is predicted well counts little
# Symbols that frequencies are worked out from, as if so many of the family before had been seen.
COUNTED, PRIOR = 1e6, 2000
N_TURNS = 5


class Case(NamedTuple):
    """Windows of a raster, for a bound."""

    name: str
    sample: fit._Sample


# Terrain ----------------------------------------------------------------------------------------


def windows_of(path: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Return windows spread over a raster, their masks, and how many metres a quantum has."""
    with rasterio.open(path) as dataset:
        heights = dataset.read(1).astype(np.float64)
        mask = (dataset.read_masks(1) > 0) & np.isfinite(heights)
        quantum = 1.0 if np.issubdtype(dataset.dtypes[0], np.integer) else 0.01
    heights = np.rint(np.where(mask, heights, np.median(heights[mask])) / quantum).astype(np.int32)
    side = tuple(min(WINDOW, n) for n in heights.shape)
    n_rows, n_cols = (max(1, min(3, n // WINDOW)) for n in heights.shape)
    found = []
    for i in range(n_rows):
        for j in range(n_cols):
            row = (heights.shape[0] - side[0]) * (2 * i + 1) // (2 * n_rows)
            col = (heights.shape[1] - side[1]) * (2 * j + 1) // (2 * n_cols)
            at = np.s_[row : row + side[0], col : col + side[1]]
            if mask[at].mean() > 0.5 and np.ptp(heights[at][mask[at]]) > 20:
                found.append((heights[at], mask[at]))
    found = found[:: -(-len(found) // MOST_WINDOWS)]
    return np.stack([one for one, _ in found]), np.stack([valid for _, valid in found]), quantum


def synthetic(seed: int, slope: float, relief: float) -> np.ndarray:
    """Return windows of fractal terrain: power falls with frequency by `slope`."""
    rng = np.random.default_rng(seed)
    rows, cols = (np.fft.fftfreq(2 * WINDOW) for _ in range(2))
    frequency = np.hypot(rows[:, None], cols)
    frequency[0, 0] = np.inf
    noise = np.fft.fft2(rng.normal(size=frequency.shape))
    heights = np.real(np.fft.ifft2(noise / frequency**slope))
    heights *= relief / heights.std()
    whole = np.rint(heights).astype(np.int32)
    return np.stack([whole[:WINDOW, :WINDOW], whole[WINDOW - 1 : -1, WINDOW - 1 : -1]])


def cases_of(paths: list[Path]) -> list[Case]:
    """Return the cases of rasters and of synthetic terrain."""
    found = []
    for path in paths:
        windows, masks, quantum = windows_of(path)
        for bound in BOUNDS if quantum == 1 else FINE_BOUNDS:
            step = 2 * round(bound / quantum) + 1
            found.append(Case(path.stem, fit._Sample(windows, masks, step, 20.0)))
    for seed, (slope, relief) in enumerate([(1.7, 300), (2.0, 500), (2.3, 900)]):
        windows = synthetic(seed, slope, relief)
        for step in (1, 3, 11):
            sample = fit._Sample(windows, np.ones(windows.shape, dtype=bool), step, 20.0)
            found.append(Case(f"synthetic {slope}", sample))
    return found


# An annex to begin with -------------------------------------------------------------------------


def first_annex() -> Annex:
    """Return cubic stencils, weights that suit most terrain, and frequencies by a formula."""
    cubic = {-1: -1, 0: 9, 1: 9, 2: -1}
    stencils = np.zeros((len(PLANES), N_SETS, 24), dtype=np.int16)
    for index, plane in enumerate(PLANES):
        for number, tap in enumerate(TAPS[plane]):
            weight = cubic[tap[1]] * cubic[tap[2]] * 16 if plane == HH else 1024
            stencils[index, :, number] = weight if plane == HH or tap in CORES[plane] else 0
    n = N_STEPS * N_KINDS
    weights = np.empty((n, N_LEVEL_CLASSES, len(PLANES), N_FEATURES), dtype=np.int64)
    weights[:] = codes_of(np.array([1500, 3000, 2000, 4000]))
    counts = np.zeros((N_TABLES, N_SYMBOLS))
    for number in range(N_CLASSES):
        expected = 2.0 ** ((number - STEP_CLASS) / 2)
        n_raw = max(number - STEP_CLASS - 4, 0) >> 1
        single = np.arange(-SINGLE_LIMIT, SINGLE_LIMIT + 1) * 2.0**n_raw
        for table, values in ((number, single), (SINGLES + number, single)):
            values = np.arange(-PAIR_LIMIT, PAIR_LIMIT + 1) if table < SINGLES else values
            shares = np.exp(-np.abs(values) / max(expected, 0.15)) + 1e-9
            shares /= shares.sum()
            if table < SINGLES:
                shares = np.outer(shares, shares).ravel()
            counts[table, : len(shares) + 1] = np.append(shares, 0.001)
    counts[ESCAPED, :N_SINGLE_SYMBOLS] = 1 / N_SINGLE_SYMBOLS
    codes = fit.codes_for(np.rint(counts * COUNTED).astype(np.int64), np.arange(N_TABLES))
    return Annex(stencils, np.full(n, STEP_CLASS), weights, np.tile(codes, (n, 1, 1)))


def use(annex: Annex) -> None:
    """Let fits build on an annex."""
    for module in (file_tables, fit, fit_stencils):
        module.annex = lambda: annex
    file_tables.tables_of.cache_clear()


# Stencils ---------------------------------------------------------------------------------------


class Pool(NamedTuple):
    """Stencils that were fitted, and what each costs each of the samples, relative to the best."""

    weights: np.ndarray
    of_weights: np.ndarray
    costs: np.ndarray
    of_costs: np.ndarray


def pools_of(cases: list[Case]) -> list[Pool]:
    """Return the stencils of each plane, and the names of the rasters that they are of."""
    pools = []
    for plane in PLANES:
        pool, names, some = [], [], []
        for name, sample in cases:
            for which in range(N_LEVEL_CLASSES):
                samples = gather(plane, sample.windows, sample.masks, which, sample.step)
                if samples is None:
                    continue
                noises = list(NOISES) if sample.step > 1 else [0.0]
                for fitted in fit_weights({(which, plane): samples}, noises):
                    for weights in fitted.values():
                        weights = weights[: N_TAPS[plane]].copy()
                        weights[missing_tap(plane)] += WHOLE - weights.sum()
                        pool.append(weights)
                        names.append(name)
                some.append((name, judged(samples), 0.0 if sample.step == 1 else NOISES[1]))
        costs = np.array(
            [
                costs_of(samples, np.array(pool), np.full(len(pool), noise)) / len(samples.goals)
                for _, samples, noise in some
            ]
        ).T
        costs = costs / fit_stencils.COST_UNIT + LEAST_COST
        # Gains at low rates count as much as those at high ones.
        costs /= costs.min(0)
        of_costs = np.array([name for name, _, _ in some])
        pools.append(Pool(np.array(pool), np.array(names), costs, of_costs))
    return pools


def chosen(pools: list[Pool], left_out: str | None) -> np.ndarray:
    """Return sets by plane: of all stencils fitted, those that together cost least."""
    found = np.zeros((len(PLANES), N_SETS, 24), dtype=np.int16)
    for index, (weights, of_weights, costs, of_costs) in enumerate(pools):
        own = of_weights != left_out
        costs = costs[own][:, of_costs != left_out]
        least = np.full(costs.shape[1], np.inf)
        for number in range(N_SETS):
            best = int(np.minimum(costs, least).sum(1).argmin())
            found[index, number, : weights.shape[1]] = weights[own][best]
            least = np.minimum(least, costs[best])
        print(PLANES[index], len(costs), costs.shape[1], f"{least.mean():.4f}", file=sys.stderr)
    return found


# Weights and frequencies ------------------------------------------------------------------------


class Coded(NamedTuple):
    """What the windows of a case told: codes of weights, and counts by class."""

    name: str
    family: int
    weights: np.ndarray
    pairs: np.ndarray
    singles: np.ndarray
    escaped: np.ndarray


def coded(case: Case) -> Coded:
    """Code the windows of a case with stencils of their own, and look at them."""
    name, sample = case
    family = family_of(sample.step)
    tables = fit._with_stencils(plain_tables(8, family), sample, map)
    seen = fit.observed(tables, sample)
    weights = fit.fit_magnitude(seen, file_tables.annex().weights[family], sample.step)
    counts = count_by_class(seen, file_tables.NUMBER_OF_CODE[weights], sample.step)
    # Of pairs of low classes, samples alone say little of those that are coded alone.
    singles = counts.singles[STEP_CLASS - 4 :].sum(0)
    pairs = counts.pairs.copy()
    grid = pairs[:, :-1].reshape(-1, 2 * PAIR_LIMIT + 1, 2 * PAIR_LIMIT + 1)
    pairs[:, :-1] = (grid + grid.transpose(0, 2, 1)).reshape(len(pairs), -1)
    pairs[:, -1] *= 2
    return Coded(name, family, weights, pairs, singles, counts.escaped)


def family_from(some: list[Coded], before: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
    """Return the cut, the weights' codes and the frequencies' codes that suit some cases."""
    counts = np.zeros((N_TABLES, N_SYMBOLS))
    for case in some:
        share = COUNTED / case.pairs.sum()
        counts[:N_CLASSES, :N_PAIR_SYMBOLS] += share * case.pairs
        counts[SINGLES : SINGLES + N_CLASSES, :N_SINGLE_SYMBOLS] += share * case.singles
        counts[ESCAPED, :N_SINGLE_SYMBOLS] += share * case.escaped[:STEP_CLASS].sum(0)
    every = np.arange(N_TABLES)

    def codes_from() -> np.ndarray:
        usual = freqs_of(before) / N_SLOTS
        return fit.codes_for(np.rint(64 * (counts + PRIOR * usual)).astype(np.int64), every)

    freqs = freqs_of(codes_from())
    rare = np.where(freqs[:STEP_CLASS] == 0, counts[:STEP_CLASS], 0).sum(0)
    for symbol in np.flatnonzero(rare):
        for side in divmod(int(symbol), 2 * PAIR_LIMIT + 1):
            counts[ESCAPED, side - PAIR_LIMIT + SINGLE_LIMIT] += rare[symbol]
    weights = np.rint(np.median([case.weights for case in some], axis=0)).astype(np.int64)
    return STEP_CLASS, weights, codes_from()


def cost_with(case: Coded, codes: np.ndarray) -> float:
    """Return what the symbols of a case cost with a family's frequencies, in bits."""
    freqs = freqs_of(codes)
    bits = np.where(freqs > 0, 12 - np.log2(np.maximum(freqs, 1)), 0)
    bits[:N_CLASSES] = np.where(
        freqs[:N_CLASSES] > 0, bits[:N_CLASSES], bits[:N_CLASSES, [N_PAIR_SYMBOLS - 1]] + 10
    )
    cost = (case.pairs[:STEP_CLASS] * bits[:STEP_CLASS, :N_PAIR_SYMBOLS]).sum()
    own = slice(SINGLES + STEP_CLASS, SINGLES + N_CLASSES)
    cost += 2 * (case.singles[STEP_CLASS:] * bits[own, :N_SINGLE_SYMBOLS]).sum()
    return float(cost)


def families_from(all_cases: list[Coded], before: Annex) -> Annex:
    """Return an annex with families that suit cases, of the stencils of another."""
    made = before._replace(
        cuts=before.cuts.copy(), weights=before.weights.copy(), codes=before.codes.copy()
    )
    for kind in range(N_STEPS):
        cases = [case for case in all_cases if case.family == kind]
        first = family_from(cases, before.codes[kind])
        alone = [family_from([case], first[2])[2] for case in cases]
        least = np.array([cost_with(case, own) for case, own in zip(cases, alone, strict=True)])
        lost = np.array([cost_with(case, first[2]) for case in cases]) / least
        best, smallest = [first, first], lost.sum()
        # The other family begins with the cases that one for all suits least.
        for n in (1, len(cases) // 4, len(cases) // 2):
            is_other = np.zeros(len(cases), dtype=bool)
            is_other[lost.argsort()[len(cases) - n :]] = True
            for _ in range(N_TURNS):
                if is_other.all() or not is_other.any():
                    break
                two = [
                    family_from([cases[k] for k in np.flatnonzero(is_other == own)], first[2])
                    for own in (False, True)
                ]
                costs = np.array([[cost_with(case, own[2]) for own in two] for case in cases])
                total = (costs.min(1) / least).sum()
                if total < smallest:
                    best, smallest, of_other = two, total, is_other
                is_other = costs[:, 1] < costs[:, 0]
        for family, own in zip((kind, kind + N_STEPS), best, strict=True):
            made.cuts[family], made.weights[family], made.codes[family] = own
        names = sorted({cases[k].name for k in np.flatnonzero(of_other)})
        print(kind, len(cases), lost.mean(), smallest / len(cases), *names, file=sys.stderr)
    return made


def main() -> None:
    """Train, and write."""
    leaves_out = "--leave-one-out" in sys.argv
    out, *paths = (Path(name) for name in sys.argv[1:] if not name.startswith("--"))
    cases = cases_of(paths)
    annex = first_annex()
    use(annex)
    pools = pools_of(cases)
    annex = annex._replace(stencils=chosen(pools, None))
    for _ in range(2):
        use(annex)
        found = [coded(case) for case in cases]
        annex = families_from(found, annex)
    (out / "rapid.bin").write_bytes(packed(annex))
    for path in paths if leaves_out else []:
        others = [case for case in found if case.name != path.stem]
        own = first_annex()._replace(stencils=chosen(pools, path.stem))
        own = families_from(others, families_from(others, own))
        (out / f"{path.stem}.bin").write_bytes(packed(own))


if __name__ == "__main__":
    main()
