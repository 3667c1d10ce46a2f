"""Heights from arrays in memory and from xarray."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from terrainwave.arguments import NodataChoice, is_twz_name
from terrainwave.errors import InvalidHeightsError
from terrainwave.grid.affine import IDENTITY
from terrainwave.place.meaning import MARKS, Names, Told, told_by
from terrainwave.place.units import is_length
from terrainwave.raster_io.backend import RasterBackend
from terrainwave.raster_io.labelled import layer_of, variable_of
from terrainwave.raster_io.labelled.values import packing_of, voids_of
from terrainwave.raster_io.raster_info import fit_nodata, stored_nodata, undeclared_by
from terrainwave.raster_io.vrt import remark_on_named


class ArrayBackend(RasterBackend):
    """A 2-D array in memory, or anything sliced like one."""

    is_file = False
    told: Told | None = None
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

    def tags(self) -> dict[str, Any]:
        return self._tags

    def read(self, row: int, col: int, n_rows: int, n_cols: int) -> tuple[np.ndarray, np.ndarray]:
        part = self._array[row : row + n_rows, col : col + n_cols]
        if not isinstance(part, np.ndarray):
            part = part.values
        heights = np.array(np.ma.getdata(part), dtype=self.dtype, order="C", subok=False)
        return heights, ~np.ma.getmaskarray(part)


class LabelledBackend(ArrayBackend):
    """xarray's layer of heights with its names and attributes.

    Understood: a Dataset with one variable of heights, a dimension ``band`` and others of length 1,
    x and y in either order, the coordinate that ``grid_mapping`` names (``spatial_ref``) and
    rioxarray's ``.rio`` accessor, nodata values, the attributes ``units``, ``long_name``,
    ``positive``, ``standard_name``, ``AREA_OR_POINT``, ``scale_factor`` and ``add_offset``. A lazy
    array is read in its own chunks.
    """

    def __init__(self, source: Any, band: int, *, nodata: NodataChoice, georeference: bool) -> None:
        variable = variable_of(source)
        layer = layer_of(variable, source, band, georeference=georeference)
        attrs, packing = variable.attrs, packing_of(variable)
        units = None if attrs.get("units") in (None, "") else str(attrs["units"])
        description = str(attrs["long_name"]) if "long_name" in attrs else None
        tags = {
            "crs": layer.crs,
            "units": units,
            "scale": packing.scale,
            "offset": packing.offset,
            "area_or_point": str(attrs["AREA_OR_POINT"]) if "AREA_OR_POINT" in attrs else None,
            "description": description,
            "band_tags": tuple((name, str(attrs[name])) for name in MARKS if name in attrs),
        }
        name = None if variable.name is None else str(variable.name)
        names = Names(name, description, is_length(units))
        self.told = told_by(attrs, names, layer.crs)
        chunks = getattr(layer.array, "chunks", None)
        super().__init__(
            layer.array,
            transform=layer.transform,
            tags=tags,
            block_shape=None if chunks is None else (max(chunks[0]), max(chunks[1])),
        )
        self._notes = [*layer.notes, *packing.notes]
        # Values that are not in memory are read when they are computed.
        if not getattr(getattr(variable, "variable", None), "_in_memory", True):
            windows = remark_on_named(variable.encoding.get("source"))
            self._notes += [] if windows is None else [windows]
        self._others: list[Any] = []
        voids = voids_of(variable, band, packing)
        self._valid_range = voids.valid_range
        self._notes += voids.notes
        if nodata.keeps_declared:
            self._declare([*([] if nodata.value is None else [nodata.value]), *voids.values])
        self.undeclared = undeclared_by(nodata, voids.values, self.dtype)
        if self._valid_range is not None and self.nodata is None and self.dtype.kind != "f":
            self.has_mask = nodata.value is None
        self.came_from = _came_from(variable)

    def _declare(self, values: list[int | float]) -> None:
        fitting = []
        for value in values:
            _, problem = fit_nodata(value, self.dtype)
            if problem is None:
                fitting.append(value)
            elif value == value or len(values) == 1:  # whole numbers are never NaN
                self._notes.append(f"{problem}, so no sample can equal it: ignored")
        finite = [value for value in fitting if math.isfinite(value)]
        if not fitting:
            return
        self.nodata = (finite or fitting)[0]
        own = stored_nodata(self.nodata, self.dtype)
        # Compared as stored: 1e20 and its float32 are one value.
        stored = {stored_nodata(value, self.dtype): value for value in fitting if value == value}
        others = [value for number, value in stored.items() if number != own]
        self._others = [number for number in stored if number != own]
        if others:
            found = ", ".join(f"{value:g}" for value in others)
            self._notes.append(
                f"{found} marks voids too; the file marks all of them by {self.nodata:g}"
            )

    def notes(self) -> Iterator[str]:
        return iter(self._notes)

    def read(self, row: int, col: int, n_rows: int, n_cols: int) -> tuple[np.ndarray, np.ndarray]:
        heights, valid = super().read(row, col, n_rows, n_cols)
        for value in self._others:
            valid &= heights != value
        if self._valid_range is not None:
            low, high = map(
                np.float64, self._valid_range
            )  # not as float32, which may be too narrow
            valid &= (heights >= low) & (heights <= high)
        return heights, valid


def _came_from(array: Any) -> str | None:
    """Return the .twz file that an array's encoding names; the heights may have changed since."""
    # Arithmetic keeps coordinates, and drops the encoding.
    holders = [array, *(coord for coord in array.coords.values() if not getattr(coord, "ndim", 1))]
    paths = (getattr(holder, "encoding", {}).get("source") for holder in holders)
    return next((str(path) for path in paths if is_twz_name(path)), None)
