"""What heights had lost before they are read: those of a .twz file that is a source itself."""

from collections.abc import Mapping
from typing import NamedTuple

from terrainwave.container.metadata import EARLIER


class EarlierFile(NamedTuple):
    """One file that heights went through, and its bound from their original, in physical units."""

    file: str
    max_error: float


class EarlierLoss(NamedTuple):
    """How far heights may be from their original, in physical units, and the files between.

    The last file's bound is `max_error`. A lossless file leaves no file.
    """

    max_error: float
    files: tuple[EarlierFile, ...] = ()


NO_LOSS = EarlierLoss(0.0)


def earlier_files(metadata: Mapping[str, object]) -> tuple[EarlierFile, ...]:
    """Return the files that a file's heights went through before; what is no such list is none."""
    found = metadata.get(EARLIER)
    files = found if isinstance(found, list) else []
    return tuple(
        EarlierFile(file["file"], float(file["max_error"]))
        for file in files
        if isinstance(file, dict)
        and isinstance(file.get("file"), str)
        and isinstance(file.get("max_error"), int | float)
    )
