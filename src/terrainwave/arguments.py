"""Checks of arguments that several functions have: what was found, what was expected."""

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

# What the names of files that are written end in, by kind.
TWZ_ENDINGS = (".twz",)
GEOTIFF_ENDINGS = (".tif", ".tiff")
HEIGHT_TILE_ENDINGS = (".r16", ".png")
# Which samples of a coarse level are void (`Terrain.read`).
VOIDS = EXACT, ANY = "exact", "any"
# What becomes of damaged blocks.
ON_ERROR = RAISE, MASK = "raise", "mask"
# What voids of a height tile become, if no height is given.
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
    """Refuse a target whose name says that it is something else than what is written.

    Nothing may be replaced by mistake: a raster that was given as the last of several sources, or
    another program's file.

    Raises
    ------
    InvalidArgumentError
        If it is a URL, unless `or_url`, or the name has none of the endings, in capital or small
        letters.
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
    """Refuse a URL where a file is written: as a path it would name folders of this machine.

    Raises
    ------
    InvalidArgumentError
        If it is one, or no name of a file; the message has neither login nor query.
    """
    name = checked_path(target)
    if "://" in name:
        raise InvalidArgumentError(
            f"found a URL, {name.partition('://')[0]}://…, expected a path: files are written to"
            " this machine alone; upload the finished file"
        )


def checked_path(path: object, argument: str | None = None) -> str:
    """Return the name of a file or folder as text.

    Parameters
    ----------
    path : object
        What was given.
    argument : str, optional
        The argument that it was given for, where messages should name it.

    Raises
    ------
    InvalidArgumentError
        If it is no text and no path, or is empty: as a path that would be the working directory.
    """
    of = "" if argument is None else f"`{argument}` "
    name = os.fspath(path) if isinstance(path, str | os.PathLike) else None
    if not isinstance(name, str):  # a PathLike may be one of bytes, too
        raise InvalidArgumentError(f"found {of}{shown(path)}, expected a path as text")
    if not name:
        raise InvalidArgumentError(
            f"found {of}'', an empty name, expected that of a file or folder"
        )
    return name


def is_twz_name(name: object) -> bool:
    """Say whether a path or the path of a URL ends as those of .twz files do."""
    if not isinstance(name, str | os.PathLike):
        return False
    return str(path_in_url(os.fspath(name))).lower().endswith(TWZ_ENDINGS)


def path_in_url(name: str) -> str:
    """Return the path of a URL, in a chain that of its first link; a path as it is."""
    if not isinstance(name, str) or "://" not in name:
        return name
    if name.startswith("zip://"):
        return name.removeprefix("zip://").partition("::")[0]
    return urlsplit(name).path


def in_one_line(text: object) -> str:
    """Return text on one line, without control, format (bidi) and unassigned characters.

    Whatever may come from an untrusted file goes through this before a terminal shows it.
    """
    words = " ".join(str(text).split())
    return "".join(char for char in words if not unicodedata.category(char).startswith("C"))


def count_of(number: int, noun: str) -> str:
    """Return a number with its noun: 1 block, 2,000 blocks."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


# What becomes of heights on the globe, whatever datum they have.
AS_IS, ELLIPSOID = "as-is", "ellipsoid"
VERTICAL = (AS_IS, ELLIPSOID)
# Axes of mesh files that may point upwards.
UPWARDS = ("y", "z")
# Of levels of detail each may have twice the error of the one before: beyond these nothing is left
# to leave out.
MOST_LODS = 16


def size_of(n_bytes: int) -> str:
    """Return a number of bytes in a unit that leaves three digits or so: 12.3 GB, 40.0 kB, 7 bytes.

    Two sizes that look alike in that are so within half a per cent.
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
    """Return a CRS in few words: its code, the name that WKT gives, or that there is none."""
    if not crs:
        return "no CRS"
    if len(crs) <= _LONGEST_CODE and '"' not in crs:
        return crs
    return crs.split('"')[1] if '"' in crs else crs[:_LONGEST_CODE]


def one_of(words: Sequence[str]) -> str:
    """Return words as a list to choose from: a, b or c."""
    return " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def shown(value: object) -> str:
    """Return a wrong value as messages show it: a number as it is, texts quoted, all in one line.

    A text that reads as a number is called one, or messages would find what they expect. Arrays are
    called by their shape, other long values by their type.
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
    """Return the number that a value is; None for texts, truth values and all else.

    Numbers of numpy and arrays of one number without dimensions are numbers as Python's are.
    """
    if type(value) is int or type(value) is float:  # most are, and abstract classes are slow
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
    """Return what `nodata` asks for: None, a number, ``"only:NUMBER"`` or ``"none"``.

    Raises
    ------
    InvalidArgumentError
        If it is something else.
    """
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
        Of the argument, as messages call it.
    value : object
        What was given for it.
    least, above, most : float
        It is >= `least`, > `above` and <= `most`.
    expected : str
        What messages say instead of these.

    Raises
    ------
    InvalidArgumentError
        If it is anything else: a text and a truth value are no numbers.
    """
    number = number_of(value)
    try:
        given = math.nan if number is None else float(number)
    except OverflowError:  # of more than 308 digits
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


def _in_range(kind: str, least: float, most: float) -> str:
    if most == math.inf:
        return kind if least == -math.inf else f"{kind} >= {least:g}"
    return f"{kind}, {least:g} … {most:g}"


def checked_numbers(name: str, values: Any, names: str, *, is_whole: bool = False) -> Any:
    """Return finite numbers as a tuple of floats, or of ints; as many as there are `names`.

    Raises
    ------
    InvalidArgumentError
        If they are anything else, or of another number.
    """
    taken: list[float] | None = []
    check = checked_whole if is_whole else checked_number
    try:
        taken = [] if isinstance(values, str | bytes) else [check(name, one) for one in values]
    except (TypeError, InvalidArgumentError):  # nothing to iterate over, or no number in it
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
    """Refuse what is none of some words.

    Raises
    ------
    InvalidArgumentError
        If it is none of them.
    """
    known = list(choices)
    if not isinstance(value, str) or value not in known:
        expected = f"one of {', '.join(known)}" if len(known) > 2 else one_of(known)
        found = repr(value) if isinstance(value, str) else shown(value)
        if number_of(value) is not None:
            # 1.0 and the text '1.0' look alike.
            found, expected = f"the number {found}", one_of([*map(repr, known)])
        raise InvalidArgumentError(f"found `{name}` {found}, expected {expected}")


def checked_error(name: str, error: object) -> float | None:
    """Return a finite error >= 0 as a float, or None.

    Raises
    ------
    InvalidArgumentError
        If it is anything else.
    """
    return None if error is None else checked_number(name, error, least=0)


def check_callback(callback: object, name: str = "progress", takes: str = "a Progress") -> None:
    """Refuse what cannot be called, and is not None.

    Raises
    ------
    InvalidArgumentError
        If it is neither None nor callable.
    """
    if callback is not None and not callable(callback):
        raise InvalidArgumentError(
            f"found `{name}` {shown(callback)}, expected a function that takes {takes}"
        )


def check_flags(**flags: object) -> None:
    """Refuse what is neither true nor false: the text "no" would count as true.

    Raises
    ------
    InvalidArgumentError
        If one of `flags` is no bool; the message begins with its name.
    """
    for name, value in flags.items():
        # NumPy's truth values are no bool; an array of them is none of either.
        is_numpys = getattr(value, "dtype", None) == "bool" and getattr(value, "shape", None) == ()
        if not isinstance(value, bool) and not is_numpys:
            raise InvalidArgumentError(f"found `{name}` {shown(value)}, expected True or False")


def check_band(band: int, n_bands: int, whose: str) -> None:
    """Refuse a band that a raster does not have; `whose` says which raster.

    Raises
    ------
    InvalidArgumentError
        If there is none of this number.
    """
    if not 1 <= band <= n_bands:
        expected = "1" if n_bands == 1 else f"1 … {n_bands}"
        raise InvalidArgumentError(
            f"found `band` {band}, expected {expected}: {whose} has {count_of(n_bands, 'band')}"
        )


def check_effort(effort: str) -> None:
    """Refuse an effort that there is not.

    Raises
    ------
    InvalidArgumentError
        If it is none.
    """
    check_choice("effort", effort, EFFORTS)


def checked_threads(threads: object) -> int:
    """Return the number of threads that is meant: all processors it may use where none is given.

    Raises
    ------
    InvalidArgumentError
        If it is no whole number >= 1.
    """
    if threads is not None:
        return checked_whole("threads", threads, least=1)
    # A process may be kept on some of the processors, as in a container or by `taskset`.
    may_use = getattr(os, "sched_getaffinity", None)
    return (len(may_use(0)) if may_use else os.cpu_count()) or 1
