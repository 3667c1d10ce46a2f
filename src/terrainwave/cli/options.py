"""Types of option values; a wrong value gives one line: found, expected."""

import math
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import click
from click.shell_completion import CompletionItem

from terrainwave.arguments import (
    ARCHIVE_ENDING,
    AS_IS,
    BLOCKS,
    VERTICAL,
    check_ending,
    check_local,
    checked_path,
    nodata_choice,
)
from terrainwave.cli.streams import STREAM, read_stream
from terrainwave.errors import InvalidArgumentError
from terrainwave.names import METHODS, SMALLEST_METHOD, methods_that
from terrainwave.render.look.colorings import AUTO, NO_SEA

TILE_SIZES = tuple(2**n + 1 for n in range(1, 15))


def complete_files(_: Any, __: Any, incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(incomplete, type="file")]


class _Path(click.ParamType):
    """Name that the shell completes."""

    completes = "file"

    def shell_complete(self, _: Any, __: Any, incomplete: str) -> list[CompletionItem]:
        return [CompletionItem(incomplete, type=self.completes)]

    def named(self, value: Any, param: Any, ctx: Any) -> str:
        """Return the name; raise if it is empty."""
        try:
            return checked_path(value)
        except InvalidArgumentError as error:
            self.fail(str(error), param, ctx)


class Name(_Path):
    """Name of a file or folder for any purpose."""

    name = "path"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        return self.named(value, param, ctx)


class Target(_Path):
    """Output file with one of some endings; - is stdout where allowed."""

    name = "path"

    def __init__(
        self, endings: Sequence[str], *, or_stdout: bool = True, or_url: bool = False
    ) -> None:
        self._endings = endings
        self._or_stdout = or_stdout
        self._or_url = or_url

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        path = self.named(value, param, ctx)
        if path == STREAM and self._or_stdout:
            return path
        try:
            if not self._or_url:
                check_local(path)
        except InvalidArgumentError as error:
            self.fail(str(error), param, ctx)
        try:
            check_ending(path, self._endings, or_url=self._or_url)
        except InvalidArgumentError as error:
            self.fail(f"{error}{', or - for stdout' * self._or_stdout}", param, ctx)
        return path


class Directory(_Path):
    """Output directory; names of archives and streams are refused, as are empty ones."""

    name = "directory"
    completes = "dir"
    archives = (ARCHIVE_ENDING, ".mbtiles", ".tar", ".zip")

    def __init__(self, *, or_ending: str | None = None) -> None:
        self._or_ending = or_ending

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """Return the name; also of a file if its ending is allowed."""
        path = self.named(value, param, ctx)
        ending = os.path.splitext(path)[1].lower()
        if ending == self._or_ending:
            return path
        if path == STREAM or ending in self.archives or os.path.isfile(path):
            found = {STREAM: "a stream"}.get(path, f"a file ({ending})" if ending else "a file")
            other = f" or a name that ends in {self._or_ending}" if self._or_ending else ""
            self.fail(f"{path}: found {found}, expected a directory{other}", param, ctx)
        return path


class Input(_Path):
    """Input file; - is stdin, which is copied to a temporary file until the command ends.

    Readers seek, which a stream cannot.
    """

    name = "path"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """Return the path of the file or of the copy."""
        if value != STREAM or ctx is None or ctx.resilient_parsing:
            return self.named(value, param, ctx)
        return read_stream(ctx)


class NamedInput(Input):
    """Input file that needs its own name or place: not a stream."""

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        if value == STREAM:
            self.fail("found -, expected a file name: this command cannot use streams", param, ctx)
        return self.named(value, param, ctx)


class Finite(click.ParamType):
    """A finite number."""

    name = "number"
    expected = "a finite number"

    def holds(self, _: float) -> bool:
        """Return whether a finite number is in the range of this type."""
        return True

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not (math.isfinite(number) and self.holds(number)):
            self.fail(f"found {value}, expected {self.expected}", param, ctx)
        return number


class SeaLevel(Finite):
    """Height of the sea, or a word for one."""

    name = "height"
    expected = f"{AUTO}, {NO_SEA} or a height"

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        return value if value in (AUTO, NO_SEA) else super().convert(value, param, ctx)


# For commands that make the page for browsers.
PAGE_SEA_LEVEL_OPTION = click.option(
    "--sea-level",
    type=SeaLevel(),
    default=AUTO,
    show_default=True,
    help="Height in metres below which the page's colours show water, or none. auto: 0 if there"
    " are heights below -450 m, else none.",
)


class Bound(Finite):
    """A finite number >= 0."""

    expected = "a finite number >= 0"

    def holds(self, number: float) -> bool:
        return number >= 0


class Positive(Finite):
    """A finite number > 0."""

    expected = "a finite number > 0"

    def holds(self, number: float) -> bool:
        return number > 0


class Nodata(click.ParamType):
    """A number, nan, inf or -inf, only:NUMBER or none; whole numbers stay whole."""

    name = "number|only:number|none"

    def convert(self, value: Any, param: Any, ctx: Any) -> int | float | str:
        """Return an int if possible, else a float, or the text."""
        for kind in (int, float):
            with suppress(ValueError):
                return kind(value)
        try:
            nodata_choice(value)
        except InvalidArgumentError:
            self.fail(f"found {value}, expected a number or nan, only:NUMBER or none", param, ctx)
        return str(value)


class BlockSide(click.ParamType):
    """A power of two from 32 to 1024."""

    name = "32…1024"

    def convert(self, value: Any, param: Any, ctx: Any) -> int:
        if str(value) not in map(str, BLOCKS):
            expected = ", ".join(map(str, BLOCKS))
            self.fail(f"found {value}, expected one of {expected}", param, ctx)
        return int(value)


class TileSize(click.ParamType):
    """2ⁿ + 1, or the word window."""

    name = "2ⁿ+1|window"

    def convert(self, value: Any, param: Any, ctx: Any) -> int | str:
        """Return the number of samples on a side, or ``"window"``."""
        if value == "window":
            return "window"
        if str(value) not in map(str, TILE_SIZES):
            self.fail(
                f"found {value}, expected 2^n + 1 from {TILE_SIZES[0]} to {TILE_SIZES[-1]}"
                " (such as 1025) or window",
                param,
                ctx,
            )
        return int(value)


class Numbers(click.ParamType):
    """Comma-separated numbers, one for each name."""

    def __init__(self, names: str, kind: type[int] | type[float]) -> None:
        self.name = names
        self._kind = kind
        self._count = len(names.split(","))

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int | float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(self._kind(part) for part in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self._count or not all(math.isfinite(number) for number in numbers):
            kind = "whole numbers" if self._kind is int else "numbers"
            count = {2: "two", 4: "four"}.get(self._count, self._count)
            self.fail(f"found {value}, expected {count} {kind}: {self.name}", param, ctx)
        return numbers


THREADS_OPTION = click.option(
    "--threads",
    type=click.IntRange(min=1),
    help="Number of threads. Default: all available processors.",
)
METHOD = click.Choice(["auto", *METHODS])
CUTTABLE = methods_that(lambda method: method.is_cuttable)
_EFFORTS = [f"{method.name} {method.effort}" for method in METHODS.values() if method.effort]
EFFORT = (
    f"Number of variants that the encoder tries: {'; '.join(_EFFORTS)}; other methods have one."
    f" For archives: best without --method selects {SMALLEST_METHOD.name}, whose files are"
    " 0.95 of the default's size (0.79 to 0.99), and are read 6 times as slowly."
)
RADIUS_OPTION = click.option(
    "--radius",
    type=Positive(),
    metavar="METRES",
    help="Radius of the planet or moon in metres, for coordinates in degrees. Default: the"
    " ellipsoid of the CRS.",
)


def vertical_option(heights: str) -> Callable[[Any], Any]:
    """Return the option --vertical, with help for these heights."""
    return click.option(
        "--vertical",
        type=click.Choice(VERTICAL),
        default=AS_IS,
        show_default=True,
        help=f"{heights}: used as heights above the ellipsoid without a change (as-is), or"
        " converted from the CRS's vertical datum by PROJ's grid (ellipsoid).",
    )


VERTICAL_OPTION = vertical_option("Heights on the globe")
LEVEL_OPTION = click.option(
    "--level",
    type=int,
    default=-1,
    help="Level of detail: -1 is the full grid (default), -2 half of it, 0 the coarsest.",
)


def check_one_area(options: dict[str, Any]) -> None:
    """Raise if both a window and bounds are given."""
    if options["window"] and options["bounds"]:
        raise click.UsageError("found both --window and --bounds, expected one of them")


def add_options(
    command: Callable[..., Any], *options: Callable[[Callable[..., Any]], Callable[..., Any]]
) -> Callable[..., Any]:
    """Return a decorator that adds options to a command; help lists the last one first."""
    for option in options:
        command = option(command)
    return command


def writing(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of commands that write a file."""
    return add_options(
        command,
        THREADS_OPTION,
        click.option("--overwrite", is_flag=True, help="Replace an existing file."),
        click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes."),
    )


def resumable(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of commands that continue an interrupted run."""
    return add_options(
        command,
        click.option(
            "--fresh",
            is_flag=True,
            help="Start over, if an earlier run of the same command did not finish. Default:"
            " continue its work.",
        ),
        click.option(
            "--temp-dir",
            type=Name(),
            help="Folder for large temporary files, and for finished work if the run fails.",
        ),
    )


def batched(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of commands that take many files."""
    return add_options(
        command,
        click.option(
            "--skip-existing",
            is_flag=True,
            help="With --to: skip files that exist and were made of the same source with the same"
            " options.",
        ),
        click.option(
            "--to",
            type=Directory(),
            metavar="DIR",
            help="Write a file for each SOURCE to this directory, and continue if one fails. A"
            " SOURCE that is a folder stands for the files below it; their folders are kept.",
        ),
    )
