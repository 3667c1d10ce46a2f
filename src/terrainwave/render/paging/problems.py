"""Unreadable pieces: damaged permanently, or unavailable and tried again."""

import math
import time
from collections.abc import Callable, Hashable

from terrainwave.errors import SourceUnavailableError
from terrainwave.file import TerrainFile

_FIRST_PAUSE, _LONGEST_PAUSE = 1.0, 30.0  # seconds
_SILENCE = 5.0


class Problems:
    """Pieces that could not be built, and the state of the connection. Used by one thread.

    A piece whose server cannot be reached is held back for a pause, each twice as long as the one
    before; an arrival ends the pause. All other pieces are damaged permanently.
    """

    def __init__(
        self,
        *,
        retries: bool = False,  # try unavailable pieces again
        # returns the number of replies of a server, whose silence is reported. None: no server.
        n_replies: Callable[[], int] | None = None,
        clock: Callable[[], float] = time.monotonic,  # seconds
    ) -> None:
        self.damaged: dict[Hashable, str] = {}  # message for each piece
        self._retries, self._count, self._clock = retries, n_replies, clock
        self._n_replies = 0  # at the last check
        self._held: set[Hashable] = set()
        self._pause = 0.0
        self._try_at = self._last_sign = clock()
        self._message = ""

    def add(self, piece: Hashable, error: Exception) -> None:
        if not (self._retries and isinstance(error, SourceUnavailableError)):
            self.damaged[piece] = str(error)
            return
        now = self._clock()
        self._held.add(piece)
        self._message = str(error)
        self._has_replied()
        if now >= self._try_at:  # several at a time are one interruption
            self._pause = min(max(2 * self._pause, _FIRST_PAUSE), _LONGEST_PAUSE)
            self._try_at = now + self._pause

    def came(self) -> None:
        """Record the arrival of a piece, from the server or from the cache."""
        if self._count is not None and not self._has_replied():
            return
        self._held.clear()
        self._pause, self._message = 0.0, ""
        self._try_at = self._last_sign = self._clock()

    def _has_replied(self) -> bool:
        n_before, self._n_replies = self._n_replies, self._count() if self._count else 0
        if self._n_replies != n_before:
            self._last_sign = self._clock()
        return self._n_replies != n_before

    def holds(self, piece: Hashable) -> bool:
        if self._held and self._clock() >= self._try_at:
            self._held.clear()
        return piece in self._held or piece in self.damaged

    @property
    def is_clear(self) -> bool:
        return not self._held and not self.damaged

    @property
    def n_held(self) -> int:
        return len(self._held)

    def lines(self, n_missing: int = 0) -> list[str]:
        """Return messages on the state; none if all is well.

        `n_missing` is the number of requested pieces; it is reported if none of them arrives.
        """
        lines, now = [], self._clock()
        if not n_missing:
            self._last_sign = now
        if self._message:
            left = math.ceil(max(self._try_at - now, 0.0))
            again = f"trying again in {left} s" if left else "trying again"
            lines.append(f"connection lost, {again}: {self._message}")
        elif self._count is not None and now - self._last_sign > _SILENCE:
            lines.append(f"waiting for the server: nothing for {now - self._last_sign:.0f} s")
        if self.damaged:
            n = len(self.damaged)
            lines.append(f"{n} damaged block{'s' if n > 1 else ''} drawn coarser")
        return lines


def replies_of(terrain: TerrainFile) -> Callable[[], int] | None:
    """Return a counter of the replies of a terrain's server; None without a server."""
    source = terrain.container.source
    return (lambda: int(source.n_replies)) if hasattr(source, "n_replies") else None
