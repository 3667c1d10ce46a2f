"""A band of anything that rasterio opens."""

import copy
import errno
import math
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.enums import MaskFlags
from rasterio.errors import NotGeoreferencedWarning, RasterioIOError
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from terrainwave.arguments import NodataChoice, check_band
from terrainwave.container.sources.addresses import display_name, without_secrets
from terrainwave.errors import InvalidHeightsError, StorageError, TerrainwaveError
from terrainwave.grid.affine import IDENTITY
from terrainwave.grid.quadtree import Region
from terrainwave.place.crs import format_crs, is_exact
from terrainwave.place.meaning import Names, Told, told_by
from terrainwave.place.units import is_length
from terrainwave.raster_io.backend import RasterBackend
from terrainwave.raster_io.even import Even, SparseBlocks, StoredValues, stored_values
from terrainwave.raster_io.gdal import GDAL_ERRORS, bounded_env, one_line
from terrainwave.raster_io.raster_info import PLAIN_COLORS, is_statistic, select_tags, undeclared_by
from terrainwave.raster_io.vrt import Unreported, is_warped, remark_on_windows, unreported

# Tags that GDAL derives rather than stores, and positions, which have a note of their own.
_DERIVED_TAGS = (
    "", "IMAGE_STRUCTURE", "DERIVED_SUBDATASETS", "SUBDATASETS", "RPC", "TIFF", "xml:VRT",
    "OVERVIEWS", "LocationInfo", "vrt_sources", "new_vrt_sources", "GEOLOCATION",
)  # fmt: skip
# netCDF's tags of a band with values that mark voids; GDAL uses one of them as nodata.
_VOID_TAGS = ("_FillValue", "missing_value")
_N_NAMES = 4

# Held while warning filters, which belong to the process, are changed.
_FILTERING = threading.Lock()


def open_dataset(path: str) -> Any:
    """Open `path` as `opened` does; refuse .twz files and those without a raster."""
    if "://" not in path and not path.startswith("/vsi") and is_twz(path):
        raise InvalidHeightsError(
            f"{path} is already a terrainwave file; expected a raster such as a GeoTIFF"
            " (terrainwave decompress makes one of it)"
        )
    dataset = opened(path)
    if dataset.count == 0:
        parts = ", ".join(dataset.subdatasets[:4])
        dataset.close()
        advice = f"; it holds several rasters, name one of them: {parts}" if parts else ""
        raise InvalidHeightsError(f"{display_name(path)} has no raster band{advice}")
    return dataset


def opened(path: str) -> Any:
    """Open `path` with rasterio; turn each failure into one line with advice."""
    local = Path(path)
    is_local = "://" not in path and not path.startswith("/vsi")
    try:
        with _FILTERING, bounded_env(), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            return rasterio.open(path)
    except UnicodeEncodeError as error:  # bytes of a name that are not text
        raise StorageError(
            f"{path}: the name is not UTF-8, which GDAL expects; rename the file"
        ) from error
    except RasterioIOError as error:
        if is_local and local.is_dir():
            raise StorageError(f"{path} is a directory; expected a raster file") from error
        if is_local and ":" not in path and not local.exists():
            raise StorageError(f"{path}: no such file") from error
        if is_local and local.is_file() and not local.stat().st_size:
            raise StorageError(f"{path} is empty; expected a raster file") from error
        problem = without_secrets(one_line(error))
        raise StorageError(
            f"{display_name(path)} is not a raster that GDAL can read: {problem}"
        ) from error


def refuse_raster(target: str | os.PathLike[str]) -> None:
    """Raise `StorageError` if a .twz would replace a raster: perhaps the only copy."""
    if not os.path.exists(target):
        return
    try:
        open_dataset(os.path.realpath(target)).close()
    except TerrainwaveError:  # a .twz, or unknown to GDAL
        return
    raise StorageError(
        f"{os.fspath(target)} is a raster and is never replaced; expected another name for the"
        " result"
    )


def _reason(error: BaseException) -> str:
    reason = one_line(error)
    if os.strerror(errno.EMFILE) in reason:
        reason += (
            "; a VRT keeps some 100 of its files open: allow more (ulimit -n 1024), or set"
            " GDAL_MAX_DATASET_POOL_SIZE=10"
        )
    return reason


def is_twz(path: str | os.PathLike[str]) -> bool:
    try:
        with Path(path).open("rb") as file:
            return b"TWZ" in file.read(8).upper()
    except (OSError, ValueError):
        return False


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return None if math.isnan(value) else value


def is_placed(dataset: Any) -> bool:
    """Return whether a dataset has a transform; rasterio returns the identity if it has none."""
    if tuple(dataset.transform[:6]) != IDENTITY:
        return True
    if _other_places(dataset):
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("error", NotGeoreferencedWarning)
        try:
            dataset.read_transform()
        except NotGeoreferencedWarning:
            return False
    return True


def _other_places(dataset: Any) -> list[str]:
    found = {
        "GCPs": dataset.gcps[0],
        "RPCs": getattr(dataset, "rpcs", None),
        "geolocation arrays": "GEOLOCATION" in dataset.tag_namespaces(),
    }
    return [name for name, value in found.items() if value]


def _stamp(dataset: Any) -> tuple[int, ...] | None:
    try:
        found = os.stat(dataset.name)
    except (OSError, ValueError):
        return None
    if dataset.driver != "GTiff":
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def told_of(dataset: Any, band: int) -> Told:
    marks = dataset.tags(band)
    if dataset.count == 1:
        marks = {**dataset.tags(), **marks}
    # HDF5:file.h5://group/variable
    variable = dataset.name.rsplit("/", 1)[-1] if dataset.driver == "HDF5Image" else None
    title, units = dataset.descriptions[band - 1], dataset.units[band - 1]
    names = Names(variable, title, is_length(units), dataset.driver)
    return told_by(marks, names, format_crs(dataset.crs))


class DatasetBackend(RasterBackend):
    """A band of a rasterio dataset."""

    told: Told

    def __init__(
        self,
        dataset: Any,
        band: int,
        *,
        owned: bool,
        georeference: bool = True,
        nested: int = 0,
        nodata: NodataChoice | None = None,
    ) -> None:
        self._owned = owned
        self._choice = nodata or NodataChoice()
        self._nested = nested
        self._dataset = dataset
        self._band = band
        self._georeference = georeference
        self._stamp = _stamp(dataset) if owned else None
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
        check_band(band, dataset.count, self.name)
        self.n_rows, self.n_cols = int(dataset.height), int(dataset.width)
        self.dtype = np.dtype(dataset.dtypes[band - 1])
        self.nodata = dataset.nodatavals[band - 1]
        self.undeclared = undeclared_by(self._choice, [self.nodata], self.dtype)
        self.block_shape: tuple[int, int] = dataset.block_shapes[band - 1]
        self.transform = tuple(float(value) for value in dataset.transform[:6])
        self.crs = dataset.crs
        self.is_lost = not is_placed(dataset)
        if self.is_lost or not self._georeference:
            self.transform, self.crs = IDENTITY, None
        flags = dataset.mask_flag_enums[band - 1]
        colors = [color.name for color in dataset.colorinterp]
        # GDAL uses an alpha as mask only in 8 and 16 bits, and only without a nodata value.
        self._alphas = [
            number for number, color in enumerate(colors, 1) if color == "alpha" and number != band
        ]
        # Neither flag: a mask band of only this band.
        is_plain = MaskFlags.all_valid in flags or flags == [MaskFlags.nodata]
        self._has_own_mask = not is_plain and MaskFlags.alpha not in flags
        self.has_mask = self._has_own_mask or bool(self._alphas)
        self._tags = select_tags(dataset.tags())
        self._band_tags = select_tags(dataset.tags(band))
        self.told = told_of(dataset, band)

    def remarks(self) -> Iterator[str]:
        dataset, band = self._dataset, self._band
        others = self._other_bands()
        if others and band == 1:
            n_bands = dataset.count - len(self._alphas)
            yield f"found {n_bands} bands; using band 1 (choose with --band); left out: {others}"
        if band == 1 and dataset.colorinterp[0].name == "alpha":
            yield "band 1 is an alpha band, whose numbers are taken for heights"
        if len(self._alphas) > 1:
            numbers = " and ".join(map(str, self._alphas))
            yield f"bands {numbers} are alpha bands: heights are void where one of them is 0"
        windows = remark_on_windows(dataset)
        if windows is not None:
            yield windows
        yield from self._notes_on_place()
        yield from self._notes_on_nodata()
        if dataset.subdatasets:
            names = ", ".join(dataset.subdatasets[:_N_NAMES])
            more = ", …" if len(dataset.subdatasets) > _N_NAMES else ""
            yield (
                "it holds several rasters, of which only the one that GDAL opens by this name is"
                f" taken; there are: {names}{more}"
            )
        dropped = {
            f"the tags {name}"
            for name in (*dataset.tag_namespaces(), *dataset.tag_namespaces(band))
            if name not in _DERIVED_TAGS
        }
        dropped |= set(self._unreported.others)
        if dataset.colorinterp[band - 1].name == "palette":
            dropped.add("its colour table")
        left_out = [*self._tags.left_out, *self._band_tags.left_out]
        if left_out:
            dropped.add(f"the tags {', '.join(left_out)}")
        if dropped:
            what = ", ".join(sorted(dropped))
            yield f"dropped, as a .twz file does not hold them: {what}"

    def _other_bands(self) -> str:
        dataset, used = self._dataset, (self._band, *self._alphas)
        others = [number for number in range(1, dataset.count + 1) if number not in used]
        if len(others) > 2 * _N_NAMES:
            return f"{len(others)} bands, from {others[0]} to {others[-1]}"
        names = ((number, dataset.descriptions[number - 1]) for number in others)
        return ", ".join(
            f"band {number}" + (f" ({name})" if name else "") for number, name in names
        )

    def asides(self) -> Iterator[str]:
        """Yield notes that need no warning: on other bands, and on what heights give again."""
        others = self._other_bands()
        if others and self._band != 1:
            yield f"using band {self._band}; left out: {others}"
        band_tags, derived = self._dataset.tags(self._band), []
        # A VRT would open its sources for that.
        if self._dataset.driver != "VRT" and self._dataset.overviews(self._band):
            derived.append("overviews (levels are samples of the full grid)")
        if any(is_statistic(name) for name in band_tags):
            derived.append("statistics")
        if derived:
            yield f"not kept, as the heights give them again: {' and '.join(derived)}"

    def _notes_on_place(self) -> Iterator[str]:
        dropped = " and ".join(_other_places(self._dataset))
        if self._georeference and dropped:
            lost = (
                ", and nothing else says where its samples lie: place and CRS are lost; gdalwarp"
                " makes a raster with a transform of it"
            )
            yield (
                f"{dropped} are dropped, a .twz file does not hold them"
                f"{lost if self.is_lost else ''}"
            )
        elif self._georeference and self.is_lost and self._dataset.crs:
            yield (
                "no transform says where its samples lie, so its CRS is dropped: give it one, for"
                " example by gdal_edit -a_ullr"
            )
        if not is_exact(self.crs):
            yield (
                "the CRS is kept as WKT that does not say all of it: compare gdalinfo of the raster"
                " and of what decompress makes"
            )

    def _notes_on_nodata(self) -> Iterator[str]:
        chosen = self._choice.value
        is_open = self.nodata is None and chosen is None and not self.has_mask
        if self._dataset.driver == "VRT" and is_open:
            remedy = "set it with gdalbuildvrt -vrtnodata, or name the files themselves"
            if isinstance(self._dataset, WarpedVRT):
                remedy = "make the WarpedVRT with nodata=…, or with add_alpha=True"
            elif is_warped(self._dataset):
                remedy = "set it with gdalwarp -dstnodata, or add a mask with -dstalpha"
            yield (
                "the VRT declares no nodata value: where none of its sources lies, heights are 0"
                f" and count as such; {remedy}"
            )
        tags = self._dataset.tags(self._band)
        for name in _VOID_TAGS:
            value = _number(tags.get(name, ""))
            if value is not None and value not in (self.nodata, chosen):
                yield (
                    f"the band's tag {name} is {tags[name]}, its nodata value"
                    f" {'none' if self.nodata is None else f'{self.nodata:g}'}: heights of"
                    f" {tags[name]} count as heights (choose with --nodata)"
                )

    def tags(self) -> dict[str, Any]:
        dataset, index = self._dataset, self._band - 1
        color = dataset.colorinterp[index].name
        return {
            "crs": format_crs(self.crs),
            "coordinate_epoch": self._unreported.coordinate_epoch if self.crs else None,
            "units": dataset.units[index] or None,
            "scale": float(dataset.scales[index]),
            "offset": float(dataset.offsets[index]),
            "area_or_point": dataset.tags().get("AREA_OR_POINT"),
            "description": dataset.descriptions[index] or None,
            "color_interpretation": None if color in PLAIN_COLORS else color,
            "tags": self._tags.kept,
            "band_tags": self._band_tags.kept,
        }

    @cached_property
    def _unreported(self) -> Unreported:
        return unreported(self._dataset, self._band)

    def read(self, row: int, col: int, n_rows: int, n_cols: int) -> tuple[np.ndarray, np.ndarray]:
        window = Window(col, row, n_cols, n_rows)
        try:
            with bounded_env():
                heights = self._dataset.read(self._band, window=window)
                valid = np.ones(heights.shape, dtype=bool)
                if self._has_own_mask:
                    valid &= self._dataset.read_masks(self._band, window=window) != 0
                for alpha in self._alphas:
                    valid &= self._dataset.read(alpha, window=window) > 0
                return heights, valid
        except GDAL_ERRORS as error:
            raise StorageError(
                f"{self.name}: rows {row} to {row + n_rows - 1}, columns {col} to"
                f" {col + n_cols - 1} cannot be read: {_reason(error)}"
            ) from error

    def again(self) -> "DatasetBackend | None":
        """Return the band opened again, of an unchanged local GeoTIFF without a mask; else None."""
        if self._stamp is None or self.has_mask:
            return None
        try:
            dataset = open_dataset(self.name)
        except TerrainwaveError:  # too many open files
            return None
        if _stamp(dataset) != self._stamp:
            dataset.close()
            return None
        other = copy.copy(self)
        other._dataset = dataset
        stored = other.__dict__.pop("_stored", None)
        if isinstance(stored, SparseBlocks):
            other._stored = stored.of(dataset, other._sample)
        return other

    def even(self, region: Region) -> Even | None:
        """Return the content of a region by the file's index; None if only reading can tell.

        Not for voids by a mask, and not for datasets that the caller opened, perhaps for writing.
        """
        if self._stored is None:
            return None
        value = self._stored.value(region)
        return None if value is None else Even(value, True)

    @cached_property
    def _stored(self) -> StoredValues | None:
        if self.has_mask or not self._owned:
            return None
        return stored_values(
            self._dataset, self._band, self._sample, self._open_member, self._nested
        )

    def _sample(self, row: int, col: int) -> Any:
        return self.read(row, col, 1, 1)[0][0, 0]

    def _open_member(self, path: str, band: int) -> Any:
        """Open a source of this VRT; its voids count as heights."""
        return closing(
            DatasetBackend(open_dataset(path), band, owned=True, nested=self._nested + 1)
        )

    def close(self) -> None:
        if self._owned:
            self._dataset.close()


def files_of(path: str) -> list[str]:
    """Return the files that GDAL reads a raster from, those of a VRT's sources too; sorted."""

    def named(name: str) -> list[str]:
        try:
            return _listed(name)
        except TerrainwaveError:  # an accompanying file, such as metadata
            return []

    return sorted(_all_below(_listed(path), named))


def stamps_of(src: Any) -> list[list[str | int]] | None:
    """Return names, sizes and times of the files that rasters are read from, also by VRTs.

    None if a source is not a local file, such as an array or a URL.
    """
    names: set[str] = set()
    for source in src if isinstance(src, list | tuple) else [src]:
        found = _files_below(source)
        if not found:
            return None
        names |= found
    stamps: list[list[str | int]] = []
    for name in sorted(names):
        try:
            seen = os.stat(name)
        except (OSError, ValueError):
            return None
        # Every change of a file sets this time, even one that restores the time of modification.
        stamps.append([os.path.abspath(name), seen.st_size, seen.st_mtime_ns, seen.st_ctime_ns])
    return stamps


def _files_below(source: Any) -> set[str]:
    if hasattr(source, "files") and hasattr(source, "block_shapes"):
        waiting = [os.fspath(name) for name in source.files]
    elif not isinstance(source, str | os.PathLike):
        return set()
    elif is_twz(source):
        return {os.fspath(source)}
    else:
        waiting = _listed(os.fspath(source))
    # Other files name no further ones, and there may be many thousands.
    return _all_below(waiting, lambda name: _listed(name) if name.lower().endswith(".vrt") else [])


def _all_below(names: list[str], named: Callable[[str], list[str]]) -> set[str]:
    found: set[str] = set()
    waiting = [*names]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += named(name)
    return found


def _listed(path: str) -> list[str]:
    with open_dataset(path) as dataset:
        return [os.fspath(name) for name in dataset.files]
