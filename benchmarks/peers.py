"""Codecs, all asked the same: keep |decoded - original| <= max_error.

Each is timed doing what its own user does, and nothing else: `Calls`. How others are treated fairly
is in ``benchmarks/README.md``. Fills for voids and margins on bounds are tried in
`benchmarks.codecs`.
"""

import math
from collections import namedtuple
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
import rasterio
import rasterio.shutil

import terrainwave
from benchmarks.rasters import Raster, write_geotiff

Stored = bytes | Path
# The two calls of a codec's user, which are timed, and what makes them comparable, which is not:
# ``encode()`` takes what the user has, a GeoTIFF on disk or an array, to what is stored;
# ``decode(stored)`` returns an array of the codec's own type; ``heights(array)`` makes of it
# heights in the raster's dtype and on its grid.
Calls = namedtuple("Calls", "encode decode heights")


def stored_size(stored: Stored) -> int:
    """Return the bytes of an encoded raster."""
    return stored.stat().st_size if isinstance(stored, Path) else len(stored)


def as_they_are(heights: np.ndarray) -> np.ndarray:
    """Return heights of a codec that knows the raster's type and grid."""
    return heights


class Codec:
    """A codec with one setting.

    `knows_voids`: it may store the mask itself; decoded voids then hold nodata. `takes_fills`: it
    is tried with voids filled, and pays for the mask. `margins`: factors on the bound it is run
    with, tried in this order until the bound holds.
    """

    name: str
    knows_voids = False
    takes_fills = True
    margins: tuple[float, ...] = (1.0,)

    def takes_nan(self, raster: Raster) -> bool:
        """Return whether voids may be NaN."""
        return False

    def refuses(self, raster: Raster, max_error: float) -> str:
        """Return why the codec cannot do this case; empty if it can."""
        return ""

    def calls(self, raster: Raster, max_error: float, margin: float) -> Calls:
        """Make what the codec's user has, and return what the user calls."""
        raise NotImplementedError


class Terrainwave(Codec):
    """The project itself, from a GeoTIFF; the whole command with "+" behind the method.

    Else without meshes and without the proof at the end of `compress`.
    """

    knows_voids = True
    takes_fills = False

    def __init__(self, method: str, folder: Path) -> None:
        """Take a method, or a method and an effort: ``predictive-fast``."""
        self.name = f"terrainwave-{method}"
        self._is_whole = method.endswith("+")
        self._method, _, effort = method.rstrip("+").partition("-")
        self._effort = effort or "default"
        self._source, self._target = (
            folder / f"{self.name}{end}" for end in ("-source.tif", ".twz")
        )

    def calls(self, raster: Raster, max_error: float, margin: float) -> Calls:
        """Write the raster as an uncompressed GeoTIFF; return `compress`, and `open` and read."""
        write_geotiff(raster, self._source)
        options: dict[str, Any] = {"method": self._method, "effort": self._effort}
        options |= {} if self._is_whole else {"verify": False, "mesh": "none"}

        def encode() -> Path:
            terrainwave.compress(
                self._source, self._target, max_error=max_error, threads=1,
                overwrite=True, **options,
            )  # fmt: skip
            return self._target

        def decode(stored: Path) -> np.ndarray:
            with terrainwave.open(stored, threads=1) as terrain:
                return terrain.read()

        return Calls(encode, decode, as_they_are)


class _Cog(Codec):
    """A Cloud Optimized GeoTIFF, which GDAL makes of a GeoTIFF and reads; with overviews, or bare.

    In the raster's own type, as its user makes it; or as float32 at the widened bound, which is
    smaller: LERC of integers quantises with 2 * max_error, where 2 * max_error + 1 would do.
    """

    def __init__(
        self, folder: Path, name: str, *, compress: str = "LERC_ZSTD", as_float: bool = False,
        overviews: str = "AUTO",
    ) -> None:  # fmt: skip
        self.name = name
        self.knows_voids = not as_float
        # Where a float is decoded a rounding beyond the bound.
        self.margins = (1.0, 0.999, 0.99, 0.95)
        self._as_float, self._compress, self._overviews = as_float, compress, overviews
        self._source, self._target = (
            folder / f"{self.name}{end}" for end in ("-source.tif", ".tif")
        )

    def takes_nan(self, raster: Raster) -> bool:
        return self._as_float or not raster.is_integer

    def refuses(self, raster: Raster, max_error: float) -> str:
        if self._compress != "LERC_ZSTD":
            return "lossless alone" if max_error else ""
        if self._as_float and not raster.quantum:
            return "the same as in the raster's own type"
        return "" if not self._as_float or float_bound(raster, max_error) > 0 else "below float32"

    def calls(self, raster: Raster, max_error: float, margin: float) -> Calls:
        bound, heights = max_error, as_they_are
        if self._as_float:
            bound, heights = float_bound(raster, max_error), partial(snap_to_grid, raster=raster)
            raster = replace(raster, heights=raster.heights.astype(np.float32), nodata=None)
        if np.isnan(raster.heights).any():
            raster = replace(raster, nodata=math.nan)
        write_geotiff(raster, self._source)
        options = {"COMPRESS": self._compress, "BLOCKSIZE": "512", "OVERVIEWS": self._overviews}
        if self._compress != "LERC_ZSTD":
            options["PREDICTOR"] = "YES"
        else:
            error = repr(bound * margin)
            options |= {"MAX_Z_ERROR": error, "MAX_Z_ERROR_OVERVIEW": error}

        def encode() -> Path:
            rasterio.shutil.copy(self._source, self._target, driver="COG", **options)
            return self._target

        def decode(stored: Path) -> np.ndarray:
            with rasterio.open(stored) as source:
                return source.read(1)

        return Calls(encode, decode, heights)


class _CogOfSteps(_Cog):
    """A lossless Cloud Optimized GeoTIFF of whole steps, with the step as the band's scale."""

    def refuses(self, raster: Raster, max_error: float) -> str:
        return "a bound alone" if max_error == 0 else ""

    def takes_nan(self, raster: Raster) -> bool:
        return False

    def calls(self, raster: Raster, max_error: float, margin: float) -> Calls:
        void, dtype = -1, raster.heights.dtype
        filled = np.where(raster.mask, raster.heights, raster.valid.min())
        values, *quantizer = quantize_indices(replace(raster, heights=filled), max_error)
        is_short = values[raster.mask].max(initial=0) < 1 << 15
        steps = np.where(raster.mask, values, void).astype(np.int16 if is_short else np.int32)
        whole = replace(raster, heights=steps, nodata=None if raster.mask.all() else void)

        def heights(decoded: np.ndarray) -> np.ndarray:
            found = dequantize_indices(decoded, *quantizer, dtype)
            nodata = math.nan if raster.nodata is None else raster.nodata
            return (
                found if raster.mask.all() else np.where(decoded == void, dtype.type(nodata), found)
            )

        calls = super().calls(whole, 0, 1.0)
        with rasterio.open(self._source, "r+") as source:
            source.offsets, source.scales = quantizer[:1], quantizer[1:]
        return calls._replace(heights=heights)


# Codecs of integers: indices of the largest step that keeps the bound.
# Quantised heights: `first` + (values * `step`) in the raster's units.
Indices = namedtuple("Indices", "values first step")


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
    """JPEG XL, lossless modular mode, of an image of indices, 8 or 16 bits; on one thread."""

    def __init__(self, effort: int) -> None:
        import imagecodecs

        self._library, self._effort, self.name = imagecodecs, effort, f"jxl-e{effort}"

    def refuses(self, raster: Raster, max_error: float) -> str:
        """Refuse more than 65536 indices, and steps smaller than floats can carry."""
        if not raster.quantum and max_error <= raster.ulp:
            return "bound below the dtype's precision"
        valid = replace(raster, heights=raster.valid, mask=np.ones(raster.valid.shape, bool))
        n_indices = quantize_indices(valid, max_error).values.max() + 1
        return "more than 65536 indices" if n_indices > 65536 else ""

    def calls(self, raster: Raster, max_error: float, margin: float) -> Calls:
        values, *quantizer = quantize_indices(raster, max_error)
        image = values.astype(np.uint8 if values.max() < 256 else np.uint16)
        library, dtype = self._library, raster.heights.dtype
        return Calls(
            lambda: library.jpegxl_encode(image, lossless=True, effort=self._effort, numthreads=1),
            lambda stored: library.jpegxl_decode(stored, numthreads=1),
            lambda decoded: dequantize_indices(decoded, *quantizer, dtype),
        )


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


class _FloatCodec(Codec):
    """A codec of float32 arrays with an absolute error bound.

    `pack` takes an array and the bound; `unpack` what it returned, and the shape.
    """

    margins = (1.0, 0.999, 0.99, 0.95)

    def __init__(
        self, name: str, pack: Callable[[np.ndarray, float], Any],
        unpack: Callable[[Any, tuple[int, int]], np.ndarray],
    ) -> None:  # fmt: skip
        self.name, self._pack, self._unpack = name, pack, unpack

    def refuses(self, raster: Raster, max_error: float) -> str:
        return "" if float_bound(raster, max_error) > 0 else "bound below float32"

    def calls(self, raster: Raster, max_error: float, margin: float) -> Calls:
        array, bound = raster.heights.astype(np.float32), float_bound(raster, max_error) * margin
        return Calls(
            lambda: self._pack(array, bound),
            lambda stored: self._unpack(stored, array.shape),
            lambda decoded: snap_to_grid(decoded, raster),
        )


def sperr(_folder: Path) -> Codec:
    """Return SPERR, wavelet and outlier coder with a point-wise error bound, one thread."""
    import imagecodecs as library

    return _FloatCodec(
        "sperr",
        lambda array, bound: library.sperr_encode(array, level=bound, mode="pwe", numthreads=1),
        lambda stored, _shape: library.sperr_decode(stored, numthreads=1),
    )


def sz3(_folder: Path) -> Codec:
    """Return SZ3 with its default algorithm."""
    import imagecodecs as library

    return _FloatCodec(
        "sz3",
        lambda array, bound: library.sz3_encode(array, mode="abs", abs=bound),
        lambda stored, shape: library.sz3_decode(stored, shape=shape, dtype=np.float32),
    )


def sz3_interpolation(_folder: Path) -> Codec:
    """Return SZ3 with its interpolation predictor, which wins at low rates."""
    import pysz as library

    def pack(array: np.ndarray, bound: float) -> np.ndarray:
        config = library.szConfig(array.shape)
        config.errorBoundMode = library.szErrorBoundMode.ABS
        config.absErrorBound = bound
        config.cmprAlgo = library.szAlgorithm.INTERP
        return library.sz.compress(array, config)[0]

    def unpack(stored: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        return library.sz.decompress(stored, np.float32, shape)[0]

    return _FloatCodec("sz3-interp", pack, unpack)


class _Lerc(Codec):
    """LERC alone, of an array in the raster's own type."""

    name = "lerc"
    margins = (1.0, 0.999, 0.99, 0.95)

    def __init__(self, _folder: Path) -> None:
        import imagecodecs

        self._library = imagecodecs

    def calls(self, raster: Raster, max_error: float, margin: float) -> Calls:
        array, library = raster.heights, self._library
        return Calls(
            lambda: library.lerc_encode(array, level=max_error * margin),
            library.lerc_decode, as_they_are,
        )  # fmt: skip


PEERS: dict[str, Callable[[Path], Codec]] = {
    "sperr": sperr, "sz3": sz3, "sz3-interp": sz3_interpolation, "lerc": _Lerc,
    "jxl-e9": lambda _folder: _JpegXl(9),
    "jxl-e7": lambda _folder: _JpegXl(7),
    # The encoder's fast mode for lossless images.
    "jxl-e1": lambda _folder: _JpegXl(1),
}  # fmt: skip
# Kinds of Cloud Optimized GeoTIFFs, and their options.
_BARE = {"overviews": "NONE"}
_COGS: dict[str, tuple[type[_Cog], dict[str, Any]]] = {
    "cog": (_Cog, {}),
    "cog-float32": (_Cog, {"as_float": True}),
    "cog-zstd": (_Cog, {"compress": "ZSTD"}),
    "cog-bare": (_Cog, _BARE),
    "cog-float32-bare": (_Cog, {"as_float": True} | _BARE),
    "cog-steps-zstd": (_CogOfSteps, {"compress": "ZSTD"}),
    "cog-steps-zstd-bare": (_CogOfSteps, {"compress": "ZSTD"} | _BARE),
    "cog-steps-deflate": (_CogOfSteps, {"compress": "DEFLATE"}),
}
PEERS |= {name: partial(kind, name=name, **more) for name, (kind, more) in _COGS.items()}


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
