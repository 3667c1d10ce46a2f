"""Use of GDAL: its memory, errors and order of blocks."""

from collections.abc import Iterator
from typing import Any

import rasterio
import rasterio.shutil
from rasterio._err import CPLE_BaseError
from rasterio.errors import RasterioError

from terrainwave.grid.quadtree import Region

# GDAL's default block cache, 5 % of the machine's memory, may exceed a memory limit by itself.
GDAL_CACHE_BYTES = 64 * 2**20

# Samples per window to write: 32 MB of float64, large compared with GDAL's overhead per call.
SCAN_SAMPLES = 4 * 2**20

# Errors of rasterio when GDAL fails; a failed copy raises the last two.
GDAL_ERRORS = (RasterioError, OSError, CPLE_BaseError, SystemError)


def bounded_env(**options: Any) -> Any:
    return rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_BYTES, **options)


def one_line(error: BaseException) -> str:
    """Return GDAL's own reason, which rasterio hides behind "See previous exception"."""
    reason = error
    while reason.__cause__ is not None:
        reason = reason.__cause__
    return " ".join(str(reason).split())


def scan_windows(
    n_rows: int, n_cols: int, block_rows: int, block_cols: int, max_samples: int
) -> Iterator[Region]:
    """Yield windows in block order: block rows from the top, in each from the left."""
    rows = min(block_rows, n_rows, max_samples)
    cols = min(n_cols, max(max_samples // rows, 1))
    if cols < n_cols and cols > block_cols:
        cols -= cols % block_cols
    elif cols == n_cols:
        rows = min(n_rows, max(max_samples // (rows * n_cols), 1) * rows)
    # One row of blocks at a time, even if the rows of huge blocks are divided.
    yield from Region(0, 0, n_rows, n_cols).tiles(rows, cols)
