"""Codecs, all asked the same: keep |decoded - original| <= max_error.

How others are treated fairly is in ``benchmarks/README.md``; it is worth up to a factor of two to
them. Fills for voids and margins on bounds are tried in `benchmarks.codecs`.
"""

import functools
import math
import struct
from collections import namedtuple
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import rasterio
import rasterio.shutil

import terrainwave
from benchmarks.rasters import Raster, write_geotiff

Stored = bytes | Path


def stored_size(stored: Stored) -> int:
    """Return the bytes of an encoded raster."""
    return stored.stat().st_size if isinstance(stored, Path) else len(stored)


class Codec:
    """A codec with one setting; each has `encode` and `decode`.

    ``encode(raster, max_error, margin)`` returns what is stored; ``decode(stored, raster,
    max_error)`` heights in the raster's dtype, and uses only shape and grid of `raster`.
    `knows_voids`: the codec stores the mask itself, decoded voids hold nodata. `takes_nan`: float32
    heights may hold NaN where the raster has voids, and come back so. `margins`: factors on the
    bound it is run with, tried in this order until the bound holds.
    """

    name: str
    knows_voids = False
    takes_nan = False
    margins: tuple[float, ...] = (1.0,)
    threads = 1

    def refuses(self, raster: Raster, max_error: float) -> str:
        """Return why the codec cannot do this case; empty if it can."""
        return ""

    def prepare(self, raster: Raster) -> None:
        """Write what `encode` reads; not timed. Does nothing for codecs in memory."""


class Terrainwave(Codec):
    """The project itself, through real files; the whole command with "+" behind the method.

    Else without meshes and without the proof at the end of `compress`.
    """

    knows_voids = True

    def __init__(self, method: str, folder: Path) -> None:
        """Take a method, or a method and an effort: ``predictive-fast``; "×2": two threads."""
        self.name = f"terrainwave-{method}"
        method, _, threads = method.partition("×")
        self.threads, self._is_whole = int(threads or 1), method.endswith("+")
        self._method, _, effort = method.rstrip("+").partition("-")
        self._effort = effort or "default"
        self._source, self._target = folder / "source.tif", folder / f"{self.name}.twz"

    def prepare(self, raster: Raster) -> None:
        """Write the raster as an uncompressed GeoTIFF."""
        write_geotiff(raster, self._source)

    def encode(self, raster: Raster, max_error: float, margin: float) -> Path:
        """Compress the file of `prepare`."""
        terrainwave.compress(
            self._source, self._target, max_error=max_error, method=self._method,
            effort=self._effort, threads=self.threads, verify=self._is_whole,
            mesh="halves" if self._is_whole else "none", overwrite=True,
        )  # fmt: skip
        return self._target

    def decode(self, stored: Stored, raster: Raster, max_error: float) -> np.ndarray:
        """Read the whole raster."""
        with terrainwave.open(stored, threads=self.threads) as terrain:
            return terrain.read()


# Codecs of integers: indices of the largest step that keeps the bound.
# Quantised heights: `first` + (values * `step`) in the raster's units.
Indices = namedtuple("Indices", "values first step")
_QUANTIZER = struct.Struct("<dd")


def quantize_indices(raster: Raster, max_error: float) -> Indices:
    """Quantise with the largest step whose middle is within `max_error` everywhere.

    On a grid an index stands for n neighbouring multiples of the quantum and decodes
    to their middle; integers need n odd, because the middle must be one of them.
    """
    exact = raster.heights.astype(np.float64)
    if not raster.quantum:
        step = 2 * (max_error - raster.ulp)
        first = exact.min()
        return Indices(np.rint((exact - first) / step).astype(np.int64), first, step)
    quanta = np.rint(exact / raster.quantum).astype(np.int64)
    ratio = max_error / raster.quantum
    n = 2 * math.floor(ratio + 1e-9) + 1
    if not raster.is_integer:
        n = math.floor(2 * ratio + 1e-9) + 1
    lowest = int(quanta.min())
    first = (lowest + (n - 1) / 2) * raster.quantum
    return Indices((quanta - lowest) // n, first, n * raster.quantum)


def dequantize_indices(values: np.ndarray, first: float, step: float, dtype) -> np.ndarray:
    """Undo `quantize_indices`: heights in `dtype`, clipped to its range."""
    return _to_dtype(first + values.astype(np.float64) * step, dtype)


def _to_dtype(heights: np.ndarray, dtype) -> np.ndarray:
    if np.dtype(dtype).kind in "iu":
        limits = np.iinfo(dtype)
        heights = np.clip(np.rint(heights), limits.min, limits.max)
    return heights.astype(dtype)


class _JpegXl(Codec):
    """JPEG XL, lossless modular mode, of 16-bit indices; on one thread."""

    def __init__(self, effort: int) -> None:
        import imagecodecs

        self._library, self._effort, self.name = imagecodecs, effort, f"jxl-e{effort}"

    def refuses(self, raster: Raster, max_error: float) -> str:
        """Refuse more than 65536 indices, and steps smaller than floats can carry."""
        if not raster.quantum and max_error <= raster.ulp:
            return "bound below the dtype's precision"
        n_indices = quantize_indices(raster, max_error).values.max() + 1
        return "more than 65536 indices" if n_indices > 65536 else ""

    def encode(self, raster: Raster, max_error: float, margin: float) -> bytes:
        values, *quantizer = quantize_indices(raster, max_error)
        image = values.astype(np.uint8 if values.max() < 256 else np.uint16)
        packed = self._library.jpegxl_encode(
            image, lossless=True, effort=self._effort, numthreads=1
        )
        return _QUANTIZER.pack(*quantizer) + packed

    def decode(self, stored: bytes, raster: Raster, max_error: float) -> np.ndarray:
        values = self._library.jpegxl_decode(stored[_QUANTIZER.size :], numthreads=1)
        return dequantize_indices(values, *_QUANTIZER.unpack_from(stored), raster.heights.dtype)


def float_bound(raster: Raster, max_error: float) -> float:
    """Return the widest absolute bound for float32 that rounding back still keeps."""
    if not raster.quantum:
        return max_error - raster.ulp
    whole = math.floor(max_error / raster.quantum + 1e-9) * raster.quantum
    return whole + 0.4999 * raster.quantum - raster.ulp


def snap_to_grid(heights: np.ndarray, raster: Raster) -> np.ndarray:
    """Round decoded floats to the raster's quantum and dtype."""
    exact = heights.astype(np.float64).reshape(raster.heights.shape)
    if raster.quantum:
        exact = np.rint(exact / raster.quantum) * raster.quantum
    return _to_dtype(exact, raster.heights.dtype)


@dataclass
class _FloatCodec(Codec):
    """A codec of float32 with an absolute error bound.

    `pack` takes heights and the bound; `unpack` what it returned, and the shape.
    """

    name: str
    pack: Callable[[np.ndarray, float], Stored]
    unpack: Callable[[Any, tuple[int, int]], np.ndarray]
    takes_nan: bool = False
    margins = (1.0, 0.999, 0.99, 0.95)

    def refuses(self, raster: Raster, max_error: float) -> str:
        return "" if float_bound(raster, max_error) > 0 else "bound below float32"

    def encode(self, raster: Raster, max_error: float, margin: float) -> Stored:
        return self.pack(raster.heights.astype(np.float32), float_bound(raster, max_error) * margin)

    def decode(self, stored: Stored, raster: Raster, max_error: float) -> np.ndarray:
        return snap_to_grid(self.unpack(stored, raster.heights.shape), raster)


def sperr() -> Codec:
    """Return SPERR, wavelet and outlier coder with a point-wise error bound, one thread."""
    import imagecodecs as library

    return _FloatCodec(
        "sperr",
        lambda heights, bound: library.sperr_encode(heights, level=bound, mode="pwe", numthreads=1),
        lambda stored, _shape: library.sperr_decode(stored, numthreads=1),
    )


def sz3() -> Codec:
    """Return SZ3 with its default algorithm."""
    import imagecodecs as library

    return _FloatCodec(
        "sz3",
        lambda heights, bound: library.sz3_encode(heights, mode="abs", abs=bound),
        lambda stored, shape: library.sz3_decode(stored, shape=shape, dtype=np.float32),
    )


def sz3_interpolation() -> Codec:
    """Return SZ3 with its interpolation predictor, which wins at low rates."""
    import pysz as library

    def pack(heights: np.ndarray, bound: float) -> bytes:
        config = library.szConfig(heights.shape)
        config.errorBoundMode = library.szErrorBoundMode.ABS
        config.absErrorBound = bound
        config.cmprAlgo = library.szAlgorithm.INTERP
        return library.sz.compress(heights, config)[0].tobytes()

    def unpack(stored: bytes, shape: tuple[int, int]) -> np.ndarray:
        return library.sz.decompress(np.frombuffer(stored, np.uint8), np.float32, shape)[0]

    return _FloatCodec("sz3-interp", pack, unpack)


def cog_lerc(folder: Path, threads: int = 1) -> Codec:
    """Return cloud-optimised GeoTIFF with LERC_ZSTD and overviews, what GIS users have today.

    float32 at the widened bound: 15 % smaller at 1 m than LERC on the same heights as
    int16, which quantises with 2 * max_error instead of 2 * max_error + 1.
    """

    def pack(heights: np.ndarray, bound: float) -> Path:
        n_rows, n_cols = heights.shape
        profile = {"count": 1, "height": n_rows, "width": n_cols, "dtype": "float32"}
        if np.isnan(heights).any():
            profile["nodata"] = np.nan
        with rasterio.MemoryFile() as memory:
            with memory.open(driver="GTiff", **profile) as sink:
                sink.write(heights, 1)
            with memory.open() as source:
                rasterio.shutil.copy(
                    source, folder / "cog.tif", driver="COG", COMPRESS="LERC_ZSTD",
                    MAX_Z_ERROR=repr(bound), MAX_Z_ERROR_OVERVIEW=repr(bound), BLOCKSIZE="512",
                    OVERVIEWS="AUTO", NUM_THREADS=str(threads),
                )  # fmt: skip
        return folder / "cog.tif"

    def unpack(stored: Path, _shape: tuple[int, int]) -> np.ndarray:
        with rasterio.open(stored, NUM_THREADS=threads) as source:
            return source.read(1)

    codec = _FloatCodec("cog-overviews" + "×2" * (threads > 1), pack, unpack, takes_nan=True)
    codec.threads = threads
    return codec


PEERS: dict[str, Callable[[Path], Codec]] = {
    "sperr": lambda _folder: sperr(),
    "sz3": lambda _folder: sz3(),
    "sz3-interp": lambda _folder: sz3_interpolation(),
    "jxl-e9": lambda _folder: _JpegXl(9),
    "jxl-e7": lambda _folder: _JpegXl(7),
    "cog-overviews": cog_lerc,
    "cog-overviews×2": functools.partial(cog_lerc, threads=2),
}
NAMES = ("terrainwave", *PEERS)


def make_codecs(names: Iterable[str], methods: Iterable[str], folder: Path) -> list[Codec]:
    """Return the codecs named, one per method for ours; say which are not installed."""
    codecs: list[Codec] = []
    for name in names:
        try:
            if name == "terrainwave":
                codecs += [Terrainwave(method, folder) for method in methods]
            else:
                codecs.append(PEERS[name](folder))
        except ImportError as error:
            click.echo(f"{name}: not installed ({error})")
    if not codecs:
        raise click.UsageError("none of the codecs is installed")
    return codecs
