"""Earlier loss of heights that come from .twz files."""

from collections.abc import Mapping
from typing import NamedTuple

from terrainwave.container.metadata import EARLIER


class EarlierFile(NamedTuple):
    """A file that heights went through, and its bound from their original, in physical units."""

    file: str
    max_error: float


class EarlierLoss(NamedTuple):
    """Largest distance of heights from their original, in physical units, and the files between.

    `max_error` is the last file's bound. Lossless files are not listed.
    """

    max_error: float
    files: tuple[EarlierFile, ...] = ()


NO_LOSS = EarlierLoss(0.0)


def earlier_files(metadata: Mapping[str, object]) -> tuple[EarlierFile, ...]:
    found = metadata.get(EARLIER)
    files = found if isinstance(found, list) else []
    return tuple(
        EarlierFile(file["file"], float(file["max_error"]))
        for file in files
        if isinstance(file, dict)
        and isinstance(file.get("file"), str)
        and isinstance(file.get("max_error"), int | float)
    )
