"""Mosaic: several rasters of one grid as one."""

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple, NoReturn, Self

import numpy as np
from numpy.typing import NDArray
from rasterio.crs import CRS

from terrainwave.arguments import NodataChoice
from terrainwave.cache import Cache
from terrainwave.errors import InvalidHeightsError
from terrainwave.grid.affine import determinant, of_window, places_to_pixels
from terrainwave.grid.quadtree import Region
from terrainwave.place.crs import format_crs
from terrainwave.place.description import added_vertical
from terrainwave.place.meaning import RADIUS, Told
from terrainwave.place.position import longitude_turn
from terrainwave.place.units import HeightUnit, Meeting, height_unit, kind_name, meeting
from terrainwave.raster_io.backend import RasterBackend
from terrainwave.raster_io.even import Even, Layers, composed, samples_in
from terrainwave.raster_io.gdal import scan_windows
from terrainwave.raster_io.raster_info import (
    SUPPORTED_DTYPES,
    EarlierLoss,
    common_tags,
    fit_nodata,
    stored_nodata,
)

# Largest difference of grids in pixels: tiles give their corners with about ten digits.
_TOLERANCE = 0.01
# Files open at a time: a row of tiles, well below the limit of a process.
_MAX_OPEN = 128
# Properties of a mosaic on which all rasters agree, and their names in notes.
_ALIKE = {
    "coordinate_epoch": "the coordinate epoch",
    "area_or_point": "AREA_OR_POINT",
    "description": "the band's description",
    "color_interpretation": "the band's colour interpretation",
}
_ASKED = (
    "name", "transform", "dtype", "undeclared", "has_mask", "block_shape", "crs", "is_lost",
    "earlier", "told",
)  # fmt: skip
# Likely reason why a mosaic in degrees is nearly empty.
_ACROSS = (
    ": they lie on both sides of 180 degrees (or of 0), so that their longitudes are a whole turn"
    " apart; give one side longitudes that go on from the other's, for example by gdal_translate"
    " -a_ullr"
)
# Striped files wider than this are read by whole strips.
_WIDE = 1024


class Orientation(NamedTuple):
    """Rows and columns exchanged, then their order reversed, relative to another grid."""

    swap: bool = False
    flip_rows: bool = False
    flip_cols: bool = False

    def of_shape(self, shape: tuple[int, int]) -> tuple[int, int]:
        return (shape[1], shape[0]) if self.swap else shape

    def of_transform(
        self, transform: tuple[float, ...], shape: tuple[int, int]
    ) -> tuple[float, ...]:
        a, b, c, d, e, f = transform
        n_rows, n_cols = self.of_shape(shape)
        if self.swap:
            a, b, d, e = b, a, e, d
        if self.flip_rows:
            b, e, c, f = -b, -e, c + n_rows * b, f + n_rows * e
        if self.flip_cols:
            a, d, c, f = -a, -d, c + n_cols * a, f + n_cols * d
        return a, b, c, d, e, f

    def of_array(self, array: NDArray[Any]) -> NDArray[Any]:
        turned = array.T if self.swap else array
        return turned[:: -1 if self.flip_rows else 1, :: -1 if self.flip_cols else 1]

    def before(self, part: Region, shape: tuple[int, int]) -> Region:
        row = shape[0] - part.row - part.n_rows if self.flip_rows else part.row
        col = shape[1] - part.col - part.n_cols if self.flip_cols else part.col
        if self.swap:
            return Region(col, row, part.n_cols, part.n_rows)
        return Region(row, col, *part.shape)


ORIENTATIONS = tuple(Orientation(*turn) for turn in product((False, True), repeat=3))


class _Description(NamedTuple):
    """Position of a raster, and properties on which a mosaic must agree."""

    name: str
    shape: tuple[int, int]
    transform: tuple[float, ...]
    dtype: np.dtype[Any]
    nodata: int | float | None
    undeclared: tuple[int | float, ...]
    has_mask: bool
    block_shape: tuple[int, int]
    crs: CRS | None
    tags: dict[str, Any]
    remarks: tuple[str, ...]
    asides: tuple[str, ...]
    is_lost: bool
    earlier: EarlierLoss | None
    told: Told
    even: Even | None
    turn: Orientation = Orientation()

    @property
    def unit(self) -> HeightUnit:
        return height_unit(self.tags["units"], self.tags["crs"])

    def on_grid_of(self, first: Self) -> Self:
        pixel, size = _pixel(first.transform), max(*first.shape, *self.shape)
        for turn in ORIENTATIONS:
            transform = turn.of_transform(self.transform, self.shape)
            if _difference(first.transform, transform) * size <= _TOLERANCE * pixel:
                return self._replace(
                    turn=turn,
                    transform=transform,
                    shape=turn.of_shape(self.shape),
                    block_shape=turn.of_shape(self.block_shape),
                )
        return self


class _Member(NamedTuple):
    """Raster of a mosaic: its position in the mosaic, and the values that mark its voids."""

    source: Any  # a path, or an open dataset or .twz file
    about: _Description
    region: Region
    voids: tuple[int | float, ...]


class MosaicBackend(RasterBackend):
    """Several rasters on one grid; where they overlap, the last one's valid heights count.

    Rows and columns are ordered as in the first raster; rasters in another order (south first,
    turned by right angles) are turned while they are read. The nodata value is the first one
    declared. A valid height of another raster with that value is refused when it is read. Without
    any nodata value, whole numbers get a mask. `open_member` opens one of `sources`. Raises
    `InvalidHeightsError` if the rasters cannot be put together; the message says what to do.
    """

    def __init__(
        self,
        sources: Sequence[Any],
        open_member: Callable[[Any], RasterBackend],
        nodata: NodataChoice,
        heights_are: str | None = None,
    ) -> None:
        self._open_member = open_member
        self._open: Cache[str, RasterBackend] = Cache(_MAX_OPEN, drop=lambda one: one.close())
        try:
            self._put_together(sources, nodata, heights_are)
        except BaseException:
            self.close()
            raise

    def _put_together(
        self, sources: Sequence[Any], nodata: NodataChoice, heights_are: str | None
    ) -> None:
        rasters = [self._describe(source) for source in sources]
        first = rasters[0]
        lost = [one for one in rasters if one.is_lost]
        if len(lost) > 1:
            raise InvalidHeightsError(
                f"{_names(lost)}: no transform says where they lie, so that they would lie on each"
                " other; expected places to put a mosaic together by: give them one, for example by"
                " gdal_edit -a_ullr"
            )
        rasters = [one.on_grid_of(first) for one in rasters]
        # The first raster with a unit gives the unit of all.
        named = next((one for one in rasters if one.unit.name is not None), first)
        for other in rasters[1:]:
            _check_alike(first, other, named)
            crs_text = format_crs(first.crs)
            are_depths = {kind_name(one.told.kind, crs_text) == "depths" for one in (first, other)}
            if heights_are is None and len(are_depths) > 1:
                _refuse_kinds([(one.name, one.told) for one in (first, other)], crs_text)
        self.told = first.told
        self.is_told = any(one.told.kind for one in rasters)
        self.name = f"{first.name} and {len(rasters) - 1} more"
        self.dtype = first.dtype
        places = [_place(first, other) for other in rasters]
        top, left = min(row for row, _ in places), min(col for _, col in places)
        self.n_rows = max(row + one.shape[0] for (row, _), one in zip(places, rasters)) - top
        self.n_cols = max(col + one.shape[1] for (_, col), one in zip(places, rasters)) - left
        self.transform = _corner_transform(rasters, places, top, left)
        self._tags, self._differing = _common(rasters, named)
        self._members = []
        for source, one, (row, col) in zip(sources, rasters, places):
            region = Region(row - top, col - left, *one.shape)
            values = one.nodata if nodata.keeps_declared else None, nodata.value
            voids = tuple(value for value in values if value is not None and value == value)
            self._members.append(_Member(source, one, region, voids))
        self._layers = Layers([member.region for member in self._members])
        self._notes = list(_gathered((one, one.remarks) for one in rasters))
        nameless = [one for one in rasters if one.unit.name is None]
        if nameless:
            self._notes += filter(None, [_units_met(nameless, named).note])
        self._asides = list(_gathered((one, one.asides) for one in rasters))
        declared = [one.nodata for one in rasters if one.nodata is not None]
        self.undeclared = tuple(dict.fromkeys(value for one in rasters for value in one.undeclared))
        self.nodata = nodata.value
        if nodata.keeps_declared:
            self.nodata = next(iter(declared), None) if nodata.value is None else nodata.value
            self._notes += _notes_on_nodata(rasters, self.nodata)
        losses = [one.earlier for one in rasters if one.earlier is not None]
        self.earlier = max(losses, key=lambda loss: loss.max_error, default=None)
        self._n_covered = samples_in([member.region for member in self._members])
        has_voids = self._has_gaps or any(one.has_mask for one in rasters)
        self.has_mask = self.nodata is None and self.dtype.kind != "f" and has_voids
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
            **{name: getattr(backend, name) for name in _ASKED},
            shape=(backend.n_rows, backend.n_cols),
            nodata=nodata,
            tags=backend.tags(),
            remarks=tuple(backend.remarks()),
            asides=tuple(backend.asides()),
            even=backend.even(Region(0, 0, backend.n_rows, backend.n_cols)),
        )

    def _backend(self, source: Any) -> RasterBackend:
        if not isinstance(source, str | os.PathLike):
            return self._open_member(source)
        return self._open.get_or_make(os.fspath(source), lambda: self._open_member(source))

    def notes(self) -> Iterator[str]:
        yield from self._notes
        if self._differing:
            names = ", ".join(self._differing)
            yield f"{self.name}: dropped, as the rasters differ there: {names}"
        turned = [one.about for one in self._members if one.about.turn != Orientation()]
        if turned:
            yield (
                f"{_names(turned)}: rows or columns are stored in another order than in"
                f" {self._members[0].about.name}; turned to its order"
            )
        if self._has_gaps:
            share = 100 * self._n_covered / (self.n_rows * self.n_cols)
            yield (
                f"{self.name} cover {share:.3g} % of the {self.n_rows} x {self.n_cols} samples"
                f" around them; the rest is void{_ACROSS * self._is_across}"
            )

    @property
    def _is_across(self) -> bool:
        turn = longitude_turn(self._tags["crs"])
        a, b, _, d, e, _ = self.transform
        if turn is None or b or d:
            return False
        first, last = (ends[:, 1 - turn.axis] for ends in (self._layers.first, self._layers.last))
        start, end = int(first.min()), int(last.max())
        west = first + last < start + end
        moved = np.where(west, turn.length / abs((a, e)[turn.axis]), 0.0)
        return bool((last + moved).max() - (first + moved).min() < (end - start) / 2)

    def named_asides(self) -> Iterator[str]:
        yield from self._asides

    def tags(self) -> dict[str, Any]:
        return self._tags

    def read(
        self, row: int, col: int, n_rows: int, n_cols: int
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return heights and validity; raise if a valid height equals the mosaic's nodata value."""
        window = Region(row, col, n_rows, n_cols)
        heights = np.full(window.shape, self._void_value(), dtype=self.dtype)
        valid = np.zeros(window.shape, dtype=np.bool_)
        for member in self._touching(window):
            part = member.region.intersect(window)
            samples, is_valid = self._read_member(member, part)
            there = part.slices_in(window)
            heights[there][is_valid] = samples[is_valid]
            valid[there] |= is_valid
        return heights, valid

    def declared_voids(
        self,
        window: Region,
        heights: NDArray[Any],  # noqa: ARG002
    ) -> NDArray[np.bool_]:
        """Return which heights of a window are declared void by their raster, against `nodata`."""
        found = np.zeros(window.shape, dtype=np.bool_)
        for member in self._touching(window):
            part = member.region.intersect(window)
            samples, is_valid = self._read_member(member, part)
            values = [stored_nodata(value, self.dtype) for value in member.about.undeclared]
            found[part.slices_in(window)][is_valid] = np.isin(samples, values)[is_valid]
        return found

    def even(self, region: Region) -> Even | None:
        """Return the common content of a region: of a gap, or of rasters with one value."""
        gap = Even(self._void_value(), False)
        value = composed(region, self._values(region), lambda: gap)
        return value if value is None or value is gap else Even(value, True)

    def _values(self, region: Region) -> Iterator[tuple[Any, Region]]:
        for member in self._touching(region):
            even = member.about.even
            if even is None:
                yield None, member.region
            elif even.is_valid and not self._is_void(even.value, *member.voids):
                # A valid height that is the mosaic's nodata value is refused when read.
                is_taken = self._is_void(even.value, self.nodata)
                yield None if is_taken else even.value, member.region

    def _is_void(self, value: Any, *voids: int | float | None) -> bool:
        if self.dtype.kind == "f" and math.isnan(value):
            return True
        known = (void for void in voids if void is not None and not math.isnan(void))
        return any(bool(value == stored_nodata(void, self.dtype)) for void in known)

    def _touching(self, region: Region) -> Iterator[_Member]:
        return (self._members[number] for number in self._layers.touching(region))

    def _void_value(self) -> Any:
        if self.nodata is not None:
            return stored_nodata(self.nodata, self.dtype)
        return math.nan if self.dtype.kind == "f" else 0

    def _read_member(self, member: _Member, part: Region) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        own, turn = member.region, member.about.turn
        place = part.row - own.row, part.col - own.col
        window = turn.before(Region(*place, *part.shape), own.shape)
        heights, valid = map(turn.of_array, self._backend(member.source).read(*window))
        for value in member.voids:
            valid &= heights != stored_nodata(value, self.dtype)
        if self.dtype.kind == "f":
            valid &= ~np.isnan(heights)
        if self.nodata is not None and self.nodata not in member.voids:
            taken = (heights == stored_nodata(self.nodata, self.dtype)) & valid
            if taken.any():
                at_row, at_col = np.argwhere(taken)[0] + place
                first = self._members[0].about.name
                raise InvalidHeightsError(
                    f"{member.about.name}: the height at row {at_row}, column {at_col} is"
                    f" {self.nodata:g}, which marks voids in {first}: give the rasters one"
                    " nodata value first, for example gdal_translate -a_nodata or"
                    " gdalwarp -dstnodata"
                )
        return heights, valid

    def parts(
        self, max_samples: int
    ) -> Iterator[tuple[str, Told, Iterator[tuple[NDArray[Any], NDArray[np.bool_]]]]]:
        """Yield the name of each raster, its own meaning, and its windows as `read` gives them."""
        for member in self._members:
            row, col, n_rows, n_cols = member.region
            yield (
                member.about.name,
                member.about.told,
                (
                    self._read_member(member, part._replace(row=row + part.row, col=col + part.col))
                    for part in scan_windows(n_rows, n_cols, *self.block_shape, max_samples)
                ),
            )

    def close(self) -> None:
        self._open.clear()


def _common(
    rasters: Sequence[_Description], named: _Description
) -> tuple[dict[str, Any], list[str]]:
    first, differing = rasters[0], list[str]()
    tags = {**first.tags, "units": named.tags["units"]}
    for name, words in _ALIKE.items():
        if any(one.tags[name] != first.tags[name] for one in rasters):
            tags[name] = None
            differing.append(words)
    for name in ("tags", "band_tags"):
        tags[name] = common_tags(one.tags[name] for one in rasters)
    kept = {name for name, _ in (*tags["tags"], *tags["band_tags"])}
    found = {
        name for one in rasters for kind in ("tags", "band_tags") for name, _ in one.tags[kind]
    }
    if found - kept:
        differing.append(f"the tags {', '.join(sorted(found - kept))}")
    return tags, differing


def _check_alike(first: _Description, other: _Description, named: _Description) -> None:
    """Raise InvalidHeightsError unless a raster fits the first one, and the unit of `named`."""
    if first.crs != other.crs:
        if first.crs and other.crs and (vertical := added_vertical(first.crs, other.crs)):
            raise InvalidHeightsError(
                f"{other.name}: found CRS {_crs_name(other.crs)}, {first.name} has"
                f" {_crs_name(first.crs)}; only one of them has a vertical datum, {vertical[0]}:"
                " if the heights of both are above it, name it in the other raster first, by"
                f" gdal_edit -a_srs {vertical[1]}"
            )
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
    problem = _units_met([other], named).problem
    if problem:
        raise InvalidHeightsError(problem)
    for name in ("scale", "offset"):
        if first.tags[name] != other.tags[name]:
            raise InvalidHeightsError(
                f"{other.name}: found {name} {other.tags[name]}, {first.name} has"
                f" {first.tags[name]}; expected the same: convert the heights first, for example"
                " gdal_calc, or correct the metadata with rio edit-info"
            )
    _place(first, other)


def check_radii(found: Iterable[tuple[str, Told]], crs_text: str | None) -> None:
    """Raise InvalidHeightsError if only some of the rasters of a mosaic have radii."""
    pairs = list(found)
    for pair in pairs:
        if (pair[1].kind == RADIUS) != (pairs[0][1].kind == RADIUS):
            _refuse_kinds([pairs[0], pair], crs_text)


def _refuse_kinds(pair: Sequence[tuple[str, Told]], crs_text: str | None) -> NoReturn:
    (first, own), (other, found) = (
        (name, kind_name(told.kind, crs_text) + (f" ({told.by})" if told.kind else ""))
        for name, told in pair
    )
    cure = "turn the others first, for example gdal_calc --calc=-A,"
    if any(told.kind == RADIUS for _, told in pair):
        cure = (
            "bring them to one first, for example gdal_calc --calc=A-R with the body's radius R,"
            " declare numbers that mark voids by `nodata`,"
        )
    raise InvalidHeightsError(
        f"{other}: found {found}, {first} has {own}; expected one of them: {cure} or say what all"
        " are by `heights_are`"
    )


def _units_met(others: Sequence[_Description], named: _Description) -> Meeting:
    return meeting(_names(others), others[0].unit, named.name, named.unit)


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
    resolution = f"{math.hypot(a, d):.10g} {math.hypot(b, e):.10g}"
    size = max(*first.shape, *other.shape)
    if _difference(first.transform, other.transform) * size > _TOLERANCE * _pixel(first.transform):
        raise InvalidHeightsError(
            f"{other.name}: found {_grid_text(other.transform)}, {first.name} has"
            f" {_grid_text(first.transform)}; expected one resolution and one direction of rows:"
            f" resample first, for example gdalwarp -tr {resolution} -tap"
        )
    row, col = places_to_pixels(first.transform, other.transform[2], other.transform[5])
    if max(abs(col - round(col)), abs(row - round(row))) > _TOLERANCE:
        raise InvalidHeightsError(
            f"{other.name}: its pixels lie {abs(col - round(col)):.3g} columns and"
            f" {abs(row - round(row)):.3g} rows beside those of {first.name}; expected one grid:"
            f" resample first, for example gdalwarp -tr {resolution} -tap for all of them"
        )
    return round(row), round(col)


def _pixel(transform: tuple[float, ...]) -> float:
    a, b, _, d, e, _ = transform
    return max(abs(a), abs(b), abs(d), abs(e))


def _difference(mine: tuple[float, ...], theirs: tuple[float, ...]) -> float:
    return max(abs(mine[k] - theirs[k]) for k in (0, 1, 3, 4))


def _grid_text(transform: tuple[float, ...]) -> str:
    """Return the size of pixels, and the rotation of rows from west to east, as text."""
    a, b, _, d, e, _ = transform
    size = f"pixels of {math.hypot(a, d):.10g} x {math.hypot(b, e):.10g}"
    angle = math.degrees(math.atan2(d, a))
    return f"{size}, turned by {angle:.6g} degrees" if angle % 180 else size


def _gathered(said: Iterable[tuple[_Description, tuple[str, ...]]]) -> Iterator[str]:
    of_remarks: dict[str, list[_Description]] = {}
    for one, remarks in said:
        for remark in remarks:
            of_remarks.setdefault(remark, []).append(one)
    for remark, found in of_remarks.items():
        yield f"{_names(found)}: {remark}"


def _names(rasters: Sequence[Any]) -> str:
    more = f" and {len(rasters) - 1} more" if len(rasters) > 1 else ""
    return f"{rasters[0].name}{more}"


def _notes_on_nodata(rasters: Sequence[_Description], kept: float | None) -> Iterator[str]:
    values = dict.fromkeys(repr(one.nodata) for one in rasters if one.nodata is not None)
    if len(values) > 1 or (values and repr(kept) not in values):
        yield (
            f"{_names(rasters)}: found the nodata values {', '.join(values)}; all voids get"
            f" {kept!r}"
        )


def _corner_transform(
    rasters: Sequence[_Description], places: Sequence[tuple[int, int]], top: int, left: int
) -> tuple[float, ...]:
    """Return the mosaic's transform; exactly as in the files if these are not rotated."""
    a, b, _, d, e, _ = rasters[0].transform
    if (b, d) == (0, 0):
        x = next(one.transform[2] for one, (_, col) in zip(rasters, places) if col == left)
        y = next(one.transform[5] for one, (row, _) in zip(rasters, places) if row == top)
        return a, b, x, d, e, y
    return of_window(rasters[0].transform, top, left)
