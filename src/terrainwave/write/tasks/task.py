"""Runs a task on a worker."""

import os
import socket
import sys
import tempfile
from collections.abc import Callable
from typing import Any, NamedTuple

from terrainwave.arguments import in_one_line
from terrainwave.errors import CorruptStreamError, StorageError, TerrainwaveError
from terrainwave.write.tasks.heap import kept_heap


class Workplace(NamedTuple):
    """A worker: its name, its machine, and its folder for temporary files."""

    worker: str
    host: str
    folder: str


class TaskOutcome(NamedTuple):
    """Outcome of a task: its result, or an error that another worker may not have."""

    result: Any
    error: TerrainwaveError | None
    place: Workplace


def run_task(function: Callable[..., Any], *arguments: Any) -> TaskOutcome:
    """Run a task.

    Errors that depend on the worker (disk, memory, network, access to depot and raster) are part of
    the outcome; others are raised.
    """
    result: Any = None
    error: TerrainwaveError | None = None
    try:
        with kept_heap():
            result = function(*arguments)
    except (StorageError, CorruptStreamError) as problem:
        error = problem
    except (OSError, MemoryError) as problem:
        reason = "out of memory" if isinstance(problem, MemoryError) else in_one_line(problem)
        error = StorageError(f"the worker cannot do its task: {reason}")
    return TaskOutcome(result, error, workplace())


def workplace() -> Workplace:
    """Return the place of this code: a dask worker with its folder, or this process."""
    host = socket.gethostname()
    distributed = sys.modules.get("distributed")
    if distributed is not None:
        try:
            worker = distributed.get_worker()
        except ValueError:  # not on a dask worker
            pass
        else:
            return Workplace(worker.address, host, worker.local_directory)
    return Workplace(f"process {os.getpid()}", host, tempfile.gettempdir())
