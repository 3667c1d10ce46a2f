"""Compress digital elevation models with a proved bound on the error of every sample.

>>> import terrainwave as tw
>>> tw.compress("dem.tif", "dem.twz", max_error=0.5)          # doctest: +SKIP
>>> terrain = tw.open("dem.twz")                              # doctest: +SKIP
>>> heights = terrain.read()                                  # doctest: +SKIP
"""

import logging
from typing import TYPE_CHECKING, Any

from terrainwave._version import __version__
from terrainwave.errors import (
    BoundViolationError,
    ClusterError,
    CorruptStreamError,
    InvalidArgumentError,
    InvalidHeightsError,
    LimitExceededError,
    SourceUnavailableError,
    StorageError,
    TerrainwaveError,
    TerrainwaveWarning,
    TruncatedStreamError,
    UnsupportedVersionError,
)

# A library logs nothing unless the application configures logging.
logging.getLogger(__name__).addHandler(logging.NullHandler())

if TYPE_CHECKING:
    from terrainwave.codec.cdf53 import Cdf53
    from terrainwave.codec.cdf97 import Cdf97
    from terrainwave.codec.predictive import Predictive
    from terrainwave.codec.rapid import Rapid
    from terrainwave.codec.store import Store
    from terrainwave.export.geotiff import decompress
    from terrainwave.export.mesh import Mesh
    from terrainwave.export.mesh_formats import SavedMesh
    from terrainwave.file.info import Info
    from terrainwave.lods import save_lods
    from terrainwave.progress import Progress
    from terrainwave.read.lost import Losses
    from terrainwave.terrain import Terrain
    from terrainwave.tri.rqt import Rqt
    from terrainwave.tri.zerotree import Zerotree
    from terrainwave.verification.heights import VerifyReport, verify
    from terrainwave.write.compress import CompressResult, compress, compress_to_bytes
    from terrainwave.write.meshes import store_meshes
    from terrainwave.write.patch import PatchResult, patch

__all__ = [
    "BoundViolationError",
    "Cdf53",
    "Cdf97",
    "ClusterError",
    "CompressResult",
    "CorruptStreamError",
    "Info",
    "InvalidArgumentError",
    "InvalidHeightsError",
    "LimitExceededError",
    "Losses",
    "Mesh",
    "PatchResult",
    "Predictive",
    "Progress",
    "Rapid",
    "Rqt",
    "SavedMesh",
    "SourceUnavailableError",
    "StorageError",
    "Store",
    "Terrain",
    "TerrainwaveError",
    "TerrainwaveWarning",
    "TruncatedStreamError",
    "UnsupportedVersionError",
    "VerifyReport",
    "Zerotree",
    "__version__",
    "compress",
    "compress_to_bytes",
    "decompress",
    "open",
    "patch",
    "save_lods",
    "store_meshes",
    "verify",
]

# Numba and rasterio are imported with the first of these that is used: `terrainwave --help` and
# `import terrainwave` need neither.
_LAZY = {
    "Rapid": "codec.rapid",
    "Predictive": "codec.predictive",
    "Cdf97": "codec.cdf97",
    "Cdf53": "codec.cdf53",
    "Store": "codec.store",
    "Zerotree": "tri.zerotree",
    "Rqt": "tri.rqt",
    "CompressResult": "write.compress",
    "compress": "write.compress",
    "compress_to_bytes": "write.compress",
    "decompress": "export.geotiff",
    "store_meshes": "write.meshes",
    "PatchResult": "write.patch",
    "patch": "write.patch",
    "Progress": "progress",
    "Info": "file.info",
    "Losses": "read.lost",
    "Terrain": "terrain",
    "Mesh": "export.mesh",
    "SavedMesh": "export.mesh_formats",
    "save_lods": "lods",
    "VerifyReport": "verification.heights",
    "verify": "verification.heights",
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'terrainwave' has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(f"terrainwave.{_LAZY[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names, imported or not; used by completion in notebooks."""
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})


def open(
    source: Any,
    *,
    cache_bytes: int = 256 << 20,
    threads: int | None = None,
    native: bool = True,
    on_error: str = "raise",
) -> "Terrain":
    """Open a .twz file: a path, URL, bytes or file object. Options are those of `Terrain`."""
    from terrainwave.terrain import Terrain

    return Terrain(
        source, cache_bytes=cache_bytes, threads=threads, native=native, on_error=on_error
    )
