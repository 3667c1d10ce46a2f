"""Meaning of a raster's numbers: heights, depths, or distances from the centre of a body.

`told_by` reads metadata and names, `settled_kind` compares them with the numbers.
"""

import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from terrainwave.arguments import shown
from terrainwave.errors import InvalidArgumentError
from terrainwave.place.description import describe_quietly

HEIGHT, DEPTH, RADIUS = "height", "depth", "radius"
KINDS = (HEIGHT, DEPTH, RADIUS)
PLURALS = {HEIGHT: "heights", DEPTH: "depths", RADIUS: "radii"}
POSITIVE, UP, DOWN = "positive", "up", "down"
MARKS = (POSITIVE, "standard_name")
# Names of the CF conventions, such as "depth_below_geoid". Other names with "depth" mean
# thicknesses or depths below the ground, such as those of snow, soil, or the water table.
_STANDARD_NAMES = re.compile(r"depth|depth_below_geoid|sea_?floor_depth(_below_\w+)?")
_VARIABLES = re.compile(r"depths?|deptho|(sea_?floor|seabed|sea_bed)_depth(_below_\w+)?")
_SEA = r"sea[ _-]?(floor|bed|level|surface)|seafloor|ocean floor|geoid|chart datum"
_TITLES = re.compile(
    rf"((sea[ _-]?(floor|bed)|ocean floor) )?depths?( (below|under) .*({_SEA}).*)?"
    r"( [(\[](m|metres?|meters?)[)\]])?"
)
# Depths that are not terrain: a flood's depth is above the ground, not below it.
_OTHER_WORDS = re.compile(
    r"water|flood|inundat|snow|ice\b|frost|soil|bedrock|root|layer|thick|active|optical|burial"
    r"|height|elevation|altitude"
)
# Hydrographic formats: GDAL's drivers name bands by their contents. The driver of S-102 gives
# depths, or on request elevations; that of BAG elevations, even if the CRS has an axis downwards.
_NAMING_DRIVERS = ("BAG", "S102")
# Share of the body's radius by which radii may differ from it, and the smallest body in metres.
_RADIUS_SHARE, _LEAST_BODY = 0.1, 100_000.0


class Told(NamedTuple):
    """Meaning of the numbers by metadata and names.

    `kind` is one of `KINDS`, ``height`` only if that contradicts the CRS's vertical axis; `by` its
    source in few words, `is_name` if that is only a name, which other numbers may have too; `note`
    a contradiction in the metadata, as a sentence.
    """

    kind: str | None = None
    by: str = ""
    is_name: bool = False
    note: str = ""


class Names(NamedTuple):
    """Names of a band or array; `has_length`: its unit is a length; `driver`: GDAL's, for files."""

    variable: str | None = None
    title: str | None = None
    has_length: bool = True
    driver: str = ""


def check_kind(heights_are: str | None) -> None:
    if heights_are is not None and heights_are not in KINDS:
        raise InvalidArgumentError(
            f"found `heights_are` {shown(heights_are)}, expected {', '.join(KINDS)}"
        )


def told_by(marks: Mapping[str, str], names: Names, crs_text: str | None) -> Told:
    """Return the meaning of the numbers by attributes or tags, else by names."""
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
    """Return the meaning of the numbers, by metadata, names and their values.

    `metres` is the range of all valid numbers, with their original sign.
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
    radius = _radius_of_body(crs_text)
    if are_radii(crs_text, [metres]):
        return Settled(
            RADIUS,
            f"its numbers are near the radius of the body, {radius:,.10g} m, and taken for radii,"
            " stored as they are; on the globe, in meshes and views heights are what they have"
            " beyond it (choose with `heights_are`)",
        )
    if any(_is_near(end, radius) for end in metres):
        return Settled(
            None,
            f"only some of its numbers are near the radius of the body, {radius:,.10g} m: all are"
            " taken for heights; if the others mark voids, declare them with `nodata` (or choose"
            " with `heights_are`)",
        )
    return Settled(None)


def are_radii(crs_text: str | None, metres: Iterable[tuple[float, float]]) -> bool | None:
    """Return whether all numbers are near the radius of the CRS's body; None without any.

    `metres` are the ranges of parts of the raster; read up to the first part with other numbers.
    """
    radius, found = _radius_of_body(crs_text), None
    if not radius:
        return False
    for ends in metres:
        found = all(_is_near(end, radius) for end in ends)
        if not found:
            break
    return found


def by_numbers(
    told: Told, crs_text: str | None, metres: Iterable[tuple[float, float]]
) -> Told | None:
    """Return the meaning of numbers, told or by all of them (`are_radii`); None without any."""
    if told.kind is not None:
        return told
    found = are_radii(crs_text, metres)
    if found is None:
        return None
    return Told(RADIUS, "near the radius of the body") if found else told


def may_have_radii(crs_text: str | None, metres: tuple[float, float]) -> bool:
    """Return whether a number between two ends can be near the radius of the CRS's body."""
    radius = _radius_of_body(crs_text)
    low, high = metres
    share = _RADIUS_SHARE * radius
    return radius > 0 and low <= radius + share and high >= radius - share


def _is_near(metres: float, radius: float) -> bool:
    return radius > 0 and abs(metres - radius) <= _RADIUS_SHARE * radius


def _radius_of_body(crs_text: str | None) -> float:
    body = describe_quietly(crs_text)
    radius = 0.0 if body is None else body.radius or 0.0
    return radius if radius > _LEAST_BODY else 0.0
