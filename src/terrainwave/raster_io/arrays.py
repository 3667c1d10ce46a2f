"""Heights from arrays in memory and from xarray."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from rasterio.crs import CRS

from terrainwave.errors import (
    InvalidHeightsError,
)
from terrainwave.raster_io.crs import format_crs, parse_crs
from terrainwave.raster_io.info import IDENTITY


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
        self.block_shape = (1, self.n_cols)
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

    Understood: a leading band dimension, dimensions in either order, rioxarray's ``spatial_ref``
    coordinate and ``.rio`` accessor, the attributes ``_FillValue``, ``units``, ``scale_factor``
    and ``add_offset`` (which are there only while the values are as stored).
    """
    if len(array.dims) == 3 and str(array.dims[0]) == "band":
        if not 1 <= band <= array.shape[0]:
            raise InvalidHeightsError(
                f"band {band} does not exist, the DataArray has {array.shape[0]}"
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
        "description": str(attrs["long_name"]) if "long_name" in attrs else None,
    }
    return ArrayBackend(
        array,
        nodata=None if nodata is None else np.asarray(nodata).item(),
        transform=_data_array_transform(array),
        tags=tags,
    )


def _spatial_ref(array: Any) -> dict[str, Any]:
    coords = array.coords
    return dict(coords["spatial_ref"].attrs) if "spatial_ref" in coords else {}


def _data_array_crs(array: Any) -> CRS | None:
    with contextlib.suppress(AttributeError):
        crs = array.rio.crs
        return None if crs is None else CRS.from_user_input(crs)
    reference = _spatial_ref(array)
    text = reference.get("crs_wkt", reference.get("spatial_ref"))
    return parse_crs(None if text is None else str(text))


def _data_array_transform(array: Any) -> tuple[float, ...]:
    """Return the transform that rioxarray stored, or the one its evenly spaced centres give."""
    stored = str(_spatial_ref(array).get("GeoTransform", "")).split()
    if len(stored) == 6:
        c, a, b, f, d, e = map(float, stored)  # GDAL's order
        return a, b, c, d, e, f
    steps = []
    for dim in array.dims[::-1]:
        centres = np.asarray(array.coords[dim].values) if dim in array.coords else np.empty(0)
        if centres.size < 2 or centres.dtype.kind not in "iuf":
            return IDENTITY
        step = (float(centres[-1]) - float(centres[0])) / (centres.size - 1)
        even = float(centres[0]) + step * np.arange(centres.size)
        # Coordinates are decimal text turned float32 as often as not: 1 % of a pixel is "even".
        if step == 0 or np.abs(centres - even).max() > 0.01 * abs(step):
            return IDENTITY
        steps.append((step, float(centres[0]) - step / 2))
    (x_step, x_origin), (y_step, y_origin) = steps
    return x_step, 0.0, x_origin, 0.0, y_step, y_origin
