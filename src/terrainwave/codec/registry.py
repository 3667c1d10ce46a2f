"""The refiners by the names of their methods; each is imported when it is asked for."""

from importlib import import_module

from terrainwave.codec.refiner import Refiner
from terrainwave.errors import CorruptStreamError, UnsupportedVersionError
from terrainwave.names import METHODS, REACH_LAYOUT, WEIGHTS_LAYOUT


def refiner_by_name(name: str, file_tables: bytes = b"") -> Refiner:
    """Return the refiner of a file's method, with the tables of its header.

    Methods of tiles have none (`names.Method.is_tiled`).

    Raises
    ------
    UnsupportedVersionError
        If this version has no such method, or doesn't know its tables.
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


def newer_layout(name: str, file_tables: bytes) -> int:
    """Return the layout of a file's tables if readers of format 1.0 don't know it, else 0."""
    layout = file_tables[0] if METHODS[name].has_reach and file_tables else 0
    return layout if layout in (REACH_LAYOUT, WEIGHTS_LAYOUT) else 0


def check_layout(name: str, file_tables: bytes, told: int) -> None:
    """Refuse tables of another layout than the header says.

    `told` is the layout that a feature bit stands for, 0 without one. Files with contexts by reach
    that do not say so are older than their bit, and sound.

    Raises
    ------
    CorruptStreamError
        If the header says what the tables are not, or not that they have weights.
    """
    layout = newer_layout(name, file_tables)
    if told == REACH_LAYOUT and layout != told:
        raise CorruptStreamError("the header says that contexts are by reach, the tables do not")
    if told == WEIGHTS_LAYOUT and layout != told:
        raise CorruptStreamError(
            "the header says that the tables have weights of features, and they have none"
        )
    if told != WEIGHTS_LAYOUT and layout == WEIGHTS_LAYOUT:
        raise CorruptStreamError(
            "the tables have weights of features, and the header does not say so"
        )


def check_file_tables(name: str, file_tables: bytes) -> None:
    """Refuse tables of a method that has none.

    Raises
    ------
    UnsupportedVersionError
        If the method has none.
    """
    if file_tables and not METHODS[name].has_file_tables:
        raise UnsupportedVersionError(
            f"the file has parameters for method {name}, which this terrainwave does not know:"
            " install a newer one"
        )
