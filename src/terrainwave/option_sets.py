"""Options of a method or of a kind of meshes: declared once, for Python and for commands.

Each set is a class in the package that it configures (`codec.cdf97`, `tri.rqt`). The library takes
an object, ``method=tw.Cdf97(faithful=True)``, the command line words, ``--method cdf97 -o
faithful``.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Self

from terrainwave.arguments import check_choice, check_flags, checked_number, checked_whole, one_of
from terrainwave.errors import InvalidArgumentError


@dataclass(frozen=True)
class _Kind:
    """Values of an option: how they are checked, parsed, and shown in help."""

    checked: Callable[[str, Any], Any]
    read: Callable[[str], Any]
    values: str


def flag(help: str) -> Any:
    """Return the field of an option that is off by default."""

    def checked(name: str, value: Any) -> bool:
        check_flags(**{name: value})
        return bool(value)

    return _field(False, help, _Kind(checked, str, ""))


def choice(help: str, *values: str, default: str | None) -> Any:
    """Return the field of an option with some words as values; None if it may be left out."""

    def checked(name: str, value: Any) -> Any:
        if value is not None or default is not None:
            check_choice(name, value, values)
        return value

    return _field(default, help, _Kind(checked, str, "|".join(values)))


def whole(help: str, *values: int) -> Any:
    """Return the field of an option with some whole numbers as values; the first is the default."""
    expected = one_of([*map(str, values)])

    def checked(name: str, value: Any) -> int:
        number = checked_whole(name, value, expected=expected)
        if number not in values:
            raise InvalidArgumentError(f"found `{name}` {number}, expected {expected}")
        return number

    return _field(values[0], help, _Kind(checked, _number, "|".join(map(str, values))))


def positive(help: str) -> Any:
    """Return the field of an option with a number > 0 as value; None if it is left out."""

    def checked(name: str, value: Any) -> float | None:
        return None if value is None else checked_number(name, value, above=0)

    return _field(None, help, _Kind(checked, _number, "NUMBER"))


def _field(default: Any, help: str, kind: _Kind) -> Any:
    return field(default=default, metadata={"help": help, "kind": kind})


def _number(text: str) -> float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text  # refused by the check


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
        for option in fields(self):
            value = option.metadata["kind"].checked(option.name, getattr(self, option.name))
            object.__setattr__(self, option.name, value)

    @classmethod
    def names(cls) -> list[str]:
        return [option.name for option in fields(cls)]

    @classmethod
    def from_words(cls, words: dict[str, str | None]) -> Self:
        """Parse a set from words; a flag has no value."""
        kinds = {option.name: option.metadata["kind"] for option in fields(cls)}
        values: dict[str, Any] = {}
        for name, word in words.items():
            kind = kinds[name]
            if word is None and kind.values:
                raise InvalidArgumentError(
                    f"found `{name}` without a value, expected `{name}`={kind.values}"
                )
            if word is not None and not kind.values:
                raise InvalidArgumentError(
                    f"found `{name}`={word}, expected `{name}` alone, which switches it on"
                )
            value = values[name] = True if word is None else kind.read(word)
            try:
                kind.checked(name, value)
            except InvalidArgumentError as error:
                expected = error.args[0].rpartition(", expected ")[2]
                raise InvalidArgumentError(f"found `{name}`={word}, expected {expected}") from None
        return cls(**values)

    @classmethod
    def described(cls) -> list[tuple[str, str]]:
        """Return each option as on the command line, with its help."""
        rows = []
        for option in fields(cls):
            values = option.metadata["kind"].values
            rows.append((f"{option.name}={values}".rstrip("="), option.metadata["help"]))
        return rows

    def call(self) -> str:
        """Return the Python call that makes the set."""
        given = ", ".join(
            f"{option.name}={getattr(self, option.name)!r}"
            for option in fields(self)
            if getattr(self, option.name) != option.default
        )
        return f"tw.{type(self).__name__}({given})"


def refuse_unknown(
    name: str, argument: str, sets: Sequence[type[OptionSet]], *, given: str, found: str
) -> None:
    """Raise for an option that the set in use lacks; name the sets that have it.

    Parameters
    ----------
    name, argument : str
        Name of the option, and of the argument that takes a set.
    sets : sequence of type
        All sets.
    given, found : str
        The option and the set as the user has written them.

    Raises
    ------
    InvalidArgumentError
        Always.
    """
    having = one_of([each.name for each in sets if name in each.names()] or [""])
    raise InvalidArgumentError(f"found {given} and {found}, expected `{argument}` {having}")
