"""Worker threads that build wanted pieces, in order; the thread that draws never waits."""

import time
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

from terrainwave import interrupts
from terrainwave.render.paging.threads import Threads
from terrainwave.render.scene.patches import Cancelled

_KEPT_TIMES = 4096


class Arrival(NamedTuple):
    """A result, or the reason for its absence."""

    key: Any
    value: Any
    error: BaseException | None


class Pager(Threads):
    """Builds values for keys in worker threads."""

    def __init__(
        self,
        # called with a key and a function that returns whether the work is cancelled; may raise
        # `Cancelled`
        build: Callable[[Any, Callable[[], bool]], Any],
        *,
        n_workers: int = 2,
        # largest number of waiting results, at which workers pause: memory is bounded by
        # ``max_ready + n_workers`` of them
        max_ready: int = 16,
    ) -> None:
        self._build = build
        self._max_ready = max_ready
        self._queue: deque[Hashable] = deque()
        self._running: dict[Hashable, bool] = {}  # whether each is still wanted
        self._ready: deque[Arrival] = deque()
        self._ready_keys: set[Hashable] = set()
        # processor time of the last builds, milliseconds
        self.build_ms: deque[float] = deque(maxlen=_KEPT_TIMES)
        self.n_cancelled = 0
        super().__init__("pager", n_workers)

    def request(self, keys: Sequence[Hashable]) -> None:
        """Replace the wanted keys, the most urgent first.

        Work on others is cancelled; finished results stay until they are taken.
        """
        with self._changed:
            wanted = set(keys)
            self._running = {key: key in wanted for key in self._running}
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
        self.request([])
        super().close(patience)

    def _has_work(self) -> bool:
        return bool(self._queue) and len(self._ready) < self._max_ready

    def _take(self) -> Hashable:
        key = self._queue.popleft()
        self._running[key] = True
        return key

    def _do(self, work: Hashable) -> None:
        started = time.thread_time()
        built = self._attempt(work)
        with self._changed:
            del self._running[work]
            if built is None:
                self.n_cancelled += 1
            else:
                self.build_ms.append((time.thread_time() - started) * 1e3)
                self._ready.append(built)
                self._ready_keys.add(built.key)
            self._changed.notify_all()

    def _attempt(self, key: Hashable) -> Arrival | None:
        try:
            value = self._build(key, lambda: not self._running[key])
        except (Cancelled, KeyboardInterrupt):  # from `interrupts.check`
            return None
        except Exception as error:  # noqa: BLE001  the thread that draws decides what it means
            return Arrival(key, None, error)
        return Arrival(key, value, None)
