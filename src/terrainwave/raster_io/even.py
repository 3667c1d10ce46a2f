"""What a raster's index says of its heights without reading them: windows of one value.

Gaps of a VRT, blocks of a sparse GeoTIFF that have no bytes. GDAL reads the same value at all
samples there, found by reading one of them. In doubt nothing is said: then heights are read.
"""

import copy
import math
import os
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import TerrainwaveError
from terrainwave.grid.quadtree import Region

# Blocks of a GeoTIFF of which is kept whether they have bytes: one byte each.
_MOST_BLOCKS = 1 << 25
# Bytes of a VRT that is read; some 100,000 sources.
_MOST_BYTES = 1 << 27
# A VRT of VRTs of VRTs is looked through, deeper ones are not.
_MOST_NESTED = 3
# Sources of a VRT are found by cells of so many samples a side; windows of more cells look at all.
_CELL = 8192
_MOST_CELLS = 64

# What a band of a VRT may have besides sources: none of it changes the heights of a gap.
_PLAIN = {
    "NoDataValue", "HideNoDataValue", "ColorInterp", "Description", "UnitType", "Offset", "Scale",
    "Metadata", "Histograms", "CategoryNames", "ColorTable", "GDALRasterAttributeTable", "Overview",
    "MaskBand",
}  # fmt: skip
# Sources that change nothing outside of their place, and what those have that copy samples.
_SOURCES = {"SimpleSource", "ComplexSource"}
_COPIES = {"SourceFilename", "SourceBand", "SourceProperties", "SrcRect", "DstRect", "NODATA"}


class Even(NamedTuple):
    """What all samples of a window are: their stored value, and whether they are valid."""

    value: Any
    is_valid: bool

    def heights(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> NDArray[Any]:
        """Return them as an array."""
        return np.full(shape, self.value, dtype=dtype)


# Returns what all samples of a window are; None where only reading tells.
EvenOf = Callable[[Region], Even | None]
# Returns heights and validity of a window of so many rows and columns from a row and a column on.
ReadWindow = Callable[[int, int, int, int], tuple[NDArray[Any], NDArray[np.bool_]]]


def even_parts(region: Region, side: int, even_of: EvenOf) -> Iterator[tuple[Region, Even | None]]:
    """Yield a region in parts that are even, and windows of `side` samples at most of the rest.

    Windows begin at the region's corner or at multiples of `side` from it.
    """
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
    """What a format tells of its samples."""

    def value(self, region: Region) -> Any:
        """Return the stored value of all samples of a region; None where only reading tells."""


class Composite:
    """What lies over each other in a region, in order: the last one that covers a sample counts."""

    def __init__(self, region: Region) -> None:
        self._region = region
        self._value: Any = None
        self._parts: list[Region] = []
        self._is_whole = False

    def put(self, value: Any, place: Region) -> bool:
        """Lay a value over a place; say whether all that lies there is of one value still."""
        part = place.intersect(self._region)
        if part == self._region:
            self._value, self._parts, self._is_whole = value, [], True
            return True
        if self._value is None:
            self._value = value
        if not self._is_whole:
            self._parts.append(part)
        return is_same(self._value, value)

    def value(self, base: Callable[[], Any]) -> Any:
        """Return the value of all samples, `base` where nothing lies; None if there are several."""
        if self._value is None:
            return base()
        if self._is_whole or covered_samples(self._parts, self._region) == _n_samples(self._region):
            return self._value
        return None


def covered_samples(parts: Sequence[Region], region: Region) -> int:
    """Return how many samples of a region lie in at least one of its parts, 0 if too few do.

    Too few to cover all of it.
    """
    if sum(map(_n_samples, parts)) < _n_samples(region):
        return 0
    return samples_in(parts)


def samples_in(regions: Sequence[Region]) -> int:
    """Return how many samples lie in at least one of the regions."""
    row_ends = sorted({end for one in regions for end in (one.row, one.row + one.n_rows)})
    col_ends = sorted({end for one in regions for end in (one.col, one.col + one.n_cols)})
    is_covered = np.zeros((len(row_ends) - 1, len(col_ends) - 1), dtype=np.bool_)
    for one in regions:
        rows = np.searchsorted(row_ends, (one.row, one.row + one.n_rows))
        cols = np.searchsorted(col_ends, (one.col, one.col + one.n_cols))
        is_covered[slice(*rows), slice(*cols)] = True
    return int(np.diff(row_ends) @ is_covered @ np.diff(col_ends))


def _n_samples(region: Region) -> int:
    return region.n_rows * region.n_cols


def is_same(one: Any, other: Any) -> bool:
    """Say whether two values are equal bit for bit: NaN as NaN, -0.0 not as 0.0."""
    return np.asarray(one).tobytes() == np.asarray(other).tobytes()


def are_bits(values: NDArray[Any], value: Any) -> NDArray[np.bool_]:
    """Say which values are a value of their type bit for bit, as `is_same` does."""
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
    """A source of a VRT's band: what it covers, and what it copies, None if it does more."""

    place: Region
    copies: tuple[str, int, Region] | None
    nodata: float | None


class VrtSources:
    """The sources of a VRT's band.

    Parameters
    ----------
    value_of : callable
        Returns the stored value of all samples of a region of a band of a file, as the type of the
        VRT's band; None where only reading tells.
    """

    def __init__(
        self,
        sources: list[_Source],
        value_of: Callable[[str, int, Region], Any],
        read_sample: Callable[[int, int], Any],
    ) -> None:
        self._sources = sources
        self._value_of = value_of
        self._read_sample = read_sample
        self._fill: Any = None
        # Each file is opened once for this, however often it is asked for.
        self._values: dict[tuple[str, int, Region], Any] = {}
        regions = np.array([one.place for one in sources], dtype=np.int64).reshape(-1, 4)
        self._corners = regions[:, :2], regions[:, :2] + regions[:, 2:]
        self._cells: defaultdict[tuple[int, int], list[int]] = defaultdict(list)
        self._has_cells = True
        for number, one in enumerate(sources):
            cells = _cells_of(one.place)
            if len(cells) > _MOST_CELLS**2:
                self._has_cells = False
                break
            for cell in cells:
                self._cells[cell].append(number)

    def value(self, region: Region) -> Any:
        """Return the value of all samples of a region, as its sources lie over each other."""
        composite = Composite(region)
        for number in self._touching(region):
            source = self._sources[number]
            value = self._source_value(source)
            if value is None:
                return None
            if source.nodata is not None:
                if _is_number(value, source.nodata):
                    continue
                if _is_nearly(value, source.nodata):
                    return None
            if not composite.put(value, source.place):
                return None
        return composite.value(lambda: self._value_of_gap(region))

    def _value_of_gap(self, region: Region) -> Any:
        if self._fill is None:
            self._fill = self._read_sample(region.row, region.col)
        return self._fill

    def _touching(self, region: Region) -> list[int]:
        """Return the sources that a region touches, in their order."""
        cells = _cells_of(region, _MOST_CELLS) if self._has_cells else None
        near: Any = slice(None)
        if cells is not None:
            near = sorted({number for cell in cells for number in self._cells.get(cell, ())})
            if not near:
                return []
        first, last = (corners[near] for corners in self._corners)
        end = region.row + region.n_rows, region.col + region.n_cols
        touching = np.flatnonzero(((first < end) & (last > region[:2])).all(axis=1)).tolist()
        return touching if cells is None else [near[at] for at in touching]

    def _source_value(self, source: _Source) -> Any:
        if source.copies is None:
            return None
        if source.copies not in self._values:
            self._values[source.copies] = self._value_of(*source.copies)
        return self._values[source.copies]


def _cells_of(region: Region, most: int | None = None) -> Any:
    """Return the cells that a region touches; None if they are more than `most`."""
    rows, cols = (
        range(first // _CELL, (first + n - 1) // _CELL + 1)
        for first, n in zip(region[:2], region.shape, strict=True)
    )
    if most is not None and len(rows) * len(cols) > most:
        return None
    return [(row, col) for row in rows for col in cols]


def _is_nearly(value: Any, number: float) -> bool:
    """Say whether GDAL, which compares floats with a tolerance, might take a value for a number."""
    return math.isclose(float(value), number, rel_tol=1e-5, abs_tol=1e-5)


def _is_number(value: Any, number: float) -> bool:
    return float(value) == number or (math.isnan(number) and math.isnan(float(value)))


def vrt_sources(path: str, shape: tuple[int, int], band: int) -> list[_Source] | None:
    """Return the sources of a band of a VRT file; None if they may not be all that makes it."""
    try:
        if not os.path.isfile(path) or os.path.getsize(path) > _MOST_BYTES:
            return None
        root = ET.parse(path).getroot()
        if root.tag != "VRTDataset" or root.get("subClass") is not None:
            return None
        if (int(root.get("rasterYSize", "0")), int(root.get("rasterXSize", "0"))) != shape:
            return None
        bands = root.findall("VRTRasterBand")
        numbers = [int(one.get("band", str(place))) for place, one in enumerate(bands, 1)]
        if numbers != list(range(1, len(bands) + 1)):
            return None
        chosen = bands[band - 1]
        if chosen.get("subClass") not in (None, "VRTSourcedRasterBand"):
            return None
        sources = [
            _source_of(one, os.path.dirname(path), shape) for one in chosen if one.tag not in _PLAIN
        ]
    except (OSError, ValueError, IndexError, ET.ParseError):
        return None
    known = [one for one in sources if one is not None]
    return _joined(known) if len(known) == len(sources) else None


def _joined(sources: list[_Source]) -> list[_Source]:
    """Return sources with those as one that follow each other, copy the same, and lie side by side.

    A sea of thousands of tiles may be one file, named for each of them: if it is of one value, so
    are they, and else nothing is known of any of them.
    """
    n_before = len(sources) + 1
    while len(sources) < n_before:
        n_before = len(sources)
        joined: list[_Source] = []
        for one in sources:
            last = joined[-1] if joined else one
            place = _union(last.place, one.place)
            is_alike = one.copies is not None and one[1:] == last[1:]
            if joined and is_alike and place is not None:
                joined[-1] = one._replace(place=place)
            else:
                joined.append(one)
        sources = joined
    return sources


def _union(one: Region, other: Region) -> Region | None:
    """Return two regions as one if they are a rectangle that both have a whole side of."""
    row, col = min(one.row, other.row), min(one.col, other.col)
    if (one.col, one.n_cols) == (other.col, other.n_cols):
        if max(one.row, other.row) == row + (one if one.row == row else other).n_rows:
            return Region(row, col, one.n_rows + other.n_rows, one.n_cols)
    elif (one.row, one.n_rows) == (other.row, other.n_rows):
        if max(one.col, other.col) == col + (one if one.col == col else other).n_cols:
            return Region(row, col, one.n_rows, one.n_cols + other.n_cols)
    return None


def _source_of(element: ET.Element, folder: str, shape: tuple[int, int]) -> _Source | None:
    if element.tag not in _SOURCES:
        return None
    place = _rectangle(element.find("DstRect"))
    if place is None:
        return _Source(Region(0, 0, *shape), None, None)
    top, left, n_rows, n_cols = place
    bottom, right = top + n_rows, left + n_cols
    is_whole = all(float(number).is_integer() for number in place)
    # GDAL rounds what is not in whole samples: it is kept a sample away.
    margin = 0 if is_whole else 1
    outer = Region(
        math.floor(top) - margin,
        math.floor(left) - margin,
        math.ceil(bottom) - math.floor(top) + 2 * margin,
        math.ceil(right) - math.floor(left) + 2 * margin,
    ).intersect(Region(0, 0, *shape))
    copies = _copied(element, folder) if is_whole else None
    nodata = element.findtext("NODATA")
    if copies is not None and copies[2].shape != (n_rows, n_cols):
        copies = None
    if copies is not None and outer.shape != copies[2].shape:  # reaches beyond the raster
        copies = None
    return _Source(outer, copies, None if nodata is None else float(nodata))


def _rectangle(element: ET.Element | None) -> tuple[float, float, float, float] | None:
    """Return row, column, rows and columns; None without all of them."""
    if element is None:
        return None
    parts = [element.get(name) for name in ("yOff", "xOff", "ySize", "xSize")]
    if None in parts:
        return None
    row, col, n_rows, n_cols = (float(part) for part in parts)  # type: ignore[arg-type]
    if not all(map(math.isfinite, (row, col, n_rows, n_cols))) or n_rows < 0 or n_cols < 0:
        raise ValueError("a rectangle without a size")
    return row, col, n_rows, n_cols


def _copied(element: ET.Element, folder: str) -> tuple[str, int, Region] | None:
    """Return file, band and place of the samples that a source copies; None if it does more."""
    if {child.tag for child in element} - _COPIES:
        return None
    name, place = element.find("SourceFilename"), _rectangle(element.find("SrcRect"))
    if name is None or not name.text or place is None:
        return None
    if not all(number.is_integer() and number >= 0 for number in place):
        return None
    band = element.findtext("SourceBand", "1")
    if not band.isdecimal():
        return None
    path = name.text
    if name.get("relativeToVRT") == "1":
        path = os.path.join(folder, path)
    if not os.path.isfile(path):
        return None
    row, col, n_rows, n_cols = map(int, place)
    return path, int(band), Region(row, col, n_rows, n_cols)


def stored_values(
    dataset: Any,
    band: int,
    read_sample: Callable[[int, int], Any],
    open_member: Callable[[str, int], Any],
    nested: int = 0,
) -> StoredValues | None:
    """Return what tells of even windows of a band of a dataset that was opened to be read.

    `open_member` opens a band of another file as a context: a raster with `dtype`, size and `even`.
    """
    if dataset.driver == "GTiff":
        return SparseBlocks(dataset, band, read_sample)
    if dataset.driver != "VRT" or nested >= _MOST_NESTED:
        return None
    sources = vrt_sources(str(dataset.name), (dataset.height, dataset.width), band)
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
