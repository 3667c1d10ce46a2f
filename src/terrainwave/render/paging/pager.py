"""Worker threads that build wanted pieces, in order; the thread that draws never waits."""

import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from terrainwave import interrupts
from terrainwave.render.scene.patches import Cancelled

_KEPT_TIMES = 4096


class Arrival(NamedTuple):
    """A result, or the reason for its absence."""

    key: Any
    value: Any
    error: BaseException | None


@dataclass
class _Running:
    is_wanted: bool = True


class Pager:
    """Builds values for keys in worker threads.

    Parameters
    ----------
    build : callable
        Called with a key and a function that returns whether the work is cancelled; may raise
        `Cancelled`.
    n_workers : int
    max_ready : int
        Largest number of waiting results, at which workers pause: memory is bounded by
        ``max_ready + n_workers`` of them.

    Attributes
    ----------
    build_ms : deque of float
        Processor time of the last builds, milliseconds.
    n_cancelled : int
    """

    def __init__(
        self,
        build: Callable[[Any, Callable[[], bool]], Any],
        *,
        n_workers: int = 2,
        max_ready: int = 16,
    ) -> None:
        self._build = build
        self._max_ready = max_ready
        self._queue: deque[Hashable] = deque()
        self._running: dict[Hashable, _Running] = {}
        self._ready: deque[Arrival] = deque()
        self._ready_keys: set[Hashable] = set()
        self._changed = threading.Condition()
        self._is_closed = False
        self.build_ms: deque[float] = deque(maxlen=_KEPT_TIMES)
        self.n_cancelled = 0
        self._threads = [
            threading.Thread(target=self._work, name=f"terrainwave-pager-{k}", daemon=True)
            for k in range(n_workers)
        ]
        for thread in self._threads:
            thread.start()

    def request(self, keys: Sequence[Hashable]) -> None:
        """Replace the wanted keys, the most urgent first.

        Work on others is cancelled; finished results stay until they are taken.
        """
        with self._changed:
            wanted = set(keys)
            for key, running in self._running.items():
                running.is_wanted = key in wanted
            self._queue = deque(
                key for key in keys if key not in self._running and key not in self._ready_keys
            )
            self._changed.notify_all()

    def take(self, max_items: int) -> list[Arrival]:
        """Return finished results, at most `max_items`; never waits for work."""
        interrupts.check()
        with self._changed:
            outcomes = [self._ready.popleft() for _ in range(min(max_items, len(self._ready)))]
            self._ready_keys.difference_update(built.key for built in outcomes)
            if outcomes:
                self._changed.notify_all()
        return outcomes

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for a result or until there is no work; for tests and `render`."""
        with self._changed:
            return self._changed.wait_for(
                lambda: bool(self._ready) or not (self._queue or self._running), timeout
            )

    def close(self, patience: float | None = None) -> None:
        """Stop the threads; unfinished work is dropped.

        `patience` limits the seconds to wait for each; by default until its work is done.
        """
        with self._changed:
            self._is_closed = True
            self._queue.clear()
            for running in self._running.values():
                running.is_wanted = False
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(patience)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: (
                        self._is_closed
                        or (bool(self._queue) and len(self._ready) < self._max_ready)
                    )
                )
                if self._is_closed:
                    return
                key = self._queue.popleft()
                running = self._running[key] = _Running()
            started = time.thread_time()
            built = self._attempt(key, running)
            with self._changed:
                del self._running[key]
                if built is None:
                    self.n_cancelled += 1
                else:
                    self.build_ms.append((time.thread_time() - started) * 1e3)
                    self._ready.append(built)
                    self._ready_keys.add(key)
                self._changed.notify_all()

    def _attempt(self, key: Hashable, running: _Running) -> Arrival | None:
        try:
            value = self._build(key, lambda: not running.is_wanted)
        except (Cancelled, KeyboardInterrupt):  # from `interrupts.check`
            return None
        except Exception as error:  # noqa: BLE001  the thread that draws decides what it means
            return Arrival(key, None, error)
        return Arrival(key, value, None)
