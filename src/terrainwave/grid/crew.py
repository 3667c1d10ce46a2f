"""Pool of threads in which the calling thread works as well."""

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from types import TracebackType
from typing import Any, Generic, TypeVar, cast

from terrainwave import interrupts

T = TypeVar("T")
Result = TypeVar("Result")


class Crew(ThreadPoolExecutor):
    """Pool of threads; the thread that submits work takes part in it.

    Its own work needs no hand-over, which costs more than many a task. With one thread no other is
    started.

    Parameters
    ----------
    n_threads : int
        Number of threads that work at a time; >= 1.
    """

    def __init__(self, n_threads: int) -> None:
        super().__init__(max(n_threads - 1, 1), thread_name_prefix="terrainwave")
        self.n_threads = n_threads
        self._begun: dict[Future[Any], Callable[..., Any]] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future = super().submit(fn, *args, **kwargs)
        self._begun[future] = fn
        future.add_done_callback(lambda ended: self._begun.pop(ended, None))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Do as `Executor.shutdown`; pending tasks of `map` are dropped.

        After an error nobody takes them, but the traceback keeps the iterator, with tasks for
        hours.
        """
        for work in list(self._begun.values()):
            turns = getattr(work, "__self__", None)
            if isinstance(turns, _Turns) and turns.asking is threading.current_thread():
                turns.stop()
        super().shutdown(wait, cancel_futures=cancel_futures)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Wait for the threads, even after Ctrl-C: they still read objects about to close."""
        interruption: BaseException | None = None
        is_ended = False
        while not is_ended:
            try:
                self.shutdown(wait=False, cancel_futures=error is not None)
                # Not by joining: a thread counts as ended when its join was interrupted.
                wait(list(self._begun))
                is_ended = True
            except KeyboardInterrupt as found:
                interruption = found
        if interruption is not None and error is None:
            raise interruption

    def map(
        self,
        fn: Callable[..., Result],
        *iterables: Iterable[Any],
        timeout: float | None = None,
        chunksize: int = 1,  # noqa: ARG002  of pools of processes
    ) -> Iterator[Result]:
        """Do as `Executor.map`; the caller works while it waits for a result. No `timeout`.

        A single thread does nothing until the first result is requested.
        """
        if timeout is not None:
            raise ValueError(f"found `timeout` {timeout}, expected None")
        turns = _Turns(fn, list(zip(*iterables, strict=False)))
        for _ in range(min(self.n_threads, len(turns.tasks)) - 1):
            self.submit(turns.take_all)
        return turns.results()

    def grow(self, work: Callable[[T], Iterable[T]], things: Iterable[T]) -> None:
        """Call `work` with things and with all things that it returns.

        The newest first, so only few wait at a time. The first error is raised when all threads
        have finished their current work.
        """
        growth = _Growth(work, list(things))
        others = [self.submit(growth.take_all) for _ in range(self.n_threads - 1)]
        try:
            growth.take_all()
        except BaseException:
            growth.stop()
            raise
        finally:
            # Pending ones are not waited for: they may be queued behind another caller's work.
            begun = [other for other in others if not other.cancel()]
            wait(begun)
        for other in begun:
            other.result()


class _Turns(Generic[Result]):
    """Tasks that threads take in turns; their results in order."""

    def __init__(self, function: Callable[..., Result], tasks: list[tuple[Any, ...]]) -> None:
        self._function = function
        self.tasks = tasks
        self.asking = threading.current_thread()
        self._next = 0
        self._found: dict[int, tuple[Result | None, BaseException | None]] = {}
        self._changed = threading.Condition()

    def take_all(self) -> None:
        """Do tasks until all are taken."""
        while self._take_one():
            pass

    def results(self) -> Iterator[Result]:
        """Yield results in order; do tasks while the next one is pending."""
        try:
            for index in range(len(self.tasks)):
                while index not in self._found and self._take_one():
                    pass
                with self._changed:
                    while index not in self._found:
                        self._changed.wait()
                    result, error = self._found.pop(index)
                if error is not None:
                    raise error
                yield cast(Result, result)
        finally:
            self.stop()

    def _take_one(self) -> bool:
        """Do the next task; False if all are taken."""
        interrupts.check()
        with self._changed:
            index = self._next
            if index >= len(self.tasks):
                return False
            self._next += 1
        result, error = None, None
        try:
            result = self._function(*self.tasks[index])
        except BaseException as raised:  # noqa: BLE001  raised where its result is awaited
            error = raised
            self.stop()  # all earlier ones are taken
        with self._changed:
            self._found[index] = result, error
            self._changed.notify_all()
        return True

    def stop(self) -> None:
        """Let threads end after their current task."""
        with self._changed:
            self._next = len(self.tasks)


class _Growth(Generic[T]):
    """Things that wait for a thread, newest last, and the number of threads that may add some."""

    def __init__(self, work: Callable[[T], Iterable[T]], things: list[T]) -> None:
        self._work = work
        self._waiting = things[::-1]
        self._n_busy = 0
        self._is_stopped = False
        self._changed = threading.Condition()

    def take_all(self) -> None:
        """Work until nothing waits, and nothing more can be added."""
        while True:
            interrupts.check()
            with self._changed:
                while not self._waiting and self._n_busy and not self._is_stopped:
                    self._changed.wait()
                if not self._waiting:
                    return
                thing = self._waiting.pop()
                self._n_busy += 1
            following: list[T] = []
            try:
                following = list(self._work(thing))
            except BaseException:
                self.stop()
                raise
            finally:
                with self._changed:
                    if not self._is_stopped:
                        self._waiting += following[::-1]
                    self._n_busy -= 1
                    self._changed.notify_all()

    def stop(self) -> None:
        """Let threads end after their current task."""
        with self._changed:
            self._is_stopped = True
            self._waiting.clear()
            self._changed.notify_all()
