"""Payloads that are fetched many at a time and decoded one at a time."""

import threading
from collections.abc import Callable, Sequence

from terrainwave.errors import CorruptStreamError
from terrainwave.forks import renew_after_fork
from terrainwave.grid.quadtree import Block

# Limit of fetched payloads that are no longer wanted: the oldest are dropped.
_MAX_BYTES = 32 << 20
# Returns the checked payloads of several units, near ones in one request.
Payloads = Callable[[Sequence[Block]], list[bytes]]


class FetchedPayloads:
    """Fetches payloads, each for one thread only. Thread-safe."""

    def __init__(self, payloads: Payloads) -> None:
        self._payloads = payloads
        self._here: dict[Block, bytes] = {}  # oldest first
        self.renew()
        renew_after_fork(self)

    def renew(self) -> None:
        """Reset after a fork: pending payloads are fetched again."""
        self._lock = threading.Lock()
        self._here.clear()
        self._n_bytes = 0
        self._on_the_way: dict[Block, threading.Event] = {}

    def fetch(self, keys: Sequence[Block]) -> None:
        """Fetch, in one call, payloads that are neither here nor pending in another thread.

        Damaged payloads are left to `take`, so that they do not affect other units; so is a single
        one.
        """
        if len(keys) < 2:
            return
        done = threading.Event()
        with self._lock:
            own = [key for key in keys if key not in self._here and key not in self._on_the_way]
            if not own:
                return
            self._on_the_way.update(dict.fromkeys(own, done))
        payloads: list[bytes] = []
        try:
            payloads = self._payloads(own)
        except CorruptStreamError:
            pass
        finally:
            with self._lock:
                for key in own:
                    del self._on_the_way[key]
                self._make_room()
                for key, payload in zip(own, payloads, strict=False):
                    self._here[key] = payload
                    self._n_bytes += len(payload)
            done.set()

    def _make_room(self) -> None:
        while self._n_bytes > _MAX_BYTES:
            self._n_bytes -= len(self._here.pop(next(iter(self._here))))

    def peek(self, key: Block) -> bytes | None:
        """Return a payload without removing it; None if it is not here."""
        with self._lock:
            return self._here.get(key)

    def take(self, key: Block) -> bytes:
        """Return and remove a payload; fetched now unless it is here or pending.

        Raises `CorruptStreamError` if its checksum or an index page on the way to it is wrong.
        """
        with self._lock:
            coming = self._on_the_way.get(key)
        if coming is not None:
            coming.wait()
        with self._lock:
            payload = self._here.pop(key, None)
            if payload is not None:
                self._n_bytes -= len(payload)
                return payload
        return self._payloads([key])[0]
