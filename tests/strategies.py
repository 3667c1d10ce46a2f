"""Rasters to test on: hypothesis strategies and a plain writer of GeoTIFFs."""

import warnings
from pathlib import Path

import numpy as np
import rasterio
from hypothesis import strategies as st
from rasterio.errors import NotGeoreferencedWarning

RASTER_DTYPES = ("uint8", "int16", "uint16", "int32", "float32", "float64")


def write_geotiff(path, heights, *, mask=None, bands=None, tags=None, units=None, **profile):
    """Write `heights` (2-D, or 3-D with the band first) by rasterio alone; return the path.

    `mask` is written as the file's internal mask, True where valid.
    """
    heights = np.asarray(heights)
    layers = heights if heights.ndim == 3 else heights[np.newaxis]
    profile = {
        "driver": "GTiff",
        "count": layers.shape[0],
        "height": layers.shape[1],
        "width": layers.shape[2],
        "dtype": heights.dtype.name,
        **profile,
    }
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", **profile) as dataset:
            if tags:
                dataset.update_tags(**tags)
            if units:
                dataset.units = units
            for name, value in (bands or {}).items():
                setattr(dataset, name, (value,) * layers.shape[0])
            dataset.write(layers)
            if mask is not None:
                dataset.write_mask(np.asarray(mask, dtype=bool))
    return Path(path)


def read_geotiff(path):
    """Return (heights, valid, profile) of band 1 as plain rasterio gives them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            return dataset.read(1), dataset.read_masks(1) != 0, dict(dataset.profile)


def terrain_like(n_rows, n_cols, dtype="int16", seed=0):
    """Return rolling hills with a little noise, 0 to about 200, any dtype."""
    rng = np.random.default_rng(seed)
    row, col = np.mgrid[0:n_rows, 0:n_cols]
    hills = 80 * np.sin(row / 17.0) * np.cos(col / 23.0) + 100
    return (hills + rng.normal(0, 2, hills.shape)).astype(dtype)


@st.composite
def heights_arrays(draw, max_side=40, dtypes=RASTER_DTYPES):
    """Draw a small raster: flat, ramp, spike, checkerboard, noise or the dtype's extremes."""
    dtype = np.dtype(draw(st.sampled_from(dtypes)))
    shape = draw(st.integers(1, max_side)), draw(st.integers(1, max_side))
    row, col = np.indices(shape)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    low, high = (-1e4, 1e4) if dtype.kind == "f" else _integer_range(dtype)
    kind = draw(st.sampled_from(["flat", "ramp", "spike", "checkerboard", "noise", "extremes"]))
    if kind == "flat":
        heights = np.full(shape, draw(st.integers(int(low), int(high))))
    elif kind == "ramp":
        heights = low + (high - low) * (row + col) / max(sum(shape), 1)
    elif kind == "spike":
        heights = np.full(shape, low)
        heights[draw(st.integers(0, shape[0] - 1)), draw(st.integers(0, shape[1] - 1))] = high
    elif kind == "checkerboard":
        heights = np.where((row + col) % 2, low, high)
    elif kind == "noise":
        heights = rng.uniform(low, high, shape)
    else:
        heights = rng.choice([low, high], shape)
    if dtype.kind != "f":
        heights = np.rint(heights)
    return heights.astype(dtype)


def _integer_range(dtype):
    # The codec holds 30 bits of range; a test that wants more of int32 says so.
    limits = np.iinfo(dtype)
    return max(limits.min, -(2**28)), min(limits.max, 2**28)


@st.composite
def valid_masks(draw, shape):
    """Draw a validity mask: all, none, one sample, or about half."""
    kind = draw(st.sampled_from(["all", "none", "one valid", "half"]))
    if kind in ("all", "none"):
        return np.full(shape, kind == "all")
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    if kind == "half":
        return rng.random(shape) < 0.5
    valid = np.zeros(shape, dtype=bool)
    valid.flat[rng.integers(valid.size)] = True
    return valid
