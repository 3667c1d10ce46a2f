"""The refiners by the names of their methods; each is imported when it is asked for."""

from importlib import import_module

from terrainwave.codec.refiner import Refiner
from terrainwave.errors import CorruptStreamError, UnsupportedVersionError
from terrainwave.names import METHODS, REACH_LAYOUT


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


def has_reach(name: str, parameters: bytes) -> bool:
    """Say whether the tables of a file have contexts by reach (format-rapid.md R.10)."""
    return METHODS[name].has_reach and parameters[:1] == bytes([REACH_LAYOUT])


def check_parameters(name: str, parameters: bytes, *, says_reach: bool = False) -> None:
    """Refuse parameters of a method that has none, or others than the header says.

    Files with contexts by reach that do not say so are older than the feature bit, and sound.

    Raises
    ------
    UnsupportedVersionError
        If the method has no parameters.
    CorruptStreamError
        If the header says that contexts are by reach, and they are not.
    """
    if says_reach and not has_reach(name, parameters):
        raise CorruptStreamError("the header says that contexts are by reach, the tables do not")
    if parameters and not METHODS[name].has_parameters:
        raise UnsupportedVersionError(
            f"the file has parameters for method {name}, which this terrainwave does not know:"
            " install a newer one"
        )
