"""Vertical units: what they are, where they are told, and how many metres they have."""

import warnings
from typing import NamedTuple

from terrainwave.errors import TerrainwaveWarning
from terrainwave.place.description import Vertical, describe_quietly
from terrainwave.place.meaning import DEPTH, HEIGHT, PLURALS, RADIUS, Told

_SURVEY_FOOT = 1200 / 3937
_METRES = {
    "m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0,
    "cm": 0.01, "centimetre": 0.01, "centimetres": 0.01, "centimeter": 0.01, "centimeters": 0.01,
    "dm": 0.1, "decimetre": 0.1, "decimetres": 0.1, "decimeter": 0.1, "decimeters": 0.1,
    "mm": 0.001, "millimetre": 0.001, "millimetres": 0.001, "millimeter": 0.001,
    "millimeters": 0.001,
    "km": 1000.0, "kilometre": 1000.0, "kilometres": 1000.0, "kilometer": 1000.0,
    "kilometers": 1000.0,
    "ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "international foot": 0.3048,
    "international feet": 0.3048, "foot (international)": 0.3048,
    "ftus": _SURVEY_FOOT, "us-ft": _SURVEY_FOOT, "us survey foot": _SURVEY_FOOT,
    "us survey feet": _SURVEY_FOOT, "foot_us": _SURVEY_FOOT, "us_survey_foot": _SURVEY_FOOT,
    "survey foot": _SURVEY_FOOT, "survey feet": _SURVEY_FOOT, "foot (us survey)": _SURVEY_FOOT,
    "feet (us survey)": _SURVEY_FOOT, "us foot": _SURVEY_FOOT, "us feet": _SURVEY_FOOT,
    "ft (us)": _SURVEY_FOOT, "sftus": _SURVEY_FOOT,
    "yd": 0.9144, "yard": 0.9144, "yards": 0.9144,
    "fathom": 1.8288, "fathoms": 1.8288,
}  # fmt: skip
# What drivers write where no unit is known.
_NO_UNIT = ("unspecified", "unknown", "undefined", "none")
BAND, CRS = "band", "CRS"
# Relative: the survey foot has several roundings, and differs from the foot by 2e-6.
_SAME_UNIT = 1e-7


class HeightUnit(NamedTuple):
    """The unit of heights.

    Parameters
    ----------
    name : str or None
        None where nobody names it.
    source : {"band", "CRS"} or None
        Who does.
    vertical : Vertical or None
        What the CRS says.
    kind : {"height", "depth", "radius"} or None
        What the numbers are; None where only the CRS tells it.
    """

    name: str | None
    source: str | None
    vertical: Vertical | None
    kind: str | None = None

    @property
    def metres(self) -> float:
        """Return the metres per unit, negative where the numbers are depths: up is positive.

        A name that is not known is warned of and taken for metres.
        """
        vertical = self.vertical
        sign = -1.0 if self.is_depth else 1.0
        if vertical is not None and (self.source == CRS or self._is_the_same_name):
            return sign * vertical.metres
        return sign * metres_per_unit(self.name)

    @property
    def is_depth(self) -> bool:
        """Say whether the numbers are depths: a mark and the CRS together turn them once."""
        if self.kind is not None:
            return self.kind == DEPTH
        return self.vertical is not None and self.vertical.is_down

    @property
    def word(self) -> str:
        """Return what a number is: a ``height``, ``depth`` or ``radius``."""
        return DEPTH if self.is_depth else self.kind or HEIGHT

    @property
    def is_radius(self) -> bool:
        """Say whether the numbers are distances from the centre of the body."""
        return self.kind == RADIUS

    def note_kind(self) -> None:
        """Warn where numbers are depths, which are turned to go down, or radii."""
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
        """Return the CRS's unit where the band names another one."""
        if self.source != BAND or self.vertical is None or self._is_the_same_name:
            return None
        metres = _METRES.get(_plain(self.name or ""))
        is_same = metres is not None and abs(metres / self.vertical.metres - 1) < _SAME_UNIT
        return None if is_same else self.vertical.unit

    @property
    def _is_the_same_name(self) -> bool:
        other = None if self.vertical is None else self.vertical.unit
        return other is not None and _plain(other) == _plain(self.name or "")


def height_unit(
    units: str | None, crs_text: str | None, heights_are: str | None = None
) -> HeightUnit:
    """Return the unit of heights: the band's, else that of the CRS's vertical axis.

    Parameters
    ----------
    units : str, optional
        What the band says.
    crs_text : str, optional
    heights_are : {"height", "depth", "radius"}, optional
        As `RasterInfo` has it.
    """
    vertical = vertical_of(crs_text)
    if units and units.strip() and _plain(units) not in _NO_UNIT:
        return HeightUnit(units.strip(), BAND, vertical, heights_are)
    if vertical is not None and vertical.unit != "unknown":
        return HeightUnit(vertical.unit, CRS, vertical, heights_are)
    return HeightUnit(None, None, vertical, heights_are)


def kind_name(heights_are: str | None, crs_text: str | None) -> str:
    """Return what numbers are, in a word: ``heights``, ``depths`` or ``radii``."""
    return PLURALS[height_unit(None, crs_text, heights_are).word]


def kind_problem(
    own: tuple[str | None, Told, str | None], other: tuple[Told, str | None]
) -> str | None:
    """Return what is wrong where a raster has depths and a file heights, or the other way round.

    Nothing is where the file has what its own tags do not say: who made it chose that.

    Parameters
    ----------
    own : (heights_are, what its tags say, CRS)
        Of the file.
    other : (what it says, CRS)
        Of the raster.
    """
    heights_are, told, crs_text = own
    found = kind_name(other[0].kind, other[1])
    kinds = [kind_name(kind, crs_text) for kind in (heights_are, told.kind)]
    if any((kind == PLURALS[DEPTH]) == (found == PLURALS[DEPTH]) for kind in kinds):
        return None
    by = f" ({other[0].by})" if other[0].kind else ""
    return f"found {found}{by}, the file has {kinds[0]}"


def vertical_of(crs_text: str | None) -> Vertical | None:
    """Return the vertical part of a CRS, if it has one."""
    description = describe_quietly(crs_text)
    return None if description is None else description.vertical


def metres_per_unit(units: str | None) -> float:
    """Return the metres of one vertical unit; 1 where it is not told, or (warned) not known."""
    if units is None or not units.strip():
        return 1.0
    name = _plain(units)
    if name not in _METRES:
        warnings.warn(
            f"the vertical unit {units!r} is not known and taken for metres",
            TerrainwaveWarning,
            stacklevel=2,
        )
    return _METRES.get(name, 1.0)


def is_length(units: str | None) -> bool:
    """Say whether a unit is a length that is known, or nobody names one."""
    return not units or _plain(units) in (*_METRES, *_NO_UNIT)


def _plain(units: str) -> str:
    return " ".join(units.lower().replace("[", " ").replace("]", " ").replace(".", "").split())


def unit_text(units: str | None) -> str:
    """Return a vertical unit as labels have it."""
    return units.strip() if units and units.strip() else "unit unknown"
