"""Facts about a raster that rasterio does not report; GDAL writes them into a VRT copy."""

import math
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, NamedTuple

import rasterio.shutil
from rasterio.io import MemoryFile

from terrainwave.raster_io.gdal import GDAL_ERRORS, bounded_env
from terrainwave.raster_io.vrt import text_of

_TABLE = "its raster attribute table"
_OTHERS = {"GDALRasterAttributeTable": _TABLE, "CategoryNames": "its category names"}
# Esri's attribute table of a raster, which only newer versions of GDAL read.
_ESRI_TABLE = ".vat.dbf"


class Unreported(NamedTuple):
    """The epoch of a raster's CRS, and other unreported facts about a band, in words."""

    coordinate_epoch: float | None = None
    others: tuple[str, ...] = ()


def unreported(dataset: Any, band: int) -> Unreported:
    """Return the facts about a dataset's CRS and a band that rasterio does not report."""
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
