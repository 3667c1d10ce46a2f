"""Served files with their places on the globe: those of the start, and those added later."""

import hashlib
import warnings
from collections.abc import Iterable
from contextlib import ExitStack
from itertools import chain, count, islice
from typing import Any, Self, TypeVar

from fastapi import HTTPException

from terrainwave._version import __version__
from terrainwave.cache import Cache
from terrainwave.errors import (
    CorruptStreamError,
    InvalidHeightsError,
    TerrainwaveError,
    TerrainwaveWarning,
)
from terrainwave.export.virtual_geotiff import VirtualGeoTIFF
from terrainwave.ext.serve.catalog import layer_names
from terrainwave.ext.serve.sending import Ahead
from terrainwave.file import TerrainFile
from terrainwave.globe import terrain_rgb as tiling
from terrainwave.globe.cesium import TilePyramid
from terrainwave.globe.lonlat import Globe
from terrainwave.globe.terrain_rgb import Look

# Tiles of a file that are kept: the page asks for the heights and the voids of one place.
_N_TILES = 32
# Decoded heights that are kept of all files together, and of one at least.
_CACHE_BYTES, _LEAST_CACHE_BYTES = 512 << 20, 16 << 20
_N_NAMES = 10


def version_of(*parts: object) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


class Raster:
    """One file as it is served: the raster, and the version of all that is made of it."""

    def __init__(self, name: str, path: str, cache_bytes: int = 64 << 20) -> None:
        self.name = name
        try:
            self.terrain = TerrainFile(path, cache_bytes=cache_bytes)
        except (InvalidHeightsError, CorruptStreamError) as error:
            raise type(error)(f"{path}: {error}") from error
        self.info = self.terrain.info()
        self.geotiff = VirtualGeoTIFF(self.terrain)
        self.geotiff.warn_of_crs()
        self.ahead = Ahead(self.geotiff.read_at)
        # A file that takes the place of this one may have the same size and say the same.
        version = getattr(self.terrain.container.source, "version", "")
        self.version = version_of(__version__, name, version, self.info.n_bytes, self.info)


class Layer(Raster):
    """One file with its place on the globe."""

    def __init__(
        self, name: str, path: str, cache_bytes: int, radius: float | None, vertical: str
    ) -> None:
        super().__init__(name, path, cache_bytes)
        self.version = version_of(self.version, radius, vertical)
        with ExitStack() as stack:
            stack.enter_context(self.terrain)
            try:
                self.globe = Globe(self.terrain, radius=radius)
                self.tiles = TilePyramid(
                    self.globe,
                    void_height=tiling.height_of_voids(self.globe),
                    vertical=vertical,
                )
            except (InvalidHeightsError, CorruptStreamError) as error:
                raise type(error)(f"{path}: {error}") from error
            stack.pop_all()
        self._rgb_tiles: Cache[tuple[Any, ...], tuple[tiling.RgbTile | None]] = Cache(_N_TILES)

    def rgb_tile(self, z: int, x: int, y: int, rim: int, look: Look) -> tiling.RgbTile | None:
        # In a tuple: a cache holds no None, which says here that there is no terrain.
        def make() -> tuple[tiling.RgbTile | None]:
            return (tiling.rgb_tile(self.globe, z, x, y, rim, look),)

        (tile,) = self._rgb_tiles.get_or_make((z, x, y, rim, *look), make)
        return tile

    def covering(self, z: int, x: int, y: int, rim: int, color: str, look: Look) -> bytes | None:
        tile = self.rgb_tile(z, x, y, rim, look)
        voids = tiling.ALL_VOID if tile is None else tile.voids
        red, green, blue = bytes.fromhex(color)
        return tiling.cover_tile(voids, (red, green, blue)) if voids.any() else None


_Served = TypeVar("_Served", bound=Raster)


def open_layers(paths: list[str], radius: float | None, vertical: str) -> dict[str, Layer]:
    """Return {name in URLs: file}; a warning names each file that cannot be served.

    Raises the first file's error if none can be served.
    """
    layers: dict[str, Layer] = {}
    refused: list[TerrainwaveError] = []
    cache_bytes = max(_CACHE_BYTES // max(len(paths), 1), _LEAST_CACHE_BYTES)
    with ExitStack() as opened:
        for name, path in layer_names(paths).items():
            try:
                layers[name] = Layer(name, path, cache_bytes, radius, vertical)
            except TerrainwaveError as error:
                refused.append(error)
                continue
            opened.enter_context(layers[name].globe.terrain)
        if refused and not layers:
            raise refused[0]
        opened.pop_all()
    for reason in refused:
        warnings.warn(TerrainwaveWarning(f"not served: {reason}"), stacklevel=3)
    return layers


class Shelf:
    """Rasters that are served as GeoTIFFs and files, by name; more can be added at any time."""

    def __init__(self, rasters: Iterable[Raster]) -> None:
        self._rasters = {raster.name: raster for raster in rasters}

    def add(self, path: str) -> Raster:
        """Serve one more file, under a name that no other has, not on the page; from one thread."""
        (stem,) = layer_names([path])
        names = chain([stem], (f"{stem}-{number}" for number in count(2)))
        raster = Raster(next(name for name in names if name not in self._rasters), path)
        # Its head and its coarsest tile are there when a program opens it, and waits.
        raster.geotiff.read_at(raster.geotiff.size - 1, 1)
        self._rasters[raster.name] = raster
        return raster

    def find(self, name: str) -> Raster:
        return named(name, self._rasters)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        for raster in self._rasters.values():
            raster.terrain.close()


def named(name: str, rasters: dict[str, _Served]) -> _Served:
    if name not in rasters:
        listed = [*islice(rasters, _N_NAMES), *(["…"] if len(rasters) > _N_NAMES else [])]
        raise HTTPException(404, f"no terrain {name[:80]!r}; there are: {', '.join(listed)}")
    return rasters[name]
