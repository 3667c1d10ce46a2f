"""``-o NAME=VALUE``: options of the method and of the kind of meshes that a command uses.

An option that only one method or one kind of meshes has is given by ``-o``, and the command's help
lists it if that method or kind is named.
"""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import click
from click.core import ParameterSource

from terrainwave.arguments import one_of
from terrainwave.cli.options import METHOD
from terrainwave.cli.output import Command
from terrainwave.codec.method_options import chosen
from terrainwave.codec.method_options import options_of as options_of_method
from terrainwave.names import DEFAULT_EFFORT, DEFAULT_MESH, EFFORTS, MESH_KINDS, METHODS
from terrainwave.option_sets import OptionSet, refuse_unknown
from terrainwave.tri.mesh_options import options_of as options_of_mesh

_ARGUMENTS = "terrainwave.arguments"


class _Word(NamedTuple):
    """Option of a method or of a kind of meshes, as typed."""

    name: str
    value: str | None
    typed: str


def own_option(help: str) -> Callable[[Any], Any]:
    return click.option("-o", "own", multiple=True, metavar="NAME[=VALUE]", help=help)


def with_own_options(own: Sequence[str], options: dict[str, Any]) -> dict[str, Any]:
    """Return a command's options with those of -o merged in.

    Parameters
    ----------
    own : sequence of str
        Values of -o.
    options : dict
        Has `mesh`, and `method` and `effort` if the command has these.

    Raises
    ------
    click.UsageError, InvalidArgumentError
        If neither the method nor the kind of meshes has the option, or the value is invalid.
    """
    ctx = click.get_current_context()
    words = _words(own)
    of_mesh = options_of_mesh(options.get("mesh") or DEFAULT_MESH)
    found: dict[str, Any] = {}
    taken = {name: words.pop(name) for name in list(words) if of_mesh and name in of_mesh.names()}
    if of_mesh is not None and taken:
        found["mesh"] = of_mesh.from_words(_values(taken))
    of_method = None
    if "method" in options:
        method, effort, _, _ = chosen(options["method"], options["effort"])
        of_method = type(method)
    _refuse_others(ctx, words, of_method, of_mesh)
    if of_method is not None and words:
        found |= {"method": of_method.from_words(_values(words)), "effort": effort}
    return options | found


def _words(own: Sequence[str]) -> dict[str, _Word]:
    """Return the values of -o by name."""
    words: dict[str, _Word] = {}
    for text in own:
        name, sign, value = text.partition("=")
        name = name.replace("-", "_")
        if not name:
            raise click.UsageError(f"found -o {text or repr(text)}, expected NAME or NAME=VALUE")
        if name in words:
            raise click.UsageError(f"found -o {name} twice, expected it once")
        words[name] = _Word(name, value if sign else None, f"-o {text}")
    return words


def _values(words: dict[str, _Word]) -> dict[str, str | None]:
    return {name: word.value for name, word in words.items()}


def _refuse_others(
    ctx: click.Context,
    words: dict[str, _Word],
    of_method: type[OptionSet] | None,
    of_mesh: type[OptionSet] | None,
) -> None:
    """Raise for options that neither the method nor the kind of meshes has; name those that do."""
    known = [name for each in (of_method, of_mesh) if each is not None for name in each.names()]
    meshes = [kind for name in MESH_KINDS if (kind := options_of_mesh(name)) is not None]
    methods = [options_of_method(name) for name in METHODS]
    for name, word in words.items():
        if name in known:
            continue
        owners: list[tuple[str, Sequence[type[OptionSet]]]] = [("mesh", meshes)]
        if of_method is not None:
            owners.append(("method", methods))
        for argument, sets in owners:
            if any(name in kind.names() for kind in sets):
                refuse_unknown(name, argument, sets, given=word.typed, found=_typed(ctx, argument))
        kinds = one_of([kind.name for kind in meshes])
        expected = f"-o {one_of(known)}" if known else f"an option of --mesh {kinds}"
        raise click.UsageError(f"found {word.typed}, expected {expected}")


def _typed(ctx: click.Context, argument: str) -> str:
    """Return an option of the command as typed, or a note that it is missing."""
    if ctx.get_parameter_source(argument) is not ParameterSource.COMMANDLINE:
        return f"no `{argument}`"
    return f"`{argument}` {ctx.params[argument]}"


class CommandWithOwnOptions(Command):
    """Command whose help lists the options of the named method and meshes."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Store the arguments for the help, which runs before options are parsed."""
        ctx.meta[_ARGUMENTS] = list(args)
        return super().parse_args(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options of the command, then those of -o."""
        super().format_options(ctx, formatter)
        for kind in _named(self._given(ctx)):
            with formatter.section(f"Options of --{kind.argument} {kind.name}"):
                formatter.write_dl([(f"-o {words}", help) for words, help in kind.described()])

    def pointer(self, ctx: click.Context, message: str) -> str:
        """Return the command that lists the options that `message` is about: -o, or all."""
        if not re.search(r"(?<!\S)'?-o\b", message):
            return super().pointer(ctx, message)
        named = dict(re.findall(r"expected --(method|mesh) (\w+)", message))
        if not named:
            named = {kind.argument: kind.name for kind in _named(self._given(ctx))}
        if not named:
            has_methods = any(option.name == "method" for option in self.params)
            named = {"method": "METHOD"} if has_methods else {"mesh": "KIND"}
        words = " ".join(f"--{argument} {name}" for argument, name in named.items())
        return f"{ctx.command_path} {words} --help"

    def _given(self, ctx: click.Context) -> dict[str, Any]:
        """Return the arguments as far as they can be parsed, before values are checked."""
        args = list(ctx.meta.get(_ARGUMENTS, []))
        for known in (args, args[:-1]):  # the last option may lack its value
            with suppress(click.UsageError):
                return self.make_parser(ctx).parse_args(list(known))[0]
        return {}


def _named(given: dict[str, Any]) -> list[type[OptionSet]]:
    """Return the option sets of the named method and kind of meshes."""
    found: list[type[OptionSet] | None] = []
    if given.get("method") in METHOD.choices:
        effort = given.get("effort")
        choice = chosen(given["method"], effort if effort in EFFORTS else DEFAULT_EFFORT)
        found.append(type(choice.own))
    found.append(options_of_mesh(given.get("mesh") or ""))
    return [kind for kind in found if kind is not None]
