"""GDAL's XML of datasets: warped rasters, and facts that only the XML states.

For each window GDAL's warper uses an approximation of the transformation, within a tolerance, by
default 0.125 pixels. With nearest neighbours a sample can then come from another pixel. So heights
of warped rasters depend on the windows that are read. Resampled sources of a VRT differ by the
rounding of floats.
"""

import math
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import rasterio
import rasterio.shutil
from rasterio.io import MemoryFile
from rasterio.vrt import WarpedVRT

from terrainwave.raster_io.gdal import GDAL_ERRORS, bounded_env

_HEAD = b"<VRTDataset"
# A file may begin with a byte order mark and an XML declaration.
_HEAD_BYTES = 256
_MOST_BYTES = 1 << 27
_MOST_NESTED = 8
_NAMES = ("SourceFilename", "SourceDataset")
_DEPENDS = (
    "so its heights depend on the windows that are read; the bound holds for those that were read"
    " here, not for what other reads find"
)
_TABLE = "its raster attribute table"
_OTHERS = {"GDALRasterAttributeTable": _TABLE, "CategoryNames": "its category names"}
# Esri's attribute table of a raster, which only newer versions of GDAL read.
_ESRI_TABLE = ".vat.dbf"


def text_of(dataset: Any) -> str:
    return "".join(dataset.tags(ns="xml:VRT").values())


def rectangles_of(source: ET.Element, default: float) -> list[list[float]]:
    """Return the stated rectangles that a source copies from and to: (row, col, n_rows, n_cols)."""
    return [
        [float(one.get(name, default)) for name in ("yOff", "xOff", "ySize", "xSize")]
        for one in map(source.find, ("SrcRect", "DstRect"))
        if one is not None
    ]


def path_of(element: ET.Element, folder: str) -> str:
    name = element.text or ""
    return os.path.join(folder, name) if element.get("relativeToVRT", "0") == "1" else name


def is_warped(dataset: Any) -> bool:
    return "VRTWarpedDataset" in text_of(dataset)[:1000]


def remark_on_windows(dataset: Any) -> str | None:
    """Return a sentence if heights of a dataset depend on the windows that are read."""
    kind = _kind_of(dataset, set(), 0)
    if kind == "warped" and isinstance(dataset, WarpedVRT):
        return (
            f"this WarpedVRT is warped when it is read, by an approximation, {_DEPENDS}; make it,"
            " and each VRT below it, with tolerance=0 (gdalwarp -et 0), or write it to a file first"
        )
    if kind == "warped":
        return (
            f"the VRT is warped when it is read, by an approximation, {_DEPENDS}; make it with"
            " gdalwarp -et 0 (rasterio: tolerance=0), or write a file first (gdal_translate)"
        )
    if kind == "resampled":
        return (
            f"the VRT resamples its sources when it is read, {_DEPENDS}; write a file first"
            " (gdal_translate)"
        )
    if kind == "index":
        return (
            "the tile index warps its rasters when it is read where these differ in CRS or"
            f" resolution, {_DEPENDS}; write a file first (gdal_translate), or name the rasters"
            " themselves"
        )
    return None


def remark_on_named(name: Any) -> str | None:
    """Return the same for a raster that other code reads, known only by its name."""
    text = str(name)
    if text.startswith("WarpedVRT("):
        return (
            f"{text} is warped when it is read; unless its tolerance is 0, {_DEPENDS[3:]}; load the"
            " array first (.load()), or make the WarpedVRT with tolerance=0"
        )
    if not _may_be_vrt(text):
        return None
    try:
        with bounded_env(), rasterio.open(text) as dataset:
            return remark_on_windows(dataset)
    except GDAL_ERRORS:
        return None


def _kind_of(dataset: Any, seen: set[str], depth: int) -> str | None:
    """Return "warped", "resampled" or "index" if reads depend on windows; else None."""
    if dataset.driver == "GTI":
        return "index"
    if dataset.driver != "VRT":
        return None
    found: set[str] = set()
    inner = getattr(dataset, "src_dataset", None)
    if isinstance(inner, WarpedVRT) and depth < _MOST_NESTED:  # it has no name to open it by
        found.add(_kind_of(inner, seen, depth + 1) or "")
    text = text_of(dataset)
    if len(text) > _MOST_BYTES:
        return None
    try:
        root = ET.fromstring(text)
    except ET.ParseError:
        return None
    found |= set(_own_kinds(root))
    own = str(dataset.name)  # or a connection string, or the XML itself
    folder = "" if own.startswith("<") else os.path.dirname(own.removeprefix("vrt://"))
    sources = (one for one in root.iter() if one.tag in _NAMES and one.text)
    for name in dict.fromkeys(path_of(one, folder) for one in sources):
        if "warped" in found or depth >= _MOST_NESTED:
            break
        if name not in seen and _may_be_vrt(name):
            seen.add(name)
            try:
                with bounded_env(), rasterio.open(name) as source:
                    found.add(_kind_of(source, seen, depth + 1) or "")
            except GDAL_ERRORS:  # reading reports the error
                continue
    return next((kind for kind in ("warped", "index", "resampled") if kind in found), None)


def _own_kinds(root: ET.Element) -> Iterator[str]:
    for transformer in root.iter("ApproxTransformer"):
        if float(transformer.findtext("MaxError", "0")) > 0:
            yield "warped"
    for source in root.iter():
        if source.get("resampling", "nearest").lower() in ("nearest", "near"):
            continue
        rectangles = rectangles_of(source, 0)
        if len(rectangles) == 2:
            (*first, height, width), (*last, new_height, new_width) = rectangles
            is_moved = not all(offset.is_integer() for offset in (*first, *last))
            if is_moved or (width, height) != (new_width, new_height):
                yield "resampled"


def _may_be_vrt(name: str) -> bool:
    """Return True if a name may be that of a VRT or a tile index; local files by their head."""
    lower = name.strip().lower()
    if lower.startswith(("<", "vrt:", "gti:")) or ".gti" in lower:
        return True
    try:
        with open(name, "rb") as file:
            return _HEAD in file.read(_HEAD_BYTES)
    except (OSError, ValueError):
        return ".vrt" in lower


class Unreported(NamedTuple):
    """The epoch of a raster's CRS, and other unreported facts about a band, in words."""

    coordinate_epoch: float | None = None
    others: tuple[str, ...] = ()


def unreported(dataset: Any, band: int) -> Unreported:
    try:
        root = ET.fromstring(_vrt_of(dataset))
    except (*GDAL_ERRORS, ET.ParseError, UnicodeError):
        return Unreported()
    srs, epoch = root.find("SRS"), None
    if srs is not None:
        epoch = _year(srs.get("coordinateEpoch", ""))
    own = root.findall("VRTRasterBand")[band - 1 : band]
    others = [
        words for tag, words in _OTHERS.items() if any(one.find(tag) is not None for one in own)
    ]
    if _TABLE not in others and _has_esri_table(str(dataset.name)):
        others.append(_TABLE)
    return Unreported(epoch, tuple(others))


def _vrt_of(dataset: Any) -> str:
    if dataset.driver == "VRT":
        return text_of(dataset)
    with bounded_env(), MemoryFile(ext=".vrt") as memory:
        rasterio.shutil.copy(dataset, memory.name, driver="VRT")
        return bytes(memory.read()).decode()


def _year(text: str) -> float | None:
    try:
        year = float(text)
    except ValueError:
        return None
    return year if math.isfinite(year) and year > 0 else None


def _has_esri_table(name: str) -> bool:
    try:
        return Path(name + _ESRI_TABLE).is_file()
    except (OSError, ValueError):
        return False
