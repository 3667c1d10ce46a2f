"""A band of anything that rasterio opens."""

import errno
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.enums import MaskFlags
from rasterio.errors import NotGeoreferencedWarning, RasterioIOError
from rasterio.windows import Window

from terrainwave.errors import (
    InvalidArgumentError,
    InvalidHeightsError,
    StorageError,
    TerrainwaveError,
)
from terrainwave.grid.affine import IDENTITY
from terrainwave.raster_io.crs import format_crs
from terrainwave.raster_io.gdal import (
    GDAL_ERRORS,
    bounded_env,
    one_line,
)
from terrainwave.raster_io.tags import PLAIN_COLORS, select_tags

# What to convert an unsupported type to; the narrowest of ours that holds all of its values, or


# What GDAL tells of a file rather than keeps in it, and places, which have a note of their own.
_DERIVED_TAGS = (
    "", "IMAGE_STRUCTURE", "DERIVED_SUBDATASETS", "SUBDATASETS", "RPC", "GEOLOCATION", "TIFF",
    "xml:VRT", "OVERVIEWS", "LocationInfo", "vrt_sources", "new_vrt_sources",
)  # fmt: skip


def open_dataset(path: str) -> Any:
    """Open `path` by rasterio; translate each failure into one line that says what to do."""
    local = Path(path)
    is_local = "://" not in path and not path.startswith("/vsi")
    if is_local and _is_twz(local):
        raise InvalidHeightsError(
            f"{path} is already a terrainwave file; expected a raster such as a GeoTIFF"
            " (terrainwave decompress makes one of it)"
        )
    try:
        with bounded_env(), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            dataset = rasterio.open(path)
    except UnicodeEncodeError as error:  # bytes of a name that are no text
        raise StorageError(
            f"{path}: the name is not UTF-8, which GDAL expects; rename the file"
        ) from error
    except RasterioIOError as error:
        if is_local and local.is_dir():
            raise StorageError(f"{path} is a directory; expected a raster file") from error
        if is_local and ":" not in path and not local.exists():
            raise StorageError(f"{path}: no such file") from error
        raise StorageError(
            f"{path} is not a raster that GDAL can read: {one_line(error)}"
        ) from error
    if dataset.count == 0:
        parts = ", ".join(dataset.subdatasets[:4])
        dataset.close()
        advice = f"; it holds several rasters, name one of them: {parts}" if parts else ""
        raise InvalidHeightsError(f"{path} has no raster band{advice}")
    return dataset


def refuse_raster(target: str | os.PathLike[str]) -> None:
    """Raise `StorageError` if a file that is to be replaced by a .twz is a raster, by any name.

    It may be the only copy of what took years to measure.
    """
    if not os.path.exists(target):
        return
    try:
        open_dataset(os.path.realpath(target)).close()
    except TerrainwaveError:  # a .twz, or nothing that GDAL knows
        return
    raise StorageError(
        f"{os.fspath(target)} is a raster and is never replaced; expected another name for the"
        " result"
    )


def _reason(error: BaseException) -> str:
    """Return GDAL's reason for a failed read, and what helps where a VRT has many sources."""
    reason = one_line(error)
    if os.strerror(errno.EMFILE) in reason:
        reason += (
            "; a VRT keeps some 100 of its files open: allow more (ulimit -n 1024), or set"
            " GDAL_MAX_DATASET_POOL_SIZE=10"
        )
    return reason


def _is_twz(path: Path) -> bool:
    """Tell a terrainwave file by its first bytes; by its name if it cannot be read."""
    try:
        with path.open("rb") as file:
            return b"TWZ" in file.read(8).upper()
    except OSError:
        return False


def is_placed(dataset: Any) -> bool:
    """Say whether a dataset has a transform; rasterio gives the identity where GDAL has none."""
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
    """Return what else than a transform tells places of samples: of rows and columns, or each."""
    found = {
        "GCPs": dataset.gcps[0],
        "RPCs": getattr(dataset, "rpcs", None),
        "geolocation arrays": "GEOLOCATION" in dataset.tag_namespaces(),
    }
    return [name for name, value in found.items() if value]


class DatasetBackend:
    """A band of a rasterio dataset."""

    is_file = True

    def __init__(self, dataset: Any, band: int, *, owned: bool, georeference: bool = True) -> None:
        self._owned = owned
        self._dataset = dataset
        self._band = band
        self._georeference = georeference
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
            raise InvalidArgumentError(
                f"{self.name}: `band` {band} does not exist, the file has {bands}"
            )
        self.n_rows, self.n_cols = int(dataset.height), int(dataset.width)
        self.dtype = np.dtype(dataset.dtypes[band - 1])
        self.nodata = dataset.nodatavals[band - 1]
        self.block_shape: tuple[int, int] = dataset.block_shapes[band - 1]
        self.transform = tuple(float(value) for value in dataset.transform[:6])
        self.crs = dataset.crs
        self._is_lost = not is_placed(dataset)
        if self._is_lost or not self._georeference:
            self.transform, self.crs = IDENTITY, None
        flags = dataset.mask_flag_enums[band - 1]
        # Neither flag: a mask band of this band alone.
        is_plain = MaskFlags.all_valid in flags or flags == [MaskFlags.nodata]
        self.has_mask = not is_plain
        self._tags = select_tags(dataset.tags())
        self._band_tags = select_tags(dataset.tags(band))

    def notes(self) -> Iterator[str]:
        """Yield what is left out or was chosen, one sentence each."""
        dataset = self._dataset
        n_bands = sum(1 for color in dataset.colorinterp if color.name != "alpha")
        if n_bands > 1 and self._band == 1:
            yield f"{self.name} has {n_bands} bands; using band 1 (choose with --band)"
        dropped = " and ".join(_other_places(dataset))
        if self._georeference and dropped:
            lost = (
                ", and nothing else says where its samples lie: place and CRS are lost; gdalwarp"
                " makes a raster with a transform of it"
            )
            yield (
                f"{self.name}: {dropped} are dropped, a .twz file does not hold them"
                f"{lost if self._is_lost else ''}"
            )
        elif self._georeference and self._is_lost and dataset.crs:
            yield (
                f"{self.name}: no transform says where its samples lie, so its CRS is dropped: give"
                " it one, for example by gdal_edit -a_ullr"
            )
        others = {
            f"the tags {name}"
            for name in (*dataset.tag_namespaces(), *dataset.tag_namespaces(self._band))
            if name not in _DERIVED_TAGS
        }
        if dataset.colorinterp[self._band - 1].name == "palette":
            others.add("its colour table")
        left_out = [*self._tags.left_out, *self._band_tags.left_out]
        if left_out:
            others.add(f"the tags {', '.join(left_out)}")
        if others:
            what = ", ".join(sorted(others))
            yield f"{self.name}: dropped, as a .twz file does not hold them: {what}"
        if dataset.driver == "VRT" and self.nodata is None and not self.has_mask:
            yield (
                f"{self.name} declares no nodata value: where none of its sources lies, heights are"
                " 0 and count as such; set it with gdalbuildvrt -vrtnodata, or name the files"
                " themselves"
            )

    def tags(self) -> dict[str, Any]:
        """Return the fields of RasterInfo that do not bear on the heights."""
        dataset, index = self._dataset, self._band - 1
        color = dataset.colorinterp[index].name
        return {
            "crs": format_crs(self.crs),
            "units": dataset.units[index] or None,
            "scale": float(dataset.scales[index]),
            "offset": float(dataset.offsets[index]),
            "area_or_point": dataset.tags().get("AREA_OR_POINT"),
            "description": dataset.descriptions[index] or None,
            "color_interpretation": None if color in PLAIN_COLORS else color,
            "tags": self._tags.kept,
            "band_tags": self._band_tags.kept,
        }

    def read(self, row: int, col: int, n_rows: int, n_cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Return heights (a copy) and False where a mask says void."""
        window = Window(col, row, n_cols, n_rows)
        try:
            with bounded_env():
                heights = self._dataset.read(self._band, window=window)
                if not self.has_mask:
                    return heights, np.ones(heights.shape, dtype=bool)
                return heights, self._dataset.read_masks(self._band, window=window) != 0
        except GDAL_ERRORS as error:
            raise StorageError(
                f"{self.name}: rows {row} to {row + n_rows - 1}, columns {col} to"
                f" {col + n_cols - 1} cannot be read: {_reason(error)}"
            ) from error

    def close(self) -> None:
        """Close what was opened here."""
        if self._owned:
            self._dataset.close()
