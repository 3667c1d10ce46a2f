"""A GeoTIFF or COG, written window by window and renamed into place at the end."""

import contextlib
import errno
import os
import shutil
import tempfile
import threading
import warnings
import zlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self
from xml.etree import ElementTree

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.crs import CRS
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning
from rasterio.io import MemoryFile
from rasterio.transform import Affine
from rasterio.windows import Window

from terrainwave.container.spool import cannot_write, storage_errors
from terrainwave.container.targets.publication import beside, publish, remove_of_gdal, scratch
from terrainwave.errors import CorruptStreamError, StorageError
from terrainwave.forks import renew_after_fork
from terrainwave.grid.affine import IDENTITY
from terrainwave.grid.quadtree import Region
from terrainwave.place.meaning import DEPTH, DOWN, HEIGHT, POSITIVE, UP
from terrainwave.raster_io.gdal import (
    GDAL_ERRORS,
    SCAN_SAMPLES,
    bounded_env,
    one_line,
    scan_windows,
)
from terrainwave.raster_io.raster_info import (
    DOMAIN,
    PLAIN_COLORS,
    RasterInfo,
    is_statistic,
    stored_nodata,
    writable_tags,
)
from terrainwave.raster_io.vrt import unreported

TILE = 512

# With fewer free bytes, a disk is tested by writing this many.
_NEARLY_FULL = 64 << 10

# Compressed output may be far smaller than its raw size; below this share it cannot fit.
_SMALLEST_SHARE = 0.05


def geotiff_profile(info: RasterInfo) -> dict[str, Any]:
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "height": info.n_rows,
        "width": info.n_cols,
        "count": 1,
        "dtype": info.dtype,
        "nodata": info.nodata,
        "crs": info.rasterio_crs(),
        "tiled": True,
        "blockxsize": TILE,
        "blockysize": TILE,
    }
    # With a CRS the identity is a real transform: rasters without transform have no CRS
    # (dataset.is_placed).
    if info.transform != IDENTITY or info.crs is not None:
        profile["transform"] = Affine(*info.transform)
    return profile


def band_tags_of(info: RasterInfo) -> dict[str, str]:
    tags = dict(writable_tags(info.band_tags))
    if info.heights_are in (DEPTH, HEIGHT):
        tags = {name: value for name, value in tags.items() if name.lower() != POSITIVE}
        tags[POSITIVE] = DOWN if info.heights_are == DEPTH else UP
    return tags


def write_description(dataset: Any, info: RasterInfo) -> None:
    dataset.update_tags(**dict(writable_tags(info.tags)))
    dataset.update_tags(1, **band_tags_of(info))
    color = info.color_interpretation
    if color in ColorInterp.__members__ and color not in PLAIN_COLORS:
        dataset.colorinterp = (ColorInterp[color],)
    if info.area_or_point is not None:
        dataset.update_tags(AREA_OR_POINT=info.area_or_point)
    if info.units is not None:
        dataset.units = (info.units,)
    if (info.scale, info.offset) != (1.0, 0.0):
        dataset.scales = (info.scale,)
        dataset.offsets = (info.offset,)
    if info.description is not None:
        dataset.descriptions = (info.description,)


class _Threads:
    """Number of threads that GDAL may compress with; after a fork it waits for them forever."""

    def __init__(self) -> None:
        self._are_there = self._are_gone = False
        renew_after_fork(self)

    def renew(self) -> None:
        self._are_gone = self._are_there

    def allowed(self, n_threads: int) -> int:
        """Return how many of `n_threads` GDAL may use: one if it had threads before a fork."""
        if self._are_gone:
            return 1
        self._are_there |= n_threads > 1
        return n_threads


_THREADS = _Threads()


class RasterSink:
    """GeoTIFF written window by window; it appears complete or not at all. A context manager.

    Windows may come in any order, each sample once; windows of `blocks` are the most efficient. If
    a nodata value marks voids, entirely void windows may be left out: their tiles take no bytes.
    All windows are read back before the file is published, because GDAL hides errors of its threads
    and of its last writes, and puts zeros in place of failed tiles. Memory: one window and GDAL's
    cache. While a COG is made, whose overviews are averages, it needs twice the size of the file on
    disk. `stated` are items of the band's metadata, in `DOMAIN`, which GDAL does not copy into a
    COG. Raises `StorageError` if the target exists, cannot be written, or the disk cannot hold it.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        info: RasterInfo,
        *,
        cog: bool = False,
        overwrite: bool = False,
        n_threads: int = 1,
        stated: Mapping[str, str] | None = None,
    ) -> None:
        self.info = info
        self._stated = stated or {}
        self._path = os.fspath(path)
        self._cog = cog
        self._n_threads = _THREADS.allowed(n_threads)
        self._dtype = np.dtype(info.dtype)
        # Void windows may be left out: they read as the nodata value.
        self.may_be_sparse = info.nodata is not None and info.mask_kind != "mask" and not cog
        self._lock = threading.Lock()
        # Each window, and checksums of its heights and of its mask, if any.
        self._written: list[tuple[Window, int, int | None]] = []
        with ExitStack() as files:
            self._target = files.enter_context(publish(path, overwrite)).path
            folder = self._target.parent
            free = shutil.disk_usage(folder).free
            if free < info.n_bytes * _SMALLEST_SHARE:
                raise StorageError(
                    f"cannot write {self._path}: {free:,} bytes are free in {folder}, the raster is"
                    f" {info.n_bytes:,} bytes uncompressed"
                )
            # A COG is a translation of a finished file.
            self._part = files.enter_context(scratch(path)).path if cog else self._target
            try:
                self._dataset = self._create()
            except UnicodeEncodeError as error:
                raise StorageError(
                    f"cannot write {self._path}: the name is not UTF-8, which GDAL expects;"
                    " choose another name"
                ) from error
            except GDAL_ERRORS as error:
                raise self._cannot_write(error) from error
            self._files = files.pop_all()

    def _create(self) -> Any:
        profile = geotiff_profile(self.info) | {
            "compress": "DEFLATE",
            "predictor": 3 if self._dtype.kind == "f" else 2,
            "bigtiff": "IF_SAFER",
            "num_threads": self._n_threads,
        }
        if self.may_be_sparse:
            profile["sparse_ok"] = True
        with bounded_env(), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            dataset = rasterio.open(self._part, "w", **profile)
            write_description(dataset, self.info)
            if self._stated:
                dataset.update_tags(1, ns=DOMAIN, **self._stated)
        return dataset

    def blocks(self, max_samples: int = SCAN_SAMPLES) -> Iterator[Region]:
        info = self.info
        yield from scan_windows(info.n_rows, info.n_cols, TILE, TILE, max_samples)

    def write(self, row: int, col: int, heights: np.ndarray, valid: np.ndarray) -> None:
        """Write the window at (row, col); void samples get nodata, `heights` is not changed."""
        info = self.info
        if not valid.all():
            if info.mask_kind == "none":
                raise CorruptStreamError(
                    "there are void samples, but the metadata say there are none"
                )
            void = info.void_value
            heights = np.where(valid, heights, stored_nodata(void, self._dtype))
        n_rows, n_cols = heights.shape
        window = Window(col, row, n_cols, n_rows)
        try:
            # The mask is internal: a .msk file would not be renamed with the raster.
            with self._lock, bounded_env(GDAL_TIFF_INTERNAL_MASK=True):
                heights = np.ascontiguousarray(heights, dtype=self._dtype)
                self._dataset.write(heights, 1, window=window)
                mask_crc = None
                if info.mask_kind == "mask":
                    self._dataset.write_mask(valid, window=window)
                    mask_crc = zlib.crc32(np.packbits(valid).data)
                self._written.append((window, zlib.crc32(heights.data), mask_crc))
        except GDAL_ERRORS as error:
            raise self._cannot_write(error) from error
        # GDAL's threads report no errors: all windows would be written, with a message of libtiff
        # for each tile.
        if self._n_threads > 1 and _is_full(self._part.parent):
            raise self._full_disk()

    def close(self) -> None:
        with self._files:
            try:
                with bounded_env(GDAL_TIFF_INTERNAL_MASK=True):
                    self._dataset.close()
                self._check_complete(self._part)
                if self._cog:
                    self._translate_to_cog()
                    self._check_complete(self._target)
            except GDAL_ERRORS as error:
                # GDAL's file next to a COG while it computes overviews.
                for path in beside(self._target):
                    with contextlib.suppress(OSError):
                        path.unlink()
                if isinstance(error, StorageError):
                    raise
                raise self._cannot_write(error) from error

    def abort(self) -> None:
        with contextlib.suppress(*GDAL_ERRORS):
            self._dataset.close()
        with contextlib.suppress(_Aborted), self._files:
            raise _Aborted

    def _translate_to_cog(self) -> None:
        with bounded_env(GDAL_TIFF_INTERNAL_MASK=True), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            rasterio.shutil.copy(
                self._part,
                self._target,
                driver="COG",
                compress="DEFLATE",
                predictor="YES",
                blocksize=TILE,
                overview_resampling="AVERAGE",
                bigtiff="IF_SAFER",
                num_threads=self._n_threads,
            )

    def _check_complete(self, part: Path) -> None:
        """Raise StorageError unless every tile lies inside the file and holds what was written.

        GDAL writes the last tiles on closing, and rasterio ignores the result.
        """
        with bounded_env(), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            try:
                is_complete = self._holds_what_was_written(part)
            except GDAL_ERRORS:
                is_complete = False
        if not is_complete:
            raise self._full_disk()

    def _holds_what_was_written(self, part: Path) -> bool:
        size = part.stat().st_size
        with rasterio.open(part) as dataset:
            for (row, col), _ in dataset.block_windows(1):
                offset = dataset.get_tag_item(f"BLOCK_OFFSET_{col}_{row}", "TIFF", 1)
                if offset is None and self.may_be_sparse:  # void tiles may be missing
                    continue
                n_bytes = dataset.get_tag_item(f"BLOCK_SIZE_{col}_{row}", "TIFF", 1)
                if offset is None or int(offset) + int(n_bytes) > size:
                    return False
        with rasterio.open(part, num_threads=self._n_threads) as dataset:
            for window, crc, mask_crc in self._written:
                if zlib.crc32(dataset.read(1, window=window).data) != crc:
                    return False
                if mask_crc is not None:
                    valid = dataset.read_masks(1, window=window) != 0
                    if zlib.crc32(np.packbits(valid).data) != mask_crc:
                        return False
        return True

    def _full_disk(self) -> StorageError:
        full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return cannot_write(self._path, _refusal(self._part.parent) or full)

    def _cannot_write(self, error: BaseException) -> StorageError:
        # GDAL reports where it failed to write, but libtiff hides the reason.
        return cannot_write(self._path, _refusal(self._part.parent) or one_line(error))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()


def _is_full(folder: Path) -> bool:
    """Return whether a disk accepts no more data; the reported free space may be wrong."""
    return shutil.disk_usage(folder).free < _NEARLY_FULL and _refusal(folder) is not None


def _refusal(folder: Path) -> OSError | None:
    try:
        with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
            n_bytes = 0
            while n_bytes < _NEARLY_FULL:
                n_bytes += file.write(bytes(_NEARLY_FULL - n_bytes))
    except OSError as error:
        return error
    return None


class _Aborted(Exception):
    """Makes `publish` behave as after a failure."""


SIDECAR = ".aux.xml"
# Elements of a band that hold statistics.
_MEASURED = ("Histograms", "Minimum", "Maximum")
# Domains with a .twz file's own properties, which GDAL copies.
_OF_TWZ = ("TERRAINWAVE", "json:TERRAINWAVE", "IMAGE_STRUCTURE")


def read_place(path: str | os.PathLike[str]) -> tuple[CRS | None, str | None, float | None]:
    with bounded_env(), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            epoch = unreported(dataset, 1).coordinate_epoch
            return dataset.crs, dataset.units[0] or None, epoch


def forget_measured(path: str | os.PathLike[str]) -> list[str]:
    """Remove GDAL's statistics of a raster whose heights have changed; return notes.

    The rest of the .aux.xml next to it stays; overviews are removed with their file.
    """
    notes = []
    for name in sorted({os.path.realpath(path), os.path.abspath(path)}):
        target = Path(f"{name}{SIDECAR}")
        if not os.path.lexists(target):
            continue
        try:
            content = ElementTree.parse(target).getroot()
        except ElementTree.ParseError:
            notes.append(f"{target.name} is no XML and may hold old statistics: removed")
            content = ElementTree.Element("PAMDataset")
        _drop_measured(content)
        if len(content):
            _write(target, content)
        else:
            remove_of_gdal(name, SIDECAR)
    remove_of_gdal(path, ".ovr")
    return notes


def _drop_measured(element: Any) -> None:
    for child in list(element):
        _drop_measured(child)
        is_domain = child.tag == "Metadata" and child.get("domain") in _OF_TWZ
        is_value = child.tag == "MDI" and is_statistic(child.get("key", ""))
        is_empty = child.tag in ("Metadata", "PAMRasterBand") and not len(child)
        if is_domain or is_value or is_empty or child.tag in _MEASURED:
            element.remove(child)


def write_beside(
    path: str | os.PathLike[str], crs: CRS, unit: str | None, epoch: float | None = None
) -> None:
    """Write CRS, epoch and unit of a raster's band to its .aux.xml, which GDAL reads first."""
    target = Path(f"{os.fspath(path)}{SIDECAR}")
    content = ElementTree.Element("PAMDataset")
    system = _as_gdal_writes_it(crs)
    if epoch is not None:
        system.set("coordinateEpoch", repr(epoch))
    content.append(system)
    if unit is not None:
        band = ElementTree.SubElement(content, "PAMRasterBand", band="1")
        ElementTree.SubElement(band, "UnitType").text = unit
    _write(target, content)


def _write(target: Path, content: Any) -> None:
    with publish(target, True) as part, storage_errors(f"cannot write {target}"):
        part.file.write(ElementTree.tostring(content, encoding="utf-8"))


def _as_gdal_writes_it(crs: CRS) -> Any:
    """Return GDAL's element for a CRS, copied from the .aux.xml of a PNG."""
    with tempfile.TemporaryDirectory() as directory, bounded_env(), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        name = Path(directory) / "place.png"
        profile = {"driver": "PNG", "width": 1, "height": 1, "count": 1, "dtype": "uint8"}
        with rasterio.open(name, "w", crs=crs, **profile) as dataset:
            dataset.write(np.zeros((1, 1, 1), dtype=np.uint8))
        return ElementTree.parse(f"{name}{SIDECAR}").getroot().find("SRS")


def crs_of_geotiff(head: bytes) -> CRS | None:
    with bounded_env(), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with MemoryFile(head) as memory, memory.open() as dataset:
            return dataset.crs
