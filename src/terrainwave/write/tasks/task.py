"""Runs a task on a worker."""

import os
import socket
import sys
import tempfile
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, Self

from terrainwave.arguments import in_one_line
from terrainwave.container.depot import Meter
from terrainwave.errors import CorruptStreamError, StorageError, TerrainwaveError
from terrainwave.write.tasks.heap import kept_heap


class Workplace(NamedTuple):
    """A worker: its name, the machine it runs on, and its folder for temporary files."""

    worker: str
    host: str
    folder: str


class Task(Protocol):
    """What a task is told first: something that it opens where it runs."""

    def at(self, meter: Meter, folder: str) -> Self:
        """Return it for one task: `meter` counts what it reads, `folder` has temporary files."""
        ...


class TaskOutcome(NamedTuple):
    """What became of a task: its result, or an error that another worker may not have."""

    result: Any
    error: TerrainwaveError | None
    place: Workplace
    meter: Meter


def run_task(function: Callable[..., Any], task: Task, *arguments: Any) -> TaskOutcome:
    """Run a task.

    Errors that depend on the worker (its disk, memory and network, what it sees of the depot and
    the raster) are part of the outcome; others are raised.
    """
    place, meter = workplace(), Meter()
    result: Any = None
    error: TerrainwaveError | None = None
    try:
        with kept_heap():
            result = function(task.at(meter, place.folder), *arguments)
    except (StorageError, CorruptStreamError) as problem:
        error = problem
    except (OSError, MemoryError) as problem:
        reason = "out of memory" if isinstance(problem, MemoryError) else in_one_line(problem)
        error = StorageError(f"the worker cannot do its task: {reason}")
    return TaskOutcome(result, error, place, meter)


def workplace() -> Workplace:
    """Return who runs this: a dask worker, whose folder is its own, or this process."""
    host = socket.gethostname()
    distributed = sys.modules.get("distributed")
    if distributed is not None:
        try:
            worker = distributed.get_worker()
        except ValueError:  # this is none
            pass
        else:
            return Workplace(worker.address, host, worker.local_directory)
    return Workplace(f"process {os.getpid()}", host, tempfile.gettempdir())
