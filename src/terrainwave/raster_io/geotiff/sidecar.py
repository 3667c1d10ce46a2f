"""GDAL's .aux.xml beside a raster: the CRS, where the raster's own format cannot hold all of it."""

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
from terrainwave.container.targets.publication import publish
from terrainwave.raster_io.gdal import bounded_env
from terrainwave.raster_io.vrt.copied import unreported

SIDECAR = ".aux.xml"


def read_place(path: str | os.PathLike[str]) -> tuple[CRS | None, str | None, float | None]:
    """Return the CRS, the band's unit and the epoch that GDAL finds, in the .aux.xml first."""
    with bounded_env(), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            epoch = unreported(dataset, 1).coordinate_epoch
            return dataset.crs, dataset.units[0] or None, epoch


def remove_beside(path: str | os.PathLike[str]) -> None:
    """Remove the .aux.xml beside a raster that has just been written, as GDAL does.

    It tells of the raster that was there before, and GDAL would read it first.

    Raises
    ------
    StorageError
        If it cannot be removed.
    """
    target = Path(f"{os.fspath(path)}{SIDECAR}")
    # Beside a name as long as the system takes there is none.
    if os.path.lexists(target):
        with storage_errors(f"cannot remove {target}"):
            target.unlink(missing_ok=True)


def write_beside(
    path: str | os.PathLike[str], crs: CRS, unit: str | None, epoch: float | None = None
) -> None:
    """Write the CRS, its epoch and the unit of a raster's band into the .aux.xml beside it.

    GDAL reads it first.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    target = Path(f"{os.fspath(path)}{SIDECAR}")
    content = ElementTree.Element("PAMDataset")
    system = _as_gdal_writes_it(crs)
    if epoch is not None:
        system.set("coordinateEpoch", repr(epoch))
    content.append(system)
    if unit is not None:
        band = ElementTree.SubElement(content, "PAMRasterBand", band="1")
        ElementTree.SubElement(band, "UnitType").text = unit
    with publish(target, True) as part, storage_errors(f"cannot write {target}"):
        part.file.write(ElementTree.tostring(content, encoding="utf-8"))


def _as_gdal_writes_it(crs: CRS) -> Any:
    """Return the element of a CRS: that of a PNG, all of whose place is in the file beside it."""
    with tempfile.TemporaryDirectory() as directory, bounded_env(), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        name = Path(directory) / "place.png"
        profile = {"driver": "PNG", "width": 1, "height": 1, "count": 1, "dtype": "uint8"}
        with rasterio.open(name, "w", crs=crs, **profile) as dataset:
            dataset.write(np.zeros((1, 1, 1), dtype=np.uint8))
        return ElementTree.parse(f"{name}{SIDECAR}").getroot().find("SRS")


def crs_of_geotiff(head: bytes) -> CRS | None:
    """Return the CRS of the head of a GeoTIFF in memory."""
    with bounded_env(), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with MemoryFile(head) as memory, memory.open() as dataset:
            return dataset.crs
