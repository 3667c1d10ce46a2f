"""Progress reports of long-running work."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from terrainwave import interrupts
from terrainwave.arguments import check_callback

# Calls in shorter intervals are dropped, except the last of a stage.
_INTERVAL = 0.1


@dataclass(frozen=True)
class Progress:
    """Progress of a stage: samples `done` of `total`, bytes of heights read and of file written.

    Stages that code units (groups and root blocks) also report `n_units` of `n_units_total`, on
    `n_levels` levels; stages on a cluster `n_tasks` of `n_tasks_total`.
    """

    stage: str
    done: int
    total: int
    n_bytes_in: int = 0
    n_bytes_out: int = 0
    n_units: int = 0
    n_units_total: int = 0
    n_levels: int = 0
    n_tasks: int = 0
    n_tasks_total: int = 0


ProgressCallback = Callable[[Progress], None]


class Reporter:
    """Calls a callback at most ten times a second, from one thread at a time.

    Raises
    ------
    InvalidArgumentError
        If it is neither None nor callable.
    """

    def __init__(self, callback: ProgressCallback | None) -> None:
        check_callback(callback)
        self._callback = callback
        self._lock = threading.Lock()
        self._last = 0.0

    def report(self, stage: str, done: int, total: int, n_bytes_in: int = 0, **more: int) -> None:
        """Call the callback unless the last call was just now; `more` are fields of `Progress`."""
        interrupts.check()
        if self._callback is None:
            return
        with self._lock:
            now = time.monotonic()
            if now - self._last < _INTERVAL and done < total:
                return
            self._last = now
            self._callback(Progress(stage, done, total, n_bytes_in, **more))

    def counter(
        self, stage: str, total: int, itemsize: int, more: Callable[[], dict[str, int]] = dict
    ) -> Callable[[int], None]:
        """Return a counter of finished samples of `itemsize` bytes, for any thread.

        `more` returns further fields of `Progress`.
        """
        lock = threading.Lock()
        done = 0

        def count(n_samples: int) -> None:
            nonlocal done
            with lock:
                done = min(done + n_samples, total)
                self.report(stage, done, total, done * itemsize, **more())

        return count
