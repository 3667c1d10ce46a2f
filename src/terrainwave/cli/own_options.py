"""``-o NAME=VALUE``: options of the method and of the kind of meshes that a command uses.

One rule for both: an option that only one method or one kind of meshes has is given by ``-o``, and
listed by the command's help where that method or kind is named.
"""

from collections.abc import Callable, Sequence
from typing import Any

import click

from terrainwave.arguments import one_of
from terrainwave.cli.options import METHOD
from terrainwave.cli.output import Command, print_note
from terrainwave.codec.method_options import chosen
from terrainwave.codec.method_options import options_of as options_of_method
from terrainwave.names import DEFAULT_EFFORT, DEFAULT_MESH, EFFORTS, MESH_KINDS, METHODS
from terrainwave.option_sets import OptionSet, refuse_unknown
from terrainwave.tri.mesh_options import MeshOptions, of_former_name
from terrainwave.tri.mesh_options import options_of as options_of_mesh

_ARGUMENTS = "terrainwave.arguments"
_FORMER = "terrainwave.former"

Words = dict[str, str | None]


def own_option(help: str) -> Callable[[Any], Any]:
    """Return the option -o."""
    return click.option("-o", "own", multiple=True, metavar="NAME[=VALUE]", help=help)


class MeshKind(click.Choice[str]):
    """A kind of meshes. Names of 1.0 for kinds with options are taken, with a note."""

    def __init__(self, *more: str) -> None:
        super().__init__([*MESH_KINDS, *more])

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the name of the kind, or the options that a former name stands for."""
        if value == "auto" or isinstance(value, MeshOptions):
            return value
        former = of_former_name(value)
        if former is None:
            return super().convert(value, param, ctx)
        words = " ".join(f"-o {name}={getattr(former, name)}" for name in former.names())
        _note_former(f"--mesh {value}", f"--mesh {former.name} {words}")
        return former


def former_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add what `compress` took in 1.0 instead of -o; it is in no help."""
    for name, values in (("rate", {}), ("psnr", {}), ("border-rings", {}), ("faithful", _FLAG)):
        command = click.option(
            f"--{name}", hidden=True, expose_value=False, callback=_take_former, **values
        )(command)
    return command


_FLAG: dict[str, Any] = {"is_flag": True}


def _take_former(ctx: click.Context, param: click.Parameter, value: Any) -> None:
    if not value or ctx.resilient_parsing:
        return
    word = str(param.name) if value is True else f"{param.name}={value}"
    if word == "border_rings=1":
        _note_former("--border-rings 1", "nothing: 1 is the default")
        return
    owners = [
        name
        for name in METHODS
        if (kind := options_of_method(name)) is not None and param.name in kind.names()
    ]
    method = f"--method {owners[0]} " if len(owners) == 1 else ""
    _note_former(param.opts[0], f"{method}-o {word}")
    ctx.meta.setdefault(_FORMER, []).append(word)


def _note_former(former: str, new: str) -> None:
    print_note(f"{former} works until terrainwave 2.0; write {new}")


def with_own_options(own: Sequence[str], options: dict[str, Any]) -> dict[str, Any]:
    """Return options of a command with those of -o in their place.

    Parameters
    ----------
    own : sequence of str
        What -o was given.
    options : dict
        Has `mesh`, and `method` and `effort` where the command has these.

    Raises
    ------
    click.UsageError, InvalidArgumentError
        If the method and the kind of meshes have no such option, or it cannot have the value.
    """
    former = click.get_current_context().meta.get(_FORMER, [])
    words = _words(own)
    for name, value in _words(former).items():
        if name in words:
            option = f"--{name.replace('_', '-')}"
            raise click.UsageError(f"found {option} and -o {name}, expected one of them")
        words[name] = value
    mesh = options.get("mesh") or "auto"
    of_mesh = options_of_mesh(mesh) if isinstance(mesh, str) else None
    found: dict[str, Any] = {}
    taken = {name: words.pop(name) for name in list(words) if of_mesh and name in of_mesh.names()}
    if of_mesh is not None and taken:
        found["mesh"] = of_mesh.from_words(taken)
    if "method" in options:
        method, effort, _, _ = chosen(options["method"], options["effort"])
        _refuse_others(words, options["method"], type(method), mesh, of_mesh)
        if words:
            found |= {"method": type(method).from_words(words), "effort": effort}
    else:
        _refuse_others(words, "", None, mesh, of_mesh)
    return options | found


def _words(own: Sequence[str]) -> Words:
    """Return the words of -o by their names."""
    words: Words = {}
    for text in own:
        name, sign, value = text.partition("=")
        name = name.replace("-", "_")
        if not name:
            raise click.UsageError(f"found -o {text or repr(text)}, expected NAME or NAME=VALUE")
        if name in words:
            raise click.UsageError(f"found -o {name} twice, expected it once")
        words[name] = value if sign else None
    return words


def _refuse_others(
    words: Words,
    method: str,
    of_method: type[OptionSet] | None,
    mesh: Any,
    of_mesh: type[OptionSet] | None,
) -> None:
    """Refuse options that neither the method nor the kind of meshes has, and say who has them."""
    known = [name for each in (of_method, of_mesh) if each is not None for name in each.names()]
    meshes = [kind for name in MESH_KINDS if (kind := options_of_mesh(name)) is not None]
    methods = [options_of_method(name) for name in METHODS]
    for name in words:
        if name in known:
            continue
        if any(name in kind.names() for kind in meshes):
            found = mesh if isinstance(mesh, str) else mesh.former_name
            refuse_unknown(name, "mesh", DEFAULT_MESH if found == "auto" else found, meshes)
        if of_method is not None and any(name in kind.names() for kind in methods):
            refuse_unknown(name, "method", method, methods)
        expected = f"-o {one_of(known)}" if known else "no option of these meshes"
        raise click.UsageError(f"found -o {name}, expected {expected}")


class CommandWithOwnOptions(Command):
    """A command whose help lists the options of the method and the meshes that are named."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Keep the arguments for the help, which comes before any option is read."""
        ctx.meta[_ARGUMENTS] = list(args)
        return super().parse_args(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options of the command, then those of -o."""
        super().format_options(ctx, formatter)
        given, _, _ = self.make_parser(ctx).parse_args(list(ctx.meta.get(_ARGUMENTS, [])))
        for kind in _named(given):
            with formatter.section(f"Options of --{kind.argument} {kind.name}"):
                formatter.write_dl([(f"-o {words}", help) for words, help in kind.described()])


def _named(given: dict[str, Any]) -> list[type[OptionSet]]:
    """Return the option sets of the method and the kind of meshes that arguments name."""
    found: list[type[OptionSet] | None] = []
    if given.get("method") in METHOD.choices:
        effort = given.get("effort")
        choice = chosen(given["method"], effort if effort in EFFORTS else DEFAULT_EFFORT)
        found.append(type(choice.own))
    found.append(options_of_mesh(given.get("mesh") or ""))
    return [kind for kind in found if kind is not None]
