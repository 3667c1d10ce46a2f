"""What a bound does to slope, pits and flow: ``python -m benchmarks.analyses DEM...``.

A pit is a sample, or a flat of several, whose neighbours are all higher; those at the edge are left
out. Slope is Horn's over 3 x 3 samples. Flow goes to the steepest of eight neighbours (D8), the
first of equals, of the heights as they are: no pits are filled. Roughness is the standard deviation
of the Laplacian. Bounds are in the rasters' own units, metres here.
"""

from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rasterio
from scipy import ndimage

import terrainwave
from benchmarks import common
from terrainwave.place.position import place_of

# `bytes` of the file, without meshes; slopes in degrees, differences from those of the original.
Row = namedtuple(
    "Row",
    "raster pixel_m max_error bytes bits_per_sample pits pits_ratio slope_rmse slope_99 slope_max"
    " flow_changed roughness_ratio",
)
# In the order in which D8 takes them.
_NEIGHBOURS = [(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)]


def n_pits(heights: np.ndarray) -> int:
    """Return the number of samples or flats without a lower neighbour, off the edge."""
    lowest = heights == ndimage.minimum_filter(heights, size=3, mode="nearest")
    labels, n_found = ndimage.label(lowest, structure=np.ones((3, 3)))
    is_pit = np.ones(n_found + 1, dtype=bool)
    is_pit[0] = False
    for shift in _NEIGHBOURS:
        near = np.roll(heights, shift, axis=(0, 1))
        near_labels = np.roll(labels, shift, axis=(0, 1))
        leaks = lowest & (near == heights) & (near_labels == 0)
        is_pit[labels[leaks]] = False
    for edge in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        is_pit[edge] = False
    return int(is_pit.sum())


def slope(heights: np.ndarray, pixel: tuple[float, float]) -> np.ndarray:
    """Return Horn's slope in degrees."""
    down = ndimage.sobel(heights, axis=0, mode="nearest") / (8 * pixel[0])
    right = ndimage.sobel(heights, axis=1, mode="nearest") / (8 * pixel[1])
    return np.degrees(np.arctan(np.hypot(down, right)))


def flow(heights: np.ndarray, pixel: tuple[float, float]) -> np.ndarray:
    """Return the number of the steepest neighbour below each inner sample; 8 where none is."""
    inner = heights[1:-1, 1:-1]
    falls = np.stack(
        [
            (
                inner
                - heights[
                    1 + row : heights.shape[0] - 1 + row, 1 + col : heights.shape[1] - 1 + col
                ]
            )
            / np.hypot(row * pixel[0], col * pixel[1])
            for row, col in _NEIGHBOURS
        ]
    )
    steepest = falls.argmax(axis=0)
    steepest[falls.max(axis=0) <= 0] = len(_NEIGHBOURS)
    return steepest


def pixel_of(dem: Path) -> tuple[float, float]:
    """Return the height and the width of a pixel in metres, in the raster's middle."""
    with rasterio.open(dem) as source:
        middle = [(source.bounds.left + source.bounds.right) / 2,
                  (source.bounds.bottom + source.bounds.top) / 2]  # fmt: skip
        place = place_of(source.crs.to_wkt(), tuple(source.bounds), is_placed=True)
        lengths = place.local_axes(*middle).lengths
        return abs(source.transform.e) * lengths[1], abs(source.transform.a) * lengths[0]


def measure(paths: list[Path], bounds: tuple[float, ...], folder: Path) -> Iterator[Row]:
    """Yield a row of each raster and bound, the original first."""
    for dem in paths:
        with rasterio.open(dem) as source:
            original = source.read(1).astype(np.float64)
        pixel = pixel_of(dem)
        before = n_pits(original), slope(original, pixel), flow(original, pixel)
        roughness = ndimage.laplace(original).std()
        for bound in bounds:
            path = folder / f"{dem.stem}.twz"
            result = terrainwave.compress(dem, path, max_error=bound, mesh="none", overwrite=True)
            with terrainwave.open(path) as terrain:
                heights = terrain.read().astype(np.float64)
            pits = n_pits(heights)
            apart = np.abs(slope(heights, pixel) - before[1])
            yield Row(
                dem.stem, round(max(pixel), 2), bound, result.n_bytes,
                round(result.bits_per_sample, 3), pits, round(pits / max(before[0], 1), 3),
                round(float(np.sqrt((apart**2).mean())), 3),
                round(float(np.quantile(apart, 0.99)), 3), round(float(apart.max()), 2),
                round(float((flow(heights, pixel) != before[2]).mean()), 4),
                round(float(ndimage.laplace(heights).std() / roughness), 3),
            )  # fmt: skip


@common.command("analyses.csv")
@common.rasters_argument
@common.bounds_option(0, 0.1, 0.25, 0.5, 1, 2, 3, 5, 10)
def main(paths, bounds, folder, out) -> None:
    """Measure what bounds do to derived quantities."""
    common.write_rows(out, measure(paths, bounds, folder))


if __name__ == "__main__":
    main()
