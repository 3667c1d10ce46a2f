"""Files and addresses that are dropped on QGIS's window."""

from __future__ import annotations

from typing import Callable

from osgeo import gdal
from qgis.gui import QgsCustomDropHandler

from terrainwave_plugin.layers import is_terrain


def gdal_reads_terrains() -> bool:
    """Say whether GDAL has the driver: then QGIS opens files without a server."""
    return gdal.GetDriverByName("TWZ") is not None


class DropHandler(QgsCustomDropHandler):
    """Takes .twz files that GDAL does not read, and addresses; all else goes on to QGIS.

    Parameters
    ----------
    add : callable
        Is called with a path or a URL.
    """

    def __init__(self, add: Callable[[str], None]) -> None:
        super().__init__()
        self._add = add

    def handleFileDrop(self, file: str) -> bool:
        """Take a local file."""
        if not is_terrain(file) or gdal_reads_terrains():
            return False
        self._add(file)
        return True

    def handleMimeDataV2(self, data) -> bool:
        """Take addresses, if they are all that was dropped."""
        urls = data.urls()
        names = [url.toString() for url in urls]
        if not urls or any(url.isLocalFile() or not is_terrain(url.path()) for url in urls):
            return False
        for name in names:
            self._add(name)
        return True
