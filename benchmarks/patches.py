"""Patch lossy files again and again, and compare their sizes with those of files made anew.

Patches lie at random places, with random sides of 20 to 299 samples: a wave of 6 m, an offset of up
to 10 m and noise of 1 m on the heights that were there. After each, every sample that it does not
cover must be what it was, and the whole file within its bound of the raster with all patches.
"""

import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import rasterio

import terrainwave
from benchmarks import common
from terrainwave.codec.corrections import decode_corrections
from terrainwave.codec.group import HAS_CORRECTIONS, read_head
from terrainwave.codec.unit_specs import unit_spec
from terrainwave.terrain import Terrain

# After so many patches a row is written.
COUNTS = (1, 5, 50)
_LEAST_SIDE, _MOST_SIDE = 20, 300

# Sizes in bytes; `patched_share` of the samples lie in some patch; `corrections` are all sections'
# bytes, `corrected` the samples they put back; `seconds` of one patch, the mean.
Row = namedtuple(
    "Row",
    "raster method mesh max_error patches patched_share made fresh patched corrections corrected"
    " bytes_per_corrected seconds",
)


class Series:
    """A file, and the raster that it should be of after each patch."""

    def __init__(self, dem: Path, folder: Path, **options: object) -> None:
        self.options, self.folder = options, folder
        with rasterio.open(dem) as source:
            self.heights, self.profile = source.read(1), source.profile
        self.nodata = self.profile.get("nodata")
        self.valid = self.heights != self.nodata
        self.lowest, self.highest = (f(self.heights[self.valid]) for f in (np.min, np.max))
        self.is_patched = np.zeros(self.heights.shape, dtype=bool)
        self.path = folder / "patched.twz"
        self.rng = np.random.default_rng(5)
        self.n_made = self.make(self.path)

    def make(self, path: Path) -> int:
        """Make a file of the raster as it is now; return its size."""
        source = self.folder / "whole.tif"
        self.write(source, self.heights, 0, 0)
        terrainwave.compress(source, path, overwrite=True, threads=1, **self.options)
        return path.stat().st_size

    def write(self, path: Path, heights: np.ndarray, row: int, col: int) -> None:
        """Write a raster whose first sample is that of a row and a column."""
        place = self.profile["transform"]
        profile = {
            "driver": "GTiff", "count": 1, "dtype": heights.dtype, "crs": self.profile["crs"],
            "nodata": self.nodata, "transform": place @ place.translation(col, row),
            "height": heights.shape[0], "width": heights.shape[1],
        }  # fmt: skip
        with rasterio.open(path, "w", **profile) as dataset:
            dataset.write(heights, 1)

    def patch(self) -> float:
        """Patch a random place; check the file; return the seconds that the patch took."""
        rng, shape = self.rng, self.heights.shape
        n_rows, n_cols = np.minimum(rng.integers(_LEAST_SIDE, _MOST_SIDE, 2), shape)
        row, col = rng.integers(0, shape[0] - n_rows + 1), rng.integers(0, shape[1] - n_cols + 1)
        at = slice(row, row + n_rows), slice(col, col + n_cols)
        down, across = np.mgrid[:n_rows, :n_cols]
        change = 6 * np.sin(down / 15) * np.cos(across / 11) + rng.uniform(-10, 10)
        change += rng.normal(0, 1, change.shape)
        part = np.clip(np.round(self.heights[at] + change), self.lowest, self.highest)
        part = np.where(self.valid[at], part, self.heights[at]).astype(self.heights.dtype)
        self.write(self.folder / "new.tif", part, int(row), int(col))
        before = self.read()
        start = time.process_time()
        terrainwave.patch(self.path, self.folder / "new.tif", threads=1)
        seconds = time.process_time() - start
        after = self.read()
        self.heights[at], self.is_patched[at] = part, True
        error = np.abs(after.astype(np.float64) - self.heights)[self.valid].max()
        before[at] = after[at]
        if not np.array_equal(before, after) or error > self.options["max_error"]:
            raise click.ClickException(f"heights have moved, or are off by {error}")
        return seconds

    def read(self) -> np.ndarray:
        """Return the heights of the file as it is now."""
        with Terrain(self.path, threads=1) as terrain:
            return terrain.read()

    def corrections(self) -> tuple[int, int]:
        """Return the bytes of all sections of corrections, and how many samples they put back."""
        n_bytes = n_corrected = 0
        with Terrain(self.path, threads=1) as terrain:
            grid, parameters = terrain.grid, terrain.header.codec_parameters
            keys = [*grid.root_keys()]
            keys += [key for level in range(grid.k_max) for key in grid.blocks(level)]
            for key in keys:
                payload = terrain.container.payload(key)
                if payload and payload[0] & HAS_CORRECTIONS:
                    spec = unit_spec(grid, parameters, key)
                    parent = None if key.is_root_key else terrain.decoder.block(key)
                    section = read_head(spec, parent, payload).corrections
                    n_bytes += len(section)
                    n_corrected += np.count_nonzero(decode_corrections(section, spec).added)
        return n_bytes, int(n_corrected)


def measure(dem: Path, folder: Path, **options: object) -> Iterator[Row]:
    """Yield a row after each count of patches."""
    series, seconds = Series(dem, folder, **options), 0.0
    for count in range(1, COUNTS[-1] + 1):
        seconds += series.patch()
        if count in COUNTS:
            n_bytes, n_corrected = series.corrections()
            yield Row(
                dem.stem, options["method"], options["mesh"], options["max_error"], count,
                f"{series.is_patched.mean():.3f}", series.n_made,
                series.make(folder / "fresh.twz"), series.path.stat().st_size, n_bytes,
                n_corrected, f"{n_bytes / max(n_corrected, 1):.3f}", f"{seconds / count:.2f}",
            )  # fmt: skip


@common.command("patches.csv")
@common.rasters_argument
@common.bounds_option(2.0)
def main(paths: list[Path], bounds: tuple[float, ...], folder: Path, out: Path) -> None:
    """Measure, print and write the CSV."""
    cases = (("rapid", "none"), ("predictive", "none"), ("rapid", "halves"))
    common.write_rows(
        out,
        (
            row
            for dem in paths
            for method, mesh in cases
            for bound in bounds
            for row in measure(dem, folder, method=method, mesh=mesh, max_error=bound)
        ),
    )


if __name__ == "__main__":
    main()
