"""The xarray backend ``terrainwave``: .twz files as lazy datasets, their levels as a tree."""

import os
from collections.abc import Iterable
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from terrainwave.file import DEFAULT_CACHE_BYTES, TerrainFile
from terrainwave.place.position import axis_attributes

VARIABLE = "heights"
GRID_MAPPING = "spatial_ref"
# Samples per side of a dask block: whole groups, whatever the size of a block.
CHUNK = 2048
_MAGIC = b"\x89TWZ"


class TerrainwaveBackend(BackendEntrypoint):
    """Open .twz files with xarray: ``xr.open_dataset("a.twz")``, ``xr.open_datatree("a.twz")``."""

    description = "Read compressed elevation rasters (.twz), any window at any level"
    open_dataset_parameters = (
        "drop_variables",
        "mask_and_scale",
        "level",
        "cache_bytes",
        "threads",
    )
    supports_groups = True

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Tell a .twz by its name, bytes and file objects by their first bytes."""
        if isinstance(filename_or_obj, str | os.PathLike):
            name = os.fspath(filename_or_obj)
            path = urlsplit(name).path if isinstance(name, str) and "://" in name else name
            return str(path).lower().endswith(".twz")
        if isinstance(filename_or_obj, bytes | bytearray | memoryview):
            return bytes(filename_or_obj[:4]) == _MAGIC
        if hasattr(filename_or_obj, "seek") and hasattr(filename_or_obj, "read"):
            place = filename_or_obj.tell()
            start = filename_or_obj.read(4)
            filename_or_obj.seek(place)
            return bool(start == _MAGIC)
        return False

    def open_dataset(
        self,
        filename_or_obj: Any,
        *,
        drop_variables: str | Iterable[str] | None = None,
        mask_and_scale: bool = True,
        level: int = -1,
        cache_bytes: int = DEFAULT_CACHE_BYTES,
        threads: int | None = None,
    ) -> xr.Dataset:
        """Open one level of a .twz file as a dataset that reads windows when they are computed.

        Parameters
        ----------
        filename_or_obj : path, URL, bytes or binary file object
            The file.
        drop_variables : str or iterable of str, optional
            Variables to leave out.
        mask_and_scale : bool
            Voids become NaN, scale and offset are applied; else values as stored.
        level : int
            Resolution level: -1 the full grid, -2 half, …; 0 the coarsest.
        cache_bytes, threads
            As for `Terrain`.
        """
        terrain = TerrainFile(filename_or_obj, cache_bytes=cache_bytes, threads=threads)
        try:
            dataset = terrain_dataset(terrain, level, mask_and_scale=mask_and_scale)
            dataset = dataset.drop_vars(_names(drop_variables), errors="ignore")
        except BaseException:
            terrain.close()
            raise
        dataset.set_close(terrain.close)
        return dataset

    def open_groups_as_dict(
        self,
        filename_or_obj: Any,
        *,
        drop_variables: str | Iterable[str] | None = None,
        mask_and_scale: bool = True,
        cache_bytes: int = DEFAULT_CACHE_BYTES,
        threads: int | None = None,
    ) -> dict[str, xr.Dataset]:
        """Return a dataset for each level: ``/level_0`` is the coarsest, the last the full grid.

        The levels share one open file and its cache; the root ``/`` holds what they share.
        """
        terrain = TerrainFile(filename_or_obj, cache_bytes=cache_bytes, threads=threads)
        try:
            groups = {"/": xr.Dataset(attrs={"n_levels": terrain.n_levels})}
            for level in range(terrain.n_levels):
                dataset = terrain_dataset(terrain, level, mask_and_scale=mask_and_scale)
                groups[f"/level_{level}"] = dataset.drop_vars(
                    _names(drop_variables), errors="ignore"
                )
        except BaseException:
            terrain.close()
            raise
        groups["/"].set_close(terrain.close)
        return groups

    def open_datatree(self, filename_or_obj: Any, **options: Any) -> xr.DataTree:
        """Return the tree of `open_groups_as_dict`."""
        groups = self.open_groups_as_dict(filename_or_obj, **options)
        tree = xr.DataTree.from_dict(groups)
        tree.set_close(groups["/"].close)
        return tree


def _names(names: str | Iterable[str] | None) -> list[str]:
    if names is None:
        return []
    return [names] if isinstance(names, str) else list(names)


def terrain_dataset(
    terrain: TerrainFile, level: int = -1, *, mask_and_scale: bool = True
) -> xr.Dataset:
    """Return a level of an open file as a lazy dataset; it lives as long as `terrain` is open.

    Its variable is ``heights(y, x)``; ``spatial_ref`` holds CRS and transform as rioxarray writes
    them. A rotated raster has no coordinates x and y, as they would be two-dimensional.
    """
    index = terrain.level_index(level)
    raster = terrain.raster_info
    heights = _LazyHeights(terrain, index, mask_and_scale=mask_and_scale)
    n_rows, n_cols = heights.shape
    attrs: dict[str, Any] = {"long_name": raster.description or "height"}
    if raster.units is not None:
        attrs["units"] = raster.units
    if raster.area_or_point is not None:
        attrs["AREA_OR_POINT"] = raster.area_or_point
    if index == terrain.n_levels - 1:
        attrs["max_error"] = terrain.effective_error
    packing = _packing(terrain)
    encoding: dict[str, Any] = {
        "preferred_chunks": {"y": min(CHUNK, n_rows), "x": min(CHUNK, n_cols)},
        "grid_mapping": GRID_MAPPING,
    }
    if mask_and_scale:
        encoding |= packing | {"dtype": terrain.dtype}
    else:
        attrs |= packing
    variable = xr.Variable(
        ("y", "x"), indexing.LazilyIndexedArray(heights), attrs=attrs, encoding=encoding
    )
    return xr.Dataset({VARIABLE: variable}, coords=_coordinates(terrain, index))


def _packing(terrain: TerrainFile) -> dict[str, Any]:
    """Return the attributes that turn stored into physical values, named by the CF conventions."""
    raster = terrain.raster_info
    packing: dict[str, Any] = {}
    if raster.nodata is not None:
        packing["_FillValue"] = terrain.dtype.type(raster.nodata)
    if (raster.scale, raster.offset) != (1.0, 0.0):
        packing |= {"scale_factor": raster.scale, "add_offset": raster.offset}
    return packing


def _coordinates(terrain: TerrainFile, level: int) -> dict[str, xr.Variable]:
    a, b, c, d, e, f = terrain.transform(level)
    crs = terrain.raster_info.rasterio_crs()
    reference: dict[str, Any] = {"GeoTransform": " ".join(map(repr, (c, a, b, f, d, e)))}
    if crs is not None:
        reference |= {"crs_wkt": crs.to_wkt(), "spatial_ref": crs.to_wkt()}
    coordinates = {GRID_MAPPING: xr.Variable((), np.int64(0), attrs=reference)}
    if (b, d) != (0, 0):
        return coordinates
    n_rows, n_cols = terrain.level_shape(level)
    x_attrs, y_attrs = axis_attributes(terrain.crs)
    coordinates["x"] = xr.Variable("x", c + a * (np.arange(n_cols) + 0.5), attrs=x_attrs)
    coordinates["y"] = xr.Variable("y", f + e * (np.arange(n_rows) + 0.5), attrs=y_attrs)
    return coordinates


class _LazyHeights(BackendArray):
    """A level of a file, of which a window is read when it is indexed."""

    def __init__(self, terrain: TerrainFile, level: int, *, mask_and_scale: bool) -> None:
        raster = terrain.raster_info
        self._terrain = terrain
        self._level = level
        self._is_scaled = mask_and_scale and (raster.scale, raster.offset) != (1.0, 0.0)
        self._is_masked = mask_and_scale and raster.mask_kind != "none"
        self.shape = terrain.level_shape(level)
        self.dtype = terrain.dtype
        if self._is_scaled:
            self.dtype = np.dtype(np.float64)  # float32 would add its rounding to the bound
        elif self._is_masked and self.dtype.kind != "f":
            # Whole numbers up to 2^24 are exact in float32.
            self.dtype = np.dtype(np.float32 if self.dtype.itemsize <= 2 else np.float64)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.BASIC, self._read
        )

    def _read(self, key: tuple[int | slice, ...]) -> NDArray[Any]:
        """Index as numpy does, by whole numbers and slices."""
        axes = [_Axis(part, size) for part, size in zip(key, self.shape, strict=True)]
        row, col = axes
        if row.n and col.n:
            window = (row.first, col.first, row.n, col.n)
            heights = self._physical(*self._terrain.read_with_mask(window, level=self._level))
        else:
            heights = np.empty((row.n, col.n), dtype=self.dtype)
        return heights[row.inner, col.inner]

    def _physical(self, heights: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[Any]:
        heights = heights.astype(self.dtype, copy=False)
        if self._is_scaled:
            heights *= self._terrain.raster_info.scale
            heights += self._terrain.raster_info.offset
        if self._is_masked and not valid.all():
            heights[~valid] = np.nan
        return heights


class _Axis:
    """A whole number or slice as a contiguous part of an axis and what to take of that part."""

    def __init__(self, key: int | slice, size: int) -> None:
        if not isinstance(key, slice):
            self.first, self.n = int(key), 1
            self.inner: int | slice = 0
            return
        wanted = range(size)[key]
        self.first, self.n = 0, 0
        self.inner = slice(None)
        if wanted:
            self.first = min(wanted[0], wanted[-1])
            self.n = abs(wanted[-1] - wanted[0]) + 1
            self.inner = slice(None, None, wanted.step)
