"""Choose and fit the tables of a file of method `rapid` (encoder only).

A few windows of the full grid, chosen by position alone, stand for the raster. Stencils follow from
them open loop (`fit_stencils`); then they are coded as if each were a file of its own, and the
symbols counted. All in whole numbers: the same raster gives the same tables everywhere.
"""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.planes import FileStencil
from terrainwave.codec.rapid import trained
from terrainwave.codec.rapid.coder import UnitCoder
from terrainwave.codec.rapid.file_tables import (
    CODE_OF_FREQ,
    FREQ_OF_CODE,
    N_CLASSES,
    PLANES,
    FileTables,
    Tables,
    default_codes,
    default_freqs,
    rest_symbols,
)
from terrainwave.codec.rapid.fit_stencils import COST_UNIT, candidates, stencils_cost
from terrainwave.codec.rapid.fit_weights import fit_magnitude, weights_bits
from terrainwave.codec.rapid.fit_weights.samples import Counter, Seen, look_at
from terrainwave.codec.rapid.magnitude import N_CONTEXTS
from terrainwave.codec.rapid.symbols import ESCAPE, ESCAPE_BITS, N_SYMBOLS, low_bits
from terrainwave.codec.rapid.trained import N_STEPS, family_of
from terrainwave.codec.refiner import Each, GroupSpec, Heights, Mask
from terrainwave.coding.rans import N_SLOTS, SYMBOL_BITS
from terrainwave.grid.quadtree import Grid, Region
from terrainwave.grid.sample_windows import HeightsOf, MaskOf, spread_windows

# Samples a side of a window, and samples of the raster for one; from 2 to 16 windows in all.
_WINDOW = 257
_SHARE = 1 << 17
_LEAST_WINDOWS, _MOST_WINDOWS = 2, 16
# Where there are more than 4, so many samples a side of at most 4 decide on stencils.
_MOST_WHOLE, _FEW, _MOST_DECIDING = 4, 129, 4
# And at most so many on weights of features and on contexts.
_MOST_LOOKED_AT = 4
_MIN_SAMPLES = 300
_COST_OF_NONE = COST_UNIT * (11 + ESCAPE_BITS)  # of a symbol that takes an escape
_FREQ_BITS = 3
# A context starts from its trained frequencies as if it had been seen so often.
_PRIOR = 240
_RAREST = N_SLOTS * ESCAPE_BITS * 2 // 3
_SAVED_BY_REACH = 1 / 256
# Bits of the samples that a weight is fitted to, which it saves by chance.
_SAVED_BY_CHANCE = 0.5
_SAVED_BY_WEIGHTS = 1 / 1024


def fit_tables(
    grid: Grid, step: int, heights: HeightsOf, mask: MaskOf, *,
    may_have_reach: bool = True, each: Each = map,
) -> FileTables:  # fmt: skip
    """Return the tables for a raster; `heights` and `mask` return a region of a level.

    Windows are coded by `each`, side by side.
    """
    n_windows = min(max(grid.n_rows * grid.n_cols // _SHARE, _LEAST_WINDOWS), _MOST_WINDOWS)
    windows, masks = spread_windows(grid, heights, mask, _WINDOW, n_windows)
    defaults = ((FileStencil(0),) * len(PLANES),) * N_CLASSES
    tables = FileTables(grid.k_max, family_of(step), defaults, {})
    if int(np.count_nonzero(masks)) < _MIN_SAMPLES:
        return tables
    share = grid.n_rows * grid.n_cols / masks.size
    best, plain = best_tables(
        tables, windows, masks, step, share, may_have_reach=may_have_reach, each=each
    )
    whole = _Sample(windows, masks, step, share)
    fitted, cost = _fitted(best, whole, each)
    # A raster of few windows has about their sides, which may cost more than is saved inside.
    if best is not plain and len(windows) <= _MOST_WHOLE:
        other, cost_of_plain = _fitted(plain, whole, each)
        if cost + COST_UNIT * weights_bits(best.weights) >= cost_of_plain:
            return other
    return fitted


def best_tables(
    tables: FileTables,
    windows: Heights,
    masks: Mask,
    step: int,
    share: float,
    *,
    may_have_reach: bool = True,
    each: Each = map,
) -> tuple[FileTables, FileTables]:
    """Return tables with the stencils, then the family, that make parts of the windows smallest.

    And the best of those without weights of features of their own, which may be the same.
    """
    every = np.s_[:: -(-len(windows) // _MOST_DECIDING)]
    few = (every, *np.s_[:_FEW, :_FEW]) if len(windows) > _MOST_WHOLE else (every,)
    some = _Sample(windows[few], masks[few], step, share * windows.size / windows[few].size, True)
    least = np.inf
    for stencils in dict.fromkeys(candidates(windows, masks, step, share, each)):
        other = tables._replace(stencils=stencils)
        cost = _fitted(other, some, each)[1]
        if cost < least:
            best, least = other, cost
    return _with_contexts(
        best, _look(best, _Sample(windows, masks, step, share), each), may_have_reach
    )


class _Looked(NamedTuple):
    """Samples of windows that were coded, what counts their symbols, and what they stand for.

    `share` is how many samples of the raster one that is counted stands for, `alone` how many one
    of those that weights are fitted to.
    """

    seen: Seen
    counter: Counter
    step: int
    share: float
    alone: float
    each: Each

    def costs(self, tables: list[FileTables]) -> list[float]:
        """Return about what the file costs with each of these tables (`cost`)."""
        return list(self.each(self.cost, tables))

    def cost(self, tables: FileTables) -> float:
        """Return about what the file costs with tables of the same stencils, in 1/64 bit."""
        cost = fit_codes(tables.family, self.counter.counts(Tables(tables)), self.share)[1]
        if tables.weights is None:
            return cost
        # Some of what they save of the samples that they were fitted to is chance.
        by_chance = _SAVED_BY_CHANCE * tables.weights.size * self.alone
        return cost + COST_UNIT * (weights_bits(tables.weights) + by_chance)


def _look(tables: FileTables, sample: "_Sample", each: Each) -> _Looked:
    """Code some of the windows with tables and look at their samples."""
    every = np.s_[:: -(-len(sample.windows) // _MOST_LOOKED_AT)]
    windows, masks, read = sample.windows[every], sample.masks[every], Tables(tables)
    if sample.step > 1:
        some = _Sample(windows, masks, sample.step, sample.share, is_inner=True)
        windows = np.stack(_coded(read, some, each)[1])
    seen = look_at(windows, masks, read, sample.step, each)
    counter = Counter(seen, sample.step)
    n_samples = sample.share * sample.windows.size / windows.size * np.count_nonzero(masks)
    share, alone = (n_samples / max(n, 1) for n in (counter.n_counted, counter.n_samples))
    return _Looked(seen, counter, sample.step, share, alone, each)


def _with_contexts(
    tables: FileTables, looked: _Looked, may_have_reach: bool
) -> tuple[FileTables, FileTables]:
    """Return tables with the family, and the weights, by which the file gets smallest.

    And the best of those without weights of their own.
    """
    families = _families(tables)[: 4 if may_have_reach else 2]
    plain, featured, *by_reach = looked.costs([tables._replace(family=own) for own in families])
    # Other features, then what takes a reader of format 1.1: other contexts, which take a little
    # longer to decode, and weights of the file's own.
    has_others = featured < plain
    best, least = tables._replace(family=families[has_others]), min(plain, featured)
    if may_have_reach:
        cost = by_reach[has_others]
        if cost < least * (1 - _SAVED_BY_REACH):
            best, least = best._replace(family=families[2 + has_others]), cost
        return _with_weights(best, least, looked), best
    return best, best


def _families(tables: FileTables) -> list[int]:
    """Return the families of a step: with each table of features by the mean, then by reach."""
    first, reach = tables.family % N_STEPS, trained.N_FAMILIES
    return [first, first + N_STEPS, first + reach, first + N_STEPS + reach]


def _with_weights(tables: FileTables, least: float, looked: _Looked) -> FileTables:
    """Return tables with weights of features of their own if the file costs less than `least`.

    With the trained frequencies and contexts that suit them; of all classes, or the finest alone.
    """
    weights = fit_magnitude(looked.seen, Tables(tables), looked.step)
    if weights is None:
        return tables
    best, smallest, reach = tables, np.inf, trained.N_FAMILIES
    families = _families(tables)
    for some_classes in ((N_CLASSES,), (2, 1)):
        others = [
            tables._replace(family=family, weights=weights[:n_classes])
            for n_classes in some_classes
            for family in families
        ]
        for other, cost in zip(others, looked.costs(others), strict=True):
            if tables.family >= reach:  # the file takes a reader of format 1.1 anyway
                most = least
            else:
                is_more = other.family >= reach
                most = least * (1 - (_SAVED_BY_REACH if is_more else _SAVED_BY_WEIGHTS))
            if cost < min(most, smallest):
                best, smallest = other, cost
        families = [best.family]
    return best


class _Sample(NamedTuple):
    """Windows of a raster, the step, and how many samples of the raster one of theirs stands for.

    `windows` and `masks` have the shape (n, n_rows, n_cols).
    """

    windows: Heights
    masks: Mask
    step: int
    share: float
    is_inner: bool = False


def _fitted(tables: FileTables, sample: _Sample, each: Each) -> tuple[FileTables, float]:
    """Return tables with frequencies, and about what the file costs with them, in 1/64 bit."""
    symbols = _coded(Tables(tables), sample, each)[0]
    share = sample.share * np.count_nonzero(sample.masks) / max(int(symbols.sum()), 1)
    codes, cost = fit_codes(tables.family, symbols, share)
    return tables._replace(codes=codes), cost + stencils_cost(tables.stencils)


# Counts and frequencies -------------------------------------------------------------------------


def count(
    tables: FileTables, windows: Heights, masks: Mask, step: int, *,
    is_inner: bool = False, each: Each = map,
) -> NDArray[np.int64]:  # fmt: skip
    """Code windows; return how often each symbol came: shape (N_CONTEXTS, N_SYMBOLS)."""
    return _coded(Tables(tables), _Sample(windows, masks, step, 1.0, is_inner), each)[0]


def _coded(
    tables: Tables, sample: "_Sample", each: Each
) -> tuple[NDArray[np.int64], list[Heights]]:
    """Code windows as root blocks; return how often each symbol came, and the decoded heights."""
    coder = UnitCoder(tables)

    def code(window: tuple[Heights, Mask]) -> tuple[NDArray[np.int64], Heights]:
        target, mask = window
        counts = np.zeros((2, N_CONTEXTS << SYMBOL_BITS), dtype=np.int64)
        if not mask.any():  # fills alone, which may be far from all heights
            return counts, target
        low, high = int(target.min()), int(target.max())
        spec = GroupSpec.alone(Region(0, 0, *target.shape), sample.step, low, high)
        spec = replace(spec, level=tables.k_max)
        whole = None if mask.all() else mask
        return counts, coder.count(spec, target, whole, counts, is_inner=sample.is_inner)

    found = list(each(code, list(zip(sample.windows, sample.masks, strict=True))))
    counts = np.add.reduce([own for own, _ in found]).sum(0)
    by_context = counts.reshape(N_CONTEXTS, 1 << SYMBOL_BITS)[:, :N_SYMBOLS]
    return np.ascontiguousarray(by_context), [heights for _, heights in found]


@cache
def _cost_table() -> NDArray[np.int64]:
    """Return -64 log2 of frequencies, rounded; none lies so near a half that machines differ."""
    freqs = np.arange(1, N_SLOTS + 1)
    costs = np.rint(COST_UNIT * (np.log2(N_SLOTS) - np.log2(freqs))).astype(np.int64)
    return np.concatenate([[_COST_OF_NONE], costs])


@cache
def _raw_bits() -> NDArray[np.int64]:
    """Return how many low bits of a detail are raw, by context."""
    return np.array([low_bits(context) for context in range(N_CONTEXTS)], dtype=np.int64)


def fit_codes(
    family: int, counts: NDArray[np.int64], share: float
) -> tuple[dict[int, NDArray[np.int64]], float]:
    """Return the codes of the contexts whose own frequencies are worth their bytes, and the cost.

    The cost is about that of the whole file in 1/64 bit, `share` times what was counted.
    """
    usual = default_freqs(family)
    codes = codes_for(counts * N_SLOTS + _PRIOR * usual, family)
    freqs = FREQ_OF_CODE[codes]
    rest = rest_symbols(family)
    every = np.arange(N_CONTEXTS)
    freqs[every, rest] = 0
    freqs[every, rest] = N_SLOTS - freqs.sum(1)
    before, after = ((counts * _cost_table()[f]).sum(1) * share for f in (usual, freqs))
    changes = np.abs(codes - default_codes(family))
    sizes = np.frexp(changes.astype(np.float64))[1]  # bits of each change
    n_bits = 2 + np.where(changes == 0, 1, 1 + _FREQ_BITS + sizes).sum(1)
    after = after + COST_UNIT * n_bits
    is_own = (counts.sum(1) > 0) & (before > after)
    n_escapes = counts[:, ESCAPE]
    n_raw = ((counts.sum(1) - n_escapes) * _raw_bits() + n_escapes * ESCAPE_BITS).sum()
    cost = float(np.cumsum(np.where(is_own, after, before))[-1] + n_raw * COST_UNIT * share)
    return {int(context): codes[context] for context in np.flatnonzero(is_own)}, cost


def codes_for(weights: NDArray[np.int64], family: int) -> NDArray[np.int64]:
    """Return codes of frequencies in proportion to `weights`, of each context N_SLOTS in all."""
    rest = rest_symbols(family)
    every = np.arange(N_CONTEXTS)
    total = np.maximum(weights.sum(1, keepdims=True), 1)
    freqs = (2 * weights * N_SLOTS + total) // (2 * total)
    # A symbol that comes once in so many is cheaper with the least frequency than by escapes: it
    # saves their bits and costs the others 1.44 / N_SLOTS each.
    freqs = np.maximum(freqs, weights * _RAREST > total)
    freqs[:, ESCAPE] = np.maximum(freqs[:, ESCAPE], 1)
    codes = CODE_OF_FREQ[np.minimum(freqs, N_SLOTS - 1)]
    codes[every, rest] = 0
    for context in np.flatnonzero(FREQ_OF_CODE[codes].sum(1) > N_SLOTS - 1):
        while FREQ_OF_CODE[codes[context]].sum() > N_SLOTS - 1:
            codes[context, codes[context].argmax()] -= 1
    codes[every, rest] = default_codes(family)[every, rest]
    return codes
