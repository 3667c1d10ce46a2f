"""Choose and fit the tables of a file of method `rapid` (encoder only).

A few windows of the full grid, chosen by position alone, are coded as if each were a file of its
own: that gives the errors of real decoded heights on all levels. Stencils are chosen plane by plane
among trained and fitted ones, then frequencies are counted. Floats are summed in a fixed order and
used for choices; the same raster gives the same tables everywhere.
"""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec import rapid_tables
from terrainwave.codec.fitting import fit_weights, gather_window, stencil_cost
from terrainwave.codec.lattice import parity, plane_sizes
from terrainwave.codec.rapid import Rapid
from terrainwave.codec.rapid_code import ESCAPE, ESCAPE_BITS, N_SYMBOLS, low_bits
from terrainwave.codec.rapid_layout import CORES, TAPS
from terrainwave.codec.rapid_magnitude import N_CONTEXTS
from terrainwave.codec.rapid_parameters import (
    N_CLASSES,
    PLANES,
    SHIFTS,
    FileStencil,
    FileTables,
    Tables,
    code_of,
    default_codes,
    default_freqs,
    freq_of,
    freqs_of,
    missing_tap,
    pack_parameters,
    rest_symbol,
    weights_of,
)
from terrainwave.codec.rapid_tables import N_FAMILIES, N_STEPS, family_of
from terrainwave.codec.refiner import GroupSpec, Heights, Mask, Sides
from terrainwave.coding.rans import N_SLOTS
from terrainwave.grid.quadtree import Grid, Region

_WINDOW = 257
_MOST_A_SIDE = 6  # windows: 36 in all
_MOST_TRIED = 12  # of them try stencils
_CLASS_DEPTHS = ((0,), (1,), (2,), (3, 4))
_MIN_SAMPLES, _MAX_SAMPLES, _MAX_JUDGED = 300, 6000, 2000
_MARGIN_WORTH = 1.5
_N_TURNS = 3
_MAX_WANTED = 28000
# Variances of the noise of decoded heights, in steps squared: that of uniform noise within
# ±0.12, ±0.25 and ±0.4 step.
_NOISES = (0.0048, 0.0208, 0.0533)
# Costs are in 1/64 bit; those of `stencil_cost` in 1/16.
_COST_UNIT = 64
_COST_OF_NONE = _COST_UNIT * (11 + ESCAPE_BITS)  # of a symbol that takes an escape
_TAP_BITS, _FREQ_BITS = 5, 3
# A context starts from its trained frequencies as if it had been seen so often.
_PRIOR = 24
_RAREST = N_SLOTS * ESCAPE_BITS * 2 // 3
_NOT_SHARED = Sides(False, False, False, False)


class Window(NamedTuple):
    """A part of the full grid that stands for the raster."""

    target: Heights
    mask: Mask


class _Counts(NamedTuple):
    """What windows cost, by class and plane, and how often each symbol came in each context."""

    costs: NDArray[np.int64]
    symbols: NDArray[np.int64]


def fit_tables(
    grid: Grid,
    step: int,
    heights: Callable[[int, Region], Heights],
    mask: Callable[[int, Region], Mask],
) -> FileTables:
    """Return the tables for a raster; `heights` and `mask` return a region of a level."""
    windows = [Window(*found) for found in spread_windows(grid, heights, mask) if found[1].any()]
    n_coded = sum(int(np.count_nonzero(window.mask)) for window in windows)
    plain = ((FileStencil(0),) * len(PLANES),) * N_CLASSES
    tables = FileTables(grid.k_max, family_of(step), plain, {})
    if n_coded < _MIN_SAMPLES:
        return tables
    share = grid.n_rows * grid.n_cols / sum(window.mask.size for window in windows)
    few = windows[:: -(-len(windows) // _MOST_TRIED)]
    tables = choose_stencils(tables, few, step, share * len(windows) / len(few))
    found = []
    for family in range(family_of(step), N_FAMILIES, N_STEPS):
        other = tables._replace(family=family)
        symbols = count(other, windows, step).symbols
        other = other._replace(codes=fit_codes(family, symbols, share))
        n_bits = 8 * len(pack_parameters(other))
        cost = int((symbols * prices(other)).sum()) * share + _COST_UNIT * n_bits
        found.append((cost, family, other))
    return min(found)[2]


def spread_windows(
    grid: Grid,
    heights: Callable[[int, Region], Heights],
    mask: Callable[[int, Region], Mask],
) -> list[tuple[Heights, Mask]]:
    """Return windows of the full grid, spread evenly; small rasters are covered."""
    found = []
    at = []
    for n in (grid.n_rows, grid.n_cols):
        count_ = min(_MOST_A_SIDE, -(-n // _WINDOW))
        rest = max(n - _WINDOW, 0)
        at.append(
            [rest * (2 * i + 1) // (2 * count_) for i in range(count_)]
            if count_ * _WINDOW < n
            else [rest * i // max(count_ - 1, 1) for i in range(count_)]
        )
    for row in at[0]:
        for col in at[1]:
            region = Region(
                row, col, min(_WINDOW, grid.n_rows - row), min(_WINDOW, grid.n_cols - col)
            )
            found.append(
                (
                    np.ascontiguousarray(heights(grid.k_max, region), dtype=np.int32),
                    np.ascontiguousarray(mask(grid.k_max, region), dtype=np.bool_),
                )
            )
    return found


# Stencils ---------------------------------------------------------------------------------------


def choose_stencils(
    tables: FileTables, windows: list[Window], step: int, share: float
) -> FileTables:
    """Return tables with the stencils that cost least.

    `share`: how many times the windows' samples the file has.
    """
    samples = {
        (which, plane): gather(plane, windows, depths, step)
        for which, depths in enumerate(_CLASS_DEPTHS)
        for plane in PLANES
    }
    noises = _NOISES if step > 1 else (0.0,)
    trained = _stencils(lambda key: _best_trained(key[1], samples[key], noises[0]))
    tried = [trained]
    for noise in noises:
        fitted = {
            key: fit_stencil(key[1], trained[key[0]][key[1] - 1].base, found, noise, share)
            for key, found in samples.items()
        }
        if any(fitted.values()):
            tried.append(
                _stencils(lambda key, f=fitted: f[key] or trained[key[0]][key[1] - 1])  # type: ignore[misc]
            )
    # What symbols cost with frequencies of their own, as far as trained stencils tell.
    first = count(tables._replace(stencils=trained), windows, step)
    paid = prices(tables._replace(codes=fit_codes(tables.family, first.symbols, share)))
    counts = [count(tables._replace(stencils=s), windows, step, paid) for s in tried]
    totals = [_total(found, row, share) for found, row in zip(counts, tried, strict=True)]
    best = np.argmin(totals, axis=0)
    mixed = _stencils(lambda key: tried[int(best[key[0], key[1] - 1])][key[0]][key[1] - 1])
    # Planes lean on those before: a mixture may do worse than what it was made of.
    tried.append(mixed)
    found = count(tables._replace(stencils=mixed), windows, step, paid)
    totals.append(_total(found, mixed, share))
    best = np.argmin(np.sum(totals, axis=2), axis=0)
    mixed = tuple(tried[int(best[which])][which] for which in range(N_CLASSES))
    return tables._replace(stencils=mixed)


def _stencils(
    of: Callable[[tuple[int, int]], FileStencil],
) -> tuple[tuple[FileStencil, ...], ...]:
    return tuple(tuple(of((which, plane)) for plane in PLANES) for which in range(N_CLASSES))


def _total(
    counts: _Counts, stencils: tuple[tuple[FileStencil, ...], ...], share: float
) -> NDArray[np.float64]:
    """Return what each class and plane costs in the file, its stencil included."""
    return counts.costs * share + _COST_UNIT * _MARGIN_WORTH * _bits_of(stencils)


def _bits_of(stencils: tuple[tuple[FileStencil, ...], ...]) -> NDArray[np.int64]:
    """Return about how many bits stencils take in the parameters."""
    return np.array([[stencil_bits(stencil) for stencil in row] for row in stencils])


def stencil_bits(stencil: FileStencil) -> int:
    """Return about how many bits a stencil's deltas take."""
    return sum(2 + abs(delta).bit_length() for delta in stencil.deltas)


class Samples(NamedTuple):
    """Taps less the core's mean, shape (n, taps), what they are to predict, in steps; the share."""

    taps: NDArray[np.float64]
    goals: NDArray[np.float64]
    every: float


def gather(plane: int, windows: list[Window], depths: tuple[int, ...], step: int) -> Samples | None:
    """Collect samples of a plane from windows at depths below the full grid."""
    taps, core = _offsets(plane, TAPS[plane]), _offsets(plane, CORES[plane])
    parts = [
        [np.ascontiguousarray(array[:: 1 << d, :: 1 << d]) for array in (target, mask)]
        for d in depths
        for target, mask in windows
    ]
    n_places = sum(part[0].size >> 2 for part in parts)
    every = max(1, n_places // _MAX_SAMPLES)
    rows = np.empty((n_places // every + 1, taps.shape[0]), dtype=np.float64)
    goals = np.empty(rows.shape[0], dtype=np.float64)
    n_found = place = 0
    own = np.array(parity(plane), dtype=np.int64)
    for target, mask in parts:
        n_found, place = gather_window(
            target, mask, own, taps, core, every, 1.0 / step, rows, goals, n_found, place
        )
    if n_found < _MIN_SAMPLES:
        return None
    return Samples(rows[:n_found], goals[:n_found], float(every))


def _offsets(plane: int, taps: tuple[tuple[int, int, int], ...]) -> NDArray[np.int64]:
    """Return (plane, row, column) in planes as offsets in the lattice."""
    row, col = parity(plane)
    return np.array(
        [(2 * r + parity(p)[0] - row, 2 * c + parity(p)[1] - col) for p, r, c in taps],
        dtype=np.int64,
    )


def _best_trained(plane: int, samples: Samples | None, noise: float) -> FileStencil:
    """Return the trained stencil that predicts best."""
    if samples is None:
        return FileStencil(0)
    judged = _judged(samples)
    costs = [
        stencil_cost(*judged, weights.astype(np.int64), noise)
        for weights in rapid_tables.STENCILS[plane]
    ]
    return FileStencil(min(range(len(costs)), key=costs.__getitem__))


def _judged(samples: Samples) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    every = max(1, len(samples.goals) // _MAX_JUDGED)
    return np.ascontiguousarray(samples.taps[::every]), samples.goals[::every].copy()


def fit_stencil(
    plane: int, base: int, samples: Samples | None, noise: float, share: float
) -> FileStencil | None:
    """Return a stencil fitted to samples; None if there are too few or it can't be stored."""
    if samples is None:
        return None
    is_core = np.array([tap in CORES[plane] for tap in TAPS[plane]], dtype=np.float64)
    solution = np.zeros(len(is_core), dtype=np.float64)
    if not fit_weights(samples.taps, samples.goals, is_core, noise, _N_TURNS, solution):
        return None
    rest = 1 - float(np.cumsum(solution)[-1])
    wanted = 4096 * (solution + is_core * (rest / 4))
    if not (np.abs(wanted) < _MAX_WANTED).all():
        return None
    trained = rapid_tables.STENCILS[plane][base]
    judged = _judged(samples)
    scale = share * samples.every * len(samples.goals) / (16 * len(judged[1]))
    best, least = None, np.inf
    for shift in SHIFTS:
        deltas = np.floor((wanted - trained) / 2**shift + 0.5).astype(np.int64)
        deltas[missing_tap(plane)] = 0
        stencil = FileStencil(base, shift, tuple(deltas.tolist()))
        if not any(stencil.deltas):
            continue
        cost = stencil_cost(*judged, weights_of(plane, stencil), noise)
        total = cost * scale + _MARGIN_WORTH * stencil_bits(stencil)
        if total < least:
            best, least = stencil, total
    return best


# Counts and frequencies -------------------------------------------------------------------------


def count(
    tables: FileTables,
    windows: list[Window],
    step: int,
    paid: NDArray[np.int64] | None = None,
) -> _Counts:
    """Code windows and return how often each symbol came, and what they cost if `paid` is given."""
    refiner = Rapid.with_tables(Tables(tables))
    costs = np.zeros(N_CLASSES * len(PLANES), dtype=np.int64)
    symbols = np.zeros(N_CONTEXTS * N_SYMBOLS, dtype=np.int64)
    for target, mask in windows:
        region = Region(0, 0, *target.shape)
        low, high = int(target[mask].min()), int(target[mask].max())
        spec = GroupSpec(
            tables.k_max, region, region, None, _NOT_SHARED, step, low, high, (1, 0), 1, 0
        )
        places, kinds = coding_order(target.shape)
        if not mask.all():
            kinds = kinds[mask.ravel()[places]]
        coded = refiner.log(spec, target, mask, len(kinds))
        symbols += np.bincount(coded, minlength=len(symbols))
        if paid is not None:
            costs += np.bincount(kinds, paid.ravel()[coded], len(costs)).astype(np.int64)
    return _Counts(costs.reshape(N_CLASSES, -1), symbols.reshape(N_CONTEXTS, N_SYMBOLS))


def prices(tables: FileTables) -> NDArray[np.int64]:
    """Return what each symbol of each context costs, raw bits included."""
    freqs = default_freqs(tables.family).copy()
    for context, codes in tables.codes.items():
        freqs[context] = freqs_of(codes, rest_symbol(tables.family, context))
    bits = _cost_of(freqs)
    raw = np.array([low_bits(context) for context in range(N_CONTEXTS)])
    bits += _COST_UNIT * raw[:, None]
    bits[:, ESCAPE] += _COST_UNIT * (ESCAPE_BITS - raw)
    escapes = np.broadcast_to(bits[:, ESCAPE : ESCAPE + 1], bits.shape)
    return np.where(freqs > 0, bits, escapes)


@cache
def _cost_table() -> NDArray[np.int64]:
    """Return -64 log2 of frequencies, rounded; none lies so near a half that machines differ."""
    freqs = np.arange(1, N_SLOTS + 1)
    costs = np.rint(_COST_UNIT * (np.log2(N_SLOTS) - np.log2(freqs))).astype(np.int64)
    return np.concatenate([[0], costs])  # of none: whatever an escape costs instead


def _cost_of(freqs: NDArray[np.int64]) -> NDArray[np.int64]:
    return _cost_table()[freqs]


@cache
def coding_order(shape: tuple[int, int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the places of a root unit's samples as they are coded, and 3·class + plane - 1."""
    stride = 1
    while stride < max(shape) - 1:
        stride *= 2
    places, kinds = [], []
    while stride > 1:
        stride >>= 1
        depth = min(stride.bit_length() - 1, N_CLASSES - 1)
        size = ((shape[0] - 1) // stride + 1, (shape[1] - 1) // stride + 1)
        sizes = plane_sizes(size)
        for t in range(sizes[0][0] + 2):
            for plane in PLANES:
                row = t + 1 - plane
                if 0 <= row < sizes[plane][0] and sizes[plane][1]:
                    first = parity(plane)
                    start = (2 * row + first[0]) * stride * shape[1] + first[1] * stride
                    cols = np.arange(sizes[plane][1], dtype=np.int64)
                    places.append(start + 2 * stride * cols)
                    kinds.append(np.full(len(cols), 3 * depth + plane - 1))
    if not places:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    return np.concatenate(places), np.concatenate(kinds)


def fit_codes(family: int, counts: NDArray[np.int64], share: float) -> dict[int, NDArray[np.int64]]:
    """Return the codes of the contexts whose own frequencies are worth their bytes."""
    found = {}
    for context in range(N_CONTEXTS):
        seen = counts[context]
        total = int(seen.sum())
        if total == 0:
            continue
        trained = default_freqs(family)[context]
        codes = codes_for(seen * N_SLOTS + _PRIOR * trained, family, context)
        rest = rest_symbol(family, context)
        before, after = (
            int((seen * np.where(freqs > 0, _cost_of(freqs), _COST_OF_NONE)).sum())
            for freqs in (trained, freqs_of(codes, rest))
        )
        changes = np.abs(codes - default_codes(family)[context])
        n_bits = 2 + sum(1 if c == 0 else 1 + _FREQ_BITS + int(c).bit_length() for c in changes)
        if (before - after) * share > _COST_UNIT * n_bits:
            found[context] = codes
    return found


def codes_for(weights: NDArray[np.int64], family: int, context: int) -> NDArray[np.int64]:
    """Return codes of frequencies in proportion to `weights`, which add up to N_SLOTS."""
    rest = rest_symbol(family, context)
    total = int(weights.sum())
    freqs = [max(int((2 * int(w) * N_SLOTS + total) // (2 * total)), 0) for w in weights]
    # A symbol that comes once in so many is cheaper with the least frequency than by escapes: it
    # saves their bits and costs the others 1.44 / N_SLOTS each.
    freqs = [
        max(freq, int(int(w) * _RAREST > total)) for freq, w in zip(freqs, weights, strict=True)
    ]
    freqs[ESCAPE] = max(freqs[ESCAPE], 1)
    codes = np.array([code_of(min(freq, N_SLOTS - 1)) for freq in freqs], dtype=np.int64)
    codes[rest] = default_codes(family)[context][rest]
    others = [symbol for symbol in range(N_SYMBOLS) if symbol != rest]
    while sum(freq_of(int(codes[symbol])) for symbol in others) > N_SLOTS - 1:
        largest = max(others, key=lambda symbol: int(codes[symbol]))
        codes[largest] -= 1
    return codes
