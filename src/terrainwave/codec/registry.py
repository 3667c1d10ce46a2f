"""The refiners by the names of their methods; each is imported when it is asked for."""

from importlib import import_module

from terrainwave.codec.refiner import Refiner
from terrainwave.errors import UnsupportedVersionError
from terrainwave.names import METHODS


def refiner_by_name(name: str, parameters: bytes = b"") -> Refiner:
    """Return the refiner of a file's method, with the `parameters` of its header.

    Methods of tiles have none (`names.Method.is_tiled`).

    Raises
    ------
    UnsupportedVersionError
        If this version has no such method, or doesn't know its parameters.
    CorruptStreamError
        If the parameters contradict FORMAT.md.
    """
    if name not in METHODS:
        raise UnsupportedVersionError(
            f"the file uses method {name!r}; this terrainwave has {', '.join(METHODS)}:"
            " install a newer one"
        )
    method = METHODS[name]
    check_parameters(name, parameters)
    assert method.refiner is not None, f"method {name} codes tiles"
    module, kind = method.refiner.split(".")
    made = getattr(import_module(f"terrainwave.codec.{module}"), kind)
    refiner: Refiner = made(parameters) if method.has_parameters else made()
    return refiner


def check_parameters(name: str, parameters: bytes) -> None:
    """Refuse parameters of a method that has none.

    Raises
    ------
    UnsupportedVersionError
        If there are.
    """
    if parameters and not METHODS[name].has_parameters:
        raise UnsupportedVersionError(
            f"the file has parameters for method {name}, which this terrainwave does not know:"
            " install a newer one"
        )
