"""Background work for the thread that draws, which polls for results and never waits."""

from collections import deque
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from terrainwave.errors import TerrainwaveError
from terrainwave.render.paging.threads import Threads


class Outcome(NamedTuple):
    """A result, or else a message."""

    value: Any
    problem: str | None


_Then = Callable[[Outcome], None]


class Background(Threads):
    """Runs functions in threads; `poll` takes their results. Used by one thread."""

    def __init__(self, n_threads: int = 2) -> None:
        self._tasks: deque[tuple[Callable[[], Any], _Then]] = deque()
        self._done: SimpleQueue[tuple[Any, Exception | None, _Then]] = SimpleQueue()
        self.n_running = 0  # pending results
        super().__init__("background", n_threads)

    def start(self, work: Callable[[], Any], then: _Then) -> None:
        """Run `work` in a thread and `then`, with its outcome, in a later `poll`."""
        self.n_running += 1
        with self._changed:
            self._tasks.append((work, then))
            self._changed.notify()

    def poll(self) -> None:
        while True:
            try:
                value, error, then = self._done.get_nowait()
            except Empty:
                return
            self.n_running -= 1
            if error is not None and not isinstance(error, TerrainwaveError):
                raise error
            then(Outcome(value, None if error is None else str(error)))

    def _has_work(self) -> bool:
        return bool(self._tasks)

    def _take(self) -> tuple[Callable[[], Any], _Then]:
        return self._tasks.popleft()

    def _do(self, work: tuple[Callable[[], Any], _Then]) -> None:
        function, then = work
        try:
            self._done.put((function(), None, then))
        except KeyboardInterrupt:  # from `interrupts.check`
            self._is_closed = True
        except Exception as error:  # noqa: BLE001  `poll` decides what it means
            self._done.put((None, error, then))
