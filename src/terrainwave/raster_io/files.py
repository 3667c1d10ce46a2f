"""The files that a raster is read from, to notice that one of them has changed."""

import os

from terrainwave.errors import TerrainwaveError
from terrainwave.raster_io.dataset import open_dataset


def files_of(path: str) -> list[str]:
    """Return the files that GDAL reads a raster from, sorted; empty if it names none.

    Of a VRT also those that its sources are read from, however deep.

    Raises
    ------
    TerrainwaveError
        If it cannot be opened.
    """
    found: set[str] = set()
    waiting = _listed(path)
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            try:
                waiting += _listed(name)
            except TerrainwaveError:  # a file beside a raster, such as metadata
                continue
    return sorted(found)


def _listed(path: str) -> list[str]:
    with open_dataset(path) as dataset:
        return [os.fspath(name) for name in dataset.files]
