"""Threads that take one piece of work after another until they are closed."""

import threading
from abc import ABC, abstractmethod
from typing import Any


class Threads(ABC):
    """Daemon threads: they end with the process, whatever they wait for.

    A subclass sets its own attributes first. `has_work` and `take` are called with `changed` held,
    which is notified after each change of the work.
    """

    def __init__(self, name: str, n_threads: int) -> None:
        self._changed = threading.Condition()
        self._is_closed = False
        self._threads = [
            threading.Thread(target=self._run, name=f"terrainwave-{name}-{k}", daemon=True)
            for k in range(n_threads)
        ]
        for thread in self._threads:
            thread.start()

    @abstractmethod
    def _has_work(self) -> bool: ...
    @abstractmethod
    def _take(self) -> Any: ...
    @abstractmethod
    def _do(self, work: Any) -> None: ...

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed or self._has_work())
                if self._is_closed:
                    return
                work = self._take()
            self._do(work)

    def close(self, patience: float | None = None) -> None:
        """Start no more work, and wait for running work, which uses objects about to close.

        `patience` limits the seconds to wait for each thread; by default until its work is done.
        """
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(patience)
