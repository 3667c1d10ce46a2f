"""The xarray backend ``terrainwave``: .twz files as lazy datasets, their levels as a tree."""

import os
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from terrainwave.arguments import MASK, is_twz_name
from terrainwave.errors import TerrainwaveWarning
from terrainwave.file import TerrainFile
from terrainwave.file.described import DEFAULT_CACHE_BYTES
from terrainwave.place.position import axis_attributes
from terrainwave.raster_io.raster_info import stored_nodata

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
        """Recognise a .twz by its name, bytes and file objects by their first bytes."""
        if isinstance(filename_or_obj, str | os.PathLike):
            return is_twz_name(filename_or_obj)
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
            Set voids to NaN and apply scale and offset; otherwise return values as stored.
        level : int
            Resolution level: -1 the full grid, -2 half, …; 0 the coarsest.
        cache_bytes, threads
            As for `Terrain`.
        """
        with _opened(filename_or_obj, cache_bytes=cache_bytes, threads=threads) as terrain:
            dataset = terrain_dataset(terrain, level, mask_and_scale=mask_and_scale)
            dataset = dataset.drop_vars(_names(drop_variables), errors="ignore")
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

        The levels share one open file and its cache; the root ``/`` holds their common variables.
        """
        names = _names(drop_variables)
        with _opened(filename_or_obj, cache_bytes=cache_bytes, threads=threads) as terrain:
            groups = {"/": xr.Dataset(attrs={"n_levels": terrain.n_levels})}
            for level in range(terrain.n_levels):
                dataset = terrain_dataset(terrain, level, mask_and_scale=mask_and_scale)
                groups[f"/level_{level}"] = dataset.drop_vars(names, errors="ignore")
            groups["/"].set_close(terrain.close)
        return groups

    def open_datatree(self, filename_or_obj: Any, **options: Any) -> xr.DataTree:
        """Return the tree of `open_groups_as_dict`."""
        groups = self.open_groups_as_dict(filename_or_obj, **options)
        tree = xr.DataTree.from_dict(groups)
        tree.set_close(groups["/"].close)
        return tree


@contextmanager
def _opened(source: Any, **options: Any) -> Iterator[TerrainFile]:
    """Yield an open file, which stays open unless the block raises."""
    terrain = TerrainFile(source, **options)
    try:
        yield terrain
    except BaseException:
        terrain.close()
        raise


def _names(names: str | Iterable[str] | None) -> list[str]:
    if names is None:
        return []
    return [names] if isinstance(names, str) else list(names)


def terrain_dataset(
    terrain: TerrainFile, level: int = -1, *, mask_and_scale: bool = True
) -> xr.Dataset:
    """Return a level of an open file as a lazy dataset; it lives as long as `terrain` is open.

    Its variable is ``heights(y, x)``; ``spatial_ref`` holds CRS and transform as rioxarray writes
    them. Coordinates equal rioxarray's to the last bit: x and y of columns and rows, or xc and yc
    of each sample if the raster is rotated. The encoding has a value for voids, or a float type,
    for writers of the dataset. Neither attributes nor encoding state a bound, because both survive
    operations that change the heights.
    """
    index = terrain.level_index(level)
    raster = terrain.raster_info
    packing = _packing(terrain)
    heights = _LazyHeights(terrain, index, mask_and_scale=mask_and_scale)
    n_rows, n_cols = heights.shape
    attrs: dict[str, Any] = {"long_name": raster.description or terrain.height_unit.word}
    if raster.units is not None:
        attrs["units"] = raster.units
    if terrain.height_unit.is_depth:
        attrs["positive"] = "down"
    if raster.area_or_point is not None:
        attrs["AREA_OR_POINT"] = raster.area_or_point
    encoding = _origin(terrain) | {
        "preferred_chunks": {"y": min(CHUNK, n_rows), "x": min(CHUNK, n_cols)},
        "grid_mapping": GRID_MAPPING,
    }
    if not mask_and_scale:
        if packing.fill is None and _may_have_voids(terrain):
            warnings.warn(
                f"{terrain.name}: voids read as {raster.void_value}, as any height does, since all"
                f" numbers of {terrain.dtype} may be heights: mask_and_scale=True has NaN",
                TerrainwaveWarning,
                stacklevel=2,
            )
        attrs |= packing.fields
        if "scale_factor" in packing.fields and heights.dtype.kind == "f":
            encoding["dtype"] = terrain.dtype  # marks floats as packed
    elif packing.fields and packing.fill is not None:
        encoding |= packing.fields | {"dtype": terrain.dtype}
    elif heights.dtype.kind == "f":
        # The file's type has no number left for voids: write the array's own type, which has NaN.
        encoding["_FillValue"] = heights.dtype.type(np.nan)
    variable = xr.Variable(
        ("y", "x"), indexing.LazilyIndexedArray(heights), attrs=attrs, encoding=encoding
    )
    return xr.Dataset({VARIABLE: variable}, coords=_coordinates(terrain, index))


def _origin(terrain: TerrainFile) -> dict[str, Any]:
    """Return the encoding that names the file, for a later comparison of heights."""
    if not isinstance(terrain.name, str | os.PathLike) or terrain.name == "<bytes>":
        return {}
    name = str(terrain.name)
    return {"source": name if "://" in name else os.path.abspath(name)}


class _Packing(NamedTuple):
    """Interpretation of stored values, named by the CF conventions, and the value of voids."""

    fields: dict[str, Any]
    fill: np.generic | None


def _packing(terrain: TerrainFile) -> _Packing:
    raster = terrain.raster_info
    is_scaled = (raster.scale, raster.offset) != (1.0, 0.0)
    fields: dict[str, Any] = {}
    fill = _fill_value(terrain)
    # Without voids no value is needed, unless one is declared or the array is read as floats.
    is_needed = _may_have_voids(terrain) or raster.mask_kind in ("nodata", "nan") or is_scaled
    if fill is not None and is_needed:
        fields["_FillValue"] = fill
    if is_scaled:
        fields |= {"scale_factor": raster.scale, "add_offset": raster.offset}
    return _Packing(fields, fill)


def _may_have_voids(terrain: TerrainFile) -> bool:
    """Return whether samples may be void: the file has voids, or damaged blocks read as void."""
    return terrain.header.has_voids or terrain.on_error == MASK


def _fill_value(terrain: TerrainFile) -> np.generic | None:
    """Return a value for voids that no height has; None if all may be heights."""
    raster, header, dtype = terrain.raster_info, terrain.header, terrain.dtype
    if raster.nodata is not None:
        return stored_nodata(raster.nodata, dtype)
    if dtype.kind == "f":
        return dtype.type(np.nan)
    low, high = (terrain.quantizer.height_of(quanta) for quanta in (header.z_min, header.z_max))
    limits = np.iinfo(dtype)
    for value in (limits.min, limits.max) if limits.min else (limits.max, limits.min):
        if not low <= value <= high or header.z_min > header.z_max:
            return dtype.type(value)
    return None


def _coordinates(terrain: TerrainFile, level: int) -> dict[str, xr.Variable]:
    a, b, c, d, e, f = terrain.transform_of(level)[:6]
    crs = terrain.raster_info.rasterio_crs()
    reference: dict[str, Any] = {"GeoTransform": " ".join(map(repr, (c, a, b, f, d, e)))}
    if crs is not None:
        reference |= {"crs_wkt": crs.to_wkt(), "spatial_ref": crs.to_wkt()}
    found = {GRID_MAPPING: xr.Variable((), np.int64(0), attrs=reference, encoding=_origin(terrain))}
    attributes = axis_attributes(terrain.crs)
    if terrain.is_turned(level):
        for axis, name in enumerate(("xc", "yc")):
            places = indexing.LazilyIndexedArray(_LazyPlaces(terrain, level, axis))
            found[name] = xr.Variable(("y", "x"), places, attrs=attributes[axis])
    else:
        for axis, name in enumerate("xy"):
            numbers = terrain.coordinates(level)[axis]
            found[name] = xr.Variable(name, numbers, attrs=attributes[axis])
    return found


class _LazyGrid(BackendArray):
    """Numbers of a level's samples, computed for a window when it is indexed."""

    shape: tuple[int, int]
    dtype: np.dtype[Any]

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.BASIC, self._read
        )

    def _read(self, key: tuple[int | slice, ...]) -> NDArray[Any]:
        """Index like numpy, by whole numbers and slices."""
        axes = [_Axis(part, size) for part, size in zip(key, self.shape, strict=True)]
        row, col = axes
        if row.n and col.n:
            numbers = self._window((row.first, col.first, row.n, col.n))
        else:
            numbers = np.empty((row.n, col.n), dtype=self.dtype)
        return numbers[row.inner, col.inner]

    def _window(self, window: tuple[int, int, int, int]) -> NDArray[Any]:
        raise NotImplementedError


class _LazyPlaces(_LazyGrid):
    """x (axis 0) or y (1) of each sample of a rotated raster."""

    dtype = np.dtype(np.float64)

    def __init__(self, terrain: TerrainFile, level: int, axis: int) -> None:
        self._terrain, self._level, self._axis = terrain, level, axis
        self.shape = terrain.level_shape(level)

    def _window(self, window: tuple[int, int, int, int]) -> NDArray[Any]:
        return self._terrain.coordinates(self._level, window)[self._axis]


class _LazyHeights(_LazyGrid):
    """A level of a file: as stored, or with scale and voids applied."""

    def __init__(self, terrain: TerrainFile, level: int, *, mask_and_scale: bool) -> None:
        raster = terrain.raster_info
        self._terrain = terrain
        self._level = level
        self._is_scaled = mask_and_scale and (raster.scale, raster.offset) != (1.0, 0.0)
        self._is_masked = mask_and_scale and _may_have_voids(terrain)
        self.shape = terrain.level_shape(level)
        self.dtype = terrain.dtype
        if self._is_scaled:
            self.dtype = np.dtype(np.float64)
        elif self._is_masked and self.dtype.kind != "f":
            # Whole numbers up to 2^24 are exact in float32.
            self.dtype = np.dtype(np.float32 if self.dtype.itemsize <= 2 else np.float64)
        # In stored voids the source may have any height.
        self._void = np.nan if self._is_masked else _fill_value(terrain)

    def _window(self, window: tuple[int, int, int, int]) -> NDArray[Any]:
        heights, valid = self._terrain.read_with_mask(window, level=self._level)
        if self._is_scaled:
            heights = self._terrain.raster_info.to_physical(heights)
        heights = heights.astype(self.dtype, copy=False)
        if self._void is not None and not valid.all():
            heights[~valid] = self._void
        return heights


class _Axis:
    """Contiguous part of an axis for a whole number or slice, and the selection from that part."""

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
