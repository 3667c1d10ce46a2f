"""Metadata of a raster: size, type, nodata, position, units."""

import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.arguments import NodataChoice, crs_name
from terrainwave.container.metadata import EARLIER
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.affine import IDENTITY
from terrainwave.names import ABOVE, BOTH
from terrainwave.place.description import impossible_places
from terrainwave.place.meaning import (
    KINDS,
    RADIUS,
    Names,
    Told,
    by_numbers,
    may_have_radii,
    told_by,
)
from terrainwave.place.units import height_unit, in_metres, is_length

SUPPORTED_DTYPES = ("uint8", "int16", "uint16", "int32", "float32", "float64")


Tags = tuple[tuple[str, str], ...]
_TEXTS = ("crs", "units", "area_or_point", "description", "color_interpretation")


@dataclass(frozen=True)
class RasterInfo:
    """Metadata of a raster.

    `n_rows`, `n_cols`: size of the grid; >= 1.
    `dtype`: numpy's name of the sample type, one of `SUPPORTED_DTYPES`.
    `nodata`: the declared nodata value: int for integer types, float (NaN and infinities allowed)
        for float types, or None.
    `crs`: ``"AUTH:CODE"`` if that code's definition equals the raster's, else WKT (version 2 if it
        gives the same system back, else 1).
    `coordinate_epoch`: epoch of coordinates in a dynamic CRS, as a year such as 2020.5.
    `transform`: affine map from (col, row) to (x, y): ``x = a*col + b*row + c``, ``y = d*col +
        e*row + f``.
    `units`: unit of the stored heights as the band names it.
    `scale`, `offset`: physical height = ``scale * stored + offset``.
    `area_or_point`: ``"Area"`` or ``"Point"`` if the file states it.
    `description`: description of the band.
    `tags`, `band_tags`: other metadata of the file and its band, sorted by name: source, licence,
        and so on.
    `color_interpretation`: GDAL's name of the band's colour, unless it is plain ``"gray"``.
    `mask_kind`: representation of voids: ``"none"`` (no voids), ``"nodata"`` (a number), ``"nan"``,
        or ``"mask"`` (a mask band or alpha, perhaps with a nodata value).
    `heights_are`: meaning of the stored numbers, one of `place.meaning.KINDS`; None: heights, or
        depths if the CRS's vertical axis points down.
    """

    n_rows: int
    n_cols: int
    dtype: str
    nodata: int | float | None = None
    crs: str | None = None
    transform: tuple[float, ...] = IDENTITY
    units: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    area_or_point: str | None = None
    description: str | None = None
    mask_kind: str = "none"
    tags: Tags = ()
    band_tags: Tags = ()
    color_interpretation: str | None = None
    heights_are: str | None = None
    coordinate_epoch: float | None = None

    @property
    def shape(self) -> tuple[int, int]:
        return self.n_rows, self.n_cols

    def stored_side(self, bound: str) -> int:
        """Return the side of stored numbers: 1 above their originals, -1 below, 0 both."""
        if bound == BOTH:
            return 0
        side = 1 if bound == ABOVE else -1
        is_depth = height_unit(self.units, self.crs, self.heights_are).is_depth
        return side * (-1 if self.scale < 0 else 1) * (-1 if is_depth else 1)

    @property
    def void_value(self) -> int | float:
        if self.nodata is not None:
            return self.nodata
        return math.nan if np.dtype(self.dtype).kind == "f" else 0

    @property
    def crs_name(self) -> str:
        return crs_name(self.crs)

    @property
    def told(self) -> Told:
        names = Names(None, self.description, is_length(self.units))
        return told_by(dict(self.band_tags), names, self.crs)

    def own_kind(
        self, low: float | None, high: float | None, *, is_asked: bool
    ) -> tuple[str | None, Told, str | None]:
        """Return the file's side of `kind_problem`, for the ends of its range in physical units.

        `is_asked`: the meaning of the other numbers was asked for: tags and numbers do not count.
        """
        told = Told(self.heights_are)
        if not is_asked and low is not None and high is not None:
            metres = in_metres((low, high), 1.0, 0.0, self.units, self.crs)
            # A file may have room for more than it holds.
            if self.heights_are != RADIUS or not may_have_radii(self.crs, metres):
                told = by_numbers(self.told, self.crs, [metres]) or self.told
        return self.heights_are, told, self.crs

    @property
    def n_bytes(self) -> int:
        return self.n_rows * self.n_cols * np.dtype(self.dtype).itemsize

    @property
    def impossible_places(self) -> str | None:
        is_placed = self.transform != IDENTITY
        return impossible_places(self.crs, self.transform, self.shape, is_placed=is_placed)

    def to_physical(self, heights: NDArray[Any]) -> NDArray[Any]:
        """Return heights after scale and offset, in float64; unchanged without these."""
        if (self.scale, self.offset) == (1.0, 0.0):
            return heights
        # float32 would add its rounding to the bound.
        return heights.astype(np.float64) * self.scale + self.offset

    def rasterio_crs(self) -> Any:
        """Return the CRS as rasterio's object; None, with a warning, if it cannot be parsed."""
        # Imported here, because `terrainwave info` needs no rasterio.
        from terrainwave.place.crs import parse_crs

        return parse_crs(self.crs)

    def to_metadata(self) -> dict[str, Any]:
        fields = asdict(self)
        if isinstance(self.nodata, float) and not math.isfinite(self.nodata):
            fields["nodata"] = str(self.nodata)
        fields["transform"] = list(self.transform)
        fields["tags"], fields["band_tags"] = dict(self.tags), dict(self.band_tags)
        return fields

    @classmethod
    def from_metadata(cls, fields: dict[str, Any]) -> Self:
        """Rebuild the info from `to_metadata`'s values; unknown keys are ignored.

        The values may come from an untrusted file. A CRS that PROJ cannot parse is kept as a
        string: it must not prevent reading the heights, and `rasterio_crs` warns about it.
        """
        try:
            dtype = fields["dtype"]
            if dtype not in SUPPORTED_DTYPES:
                raise ValueError(f"dtype is {str(dtype)[:40]!r}")
            mask_kind = fields.get("mask_kind", "none")
            if mask_kind not in ("none", "nodata", "nan", "mask"):
                raise ValueError(f"mask_kind is {str(mask_kind)[:40]!r}")
            transform = tuple(_finite(value) for value in fields.get("transform", IDENTITY))
            if len(transform) != 6:
                raise ValueError(f"transform has {len(transform)} numbers, expected 6")
            nodata = _number_from_plain(fields.get("nodata"))
            if nodata is not None:
                nodata, problem = fit_nodata(nodata, np.dtype(dtype))
                if problem:
                    raise ValueError(problem)
            heights_are = fields.get("heights_are")
            texts = {name: _optional_text(fields.get(name)) for name in _TEXTS}
            return cls(
                n_rows=_positive(fields["n_rows"]),
                n_cols=_positive(fields["n_cols"]),
                dtype=dtype,
                nodata=nodata,
                transform=transform,
                scale=_finite(fields.get("scale", 1.0)),
                offset=_finite(fields.get("offset", 0.0)),
                mask_kind=mask_kind,
                tags=_tags(fields.get("tags")),
                band_tags=_tags(fields.get("band_tags")),
                # Readers ignore unknown words (FORMAT.md §4.2).
                heights_are=heights_are if heights_are in KINDS else None,
                coordinate_epoch=_year(fields.get("coordinate_epoch")),
                **texts,
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise CorruptStreamError(f"the raster's metadata are damaged: {error!r}") from error


def _year(value: Any) -> float | None:
    """Return the epoch that a file states; None if it is not a number (FORMAT.md §4.2)."""
    with suppress(ValueError):
        return _finite(value)
    return None


def _number_from_plain(value: Any) -> int | float | None:
    if value is None:
        return None
    if isinstance(value, str):
        if value not in ("nan", "inf", "-inf"):
            raise ValueError(f"nodata is {value[:40]!r}")
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"nodata is a {type(value).__name__}")
    return value


def _finite(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"expected a finite number, found {str(value)[:40]!r}")
    return float(value)


def _positive(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"expected a whole number >= 1, found {str(value)[:40]!r}")
    return value


def _tags(value: Any) -> Tags:
    if value is None:
        return ()
    if not isinstance(value, dict) or not all(isinstance(text, str) for text in value.values()):
        raise TypeError("expected names with texts as tags")
    return tuple(sorted(value.items()))


def _optional_text(value: Any) -> str | None:
    if value is not None and not isinstance(value, str):
        raise TypeError(f"expected text, found a {type(value).__name__}")
    return value


def fit_nodata(nodata: int | float, dtype: np.dtype[Any]) -> tuple[int | float | None, str | None]:
    """Return `nodata` as a value of `dtype`; or None and the reason if it does not fit."""
    if not isinstance(nodata, int | float | np.integer | np.floating):
        return None, f"nodata {str(nodata)[:20]!r} is not a number"
    try:
        value = float(nodata)
    except OverflowError:  # an int of more than 308 digits
        return None, f"nodata {str(nodata)[:20]}… is outside {dtype.name}"
    if dtype.kind == "f":
        limit = float(np.finfo(dtype).max)
        # Half an ulp above the limit still rounds to it: files write float32's limits with few
        # digits.
        if math.isfinite(value) and abs(value) > limit * (1 + 2.0**-25):
            return None, f"nodata {nodata!r} is outside {dtype.name}"
        return value, None
    limits = np.iinfo(dtype)
    if not math.isfinite(nodata) or nodata != int(nodata):
        return None, f"nodata {nodata!r} is not a whole number, the heights are {dtype.name}"
    if not limits.min <= nodata <= limits.max:
        return None, f"nodata {nodata!r} is outside {dtype.name} ({limits.min} to {limits.max})"
    return int(nodata), None


def undeclared_by(
    choice: NodataChoice, declared: Iterable[Any], dtype: np.dtype[Any]
) -> tuple[int | float, ...]:
    """Return the declared nodata values that `nodata` turns into heights; NaN stays void."""
    if choice.keeps_declared or dtype.name not in SUPPORTED_DTYPES:
        return ()
    fitting = (fit_nodata(value, dtype)[0] for value in declared if value is not None)
    found = dict.fromkeys(value for value in fitting if value is not None and value == value)
    # A value that does not fit is refused later.
    kept = None if choice.value is None else fit_nodata(choice.value, dtype)[0]
    return tuple(value for value in found if kept is None or not is_same_value(value, kept, dtype))


def is_same_value(one: int | float, other: int | float, dtype: np.dtype[Any]) -> bool:
    if math.isnan(one) or math.isnan(other):
        return math.isnan(one) and math.isnan(other)
    return bool(stored_nodata(one, dtype) == stored_nodata(other, dtype))


def stored_nodata(nodata: int | float, dtype: np.dtype[Any]) -> Any:
    with np.errstate(over="ignore", under="ignore"):
        value = np.float64(nodata).astype(dtype) if dtype.kind == "f" else dtype.type(nodata)
    if dtype.kind == "f" and math.isfinite(nodata) and not np.isfinite(value):
        return np.copysign(np.finfo(dtype).max, value)
    return value


class EarlierFile(NamedTuple):
    """A file that heights went through, and its bound from their original, in physical units."""

    file: str
    max_error: float


class EarlierLoss(NamedTuple):
    """Bound of heights from their original by the last of some files, in physical units."""

    max_error: float
    files: tuple[EarlierFile, ...] = ()


NO_LOSS = EarlierLoss(0.0)


def earlier_files(metadata: Mapping[str, object]) -> tuple[EarlierFile, ...]:
    found = metadata.get(EARLIER)
    files = found if isinstance(found, list) else []
    return tuple(
        EarlierFile(file["file"], float(file["max_error"]))
        for file in files
        if isinstance(file, dict)
        and isinstance(file.get("file"), str)
        and isinstance(file.get("max_error"), int | float)
    )


# Limit in UTF-8 bytes of the names and values of one set: files open with one short read.
_MOST_BYTES = 16 << 10
# Usual colours of bands; an alpha or a palette would have another meaning in the output.
PLAIN_COLORS = ("gray", "undefined", "alpha", "palette")
# A domain that GDAL's commands do not copy. They copy plain tags to rasters that were resampled or
# computed, for which a bound does not hold.
DOMAIN = "TERRAINWAVE"
# Stored in a field of its own; statistics were computed before heights were rounded.
_OWN = "AREA_OR_POINT"
_MEASURED = "STATISTICS_"
# Names that rasterio's `update_tags` uses for its own arguments.
_RESERVED = ("ns", "bidx")


class KeptTags(NamedTuple):
    """Kept tags, and the names of those that are too long or not text."""

    kept: Tags
    left_out: tuple[str, ...]


def select_tags(tags: Mapping[str, str]) -> KeptTags:
    sizes = {name: _size(name) + _size(value) for name, value in writable_tags(tags.items())}
    kept, room = [], _MOST_BYTES
    for name in sorted(sizes, key=lambda name: (sizes[name], name)):
        if sizes[name] <= room:
            room -= sizes[name]
            kept.append((name, tags[name]))
    names = {name for name, _ in kept}
    left_out = (name for name in tags if name not in names and not _is_own(name))
    return KeptTags(tuple(sorted(kept)), tuple(left_out))


def common_tags(sets: Iterable[Tags]) -> Tags:
    first, *others = map(set, sets)
    return tuple(sorted(first.intersection(*others)))


def writable_tags(tags: Iterable[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """Yield the tags that GDAL can write; those of an untrusted file may be any text."""
    for name, value in tags:
        is_text = all(_size(text) >= 0 and "\0" not in text for text in (name, value))
        if name and "=" not in name and name not in _RESERVED and is_text and not _is_own(name):
            yield name, value


def is_statistic(name: str) -> bool:
    return name.upper().startswith(_MEASURED)


def _is_own(name: str) -> bool:
    return name.upper() == _OWN or is_statistic(name)


def _size(text: str) -> int:
    """Return the UTF-8 bytes of a text; -1 if it is not text."""
    try:
        return len(text.encode())
    except UnicodeEncodeError:
        return -1
