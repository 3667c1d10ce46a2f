"""Train the tables of the `rapid` method from a directory of rasters.

    python tools/train_rapid.py DIRECTORY > src/terrainwave/codec/rapid/trained.py
    python tools/train_rapid.py DIRECTORY --reach > src/terrainwave/codec/rapid/trained_reach.py

Stencils are fitted to each raster, bound, class of levels and plane, and those kept that together
serve all of them best; frequencies are counted in windows coded with them. Weights of the expected
magnitude are those of `FEATURES` here: non-negative least squares over the same rasters
(reference: rapid_codec.md; per class HH, HL, LH, then lines).
"""

import base64
import sys
import zlib
from pathlib import Path
from types import ModuleType

import numpy as np
import rasterio

from terrainwave.codec.planes import WHOLE, FileStencil
from terrainwave.codec.rapid import file_tables as rapid_parameters
from terrainwave.codec.rapid import trained as rapid_tables
from terrainwave.codec.rapid import trained_reach as rapid_reach_tables
from terrainwave.codec.rapid.file_tables import (
    N_CLASSES,
    PLANES,
    FileTables,
    missing_tap,
)
from terrainwave.codec.rapid.fit import best_tables, codes_for, count
from terrainwave.codec.rapid.fit_stencils import COST_UNIT, costs_of, fit_weights, gather, judged
from terrainwave.codec.rapid.layout import TAPS
from terrainwave.codec.rapid.magnitude import N_CONTEXTS

# Not those that sizes are measured on.
RASTERS = (
    "srtm1_olympic_peninsula.tif",
    "srtm3_pyrenees_catalonia.tif",
    "srtm3_swiss_alps_N46E008.tif",
    "srtm3_coast_mountains_N49W124_W123.tif",
    "etopo5_global_5arcmin.tif",
    "mars_mola_megdr_4ppd.tif",
    "jacksboro_fault.tif",
    "lidar_santacruz_pozo_4m.tif",
)
BOUNDS = (0, 1, 2, 3, 5, 10, 30)
WINDOW, MAX_WINDOWS = 257, 6
N_SETS = 12
NOISES = (0.0048, 0.0208, 0.0533)  # of ±0.12, ±0.25 and ±0.4 step, in steps squared
LEAST = 1 / 16  # of a cost, in bits a sample: what is predicted well counts little


def windows_of(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Return windows spread over a raster, heights less their middle, and masks; None if void."""
    with rasterio.open(path) as dataset:
        heights = dataset.read(1).astype(np.float64)
        mask = dataset.read_masks(1) > 0
    quantum = 0.1 if "lidar" in path.name else 1.0
    heights = np.where(mask & np.isfinite(heights), heights / quantum, 0.0)
    target = np.rint(heights).astype(np.int32)
    target -= int(np.median(target[mask]))
    n_rows, n_cols = (max(1, min(3, n // WINDOW)) for n in target.shape)
    found = []
    for i in range(n_rows):
        for j in range(n_cols):
            row = max(0, target.shape[0] - WINDOW) * (2 * i + 1) // (2 * n_rows)
            col = max(0, target.shape[1] - WINDOW) * (2 * j + 1) // (2 * n_cols)
            at = np.s_[row : row + WINDOW, col : col + WINDOW]
            if mask[at].mean() > 0.5 and np.ptp(target[at][mask[at]]) > 20:
                found.append((target[at], mask[at]))
    found = found[:: max(1, len(found) // MAX_WINDOWS)][:MAX_WINDOWS]
    if not found:
        return None
    return np.stack([one for one, _ in found]), np.stack([valid for _, valid in found])


def plain_tables(step: int) -> FileTables:
    """Return tables without anything of a file's own."""
    plain = ((FileStencil(0),) * len(PLANES),) * N_CLASSES
    return FileTables(0, rapid_tables.family_of(step), plain, {})


def train_stencils(windows: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[int, np.ndarray]:
    """Return sets by plane: of all stencils fitted, those that together cost least."""
    chosen = {}
    for plane in PLANES:
        pool, some = [], []
        for name, found in windows.items():
            for bound in BOUNDS:
                step = 2 * bound * (10 if "lidar" in name else 1) + 1
                for which in range(N_CLASSES):
                    samples = gather(plane, *found, which, step)
                    if samples is None:
                        continue
                    noises = list(NOISES) if step > 1 else [0.0]
                    for fitted in fit_weights({(which, plane): samples}, noises):
                        pool += [weights[: len(TAPS[plane])] for weights in fitted.values()]
                    some.append((judged(samples), 0.0 if step == 1 else NOISES[1]))
        for weights in pool:
            weights[missing_tap(plane)] += WHOLE - weights.sum()
        costs = np.array(
            [
                costs_of(samples, np.array(pool), np.full(len(pool), noise)) / len(samples.goals)
                for samples, noise in some
            ]
        ).T
        costs = costs / COST_UNIT + LEAST
        # Gains at low rates count as much as those at high ones.
        costs /= costs.min(0)
        least = np.full(len(some), np.inf)
        sets = []
        for _ in range(N_SETS):
            totals = np.minimum(costs, least).sum(1)
            best = int(totals.argmin())
            sets.append(pool[best])
            least = np.minimum(least, costs[best])
        print(plane, len(pool), len(some), least.mean(), file=sys.stderr)
        chosen[plane] = np.array(sets)
    return chosen


def train_codes(windows: dict[str, tuple[np.ndarray, np.ndarray]], layout: int) -> np.ndarray:
    """Return codes of frequencies by family of a layout, context and symbol."""
    first = layout * rapid_tables.N_FAMILIES
    counts = np.zeros((rapid_tables.N_FAMILIES, N_CONTEXTS, 63), dtype=np.float64)
    for name, found in windows.items():
        for bound in BOUNDS:
            step = 2 * bound * (10 if "lidar" in name else 1) + 1
            _, tables = best_tables(plain_tables(step), *found, step, 20.0)
            families = range(
                rapid_tables.family_of(step), rapid_tables.N_FAMILIES, rapid_tables.N_STEPS
            )
            for family in families:
                own = tables._replace(family=first + family)
                symbols = count(own, *found, step).astype(np.float64)
                counts[family] += symbols / max(1.0, symbols.sum()) * 1e6
    codes = np.zeros(counts.shape, dtype=np.int64)
    every = np.arange(N_CONTEXTS)
    for family in range(rapid_tables.N_FAMILIES):
        trained = rapid_parameters.default_freqs(first + family) / 2048
        weights = np.rint(1000 * (counts[family] + 200 * trained)).astype(np.int64)
        codes[family] = codes_for(weights, first + family)
        rest = rapid_parameters.rest_symbols(first + family)
        left = rapid_parameters.freqs_of(codes[family], rest)[every, rest].tolist()
        codes[family, every, rest] = [rapid_parameters.code_of(freq) for freq in left]
    return codes


def write_codes(codes: np.ndarray) -> None:
    """Print the codes, one string."""
    packed = base64.b85encode(zlib.compress(codes.astype(np.uint8).tobytes(), 9)).decode()
    print("_CODES = (")
    for k in range(0, len(packed), 96):
        print(f'    "{packed[k : k + 96]}"')
    print(")")


def write(stencils: dict[int, np.ndarray], codes: np.ndarray) -> None:
    """Print the module of the tables."""
    features = rapid_tables.FEATURES
    print(HEADER + IMPORTS)
    print("STENCILS = {")
    for plane, sets in stencils.items():
        rows = ", ".join(str([int(w) for w in row]) for row in sets)
        print(f"    {plane}: np.array([{rows}], dtype=np.int16),")
    print("}\n")
    print("FEATURES = (")
    for table in features:
        print(f"    np.array({table.tolist()}, dtype=np.int64),")
    print(")\n")
    write_codes(codes)
    print(FOOTER)


HEADER = '''"""Tables of the `rapid` method: written by tools/train_rapid.py, never edited.

Stencils by plane (HH, HL, LH) and set, in 1/4096; weights of the expected magnitude by table, class
of levels and plane or line, in 2**-24; codes of frequencies by family, context and symbol.
"""
'''

REACH_HEADER = '''"""Tables of `rapid` for contexts by reach, by tools/train_rapid.py, never edited.

Codes of frequencies by family, context and symbol.
"""
'''

IMPORTS = """
# fmt: off
import base64
import zlib
from functools import cache

import numpy as np
from numpy.typing import NDArray
"""

FOOTER = '''# fmt: on

N_STEPS, N_FAMILIES = 3, 6  # of steps; those with each table of features


def family_of(step: int) -> int:
    """Return which frequencies a step starts from with the first table of features."""
    return 0 if step == 1 else 1 if step == 3 else 2


@cache
def default_codes() -> NDArray[np.uint8]:
    """Return the trained codes, shape (N_FAMILIES, contexts, symbols)."""
    codes = np.frombuffer(zlib.decompress(base64.b85decode(_CODES)), dtype=np.uint8)
    return codes.reshape(N_FAMILIES, 176, 63)'''

REACH_FOOTER = '''# fmt: on


@cache
def default_codes() -> NDArray[np.uint8]:
    """Return the trained codes, shape (families, contexts, symbols)."""
    codes = np.frombuffer(zlib.decompress(base64.b85decode(_CODES)), dtype=np.uint8)
    return codes.reshape(-1, 176, 63)'''


def take(module: ModuleType, codes: np.ndarray) -> None:
    """Let `best_tables` work with other codes of a module of tables."""
    module.default_codes = lambda: codes
    for cached in (
        rapid_parameters._all_codes,
        rapid_parameters._all_rests,
        rapid_parameters.default_freqs,
    ):
        cached.cache_clear()


def main() -> None:
    """Train and print."""
    directory, is_by_reach = Path(sys.argv[1]), "--reach" in sys.argv[2:]
    found = {name: windows_of(directory / name) for name in RASTERS}
    windows = {name: pair for name, pair in found.items() if pair is not None}
    for name, (heights, _) in windows.items():
        print(name, len(heights), file=sys.stderr)
    for turn in range(2):
        if turn == 0 and not is_by_reach:
            rapid_tables.STENCILS = train_stencils(windows)
        codes = train_codes(windows, int(is_by_reach))
        take(rapid_reach_tables if is_by_reach else rapid_tables, codes)
    if is_by_reach:
        print(REACH_HEADER + IMPORTS)
        write_codes(codes)
        print(REACH_FOOTER)
    else:
        write(rapid_tables.STENCILS, codes)


if __name__ == "__main__":
    main()
