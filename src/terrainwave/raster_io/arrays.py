"""Heights from arrays in memory and from xarray."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from rasterio.crs import CRS

from terrainwave.errors import (
    InvalidArgumentError,
    InvalidHeightsError,
)
from terrainwave.grid.affine import IDENTITY
from terrainwave.raster_io.crs import format_crs, parse_crs


class ArrayBackend:
    """A 2-D array in memory, or anything sliced like one."""

    is_file = False
    name = "the array"

    def __init__(
        self,
        array: Any,
        *,
        nodata: int | float | None = None,
        transform: tuple[float, ...] = IDENTITY,
        tags: dict[str, Any] | None = None,
        block_shape: tuple[int, int] | None = None,
    ) -> None:
        shape = array.shape
        if len(shape) != 2 or 0 in shape:
            raise InvalidHeightsError(
                f"the array has shape {tuple(shape)}; expected two dimensions, rows and columns"
            )
        self._array = array
        self.n_rows, self.n_cols = (int(size) for size in shape)
        self.dtype = np.dtype(array.dtype).newbyteorder("=")
        self.nodata = nodata
        self.block_shape = block_shape or (1, self.n_cols)
        self.transform = transform
        # A masked float array comes back with NaN in its voids, which needs no mask band.
        self.has_mask = np.ma.getmask(array) is not np.ma.nomask and self.dtype.kind != "f"
        self._tags = tags or {}

    def notes(self) -> Iterator[str]:
        """Yield what is left out or was chosen, one sentence each."""
        return iter(())

    def tags(self) -> dict[str, Any]:
        """Return the fields of RasterInfo that do not bear on the heights."""
        return self._tags

    def read(self, row: int, col: int, n_rows: int, n_cols: int) -> tuple[np.ndarray, np.ndarray]:
        """Return heights (a copy) and False where a mask says void."""
        part = self._array[row : row + n_rows, col : col + n_cols]
        if not isinstance(part, np.ndarray):
            part = part.values
        heights = np.array(np.ma.getdata(part), dtype=self.dtype, order="C", subok=False)
        return heights, ~np.ma.getmaskarray(part)

    def close(self) -> None:
        """Do nothing: the array is the caller's."""


_ROW_DIMS = ("y", "lat", "latitude", "northing", "row")
_COL_DIMS = ("x", "lon", "longitude", "easting", "col")


def open_data_array(array: Any, band: int) -> ArrayBackend:
    """Take heights, CRS and transform from an xarray DataArray, by its names alone.

    Understood: a leading band dimension, dimensions in either order, the coordinate that
    ``grid_mapping`` names (``spatial_ref``) and rioxarray's ``.rio`` accessor, the attributes
    ``_FillValue``, ``units``, ``AREA_OR_POINT``, ``scale_factor`` and ``add_offset`` (which are
    there only while the values are as stored). A lazy array is read in its own chunks.
    """
    if len(array.dims) == 3 and str(array.dims[0]) == "band":
        if not 1 <= band <= array.shape[0]:
            raise InvalidArgumentError(
                f"`band` {band} does not exist, the DataArray has {array.shape[0]}"
            )
        array = array[band - 1]
    if len(array.dims) != 2:
        raise InvalidHeightsError(
            f"the DataArray has dimensions {tuple(map(str, array.dims))}; expected rows and columns"
        )
    names = [str(dim).lower() for dim in array.dims]
    if names[0] in _COL_DIMS and names[1] in _ROW_DIMS:
        array = array.transpose(*array.dims[::-1])
    attrs = array.attrs
    nodata = attrs.get("_FillValue", attrs.get("nodata"))
    units = attrs.get("units")
    tags = {
        "crs": format_crs(_data_array_crs(array)),
        "units": None if units in (None, "") else str(units),
        "scale": float(attrs.get("scale_factor", 1.0)),
        "offset": float(attrs.get("add_offset", 0.0)),
        "area_or_point": str(attrs["AREA_OR_POINT"]) if "AREA_OR_POINT" in attrs else None,
        "description": str(attrs["long_name"]) if "long_name" in attrs else None,
    }
    chunks = getattr(array, "chunks", None)
    return ArrayBackend(
        array,
        nodata=None if nodata is None else np.asarray(nodata).item(),
        transform=_data_array_transform(array),
        tags=tags,
        block_shape=None if chunks is None else (max(chunks[0]), max(chunks[1])),
    )


def _spatial_ref(array: Any) -> dict[str, Any]:
    """Return the attributes of the coordinate that holds CRS and transform."""
    name = "spatial_ref"
    for fields in (getattr(array, "encoding", {}), array.attrs):
        name = str(fields.get("grid_mapping", name))
    return dict(array.coords[name].attrs) if name in array.coords else {}


def _data_array_crs(array: Any) -> CRS | None:
    with contextlib.suppress(AttributeError):
        crs = array.rio.crs
        return None if crs is None else CRS.from_user_input(crs)
    reference = _spatial_ref(array)
    text = reference.get("crs_wkt", reference.get("spatial_ref"))
    return parse_crs(None if text is None else str(text))


def _data_array_transform(array: Any) -> tuple[float, ...]:
    """Return where the pixels are, by the stored transform and the coordinates of their centres.

    The stored one is exact, but stays as it was when the array is cut, turned over or thinned
    out: the centres then tell by how many pixels.
    """
    text = str(_spatial_ref(array).get("GeoTransform", "")).split()
    stored_x = stored_y = None
    if len(text) == 6:
        c, a, b, f, d, e = map(float, text)  # GDAL's order
        if (b, d) != (0, 0):
            return a, b, c, d, e, f
        stored_x, stored_y = (a, c), (e, f)
    x_axis = _axis_transform(array, array.dims[1], stored_x)
    y_axis = _axis_transform(array, array.dims[0], stored_y)
    if x_axis is None or y_axis is None:
        return IDENTITY
    return x_axis[0], 0.0, x_axis[1], 0.0, y_axis[0], y_axis[1]


# Coordinates are decimal text turned float32 as often as not: 1 % of a pixel is "even".
_EVEN = 0.01


def _axis_transform(
    array: Any, dim: Any, stored: tuple[float, float] | None
) -> tuple[float, float] | None:
    """Return (pixel size, edge of the first pixel) along a dimension; None if it is not even."""
    centres = np.asarray(array.coords[dim].values) if dim in array.coords else np.empty(0)
    if centres.size == 0 or centres.dtype.kind not in "iuf":
        return stored
    first = float(centres[0])
    if centres.size == 1:
        size = None if stored is None else stored[0]
    else:
        size = (float(centres[-1]) - first) / (centres.size - 1)
    if not size:
        return None
    if np.abs(centres - (first + size * np.arange(centres.size))).max() > _EVEN * abs(size):
        return None
    if stored is not None and stored[0]:
        n_pixels, skipped = size / stored[0], (first - stored[1]) / stored[0] - 0.5
        whole = round(n_pixels), round(skipped)
        if whole[0] and max(abs(n_pixels - whole[0]), abs(skipped - whole[1])) <= _EVEN:
            return stored[0] * whole[0], stored[1] + stored[0] * (whole[1] + (1 - whole[0]) / 2)
    return size, first - size / 2
