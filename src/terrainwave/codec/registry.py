"""Registry of refiners by method; each is imported on demand."""

from importlib import import_module

from terrainwave.codec.refiner import Refiner
from terrainwave.errors import UnsupportedVersionError
from terrainwave.names import METHODS


def refiner_by_name(name: str, file_tables: bytes = b"") -> Refiner:
    """Return the refiner of a file's method, with the tables of its header.

    Methods with tiles have none (`names.Method.is_tiled`).

    Raises
    ------
    UnsupportedVersionError
        If this version has no such method, or does not support its tables.
    CorruptStreamError
        If the tables contradict FORMAT.md.
    """
    if name not in METHODS:
        raise UnsupportedVersionError(
            f"the file uses method {name!r}; this terrainwave has {', '.join(METHODS)}:"
            " install a newer one"
        )
    method = METHODS[name]
    check_file_tables(name, file_tables)
    assert method.refiner is not None, f"method {name} codes tiles"
    module, kind = method.refiner.rsplit(".", 1)
    made = getattr(import_module(f"terrainwave.codec.{module}"), kind)
    refiner: Refiner = made(file_tables) if method.has_file_tables else made()
    return refiner


def check_file_tables(name: str, file_tables: bytes) -> None:
    """Raise `UnsupportedVersionError` for tables of a method without tables."""
    if file_tables and not METHODS[name].has_file_tables:
        raise UnsupportedVersionError(
            f"the file has parameters for method {name}, which this terrainwave does not know:"
            " install a newer one"
        )
