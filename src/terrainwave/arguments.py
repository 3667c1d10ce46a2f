"""Checks of arguments that several functions share."""

import math
import numbers
import os
import unicodedata
from collections.abc import Iterable, Sequence
from contextlib import suppress
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from terrainwave.errors import InvalidArgumentError
from terrainwave.names import EFFORTS

# Cells on a side of a block.
BLOCKS = (32, 64, 128, 256, 512, 1024)

# Endings of the names of output files, by kind.
TWZ_ENDINGS = (".twz",)
GEOTIFF_ENDINGS = (".tif", ".tiff")
HEIGHT_TILE_ENDINGS = (".r16", ".png")
# Samples on a side of a height tile: 2ⁿ + 1 up to this.
MAX_TILE_SIZE = 16385
# Which samples of a coarse level are void (`Terrain.read`).
VOIDS = EXACT, ANY = "exact", "any"
# How damaged blocks are handled.
ON_ERROR = RAISE, MASK = "raise", "mask"
# How voids of a height tile are filled if no height is given.
FILLINGS = ("lowest", "fill")
PICTURE_ENDINGS = (".png",)
ARCHIVE_ENDING = ".pmtiles"

# Longer ones are WKT, whose name is its first quoted string.
_LONGEST_CODE = 40
# Characters of a wrong value that a message shows.
_LONGEST_VALUE = 60


def check_ending(
    path: str | os.PathLike[str], endings: Sequence[str], *, or_url: bool = False
) -> None:
    """Raise if a target's name has the ending of another kind of file.

    This protects a raster that was given as the last of several sources, and the files of other
    programs.
    """
    if not or_url:
        check_local(path)
    name = path_in_url(checked_path(path))
    ending = Path(name).suffix
    if ending.lower() not in endings:
        raise InvalidArgumentError(
            f"{name}: found {ending or 'no extension'}, expected a name that ends in"
            f" {one_of(endings)}"
        )


def check_local(target: str | os.PathLike[str]) -> None:
    """Raise if a target is a URL: used as a path it would name folders of this machine."""
    name = checked_path(target)
    if "://" in name:
        raise InvalidArgumentError(
            f"found a URL, {name.partition('://')[0]}://…, expected a path: files are written"
            " only to this machine; upload the finished file"
        )


def checked_path(path: object, argument: str | None = None) -> str:
    """Return the name of a file or folder as text.

    Parameters
    ----------
    path : object
        The value given by the user.
    argument : str, optional
        The name of the argument, for messages.
    """
    of = "" if argument is None else f"`{argument}` "
    name = os.fspath(path) if isinstance(path, str | os.PathLike) else None
    if not isinstance(name, str):  # a PathLike may hold bytes
        raise InvalidArgumentError(f"found {of}{shown(path)}, expected a path as text")
    if not name:
        raise InvalidArgumentError(
            f"found {of}'', an empty name, expected that of a file or folder"
        )
    return name


def is_twz_name(name: object) -> bool:
    """Return whether a path or URL ends like a .twz file."""
    if not isinstance(name, str | os.PathLike):
        return False
    return str(path_in_url(os.fspath(name))).lower().endswith(TWZ_ENDINGS)


def path_in_url(name: str) -> str:
    """Return the path of a URL (of a chain: of its first link); a path unchanged."""
    if not isinstance(name, str) or "://" not in name:
        return name
    if name.startswith("zip://"):
        return name.removeprefix("zip://").partition("::")[0]
    return urlsplit(name).path


def in_one_line(text: object) -> str:
    """Return text on one line, without control, format (bidi) and unassigned characters.

    Text from an untrusted file goes through this before a terminal shows it.
    """
    words = " ".join(str(text).split())
    return "".join(char for char in words if not unicodedata.category(char).startswith("C"))


def count_of(number: int, noun: str) -> str:
    """Return a number with its noun: 1 block, 2,000 blocks."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


# How heights on the globe relate to their datum.
AS_IS, ELLIPSOID = "as-is", "ellipsoid"
VERTICAL = (AS_IS, ELLIPSOID)
VERTICAL_HELP = (
    ": used as heights above the ellipsoid without a change (as-is), or converted from the CRS's"
    " vertical datum by PROJ's grid (ellipsoid)."
)
RADIUS_HELP = (
    "Radius of the planet or moon in metres, for coordinates in degrees. Default: the ellipsoid of"
    " the CRS."
)
# Axes of mesh files that may point upwards.
UPWARDS = ("y", "z")
# Each level of detail may have twice the error of the one before: no mesh has detail for more.
MOST_LODS = 16


def size_of(n_bytes: int) -> str:
    """Return a number of bytes with a unit and about three digits: 12.3 GB, 40.0 kB, 7 bytes.

    Two sizes that give the same text differ by at most half a per cent.
    """
    for unit, name in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if n_bytes >= unit:
            return (
                f"{n_bytes / unit:.1f} {name}"
                if n_bytes < 100 * unit
                else (f"{n_bytes / unit:,.0f} {name}")
            )
    return count_of(n_bytes, "byte")


def crs_name(crs: str | None) -> str:
    """Return a short name of a CRS: its code, its name in WKT, or a note that it is missing."""
    if not crs:
        return "no CRS"
    if len(crs) <= _LONGEST_CODE and '"' not in crs:
        return crs
    return crs.split('"')[1] if '"' in crs else crs[:_LONGEST_CODE]


def one_of(words: Sequence[str]) -> str:
    """Return words as a list to choose from: a, b or c."""
    return " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def shown(value: object) -> str:
    """Return a wrong value as messages show it: numbers plain, texts quoted, all on one line.

    Text that reads as a number is marked as text, or the message would show just what it asks for.
    Arrays are shown by their shape, other long values by their type.
    """
    if number_of(value) is not None:
        text = str(value)
    elif isinstance(value, str) and _reads_as_number(value):
        text = f"the text {value!r}"
    elif hasattr(value, "shape") and hasattr(value, "dtype"):
        text = f"an array of shape {value.shape}"
    else:
        text = in_one_line(repr(value))
    kind = type(value).__name__
    short = f"{'an' if kind[:1].lower() in 'aeiou' else 'a'} {kind}"
    return text if 0 < len(text) <= _LONGEST_VALUE else short


def _reads_as_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def number_of(value: object) -> int | float | None:
    """Return a value as a number; None for texts, truth values and anything else.

    NumPy's numbers and arrays without dimensions count as numbers.
    """
    if type(value) is int or type(value) is float:  # the usual case; abstract classes are slow
        return value
    if getattr(value, "shape", None) == () and not getattr(value, "mask", False):
        value = getattr(value, "item", lambda: value)()
    if isinstance(value, bool) or not isinstance(value, numbers.Real | Decimal):
        return None
    if isinstance(value, int):
        return int(value)
    try:
        return float(value)
    except (ValueError, OverflowError):  # Decimal's signalling NaN, a fraction too large
        return math.nan


class NodataChoice(NamedTuple):
    """The argument `nodata`.

    `value` marks voids; without `keeps_declared` the values that a raster declares are heights.
    """

    value: int | float | None = None
    keeps_declared: bool = True


_ONLY = "only:"


def nodata_choice(given: object) -> NodataChoice:
    """Parse `nodata`: None, a number, ``"only:NUMBER"`` or ``"none"``."""
    if given is None:
        return NodataChoice()
    value = None if isinstance(given, str) else number_of(given)
    if value is not None:
        return NodataChoice(value)
    if isinstance(given, str):
        if given == "none":
            return NodataChoice(None, keeps_declared=False)
        if given.startswith(_ONLY):
            for kind in (int, float):
                with suppress(ValueError):
                    return NodataChoice(kind(given.removeprefix(_ONLY)), keeps_declared=False)
    raise InvalidArgumentError(
        f"found `nodata` {shown(given)}, expected a number, or nan, only:NUMBER or none"
    )


def checked_number(
    name: str,
    value: object,
    *,
    least: float = -math.inf,
    above: float = -math.inf,
    most: float = math.inf,
    expected: str = "",
) -> float:
    """Return a finite number as a float.

    Parameters
    ----------
    name : str
        The argument's name in messages.
    value : object
        The value given by the user.
    least, above, most : float
        The number must be >= `least`, > `above` and <= `most`.
    expected : str
        Replaces the description of this range in messages.
    """
    number = number_of(value)
    try:
        given = math.nan if number is None else float(number)
    except OverflowError:  # more than 308 digits
        given = math.inf
    if not (math.isfinite(given) and given >= least and given > above and given <= most):
        if not expected and above > -math.inf:
            expected = f"a finite number > {above:g}"
        raise InvalidArgumentError(
            f"found `{name}` {shown(value)}, expected"
            f" {expected or _in_range('a finite number', least, most)}"
        )
    return given


def checked_whole(
    name: str,
    value: object,
    *,
    least: float = -math.inf,
    most: float = math.inf,
    expected: str = "",
) -> int:
    """Return a whole number as an int; arguments and errors are those of `checked_number`."""
    number = number_of(value)
    if isinstance(number, float) and number.is_integer():
        number = int(number)
    if not isinstance(number, int) or not least <= number <= most:
        raise InvalidArgumentError(
            f"found `{name}` {shown(value)}, expected"
            f" {expected or _in_range('a whole number', least, most)}"
        )
    return number


def checked_tile_size(name: str, value: object) -> int:
    """Return the samples on a side of a height tile; errors are those of `checked_number`."""
    expected = f"2^n + 1 from 3 to {MAX_TILE_SIZE} (such as 1025) or window"
    side = checked_whole(name, value, least=3, most=MAX_TILE_SIZE, expected=expected)
    if (side - 1) & (side - 2):
        raise InvalidArgumentError(f"found `{name}` {side}, expected {expected}")
    return side


def _in_range(kind: str, least: float, most: float) -> str:
    if most == math.inf:
        return kind if least == -math.inf else f"{kind} >= {least:g}"
    return f"{kind}, {least:g} … {most:g}"


def checked_numbers(name: str, values: Any, names: str, *, is_whole: bool = False) -> Any:
    """Return finite numbers as a tuple of floats or of ints, one for each of `names`."""
    taken: list[float] | None = []
    check = checked_whole if is_whole else checked_number
    try:
        taken = [] if isinstance(values, str | bytes) else [check(name, one) for one in values]
    except (TypeError, InvalidArgumentError):  # not iterable, or an item is not a number
        taken = []
    count = names.count(",") + 1
    if len(taken) != count:
        words = {2: "two", 3: "three", 4: "four"}.get(count, count)
        kind = "whole numbers" if is_whole else "finite numbers"
        raise InvalidArgumentError(
            f"found `{name}` {shown(values)}, expected {words} {kind}: {names}"
        )
    return tuple(taken)


def check_choice(name: str, value: object, choices: Iterable[str]) -> None:
    """Raise `InvalidArgumentError` unless the value is one of `choices`."""
    known = list(choices)
    if not isinstance(value, str) or value not in known:
        expected = f"one of {', '.join(known)}" if len(known) > 2 else one_of(known)
        found = repr(value) if isinstance(value, str) else shown(value)
        if number_of(value) is not None:
            # 1.0 and the text '1.0' look alike.
            found, expected = f"the number {found}", one_of([*map(repr, known)])
        raise InvalidArgumentError(f"found `{name}` {found}, expected {expected}")


def checked_error(name: str, error: object) -> float | None:
    """Return a finite error >= 0 as a float, or None."""
    return None if error is None else checked_number(name, error, least=0)


def check_callback(callback: object, name: str = "progress", takes: str = "a Progress") -> None:
    """Raise `InvalidArgumentError` unless the callback is callable or None."""
    if callback is not None and not callable(callback):
        raise InvalidArgumentError(
            f"found `{name}` {shown(callback)}, expected a function that takes {takes}"
        )


def check_vertical(vertical: str) -> bool:
    """Return whether heights must be converted to the ellipsoid."""
    check_choice("vertical", vertical, VERTICAL)
    return vertical == ELLIPSOID


def check_flags(**flags: object) -> None:
    """Raise `InvalidArgumentError` for a flag that is not a bool: text "no" would count as true."""
    for name, value in flags.items():
        # NumPy's truth values are not of type bool; arrays of them are not flags.
        is_numpys = getattr(value, "dtype", None) == "bool" and getattr(value, "shape", None) == ()
        if not isinstance(value, bool) and not is_numpys:
            raise InvalidArgumentError(f"found `{name}` {shown(value)}, expected True or False")


def check_band(band: int, n_bands: int, whose: str) -> None:
    """Raise `InvalidArgumentError` if a raster lacks a band; `whose` names the raster."""
    if not 1 <= band <= n_bands:
        expected = "1" if n_bands == 1 else f"1 … {n_bands}"
        raise InvalidArgumentError(
            f"found `band` {band}, expected {expected}: {whose} has {count_of(n_bands, 'band')}"
        )


def check_effort(effort: str) -> None:
    """Raise `InvalidArgumentError` if the effort is unknown."""
    check_choice("effort", effort, EFFORTS)


def checked_threads(threads: object) -> int:
    """Return the number of threads; by default one for each processor that the process may use."""
    if threads is not None:
        return checked_whole("threads", threads, least=1)
    # Containers and `taskset` restrict a process to some of the processors.
    may_use = getattr(os, "sched_getaffinity", None)
    return (len(may_use(0)) if may_use else os.cpu_count()) or 1
