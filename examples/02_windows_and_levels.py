"""Read parts of a file at several resolutions; only the blocks needed are decoded."""

import tempfile
from pathlib import Path

import matplotlib.cbook

import terrainwave as tw

with matplotlib.cbook.get_sample_data("jacksboro_fault_dem.npz") as dem:
    heights = dem["elevation"]

with tempfile.TemporaryDirectory() as directory:
    path = Path(directory) / "jacksboro.twz"
    tw.compress(heights, path, max_error=3, block=32)
    with tw.open(path) as terrain:
        for level in range(terrain.n_levels):
            print(f"level {level}: {terrain.level_shape(level)} samples")
        window = terrain.read((100, 200, 3, 4))
        print("rows 100-102, columns 200-203:\n", window)
        # A level is samples at positions: its sample (50, 100) lies on sample (100, 200).
        print("the same place at half the resolution:", terrain.read((50, 100, 1, 1), level=-2))
        small = terrain.read(out_shape=(4, 4), resampling="average")
        print("averages of a 4 x 4 grid of pixels:\n", small)
        assert (window == terrain.read()[100:103, 200:204]).all()
