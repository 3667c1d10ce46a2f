"""Rasters in and out: windows of heights with their validity, and what must come back with them.

`RasterSource` reads one band of anything rasterio opens (or an array) window by window;
`RasterSink` writes a GeoTIFF or COG the same way and renames it into place at the end. Neither
ever holds the raster: GDAL's block cache, whose default is 5 % of the machine's memory, is held at
`GDAL_CACHE_BYTES` while they work.

Which samples are valid is decided here and nowhere else in the encoder: a sample is void if it
equals nodata, is NaN, or is masked by the dataset (mask band, alpha). Both can apply at once.
"""

import contextlib
import math
import os
import secrets
import shutil
import threading
import time
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.crs import CRS
from rasterio.enums import MaskFlags
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioError, RasterioIOError
from rasterio.transform import Affine
from rasterio.windows import Window

from terrainwave.errors import (
    CorruptStreamError,
    InvalidHeightsError,
    StorageError,
    TerrainwaveWarning,
)
from terrainwave.quadtree import Region

SUPPORTED_DTYPES = ("uint8", "int16", "uint16", "int32", "float32", "float64")

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

# GDAL's default block cache is 5 % of the machine's memory, which alone can break a memory limit.
GDAL_CACHE_BYTES = 64 * 2**20

# Samples per window of a sequential scan: 32 MB of float64, large against GDAL's overhead per call.
SCAN_SAMPLES = 4 * 2**20

# A window narrower than this fraction of the width decodes mostly samples it does not want.
_NARROW_COLS = 1024

_TILE = 512

# Compressed output may be far smaller than its raw size; below this share it cannot fit.
_SMALLEST_SHARE = 0.05

_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class RasterInfo:
    """All of a raster but its heights.

    Attributes
    ----------
    n_rows, n_cols : int
        Size of the grid; >= 1.
    dtype : str
        numpy's name of the sample type, one of `SUPPORTED_DTYPES`.
    nodata : int, float or None
        The declared nodata value: int for integer types, float (NaN and infinities allowed) for
        float types, None if there is none.
    crs : str or None
        ``"AUTH:CODE"`` where that code's definition equals the raster's, else WKT2.
    transform : tuple of 6 float
        Affine map from (col, row) to (x, y): ``x = a*col + b*row + c``, ``y = d*col + e*row + f``.
    units : str or None
        Unit of the stored heights as the band names it.
    scale, offset : float
        Physical height = ``scale * stored + offset``.
    area_or_point : str or None
        ``"Area"`` or ``"Point"`` where the file says so.
    description : str or None
        Description of the band.
    mask_kind : str
        How voids are told from heights: ``"none"`` (there are none), ``"nodata"`` (a number),
        ``"nan"``, or ``"mask"`` (a mask band or alpha, perhaps beside a nodata value).
    """

    n_rows: int
    n_cols: int
    dtype: str
    nodata: int | float | None = None
    crs: str | None = None
    transform: tuple[float, ...] = _IDENTITY
    units: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    area_or_point: str | None = None
    description: str | None = None
    mask_kind: str = "none"

    @property
    def void_value(self) -> int | float:
        """What a void sample holds in an array or file of this raster."""
        if self.nodata is not None:
            return self.nodata
        return math.nan if np.dtype(self.dtype).kind == "f" else 0

    @property
    def n_bytes(self) -> int:
        """Size of the uncompressed samples."""
        return self.n_rows * self.n_cols * np.dtype(self.dtype).itemsize

    def rasterio_crs(self) -> CRS | None:
        """Return the CRS as rasterio's object; None, with a warning, if it cannot be understood."""
        return parse_crs(self.crs)

    def to_metadata(self) -> dict[str, Any]:
        """Return plain values for JSON; numbers that JSON lacks become "nan", "inf", "-inf"."""
        fields = asdict(self)
        fields["nodata"] = _number_to_plain(self.nodata)
        fields["transform"] = list(self.transform)
        return fields

    @classmethod
    def from_metadata(cls, fields: dict[str, Any]) -> Self:
        """Rebuild the info from `to_metadata`'s values; unknown keys are ignored.

        The values may come from an untrusted file. A CRS that PROJ does not understand is kept as
        the string it is: it must not prevent reading the heights, and whoever asks for it through
        `rasterio_crs` gets a warning.

        Raises
        ------
        CorruptStreamError
            If a key is missing where it is needed or a value has the wrong type or range.
        """
        try:
            return cls._from_plain(fields)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise CorruptStreamError(f"the raster's metadata are damaged: {error!r}") from error

    @classmethod
    def _from_plain(cls, fields: dict[str, Any]) -> Self:
        dtype = fields["dtype"]
        if dtype not in SUPPORTED_DTYPES:
            raise ValueError(f"dtype is {str(dtype)[:40]!r}")
        mask_kind = fields.get("mask_kind", "none")
        if mask_kind not in ("none", "nodata", "nan", "mask"):
            raise ValueError(f"mask_kind is {str(mask_kind)[:40]!r}")
        transform = tuple(_finite(value) for value in fields.get("transform", _IDENTITY))
        if len(transform) != 6:
            raise ValueError(f"transform has {len(transform)} numbers, expected 6")
        nodata = _number_from_plain(fields.get("nodata"))
        if nodata is not None:
            nodata, problem = _fit_nodata(nodata, np.dtype(dtype))
            if problem:
                raise ValueError(problem)
        return cls(
            n_rows=_positive(fields["n_rows"]),
            n_cols=_positive(fields["n_cols"]),
            dtype=dtype,
            nodata=nodata,
            crs=_optional_text(fields.get("crs")),
            transform=transform,
            units=_optional_text(fields.get("units")),
            scale=_finite(fields.get("scale", 1.0)),
            offset=_finite(fields.get("offset", 0.0)),
            area_or_point=_optional_text(fields.get("area_or_point")),
            description=_optional_text(fields.get("description")),
            mask_kind=mask_kind,
        )


def _number_to_plain(value: int | float | None) -> int | float | str | None:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)  # "nan", "inf" or "-inf"
    return value


def _number_from_plain(value: Any) -> int | float | None:
    if value is None:
        return None
    if isinstance(value, str):
        if value not in ("nan", "inf", "-inf"):
            raise ValueError(f"nodata is {value[:40]!r}")
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"nodata is a {type(value).__name__}")
    return value


def _finite(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"expected a finite number, found {str(value)[:40]!r}")
    return float(value)


def _positive(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"expected a whole number >= 1, found {str(value)[:40]!r}")
    return value


def _optional_text(value: Any) -> str | None:
    if value is not None and not isinstance(value, str):
        raise TypeError(f"expected text, found a {type(value).__name__}")
    return value


def parse_crs(text: str | None) -> CRS | None:
    """Return the CRS that ``"AUTH:CODE"`` or WKT stands for; warn and return None if none does."""
    if text is None:
        return None
    try:
        with rasterio.Env():
            return CRS.from_string(text)
    except CRSError as error:
        warnings.warn(
            f"the coordinate reference system is ignored, PROJ does not understand it: {error}",
            TerrainwaveWarning,
            stacklevel=2,
        )
        return None


def format_crs(crs: CRS | None) -> str | None:
    """Return ``"AUTH:CODE"`` where that code means exactly `crs`, else its WKT2; None for none.

    Equal means: the same WKT. Looser comparisons (PROJ's, rasterio's ``==``) call two systems the
    same whose ellipsoids differ in the ninth digit. The WKT compared is rasterio's default, as
    GeoTIFF keys don't carry the areas and ensembles that the registry's WKT2 has.
    """
    if not crs:
        return None
    authority = crs.to_authority()
    if authority is not None:
        with contextlib.suppress(CRSError):
            if CRS.from_authority(*authority).to_wkt() == crs.to_wkt():
                return ":".join(authority)
    try:
        return str(crs.to_wkt(version="WKT2_2019"))
    except CRSError:
        return str(crs.to_wkt())


def _fit_nodata(nodata: int | float, dtype: np.dtype[Any]) -> tuple[int | float | None, str | None]:
    """Return `nodata` as a value that `dtype` can hold, or None and the reason why it can't."""
    if dtype.kind == "f":
        value = float(nodata)
        limit = float(np.finfo(dtype).max)
        # Half an ulp above the limit still rounds to it: files write float32's with few digits.
        if math.isfinite(value) and abs(value) > limit * (1 + 2.0**-24):
            return None, f"nodata {nodata!r} is outside {dtype.name}"
        return value, None
    limits = np.iinfo(dtype)
    if not math.isfinite(nodata) or nodata != int(nodata):
        return None, f"nodata {nodata!r} is not a whole number, the heights are {dtype.name}"
    if not limits.min <= nodata <= limits.max:
        return None, f"nodata {nodata!r} is outside {dtype.name} ({limits.min} to {limits.max})"
    return int(nodata), None


def _stored_nodata(nodata: int | float, dtype: np.dtype[Any]) -> Any:
    """Return the sample value that means `nodata`."""
    with np.errstate(over="ignore", under="ignore"):
        value = np.float64(nodata).astype(dtype) if dtype.kind == "f" else dtype.type(nodata)
    if dtype.kind == "f" and math.isfinite(nodata) and not np.isfinite(value):
        return np.copysign(np.finfo(dtype).max, value)
    return value


def _bounded_env(**options: Any) -> Any:
    """Return the GDAL environment all work here is done in."""
    return rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_BYTES, **options)


class RasterSource:
    """One band of a raster, read window by window.

    Parameters
    ----------
    source : path, rasterio dataset, ndarray, masked array or xarray DataArray
        What to read. A dataset is not closed; a DataArray may be lazy.
    band : int
        Number of the band, from 1. Band 1 of several is noted, as it may not be a choice.
    nodata : int or float, optional
        Replaces the declared nodata value.

    Attributes
    ----------
    info : RasterInfo
        Everything but the heights.
    name : str
        How messages call the source.
    notes : tuple of str
        What the source left out or chose, one sentence each; also issued as `TerrainwaveWarning`.
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
    Thread-safe: reads are serialised by a lock, as a GDAL dataset serves one thread at a time. A
    dataset that the caller passed must not be used elsewhere meanwhile.
    """

    def __init__(self, source: Any, *, band: int = 1, nodata: int | float | None = None) -> None:
        self._lock = threading.Lock()
        self._backend = _open_backend(source, band)
        self.name: str = self._backend.name
        try:
            notes = list(self._backend.notes())
            self.info = self._complete_info(nodata, notes)
        except BaseException:
            self.close()
            raise
        self.notes = tuple(notes)
        for note in notes:
            warnings.warn(note, TerrainwaveWarning, stacklevel=2)
        self._dtype = np.dtype(self.info.dtype)

    def _complete_info(self, override: int | float | None, notes: list[str]) -> RasterInfo:
        """Check the band's type and settle nodata; appends to `notes`."""
        backend = self._backend
        dtype = backend.dtype
        _check_dtype(dtype, self.name)
        if override is not None:
            nodata, problem = _fit_nodata(override, dtype)
            if problem:
                raise InvalidHeightsError(f"{problem}: choose another --nodata")
        elif backend.nodata is not None:
            nodata, problem = _fit_nodata(backend.nodata, dtype)
            if problem:
                notes.append(f"{problem}, so no sample can equal it: ignored")
        else:
            nodata = None
        transform = backend.transform
        if not all(math.isfinite(value) for value in transform):
            notes.append("the affine transform is not finite: ignored")
            transform = _IDENTITY
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
            **backend.tags(),
        )

    @property
    def is_striped(self) -> bool:
        block_cols = self._backend.block_shape[1]
        return block_cols >= self.info.n_cols > _NARROW_COLS and self._backend.is_file

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
        with self._lock:
            heights, valid = self._backend.read(row, col, n_rows, n_cols)
        if info.nodata is not None and not math.isnan(info.nodata):
            valid &= heights != _stored_nodata(info.nodata, self._dtype)
        if self._dtype.kind == "f":
            valid &= ~np.isnan(heights)
            self._check_finite(heights, valid, row, col)
        return heights, valid

    def _check_finite(self, heights: np.ndarray, valid: np.ndarray, row: int, col: int) -> None:
        infinite = np.isinf(heights) & valid
        if infinite.any():
            at_row, at_col = np.unravel_index(int(np.argmax(infinite)), infinite.shape)
            value = heights[at_row, at_col]
            raise InvalidHeightsError(
                f"{self.name}: the height at row {row + at_row}, column {col + at_col} is {value};"
                f" expected finite heights (if it marks a void, use --nodata {value})"
            )

    def blocks(self, max_samples: int = SCAN_SAMPLES) -> Iterator[Region]:
        """Yield windows that cover the grid once, in the order the source stores its blocks.

        Each holds at most `max_samples` samples: full-width strips where they fit, else rows of
        whole blocks cut in width.
        """
        info = self.info
        block_rows, block_cols = self._backend.block_shape
        yield from _scan_windows(info.n_rows, info.n_cols, block_rows, block_cols, max_samples)

    def close(self) -> None:
        """Close what the source opened itself."""
        self._backend.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _scan_windows(
    n_rows: int, n_cols: int, block_rows: int, block_cols: int, max_samples: int
) -> Iterator[Region]:
    """Yield windows in block order: block rows from the top, in each from the left."""
    rows = min(block_rows, n_rows, max_samples)
    cols = min(n_cols, max(max_samples // rows, 1))
    if cols < n_cols and cols > block_cols:
        cols -= cols % block_cols
    elif cols == n_cols:
        rows = min(n_rows, max(max_samples // (rows * n_cols), 1) * rows)
    # One row of blocks at a time, also where the rows of a huge block are taken in several parts.
    for row in range(0, n_rows, rows):
        for col in range(0, n_cols, cols):
            yield Region(row, col, min(rows, n_rows - row), min(cols, n_cols - col))


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


def _open_backend(source: Any, band: int) -> "_DatasetBackend | _ArrayBackend":
    if isinstance(source, str | os.PathLike):
        return _DatasetBackend(_open_dataset(os.fspath(source)), band, owned=True)
    if hasattr(source, "read_masks") and hasattr(source, "block_shapes"):
        return _DatasetBackend(source, band, owned=False)
    if isinstance(source, np.ndarray):
        return _ArrayBackend(source)
    if hasattr(source, "dims") and hasattr(source, "values"):
        return _open_data_array(source, band)
    if isinstance(source, list | tuple):
        return _ArrayBackend(np.asarray(source))
    raise InvalidHeightsError(
        f"found a {type(source).__name__}; expected a path, a rasterio dataset, a 2-D array or an "
        "xarray DataArray"
    )


def _open_dataset(path: str) -> Any:
    """Open `path` by rasterio; translate each failure into one line that says what to do."""
    local = Path(path)
    is_local = "://" not in path and not path.startswith("/vsi")
    if is_local and _is_twz(local):
        raise InvalidHeightsError(
            f"{path} is already a terrainwave file; expected a raster such as a GeoTIFF"
            " (terrainwave decompress makes one of it)"
        )
    try:
        with _bounded_env(), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            dataset = rasterio.open(path)
    except RasterioIOError as error:
        if is_local and local.is_dir():
            raise StorageError(f"{path} is a directory; expected a raster file") from error
        if is_local and ":" not in path and not local.exists():
            raise StorageError(f"{path}: no such file") from error
        raise StorageError(
            f"{path} is not a raster that GDAL can read: {_one_line(error)}"
        ) from error
    if dataset.count == 0:
        parts = ", ".join(dataset.subdatasets[:4])
        dataset.close()
        advice = f"; it holds several rasters, name one of them: {parts}" if parts else ""
        raise InvalidHeightsError(f"{path} has no raster band{advice}")
    return dataset


def _is_twz(path: Path) -> bool:
    """Tell a terrainwave file by its first bytes; by its name if it cannot be read."""
    try:
        with path.open("rb") as file:
            return b"TWZ" in file.read(8).upper()
    except OSError:
        return False


def _one_line(error: BaseException) -> str:
    """Return GDAL's own reason, which rasterio hides behind "See previous exception"."""
    reason = error
    while reason.__cause__ is not None:
        reason = reason.__cause__
    return " ".join(str(reason).split())


class _DatasetBackend:
    """A band of a rasterio dataset."""

    is_file = True

    def __init__(self, dataset: Any, band: int, *, owned: bool) -> None:
        self._owned = owned
        self._dataset = dataset
        self._band = band
        try:
            self._check()
        except BaseException:
            self.close()
            raise

    def _check(self) -> None:
        dataset, band = self._dataset, self._band
        if dataset.closed:
            raise InvalidHeightsError("the rasterio dataset is closed; expected an open one")
        self.name = str(dataset.name)
        if not 1 <= band <= dataset.count:
            bands = "1 band" if dataset.count == 1 else f"{dataset.count} bands"
            raise InvalidHeightsError(
                f"{self.name}: band {band} does not exist, the file has {bands}"
            )
        self.n_rows, self.n_cols = int(dataset.height), int(dataset.width)
        self.dtype = np.dtype(dataset.dtypes[band - 1])
        self.nodata = dataset.nodatavals[band - 1]
        self.block_shape: tuple[int, int] = dataset.block_shapes[band - 1]
        self.transform = tuple(float(value) for value in dataset.transform[:6])
        flags = dataset.mask_flag_enums[band - 1]
        # Neither flag: a mask band of this band alone.
        is_plain = MaskFlags.all_valid in flags or flags == [MaskFlags.nodata]
        self.has_mask = not is_plain

    def notes(self) -> Iterator[str]:
        dataset = self._dataset
        n_bands = sum(1 for color in dataset.colorinterp if color.name != "alpha")
        if n_bands > 1 and self._band == 1:
            yield f"{self.name} has {n_bands} bands; using band 1 (choose with --band)"
        dropped = [
            name
            for name, found in (("GCPs", dataset.gcps[0]), ("RPCs", getattr(dataset, "rpcs", None)))
            if found
        ]
        if dropped:
            what = " and ".join(dropped)
            yield f"{self.name}: {what} are dropped, a .twz file does not hold them"

    def tags(self) -> dict[str, Any]:
        dataset, index = self._dataset, self._band - 1
        return {
            "crs": format_crs(dataset.crs),
            "units": dataset.units[index] or None,
            "scale": float(dataset.scales[index]),
            "offset": float(dataset.offsets[index]),
            "area_or_point": dataset.tags().get("AREA_OR_POINT"),
            "description": dataset.descriptions[index] or None,
        }

    def read(self, row: int, col: int, n_rows: int, n_cols: int) -> tuple[np.ndarray, np.ndarray]:
        window = Window(col, row, n_cols, n_rows)
        try:
            with _bounded_env():
                heights = self._dataset.read(self._band, window=window)
                if not self.has_mask:
                    return heights, np.ones(heights.shape, dtype=bool)
                return heights, self._dataset.read_masks(self._band, window=window) != 0
        except RasterioError as error:
            raise StorageError(
                f"{self.name}: rows {row} to {row + n_rows - 1}, columns {col} to"
                f" {col + n_cols - 1} cannot be read: {_one_line(error)}"
            ) from error

    def close(self) -> None:
        if self._owned:
            self._dataset.close()


class _ArrayBackend:
    """A 2-D array in memory, or anything sliced like one."""

    is_file = False
    name = "the array"

    def __init__(
        self,
        array: Any,
        *,
        nodata: int | float | None = None,
        transform: tuple[float, ...] = _IDENTITY,
        tags: dict[str, Any] | None = None,
    ) -> None:
        shape = array.shape
        if len(shape) != 2 or 0 in shape:
            raise InvalidHeightsError(
                f"the array has shape {tuple(shape)}; expected two dimensions, rows and columns"
            )
        self._array = array
        self.n_rows, self.n_cols = (int(size) for size in shape)
        self.dtype = np.dtype(array.dtype).newbyteorder("=")
        self.nodata = nodata
        self.block_shape = (1, self.n_cols)
        self.transform = transform
        # A masked float array comes back with NaN in its voids, which needs no mask band.
        self.has_mask = np.ma.getmask(array) is not np.ma.nomask and self.dtype.kind != "f"
        self._tags = tags or {}

    def notes(self) -> Iterator[str]:
        return iter(())

    def tags(self) -> dict[str, Any]:
        return self._tags

    def read(self, row: int, col: int, n_rows: int, n_cols: int) -> tuple[np.ndarray, np.ndarray]:
        part = self._array[row : row + n_rows, col : col + n_cols]
        if not isinstance(part, np.ndarray):
            part = part.values
        heights = np.array(np.ma.getdata(part), dtype=self.dtype, order="C", subok=False)
        return heights, ~np.ma.getmaskarray(part)

    def close(self) -> None:
        pass


_ROW_DIMS = ("y", "lat", "latitude", "northing", "row")
_COL_DIMS = ("x", "lon", "longitude", "easting", "col")


def _open_data_array(array: Any, band: int) -> _ArrayBackend:
    """Take heights, CRS and transform from an xarray DataArray, by its names alone.

    Understood: a leading band dimension, dimensions in either order, rioxarray's ``spatial_ref``
    coordinate and ``.rio`` accessor, the attributes ``_FillValue``, ``units``, ``scale_factor``
    and ``add_offset`` (which are there only while the values are as stored).
    """
    if len(array.dims) == 3 and str(array.dims[0]) == "band":
        if not 1 <= band <= array.shape[0]:
            raise InvalidHeightsError(
                f"band {band} does not exist, the DataArray has {array.shape[0]}"
            )
        array = array[band - 1]
    if len(array.dims) != 2:
        raise InvalidHeightsError(
            f"the DataArray has dimensions {tuple(map(str, array.dims))}; expected rows and columns"
        )
    names = [str(dim).lower() for dim in array.dims]
    if names[0] in _COL_DIMS and names[1] in _ROW_DIMS:
        array = array.transpose(*array.dims[::-1])
    attrs = array.attrs
    nodata = attrs.get("_FillValue", attrs.get("nodata"))
    units = attrs.get("units")
    tags = {
        "crs": format_crs(_data_array_crs(array)),
        "units": None if units in (None, "") else str(units),
        "scale": float(attrs.get("scale_factor", 1.0)),
        "offset": float(attrs.get("add_offset", 0.0)),
        "description": str(attrs["long_name"]) if "long_name" in attrs else None,
    }
    return _ArrayBackend(
        array,
        nodata=None if nodata is None else np.asarray(nodata).item(),
        transform=_data_array_transform(array),
        tags=tags,
    )


def _spatial_ref(array: Any) -> dict[str, Any]:
    coords = array.coords
    return dict(coords["spatial_ref"].attrs) if "spatial_ref" in coords else {}


def _data_array_crs(array: Any) -> CRS | None:
    with contextlib.suppress(AttributeError):
        crs = array.rio.crs
        return None if crs is None else CRS.from_user_input(crs)
    reference = _spatial_ref(array)
    text = reference.get("crs_wkt", reference.get("spatial_ref", array.attrs.get("crs")))
    return parse_crs(None if text is None else str(text))


def _data_array_transform(array: Any) -> tuple[float, ...]:
    """Return the transform that rioxarray stored, or the one its evenly spaced centres give."""
    stored = str(_spatial_ref(array).get("GeoTransform", "")).split()
    if len(stored) == 6:
        c, a, b, f, d, e = map(float, stored)  # GDAL's order
        return a, b, c, d, e, f
    steps = []
    for dim in array.dims[::-1]:
        centres = np.asarray(array.coords[dim].values) if dim in array.coords else np.empty(0)
        if centres.size < 2 or centres.dtype.kind not in "iuf":
            return _IDENTITY
        step = (float(centres[-1]) - float(centres[0])) / (centres.size - 1)
        even = float(centres[0]) + step * np.arange(centres.size)
        # Coordinates are decimal text turned float32 as often as not: 1 % of a pixel is "even".
        if step == 0 or np.abs(centres - even).max() > 0.01 * abs(step):
            return _IDENTITY
        steps.append((step, float(centres[0]) - step / 2))
    (x_step, x_origin), (y_step, y_origin) = steps
    return x_step, 0.0, x_origin, 0.0, y_step, y_origin


class RasterSink:
    """A GeoTIFF written window by window, which appears at its place complete or not at all.

    Parameters
    ----------
    path : path
        The target; an existing one is refused without `overwrite`.
    info : RasterInfo
        Size, type and all else that the file shall carry.
    cog : bool
        Make a cloud-optimised GeoTIFF: overviews are averages of the grid written here.
    overwrite : bool
        Replace an existing file.
    n_threads : int
        Threads that GDAL compresses with.

    Raises
    ------
    StorageError
        If the target exists, its directory cannot be written, or the disk cannot hold it.

    Notes
    -----
    Used as a context manager: leaving it normally publishes the file, leaving it by an exception
    removes what was written. Windows may come in any order; those of `blocks` waste nothing.
    Memory: one window and GDAL's cache. A COG needs room for the file twice while it is made.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        info: RasterInfo,
        *,
        cog: bool = False,
        overwrite: bool = False,
        n_threads: int = 1,
    ) -> None:
        self.info = info
        self.path = Path(os.path.realpath(path))
        self._shown_path = os.fspath(path)
        self._overwrite = overwrite
        self._cog = cog
        self._n_threads = n_threads
        self._dtype = np.dtype(info.dtype)
        self._lock = threading.Lock()
        self._check_target()
        self._part = self._new_part()
        try:
            self._dataset = self._create()
        except BaseException as error:
            self._remove_parts()
            if isinstance(error, RasterioError | OSError):
                raise self._cannot_write(error) from error
            raise

    def _check_target(self) -> None:
        shown, folder = self._shown_path, self.path.parent
        if self.path.is_dir():
            raise StorageError(f"{shown} is a directory; expected the name of a file to write")
        if not folder.is_dir():
            raise StorageError(f"{shown} cannot be written: {folder} is not a directory")
        if self.path.exists() and not self._overwrite:
            raise StorageError(
                f"{shown} exists already; choose another name or overwrite it (--overwrite)"
            )
        free = shutil.disk_usage(folder).free
        if free < self.info.n_bytes * _SMALLEST_SHARE:
            raise StorageError(
                f"{shown} cannot be written: {free:,} bytes are free in {folder}, the raster is"
                f" {self.info.n_bytes:,} bytes uncompressed"
            )

    def _new_part(self) -> Path:
        """Create an empty file beside the target, with the permissions a new file has."""
        for _ in range(100):
            part = self.path.with_name(f".{self.path.name}.{secrets.token_hex(4)}.part.tif")
            try:
                os.close(os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            except FileExistsError:
                continue
            except OSError as error:
                raise self._cannot_write(error) from error
            return part
        raise StorageError(f"{self._shown_path} cannot be written: no free temporary name")

    def _create(self) -> Any:
        info = self.info
        profile: dict[str, Any] = {
            "driver": "GTiff",
            "height": info.n_rows,
            "width": info.n_cols,
            "count": 1,
            "dtype": info.dtype,
            "nodata": info.nodata,
            "crs": info.rasterio_crs(),
            "tiled": True,
            "blockxsize": _TILE,
            "blockysize": _TILE,
            "compress": "DEFLATE",
            "predictor": 3 if self._dtype.kind == "f" else 2,
            "bigtiff": "IF_SAFER",
            "num_threads": self._n_threads,
        }
        if info.transform != _IDENTITY:
            profile["transform"] = Affine(*info.transform)
        with _bounded_env(), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            dataset = rasterio.open(self._part, "w", **profile)
            self._write_tags(dataset)
        return dataset

    def _write_tags(self, dataset: Any) -> None:
        info = self.info
        if info.area_or_point is not None:
            dataset.update_tags(AREA_OR_POINT=info.area_or_point)
        if info.units is not None:
            dataset.units = (info.units,)
        if (info.scale, info.offset) != (1.0, 0.0):
            dataset.scales = (info.scale,)
            dataset.offsets = (info.offset,)
        if info.description is not None:
            dataset.descriptions = (info.description,)

    def blocks(self, max_samples: int = SCAN_SAMPLES) -> Iterator[Region]:
        """Yield windows of whole tiles that cover the grid once, in file order."""
        info = self.info
        yield from _scan_windows(info.n_rows, info.n_cols, _TILE, _TILE, max_samples)

    def write(self, row: int, col: int, heights: np.ndarray, valid: np.ndarray) -> None:
        """Write the window at (row, col); void samples get nodata, `heights` is not changed.

        Raises
        ------
        CorruptStreamError
            If a sample is void although the raster has no way to mark voids.
        StorageError
            If the disk is full or fails.
        """
        info = self.info
        if not valid.all():
            if info.mask_kind == "none":
                raise CorruptStreamError(
                    "there are void samples, but the metadata say there are none"
                )
            void = info.void_value
            heights = np.where(valid, heights, _stored_nodata(void, self._dtype))
        n_rows, n_cols = heights.shape
        window = Window(col, row, n_cols, n_rows)
        try:
            # A mask in the file itself: a .msk beside it would not be renamed with it.
            with self._lock, _bounded_env(GDAL_TIFF_INTERNAL_MASK=True):
                self._dataset.write(heights.astype(self._dtype, copy=False), 1, window=window)
                if info.mask_kind == "mask":
                    self._dataset.write_mask(valid, window=window)
        except (RasterioError, OSError) as error:
            raise self._cannot_write(error) from error

    def close(self) -> None:
        """Finish the file and move it to its place."""
        try:
            with _bounded_env(GDAL_TIFF_INTERNAL_MASK=True):
                self._dataset.close()
            self._check_complete(self._part)
            if self._cog:
                self._translate_to_cog()
            _flush_to_disk(self._part)
            if self.path.exists() and not self._overwrite:
                raise StorageError(f"{self._shown_path} exists already; it was made meanwhile")
            _replace(self._part, self.path)
        except (RasterioError, OSError) as error:
            self._remove_parts()
            if isinstance(error, StorageError):
                raise
            raise self._cannot_write(error) from error
        except BaseException:
            self._remove_parts()
            raise

    def abort(self) -> None:
        """Remove what was written; the target stays as it was."""
        with contextlib.suppress(RasterioError, OSError):
            self._dataset.close()
        self._remove_parts()

    def _translate_to_cog(self) -> None:
        plain = self._part
        self._part = self._new_part()
        try:
            with _bounded_env(GDAL_TIFF_INTERNAL_MASK=True), warnings.catch_warnings():
                warnings.simplefilter("ignore", NotGeoreferencedWarning)
                rasterio.shutil.copy(
                    plain,
                    self._part,
                    driver="COG",
                    compress="DEFLATE",
                    predictor="YES",
                    blocksize=_TILE,
                    overview_resampling="AVERAGE",
                    bigtiff="IF_SAFER",
                    num_threads=self._n_threads,
                )
            self._check_complete(self._part)
        finally:
            plain.unlink(missing_ok=True)

    def _check_complete(self, part: Path) -> None:
        """Raise StorageError unless every tile lies inside the file.

        GDAL writes the last tiles when the dataset is closed, and rasterio ignores the result: on
        a full disk `close` succeeds.
        """
        with _bounded_env(), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            size = part.stat().st_size
            with rasterio.open(part) as dataset:
                for (row, col), _ in dataset.block_windows(1):
                    offset = dataset.get_tag_item(f"BLOCK_OFFSET_{col}_{row}", "TIFF", 1)
                    n_bytes = dataset.get_tag_item(f"BLOCK_SIZE_{col}_{row}", "TIFF", 1)
                    if offset is None or int(offset) + int(n_bytes) > size:
                        raise StorageError(
                            f"{self._shown_path} could not be written completely; is the disk full?"
                        )

    def _cannot_write(self, error: BaseException) -> StorageError:
        return StorageError(f"{self._shown_path} cannot be written: {_one_line(error)}")

    def _remove_parts(self) -> None:
        """Remove the temporary file and those that GDAL makes beside it for overviews."""
        for path in self._part.parent.glob(f"{self._part.name}*"):
            with contextlib.suppress(OSError):
                path.unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()


def _flush_to_disk(path: Path) -> None:
    """Make sure that the rename cannot survive a power failure without the contents."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _replace(part: Path, target: Path) -> None:
    """Rename `part` to `target`; try again for a second, as scanners on Windows hold new files."""
    for pause in (0.05, 0.1, 0.2, 0.4, 0.4, None):
        try:
            os.replace(part, target)
        except PermissionError:
            if pause is None:
                raise
            time.sleep(pause)
        else:
            return
