"""One band of a raster, read window by window."""

import math
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numpy as np

from terrainwave import interrupts
from terrainwave.arguments import (
    check_flags,
    checked_path,
    checked_whole,
    is_twz_name,
    number_of,
    shown,
)
from terrainwave.errors import (
    InvalidArgumentError,
    InvalidHeightsError,
    TerrainwaveWarning,
)
from terrainwave.grid.affine import IDENTITY, Transform
from terrainwave.grid.quadtree import Region
from terrainwave.raster_io.arrays import ArrayBackend, Claim, LabelledBackend
from terrainwave.raster_io.backend import RasterBackend, Readers
from terrainwave.raster_io.dataset import DatasetBackend, is_twz, open_dataset
from terrainwave.raster_io.earlier_loss import EarlierLoss
from terrainwave.raster_io.even import Even, even_parts, is_seen
from terrainwave.raster_io.gdal import scan_windows
from terrainwave.raster_io.mosaic import MosaicBackend
from terrainwave.raster_io.raster_info import (
    SUPPORTED_DTYPES,
    RasterInfo,
    fit_nodata,
    stored_nodata,
)

# What to convert an unsupported type to; the narrowest of ours that holds all of its values, or
# the one that holds elevations in practice.
_CONVERT_TO = {
    "int8": "int16",
    "uint32": "int32 (or float64 above 2147483647)",
    "int64": "int32",
    "uint64": "int32",
    "float16": "float32",
    "bool": "uint8",
}
_GDAL_NAMES = {
    "uint8": "Byte",
    "int16": "Int16",
    "uint16": "UInt16",
    "int32": "Int32",
    "float32": "Float32",
    "float64": "Float64",
}


# Opens a .twz file, given by its path or open already, as a raster.
OpenTerrain = Callable[..., RasterBackend]
# A window narrower than this fraction of the width decodes mostly samples it does not want.
_NARROW_COLS = 1024
# Samples a side of the smallest parts of windows that are asked whether they are even.
_EVEN_SIDE = 512
_BAND_ROWS = 4096
# Samples per window of a sequential scan: large against GDAL's overhead per call, and several
# of a small raster, so that threads share them.
_SCAN_SAMPLES = 1 << 19


class RasterSource:
    """One band of a raster, read window by window.

    Parameters
    ----------
    source : path, rasterio dataset, list of these, ndarray, masked array, DataArray or Dataset
        What to read. A list is a mosaic: rasters of one grid, of which the last counts where they
        overlap. A dataset of rasterio is not closed; those of xarray may be lazy. With
        `open_terrain` also .twz files, by their paths or open.
    band : int
        Number of the band, from 1. Band 1 of several is noted, as it may not be a choice.
    nodata : int or float, optional
        Replaces the declared nodata value.
    georeference : bool
        False leaves place and CRS out, whatever the source says of them.
    warn : bool
        Issue `notes` as warnings; tasks that open the same raster again don't.
    open_terrain : callable, optional
        Opens a .twz file as a raster (`file.raster`); without it they are refused.

    Attributes
    ----------
    info : RasterInfo
        Everything but the heights.
    name : str
        How messages call the source.
    notes : tuple of str
        What the source left out or chose, one sentence each; issued as `TerrainwaveWarning`, but
        for bands beside one that was chosen, and for what the heights give again.
    n_bytes_read : int
        Bytes of heights, as numbers, that have been read so far.
    is_striped : bool
        True if a narrow window makes the source decode much wider ones: a scan in the order of
        `blocks` is then many times cheaper than small windows.

    Raises
    ------
    InvalidHeightsError
        If the band is missing, its type is unsupported, the array is not 2-D or empty, or
        `nodata` does not fit the type; or if a .twz file is given.
    StorageError
        If the file is missing or no raster.

    Notes
    -----
    Thread-safe. A GDAL dataset serves one thread at a time: a local GeoTIFF is opened again for
    each further thread, others are read by one thread at a time. A dataset that the caller passed
    must not be used elsewhere meanwhile, and nothing may be read while `close` runs.
    """

    def __init__(
        self,
        source: Any,
        *,
        band: int = 1,
        nodata: int | float | None = None,
        georeference: bool = True,
        warn: bool = True,
        open_terrain: OpenTerrain | None = None,
    ) -> None:
        check_flags(georeference=georeference)
        band = checked_whole("band", band, least=1)
        if nodata is not None:
            given, nodata = nodata, number_of(nodata)
            if nodata is None:
                raise InvalidArgumentError(
                    f"found `nodata` {shown(given)}, expected a number, or nan"
                )
        self._counting = threading.Lock()
        self.n_bytes_read = 0
        opening = _Opening(band, nodata, georeference, open_terrain)
        self._backend = opening.backend(source)
        self._readers = Readers(self._backend)
        self.name: str = self._backend.name
        try:
            notes = list(self._backend.notes())
            self.info = self._complete_info(nodata, notes)
        except BaseException:
            self.close()
            raise
        self.notes = (*notes, *self._asides())
        for note in notes if warn else ():
            warnings.warn(note, TerrainwaveWarning, stacklevel=2)
        self._dtype = np.dtype(self.info.dtype)

    def _complete_info(self, override: int | float | None, notes: list[str]) -> RasterInfo:
        """Check the band's type and settle nodata; appends to `notes`."""
        backend = self._backend
        dtype = backend.dtype
        _check_dtype(dtype, self.name)
        if override is not None:
            nodata, problem = fit_nodata(override, dtype)
            if problem:
                raise InvalidArgumentError(f"{problem}: choose another `nodata`")
        elif backend.nodata is not None:
            nodata, problem = fit_nodata(backend.nodata, dtype)
            if problem:
                notes.append(f"{problem}, so no sample can equal it: ignored")
        else:
            nodata = None
        transform = backend.transform
        tags = dict(backend.tags())
        problem = _problem_of(transform)
        if problem:
            has_crs = tags["crs"] is not None
            notes.append(f"{problem}, so it is ignored{', and the CRS with it' * has_crs}")
            transform, tags["crs"] = IDENTITY, None
        if backend.has_mask:
            mask_kind = "mask"
        elif dtype.kind == "f" and (nodata is None or math.isnan(nodata)):
            mask_kind = "nan"
        else:
            mask_kind = "none" if nodata is None else "nodata"
        return RasterInfo(
            n_rows=backend.n_rows,
            n_cols=backend.n_cols,
            dtype=dtype.name,
            nodata=nodata,
            transform=transform,
            mask_kind=mask_kind,
            **tags,
        )

    def _asides(self) -> Iterator[str]:
        """Yield notes that are no reason for a warning."""
        backend = self._backend
        if isinstance(backend, DatasetBackend):
            yield from (f"{self.name}: {aside}" for aside in backend.asides())
        elif isinstance(backend, MosaicBackend):
            yield from backend.asides()

    @property
    def earlier(self) -> EarlierLoss | None:
        """Return what the heights of .twz files had lost, the most of several; None of others."""
        return self._backend.earlier

    @property
    def claim(self) -> Claim | None:
        """Return the bound that came with an array, if one did."""
        return self._backend.claim if isinstance(self._backend, LabelledBackend) else None

    @property
    def is_file(self) -> bool:
        """Tell whether windows are decoded from a file."""
        return self._backend.is_file

    @property
    def is_striped(self) -> bool:
        """Tell whether a narrow window makes the source decode whole rows of blocks."""
        block_cols = self._backend.block_shape[1]
        return block_cols >= self.info.n_cols > _NARROW_COLS and self.is_file

    def read(self, row: int, col: int, n_rows: int, n_cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Read the window of `n_rows` x `n_cols` samples at (row, col), which lies inside the grid.

        Returns
        -------
        heights : ndarray of the source's dtype, shape (n_rows, n_cols)
            A copy, writable; void samples hold whatever the source has there.
        valid : ndarray of bool, shape (n_rows, n_cols)
            False where the sample is void.

        Raises
        ------
        InvalidHeightsError
            If a valid sample is infinite.
        StorageError
            If the source cannot be read there.
        """
        info = self.info
        if row < 0 or col < 0 or row + n_rows > info.n_rows or col + n_cols > info.n_cols:
            raise ValueError(f"window ({row}, {col}, {n_rows}, {n_cols}) is not inside the raster")
        even = self.even(Region(row, col, n_rows, n_cols))
        if even is not None:
            shape = n_rows, n_cols
            return even.heights(shape, self._dtype), np.full(shape, even.is_valid)
        return self._read(row, col, n_rows, n_cols)

    def _read(self, row: int, col: int, n_rows: int, n_cols: int) -> tuple[np.ndarray, np.ndarray]:
        interrupts.check()
        info = self.info
        with self._readers.lent() as backend:
            heights, valid = backend.read(row, col, n_rows, n_cols)
        with self._counting:
            self.n_bytes_read += heights.nbytes
        if info.nodata is not None and not math.isnan(info.nodata):
            valid &= heights != stored_nodata(info.nodata, self._dtype)
        if self._dtype.kind == "f":
            valid &= ~np.isnan(heights)
            self._check_finite(heights, valid, row, col)
        return heights, valid

    def even(self, region: Region) -> Even | None:
        """Return what all samples of a region inside the grid are, without reading them.

        None where the source does not know it by its index alone.
        """
        with self._readers.lent() as backend:
            even = backend.even(region)
        if even is None or not even.is_valid:
            return even
        value, nodata = even.value, self.info.nodata
        is_float = self._dtype.kind == "f"
        if is_float and np.isinf(value):  # which reading refuses
            return None
        is_void = is_float and bool(np.isnan(value))
        if nodata is not None and not math.isnan(nodata):
            is_void |= bool(value == stored_nodata(nodata, self._dtype))
        return Even(value, not is_void)

    def holds(self, region: Region, even: Even) -> bool:
        """Say whether corners and middle of a region, read, are what the index says."""
        return is_seen(self._read, region, even)

    def _check_finite(self, heights: np.ndarray, valid: np.ndarray, row: int, col: int) -> None:
        infinite = np.isinf(heights) & valid
        if infinite.any():
            at_row, at_col = np.unravel_index(int(np.argmax(infinite)), infinite.shape)
            value = heights[at_row, at_col]
            raise InvalidHeightsError(
                f"{self.name}: the height at row {row + at_row}, column {col + at_col} is {value};"
                f" expected finite heights (if it marks a void, use `nodata` {value})"
            )

    def blocks(self, max_samples: int = _SCAN_SAMPLES) -> Iterator[Region]:
        """Yield windows that cover the grid once, in the order the source stores its blocks.

        Each holds at most `max_samples` samples: full-width strips where they fit, else rows of
        whole blocks cut in width.
        """
        info = self.info
        block_rows, block_cols = self._backend.block_shape
        yield from scan_windows(info.n_rows, info.n_cols, block_rows, block_cols, max_samples)

    def parts(self) -> Iterator[tuple[Region, Even | None]]:
        """Yield windows that cover the grid once, as `blocks` does, with what even ones are.

        A window of which a part is even comes in several.
        """
        bands: dict[int, Even | None] = {}
        band = Region(0, 0, 0, 0)
        for block in self.blocks():
            # Blocks may be thousands of times as wide as high: many below each other at a time.
            if block.row + block.n_rows > band.row + band.n_rows:
                bands.clear()
                n_rows = max(block.n_rows, min(_BAND_ROWS, self.info.n_rows - block.row))
                band = Region(block.row, 0, n_rows, self.info.n_cols)
            if block.col not in bands:
                bands[block.col] = self.even(band._replace(col=block.col, n_cols=block.n_cols))
            even = bands[block.col]
            if even is not None:
                yield block, even
                continue
            parts = list(even_parts(block, _EVEN_SIDE, self.even))
            if all(even is None for _, even in parts):
                yield block, None
            else:
                yield from parts

    def close(self) -> None:
        """Close what the source opened itself."""
        self._readers.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _problem_of(transform: Transform) -> str:
    """Say why an affine transform places no samples; nothing if it does."""
    if not all(math.isfinite(value) for value in transform):
        return "the affine transform is not finite"
    a, b, _, d, e, _ = transform
    if a * e == b * d:
        return "the affine transform puts all samples on one line or point"
    return ""


def _check_dtype(dtype: np.dtype[Any], name: str) -> None:
    if dtype.name in SUPPORTED_DTYPES:
        return
    supported = ", ".join(SUPPORTED_DTYPES)
    target = _CONVERT_TO.get(dtype.name)
    advice = ""
    if target is not None:
        plain = target.split()[0]
        advice = f"; convert to {target}, for example gdal_translate -ot {_GDAL_NAMES[plain]}"
        advice += f" or heights.astype(np.{plain})"
    raise InvalidHeightsError(
        f"{name}: heights are {dtype.name}, which is not supported (one of {supported}){advice}"
    )


@dataclass(frozen=True)
class _Opening:
    """How sources are opened: arguments of `RasterSource`."""

    band: int
    nodata: int | float | None
    georeference: bool
    open_terrain: OpenTerrain | None

    def backend(self, source: Any) -> RasterBackend | MosaicBackend | ArrayBackend:
        """Return the opened source.

        Raises
        ------
        InvalidArgumentError
            If it is none that is understood.
        """
        if isinstance(source, list | tuple) and source and all(map(self._is_raster, source)):
            if len(source) > 1:
                if not self.georeference:
                    raise InvalidArgumentError(
                        f"found `georeference` False and {len(source)} rasters, expected one: a"
                        " mosaic is put together by their places"
                    )
                return MosaicBackend(source, self._raster, self.nodata)
            source = source[0]
        if self._is_raster(source):
            return self._raster(source)
        if isinstance(source, np.ndarray):
            return ArrayBackend(source)
        if hasattr(source, "dims") and hasattr(source, "coords"):
            return LabelledBackend(
                source, self.band, override=self.nodata, georeference=self.georeference
            )
        if isinstance(source, list | tuple):
            return ArrayBackend(np.asarray(source))
        raise InvalidArgumentError(
            f"found {shown(source)}, expected a path, a rasterio dataset, a 2-D array, an"
            " xarray DataArray or Dataset, or a list of paths or datasets"
        )

    def _is_raster(self, source: Any) -> bool:
        """Say whether it is the path of a raster, or something opened that lies somewhere."""
        is_dataset = hasattr(source, "read_masks") and hasattr(source, "block_shapes")
        return is_dataset or isinstance(source, str | os.PathLike) or self._is_terrain(source)

    def _is_terrain(self, source: Any) -> bool:
        """Say whether it is a .twz file that can be opened here."""
        if self.open_terrain is None:
            return False
        if isinstance(source, str | os.PathLike):
            return is_twz(source) or ("://" in os.fspath(source) and is_twz_name(source))
        return hasattr(source, "read_with_mask") and hasattr(source, "raster_info")

    def _raster(self, source: Any) -> RasterBackend:
        if self._is_terrain(source):
            assert self.open_terrain is not None
            self._refuse_options_of_rasters(source)
            return self.open_terrain(source, georeference=self.georeference)
        is_path = isinstance(source, str | os.PathLike)
        dataset = open_dataset(checked_path(source)) if is_path else source
        return DatasetBackend(dataset, self.band, owned=is_path, georeference=self.georeference)

    def _refuse_options_of_rasters(self, source: Any) -> None:
        """Raise `InvalidArgumentError` where an option cannot be meant for a .twz file."""
        name = shown(getattr(source, "name", source))
        if self.band != 1:
            raise InvalidArgumentError(
                f"found `band` {self.band} and {name}, expected 1: a .twz file has one band"
            )
        if self.nodata is not None:
            raise InvalidArgumentError(
                f"found `nodata` {self.nodata:g} and {name}, expected none: a .twz file knows its"
                " voids"
            )
