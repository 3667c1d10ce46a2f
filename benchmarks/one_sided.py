"""Random rasters with one-sided bounds: ``python -m benchmarks.one_sided``.

Each raster has a random type, size, range, vertical grid, voids, scale and meaning. Every valid
height must be decoded to the side that was asked for, and within the bound. Physical heights are
compared as exact fractions.
"""

import warnings
from collections import namedtuple
from fractions import Fraction
from pathlib import Path

import numpy as np
import rasterio

import terrainwave
from benchmarks import common

METHODS = ("rapid", "predictive", "cdf97", "store")
BOUNDS = (0.01, 0.1, 0.5, 1.0, 2.0, 3.0, 10.0, 100.0)
Row = namedtuple("Row", "method n_rasters n_lossless n_violations")
Case = namedtuple("Case", "heights valid nodata scale kind max_error bound method")


def random_case(rng: np.random.Generator) -> Case:
    """Return a raster of up to 80 x 80 samples, and how it is to be compressed."""
    dtype = np.dtype(rng.choice(["uint8", "int16", "uint16", "int32", "float32", "float64"]))
    heights = rng.normal(size=rng.integers(1, 80, 2)).cumsum(0).cumsum(1)
    heights *= rng.choice([1, 30, 3000])
    if dtype.kind == "f":
        heights = np.round(heights, rng.integers(0, 4)) if rng.random() < 0.6 else heights
        heights += rng.choice([0, 8000])
    else:  # ends of the range come up often
        limits = np.iinfo(dtype)
        heights = np.clip(heights + limits.max // 2 * (limits.min == 0), limits.min, limits.max)
    heights = heights.astype(dtype)
    valid, nodata = np.ones(heights.shape, bool), None
    if rng.random() < 0.4:
        nodata = heights.ravel()[rng.integers(heights.size)].item()
        heights[rng.random(heights.shape) < 0.2] = nodata
        valid = heights != nodata
    return Case(
        heights, valid, nodata, float(rng.choice([1.0, 1.0, -1.0, 0.1])),
        str(rng.choice(["height", "depth"])), float(rng.choice(BOUNDS)),
        str(rng.choice(["above", "below"])), str(rng.choice(METHODS)),
    )  # fmt: skip


def compressed(case: Case) -> bytes:
    """Return the file of a case."""
    n_rows, n_cols = case.heights.shape
    with rasterio.MemoryFile() as memory:
        with memory.open(
            driver="GTiff", height=n_rows, width=n_cols, count=1, dtype=case.heights.dtype,
            nodata=case.nodata,
        ) as dataset:  # fmt: skip
            dataset.write(case.heights, 1)
            dataset.scales = [case.scale]
        with memory.open() as dataset:
            return terrainwave.compress_to_bytes(
                dataset, max_error=case.max_error, bound=case.bound, method=case.method,
                heights_are=case.kind, threads=1,
            )  # fmt: skip


def n_violations(case: Case, data: bytes) -> int:
    """Return the number of samples that are void, on the wrong side, or beyond the bound."""
    with terrainwave.open(data) as terrain:
        decoded, valid = terrain.read_with_mask()
        slack = Fraction(terrain.info().float_error)
    wrong = int(np.count_nonzero(valid != case.valid))
    both = valid & case.valid
    scale, bound = Fraction(repr(case.scale)), Fraction(repr(case.max_error))
    up = (1 if case.bound == "above" else -1) * (-1 if case.kind == "depth" else 1)
    pairs = {*zip(decoded[both].tolist(), case.heights[both].tolist(), strict=True)}
    for found, original in pairs:
        apart = up * scale * (Fraction(found) - Fraction(original))
        # On a decimal grid the bound is that of the decimal numbers.
        wrong += not 0 <= apart <= bound + slack
    return wrong


@common.command("one_sided.csv")
@common.option("--rasters", "n_rasters", type=common.COUNT, default=10_000)
def main(n_rasters: int, folder: Path, out: Path) -> None:
    """Compress, compare, print and write the CSV."""
    warnings.simplefilter("ignore")
    counts = {method: [0, 0, 0] for method in METHODS}
    for seed in range(n_rasters):
        case = random_case(np.random.default_rng(seed))
        data = compressed(case)
        with terrainwave.open(data) as terrain:
            is_lossless = terrain.info().effective_error == 0
        for k, n in enumerate((1, int(is_lossless), n_violations(case, data))):
            counts[case.method][k] += n
    common.write_rows(out, [Row(method, *found) for method, found in counts.items()])


if __name__ == "__main__":
    main()
