"""Files of lidar at bounds of millimetres: ``python -m benchmarks.lidar DIR/*lidar*.tif``.

`lidar.csv` has the bytes of files and of the same heights in a COG (LERC_ZSTD, overviews with the
same bound). `lidar_coarse.csv` models a wider bound for coarse levels. Samples of a coarse level
are samples of the full grid, coded once. With a wider bound they would be coded twice: within the
wider bound, then to the narrow one with the finest level. The second part is counted by the
entropy of what is left, without contexts: what is left of a quantised height is noise.
"""

import math
from collections import namedtuple
from pathlib import Path

import numpy as np
import rasterio
import rasterio.shutil

import terrainwave
from benchmarks import common

BOUNDS = (0.001, 0.01)
# Bounds of coarse levels: as LINZ keeps overviews, and four times the file's.
WIDE = 0.1

SizeRow = namedtuple("SizeRow", "raster max_error n_bytes bits_per_sample cog_bytes ratio")
CoarseRow = namedtuple(
    "CoarseRow",
    "raster max_error coarse_error n_bytes coarse_bytes wide_bytes rest_bytes saved_percent",
)


def cog_bytes(dem: Path, target: Path, max_error: float) -> int:
    """Return the bytes of a COG within a bound."""
    error = repr(max_error)
    rasterio.shutil.copy(
        dem, target, driver="COG", COMPRESS="LERC_ZSTD", BLOCKSIZE="512", OVERVIEWS="AUTO",
        MAX_Z_ERROR=error, MAX_Z_ERROR_OVERVIEW=error,
    )  # fmt: skip
    return target.stat().st_size


def compressed(dem: Path, target: Path, max_error: float) -> Path:
    """Return a file within a bound."""
    terrainwave.compress(dem, target, max_error=max_error, mesh="none", overwrite=True)
    return target


def coarse_bytes(file: Path) -> int:
    """Return the bytes of all levels but the full grid."""
    with terrainwave.open(file) as terrain:
        return sum(terrain.parts().heights[:-1])


def rest_bytes(narrow: Path, wide: Path) -> int:
    """Return the bytes by which coarse samples within a wide bound get to the narrow one."""
    with terrainwave.open(narrow) as fine, terrainwave.open(wide) as coarse:
        (goal, valid), (heights, _) = (one.read_with_mask(level=-2) for one in (fine, coarse))
        step = fine.header.step * float(fine.header.quantum)
        left = np.rint((goal.astype(np.float64) - heights)[valid] / step)
    counts = np.unique(left, return_counts=True)[1]
    return math.ceil(-(counts * np.log2(counts / counts.sum())).sum() / 8)


@common.command()
@common.rasters_argument
@common.bounds_option(*BOUNDS)
def main(paths: list[Path], bounds: tuple[float, ...], folder: Path, out: Path) -> None:
    """Measure, print and write the CSVs."""
    sizes, levels = [], []
    for dem in paths:
        with rasterio.open(dem) as dataset:
            n_samples = dataset.width * dataset.height
        for bound in bounds:
            narrow = compressed(dem, folder / "narrow.twz", bound)
            n_bytes, n_cog = narrow.stat().st_size, cog_bytes(dem, folder / "cog.tif", bound)
            bits = round(8 * n_bytes / n_samples, 3)
            sizes.append(SizeRow(dem.stem, bound, n_bytes, bits, n_cog, round(n_bytes / n_cog, 3)))
            of_levels = coarse_bytes(narrow)
            for wider in sorted({4 * bound, WIDE}):
                wide = compressed(dem, folder / "wide.twz", wider)
                of_wide, rest = coarse_bytes(wide), rest_bytes(narrow, wide)
                saved = 100 * (of_levels - of_wide - rest) / n_bytes
                levels.append(
                    CoarseRow(
                        dem.stem, bound, wider, n_bytes, of_levels, of_wide, rest, round(saved, 2)
                    )
                )
    common.write_rows(out / "lidar.csv", sizes)
    common.write_rows(out / "lidar_coarse.csv", levels)


if __name__ == "__main__":
    main()
