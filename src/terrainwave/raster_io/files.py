"""Files that a raster is read from, to detect changes."""

import os
from collections.abc import Callable
from typing import Any

from terrainwave.errors import TerrainwaveError
from terrainwave.raster_io.dataset import is_twz, open_dataset


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
