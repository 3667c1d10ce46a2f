"""A least-recently-used cache, limited by number of values or by bytes."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

from terrainwave.forks import renew_after_fork

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class Cache(Generic[Key, Value]):
    """Values by key; the least recently used are dropped first. Thread-safe.

    Parameters
    ----------
    limit : int
        Largest sum of sizes. One value stays, whatever its size.
    size_of : callable, optional
        Size of a value, the same each time; by default each counts 1.
    drop : callable, optional
        Called with each dropped value, for example to close it.
    """

    def __init__(
        self,
        limit: int,
        *,
        size_of: Callable[[Value], int] = lambda _: 1,
        drop: Callable[[Value], None] = lambda _: None,
    ) -> None:
        self._limit = limit
        self._size_of = size_of
        self._drop = drop
        self._size = 0
        self._values: OrderedDict[Key, Value] = OrderedDict()
        self._in_work: dict[Key, threading.Event] = {}
        self._lock = threading.Lock()
        renew_after_fork(self)

    def renew(self) -> None:
        """Reset after a fork: values that were being made are made again."""
        self._lock, self._in_work = threading.Lock(), {}
        # A fork may happen between two lines of `put`.
        self._size = sum(map(self._size_of, self._values.values()))

    def __len__(self) -> int:
        return len(self._values)

    def get(self, key: Key) -> Value | None:
        """Return the value, or None if it is not in the cache."""
        with self._lock:
            return self._take(key)

    def _take(self, key: Key) -> Value | None:
        value = self._values.get(key)
        if value is not None:
            self._values.move_to_end(key)
        return value

    def _drop_lesser(self, key: Key, is_enough: Callable[[Value], bool]) -> None:
        value = self._values.get(key)
        if value is not None and not is_enough(value):
            del self._values[key]
            self._size -= self._size_of(value)

    def is_coming(self, key: Key) -> bool:
        """Return whether `get_or_make` is making the value."""
        return key in self._in_work

    def put(self, key: Key, value: Value) -> None:
        """Store a value; an equal one that is already stored stays instead."""
        dropped = []
        with self._lock:
            if self._take(key) is not None:
                return
            self._values[key] = value
            self._size += self._size_of(value)
            while self._size > self._limit and len(self._values) > 1:
                dropped.append(self._values.popitem(last=False)[1])
                self._size -= self._size_of(dropped[-1])
        for one in dropped:
            self._drop(one)

    def get_or_make(
        self, key: Key, make: Callable[[], Value], is_enough: Callable[[Value], bool] | None = None
    ) -> Value:
        """Return the value; make it if it is missing or `is_enough` rejects the stored one.

        Threads that ask for a value that is being made wait for it; if that fails, the next one
        tries. `make` may ask for other keys, as long as no two wait for each other.
        """
        while True:
            with self._lock:
                if is_enough is not None:
                    self._drop_lesser(key, is_enough)
                value = self._take(key)
                if value is not None:
                    return value
                other = self._in_work.get(key)
                if other is None:
                    mine = self._in_work[key] = threading.Event()
                    break
            other.wait()
        try:
            value = make()
            self.put(key, value)
            return value
        finally:
            with self._lock:
                del self._in_work[key]
            mine.set()

    def clear(self) -> None:
        """Drop all values."""
        with self._lock:
            dropped = list(self._values.values())
            self._values.clear()
            self._size = 0
        for one in dropped:
            self._drop(one)
