"""A GeoTIFF with voids and a CRS: both come back, voids exactly."""

import tempfile
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import Affine

import terrainwave as tw

rows, cols = np.mgrid[:200, :300]
heights = (400 + 80 * np.sin(rows / 23) * np.cos(cols / 31)).astype(np.float32)
heights[60:90, 100:140] = -9999

with tempfile.TemporaryDirectory() as directory:
    source, file, back = (Path(directory) / name for name in ("dem.tif", "dem.twz", "back.tif"))
    profile = {
        "driver": "GTiff", "height": 200, "width": 300, "count": 1, "dtype": "float32",
        "crs": "EPSG:32633", "nodata": -9999,
        "transform": Affine(10, 0, 500_000, 0, -10, 5_200_000),
    }  # fmt: skip
    with rasterio.open(source, "w", **profile) as dataset:
        dataset.write(heights, 1)
    tw.compress(source, file, max_error=0.1)
    report = tw.verify(file, source)
    print(report.errors)
    assert report.ok
    with tw.open(file) as terrain:
        x, y = 500_000 + 1005, 5_200_000 - 305
        print(f"height at ({x}, {y}): {terrain.sample([(x, y)])[0]:.2f}")
    tw.decompress(file, back)
    with rasterio.open(back) as dataset:
        print(dataset.crs, dataset.nodata, dataset.transform.a)
        assert ((dataset.read(1) == -9999) == (heights == -9999)).all()
