"""Checks of arguments that several functions have: what was found, what was expected."""

import math
import os
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

from terrainwave.errors import InvalidArgumentError
from terrainwave.names import EFFORTS, MESH_CHOICES, METHODS, UNBOUNDED_MESHES, Method, methods_that

# Cells on a side of a block.
BLOCKS = (32, 64, 128, 256, 512, 1024)

# What the names of files that are written end in, by kind.
TWZ_ENDINGS = (".twz",)
GEOTIFF_ENDINGS = (".tif", ".tiff")
HEIGHT_TILE_ENDINGS = (".r16", ".png")
# Which samples of a coarse level are void (`Terrain.read`).
VOIDS = ("exact", "any")
# What voids of a height tile become, if no height is given.
FILLINGS = ("lowest", "fill")
PICTURE_ENDINGS = (".png",)
ARCHIVE_ENDING = ".pmtiles"

# Longer ones are WKT, whose name is its first quoted string.
_LONGEST_CODE = 40


def check_ending(path: str | os.PathLike[str], endings: Sequence[str]) -> None:
    """Refuse a target whose name says that it is something else than what is written.

    Nothing may be replaced by mistake: a raster that was given as the last of several sources, or
    another program's file.

    Raises
    ------
    InvalidArgumentError
        If it is a URL, or the name has none of the endings, in capital or small letters.
    """
    check_local(path)
    ending = Path(path).suffix.lower()
    if ending not in endings:
        raise InvalidArgumentError(
            f"{os.fspath(path)}: found {ending or 'no extension'}, expected a name that ends in"
            f" {one_of(endings)}"
        )


def check_local(target: str | os.PathLike[str]) -> None:
    """Refuse a URL where a file is written: as a path it would name folders of this machine.

    Raises
    ------
    InvalidArgumentError
        If it is one; the message has neither login nor query.
    """
    name = os.fspath(target)
    if "://" in name:
        raise InvalidArgumentError(
            f"found a URL, {name.partition('://')[0]}://…, expected a path: files are written to"
            " this machine alone; upload the finished file"
        )


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


def checked_error(name: str, error: float | None) -> float | None:
    """Return a finite error >= 0 as a float, or None.

    Raises
    ------
    InvalidArgumentError
        If it is anything else; the message begins with `name`.
    """
    if error is None:
        return None
    try:
        number = float(error)
    except (TypeError, ValueError, OverflowError):  # text, no number, or an int too large
        number = math.nan
    if not (math.isfinite(number) and number >= 0):
        raise InvalidArgumentError(f"found `{name}` {error}, expected a finite number >= 0")
    return number


def check_flags(**flags: object) -> None:
    """Refuse what is neither true nor false: the text "no" would count as true.

    Raises
    ------
    InvalidArgumentError
        If one of `flags` is no bool; the message begins with its name.
    """
    for name, value in flags.items():
        # NumPy's truth values are no bool.
        if not isinstance(value, bool) and getattr(value, "dtype", None) != "bool":
            raise InvalidArgumentError(f"found `{name}` {value!r}, expected True or False")


def check_method(name: str) -> None:
    """Refuse a method that there is not.

    Raises
    ------
    InvalidArgumentError
        If there is no such method.
    """
    if name != "auto" and name not in METHODS:
        raise InvalidArgumentError(f"found `method` {name!r}, expected auto, {', '.join(METHODS)}")


def check_effort(effort: str) -> None:
    """Refuse an effort that there is not.

    Raises
    ------
    InvalidArgumentError
        If it is none.
    """
    if effort not in EFFORTS:
        raise InvalidArgumentError(
            f"found `effort` {effort!r}, expected one of {', '.join(EFFORTS)}"
        )


def check_mesh(mesh: str, *, or_none: bool) -> None:
    """Check the name of a kind of meshes; "none" is one only where that is allowed.

    Raises
    ------
    InvalidArgumentError
        If it is no such name.
    """
    known = (*MESH_CHOICES, "none") if or_none else MESH_CHOICES
    if mesh not in ("auto", *known):
        raise InvalidArgumentError(
            f"found `mesh` {mesh!r}, expected one of auto, {', '.join(known)}"
        )


def check_mesh_of(mesh: str, method: Method, *, is_faithful: bool) -> None:
    """Check that files of a method, faithful to its paper or not, can have meshes of a kind.

    Raises
    ------
    InvalidArgumentError
        If the kind follows wavelet coefficients or zero trees that such files do not have.
    """
    if mesh == "zerotree-coded" and not is_faithful:
        raise InvalidArgumentError(
            f"found `mesh` {mesh} for a file that codes no zero trees, expected `faithful`, or"
            " `mesh` zerotree-layer, which follows those of the decoded heights"
        )
    if mesh in UNBOUNDED_MESHES and not method.is_tiled:
        raise InvalidArgumentError(
            f"found `mesh` {mesh!r} and method {method.name}, expected method"
            f" {methods_that(lambda method: method.is_tiled)}, whose coefficients it follows"
        )


def checked_threads(threads: int | None) -> int:
    """Return the number of threads that is meant: all processors it may use where none is given.

    Raises
    ------
    InvalidArgumentError
        If there are fewer than one.
    """
    if threads is not None and threads < 1:
        raise InvalidArgumentError(f"found {threads} threads, expected at least 1")
    if threads is not None:
        return threads
    # A process may be kept on some of the processors, as in a container or by `taskset`.
    may_use = getattr(os, "sched_getaffinity", None)
    return (len(may_use(0)) if may_use else os.cpu_count()) or 1
