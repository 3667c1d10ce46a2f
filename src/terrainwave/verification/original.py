"""The original raster, read only with rasterio; validity is decided here independently.

Where its index, as used by `compress`, says that all of a large window is void, or of one value,
only some samples are read.
"""

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from rasterio.crs import CRS
from rasterio.enums import MaskFlags
from rasterio.errors import RasterioError
from rasterio.windows import Window

from terrainwave.arguments import nodata_choice
from terrainwave.errors import StorageError
from terrainwave.grid.affine import determinant, places_to_pixels
from terrainwave.grid.quadtree import Region
from terrainwave.place.crs import format_crs, parse_crs
from terrainwave.place.meaning import Told, by_numbers
from terrainwave.place.units import HeightUnit, height_unit, in_metres, kind_problem, meeting
from terrainwave.raster_io.dataset import DatasetBackend, is_placed, told_of
from terrainwave.raster_io.even import Even, even_parts, is_seen
from terrainwave.raster_io.gdal import bounded_env
from terrainwave.raster_io.mosaic import ORIENTATIONS, Orientation
from terrainwave.raster_io.vrt import unreported

# Samples per window, and its height if the original is striped: with windows of few rows the
# decoder would decode the same blocks again and again.
_WINDOW_SAMPLES = 4 * 2**20
_WINDOW_SIDE = 2048
_WINDOW_ROWS = 256

# Share of a pixel by which positions in one grid may differ.
_SAME_PIXEL = 1e-6
# The same for a raster that covers a part of a file, as in `patch`.
_SAME_PLACE = 1e-3
# Indices of a transform's numbers for size and direction of pixels.
_LINEAR = (0, 1, 3, 4)


class Original:
    """A band of a rasterio dataset; `nodata` and `heights_are` as in `compress`.

    Rows and columns are read in the order of `transform`, a file's. With `whole`, the shape of the
    file, the dataset may cover only a part of it: `place` is that part, or None if the dataset does
    not lie on the file's grid or extends beyond the file. Regions to read are the file's.
    """

    def __init__(
        self,
        dataset: Any,
        band: int,
        nodata: float | str | None,
        transform: Any = None,
        heights_are: str | None = None,
        whole: tuple[int, int] | None = None,
    ) -> None:
        self.dataset, self.band = dataset, band
        self._asked_kind = heights_are
        self.transform = tuple(dataset.transform)[:6]
        self.shape = dataset.height, dataset.width
        self.place: Region | None = Region(0, 0, *self.shape)
        self.turn = Orientation()
        if whole is not None:
            self.turn, self.place = _place(dataset, tuple(transform)[:6], whole)
        elif transform is not None:
            self.turn = _turn_to(dataset, tuple(transform)[:6])
        if any(self.turn):
            self.transform = tuple(transform)[:6]
        self.dtype = np.dtype(dataset.dtypes[band - 1])
        declared = dataset.nodatavals[band - 1]
        choice = nodata_choice(nodata)
        if not choice.keeps_declared:
            declared = None
        self.nodata = declared if choice.value is None else choice.value
        self._voids = {self.nodata, declared}
        self.scale = float(dataset.scales[band - 1])
        flags = dataset.mask_flag_enums[band - 1]
        self._has_mask = MaskFlags.all_valid not in flags and flags != [MaskFlags.nodata]
        colors = enumerate(dataset.colorinterp, 1)
        self._alphas = [n for n, color in colors if color.name == "alpha" and n != band]

    def unit(self) -> HeightUnit:
        units = self.dataset.units[self.band - 1]
        return height_unit(units, format_crs(self.dataset.crs))

    def kind_problem(self, terrain: Any) -> str | None:
        crs_text, is_asked = format_crs(self.dataset.crs), self._asked_kind is not None
        told: Told | None = Told(self._asked_kind, "`heights_are`")
        if not is_asked:
            told = by_numbers(told_of(self.dataset, self.band), crs_text, self._metres(crs_text))
        if told is None:
            return None
        info = terrain.info()
        own = terrain.raster_info.own_kind(info.minimum, info.maximum, is_asked=is_asked)
        return kind_problem(own, (told, crs_text))

    def _metres(self, crs_text: str | None) -> Iterator[tuple[float, float]]:
        index = self.band - 1
        offset, units = float(self.dataset.offsets[index]), self.dataset.units[index]
        for window, even in self.windows():
            # One sample represents all of an even window.
            shape = window.shape if even is None else (1, 1)
            heights, valid = self.read(window.row, window.col, *shape)
            if valid.any():
                ends = float(heights[valid].min()), float(heights[valid].max())
                yield in_metres(ends, self.scale, offset, units, crs_text)

    def coordinate_epoch(self) -> float | None:
        return unreported(self.dataset, self.band).coordinate_epoch if self.dataset.crs else None

    def area_or_point(self) -> str:
        return str(self.dataset.tags().get("AREA_OR_POINT", "Area"))

    def read(self, row: int, col: int, n_rows: int, n_cols: int) -> tuple[np.ndarray, np.ndarray]:
        row, col = self._stored(Region(row, col, n_rows, n_cols))[:2]
        window = Window(col, row, n_cols, n_rows)
        try:
            with bounded_env():
                heights = self.dataset.read(self.band, window=window)
                valid = ~self._is_void(heights)
                if self._has_mask:
                    valid &= self.dataset.read_masks(self.band, window=window) > 0
                for alpha in self._alphas:
                    valid &= self.dataset.read(alpha, window=window) > 0
        except RasterioError as error:
            raise StorageError(
                f"the original cannot be read: {place_text(row, col, n_rows, n_cols)}"
            ) from error
        if self.dtype.kind == "f":
            valid &= ~np.isnan(heights)
        return self.turn.of_array(heights), self.turn.of_array(valid)

    def _stored(self, region: Region) -> Region:
        if self.place is not None:
            row, col = region.row - self.place.row, region.col - self.place.col
            region = region._replace(row=row, col=col)
        return self.turn.before(region, self.shape)

    def _is_void(self, heights: np.ndarray) -> np.ndarray:
        found = (self.equals(heights, value) for value in self._voids)
        return np.logical_or.reduce(list(found))

    def equals(self, heights: np.ndarray, value: Any) -> np.ndarray:
        """Return which heights equal a nodata value, if any, as the dataset's type stores it."""
        if value is None or math.isnan(value):
            return np.zeros(heights.shape, dtype=bool)
        if self.dtype.kind == "f":
            return heights == as_stored(value, self.dtype)
        nodata, limits = float(value), np.iinfo(self.dtype)
        if not nodata.is_integer() or not limits.min <= nodata <= limits.max:
            return np.zeros(heights.shape, dtype=bool)
        return heights == self.dtype.type(int(nodata))

    def windows(self) -> Iterator[tuple[Region, Even | None]]:
        """Yield windows that suit both sides; larger ones are even, confirmed by `holds`."""
        if self.place is None:
            return
        for part, even in even_parts(self.place, self.side, self._even):
            if even is not None and self.holds(part, even):
                yield part, even
            else:
                yield from ((window, None) for window in part.tiles(*self.window_shape))

    @property
    def side(self) -> int:
        rows, cols = self.window_shape
        return -(-max(rows, cols) // rows) * rows

    @property
    def window_shape(self) -> tuple[int, int]:
        n_cols = self.shape[1]
        if self.dataset.block_shapes[self.band - 1][1] < n_cols:
            return _WINDOW_SIDE, _WINDOW_SIDE
        cols = min(n_cols, _WINDOW_SAMPLES // _WINDOW_ROWS)
        return max(_WINDOW_SAMPLES // cols // _WINDOW_ROWS, 1) * _WINDOW_ROWS, cols

    def holds(self, region: Region, even: Even) -> bool:
        """Read corners and middle of a region; return whether they match the index."""
        return is_seen(self.read, region, even)

    def _even(self, region: Region) -> Even | None:
        even = None if self._alphas else self._index.even(self._stored(region))
        if even is None:
            return None
        value = even.heights((1, 1), self.dtype)
        is_void = self._is_void(value) | (value != value)  # NaN
        return Even(value[0, 0], not is_void.all())

    @cached_property
    def _index(self) -> DatasetBackend:
        return DatasetBackend(self.dataset, self.band, owned=True)


def _turns_of(
    dataset: Any, wanted: tuple[float, ...]
) -> Iterator[tuple[Orientation, Any, float, float]]:
    """Yield orders of rows and columns, with the transform, the pixel, and how far ends drift."""
    shape = dataset.height, dataset.width
    for turn in ORIENTATIONS:
        if not turn.swap:
            found = turn.of_transform(tuple(dataset.transform)[:6], shape)
            drift = max(shape) * max(abs(found[i] - wanted[i]) for i in _LINEAR)
            yield turn, found, max(abs(found[i]) for i in _LINEAR), drift


def _turn_to(dataset: Any, wanted: tuple[float, ...]) -> Orientation:
    """Return the order of a dataset's rows and columns compared with a transform's."""
    for turn, found, pixel, drift in _turns_of(dataset, wanted):
        # Corners computed in another way differ by rounding.
        shift = max(abs(found[i] - wanted[i]) for i in (2, 5))
        if max(shift, drift) <= _SAME_PIXEL * pixel:
            return turn
    return Orientation()


def _place(
    dataset: Any, wanted: tuple[float, ...], whole: tuple[int, int]
) -> tuple[Orientation, Region | None]:
    """Return the order of a dataset and the part of a file's grid that it covers, or None."""
    for turn, found, pixel, drift in _turns_of(dataset, wanted) if determinant(wanted) else ():
        row, col = places_to_pixels(wanted, found[2], found[5])
        if not pixel or not math.isfinite(row) or not math.isfinite(col):
            continue
        off = max(abs(row - round(row)), abs(col - round(col)))
        if max(off, drift / pixel) <= _SAME_PLACE:
            place = Region(round(row), round(col), dataset.height, dataset.width)
            is_inside = place.intersect(Region(0, 0, *whole)) == place
            return turn, place if is_inside else None
    return Orientation(), None


def place_text(row: int, col: int, n_rows: int, n_cols: int) -> str:
    return f"rows {row} to {row + n_rows - 1}, columns {col} to {col + n_cols - 1}"


def as_stored(nodata: float, dtype: np.dtype[Any]) -> Any:
    with np.errstate(over="ignore", under="ignore"):
        return np.float64(nodata).astype(dtype)


# Metadata that the raster of a part need not share with the file.
_OF_WHOLE = ("size", "description", "AREA_OR_POINT")


def metadata_problems(terrain: Any, original: Original, *, part: bool = False) -> Iterator[str]:
    """Yield differences of metadata; for the raster of a `part`, of those that affect heights."""
    dataset, index = original.dataset, original.band - 1
    info = terrain.info()
    if terrain.effective_error > terrain.max_error * (1 + 1e-12):
        yield (
            f"the file states an effective error of {terrain.effective_error}, above the"
            f" {terrain.max_error} it was asked for"
        )
    pairs = [
        ("size", tuple(terrain.shape), (dataset.height, dataset.width)),
        ("type", np.dtype(terrain.dtype).name, original.dtype.name),
        ("scale", float(info.scale), original.scale),
        ("offset", float(info.offset), float(dataset.offsets[index])),
        ("description", info.description or None, dataset.descriptions[index] or None),
        # Area is GDAL's default, and is not stored in a GeoTIFF without georeference.
        ("AREA_OR_POINT", info.area_or_point or "Area", original.area_or_point()),
    ]
    unit, own_unit = original.unit().name, info.units or None
    problem = unit_problem(terrain, original)
    if problem:
        yield problem
    elif (own_unit is None) != (unit is None) and not part:
        yield f"units is {own_unit!r}, the original's is {unit!r}"
    for name, found, expected in pairs:
        if found != expected and not (part and name in _OF_WHOLE):
            hint = " (with `part` only what it covers is compared)" if name == "size" else ""
            hint = hint if np.less_equal(original.shape, terrain.shape).all() else ""
            yield f"{name} is {found!r}, the original's is {expected!r}{hint}"
    other_kind = original.kind_problem(terrain)
    if other_kind is not None:
        yield f"the original's numbers mean something else: {other_kind}"
    if part:
        if (dataset.crs or None) != terrain.raster_info.rasterio_crs():
            found = dataset.crs or "missing"
            yield f"the CRS is {terrain.crs or 'missing'}, the original's is {found}"
        return
    if not _same_nodata(terrain.nodata, original.nodata, original.dtype):
        yield f"nodata is {terrain.nodata!r}, the original's is {original.nodata!r}"
    found, expected = tuple(terrain.transform)[:6], original.transform
    if found != expected:
        yield f"the transform is {found}, the original's is {expected}"
    # Without georeference a file keeps no CRS.
    if terrain.crs or is_placed(dataset):
        epoch, expected_epoch = info.coordinate_epoch, original.coordinate_epoch()
        if epoch != expected_epoch:
            yield f"the coordinate epoch is {epoch}, the original's is {expected_epoch}"
        yield from _compare_crs(terrain.crs, dataset.crs)


def place_problem(terrain: Any, original: Original) -> str:
    if original.place is not None:
        return ""
    n_rows, n_cols = original.shape
    return (
        f"the original does not lie on the file's grid, or reaches beyond the file: found {n_rows}"
        f" x {n_cols} samples with the transform {original.transform}, expected a part of"
        f" {terrain.shape[0]} x {terrain.shape[1]} with {tuple(terrain.transform)[:6]}, moved by"
        " whole pixels"
    )


def unit_problem(terrain: Any, original: Original) -> str:
    unit = height_unit(terrain.info().units, terrain.crs)
    return meeting("the original", original.unit(), "the file", unit).problem


def _same_nodata(nodata: Any, expected: Any, dtype: np.dtype[Any]) -> bool:
    if expected is not None and dtype.kind != "f":
        limits = np.iinfo(dtype)
        # No sample can equal such a value, so the file has none.
        if not (math.isfinite(expected) and limits.min <= expected <= limits.max):
            expected = None
        elif expected != int(expected):
            expected = None
    if nodata is None or expected is None:
        return nodata is None and expected is None
    if math.isnan(nodata) or math.isnan(expected):
        return math.isnan(nodata) and math.isnan(expected)
    return bool(as_stored(nodata, dtype) == as_stored(expected, dtype))


def _compare_crs(crs: Any, expected: CRS | None) -> Iterator[str]:
    if not crs or not expected:
        if bool(crs) != bool(expected):
            yield f"the CRS is {crs or 'missing'}, the original's is {expected or 'missing'}"
        return
    # Compared by WKT: rasterio's == equates systems whose ellipsoids differ in late digits. A
    # string is from the file, hence parse_crs: rasterio would follow a URL in it.
    crs = parse_crs(crs) if isinstance(crs, str) else crs
    if crs is None or crs.to_wkt() != expected.to_wkt():
        crs_text = "not understood" if crs is None else crs.to_wkt()
        yield f"the CRS is {crs_text}, the original's is {expected.to_wkt()}"
