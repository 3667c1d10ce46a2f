"""What heights had lost before they are read: those of a .twz file that is a source itself."""

from collections.abc import Mapping
from typing import NamedTuple

from terrainwave.container.metadata import EARLIER


class Step(NamedTuple):
    """One file that heights went through, and its bound from their original, in physical units."""

    file: str
    max_error: float


class EarlierLoss(NamedTuple):
    """How far heights may be from their original, in physical units, and the files between.

    The last step's bound is `max_error`. A lossless file leaves no step.
    """

    max_error: float
    steps: tuple[Step, ...] = ()


NO_LOSS = EarlierLoss(0.0)


def steps_of(metadata: Mapping[str, object]) -> tuple[Step, ...]:
    """Return the files that a file's heights went through before; what is no such list is none."""
    found = metadata.get(EARLIER)
    steps = found if isinstance(found, list) else []
    return tuple(
        Step(step["file"], float(step["max_error"]))
        for step in steps
        if isinstance(step, dict)
        and isinstance(step.get("file"), str)
        and isinstance(step.get("max_error"), int | float)
    )
