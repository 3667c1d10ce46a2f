"""Options, each declared once: the field of a class with its values, default and help.

The field is the keyword in Python, the option of commands (`cli.options.declared`; ``-o`` for
options of a method or of a kind of meshes) and the key in metadata. It checks its value.
"""

from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from functools import partial
from importlib import import_module
from typing import Any, ClassVar, Self, cast

from terrainwave.arguments import (
    check_choice,
    check_flags,
    checked_number,
    checked_numbers,
    checked_path,
    checked_tile_size,
    checked_whole,
    nodata_choice,
    one_of,
)
from terrainwave.errors import InvalidArgumentError


@dataclass(frozen=True)
class Kind:
    """Values of an option: how they are checked, read from text, and shown in help.

    Attributes
    ----------
    checked : callable
        Takes the option's name and a value; returns the value, or raises `InvalidArgumentError`.
    read : callable
        Takes text; returns the value to check.
    values : str
        The values as help shows them; empty for a flag.
    choices : tuple of str
        The words to choose from, if these are all values.
    limits : dict
        Those of a number, as `checked_number` takes them.
    """

    checked: Callable[[str, Any], Any]
    read: Callable[[str], Any] = str
    values: str = ""
    choices: tuple[str, ...] = ()
    limits: Mapping[str, float] = field(default_factory=dict)

    def from_text(self, text: str, found: str = "") -> Any:
        """Return the value that a command was given as text; messages call it `found`."""
        try:
            return self.checked("value", self.read(text))
        except InvalidArgumentError as error:
            expected = error.args[0].rpartition(", expected ")[2]
            raise InvalidArgumentError(f"found {found or text}, expected {expected}") from None


def _checked_flag(name: str, value: Any) -> bool:
    check_flags(**{name: value})
    return bool(value)


FLAG = Kind(_checked_flag)
PATH = Kind(lambda name, value: checked_path(value, name), values="path")


def words(*choices: str) -> Kind:
    """Return the kind of an option with some words as values."""

    def checked(name: str, value: Any) -> str:
        check_choice(name, value, choices)
        return str(value)

    return Kind(checked, values="|".join(choices), choices=choices)


def whole(*choices: int, expected: str = "") -> Kind:
    """Return the kind of an option with some whole numbers as values."""
    texts = [*map(str, choices)]
    expected = expected or (one_of(texts) if len(texts) < 3 else f"one of {', '.join(texts)}")

    def checked(name: str, value: Any) -> int:
        found = checked_whole(name, value, expected=expected)
        if found not in choices:
            raise InvalidArgumentError(f"found `{name}` {found}, expected {expected}")
        return found

    return Kind(checked, number_in, "|".join(texts))


def number(**limits: Any) -> Kind:
    """Return the kind of an option with a finite number, in the limits of `checked_number`."""
    return Kind(partial(checked_number, **limits), number_in, "NUMBER", limits=limits)


def numbers(names: str, *, is_whole: bool = False) -> Kind:
    """Return the kind of an option with several finite numbers, separated by commas."""
    return Kind(
        lambda name, value: checked_numbers(name, value, names, is_whole=is_whole),
        lambda text: [number_in(part) for part in text.split(",")],
        names.replace(" ", ""),
    )


def number_in(text: str) -> float | str:
    """Return the number that a text is; other text unchanged, which a check then refuses."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def option(
    kind: Kind, help: str = "", *, default: Any = None, typed: Mapping[str, Any] | None = None
) -> Any:
    """Return the field of an option.

    Parameters
    ----------
    kind : Kind
        Its values. Without a default, None is one, too.
    help : str
        The help of commands. Without it, no command has the option.
    default : object
        Of the keyword. A flag whose default is True is an option of commands that switches it off.
    typed : dict, optional
        Arguments of `click.option` where commands differ: `names`, `metavar`, `default` and others.
        With `has_range`, help shows the limits of a number.
    """
    return field(default=default, metadata={"kind": kind, "help": help, "typed": typed or {}})


def _checked_nodata(_: str, value: Any) -> Any:
    nodata_choice(value)
    return value


def _checked_tile_size(name: str, value: Any) -> int | str:
    return "window" if value == "window" else checked_tile_size(name, value)


NODATA = Kind(_checked_nodata, number_in, "number|only:number|none")
TILE_SIZE = Kind(_checked_tile_size, number_in, "2ⁿ+1|window")
WINDOW = numbers("row, col, n_rows, n_cols", is_whole=True)
BOUNDS = numbers("left, bottom, right, top")


@dataclass(frozen=True, kw_only=True)
class OptionSet:
    """Options that belong together, checked when the set is made.

    Raises
    ------
    InvalidArgumentError
        If an option, or a combination, is invalid; the message says what was found and expected.
    """

    # The thing that they configure, and the argument that takes the set.
    name: ClassVar[str] = ""
    argument: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for one in self.options():
            value = getattr(self, one.name)
            if value is not None or one.default is not None:
                object.__setattr__(self, one.name, one.metadata["kind"].checked(one.name, value))

    @classmethod
    def options(cls) -> list[Field[Any]]:
        """Return the fields that are options."""
        return [one for one in fields(cls) if "kind" in one.metadata]

    @classmethod
    def names(cls) -> list[str]:
        return [one.name for one in cls.options()]

    @classmethod
    def from_words(cls, words: Mapping[str, str]) -> Self:
        """Parse a set from words by name: NAME=VALUE, or NAME for a flag."""
        kinds = {one.name: one.metadata["kind"] for one in cls.options()}
        values: dict[str, Any] = {}
        for name, word in words.items():
            kind, (_, sign, text) = kinds[name], word.partition("=")
            if not sign and kind is not FLAG:
                raise InvalidArgumentError(
                    f"found `{name}` without a value, expected `{name}`={kind.values}"
                )
            if sign and kind is FLAG:
                raise InvalidArgumentError(
                    f"found `{name}`={text}, expected `{name}` alone, which switches it on"
                )
            values[name] = not sign or kind.from_text(text, f"`{name}`={text}")
        return cls(**values)

    @classmethod
    def described(cls) -> list[tuple[str, str]]:
        """Return each option as -o takes it, with its help."""
        return [
            (f"{one.name}={one.metadata['kind'].values}".rstrip("="), one.metadata["help"])
            for one in cls.options()
        ]

    def to_metadata(self) -> dict[str, Any]:
        """Return the options that are set, as plain values for JSON."""
        values = {name: getattr(self, name) for name in self.names()}
        # Compared by identity: a bound of 0 equals False.
        return {name: v for name, v in values.items() if v is not None and v is not False}

    def call(self) -> str:
        """Return the Python call that makes the set."""
        given = ", ".join(
            f"{one.name}={getattr(self, one.name)!r}"
            for one in self.options()
            if getattr(self, one.name) != one.default
        )
        return f"tw.{type(self).__name__}({given})"


def set_at(place: str) -> type[OptionSet]:
    """Return the class of options at a place: its module and its name."""
    module, name = place.rsplit(".", 1)
    return cast(type[OptionSet], getattr(import_module(module), name))
