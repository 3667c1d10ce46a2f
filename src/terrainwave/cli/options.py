"""Types of option values; a wrong value gives one line: found, expected."""

import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import Field
from typing import Any

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from terrainwave.arguments import ARCHIVE_ENDING, check_ending, check_local, checked_path, one_of
from terrainwave.cli.output import Command, own_sets
from terrainwave.cli.streams import STREAM, read_stream
from terrainwave.codec.method_options import chosen
from terrainwave.errors import InvalidArgumentError
from terrainwave.export.shapes import Shape
from terrainwave.names import DEFAULT_EFFORT, DEFAULT_MESH, EFFORTS, METHODS
from terrainwave.option_sets import FLAG, PATH, Kind, OptionSet, number
from terrainwave.render.look.colorings import AUTO, SEA_LEVEL
from terrainwave.tri import mesh_options


def complete_files(_: Any, __: Any, incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(incomplete, type="file")]


class Name(click.ParamType):
    """Name of a file or folder for any purpose, which the shell completes."""

    name = "path"
    completes = "file"

    def shell_complete(self, _: Any, __: Any, incomplete: str) -> list[CompletionItem]:
        return [CompletionItem(incomplete, type=self.completes)]

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        try:
            return checked_path(value)
        except InvalidArgumentError as error:
            self.fail(str(error), param, ctx)


class Target(Name):
    """Output file with one of some endings; - is stdout where allowed."""

    def __init__(
        self, endings: Sequence[str], *, or_stdout: bool = True, or_url: bool = False
    ) -> None:
        self._endings = endings
        self._or_stdout = or_stdout
        self._or_url = or_url

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        path = super().convert(value, param, ctx)
        if path == STREAM and self._or_stdout:
            return path
        more = ""
        try:
            if not self._or_url:
                check_local(path)
            more = ", or - for stdout" * self._or_stdout
            check_ending(path, self._endings, or_url=self._or_url)
        except InvalidArgumentError as error:
            self.fail(f"{error}{more}", param, ctx)
        return path


class Directory(Name):
    """Output directory; names of archives and streams are refused, as are empty ones."""

    name = "directory"
    completes = "dir"
    archives = (ARCHIVE_ENDING, ".mbtiles", ".tar", ".zip")

    def __init__(self, *, or_ending: str | None = None) -> None:
        self._or_ending = or_ending

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        path = super().convert(value, param, ctx)
        ending = os.path.splitext(path)[1].lower()
        if ending == self._or_ending:
            return path
        if path == STREAM or ending in self.archives or os.path.isfile(path):
            found = {STREAM: "a stream"}.get(path, f"a file ({ending})" if ending else "a file")
            other = f" or a name that ends in {self._or_ending}" if self._or_ending else ""
            self.fail(f"{path}: found {found}, expected a directory{other}", param, ctx)
        return path


class Input(Name):
    """Input file; - is stdin, copied to a temporary file, as readers seek."""

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        if value != STREAM or ctx is None or ctx.resilient_parsing:
            return super().convert(value, param, ctx)
        return read_stream(ctx)


class NamedInput(Input):
    """Input file that needs its own name or place: not a stream."""

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        if value == STREAM:
            self.fail("found -, expected a file name: this command cannot use streams", param, ctx)
        return super().convert(value, param, ctx)


class OfKind(click.ParamType):
    """Values of a kind of options, typed as text."""

    def __init__(self, kind: Kind) -> None:
        self._kind = kind
        self.name = kind.values

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        if not isinstance(value, str):  # a default
            return value
        try:
            return self._kind.from_text(value)
        except InvalidArgumentError as error:
            self.fail(str(error), param, ctx)


class _Range(OfKind, click.FloatRange):
    """A number whose limits the help shows."""

    def __init__(self, kind: Kind) -> None:
        least = kind.limits.get("least", kind.limits.get("above"))
        is_open = "above" in kind.limits
        click.FloatRange.__init__(self, least, kind.limits.get("most"), min_open=is_open)
        self._kind = kind


def declared(
    options: type[OptionSet], first: str | None = None, last: str | None = None
) -> Callable[[Any], Any]:
    """Return a decorator that gives a command options of a class, from `first` to `last`."""
    names = options.names()
    start = 0 if first is None else names.index(first)
    stop = None if last is None else names.index(last) + 1
    taken = [one for one in options.options()[start:stop] if one.metadata["help"]]
    return lambda command: add_options(command, *map(_declared, reversed(taken)))


def _declared(one: Field[Any]) -> Callable[[Any], Any]:
    kind, default, typed = one.metadata["kind"], one.default, {**one.metadata["typed"]}
    given: dict[str, Any] = {"default": default, "show_default": True}
    if kind is FLAG:
        given = {"is_flag": True, "default": None if default is None else False}
    elif kind.choices:
        given["type"] = click.Choice(kind.choices)
    elif kind is PATH:
        given["type"] = Name()
    else:
        given["type"] = (_Range if typed.pop("has_range", False) else OfKind)(kind)
    word = one.name.replace("_", "-")
    if default is True:
        word, given["callback"] = f"no-{word}", lambda _, __, value: not value
    given |= {"names": [f"--{word}"]} | typed
    return click.option(*given.pop("names"), one.name, help=one.metadata["help"], **given)


BOUND, POSITIVE, FINITE = OfKind(number(least=0)), OfKind(number(above=0)), OfKind(number())
PAGE_SEA_LEVEL_OPTION = click.option(
    "--sea-level",
    type=OfKind(SEA_LEVEL),
    default=AUTO,
    show_default=True,
    help="Height in metres below which the page's colours show water, or none. auto: 0 if there"
    " are heights below -450 m, else none.",
)
THREADS_OPTION = click.option(
    "--threads",
    type=click.IntRange(min=1),
    help="Number of threads. Default: all available processors.",
)
RADIUS_OPTION = declared(Shape, "radius", "radius")
VERTICAL_OPTION = declared(Shape, "vertical")
LEVEL_OPTION = click.option(
    "--level",
    type=int,
    default=-1,
    help="Level of detail: -1 is the full grid (default), -2 half of it, 0 the coarsest.",
)


def on_command_line() -> set[str]:
    """Return the names of the parameters that the command line gives."""
    ctx = click.get_current_context()
    return {
        name for name in ctx.params if ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE
    }


def check_one_area(options: dict[str, Any]) -> None:
    if options["window"] and options["bounds"]:
        raise click.UsageError("found both --window and --bounds, expected one of them")


def add_options(
    command: Callable[..., Any], *options: Callable[[Callable[..., Any]], Callable[..., Any]]
) -> Callable[..., Any]:
    for option in options:
        command = option(command)
    return command


def writing(command: Callable[..., Any]) -> Callable[..., Any]:
    return add_options(
        command,
        THREADS_OPTION,
        click.option("--overwrite", is_flag=True, help="Replace an existing file."),
        click.option("--quiet", "-q", is_flag=True, help="Print nothing but errors and notes."),
    )


def resumable(command: Callable[..., Any]) -> Callable[..., Any]:
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


_ARGUMENTS = "terrainwave.arguments"


def own_option(help: str) -> Callable[[Any], Any]:
    return click.option("-o", "own", multiple=True, metavar="NAME[=VALUE]", help=help)


def with_own_options(own: Sequence[str], options: dict[str, Any]) -> dict[str, Any]:
    """Return a command's options with those of -o (`own`) merged in.

    Raises `click.UsageError` or `InvalidArgumentError` if neither the method nor the kind of meshes
    has the option, or the value is invalid.
    """
    words = _words(own)
    in_use = _sets_of({"mesh": DEFAULT_MESH} | options)
    found: dict[str, Any] = {}
    for each in in_use:
        taken = {name: words.pop(name) for name in each.names() if name in words}
        if taken:
            found[each.argument] = each.from_words(taken)
    for name, word in words.items():
        _refuse(name, f"-o {word}", options, in_use)
    if "method" in found:
        found["effort"] = chosen(options["method"], options["effort"]).effort
    return options | found


def _words(own: Sequence[str]) -> dict[str, str]:
    words: dict[str, str] = {}
    for text in own:
        name = text.partition("=")[0].replace("-", "_")
        if not name:
            raise click.UsageError(f"found -o {text or repr(text)}, expected NAME or NAME=VALUE")
        if name in words:
            raise click.UsageError(f"found -o {name} twice, expected it once")
        words[name] = text
    return words


def _refuse(
    name: str, typed: str, options: dict[str, Any], in_use: Sequence[type[OptionSet]]
) -> None:
    of_command = [each for each in own_sets() if each.argument in options]
    having = [each for each in of_command if name in each.names()]
    if having:
        argument, params = having[0].argument, click.get_current_context().params
        found = (
            f"`{argument}` {params[argument]}"
            if argument in on_command_line()
            else f"no `{argument}`"
        )
        raise InvalidArgumentError(
            f"found {typed} and {found}, expected `{argument}` {one_of([h.name for h in having])}"
        )
    known = [name for each in in_use for name in each.names()]
    kinds = one_of([each.name for each in of_command if each.argument == "mesh"])
    expected = f"-o {one_of(known)}" if known else f"an option of --mesh {kinds}"
    raise click.UsageError(f"found {typed}, expected {expected}")


class CommandWithOwnOptions(Command):
    """Command whose help lists the options of the named method and meshes."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.meta[_ARGUMENTS] = list(args)
        return super().parse_args(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        super().format_options(ctx, formatter)
        for kind in _sets_of(self._given(ctx)):
            with formatter.section(f"Options of --{kind.argument} {kind.name}"):
                formatter.write_dl([(f"-o {words}", help) for words, help in kind.described()])

    def pointer(self, ctx: click.Context, message: str) -> str:
        """Return the command that lists the options that `message` is about: -o, or all."""
        if not re.search(r"(?<!\S)'?-o\b", message):
            return super().pointer(ctx, message)
        named = dict(re.findall(r"expected --(method|mesh) (\w+)", message))
        if not named:
            named = {kind.argument: kind.name for kind in _sets_of(self._given(ctx))}
        if not named:
            has_methods = any(option.name == "method" for option in self.params)
            named = {"method": "METHOD"} if has_methods else {"mesh": "KIND"}
        words = " ".join(f"--{argument} {name}" for argument, name in named.items())
        return f"{ctx.command_path} {words} --help"

    def _given(self, ctx: click.Context) -> dict[str, Any]:
        args = list(ctx.meta.get(_ARGUMENTS, []))
        for known in (args, args[:-1]):  # the last option may lack its value
            with suppress(click.UsageError):
                return self.make_parser(ctx).parse_args(list(known))[0]
        return {}


def _sets_of(given: Mapping[str, Any]) -> list[type[OptionSet]]:
    found: list[type[OptionSet] | None] = [mesh_options.options_of(given.get("mesh") or "")]
    if given.get("method") in ("auto", *METHODS):
        effort = given.get("effort")
        choice = chosen(given["method"], effort if effort in EFFORTS else DEFAULT_EFFORT)
        found.insert(0, type(choice.own))
    return [each for each in found if each is not None]
