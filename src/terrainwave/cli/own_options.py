"""``-o NAME=VALUE``: options of the method and of the kind of meshes that a command uses.

An option that only one method or one kind of meshes has is given by ``-o``, and the command's help
lists it if that method or kind is named.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import click

from terrainwave.arguments import one_of
from terrainwave.cli.options import on_command_line
from terrainwave.cli.output import Command, own_sets
from terrainwave.codec.method_options import chosen
from terrainwave.errors import InvalidArgumentError
from terrainwave.names import DEFAULT_EFFORT, DEFAULT_MESH, EFFORTS, METHODS
from terrainwave.option_sets import OptionSet
from terrainwave.tri import mesh_options

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
