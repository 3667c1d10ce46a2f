"""One band of a raster, read window by window."""

import math
import os
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from terrainwave import interrupts
from terrainwave.arguments import (
    NodataChoice,
    check_flags,
    checked_path,
    checked_whole,
    is_twz_name,
    nodata_choice,
    shown,
)
from terrainwave.errors import (
    InvalidArgumentError,
    InvalidHeightsError,
    TerrainwaveWarning,
)
from terrainwave.grid.affine import IDENTITY, Transform
from terrainwave.grid.quadtree import Region
from terrainwave.place.meaning import (
    Told,
    are_radii,
    by_numbers,
    check_kind,
    may_have_radii,
    settled_kind,
)
from terrainwave.place.units import in_metres
from terrainwave.raster_io.backend import RasterBackend
from terrainwave.raster_io.dataset import DatasetBackend, is_twz, open_dataset
from terrainwave.raster_io.even import Even, even_parts, is_seen
from terrainwave.raster_io.gdal import scan_windows
from terrainwave.raster_io.raster_info import (
    SUPPORTED_DTYPES,
    RasterInfo,
    fit_nodata,
    is_same_value,
    stored_nodata,
)

# Replacements of unsupported types: the narrowest supported one with all of their values, or the
# one that holds elevations in practice.
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


OpenTerrain = Callable[..., RasterBackend]
# Windows narrower than this fraction of the width decode mostly unwanted samples.
_NARROW_COLS = 1024
# Side, in samples, of the smallest parts of windows that are checked for even content.
_EVEN_SIDE = 512
_BAND_ROWS = 4096
# Samples per window of a sequential scan: large compared with GDAL's overhead per call, but several
# windows even for a small raster, so that threads share them.
_SCAN_SAMPLES = 1 << 19


class RasterSource:
    """One band of a raster, read window by window.

    A list of rasters is a mosaic: rasters of one grid; where they overlap, the last one counts. A
    dataset of rasterio is not closed; those of xarray may be lazy. With `open_terrain` also .twz
    files, by their paths or open. `nodata` marks voids, besides the values that the raster
    declares; ``"only:V"`` uses V instead of these, ``"none"`` no value at all. `warn` issues
    `notes` as warnings, except its asides. Raises `InvalidHeightsError` or `StorageError` if the
    raster cannot be used, or `nodata` does not fit.

    `told` is the meaning of the numbers by the metadata, None for plain arrays; `is_asked` is true
    with `heights_are`. `earlier` is the earlier loss of heights from .twz files, the largest of
    several, `came_from` the .twz file that an array names as its source. `undeclared_values` are
    declared void by sources, but not by `nodata`. `is_striped` is true if narrow windows decode
    much wider ones: a scan in the order of `blocks` is then many times cheaper than small windows.

    Thread-safe. A GDAL dataset serves one thread at a time: a local GeoTIFF is opened again for
    each further thread, others are read by one thread at a time. A dataset that the caller passed
    must not be used elsewhere meanwhile, and nothing may be read while `close` runs.
    """

    def __init__(
        self,
        source: Any,
        *,
        band: int = 1,
        nodata: int | float | str | None = None,
        georeference: bool = True,
        heights_are: str | None = None,
        warn: bool = True,
        open_terrain: OpenTerrain | None = None,
    ) -> None:
        check_flags(georeference=georeference)
        check_kind(heights_are)
        band = checked_whole("band", band, least=1)
        choice = nodata_choice(nodata)
        self._counting = threading.Lock()
        self.n_bytes_read = 0
        opening = _Opening(band, choice, georeference, open_terrain, heights_are)
        self._backend = opening.backend(source)
        self.told = self._backend.told
        if heights_are is not None:
            self.told = Told(heights_are, "`heights_are`")
        self.is_asked = heights_are is not None
        # Opened again for each further thread that reads it.
        self._first_free = threading.Lock()
        self._others: list[RasterBackend] = []
        self._idle: list[RasterBackend] = []
        self.name: str = self._backend.name
        try:
            notes = list(self._backend.notes())
            self.info = self._complete_info(choice, notes)
        except BaseException:
            self.close()
            raise
        self.notes = (*notes, *self._backend.named_asides())
        for note in notes if warn else ():
            warnings.warn(note, TerrainwaveWarning, stacklevel=2)
        self._dtype = np.dtype(self.info.dtype)
        backend = self._backend
        self.earlier, self.came_from = backend.earlier, backend.came_from
        self.undeclared_values: tuple[int | float, ...] = tuple(backend.undeclared)
        self.is_file, block_cols = backend.is_file, backend.block_shape[1]
        self.is_striped = self.is_file and block_cols >= self.info.n_cols > _NARROW_COLS

    def _settle_nodata(self, choice: NodataChoice, notes: list[str]) -> int | float | None:
        dtype, declared = self._backend.dtype, self._backend.nodata
        # Stored values that mark voids, including the file's nodata value.
        self._voids: list[Any] = []
        nodata = None
        if choice.value is not None:
            nodata, problem = fit_nodata(choice.value, dtype)
            if problem:
                raise InvalidArgumentError(f"{problem}: choose another `nodata`")
        if declared is not None and choice.keeps_declared:
            declared, problem = fit_nodata(declared, dtype)
            if problem:
                notes.append(f"{problem}, so no sample can equal it: ignored")
            elif nodata is None:
                nodata = declared
            elif declared is not None and not is_same_value(declared, nodata, dtype):
                notes.append(
                    f"{self.name}: {declared:g} marks voids too; the file marks all of them by"
                    f" {nodata:g}"
                )
                self._voids.append(stored_nodata(declared, dtype))
        if nodata is not None:
            self._voids.append(stored_nodata(nodata, dtype))
        self._voids = [value for value in self._voids if value == value]
        return nodata

    def _complete_info(self, choice: NodataChoice, notes: list[str]) -> RasterInfo:
        backend = self._backend
        dtype = backend.dtype
        _check_dtype(dtype, self.name)
        nodata = self._settle_nodata(choice, notes)
        transform = backend.transform
        tags = dict(backend.tags())
        problem = _problem_of(transform)
        if problem:
            has_crs = tags["crs"] is not None
            notes.append(f"{problem}, so it is ignored{', and the CRS with it' * has_crs}")
            transform, tags["crs"] = IDENTITY, None
            tags["coordinate_epoch"] = None
        if backend.has_mask:
            mask_kind = "mask"
        elif dtype.kind == "f" and (nodata is None or math.isnan(nodata)):
            mask_kind = "nan"
        else:
            mask_kind = "none" if nodata is None else "nodata"
        info = RasterInfo(
            n_rows=backend.n_rows,
            n_cols=backend.n_cols,
            dtype=dtype.name,
            nodata=nodata,
            transform=transform,
            mask_kind=mask_kind,
            **{**tags, "heights_are": self.told.kind if self.told else None},
        )
        if info.impossible_places is not None:
            notes.append(
                f"{self.name}: {info.impossible_places}. Tiles, servers, STAC items and geocentric"
                " meshes of the file are refused"
            )
        return info

    def with_meaning(self, minimum: float, maximum: float) -> tuple[RasterInfo, list[str]]:
        """Return `info` with the meaning of the numbers, by the extremes as stored, and notes.

        Reads the raster again if only a name suggests depths and some values are below 0, and the
        rasters of a mosaic if some may have radii and others not, which is refused.
        """
        info = self.info
        if self.is_asked or minimum > maximum:
            return info, []
        low, high = sorted(end * info.scale + info.offset for end in (minimum, maximum))
        metres = self._in_metres((minimum, maximum), info.crs)
        is_mixed = may_have_radii(info.crs, metres) and not are_radii(info.crs, [metres])
        if is_mixed or self._backend.is_told:
            self._refuse_some_radii(info.crs)
        told = self.told or Told()
        is_unsure = told.kind is not None and told.is_name and low < 0
        kind, note = settled_kind(
            told,
            info.crs,
            metres,
            is_mostly_negative=is_unsure and (high <= 0 or self._is_mostly_negative()),
        )
        return replace(info, heights_are=kind), [f"{self.name}: {note}"] if note else []

    def settled(self, crs_text: str | None) -> Told | None:
        """Return the meaning of the numbers, told or else by their values; None without any.

        `crs_text` is the CRS of a raster that has none. Raises `InvalidHeightsError` if only some
        rasters of a mosaic have radii.
        """
        crs_text = self.info.crs or crs_text
        if not self.is_asked:
            self._refuse_some_radii(crs_text)
        windows = (self.read(*region) for region in self.blocks())
        metres = (self._in_metres(ends, crs_text) for ends in _ends(windows))
        return by_numbers(self.told or Told(), crs_text, metres)

    def _refuse_some_radii(self, crs_text: str | None) -> None:
        found = list[tuple[str, Told]]()
        with self._lent() as backend:
            for name, told, windows in backend.parts(_SCAN_SAMPLES):
                metres = (self._in_metres(ends, crs_text) for ends in _ends(windows))
                kind = by_numbers(told, crs_text, metres)
                if kind is not None:
                    found.append((name, kind))
        if found:
            from terrainwave.raster_io.mosaic import check_radii

            check_radii(found, crs_text)

    def _in_metres(self, ends: tuple[float, float], crs_text: str | None) -> tuple[float, float]:
        info = self.info
        return in_metres(ends, info.scale, info.offset, info.units, crs_text)

    def _is_mostly_negative(self) -> bool:
        n_below = n_valid = 0
        for region in self.blocks():
            heights, valid = self.read(*region)
            n_valid += int(valid.sum())
            n_below += int((self.info.to_physical(heights[valid]) < 0).sum())
        return 2 * n_below > n_valid

    @contextmanager
    def _lent(self) -> Iterator[RasterBackend]:
        """Yield a reader for one thread; they take turns if it cannot be opened again."""
        other = None
        if not self._first_free.acquire(blocking=False):
            other = self._other()
            if other is None:
                self._first_free.acquire()
        try:
            yield self._backend if other is None else other
        finally:
            if other is None:
                self._first_free.release()
            else:
                self._idle.append(other)

    def _other(self) -> RasterBackend | None:
        with suppress(IndexError):
            return self._idle.pop()
        other = self._backend.again()
        if other is not None:
            self._others.append(other)
        return other

    def read(self, row: int, col: int, n_rows: int, n_cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Return heights of a window inside the grid, a copy, and their validity.

        Raises `InvalidHeightsError` if a valid sample is infinite, `StorageError` if reading fails.
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
        with self._lent() as backend:
            heights, valid = backend.read(row, col, n_rows, n_cols)
        with self._counting:
            self.n_bytes_read += heights.nbytes
        for value in self._voids:
            valid &= heights != value
        if self._dtype.kind == "f":
            valid &= ~np.isnan(heights)
            self._check_finite(heights, valid, row, col)
        return heights, valid

    def even(self, region: Region) -> Even | None:
        """Return the common content of a region if the source's index gives it."""
        with self._lent() as backend:
            even = backend.even(region)
        if even is None or not even.is_valid:
            return even
        value = even.value
        is_float = self._dtype.kind == "f"
        if is_float and np.isinf(value):  # refused when read
            return None
        is_void = is_float and bool(np.isnan(value))
        is_void |= any(bool(value == one) for one in self._voids)
        return Even(value, not is_void)

    def undeclared(self, region: Region) -> np.ndarray | None:
        """Return which heights of a region the source declares void, against `nodata`, if any."""
        if not self._backend.undeclared:
            return None
        heights, valid = self.read(*region)
        with self._lent() as backend:
            return valid & backend.declared_voids(region, heights)

    def holds(self, region: Region, even: Even) -> bool:
        """Read corners and middle of a region; return whether they match the index."""
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
        """Yield windows that cover the grid, in the order of its blocks."""
        info = self.info
        block_rows, block_cols = self._backend.block_shape
        yield from scan_windows(info.n_rows, info.n_cols, block_rows, block_cols, max_samples)

    def parts(self) -> Iterator[tuple[Region, Even | None]]:
        """Yield the windows of `blocks`, divided where a part is even, with their content."""
        bands: dict[int, Even | None] = {}
        band = Region(0, 0, 0, 0)
        for block in self.blocks():
            # Blocks may be thousands of times as wide as high: take many rows of them at a time.
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
        for backend in (self._backend, *self._others):
            backend.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _ends(windows: Iterable[tuple[np.ndarray, np.ndarray]]) -> Iterator[tuple[float, float]]:
    for heights, valid in windows:
        found = heights[valid]
        if found.size:
            yield float(found.min()), float(found.max())


def _problem_of(transform: Transform) -> str:
    """Return why an affine transform cannot place samples; "" if it can."""
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
    """Arguments of `RasterSource` that concern opening."""

    band: int
    nodata: NodataChoice
    georeference: bool
    open_terrain: OpenTerrain | None
    heights_are: str | None

    def backend(self, source: Any) -> RasterBackend:
        if isinstance(source, list | tuple) and source and all(map(self._is_raster, source)):
            if len(source) > 1:
                if not self.georeference:
                    raise InvalidArgumentError(
                        f"found `georeference` False and {len(source)} rasters, expected one: a"
                        " mosaic is put together by their places"
                    )
                from terrainwave.raster_io.mosaic import MosaicBackend

                return MosaicBackend(source, self._raster, self.nodata, self.heights_are)
            source = source[0]
        if self._is_raster(source):
            return self._raster(source)
        from terrainwave.raster_io.arrays import ArrayBackend, LabelledBackend

        if isinstance(source, np.ndarray):
            return ArrayBackend(source)
        if hasattr(source, "dims") and hasattr(source, "coords"):
            return LabelledBackend(
                source, self.band, nodata=self.nodata, georeference=self.georeference
            )
        if isinstance(source, list | tuple):
            return ArrayBackend(np.asarray(source))
        raise InvalidArgumentError(
            f"found {shown(source)}, expected a path, a rasterio dataset, a 2-D array, an"
            " xarray DataArray or Dataset, or a list of paths or datasets"
        )

    def _is_raster(self, source: Any) -> bool:
        is_dataset = hasattr(source, "read_masks") and hasattr(source, "block_shapes")
        return is_dataset or isinstance(source, str | os.PathLike) or self._is_terrain(source)

    def _is_terrain(self, source: Any) -> bool:
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
        return DatasetBackend(
            dataset, self.band, owned=is_path, georeference=self.georeference, nodata=self.nodata
        )

    def _refuse_options_of_rasters(self, source: Any) -> None:
        name = shown(getattr(source, "name", source))
        if self.band != 1:
            raise InvalidArgumentError(
                f"found `band` {self.band} and {name}, expected 1: a .twz file has one band"
            )
        if self.nodata != NodataChoice():
            given = "none" if self.nodata.value is None else f"{self.nodata.value:g}"
            raise InvalidArgumentError(
                f"found `nodata` {given} and {name}, expected no such option: a .twz file knows its"
                " voids"
            )
