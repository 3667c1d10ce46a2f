"""Windows of one value, found in a raster's index without reading heights.

Gaps of a VRT, blocks of a sparse GeoTIFF that have no bytes. GDAL reads the same value at all
samples there, found by reading one of them. In doubt nothing is said: then heights are read.
"""

import copy
import math
import os
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from itertools import product
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import TerrainwaveError
from terrainwave.grid.quadtree import Region
from terrainwave.raster_io.gdal import GDAL_ERRORS
from terrainwave.raster_io.vrt import path_of, rectangles_of, text_of

# Blocks of a GeoTIFF of which is kept whether they have bytes: one byte each.
_MOST_BLOCKS = 1 << 25
# A VRT of VRTs of VRTs is looked through, deeper ones are not.
_MOST_NESTED = 3
# Rows of the bands in which places are looked for, at least.
_BAND = 1024

# Sources that change nothing outside of their place, and the elements of those that copy samples.
_SOURCES = {"SimpleSource", "ComplexSource"}
_COPIES = {"SourceFilename", "SourceBand", "SourceProperties", "SrcRect", "DstRect", "NODATA"}


class Even(NamedTuple):
    """Stored value and validity that all samples of a window share."""

    value: Any
    is_valid: bool

    def heights(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> NDArray[Any]:
        return np.full(shape, self.value, dtype=dtype)


# Returns what all samples of a window are; None where only reading tells.
EvenOf = Callable[[Region], Even | None]
# Returns heights and validity of a window of so many rows and columns from a row and a column on.
ReadWindow = Callable[[int, int, int, int], tuple[NDArray[Any], NDArray[np.bool_]]]


def even_parts(region: Region, side: int, even_of: EvenOf) -> Iterator[tuple[Region, Even | None]]:
    """Yield a region in parts that are even, and windows of `side` samples at most of the rest."""
    if not (region.n_rows and region.n_cols):
        return
    even = even_of(region)
    largest = max(region.shape)
    if even is not None or largest <= side:
        yield region, even
        return
    half = side
    while 2 * half < largest:
        half *= 2
    for part in region.tiles(half, half):
        yield from even_parts(part, side, even_of)


class StoredValues(Protocol):
    """Facts about samples that a format states."""

    def value(self, region: Region) -> Any:
        """Return the stored value of all samples of a region; None where only reading tells."""


class Layers:
    """Places that lie over each other, in their order."""

    def __init__(self, places: Sequence[Region]) -> None:
        corners = np.array(places, dtype=np.int64).reshape(-1, 4)
        self.first, self.last = corners[:, :2], corners[:, :2] + corners[:, 2:]
        self._edges = np.vstack([np.arange(len(places)), self.first.T, self.last.T])
        # Bands of the mean height: each place is in few of them.
        self._band = max(_BAND, int(corners[:, 2].sum()) // max(len(places), 1))
        self._near = cache(self._near_band)

    def touching(self, region: Region) -> list[int]:
        row, col, n_rows, n_cols = region
        is_low = n_rows <= self._band
        numbers, top, left, bottom, right = self._near(row // self._band) if is_low else self._edges
        within_rows = (top < row + n_rows) & (bottom > row)
        return numbers[within_rows & (left < col + n_cols) & (right > col)].tolist()

    def _near_band(self, band: int) -> NDArray[np.int64]:
        """Return edges of the places that regions beginning in a band, and as low, may touch."""
        first, end = band * self._band, (band + 2) * self._band
        return self._edges[:, (self._edges[1] < end) & (self._edges[3] > first)]


def composed(region: Region, layers: Iterable[tuple[Any, Region]], gap: Callable[[], Any]) -> Any:
    """Return the common value of a region's layers, where the last one counts; None in doubt."""
    value, parts = None, list[Region]()
    for above, place in layers:
        part = place.intersect(region)
        if above is None:
            return None
        if part == region:
            value, parts = above, []
        elif value is not None and not is_same(value, above):
            return None
        value = above
        parts.append(part)
    if value is None:
        return gap()
    if parts[0] == region:
        return value
    n_samples = region.n_rows * region.n_cols
    is_enough = sum(one.n_rows * one.n_cols for one in parts) >= n_samples
    return value if is_enough and samples_in(parts) == n_samples else None


def samples_in(regions: Sequence[Region]) -> int:
    row_ends = sorted({end for one in regions for end in (one.row, one.row + one.n_rows)})
    col_ends = sorted({end for one in regions for end in (one.col, one.col + one.n_cols)})
    is_covered = np.zeros((len(row_ends) - 1, len(col_ends) - 1), dtype=np.bool_)
    for one in regions:
        rows = np.searchsorted(row_ends, (one.row, one.row + one.n_rows))
        cols = np.searchsorted(col_ends, (one.col, one.col + one.n_cols))
        is_covered[slice(*rows), slice(*cols)] = True
    return int(np.diff(row_ends) @ is_covered @ np.diff(col_ends))


def is_same(one: Any, other: Any) -> bool:
    """Say whether two values are equal bit for bit: NaN as NaN, -0.0 not as 0.0."""
    return np.asarray(one).tobytes() == np.asarray(other).tobytes()


def are_bits(values: NDArray[Any], value: Any) -> NDArray[np.bool_]:
    bits = f"u{values.dtype.itemsize}"
    return values.view(bits) == np.asarray(value, dtype=values.dtype).view(bits)


def is_seen(read: ReadWindow, region: Region, even: Even) -> bool:
    """Say whether corners and middle of a region, read one by one, are what an index says."""
    last_row, last_col = region.row + region.n_rows - 1, region.col + region.n_cols - 1
    middle = (region.row + last_row) // 2, (region.col + last_col) // 2
    corners = product((region.row, last_row), (region.col, last_col))
    for row, col in {middle, *corners}:
        heights, valid = read(row, col, 1, 1)
        if bool(valid[0, 0]) != even.is_valid:
            return False
        if even.is_valid and not is_same(heights[0, 0], even.value):
            return False
    return True


class SparseBlocks:
    """A GeoTIFF's blocks without bytes."""

    def __init__(self, dataset: Any, band: int, read_sample: Callable[[int, int], Any]) -> None:
        self._dataset, self._band = dataset, band
        self._read_sample = read_sample
        self._shape = dataset.block_shapes[band - 1]
        n_rows, n_cols = (
            -(-size // block)
            for size, block in zip((dataset.height, dataset.width), self._shape, strict=True)
        )
        # 0 not known, 1 has bytes, 2 has none.
        is_small = n_rows * n_cols <= _MOST_BLOCKS
        self._state = np.zeros((n_rows, n_cols) if is_small else (0, 0), dtype=np.uint8)
        self._value: Any = None

    def of(self, dataset: Any, read_sample: Callable[[int, int], Any]) -> "SparseBlocks":
        """Return the same, asked of the same file opened again; what either finds, both know."""
        other = copy.copy(self)
        other._dataset, other._read_sample = dataset, read_sample
        return other

    def value(self, region: Region) -> Any:
        """Return the value of blocks without bytes, where all of a region are such."""
        rows, cols = (
            slice(first // size, (first + n - 1) // size + 1)
            for first, n, size in zip(region[:2], region.shape, self._shape, strict=True)
        )
        state = self._state[rows, cols]
        # Most often all have bytes, which the first and the last one tell.
        if not state.size or self._has_bytes(rows.start, cols.start):
            return None
        if self._has_bytes(rows.stop - 1, cols.stop - 1) or (state == 1).any():
            return None
        for row, col in np.argwhere(state == 0).tolist():
            if self._has_bytes(rows.start + row, cols.start + col):
                return None
        if self._value is None:
            self._value = self._read_sample(region.row, region.col)
        return self._value

    def _has_bytes(self, row: int, col: int) -> bool:
        if not self._state[row, col]:
            name = f"BLOCK_OFFSET_{col}_{row}"
            offset = self._dataset.get_tag_item(name, "TIFF", bidx=self._band)
            self._state[row, col] = 2 if offset is None else 1
        return bool(self._state[row, col] == 1)


class _Source(NamedTuple):
    """A source of a VRT's band: its place, and the samples that it copies, None if it does more."""

    place: Region
    copies: tuple[str, int, Region] | None = None
    nodata: float | None = None


class VrtSources:
    """The sources of a VRT's band; `value_of` returns the one value of a part of a file."""

    def __init__(
        self,
        sources: list[_Source],
        value_of: Callable[[str, int, Region], Any],
        read_sample: Callable[[int, int], Any],
    ) -> None:
        self._sources = sources
        # Each file is opened once for this, however often it is asked for.
        self._value_of = cache(value_of)
        self._read_sample = read_sample
        self._fill: Any = None
        self._layers = Layers([one.place for one in sources])

    def value(self, region: Region) -> Any:
        """Return the value of all samples of a region, as its sources lie over each other."""

        def gap() -> Any:
            if self._fill is None:
                self._fill = self._read_sample(region.row, region.col)
            return self._fill

        return composed(region, self._values(region), gap)

    def _values(self, region: Region) -> Iterator[tuple[Any, Region]]:
        for number in self._layers.touching(region):
            place, copies, nodata = self._sources[number]
            value = None if copies is None else self._value_of(*copies)
            if value is not None and nodata is not None:
                found = float(value)
                if found == nodata or (math.isnan(nodata) and math.isnan(found)):
                    continue
                # GDAL compares floats with a tolerance.
                if math.isclose(found, nodata, rel_tol=1e-5, abs_tol=1e-5):
                    value = None
            yield value, place


def _vrt_sources(dataset: Any, band: int) -> list[_Source] | None:
    """Return the sources of a band of a VRT; None if they may not be all that makes it."""
    root = ET.fromstring(text_of(dataset))
    own = root.findall("VRTRasterBand")[band - 1 : band]
    sources = [one for each in own for one in each if one.tag.endswith("Source")]
    kinds = {root.get("subClass"), *(one.get("subClass") for one in own)}
    if not own or kinds - {None, "VRTSourcedRasterBand"} or {one.tag for one in sources} - _SOURCES:
        return None
    whole = Region(0, 0, dataset.height, dataset.width)
    folder = os.path.dirname(str(dataset.name))
    found = [_source_of(one, folder, whole) for one in sources]
    return [one for one in found if min(one.place.shape)]


def _source_of(element: ET.Element, folder: str, whole: Region) -> _Source:
    """Return a source of a VRT that GDAL has written: all numbers are there, or no rectangle."""
    rectangles = rectangles_of(element, math.nan)
    if len(rectangles) < 2 or min(rectangles[1][2:]) < 0:
        return _Source(whole)
    if all(number.is_integer() for rectangle in rectangles for number in rectangle):
        source, place = (Region(*map(int, rectangle)) for rectangle in rectangles)
        name, band = element.find("SourceFilename"), element.findtext("SourceBand", "1")
        is_copy = source.shape == place.shape and place.intersect(whole) == place
        is_copy &= not {child.tag for child in element} - _COPIES and band.isdecimal()
        if is_copy and name is not None and min(source) >= 0:
            path = path_of(name, folder)
            nodata = element.findtext("NODATA")
            if os.path.isfile(path):
                copies = path, int(band), source
                return _Source(place, copies, None if nodata is None else float(nodata))
    # GDAL rounds what is not in whole samples: a sample more on each side.
    row, col, n_rows, n_cols = rectangles[1]
    outer = math.floor(row) - 1, math.floor(col) - 1, math.ceil(n_rows) + 3, math.ceil(n_cols) + 3
    return _Source(Region(*outer).intersect(whole))


def stored_values(
    dataset: Any,
    band: int,
    read_sample: Callable[[int, int], Any],
    open_member: Callable[[str, int], Any],
    nested: int = 0,
) -> StoredValues | None:
    """Return the finder of even windows of a band of a dataset; `open_member` opens others."""
    if dataset.driver == "GTiff":
        return SparseBlocks(dataset, band, read_sample)
    if dataset.driver != "VRT" or nested >= _MOST_NESTED:
        return None
    try:
        sources = _vrt_sources(dataset, band)
    except (*GDAL_ERRORS, ET.ParseError, ValueError, OverflowError):
        return None
    if sources is None:
        return None
    dtype = np.dtype(dataset.dtypes[band - 1])

    def value_of(path: str, number: int, region: Region) -> Any:
        try:
            with open_member(path, number) as raster:
                if raster.dtype != dtype:
                    return None
                if region.intersect(Region(0, 0, raster.n_rows, raster.n_cols)) != region:
                    return None
                even = raster.even(region)
        except TerrainwaveError:  # whoever reads there is told
            return None
        return None if even is None else even.value

    return VrtSources(sources, value_of, read_sample)
