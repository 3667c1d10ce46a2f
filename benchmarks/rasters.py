"""Rasters as benchmarks need them: heights, mask, vertical quantum, fills for voids.

Nothing here uses terrainwave: what checks the package must not depend on it.
"""

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window
from scipy import ndimage

# Decimal and dyadic steps that heights are published in, metres and feet.
QUANTA = (1.0, 0.5, 0.25, 0.125, 0.1, 0.05, 0.01, 0.001)


@dataclass(frozen=True)
class Raster:
    """One band of heights.

    Attributes
    ----------
    name : str
        File name without its ending.
    heights : ndarray, shape (n_rows, n_cols)
        In the file's dtype; whatever the file holds where `mask` is False.
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where the sample is valid.
    quantum : float
        The heights are whole multiples of it; 0 if they are on no known grid.
    nodata : float or None
        The file's nodata value.
    transform, crs
        As in rasterio; copied to files, otherwise unused.
    """

    name: str
    heights: np.ndarray
    mask: np.ndarray
    quantum: float
    nodata: float | None
    transform: object
    crs: object

    @property
    def is_integer(self) -> bool:
        """True if the dtype is an integer."""
        return self.heights.dtype.kind in "iu"

    @property
    def slack(self) -> float:
        """What decimal numbers in binary floats may add to an error: one ulp.

        Both the original and the decoded height stand for a multiple of the quantum;
        on a grid of 0.01 neither is exact, and their difference may be half an ulp
        of each off. 0 for integers, dyadic quanta and heights on no grid.
        """
        if self.is_integer or not self.quantum or _is_power_of_two(self.quantum):
            return 0.0
        return self.ulp

    @property
    def ulp(self) -> float:
        """Spacing of the dtype (at most float32's) at the largest valid height."""
        largest = np.abs(self.valid.astype(np.float64)).max(initial=0.0)
        dtype = np.float64 if self.heights.dtype == np.float64 else np.float32
        return float(np.spacing(dtype(largest)))

    @property
    def valid(self) -> np.ndarray:
        """The valid heights, 1-D."""
        return self.heights[self.mask]


def _is_power_of_two(number: float) -> bool:
    return math.frexp(number)[0] == 0.5


def find_rasters(places: list[Path]) -> list[Path]:
    """List the GeoTIFFs given: files themselves, directories' sorted by name."""
    found: list[Path] = []
    for place in places:
        found += sorted(place.glob("*.tif")) if place.is_dir() else [place]
    return found


def load_raster(path: Path, crop: int | None = None) -> Raster:
    """Read band 1 of `path`, or its upper left `crop` x `crop` samples."""
    with rasterio.open(path) as source:
        n_rows, n_cols = source.shape
        window = Window(0, 0, min(crop or n_cols, n_cols), min(crop or n_rows, n_rows))
        heights = source.read(1, window=window)
        mask = source.dataset_mask(window=window) > 0
        nodata, transform, crs = source.nodata, source.transform, source.crs
    if heights.dtype.kind == "f":
        mask &= np.isfinite(heights)
    quantum = detect_quantum(heights[mask])
    return Raster(path.stem, heights, mask, quantum, nodata, transform, crs)


def detect_quantum(valid: np.ndarray) -> float:
    """Return the largest of `QUANTA` whose multiples all `valid` heights are, or 0."""
    if valid.dtype.kind in "iu":
        return 1.0
    exact = valid.astype(np.float64)
    for quantum in QUANTA:
        nearest = np.rint(exact / quantum) * quantum
        if np.array_equal(nearest.astype(valid.dtype), valid):
            return quantum
    return 0.0


def write_geotiff(raster: Raster, path: Path) -> None:
    """Write `raster` uncompressed and tiled: a source that costs little to read."""
    n_rows, n_cols = raster.heights.shape
    profile = {
        "driver": "GTiff",
        "count": 1,
        "height": n_rows,
        "width": n_cols,
        "dtype": raster.heights.dtype.name,
        "nodata": raster.nodata,
        "transform": raster.transform,
        "crs": raster.crs,
        "tiled": True,
    }
    with rasterio.open(path, "w", **profile) as sink:
        sink.write(raster.heights, 1)


# --- voids: peers without a mask get the best of several fills, and pay for the mask ---


def void_fills(raster: Raster) -> Iterator[tuple[str, Raster]]:
    """Yield the raster with its voids filled in the ways that suit other codecs.

    Without voids: the raster itself, under the name "none".
    """
    if raster.mask.all() or not raster.mask.any():
        yield "none", raster
        return
    nearest = _nearest_fill(raster)
    smooth = _smooth_fill(raster, nearest)
    constant = raster.heights.dtype.type(np.median(raster.valid))
    for name, fill in (
        ("nearest", nearest),
        ("smooth", smooth.astype(raster.heights.dtype)),
        ("constant", constant),
    ):
        filled = np.where(raster.mask, raster.heights, fill)
        yield name, replace(raster, heights=filled)


@dataclass(frozen=True)
class Forms:
    """A raster with what codecs without masks need; made once, since smooth fills are slow."""

    raster: Raster
    fills: tuple[tuple[str, Raster], ...]
    mask_bytes: int


def make_forms(raster: Raster) -> Forms:
    """Return the raster with its voids filled in several ways, and the price of its mask."""
    return Forms(raster, tuple(void_fills(raster)), mask_bytes(raster.mask))


def with_nan(raster: Raster) -> Raster:
    """Return the raster as float32 with NaN in its voids."""
    return replace(raster, heights=np.where(raster.mask, raster.heights, np.nan).astype(np.float32))


def without_nan(decoded: np.ndarray, raster: Raster) -> np.ndarray | None:
    """Undo `with_nan`: the raster's dtype, 0 in voids; None if the mask differs."""
    if not np.array_equal(np.isnan(decoded), ~raster.mask):
        return None
    return np.where(raster.mask, decoded, 0).astype(raster.heights.dtype)


def _nearest_fill(raster: Raster) -> np.ndarray:
    """Return the heights with each void sample given its nearest valid height."""
    nearest = ndimage.distance_transform_edt(
        ~raster.mask, return_distances=False, return_indices=True
    )
    return raster.heights[tuple(nearest)]


def _smooth_fill(raster: Raster, nearest: np.ndarray) -> np.ndarray:
    """Return float64 heights, smooth in the voids, rounded to the quantum.

    Normalised convolution with growing Gaussians; each sample takes the narrowest
    that sees enough valid ground.
    """
    known = raster.mask.astype(np.float64)
    heights = np.where(raster.mask, raster.heights, 0).astype(np.float64)
    smooth = nearest.astype(np.float64)
    is_done = np.zeros(known.shape, bool)
    for sigma in (1, 2, 4, 8, 16, 32, 64, 128):
        weight = ndimage.gaussian_filter(known, sigma)
        is_new = (weight > 0.05) & ~is_done
        smooth[is_new] = ndimage.gaussian_filter(heights, sigma)[is_new] / weight[is_new]
        is_done |= is_new
    if raster.quantum:
        smooth = np.rint(smooth / raster.quantum) * raster.quantum
    return smooth


def mask_bytes(mask: np.ndarray) -> int:
    """Return what a codec without masks pays for one: the smaller of two packings."""
    if mask.all():
        return 0
    sizes = [len(zlib.compress(np.packbits(mask).tobytes(), 9))]
    try:
        import imagecodecs
    except ImportError:
        return sizes[0]
    image = mask.astype(np.uint8) * 255
    sizes.append(len(imagecodecs.jpegxl_encode(image, lossless=True, effort=7)))
    return min(sizes)
