"""Fetches from a server what queued pieces need, so that those who decode find it here. No GPU."""

import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from terrainwave.errors import TerrainwaveError
from terrainwave.grid.quadtree import Block, Region
from terrainwave.read.decoder import units_of
from terrainwave.render.problems import replies_of
from terrainwave.render.selection import Piece

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile
    from terrainwave.render.modes.mode import Mode

# Two calls are on their way at a time, so that the line is never idle between them; each is of so
# few pieces that another camera need not wait long for its own.
_THREADS, _BATCH = 2, 8
PATIENCE = 1.0  # seconds
# Samples around a block that its slopes are made of.
_RING = 2


class ReadAhead:
    """Threads that fetch payloads of pieces, the most urgent first, and decode nothing.

    Parameters
    ----------
    prefetch : callable
        Fetches what decoding some units will need, in few requests.
    units : callable
        Returns the units that a piece is made of.
    """

    def __init__(
        self,
        prefetch: Callable[[Sequence[Block]], object],
        units: Callable[[Piece], Sequence[Block]],
    ) -> None:
        self._prefetch, self._units = prefetch, units
        self._queue: list[Piece] = []
        self._done: set[Piece] = set()
        self._changed = threading.Condition()
        self._is_closed = False
        self._threads = [
            threading.Thread(target=self._work, name=f"terrainwave-ahead-{k}", daemon=True)
            for k in range(_THREADS)
        ]
        for thread in self._threads:
            thread.start()

    def request(self, pieces: Sequence[Piece]) -> None:
        """Replace what is wanted: these pieces, the first ones first."""
        with self._changed:
            self._done &= set(pieces)
            self._queue = [piece for piece in pieces if piece not in self._done]
            self._changed.notify_all()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed or bool(self._queue))
                if self._is_closed:
                    return
                batch, self._queue = self._queue[:_BATCH], self._queue[_BATCH:]
                self._done.update(batch)
            keys = dict.fromkeys(key for piece in batch for key in self._units(piece))
            try:
                self._prefetch(list(keys))
            except TerrainwaveError:  # who builds the piece will meet it again, and says so
                with self._changed:
                    self._done.difference_update(batch)

    def close(self) -> None:
        """Stop the threads; a request on its way is not waited for long."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(PATIENCE)


def units_of_piece(terrain: "TerrainFile", piece: Piece) -> list[Block]:
    """Return the keys of the units that hold a block and the samples around it."""
    grid = terrain.grid
    level = Region(0, 0, *grid.level_shape(piece.level))
    return units_of(grid, piece.level, grid.block_region(piece.block, _RING).intersect(level))


def read_ahead_of(terrain: "TerrainFile", mode: "Mode") -> ReadAhead | None:
    """Return what reads ahead for a mode that draws blocks of a file on a server, else None."""
    if replies_of(terrain) is None or not hasattr(mode, "builder"):
        return None
    return ReadAhead(terrain.decoder.prefetch, lambda piece: units_of_piece(terrain, piece))
