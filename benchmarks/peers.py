"""One small class per codec, all asked the same: keep |decoded - original| <= max_error.

How other codecs are treated fairly (measured: it is worth up to a factor of two to them):

- Codecs of integers ("index codecs") get the heights quantised beforehand with the largest
  step that keeps the bound, then code those indices without loss.
- Codecs of floats, on data with a vertical quantum, run at max_error + 0.4999 quantum, and
  the result is rounded back to the grid.
- Codecs that overshoot get a slightly smaller bound until the decoded result keeps it.
- Where the raster has voids, `benchmarks.measure` gives codecs without masks the best of
  several fills and charges them the mask's bytes.
"""

import math
import struct
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rasterio
import rasterio.shutil

from benchmarks.rasters import Raster, write_geotiff

Stored = bytes | Path


def stored_size(stored: Stored) -> int:
    """Return the bytes of an encoded raster."""
    return stored.stat().st_size if isinstance(stored, Path) else len(stored)


class Codec(ABC):
    """A codec with one setting.

    Attributes
    ----------
    name : str
        As in tables and on the command line.
    knows_voids : bool
        True if the codec stores the mask itself; decoded voids then hold nodata.
    takes_nan : bool
        True if float32 heights may hold NaN where the raster has voids, and come back so.
    margins : tuple of float
        Factors on the bound it is run with, tried in this order until the bound holds.
    """

    name: str
    knows_voids = False
    takes_nan = False
    margins: tuple[float, ...] = (1.0,)

    def refuses(self, raster: Raster, max_error: float) -> str:
        """Return why the codec cannot do this case; empty if it can."""
        return ""

    def prepare(self, raster: Raster) -> None:
        """Write what `encode` reads; not timed. Does nothing for codecs in memory."""
        return

    @abstractmethod
    def encode(self, raster: Raster, max_error: float, margin: float) -> Stored:
        """Return the encoded raster."""

    @abstractmethod
    def decode(self, stored: Stored, raster: Raster, max_error: float) -> np.ndarray:
        """Return heights in the raster's dtype; of `raster` use only shape and grid."""


# --- terrainwave ---


@dataclass
class Terrainwave(Codec):
    """The project itself, through real files, without the proof at the end of `compress`.

    `method` may name an effort: ``predictive-fast``.
    """

    method: str
    folder: Path
    knows_voids = True

    def __post_init__(self) -> None:
        """Check that the package is there."""
        import terrainwave

        self._package = terrainwave
        self.name = f"terrainwave-{self.method}"

    def prepare(self, raster: Raster) -> None:
        """Write the raster as an uncompressed GeoTIFF."""
        write_geotiff(raster, self.folder / "source.tif")

    def encode(self, raster: Raster, max_error: float, margin: float) -> Path:
        """Compress the file of `prepare`."""
        target = self.folder / f"{self.name}.twz"
        self._package.compress(
            self.folder / "source.tif",
            target,
            max_error=max_error,
            method=self.method.partition("-")[0],
            effort=self.method.partition("-")[2] or "default",
            threads=1,
            verify=False,
            mesh="none",
            overwrite=True,
        )
        return target

    def decode(self, stored: Stored, raster: Raster, max_error: float) -> np.ndarray:
        """Read the whole raster."""
        with self._package.open(stored, threads=1) as terrain:
            return terrain.read()


# --- codecs of integers: indices of the largest step that keeps the bound ---


@dataclass(frozen=True)
class Indices:
    """Quantised heights: `first` + (index * step) in the raster's units."""

    values: np.ndarray
    first: float
    step: float


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
    heights = first + values.astype(np.float64) * step
    if np.dtype(dtype).kind in "iu":
        limits = np.iinfo(dtype)
        heights = np.clip(np.rint(heights), limits.min, limits.max)
    return heights.astype(dtype)


_QUANTIZER = struct.Struct("<dd")


class IndexCodec(Codec):
    """Base of the lossless image codecs; they take 8- or 16-bit samples."""

    @abstractmethod
    def pack(self, image: np.ndarray) -> bytes:
        """Encode a uint8 or uint16 image without loss."""

    @abstractmethod
    def unpack(self, stored: bytes) -> np.ndarray:
        """Decode what `pack` made."""

    def refuses(self, raster: Raster, max_error: float) -> str:
        """Refuse more than 65536 indices, and steps smaller than floats can carry."""
        if not raster.quantum and max_error <= raster.ulp:
            return "bound below the dtype's precision"
        n_indices = quantize_indices(raster, max_error).values.max() + 1
        return "more than 65536 indices" if n_indices > 65536 else ""

    def encode(self, raster: Raster, max_error: float, margin: float) -> bytes:
        """Quantise and pack, behind 16 bytes for the quantiser."""
        indices = quantize_indices(raster, max_error)
        header = _QUANTIZER.pack(indices.first, indices.step)
        # JPEG-LS is up to 6 % smaller where it knows that 8 bits are enough.
        sample = np.uint8 if indices.values.max() < 256 else np.uint16
        return header + self.pack(indices.values.astype(sample))

    def decode(self, stored: Stored, raster: Raster, max_error: float) -> np.ndarray:
        """Unpack and dequantise."""
        assert isinstance(stored, bytes)
        first, step = _QUANTIZER.unpack_from(stored)
        values = self.unpack(stored[_QUANTIZER.size :])
        return dequantize_indices(values, first, step, raster.heights.dtype)


@dataclass
class JpegXl(IndexCodec):
    """JPEG XL, lossless modular mode."""

    effort: int

    def __post_init__(self) -> None:
        """Find the library."""
        import imagecodecs

        self._library = imagecodecs
        self.name = f"jxl-e{self.effort}"

    def pack(self, image: np.ndarray) -> bytes:
        """Encode on one thread."""
        return self._library.jpegxl_encode(image, lossless=True, effort=self.effort, numthreads=1)

    def unpack(self, stored: bytes) -> np.ndarray:
        """Decode on one thread."""
        return self._library.jpegxl_decode(stored, numthreads=1)


@dataclass
class JpegLs(IndexCodec):
    """JPEG-LS, lossless."""

    name: str = "jpeg-ls"

    def __post_init__(self) -> None:
        """Find the library."""
        import imagecodecs

        self._library = imagecodecs

    def pack(self, image: np.ndarray) -> bytes:
        """Encode."""
        return self._library.jpegls_encode(image, level=0)

    def unpack(self, stored: bytes) -> np.ndarray:
        """Decode."""
        return self._library.jpegls_decode(stored)


# --- codecs of floats: a wider bound, then back to the grid ---


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
    if raster.is_integer:
        limits = np.iinfo(raster.heights.dtype)
        exact = np.clip(exact, limits.min, limits.max)
    return exact.astype(raster.heights.dtype)


class FloatCodec(Codec):
    """Base of the codecs with an absolute error bound on float32."""

    margins = (1.0, 0.999, 0.99, 0.95)

    @abstractmethod
    def pack(self, heights: np.ndarray, bound: float) -> Stored:
        """Encode float32 heights."""

    @abstractmethod
    def unpack(self, stored: Stored, shape: tuple[int, int]) -> np.ndarray:
        """Decode what `pack` made."""

    def refuses(self, raster: Raster, max_error: float) -> str:
        """Refuse bounds below the precision of float32."""
        return "" if float_bound(raster, max_error) > 0 else "bound below float32"

    def encode(self, raster: Raster, max_error: float, margin: float) -> Stored:
        """Pack as float32."""
        bound = float_bound(raster, max_error) * margin
        return self.pack(raster.heights.astype(np.float32), bound)

    def decode(self, stored: Stored, raster: Raster, max_error: float) -> np.ndarray:
        """Unpack and round back to the grid."""
        return snap_to_grid(self.unpack(stored, raster.heights.shape), raster)


@dataclass
class Sperr(FloatCodec):
    """SPERR: wavelet and outlier coder with a point-wise error bound."""

    name: str = "sperr"

    def __post_init__(self) -> None:
        """Find the library."""
        import imagecodecs

        self._library = imagecodecs

    def pack(self, heights: np.ndarray, bound: float) -> bytes:
        """Encode on one thread."""
        return self._library.sperr_encode(heights, level=bound, mode="pwe", numthreads=1)

    def unpack(self, stored: Stored, shape: tuple[int, int]) -> np.ndarray:
        """Decode on one thread."""
        return self._library.sperr_decode(stored, numthreads=1)


@dataclass
class Sz3(FloatCodec):
    """SZ3 with its default algorithm."""

    name: str = "sz3"

    def __post_init__(self) -> None:
        """Find the library."""
        import imagecodecs

        self._library = imagecodecs

    def pack(self, heights: np.ndarray, bound: float) -> bytes:
        """Encode."""
        return self._library.sz3_encode(heights, mode="abs", abs=bound)

    def unpack(self, stored: Stored, shape: tuple[int, int]) -> np.ndarray:
        """Decode."""
        return self._library.sz3_decode(stored, shape=shape, dtype=np.float32)


@dataclass
class Sz3Interpolation(FloatCodec):
    """SZ3 with its interpolation predictor, which wins at low rates."""

    name: str = "sz3-interp"

    def __post_init__(self) -> None:
        """Find the library."""
        import pysz

        self._library = pysz

    def pack(self, heights: np.ndarray, bound: float) -> bytes:
        """Encode."""
        config = self._library.szConfig(heights.shape)
        config.errorBoundMode = self._library.szErrorBoundMode.ABS
        config.absErrorBound = bound
        config.cmprAlgo = self._library.szAlgorithm.INTERP
        packed, _ratio = self._library.sz.compress(heights, config)
        return packed.tobytes()

    def unpack(self, stored: Stored, shape: tuple[int, int]) -> np.ndarray:
        """Decode."""
        packed = np.frombuffer(stored, np.uint8)
        heights, _config = self._library.sz.decompress(packed, np.float32, shape)
        return heights


@dataclass
class Lerc(FloatCodec):
    """LERC2 as one blob, without a second compressor."""

    name: str = "lerc"

    def __post_init__(self) -> None:
        """Find the library."""
        import imagecodecs

        self._library = imagecodecs

    def pack(self, heights: np.ndarray, bound: float) -> bytes:
        """Encode."""
        return self._library.lerc_encode(heights, level=bound)

    def unpack(self, stored: Stored, shape: tuple[int, int]) -> np.ndarray:
        """Decode."""
        return self._library.lerc_decode(stored)


@dataclass
class CogLerc(FloatCodec):
    """Cloud-optimised GeoTIFF with LERC_ZSTD, what GIS users have today.

    float32 at the widened bound: 15 % smaller at 1 m than LERC on the same heights as
    int16, which quantises with 2 * max_error instead of 2 * max_error + 1.
    """

    folder: Path
    has_overviews: bool
    name: str = field(init=False)
    takes_nan = True

    def __post_init__(self) -> None:
        """Name it."""
        self.name = "cog-overviews" if self.has_overviews else "cog"

    def pack(self, heights: np.ndarray, bound: float) -> Path:
        """Write a GeoTIFF in memory, then copy it as COG."""
        target = self.folder / f"{self.name}.tif"
        n_rows, n_cols = heights.shape
        profile = {"count": 1, "height": n_rows, "width": n_cols, "dtype": "float32"}
        if np.isnan(heights).any():
            profile["nodata"] = np.nan
        with rasterio.MemoryFile() as memory:
            with memory.open(driver="GTiff", **profile) as sink:
                sink.write(heights, 1)
            with memory.open() as source:
                rasterio.shutil.copy(
                    source,
                    target,
                    driver="COG",
                    COMPRESS="LERC_ZSTD",
                    MAX_Z_ERROR=repr(bound),
                    MAX_Z_ERROR_OVERVIEW=repr(bound),
                    BLOCKSIZE="512",
                    OVERVIEWS="AUTO" if self.has_overviews else "NONE",
                )
        return target

    def unpack(self, stored: Stored, shape: tuple[int, int]) -> np.ndarray:
        """Read the full grid."""
        with rasterio.open(stored) as source:
            return source.read(1)


# --- the list ---

PEERS = (
    "lerc",
    "cog",
    "cog-overviews",
    "sperr",
    "sz3",
    "sz3-interp",
    "jxl-e7",
    "jxl-e9",
    "jpeg-ls",
)
NAMES = ("terrainwave", *PEERS)


def make_codecs(name: str, methods: list[str], folder: Path) -> list[Codec]:
    """Return the codecs that `name` stands for: one, or one per method of ours.

    Raises
    ------
    ImportError
        If its library is not installed.
    """
    if name == "terrainwave":
        return [Terrainwave(method, folder) for method in methods]
    makers = {
        "lerc": Lerc,
        "cog": lambda: CogLerc(folder, has_overviews=False),
        "cog-overviews": lambda: CogLerc(folder, has_overviews=True),
        "sperr": Sperr,
        "sz3": Sz3,
        "sz3-interp": Sz3Interpolation,
        "jxl-e7": lambda: JpegXl(7),
        "jxl-e9": lambda: JpegXl(9),
        "jpeg-ls": JpegLs,
    }
    return [makers[name]()]
