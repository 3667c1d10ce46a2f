"""Meaning of a raster's numbers: heights, depths, or distances from the centre of a body.

`told_by` reads marks and names, `settled_kind` compares them with the numbers.
"""

import re
from collections.abc import Mapping
from typing import NamedTuple

from terrainwave.arguments import shown
from terrainwave.errors import InvalidArgumentError
from terrainwave.place.description import describe_quietly

HEIGHT, DEPTH, RADIUS = "height", "depth", "radius"
KINDS = (HEIGHT, DEPTH, RADIUS)
PLURALS = {HEIGHT: "heights", DEPTH: "depths", RADIUS: "radii"}
# The attribute of the CF conventions, and its values.
POSITIVE, UP, DOWN = "positive", "up", "down"
# What of an array's attributes a file keeps for that.
MARKS = (POSITIVE, "standard_name")
# Of the CF conventions, of which "depth_below_geoid" is one. Others that have "depth" in them are
# thicknesses or lie below the ground, such as the depth of snow, soil, or the water table.
_STANDARD_NAMES = re.compile(r"depth|depth_below_geoid|sea_?floor_depth(_below_\w+)?")
_VARIABLES = re.compile(r"depths?|deptho|(sea_?floor|seabed|sea_bed)_depth(_below_\w+)?")
# Titles, of which only plain ones count.
_SEA = r"sea[ _-]?(floor|bed|level|surface)|seafloor|ocean floor|geoid|chart datum"
_TITLES = re.compile(
    rf"((sea[ _-]?(floor|bed)|ocean floor) )?depths?( (below|under) .*({_SEA}).*)?"
    r"( [(\[](m|metres?|meters?)[)\]])?"
)
# What depths are of that are no terrain: that of a flood is above the ground, not below it.
_OTHER_WORDS = re.compile(
    r"water|flood|inundat|snow|ice\b|frost|soil|bedrock|root|layer|thick|active|optical|burial"
    r"|height|elevation|altitude"
)
# Formats of hydrographers: GDAL's drivers name bands by what they are. That of S-102 gives depths,
# or on request elevations; that of BAG elevations, also where the CRS has an axis downwards.
_NAMING_DRIVERS = ("BAG", "S102")
# Of the body's radius: how far radii may be from it, and how small a body may be, metres.
_RADIUS_SHARE, _LEAST_BODY = 0.1, 100_000.0


class Told(NamedTuple):
    """Meaning that marks and names give to the numbers.

    Parameters
    ----------
    kind : {"height", "depth"} or None
        ``height`` only where that is said against the CRS's vertical axis.
    by : str
        What says so, in few words.
    is_name : bool
        Only a name says it, which other numbers have too.
    note : str
        What contradicts itself, a sentence; else empty.
    """

    kind: str | None = None
    by: str = ""
    is_name: bool = False
    note: str = ""


class Names(NamedTuple):
    """Names of a band or array: variable and title.

    `has_length` is False if its unit is no length. `driver` is GDAL's, of files.
    """

    variable: str | None = None
    title: str | None = None
    has_length: bool = True
    driver: str = ""


def check_kind(heights_are: str | None) -> None:
    """Raise `InvalidArgumentError` unless it is None or one of `KINDS`."""
    if heights_are is not None and heights_are not in KINDS:
        raise InvalidArgumentError(
            f"found `heights_are` {shown(heights_are)}, expected {', '.join(KINDS)}"
        )


def told_by(marks: Mapping[str, str], names: Names, crs_text: str | None) -> Told:
    """Return what attributes or tags, else names, say of the numbers.

    Parameters
    ----------
    marks : mapping
        Attributes of the array, or tags of the band.
    names : Names
    crs_text : str, optional
        Whose vertical axis may go down.
    """
    said = {name.lower(): str(value).strip().lower() for name, value in marks.items()}
    title = " ".join((names.title or "").lower().split())
    positive = said.get(POSITIVE, "")
    by = f"positive: {positive}"
    if positive not in (UP, DOWN) and names.driver in _NAMING_DRIVERS:
        by = f"band {title} of {names.driver}"
        positive = DOWN if title == DEPTH else UP if title.endswith("elevation") else ""
    if positive == DOWN:
        return Told(DEPTH, by)
    told = describe_quietly(crs_text)
    axis = None if told is None else told.vertical
    if axis is None or not axis.is_down:
        if positive == UP:
            return Told(by=by)
        name = _depth_name(said, names, title) if names.has_length else None
        return Told() if name is None else Told(DEPTH, name, is_name=True)
    if positive == UP:
        return Told(
            HEIGHT,
            by,
            note=f"it says {by}, but its CRS counts depths downwards ({axis.name}): the numbers are"
            " taken for heights (choose with `heights_are`)",
        )
    return Told()


def _depth_name(said: Mapping[str, str], names: Names, title: str) -> str | None:
    """Return the name that means depths; a standard name counts before all others."""
    # With a modifier, such as standard_error, it is a quantity of another kind.
    standard_name = said.get("standard_name", "")
    if standard_name:
        is_depth = _STANDARD_NAMES.fullmatch(standard_name)
        return f"standard_name: {standard_name}" if is_depth else None
    title = title or " ".join(said.get("long_name", "").split())
    if _OTHER_WORDS.search(title) and not re.search(_SEA, title):
        return None
    variable = (names.variable or said.get("netcdf_varname", "")).strip()
    if _VARIABLES.fullmatch(variable.lower()):
        return f"name: {variable}"
    return f"name: {title}" if _TITLES.fullmatch(title) else None


class Settled(NamedTuple):
    """Meaning that a file stores, and a note for the user."""

    kind: str | None
    note: str = ""


def settled_kind(
    told: Told, crs_text: str | None, metres: tuple[float, float], *, is_mostly_negative: bool
) -> Settled:
    """Return the meaning of the numbers, from marks, names and their values.

    Parameters
    ----------
    told : Told
    crs_text : str, optional
    metres : (low, high)
        Of all valid numbers, without a sign turned.
    is_mostly_negative : bool
    """
    if told.kind == DEPTH and told.is_name and is_mostly_negative:
        return Settled(
            None,
            f"its {told.by} means depths, but most numbers are below 0: they are taken for heights"
            " (choose with `heights_are`)",
        )
    if told.kind == DEPTH:
        return Settled(
            DEPTH,
            f"its numbers are depths ({told.by}), stored as they are; on the globe, in meshes and"
            " views a depth of 10 becomes a height of -10 (choose with `heights_are`)",
        )
    if told.kind is not None:
        return Settled(told.kind, told.note)
    body = describe_quietly(crs_text)
    radius = 0.0 if body is None else body.radius or 0.0
    if radius > _LEAST_BODY and all(abs(end - radius) <= _RADIUS_SHARE * radius for end in metres):
        return Settled(
            RADIUS,
            f"its numbers are near the radius of the body, {radius:,.10g} m, and taken for radii,"
            " stored as they are; on the globe, in meshes and views heights are what they have"
            " beyond it (choose with `heights_are`)",
        )
    return Settled(None)
