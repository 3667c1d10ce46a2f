"""Train the tables of the `rapid` method from a directory of rasters.

    python tools/train_rapid.py DIRECTORY > src/terrainwave/codec/rapid_tables.py

Stencils are fitted to each raster, bound, class of levels and plane, and those kept that together
serve all of them best; frequencies are counted in windows coded with them. Weights of the expected
magnitude are those of `FEATURES` here: non-negative least squares over the same rasters
(reference: rapid_codec.md; per class HH, HL, LH, then lines).
"""

import base64
import sys
import zlib
from pathlib import Path

import numpy as np
import rasterio

from terrainwave.codec import rapid_parameters, rapid_tables
from terrainwave.codec.fitting import stencil_cost
from terrainwave.codec.rapid_fitting import (
    _CLASS_DEPTHS,
    _NOISES,
    Window,
    _judged,
    choose_stencils,
    codes_for,
    count,
    fit_stencil,
    gather,
)
from terrainwave.codec.rapid_magnitude import N_CONTEXTS
from terrainwave.codec.rapid_parameters import (
    N_CLASSES,
    PLANES,
    FileStencil,
    FileTables,
    weights_of,
)

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
NO_ERROR = 63  # what stencil_cost counts where a prediction is right is 64


def windows_of(path: Path) -> list[Window]:
    """Return windows spread over a raster, heights less their middle."""
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
                found.append(
                    Window(np.ascontiguousarray(target[at]), np.ascontiguousarray(mask[at]))
                )
    return found[:: max(1, len(found) // MAX_WINDOWS)][:MAX_WINDOWS]


def plain_tables(step: int) -> FileTables:
    """Return tables without anything of a file's own."""
    plain = ((FileStencil(0),) * len(PLANES),) * N_CLASSES
    return FileTables(0, rapid_tables.family_of(step), plain, {})


def train_stencils(windows: dict[str, list[Window]]) -> dict[int, np.ndarray]:
    """Return sets by plane: of all stencils fitted, those that together cost least."""
    chosen = {}
    for plane in PLANES:
        pool, judged = [], []
        for name, found in windows.items():
            for bound in BOUNDS:
                step = 2 * bound * (10 if "lidar" in name else 1) + 1
                for depths in _CLASS_DEPTHS:
                    samples = gather(plane, found, depths, step)
                    if samples is None:
                        continue
                    for noise in _NOISES if step > 1 else (0.0,):
                        stencil = fit_stencil(plane, 0, samples, noise, 1e9)
                        if stencil is not None:
                            pool.append(weights_of(plane, stencil))
                    judged.append((*_judged(samples), 0.0 if step == 1 else _NOISES[1]))
        costs = np.array(
            [[stencil_cost(t, g, w, n) / len(g) - NO_ERROR for t, g, n in judged] for w in pool]
        )
        # Gains at low rates count as much as those at high ones.
        costs /= costs.min(0)
        least = np.full(len(judged), np.inf)
        sets = []
        for _ in range(N_SETS):
            totals = np.minimum(costs, least).sum(1)
            best = int(totals.argmin())
            sets.append(pool[best])
            least = np.minimum(least, costs[best])
        print(plane, len(pool), len(judged), least.mean(), file=sys.stderr)
        chosen[plane] = np.array(sets)
    return chosen


def train_codes(windows: dict[str, list[Window]]) -> np.ndarray:
    """Return codes of frequencies by family, context and symbol."""
    counts = np.zeros((rapid_tables.N_FAMILIES, N_CONTEXTS, 63), dtype=np.float64)
    for name, found in windows.items():
        for bound in BOUNDS:
            step = 2 * bound * (10 if "lidar" in name else 1) + 1
            tables = choose_stencils(plain_tables(step), found, step, 20.0)
            for family in range(tables.family, rapid_tables.N_FAMILIES, rapid_tables.N_STEPS):
                seen = count(tables._replace(family=family), found, step)
                symbols = seen.symbols.astype(np.float64)
                counts[family] += symbols / max(1.0, symbols.sum()) * 1e6
    codes = np.zeros(counts.shape, dtype=np.int64)
    for family in range(rapid_tables.N_FAMILIES):
        for context in range(N_CONTEXTS):
            trained = rapid_parameters.default_freqs(family)[context] / 2048
            weights = counts[family, context] + 200 * trained
            codes[family, context] = codes_for(
                np.rint(1000 * weights).astype(np.int64), family, context
            )
            rest = rapid_parameters.rest_symbol(family, context)
            left = rapid_parameters.freqs_of(codes[family, context], rest)[rest]
            codes[family, context, rest] = rapid_parameters.code_of(int(left))
    return codes


def write(stencils: dict[int, np.ndarray], codes: np.ndarray) -> None:
    """Print the module of the tables."""
    features = rapid_tables.FEATURES
    print(HEADER)
    print("STENCILS = {")
    for plane, sets in stencils.items():
        rows = ", ".join(str([int(w) for w in row]) for row in sets)
        print(f"    {plane}: np.array([{rows}], dtype=np.int16),")
    print("}\n")
    print("FEATURES = (")
    for table in features:
        print(f"    np.array({table.tolist()}, dtype=np.int64),")
    print(")\n")
    packed = base64.b85encode(zlib.compress(codes.astype(np.uint8).tobytes(), 9)).decode()
    print("_CODES = (")
    for k in range(0, len(packed), 96):
        print(f'    "{packed[k : k + 96]}"')
    print(")")
    print(FOOTER)


HEADER = '''"""Tables of the `rapid` method: written by tools/train_rapid.py, never edited.

Stencils by plane (HH, HL, LH) and set, in 1/4096; weights of the expected magnitude by table, class
of levels and plane or line, in 2**-24; codes of frequencies by family, context and symbol.
"""

# fmt: off
import base64
import zlib
from functools import cache

import numpy as np
from numpy.typing import NDArray
'''

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


def main() -> None:
    """Train and print."""
    directory = Path(sys.argv[1])
    windows = {name: windows_of(directory / name) for name in RASTERS}
    for name, found in windows.items():
        print(name, len(found), file=sys.stderr)
    for turn in range(2):
        if turn == 0:
            rapid_tables.STENCILS = train_stencils(windows)
        codes = train_codes(windows)
        rapid_tables.default_codes = lambda codes=codes: codes
        rapid_parameters.default_codes.cache_clear()
        rapid_parameters.default_freqs.cache_clear()
    write(rapid_tables.STENCILS, codes)


if __name__ == "__main__":
    main()
