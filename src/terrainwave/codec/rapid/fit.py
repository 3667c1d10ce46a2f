"""Choose and fit the tables of a file (encoder only).

A few windows of the full grid, chosen by position alone, stand for the raster. Stencils follow from
them open loop (`fit_stencils`); then they are coded as if each were a file of its own, and the
symbols counted. All in whole numbers: the same raster gives the same tables everywhere.
"""

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.rapid.details import LEAST_CUT, MOST_CUT
from terrainwave.codec.rapid.file_tables import (
    EXISTS,
    LEAST,
    MOST_K,
    N_FAMILIES,
    N_KINDS_OF_STEPS,
    NUMBER_OF_CODE,
    RESTS,
    FileTables,
    annex,
    codes_of,
    family_of,
    freqs_of,
    plain_tables,
    stencils_from,
)
from terrainwave.codec.rapid.fit_stencils import COST_UNIT, candidates, stencils_cost
from terrainwave.codec.rapid.fit_weights import (
    Counts,
    Observer,
    Seen,
    count_by_class,
    fit_magnitude,
)
from terrainwave.codec.rapid.layout import N_LEVEL_CLASSES
from terrainwave.codec.rapid.symbols import (
    ESCAPED,
    N_CLASSES,
    N_SLOTS,
    N_SYMBOLS,
    N_TABLES,
    PAIR_ESCAPE,
    PAIR_LIMIT,
    SINGLE_ESCAPE,
    SINGLE_LIMIT,
    SINGLES,
    SLOT_BITS,
    STEP_CLASS,
    Frequencies,
)
from terrainwave.codec.rapid.tables import Tables
from terrainwave.codec.rapid.unit import UnitCoder
from terrainwave.codec.refiner import Each, GroupSpec, Heights, Mask
from terrainwave.grid.quadtree import Grid, Region
from terrainwave.grid.sample_windows import HeightsOf, MaskOf, spread_windows

Whole = NDArray[np.int64]
_Coder = TypeVar("_Coder", bound=UnitCoder)

# Samples a side of a window, and samples of the raster for one; from 2 to 16 windows in all.
_WINDOW = 257
_SHARE = 1 << 17
_LEAST_WINDOWS, _MOST_WINDOWS = 2, 16
# So many samples a side of at most so many windows decide on stencils.
_FEW, _MOST_DECIDING = 193, 4
_MIN_SAMPLES = 300
# Bits of what a symbol of a sample says no more, about; and of two samples of a pair without one.
_BEYOND_BITS, _ESCAPED_BITS = 11, 10
# A table starts from its trained frequencies as if it had been seen so often.
_PRIOR = 240
# Pairs as rare as this share of a slot take the escape, in hundredths.
_RARE = 45
# Bits that a code must save to be another than the trained one, and a table of its own.
_KEPT_BITS, _OWN_BITS = 3.0, 8.0


class _Sample(NamedTuple):
    """Windows of a raster, the step, and how many samples of the raster one of theirs stands for.

    `windows` and `masks` have the shape (n, n_rows, n_cols).
    """

    windows: Heights
    masks: Mask
    step: int
    share: float

    def part(self, of: Any) -> "_Sample":
        """Return some of the windows, or parts of them."""
        windows, masks = self.windows[of], self.masks[of]
        n, of_part = int(np.count_nonzero(self.masks)), int(np.count_nonzero(masks))
        return _Sample(windows, masks, self.step, self.share * n / max(of_part, 1))


def fit_tables(
    grid: Grid, step: int, heights: HeightsOf, mask: MaskOf, *, each: Each = map
) -> FileTables:
    """Return the tables for a raster; `heights` and `mask` return a region of a level.

    Windows are coded by `each`, side by side.
    """
    n_windows = min(max(grid.n_rows * grid.n_cols // _SHARE, _LEAST_WINDOWS), _MOST_WINDOWS)
    windows, masks = spread_windows(grid, heights, mask, _WINDOW, n_windows)
    if not masks.all():  # tables must not depend on heights of voids
        windows = np.stack([_filled(*window) for window in zip(windows, masks, strict=True)])
    tables = plain_tables(min(grid.k_max, MOST_K), family_of(step))
    if int(np.count_nonzero(masks)) < _MIN_SAMPLES:
        return tables
    return fit_windows(
        tables, _Sample(windows, masks, step, grid.n_rows * grid.n_cols / masks.size), each
    )


def _filled(window: Heights, mask: Mask) -> Heights:
    """Return a window whose voids have the height of the valid sample before, in raster order."""
    valid = np.flatnonzero(mask)
    if valid.size == 0:
        return np.zeros_like(window)
    last = np.searchsorted(valid, np.arange(mask.size), side="right") - 1
    return window.ravel()[valid[np.maximum(last, 0)]].reshape(window.shape)


def fit_windows(tables: FileTables, sample: _Sample, each: Each = map) -> FileTables:
    """Return tables fitted to windows, from those of a family on."""
    return with_weights(_with_stencils(tables, sample, each), sample, each)


def _with_stencils(tables: FileTables, sample: _Sample, each: Each) -> FileTables:
    """Return tables with the stencils that make parts of the windows smallest."""
    every = -(-len(sample.windows) // _MOST_DECIDING)
    some = sample.part(np.s_[::every, :_FEW, :_FEW])
    tried = dict.fromkeys(candidates(sample.windows, sample.masks, sample.step, sample.share, each))
    best, least = tables, np.inf
    for stencils in tried:
        other = tables._replace(stencils=stencils)
        cost = fit_codes(other, count(other, some, each), some.share)[1] + stencils_cost(stencils)
        if cost < least:
            best, least = other, cost
    return best


def with_weights(tables: FileTables, sample: _Sample, each: Each = map) -> FileTables:
    """Return tables with the family, weights, cut and frequencies that make windows smallest."""
    seen = observed(tables, sample, each)
    tables = tables._replace(weights=fit_magnitude(seen, tables.weights, sample.step))
    by_class = count_by_class(seen, NUMBER_OF_CODE[tables.weights], sample.step)
    least = np.inf
    for family in range(tables.family, N_FAMILIES, N_KINDS_OF_STEPS):
        other = tables._replace(family=family, cut=best_cut(by_class, family))
        codes, cost = fit_codes(other, counts_of(by_class, other.cut), sample.share)
        if cost < least:
            best, least = other._replace(codes=codes), cost
    return best


def observed(tables: FileTables, sample: _Sample, each: Each = map) -> list[Seen]:
    """Code windows; return what was seen of their samples."""
    coded = _coded(Observer, tables, sample, each)
    return [seen for coder, _ in coded for seen in coder.samples]


# Counts -----------------------------------------------------------------------------------------


def _for_counts(tables: FileTables) -> Tables:
    """Return tables by which encoders log symbols: every pair has one."""
    every, none = EXISTS.astype(np.uint32), np.zeros(1, dtype=np.uint32)
    weights = NUMBER_OF_CODE[tables.weights]
    frequencies = Frequencies(tables.cut, none, every, every)
    return Tables(tables.k_max, stencils_from(tables), weights, frequencies)


def _coded(
    kind: type[_Coder], tables: FileTables, sample: _Sample, each: Each
) -> list[tuple[_Coder, Whole]]:
    """Code windows as groups; return the coder and the counts of symbols of each.

    One group of each class of levels, the first from the window's own heights.
    """
    read = _for_counts(tables)

    def code(window: tuple[Heights, Mask]) -> tuple[_Coder, Whole]:
        (whole, valid), coder = window, kind(read)
        counts = np.zeros((N_TABLES, N_SYMBOLS), dtype=np.int64)
        if not valid.any():  # fills alone, which may be far from all heights
            return coder, counts
        low, high = int(whole.min()), int(whole.max())
        is_full = bool(valid.all())
        above = np.ascontiguousarray(whole[:: 1 << N_LEVEL_CLASSES, :: 1 << N_LEVEL_CLASSES])
        for depth in range(N_LEVEL_CLASSES - 1, -1, -1):
            part = np.s_[:: 1 << depth, :: 1 << depth]
            target, mask = whole[part], None if is_full else valid[part]
            spec = GroupSpec.alone(Region(0, 0, *target.shape), sample.step, low, high)
            spec = replace(spec, level=tables.k_max - depth)
            above = coder.count(spec, above, target, mask, counts)
        return coder, counts

    return list(each(code, list(zip(sample.windows, sample.masks, strict=True))))


def count(tables: FileTables, sample: _Sample, each: Each = map) -> Whole:
    """Code windows; return how often each symbol came: shape (N_TABLES, N_SYMBOLS)."""
    total: Whole = np.add.reduce([own for _, own in _coded(UnitCoder, tables, sample, each)])
    return total


def counts_of(counts: Counts, cut: int) -> Whole:
    """Return how often each symbol comes with a cut, as `count` does."""
    found = np.zeros((N_TABLES, N_SYMBOLS), dtype=np.int64)
    found[:cut, : PAIR_ESCAPE + 1] = counts.pairs[:cut]
    found[SINGLES : SINGLES + N_CLASSES, : SINGLE_ESCAPE + 1] = counts.singles[cut:].sum(0)
    found[ESCAPED, : SINGLE_ESCAPE + 1] = counts.escaped[:cut].sum(0)
    return found


def best_cut(counts: Counts, family: int) -> int:
    """Return the cut by which symbols cost least with the frequencies of a family."""
    costs = _cost_table()[trained_freqs(family)]
    costs[:N_CLASSES] = np.where(
        trained_freqs(family)[:N_CLASSES] > 0, costs[:N_CLASSES], _cost_of_none(costs)[:, None]
    )
    of_pairs = (counts.pairs * costs[:N_CLASSES, : PAIR_ESCAPE + 1]).sum(1)
    escaped = costs[ESCAPED, : SINGLE_ESCAPE + 1].copy()
    escaped[SINGLE_ESCAPE] += COST_UNIT * _BEYOND_BITS
    of_pairs += (counts.escaped * escaped).sum(1)
    singles = costs[SINGLES : SINGLES + N_CLASSES, : SINGLE_ESCAPE + 1].copy()
    singles[:, SINGLE_ESCAPE] += COST_UNIT * _BEYOND_BITS
    singles += COST_UNIT * _raw_bits()[SINGLES : SINGLES + N_CLASSES, None]
    of_singles = (counts.singles * singles).sum((1, 2))
    totals = np.concatenate([[0], np.cumsum(of_pairs - of_singles)])
    return LEAST_CUT + int(totals[LEAST_CUT : MOST_CUT + 1].argmin())


# Frequencies ------------------------------------------------------------------------------------


@cache
def _cost_table() -> Whole:
    """Return -64 log2 of frequencies, rounded, by whole numbers alone: of 0 it is 0."""
    # The digits of f ** 128 are 128 log2 f, rounded down, and one.
    halves = [(freq ** (2 * COST_UNIT)).bit_length() for freq in range(1, N_SLOTS + 1)]
    return np.array([0, *(COST_UNIT * SLOT_BITS - n // 2 for n in halves)])


@cache
def _raw_bits() -> Whole:
    """Return how many raw bits the samples of a table have."""
    classes = np.arange(N_TABLES) - SINGLES
    is_single = (classes >= 0) & (classes < N_CLASSES)
    return np.where(is_single, np.maximum(classes - (STEP_CLASS + 4), 0) >> 1, 0)


def _cost_of_none(costs: Whole) -> Whole:
    """Return about what a pair without a symbol costs, by class of pairs."""
    return costs[:N_CLASSES, PAIR_ESCAPE] + COST_UNIT * _ESCAPED_BITS


def trained_freqs(family: int) -> Whole:
    """Return the frequencies of a family, shape (N_TABLES, N_SYMBOLS)."""
    return freqs_of(annex().codes[family])


def fit_codes(tables: FileTables, counts: Whole, share: float) -> tuple[dict[int, Whole], float]:
    """Return the codes of the tables whose own frequencies are worth their bytes, and the cost.

    The cost is about that of the whole file in 1/64 bit, `share` times what was counted.
    """
    counts = counts.copy()
    usual = annex().codes[tables.family]
    pairs_and_singles = np.flatnonzero(counts.any(1) & (np.arange(N_TABLES) != ESCAPED))
    codes, freqs, cost = _own_codes(usual, counts, pairs_and_singles, share)
    # Pairs without a slot come as two samples.
    pairs = pairs_and_singles < tables.cut
    for row, table in zip(freqs[pairs], pairs_and_singles[pairs].tolist(), strict=True):
        for symbol in np.flatnonzero((row == 0) & (counts[table] > 0)):
            for side in divmod(int(symbol), 2 * PAIR_LIMIT + 1):
                counts[ESCAPED, side - PAIR_LIMIT + SINGLE_LIMIT] += counts[table, symbol]
    escaped = np.flatnonzero(counts.any(1) & (np.arange(N_TABLES) == ESCAPED))
    own, _, more = _own_codes(usual, counts, escaped, share)
    n_beyond = counts[SINGLES:, SINGLE_ESCAPE].sum()
    n_raw = (counts.sum(1) * _raw_bits()).sum() + n_beyond * _BEYOND_BITS
    return {**codes, **own}, cost + more + float(n_raw) * COST_UNIT * share


def _own_codes(
    usual: Whole, counts: Whole, tables: Whole, share: float
) -> tuple[dict[int, Whole], Whole, float]:
    """Return the codes of tables that are worth their bytes, the frequencies of all, and costs."""
    counts, usual = counts[tables], usual[tables]
    usual_freqs = freqs_of(usual, tables)
    weights = counts * N_SLOTS + _PRIOR * usual_freqs
    codes = _near_usual(codes_for(weights, tables), usual, usual_freqs, counts, tables, share)
    freqs = freqs_of(codes, tables)
    changes = np.abs(codes - usual)
    sizes = np.frexp(changes.astype(np.float64))[1]  # bits of each change
    n_bits = _OWN_BITS + np.where(changes == 0, 0.25, 2 + sizes + _KEPT_BITS / 2).sum(1)
    before, after = (_cost(own, counts, tables) * share for own in (usual_freqs, freqs))
    after = after + COST_UNIT * n_bits
    is_own = before > after
    cost = float(np.cumsum(np.append(np.where(is_own, after, before), 0.0))[-1])
    found = {int(tables[k]): codes[k] for k in np.flatnonzero(is_own)}
    return found, np.where(is_own[:, None], freqs, usual_freqs), cost


def _cost(freqs: Whole, counts: Whole, tables: Whole) -> Whole:
    """Return what the symbols of tables cost; pairs without a slot that of the escape and more."""
    costs = _cost_table()[freqs]
    of_none = costs[:, PAIR_ESCAPE] + COST_UNIT * _ESCAPED_BITS
    costs = np.where((freqs == 0) & (tables < SINGLES)[:, None], of_none[:, None], costs)
    total: Whole = (counts * costs).sum(1)
    return total


def _near_usual(
    codes: Whole, usual: Whole, usual_freqs: Whole, counts: Whole, tables: Whole, share: float
) -> Whole:
    """Return codes; those that save less than their change costs stay the usual ones."""
    freqs = np.maximum(NUMBER_OF_CODE[codes] + LEAST[tables], 1).astype(np.float64)
    apart = (usual_freqs - freqs) / freqs
    saved = counts * (apart * apart * 0.72)
    totals = counts.sum(1)[:, None] / N_SLOTS
    saved = np.where(codes == 0, totals * (usual_freqs * 1.44), saved)
    saved = np.where(usual_freqs == 0, counts * 8.0, saved)
    return _fitting(np.where(saved * share < _KEPT_BITS, usual, codes), tables)


def codes_for(weights: Whole, tables: Whole) -> Whole:
    """Return codes of frequencies in proportion to `weights`, of each table N_SLOTS in all."""
    total = np.maximum(weights.sum(1, keepdims=True), 1)
    # Weights are at most 2**45 or so.
    freqs = (weights * N_SLOTS + total * (100 - _RARE) // 100) // total
    return _fitting(codes_of(np.maximum(freqs - LEAST[tables], 0)), tables)


def _fitting(codes: Whole, tables: Whole) -> Whole:
    """Return codes that leave their rest symbols something: the largest ones are less."""
    codes = np.where(EXISTS[tables], codes, 0)
    every = np.arange(len(codes))
    codes[every, RESTS[tables]] = 0
    sums = (NUMBER_OF_CODE[codes] + LEAST[tables]).sum(1)
    for k in np.flatnonzero(sums >= N_SLOTS):
        while (NUMBER_OF_CODE[codes[k]] + LEAST[tables[k]]).sum() >= N_SLOTS:
            codes[k, codes[k].argmax()] -= 1
    return codes
