"""GDAL's .aux.xml next to a raster: a CRS that its format cannot hold, and statistics."""

import os
import tempfile
import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.errors import NotGeoreferencedWarning
from rasterio.io import MemoryFile

from terrainwave.container.spool import storage_errors
from terrainwave.container.targets.publication import publish, remove_of_gdal
from terrainwave.raster_io.gdal import bounded_env
from terrainwave.raster_io.raster_info import is_statistic
from terrainwave.raster_io.vrt import unreported

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
