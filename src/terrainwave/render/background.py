"""Work beside the thread that draws, which looks for results and never waits. No GPU."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

from terrainwave.errors import TerrainwaveError

_THREADS = 2


class Outcome(NamedTuple):
    """A result, or what is said where there is none."""

    value: Any
    problem: str | None


class Background:
    """Runs functions in threads; their results are taken by `poll`. Used by one thread."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(_THREADS, thread_name_prefix="terrainwave-background")
        self._tasks: list[tuple[Future[Any], Callable[[Outcome], None]]] = []

    def start(self, work: Callable[[], Any], then: Callable[[Outcome], None]) -> None:
        """Run `work` in a thread and `then`, with its outcome, in a later `poll`."""
        self._tasks.append((self._executor.submit(work), then))

    @property
    def n_running(self) -> int:
        """Return how many results are still to come."""
        return len(self._tasks)

    def poll(self) -> None:
        """Hand over the results that are here.

        Raises
        ------
        Exception
            What a function raised, if it is no `TerrainwaveError`.
        """
        done = [task for task in self._tasks if task[0].done()]
        self._tasks = [task for task in self._tasks if task not in done]
        for future, then in done:
            try:
                outcome = Outcome(future.result(), None)
            except TerrainwaveError as error:
                outcome = Outcome(None, str(error))
            then(outcome)

    def close(self) -> None:
        """Begin no more work; what runs is not waited for."""
        self._executor.shutdown(wait=False, cancel_futures=True)
        self._tasks = []
