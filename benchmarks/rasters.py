"""Rasters as benchmarks need them: heights, mask, vertical quantum, fills for voids.

What checks the package must not depend on it: only `coefficients_of`, `mirrored_file` and
`write_pair` use terrainwave.
"""

import math
import tempfile
import zlib
from collections import namedtuple
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window
from scipy import ndimage

# Rows written at a time: one row of tiles, or this many strips of one row.
CHUNK = 512
# Decimal and dyadic steps that heights are published in, metres and feet.
QUANTA = (1.0, 0.5, 0.25, 0.125, 0.1, 0.05, 0.01, 0.001)


@dataclass(frozen=True)
class Raster:
    """One band of heights; `transform` and `crs` as in rasterio, copied to files."""

    name: str  # file name without its ending
    heights: np.ndarray  # (n_rows, n_cols), the file's dtype; anything where `mask` is False
    mask: np.ndarray  # (n_rows, n_cols) of bool, True where the sample is valid
    quantum: float  # the heights are whole multiples of it; 0 if they are on no known grid
    nodata: float | None
    transform: object
    crs: object

    @property
    def is_integer(self) -> bool:
        """True if the dtype is an integer."""
        return self.heights.dtype.kind in "iu"

    @property
    def slack(self) -> float:
        """What decimal numbers in binary floats may add to an error: half an ulp of each of two.

        0 for integers, dyadic quanta and heights on no grid.
        """
        is_dyadic = math.frexp(self.quantum)[0] == 0.5
        return 0.0 if self.is_integer or not self.quantum or is_dyadic else self.ulp

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


def load_raster(path: Path, crop: int | None = None, window: Window | None = None) -> Raster:
    """Read band 1 of `path`, its upper left `crop` x `crop` samples, or a window of it."""
    with rasterio.open(path) as source:
        n_rows, n_cols = source.shape
        window = window or Window(0, 0, min(crop or n_cols, n_cols), min(crop or n_rows, n_rows))
        heights = source.read(1, window=window)
        mask = source.dataset_mask(window=window) > 0
        nodata, crs = source.nodata, source.crs
        a, b, c, d, e, f = source.transform[:6]
        x, y = (one * window.col_off + two * window.row_off for one, two in ((a, b), (d, e)))
        transform = rasterio.Affine(a, b, c + x, d, e, f + y)
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
    with rasterio.open(
        path, "w", driver="GTiff", count=1, height=n_rows, width=n_cols, tiled=True,
        dtype=raster.heights.dtype.name, nodata=raster.nodata, transform=raster.transform,
        crs=raster.crs,
    ) as sink:  # fmt: skip
        sink.write(raster.heights, 1)


def write_cog(source: Path, target: Path, max_error: float, compression: str = "LERC_ZSTD") -> Path:
    """Make a COG of a GeoTIFF as `gdal_translate` does, in its own type, by one thread."""
    import rasterio.shutil

    rasterio.shutil.copy(
        source, target, driver="COG", COMPRESS=compression, MAX_Z_ERROR=repr(max_error),
        BLOCKSIZE="512", OVERVIEWS="AUTO",
    )  # fmt: skip
    return target


def write_pair(source: Path, target: Path, max_error: float, **options) -> dict[str, Path]:
    """Make a file of ours, without meshes, and a COG of a GeoTIFF, beside each other."""
    import terrainwave

    files = {"terrainwave": target.with_suffix(".twz"), "cog": target.with_suffix(".tif")}
    terrainwave.compress(
        source, files["terrainwave"], max_error=max_error, mesh="none", overwrite=True, **options
    )
    write_cog(source, files["cog"], max_error)
    return files


def largest_error(original: np.ndarray, decoded: np.ndarray, mask: np.ndarray) -> float:
    """Return how far valid heights are from the original, in float64."""
    apart = np.abs(decoded.astype(np.float64) - original)
    return float(apart.max(initial=0.0, where=mask))


def make_mirrored(
    source: Path, target: Path, size: int, layout: str = "tiled", spacing: float = 0.0
) -> None:
    """Write a `size` x `size` raster that repeats `source`, every second time mirrored.

    Continuous everywhere, so that it compresses like real ground. With `spacing`, samples are so
    many metres apart.
    """
    with rasterio.open(source) as dataset:
        heights = dataset.read(1)
        profile = {name: dataset.profile[name] for name in ("nodata", "crs", "transform", "dtype")}
    if spacing:
        profile["transform"] = rasterio.Affine(spacing, 0, 0, 0, -spacing, 0)
    rows, columns = (_mirrored_indices(size, period) for period in heights.shape)
    profile |= {"driver": "GTiff", "count": 1, "height": size, "width": size, "BIGTIFF": "IF_SAFER"}
    is_tiled = layout == "tiled"
    profile |= {"tiled": is_tiled, "blockysize": CHUNK if is_tiled else 1}
    if is_tiled:
        profile["blockxsize"] = CHUNK
    with rasterio.Env(GDAL_CACHEMAX=64), rasterio.open(target, "w", **profile) as sink:
        for top in range(0, size, CHUNK):
            part = heights[np.ix_(rows[top : top + CHUNK], columns)]
            sink.write(part, 1, window=Window(0, top, size, part.shape[0]))


def _mirrored_indices(n: int, period: int) -> np.ndarray:
    """Return 0, 1, ... period-1, period-2, ... 1, 0, 1, ...: `n` of them."""
    turn = max(1, 2 * (period - 1))
    position = np.arange(n) % turn
    return np.minimum(position, turn - position) % period


def coefficients_of(heights):
    """Return the wavelet coefficients of whole numbers, as method cdf53 has them."""
    import terrainwave
    from terrainwave.grid.quadtree import Region

    with tempfile.TemporaryDirectory() as folder:
        file, whole = Path(folder, "a.twz"), heights.astype(np.int32)
        terrainwave.compress(whole, file, max_error=0, method="cdf53", mesh="none", verify=False)
        with terrainwave.open(file) as terrain:
            return terrain.decoder.coefficients(terrain.n_levels - 1, Region(0, 0, *heights.shape))


def mirrored_file(dem: Path, size: int, folder: Path, **options) -> Path:
    """Return a mirrored raster compressed with these options, made if it is not there."""
    import terrainwave

    source = folder / f"{dem.stem}-{size}.tif"
    words = "-".join(map(str, options.values()))
    target = folder / f"{source.stem}-{words}.twz"
    if not target.exists():
        if not source.exists():
            make_mirrored(dem, source, size)
        terrainwave.compress(source, target, verify=False, **options)
    return target


def whole_units(path: Path) -> np.ndarray:
    """Return a raster in whole units, voids as the lowest height."""
    with rasterio.open(path) as dataset:
        heights = dataset.read(1, masked=True)
    return np.rint(heights.filled(heights.min())).astype(np.int32)


# --- voids: peers without a mask get the best of several fills, and pay for the mask ---


def void_fills(raster: Raster) -> Iterator[tuple[str, Raster]]:
    """Yield the raster with its voids filled in the ways that suit other codecs.

    Without voids: the raster itself, under the name "none".
    """
    if raster.mask.all() or not raster.mask.any():
        yield "none", raster
        return
    places = ndimage.distance_transform_edt(
        ~raster.mask, return_distances=False, return_indices=True
    )
    nearest = raster.heights[tuple(places)]
    smooth = _smooth_fill(raster, nearest)
    constant = raster.heights.dtype.type(np.median(raster.valid))
    fills = {"nearest": nearest, "smooth": smooth.astype(nearest.dtype), "constant": constant}
    for name, fill in fills.items():
        yield name, replace(raster, heights=np.where(raster.mask, raster.heights, fill))


# A raster with what codecs without masks need; made once, since smooth fills are slow.
Forms = namedtuple("Forms", "raster fills mask_bytes")


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


def vrt_source(
    name: str | Path, part: tuple[int, int, int, int], row: int, col: int,
    nodata: float | None = -32768,
) -> str:  # fmt: skip
    """Return the element of a VRT that puts a part of a file at a place.

    `part` is its first row and column, rows and columns. A relative `name` is beside the VRT.
    """
    first_row, first_col, n_rows, n_cols = part
    size = f'xSize="{n_cols}" ySize="{n_rows}"'
    is_relative = int(not Path(name).is_absolute())
    voids = "" if nodata is None else f"<NODATA>{nodata}</NODATA>"
    return (
        f'<ComplexSource><SourceFilename relativeToVRT="{is_relative}">{name}</SourceFilename>'
        f'<SourceBand>1</SourceBand><SrcRect xOff="{first_col}" yOff="{first_row}" {size}/>'
        f'<DstRect xOff="{col}" yOff="{row}" {size}/>{voids}</ComplexSource>'
    )
