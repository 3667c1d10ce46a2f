"""Vertical units: their names, their origin, and their metres."""

import math
import re
import warnings
from typing import NamedTuple

from terrainwave.errors import TerrainwaveWarning
from terrainwave.place.description import Vertical, describe_quietly
from terrainwave.place.meaning import DEPTH, HEIGHT, PLURALS, RADIUS, Told

_FOOT, _SURVEY_FOOT = 0.3048, 1200 / 3937
# Keys as `_plain` writes them; longer words without a plural s.
_METRES = {
    "m": 1.0, "metre": 1.0, "meter": 1.0, "masl": 1.0, "mamsl": 1.0,
    "dm": 0.1, "decimetre": 0.1, "decimeter": 0.1,
    "cm": 0.01, "centimetre": 0.01, "centimeter": 0.01,
    "mm": 0.001, "millimetre": 0.001, "millimeter": 0.001,
    "µm": 1e-6, "um": 1e-6, "micrometre": 1e-6, "micrometer": 1e-6, "micron": 1e-6,
    "dam": 10.0, "decametre": 10.0, "decameter": 10.0,
    "hm": 100.0, "hectometre": 100.0, "hectometer": 100.0,
    "km": 1000.0, "kilometre": 1000.0, "kilometer": 1000.0,
    "in": 0.0254, "inch": 0.0254, "inches": 0.0254,
    "ft": _FOOT, "foot": _FOOT, "feet": _FOOT,
    "international foot": _FOOT, "international feet": _FOOT, "intl foot": _FOOT,
    "foot (international)": _FOOT, "feet (international)": _FOOT,
    "foot international": _FOOT, "feet international": _FOOT,
    "ftus": _SURVEY_FOOT, "usft": _SURVEY_FOOT, "us ft": _SURVEY_FOOT, "ft us": _SURVEY_FOOT,
    "us survey foot": _SURVEY_FOOT, "us survey feet": _SURVEY_FOOT, "foot us": _SURVEY_FOOT,
    "survey foot": _SURVEY_FOOT, "survey feet": _SURVEY_FOOT, "foot (us survey)": _SURVEY_FOOT,
    "feet (us survey)": _SURVEY_FOOT, "us foot": _SURVEY_FOOT, "us feet": _SURVEY_FOOT,
    "ft (us)": _SURVEY_FOOT, "foot (us)": _SURVEY_FOOT, "feet (us)": _SURVEY_FOOT,
    "sftus": _SURVEY_FOOT,
    "yd": 0.9144, "yard": 0.9144,
    "fathom": 1.8288,
    "mile": 1609.344, "mi": 1609.344, "nautical mile": 1852.0, "nmi": 1852.0,
}  # fmt: skip
# Letters of words that an s would change: ms are not metres.
_SHORT = 3
# Reference surfaces that may follow a length. Depths are below, which is not a unit.
_REFERENCE = re.compile(
    r" (?:above|over|asl|amsl|msl|agl|hae|ahd|odn|nap|nhn|nn|(?:navd|ngvd|egm) ?\d*)\b.*"
    r"| \((?!per\b)[^/()^-]*\)$"
)
_HYPHEN = re.compile(r"(?<=[a-z])-(?=[a-z])")
# Drivers' texts for an unknown unit.
_NO_UNIT = ("unspecified", "unknown", "undefined", "none", "n/a", "-")
BAND, CRS = "band", "CRS"
# Relative: the survey foot has several roundings, and differs from the foot by 2e-6.
_SAME_UNIT = 1e-7


class HeightUnit(NamedTuple):
    """Unit of heights: its name, if it has one, and where that is from (`BAND` or `CRS`).

    `vertical` is the vertical axis of the CRS, `kind` one of `meaning.KINDS`, or None if only the
    CRS states the meaning of the numbers.
    """

    name: str | None
    source: str | None
    vertical: Vertical | None
    kind: str | None = None

    @property
    def metres(self) -> float:
        """Return the metres per unit, negative for depths; a warning for an unknown name."""
        sign = -1.0 if self.is_depth else 1.0
        length = self.length
        return sign * (metres_per_unit(self.name) if length is None else length)

    @property
    def length(self) -> float | None:
        """Return the metres per unit, without sign; None if it is not named, or not a length."""
        vertical = self.vertical
        if vertical is not None and (self.source == CRS or self._is_the_same_name):
            return vertical.metres
        return None if self.name is None else _length(self.name)

    @property
    def is_depth(self) -> bool:
        if self.kind is not None:
            return self.kind == DEPTH
        return self.vertical is not None and self.vertical.is_down

    @property
    def word(self) -> str:
        return DEPTH if self.is_depth else self.kind or HEIGHT

    @property
    def is_radius(self) -> bool:
        return self.kind == RADIUS

    def note_kind(self) -> None:
        if self.is_radius:
            words = "the numbers are radii; heights are what they have beyond the body's own radius"
        elif not self.is_depth:
            return
        else:
            told = "the file says that its numbers are depths"
            if self.kind is None and self.vertical is not None:
                name = self.vertical.name
                told = f"the coordinate reference system counts depths downwards ({name})"
            words = f"{told}; a depth of 10 becomes a height of -10"
        warnings.warn(words, TerrainwaveWarning, stacklevel=3)

    @property
    def of_crs(self) -> str | None:
        if self.source != BAND or self.vertical is None or self._is_the_same_name:
            return None
        return None if _is_same(self.length, self.vertical.metres) else self.vertical.unit

    @property
    def _is_the_same_name(self) -> bool:
        other = None if self.vertical is None else self.vertical.unit
        return other is not None and _plain(other) == _plain(self.name or "")


def height_unit(
    units: str | None, crs_text: str | None, heights_are: str | None = None
) -> HeightUnit:
    """Return the unit of heights: the band's, else that of the CRS's vertical axis."""
    vertical = vertical_of(crs_text)
    if units and units.strip() and _plain(units) not in _NO_UNIT:
        return HeightUnit(units.strip(), BAND, vertical, heights_are)
    if vertical is not None and vertical.unit != "unknown":
        return HeightUnit(vertical.unit, CRS, vertical, heights_are)
    return HeightUnit(None, None, vertical, heights_are)


def kind_name(heights_are: str | None, crs_text: str | None) -> str:
    return PLURALS[height_unit(None, crs_text, heights_are).word]


def kind_problem(
    own: tuple[str | None, Told, str | None], other: tuple[Told, str | None]
) -> str | None:
    """Return the problem if a raster and a file have two of heights, depths and radii.

    None if the file's meaning is not that of its own tags and numbers: its maker chose it. A name
    that was not trusted then only counts against other names. `own` are the file's `heights_are`,
    kind by its tags or numbers, and CRS; `other` are the raster's kind and CRS.
    """
    heights_are, told, crs_text = own
    found = kind_name(other[0].kind, other[1])
    kinds = [kind_name(heights_are, crs_text)]
    if other[0].is_name or not told.is_name:
        kinds.append(kind_name(told.kind, crs_text))
    if found in kinds:
        return None
    by = f" ({other[0].by})" if other[0].kind else ""
    return f"found {found}{by}, the file has {kinds[0]}"


def in_metres(
    ends: tuple[float, float], scale: float, offset: float, units: str | None, crs_text: str | None
) -> tuple[float, float]:
    """Return the lowest and the highest stored number in metres; NaN if the unit is no length."""
    unit = math.nan
    if is_length(units):
        unit = abs(height_unit(units, crs_text).metres)
    low, high = sorted((end * scale + offset) * unit for end in ends)
    return low, high


class Meeting(NamedTuple):
    """Why heights of two sources cannot be combined, and what to do; or an assumption to note."""

    problem: str = ""
    note: str = ""


def meeting(name: str, found: HeightUnit, other_name: str, other: HeightUnit) -> Meeting:
    """Return the consequence of combining heights of `name` with those of `other_name`.

    Spellings of units with the same length are equal. Nothing is converted: conversion rounds
    heights, which would be within the bound of other heights than the given ones.
    """
    if found.name is None and other.name is None:
        return Meeting()
    if found.name is None:
        return Meeting(note=_note_on(name, other_name, other.name))
    if other.name is None:
        return Meeting(note=_note_on(other_name, name, found.name))
    if _is_same(found.length, other.length) or _plain(found.name) == _plain(other.name):
        return Meeting()
    problem = f"{name}: found heights in {found.name}, {other_name} has {other.name}; expected one"
    rename = f'gdal_edit -units "{other.name}"'
    if found.length is None or other.length is None:
        return Meeting(
            f"{problem} unit: if both mean the same, name it alike, for example {rename}"
        )
    factor = found.length / other.length
    return Meeting(
        f"{problem} unit: convert the heights first, for example gdal_calc"
        f' --calc "A*{factor:.12g}", then {rename}'
    )


def _note_on(name: str, other_name: str, unit: str | None) -> str:
    return f"{name}: no unit of heights is named; taken for {unit}, as {other_name} has"


def vertical_of(crs_text: str | None) -> Vertical | None:
    description = describe_quietly(crs_text)
    return None if description is None else description.vertical


def metres_per_unit(units: str | None) -> float:
    """Return the metres of one vertical unit; 1 if it is missing, or (with a warning) unknown."""
    if units is None or not units.strip():
        return 1.0
    length = _length(units)
    if length is None:
        warnings.warn(
            f"the vertical unit {units!r} is not known and taken for metres",
            TerrainwaveWarning,
            stacklevel=2,
        )
    return 1.0 if length is None else length


def _length(name: str) -> float | None:
    name = _plain(name)
    for words in (name, _REFERENCE.sub("", name)):
        singular = words.removesuffix("s") if len(words) > _SHORT else words
        for spelling in (words, singular):
            if spelling in _METRES:
                return _METRES[spelling]
    return None


def _is_same(length: float | None, other: float | None) -> bool:
    return length is not None and other is not None and abs(length / other - 1) < _SAME_UNIT


def is_length(units: str | None) -> bool:
    unit = height_unit(units, None)
    return unit.name is None or unit.length is not None


def _plain(units: str) -> str:
    for mark, plain in (("[", " "), ("]", " "), ("_", " "), (".", ""), ("\u03bc", "\u00b5")):
        units = units.replace(mark, plain)
    return " ".join(_HYPHEN.sub(" ", units.lower()).split())


def unit_text(units: str | None) -> str:
    return units.strip() if units and units.strip() else "unit unknown"
