"""Check for private names of numba."""

import inspect
from collections.abc import Iterable, Mapping
from types import FunctionType
from typing import Any


def missing(needed: Mapping[type, Iterable[str]]) -> list[str]:
    """Return the names that classes lack.

    A name may be an attribute of the class, or one that its methods read or set. With arguments in
    brackets, ``run(self, emit_dels)``, it must be a method with exactly these.
    """
    return [
        f"{owner.__name__}.{name}"
        for owner, names in needed.items()
        for name in names
        if not (_has_arguments if "(" in name else _has)(owner, name)
    ]


def _has(owner: type, name: str) -> bool:
    return hasattr(owner, name) or any(
        name in code.co_names for one in owner.__mro__ for code in _codes_of(one)
    )


def _has_arguments(owner: type, text: str) -> bool:
    name, _, arguments = text.rstrip(")").partition("(")
    function = inspect.unwrap(getattr(owner, name, None) or len)
    return isinstance(function, FunctionType) and arguments.split(", ") == list(
        inspect.signature(function).parameters
    )


def _codes_of(owner: type) -> Iterable[Any]:
    """Yield the code of a class's own methods."""
    for value in vars(owner).values():
        function = inspect.unwrap(getattr(value, "fget", None) or getattr(value, "__func__", value))
        if isinstance(function, FunctionType):
            yield function.__code__
