"""Several rasters of one grid as one: what a mosaic or its missing parts read as."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rasterio.crs import CRS

from terrainwave.cache import Cache
from terrainwave.errors import InvalidHeightsError
from terrainwave.grid.affine import determinant, of_window, places_to_pixels
from terrainwave.grid.quadtree import Region
from terrainwave.raster_io.crs import format_crs
from terrainwave.raster_io.dataset import DatasetBackend, open_dataset
from terrainwave.raster_io.info import SUPPORTED_DTYPES, fit_nodata, stored_nodata
from terrainwave.raster_io.tags import common_tags

# Parts of a pixel by which grids may differ: tiles name their corners with ten digits or so.
_TOLERANCE = 0.01
# Files that are open at a time: a row of tiles, well below what a process may open.
_MAX_OPEN = 128
# Striped files wider than this are read by whole strips.
_WIDE = 1024


class _Member(NamedTuple):
    """One raster of a mosaic: its place in the mosaic and how its voids are told."""

    source: Any  # a path, or an open dataset
    name: str
    region: Region
    nodata: int | float | None
    has_mask: bool


class _Description(NamedTuple):
    """What the rasters of a mosaic must agree in, and where they lie."""

    name: str
    shape: tuple[int, int]
    transform: tuple[float, ...]
    dtype: np.dtype[Any]
    nodata: int | float | None
    has_mask: bool
    block_shape: tuple[int, int]
    crs: CRS | None
    tags: dict[str, Any]
    notes: tuple[str, ...]


class MosaicBackend:
    """Several rasters on one grid; where they overlap, the last one's valid heights count.

    Parameters
    ----------
    sources : sequence of paths or rasterio datasets
    band : int
        Band of each.
    nodata : int or float, optional
        Replaces the nodata value of each.

    Raises
    ------
    InvalidHeightsError
        If they differ in CRS, resolution, type, scale, offset or units, or their pixels don't lie
        on one grid; the message says which and what to do.
    StorageError
        If one cannot be opened.

    Notes
    -----
    The mosaic's nodata value is the first one declared. A valid height of another raster that has
    that value is refused when it is read. Without any such value, whole numbers get a mask.
    """

    is_file = True

    def __init__(self, sources: Sequence[Any], band: int, nodata: int | float | None) -> None:
        self._band = band
        self._open: Cache[str, DatasetBackend] = Cache(_MAX_OPEN, drop=DatasetBackend.close)
        rasters = [self._describe(source) for source in sources]
        first = rasters[0]
        for other in rasters[1:]:
            _check_alike(first, other)
        self.name = f"{first.name} and {len(rasters) - 1} more"
        self.dtype = first.dtype
        places = [_place(first, other) for other in rasters]
        top, left = min(row for row, _ in places), min(col for _, col in places)
        self.n_rows = max(row + one.shape[0] for (row, _), one in zip(places, rasters)) - top
        self.n_cols = max(col + one.shape[1] for (_, col), one in zip(places, rasters)) - left
        self.transform = _corner_transform(rasters, places, top, left)
        self._tags = dict(first.tags)
        for name in ("area_or_point", "description", "color_interpretation"):
            if any(one.tags[name] != first.tags[name] for one in rasters):
                self._tags[name] = None
        for name in ("tags", "band_tags"):
            self._tags[name] = common_tags(one.tags[name] for one in rasters)
        kept = {name for name, _ in (*self._tags["tags"], *self._tags["band_tags"])}
        found = {
            name for one in rasters for kind in ("tags", "band_tags") for name, _ in one.tags[kind]
        }
        self._differing = sorted(found - kept)
        self._members = [
            _Member(
                source,
                one.name,
                Region(row - top, col - left, *one.shape),
                one.nodata if nodata is None else nodata,
                one.has_mask,
            )
            for source, one, (row, col) in zip(sources, rasters, places)
        ]
        regions = np.array([member.region for member in self._members], dtype=np.int64)
        self._corners = regions[:, :2], regions[:, :2] + regions[:, 2:]
        self._notes = [note for one in rasters for note in one.notes]
        declared = [one.nodata for one in rasters if one.nodata is not None]
        self.nodata = declared[0] if declared else None
        self._nodata = self.nodata if nodata is None else nodata
        self._n_covered = covered_samples([member.region for member in self._members])
        has_voids = self._has_gaps or any(one.has_mask for one in rasters)
        self.has_mask = self._nodata is None and self.dtype.kind != "f" and has_voids
        self.block_shape = first.block_shape
        if first.block_shape[1] >= first.shape[1] > _WIDE:
            self.block_shape = first.block_shape[0], self.n_cols

    @property
    def _has_gaps(self) -> bool:
        return self._n_covered < self.n_rows * self.n_cols

    def _describe(self, source: Any) -> _Description:
        backend = self._backend(source)
        nodata = backend.nodata
        if nodata is not None and backend.dtype.name in SUPPORTED_DTYPES:
            nodata, _ = fit_nodata(nodata, backend.dtype)
        return _Description(
            name=backend.name,
            shape=(backend.n_rows, backend.n_cols),
            transform=backend.transform,
            dtype=backend.dtype,
            nodata=nodata,
            has_mask=backend.has_mask,
            block_shape=backend.block_shape,
            crs=backend.crs,
            tags=backend.tags(),
            notes=tuple(backend.notes()),
        )

    def _backend(self, source: Any) -> DatasetBackend:
        """Return an open raster; of files, the one that was not read longest is closed."""
        if hasattr(source, "read_masks"):
            return DatasetBackend(source, self._band, owned=False)
        path = str(source)
        return self._open.get_or_make(
            path, lambda: DatasetBackend(open_dataset(path), self._band, owned=True)
        )

    def notes(self) -> Iterator[str]:
        """Yield what is left out or was chosen, one sentence each."""
        yield from self._notes
        if self._differing:
            names = ", ".join(self._differing)
            yield f"{self.name}: dropped, as the rasters differ there: the tags {names}"
        if self._has_gaps:
            share = 100 * self._n_covered / (self.n_rows * self.n_cols)
            yield (
                f"{self.name} cover {share:.3g} % of the {self.n_rows} x {self.n_cols} samples"
                " around them; the rest is void"
            )

    def tags(self) -> dict[str, Any]:
        """Return the fields of RasterInfo that do not bear on the heights."""
        return self._tags

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return heights and validity; voids hold the nodata value, NaN or 0.

        Raises
        ------
        InvalidHeightsError
            If a valid height has the value that marks voids.
        """
        window = Region(row, col, n_rows, n_cols)
        heights = np.full(window.shape, self._void_value(), dtype=self.dtype)
        valid = np.zeros(window.shape, dtype=np.bool_)
        # All at once: there may be thousands.
        first, last = self._corners
        touching = (first < (row + n_rows, col + n_cols)) & (last > (row, col))
        for number in np.flatnonzero(touching.all(axis=1)).tolist():
            member = self._members[number]
            part = member.region.intersect(window)
            samples, is_valid = self._read_member(member, part)
            there = part.slices_in(window)
            heights[there][is_valid] = samples[is_valid]
            valid[there] |= is_valid
        return heights, valid

    def _void_value(self) -> Any:
        if self._nodata is not None:
            return stored_nodata(self._nodata, self.dtype)
        return math.nan if self.dtype.kind == "f" else 0

    def _read_member(self, member: _Member, part: Region) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        place = part.row - member.region.row, part.col - member.region.col
        heights, valid = self._backend(member.source).read(*place, *part.shape)
        if member.nodata is not None and not math.isnan(member.nodata):
            valid &= heights != stored_nodata(member.nodata, self.dtype)
        if self.dtype.kind == "f":
            valid &= ~np.isnan(heights)
        if self._nodata is not None and self._nodata != member.nodata:
            taken = (heights == stored_nodata(self._nodata, self.dtype)) & valid
            if taken.any():
                at_row, at_col = np.argwhere(taken)[0] + place
                raise InvalidHeightsError(
                    f"{member.name}: the height at row {at_row}, column {at_col} is"
                    f" {self._nodata:g}, which marks voids in {self._members[0].name}: give the"
                    " rasters one nodata value first, for example gdal_translate -a_nodata or"
                    " gdalwarp -dstnodata"
                )
        return heights, valid

    def close(self) -> None:
        """Close what was opened here."""
        self._open.clear()


def _check_alike(first: _Description, other: _Description) -> None:
    """Raise InvalidHeightsError unless two rasters can be parts of one mosaic."""
    if first.crs != other.crs:
        wanted = format_crs(first.crs)
        target = wanted if wanted and len(wanted) < 20 else "the CRS of the first"
        raise InvalidHeightsError(
            f"{other.name}: found CRS {_crs_name(other.crs)}, {first.name} has"
            f" {_crs_name(first.crs)}; expected one CRS: bring them to the same first, for example"
            f" gdalwarp -t_srs {target}"
        )
    if first.dtype != other.dtype:
        raise InvalidHeightsError(
            f"{other.name}: heights are {other.dtype}, {first.name} has {first.dtype}; expected one"
            " type: convert them first, for example gdal_translate -ot Float32"
        )
    for name in ("units", "scale", "offset"):
        if first.tags[name] != other.tags[name]:
            raise InvalidHeightsError(
                f"{other.name}: found {name} {other.tags[name]}, {first.name} has"
                f" {first.tags[name]}; expected the same: convert the heights first, for example"
                " gdal_calc, or correct the metadata with rio edit-info"
            )
    _place(first, other)


def _crs_name(crs: CRS | None) -> str:
    text = format_crs(crs) or "none"
    return text.split('"')[1] if '"' in text else text


def _place(first: _Description, other: _Description) -> tuple[int, int]:
    """Return row and column of `other`'s first pixel on the grid of `first`."""
    a, b, _, d, e, _ = first.transform
    is_finite = all(map(math.isfinite, (*first.transform, *other.transform)))
    if not is_finite or determinant(first.transform) == 0:
        raise InvalidHeightsError(
            f"{first.name} and {other.name}: their transforms do not say where they lie"
        )
    size = max(*first.shape, *other.shape)
    pixel = max(abs(a), abs(b), abs(d), abs(e))
    differences = [
        abs(mine - theirs)
        for mine, theirs in zip((a, b, d, e), (*other.transform[:2], *other.transform[3:5]))
    ]
    resolution = f"{math.hypot(a, d):.10g} {math.hypot(b, e):.10g}"
    if max(differences) * size > _TOLERANCE * pixel:
        oa, ob, _, od, oe, _ = other.transform
        raise InvalidHeightsError(
            f"{other.name}: found pixels of {math.hypot(oa, od):.10g} x {math.hypot(ob, oe):.10g},"
            f" {first.name} has {math.hypot(a, d):.10g} x {math.hypot(b, e):.10g} (or they are"
            " turned); expected one resolution: resample first, for example gdalwarp -tr"
            f" {resolution} -tap"
        )
    row, col = places_to_pixels(first.transform, other.transform[2], other.transform[5])
    if max(abs(col - round(col)), abs(row - round(row))) > _TOLERANCE:
        raise InvalidHeightsError(
            f"{other.name}: its pixels lie {abs(col - round(col)):.3g} columns and"
            f" {abs(row - round(row)):.3g} rows beside those of {first.name}; expected one grid:"
            f" resample first, for example gdalwarp -tr {resolution} -tap for all of them"
        )
    return round(row), round(col)


def _corner_transform(
    rasters: Sequence[_Description], places: Sequence[tuple[int, int]], top: int, left: int
) -> tuple[float, ...]:
    """Return the mosaic's transform; exactly as the files have it, where they are not rotated."""
    a, b, _, d, e, _ = rasters[0].transform
    if (b, d) == (0, 0):
        x = next(one.transform[2] for one, (_, col) in zip(rasters, places) if col == left)
        y = next(one.transform[5] for one, (row, _) in zip(rasters, places) if row == top)
        return a, b, x, d, e, y
    return of_window(rasters[0].transform, top, left)


def covered_samples(regions: Sequence[Region]) -> int:
    """Return how many samples lie in at least one of the regions."""
    row_ends = sorted({end for one in regions for end in (one.row, one.row + one.n_rows)})
    col_ends = sorted({end for one in regions for end in (one.col, one.col + one.n_cols)})
    is_covered = np.zeros((len(row_ends) - 1, len(col_ends) - 1), dtype=np.bool_)
    for one in regions:
        rows = np.searchsorted(row_ends, (one.row, one.row + one.n_rows))
        cols = np.searchsorted(col_ends, (one.col, one.col + one.n_cols))
        is_covered[slice(*rows), slice(*cols)] = True
    return int(np.diff(row_ends) @ is_covered @ np.diff(col_ends))
