"""Rasters and .twz files for the tests of the driver."""

from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from ext.rasters import hills
from rasterio.enums import ColorInterp

import terrainwave

TRANSFORM = Affine(30, 0, 400_000, 0, -30, 5_100_000)
# dtype, how voids are told, and rows x columns: of each several pyramids of overviews.
KINDS = {
    "int16-nodata": ("int16", "nodata", (1300, 1091)),
    "int16-none": ("int16", "none", (700, 2100)),
    "uint8-mask": ("uint8", "mask", (1025, 600)),
    "uint16-nodata": ("uint16", "nodata", (513, 1200)),
    "int32-mask": ("int32", "mask", (530, 640)),
    "float32-nan": ("float32", "nan", (1100, 1099)),
    "float32-nodata": ("float32", "nodata", (600, 1030)),
    "float64-nodata": ("float64", "nodata", (520, 1025)),
}
NODATA = {"int16": -32768, "uint16": 410, "float32": -9999.0, "float64": 1e30}


def heights_of(dtype, shape):
    """Return hills of a type, and where they are valid: with holes, and single samples in them."""
    heights = hills(*shape).astype(np.float64)
    if dtype == "uint8":
        heights = (heights - heights.min()) / np.ptp(heights) * 255
    if dtype[0] == "f":
        heights += 0.125
    valid = np.ones(shape, dtype=np.bool_)
    valid[40:301, 90:411] = False
    valid[100:120:2, 200:240:3] = True
    valid[-60:, -3:] = False
    return heights.astype(dtype), valid


def write_kind(folder, kind, **options):
    """Write a raster of one of `KINDS` and the .twz file of it, once; return the latter's path."""
    name = "-".join([kind, *map(str, options.values())])
    source = Path(folder) / f"{name}.tif"
    target = source.with_suffix(".twz")
    if target.exists():
        return target
    dtype, voids, shape = KINDS[kind]
    heights, valid = heights_of(dtype, shape)
    nodata = NODATA[dtype] if voids == "nodata" else None
    if voids == "nodata":
        heights[~valid] = nodata
    elif voids == "nan":
        heights[~valid] = np.nan
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(
        source, "w", driver="GTiff", height=shape[0], width=shape[1], count=1, dtype=dtype,
        crs="EPSG:32632", transform=TRANSFORM, nodata=nodata,
    ) as raster:  # fmt: skip
        raster.write(heights, 1)
        if voids == "mask":
            raster.write_mask(valid)
    terrainwave.compress(source, target, max_error=2, threads=1, mesh="none", **options)
    return target


def write_described(folder):
    """Write a small .twz file that says all of itself that a file can say; return its path."""
    source = Path(folder) / "described.tif"
    with rasterio.open(
        source, "w", driver="GTiff", height=80, width=90, count=1, dtype="int16", nodata=-1,
        crs="EPSG:2056+5728", transform=Affine(9, 2, 2_600_000, 3, -11, 1_200_000),
    ) as raster:  # fmt: skip
        raster.write(hills(80, 90), 1)
        raster.update_tags(AREA_OR_POINT="Point", COPYRIGHT="© Ämter", licence="a=b, c")
        raster.update_tags(1, SENSOR="none of them")
        raster.descriptions, raster.units = ("ground",), ("m",)
        raster.scales, raster.offsets = (0.5,), (-3.25,)
        raster.colorinterp = (ColorInterp.green,)
    target = source.with_suffix(".twz")
    terrainwave.compress(source, target, max_error=0.75, threads=1, mesh="none")
    return target


def centre(transform, row, col):
    """Return the place of the centre of a pixel."""
    a, b, c, d, e, f = transform[:6]
    return a * (col + 0.5) + b * (row + 0.5) + c, d * (col + 0.5) + e * (row + 0.5) + f
