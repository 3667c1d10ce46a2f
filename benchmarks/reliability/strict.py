"""Measure what the strict bound costs: ``python -m benchmarks.reliability.strict DIR``.

Rasters of floats on a decimal grid are taken as they are; those of floats on none are rounded to
0.01, and those of integers are taken as tenths. Each is compressed with bounds of some steps of its
grid, by default and with ``strict``; stored values are then compared in their own type.

Exit status: 0 good; 1 a strict bound does not hold; 2 wrong usage.
"""

from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import terrainwave
from benchmarks import common
from benchmarks.rasters import Raster, load_raster

STEPS = (1, 3, 10, 30)

# `excess` is how much further than the bound the default's stored values are, in spacings of the
# largest height; `largest` how far the strict ones are, as a share of the bound.
Row = namedtuple("Row", "raster step steps max_error n_bytes strict_bytes excess largest holds")


def decimal_heights(raster: Raster) -> tuple[np.ma.MaskedArray, float]:
    """Return float32 heights on a decimal grid, and its step."""
    heights = raster.heights.astype(np.float64)
    if raster.heights.dtype.kind in "iu":
        heights, step = heights / 10, 0.1
    elif raster.quantum and raster.quantum != 1:
        heights, step = np.round(heights / raster.quantum) * raster.quantum, raster.quantum
    else:
        heights, step = np.round(heights, 2), 0.01
    voids = ~raster.mask
    return np.ma.MaskedArray(np.where(voids, 0, heights).astype(np.float32), voids), step


def largest_difference(path: Path, heights: np.ma.MaskedArray) -> float:
    """Return the largest difference of stored values, as numpy computes it in their type."""
    with terrainwave.open(path) as terrain:
        decoded = terrain.read()
    valid = ~np.ma.getmaskarray(heights)
    return float(np.abs(decoded[valid] - heights.data[valid]).max())


def measure(raster: Raster, folder: Path) -> Iterator[Row]:
    """Yield a row for each bound."""
    heights, step = decimal_heights(raster)
    spacing = float(np.spacing(np.abs(heights).max()))
    for steps in STEPS:
        bound = round(steps * step, 6)
        sizes, largest = [], []
        for is_strict in (False, True):
            target = folder / "strict.twz"
            result = terrainwave.compress(
                heights,
                target,
                max_error=bound,
                method="rapid",
                strict=is_strict,
                mesh="none",
                overwrite=True,
            )
            sizes.append(result.n_bytes)
            largest.append(largest_difference(target, heights))
        excess = round(max(largest[0] - bound, 0.0) / spacing, 3)
        yield Row(
            raster.name, step, steps, bound, *sizes, excess, round(largest[1] / bound, 6),
            int(largest[1] <= bound),
        )  # fmt: skip


@common.command("strict.csv")
@common.rasters_argument
@common.crop_option
def main(paths, crop, folder, out) -> None:
    """Write what strict files cost to a CSV."""
    rows = [row for path in paths for row in measure(load_raster(path, crop), folder)]
    common.write_rows(out, rows)
    if not all(row.holds for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
