"""Compress an array with a bound of 1 m, read it back, and check the bound yourself."""

import tempfile
from pathlib import Path

import matplotlib.cbook
import numpy as np

import terrainwave as tw

with matplotlib.cbook.get_sample_data("jacksboro_fault_dem.npz") as dem:
    heights = dem["elevation"]

with tempfile.TemporaryDirectory() as directory:
    path = Path(directory) / "jacksboro.twz"
    result = tw.compress(heights, path, max_error=1)
    print(
        f"{heights.nbytes:,} -> {result.n_bytes:,} bytes, {result.bits_per_sample:.2f} bits/sample"
    )
    with tw.open(path) as terrain:
        decoded = terrain.read()

largest = np.abs(decoded.astype(int) - heights.astype(int)).max()
print(f"largest error {largest} m, promised {result.effective_error} m")
assert largest <= result.effective_error
