"""Vertical units: what they are, where they are told, and how many metres they have."""

import warnings
from typing import NamedTuple

from terrainwave.errors import TerrainwaveWarning
from terrainwave.place.description import Vertical, describe_quietly

_SURVEY_FOOT = 1200 / 3937
_METRES = {
    "m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0,
    "cm": 0.01, "centimetre": 0.01, "centimetres": 0.01, "centimeter": 0.01, "centimeters": 0.01,
    "dm": 0.1, "mm": 0.001, "km": 1000.0, "kilometre": 1000.0, "kilometer": 1000.0,
    "ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "international foot": 0.3048,
    "ftus": _SURVEY_FOOT, "us-ft": _SURVEY_FOOT, "us survey foot": _SURVEY_FOOT,
    "us survey feet": _SURVEY_FOOT, "foot_us": _SURVEY_FOOT, "us_survey_foot": _SURVEY_FOOT,
    "survey foot": _SURVEY_FOOT, "foot (us survey)": _SURVEY_FOOT, "sftus": _SURVEY_FOOT,
    "yd": 0.9144, "yard": 0.9144,
}  # fmt: skip
BAND, CRS = "band", "CRS"


class HeightUnit(NamedTuple):
    """The unit of heights.

    Parameters
    ----------
    name : str or None
        None where nobody names it.
    source : {"band", "CRS"} or None
        Who does.
    metres : float
        Per unit; negative where the CRS counts depths, so that the product always goes up.
    of_crs : str or None
        What the CRS says instead, where the band says something else.
    """

    name: str | None
    source: str | None
    metres: float
    of_crs: str | None = None


def height_unit(units: str | None, crs_text: str | None) -> HeightUnit:
    """Return the unit of heights: the band's, else that of the CRS's vertical axis, else metres.

    Parameters
    ----------
    units : str, optional
        What the band says.
    crs_text : str, optional

    Notes
    -----
    An unknown name is warned of and taken for metres.
    """
    vertical = vertical_of(crs_text)
    sign = -1.0 if vertical is not None and vertical.is_down else 1.0
    name = units.strip() if units else ""
    if not name:
        if vertical is None:
            return HeightUnit(None, None, 1.0)
        return HeightUnit(vertical.unit, CRS, sign * vertical.metres)
    if vertical is not None and name.lower() == vertical.unit.lower():
        return HeightUnit(name, BAND, sign * vertical.metres)
    metres = metres_per_unit(name)
    differs = vertical is not None and abs(metres / vertical.metres - 1) > 1e-9
    return HeightUnit(name, BAND, sign * metres, vertical.unit if vertical and differs else None)


def vertical_of(crs_text: str | None) -> Vertical | None:
    """Return the vertical part of a CRS, if it has one."""
    description = describe_quietly(crs_text)
    return None if description is None else description.vertical


def metres_per_unit(units: str | None) -> float:
    """Return the metres of one vertical unit; 1 where it is not told, or (warned) not known."""
    if units is None or not units.strip():
        return 1.0
    name = " ".join(units.lower().replace("[", " ").replace("]", " ").split())
    if name not in _METRES:
        warnings.warn(
            f"the vertical unit {units!r} is not known and taken for metres",
            TerrainwaveWarning,
            stacklevel=2,
        )
    return _METRES.get(name, 1.0)


def unit_text(units: str | None) -> str:
    """Return a vertical unit as labels have it."""
    return units.strip() if units and units.strip() else "unit unknown"
