"""The options of methods: what all have in common, and which method is meant.

Each method has a class of its own, which its line in `names.METHODS` names.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from terrainwave.arguments import check_choice, check_effort, shown
from terrainwave.errors import InvalidArgumentError
from terrainwave.names import (
    DEFAULT_EFFORT,
    DEFAULT_METHOD,
    EFFORTS,
    METHODS,
    SMALLEST_METHOD,
    Method,
)
from terrainwave.option_sets import OptionSet, refuse_unknown, whole


@dataclass(frozen=True, kw_only=True)
class MethodOptions(OptionSet):
    """Options of one method."""

    argument = "method"

    @property
    def method(self) -> Method:
        """Return the method."""
        return METHODS[self.name]


@dataclass(frozen=True, kw_only=True)
class BlockMethodOptions(MethodOptions):
    """Options of a method that codes blocks, which share samples with their neighbours."""

    border_rings: int = whole(
        "Rings of samples on both sides of each block border that neighbouring blocks share"
        " (Yusov & Turlapov 2010, §2.3). Default: 1.",
        1,
        3,
    )


def options_of(name: str) -> type[MethodOptions]:
    """Return the class of a method's options."""
    module, kind = METHODS[name].options.rsplit(".", 1)
    found: type[MethodOptions] = getattr(import_module(f"terrainwave.codec.{module}"), kind)
    return found


def chosen(method: object, effort: str) -> tuple[MethodOptions, str]:
    """Return the options of the method that is meant, and the effort that its files state.

    Parameters
    ----------
    method : str or MethodOptions
        "auto", one of `METHODS`, or the options of one.
    effort : str
        One of `EFFORTS`: what "auto" stands for follows from it.

    Raises
    ------
    InvalidArgumentError
        If there is no such method or effort.
    """
    check_effort(effort)
    if isinstance(method, MethodOptions):
        return method, effort
    if not isinstance(method, str):
        raise InvalidArgumentError(
            f"found `method` {shown(method)}, expected a name, such as {DEFAULT_METHOD.name!r},"
            f" or options of a method, such as {options_of(DEFAULT_METHOD.name)().call()}"
        )
    check_choice("method", method, ("auto", *METHODS))
    if method != "auto":
        return options_of(method)(), effort
    found = SMALLEST_METHOD if effort == EFFORTS[-1] else DEFAULT_METHOD
    return options_of(found.name)(), effort if found.effort else DEFAULT_EFFORT


def chosen_with(method: object, effort: str, given: Mapping[str, Any]) -> tuple[MethodOptions, str]:
    """Return the same with options that were given one by one.

    Raises
    ------
    InvalidArgumentError
        If the method has no such option.
    """
    own, stated = chosen(method, effort)
    for name in given:
        if name not in own.names():
            asked = method if isinstance(method, str) else own.name
            sets = [options_of(each) for each in METHODS]
            refuse_unknown(name, "method", sets, given=f"`{name}`", found=f"`method` {asked}")
    return replace(own, **given), stated


def with_method(own: MethodOptions, method: Method) -> MethodOptions:
    """Return options of another method; those that both have stay."""
    kind = options_of(method.name)
    return kind(**{name: getattr(own, name) for name in own.names() if name in kind.names()})
