"""The annexes of the format: tables that every reader has, as data files (FORMAT.md §15).

Readers in other languages load the same files. A file that is in use is never changed.
Kernels take tables as arguments, not as constants: numba's cache knows only sources.
"""

from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from terrainwave.errors import StorageError


@cache
def read_annex(name: str) -> bytes:
    """Return the bytes of an annex, which is read once.

    Raises
    ------
    StorageError
        If the file cannot be read: the installation is incomplete.
    """
    path = Path(__file__).with_name(name)
    try:
        return path.read_bytes()
    except OSError as error:
        raise StorageError(
            f"{path}: {error.strerror}; terrainwave needs this table: install it again, with its"
            " data files"
        ) from None


def read_tables(name: str, layout: DTypeLike) -> np.void:
    """Return the tables of an annex by name, each an array in the byte order of the file.

    Parameters
    ----------
    name
        The file.
    layout
        A structured dtype: the tables in the order of the file, with nothing between them.

    Raises
    ------
    StorageError
        If the file cannot be read, or has another size.
    """
    data, n_bytes = read_annex(name), np.dtype(layout).itemsize
    if len(data) != n_bytes:
        raise StorageError(
            f"{Path(__file__).with_name(name)}: {len(data)} bytes, expected {n_bytes}: install"
            " terrainwave again"
        )
    return np.frombuffer(data, layout)[0]
