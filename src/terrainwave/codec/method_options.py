"""Options of methods: their common base, and the choice of a method.

Each method has a class of its own, which its entry in `names.METHODS` names.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

from terrainwave.arguments import check_choice, check_effort, shown
from terrainwave.errors import InvalidArgumentError
from terrainwave.names import (
    DEFAULT_EFFORT,
    DEFAULT_METHOD,
    EFFORTS,
    METHODS,
    PLAIN_METHOD,
    SMALLEST_METHOD,
    Method,
    methods_that,
)
from terrainwave.option_sets import OptionSet, option, set_at, whole

METHOD_HELP = f"auto is {DEFAULT_METHOD.name}; with --effort best it is {SMALLEST_METHOD.name}."
_EFFORTS = [f"{method.name} {method.effort}" for method in METHODS.values() if method.effort]
EFFORT_HELP = (
    f"Number of variants that the encoder tries: {'; '.join(_EFFORTS)}; other methods have one."
    f" For archives: best without --method selects {SMALLEST_METHOD.name}, whose files are"
    " 0.95 of the default's size (0.79 to 0.99), and are read 6 times as slowly."
)


# Options of `compress` that some methods and faithful files cannot keep, and why.
_WITHOUT_REMAINDERS = {
    "bound": "the others move heights to both sides",
    "stable": "those round heights in ways of their own",
}


@dataclass(frozen=True, kw_only=True)
class MethodOptions(OptionSet):
    """Options of one method."""

    argument = "method"

    @property
    def method(self) -> Method:
        return METHODS[self.name]

    @property
    def is_faithful(self) -> bool:
        """Return whether files follow the method's paper."""
        return False

    @property
    def goal(self) -> str:
        """Return the option that cuts streams instead of a bound, or an empty string."""
        return ""

    @property
    def without_efforts(self) -> str:
        """Return why all efforts give the same file; "" if they do not."""
        return "" if self.method.effort else f"method {self.name} has no efforts"

    def check_beside(self, given: Mapping[str, Any]) -> None:
        """Raise `InvalidArgumentError` for options of `compress` that do not go with these."""
        if not self.is_faithful and self.method.has_remainders:
            return
        for name, reason in _WITHOUT_REMAINDERS.items():
            if name in given:
                fit = methods_that(lambda method: method.has_remainders)
                found = "`faithful`" if self.is_faithful else f"`method` {self.name}"
                asked = f"`{name}`" if given[name] is True else f"`{name}` {given[name]}"
                raise InvalidArgumentError(
                    f"found {asked} and {found}, expected `method` {fit}, and not `faithful`:"
                    f" {reason}"
                )


class MethodChoice(NamedTuple):
    """Method of a raster and the reason for it, decided once by `chosen`.

    Attributes
    ----------
    own : MethodOptions
        The options of the method.
    effort : str
        The effort that its files state.
    reason : str
        Reason for this method.
    other : Method, optional
        Fallback if the method does not make the raster smaller; None: no fallback.
    """

    own: MethodOptions
    effort: str
    reason: str
    other: Method | None


@dataclass(frozen=True, kw_only=True)
class BlockMethodOptions(MethodOptions):
    """Options of a method that codes blocks, which share samples with their neighbours."""

    border_rings: int = option(
        whole(1, 3),
        "Rings of samples on both sides of each block border that neighbouring blocks share"
        " (Yusov & Turlapov 2010, §2.3). Default: 1.",
        default=1,
    )


def options_of(name: str) -> type[MethodOptions]:
    """Return the class of a method's options."""
    return cast(type[MethodOptions], set_at(f"terrainwave.codec.{METHODS[name].options}"))


def chosen(method: object, effort: str) -> MethodChoice:
    """Choose the method for a raster.

    Parameters
    ----------
    method : str or MethodOptions
        "auto", one of `METHODS`, or the options of one.
    effort : str
        One of `EFFORTS`, which decides the meaning of "auto".

    Raises
    ------
    InvalidArgumentError
        If the method or effort is unknown.
    """
    check_effort(effort)
    if isinstance(method, MethodOptions):
        return _choice(method, effort, "asked for with options")
    if not isinstance(method, str):
        raise InvalidArgumentError(
            f"found `method` {shown(method)}, expected a name, such as {DEFAULT_METHOD.name!r},"
            f" or options of a method, such as {options_of(DEFAULT_METHOD.name)().call()}"
        )
    check_choice("method", method, ("auto", *METHODS))
    if method != "auto":
        return _choice(options_of(method)(), effort, "asked for")
    if effort == EFFORTS[-1]:
        return _choice(options_of(SMALLEST_METHOD.name)(), effort, f"effort {effort}: for archives")
    stated = effort if DEFAULT_METHOD.effort else DEFAULT_EFFORT
    return _choice(options_of(DEFAULT_METHOD.name)(), stated, "the default")


def _choice(own: MethodOptions, effort: str, reason: str) -> MethodChoice:
    stays = own.is_faithful or own.goal or own.method == PLAIN_METHOD
    return MethodChoice(own, effort, reason, None if stays else PLAIN_METHOD)


def with_method(own: MethodOptions, method: Method) -> MethodOptions:
    """Return options of another method; common ones keep their values."""
    kind = options_of(method.name)
    return kind(**{name: getattr(own, name) for name in own.names() if name in kind.names()})
