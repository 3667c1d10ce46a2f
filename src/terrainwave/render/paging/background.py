"""Background work for the thread that draws, which polls for results and never waits."""

import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from terrainwave.errors import TerrainwaveError


class Outcome(NamedTuple):
    """A result, or else a message."""

    value: Any
    problem: str | None


_Then = Callable[[Outcome], None]


class Background:
    """Runs functions in threads; `poll` takes their results. Used by one thread.

    Parameters
    ----------
    n_threads : int
        They end with the process, whatever they wait for.
    """

    def __init__(self, n_threads: int = 2) -> None:
        self._tasks: SimpleQueue[tuple[Callable[[], Any], _Then] | None] = SimpleQueue()
        self._done: SimpleQueue[tuple[Any, Exception | None, _Then]] = SimpleQueue()
        self._is_closed = False
        self.n_running = 0  # pending results
        self._threads = [
            threading.Thread(
                target=self._work, name=f"terrainwave-background-{number}", daemon=True
            )
            for number in range(n_threads)
        ]
        for thread in self._threads:
            thread.start()

    def start(self, work: Callable[[], Any], then: _Then) -> None:
        """Run `work` in a thread and `then`, with its outcome, in a later `poll`."""
        self.n_running += 1
        self._tasks.put((work, then))

    def poll(self) -> None:
        """Handle the finished results.

        Raises
        ------
        Exception
            An exception of a function that is not a `TerrainwaveError`.
        """
        while True:
            try:
                value, error, then = self._done.get_nowait()
            except Empty:
                return
            self.n_running -= 1
            if error is not None and not isinstance(error, TerrainwaveError):
                raise error
            then(Outcome(value, None if error is None else str(error)))

    def close(self, patience: float | None = None) -> None:
        """Start no more work, and wait for running work, which uses objects about to close.

        `patience` limits the seconds to wait for each thread; by default until its work is done.
        """
        self._is_closed = True
        for _ in self._threads:
            self._tasks.put(None)
        for thread in self._threads:
            thread.join(patience)

    def _work(self) -> None:
        while (task := self._tasks.get()) is not None and not self._is_closed:
            work, then = task
            try:
                self._done.put((work(), None, then))
            except KeyboardInterrupt:  # from `interrupts.check`
                return
            except Exception as error:  # noqa: BLE001  `poll` decides what it means
                self._done.put((None, error, then))
