"""Small georeferenced rasters and files for tests of integrations."""

import numpy as np
import rasterio
from affine import Affine

import terrainwave

# Left, bottom, right and top of what servers show, in degrees.
BOUNDS = (8.0, 46.0, 8.5, 46.4)


def write_raster(path, heights, bounds, crs="EPSG:4326", units="m", **profile):
    """Write a GeoTIFF whose pixels cover `bounds` (left, bottom, right, top)."""
    n_rows, n_cols = heights.shape
    left, bottom, right, top = bounds
    transform = Affine((right - left) / n_cols, 0, left, 0, (bottom - top) / n_rows, top)
    with rasterio.open(
        path, "w", driver="GTiff", height=n_rows, width=n_cols, count=1, dtype=heights.dtype,
        crs=crs, transform=transform, **profile,
    ) as raster:  # fmt: skip
        raster.write(heights, 1)
        if units:
            raster.units = (units,)
    return path


def hills(n_rows, n_cols, seed=1):
    """Return whole metres, smooth and rough in places."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[0:n_rows, 0:n_cols] / 12.0
    heights = 400 + 150 * np.sin(rows) * np.cos(cols / 1.7) + 4 * rng.standard_normal(rows.shape)
    return np.rint(heights).astype(np.int16)


def write_twz(folder, heights, bounds, crs="EPSG:4326", max_error=0.5, name="hills", **profile):
    """Return the path of a .twz file of these heights."""
    source = write_raster(folder / f"{name}.tif", heights, bounds, crs, **profile)
    target = folder / f"{name}.twz"
    terrainwave.compress(source, target, max_error=max_error, block=32, threads=1)
    return target
