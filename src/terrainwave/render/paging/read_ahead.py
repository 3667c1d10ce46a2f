"""Fetches from a server what queued pieces need, so that those who decode find it here."""

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

from terrainwave.errors import TerrainwaveError
from terrainwave.grid.quadtree import Block, Region
from terrainwave.read.decoder import units_of
from terrainwave.render.paging.problems import replies_of
from terrainwave.render.scene.selection import NodeTable, Piece, View

if TYPE_CHECKING:
    from terrainwave.file import TerrainFile
    from terrainwave.render.modes.mode import Mode
    from terrainwave.render.scene.camera import Camera

# Two calls are on their way at a time, so that the line is never idle between them; each is of so
# few pieces that another camera need not wait long for its own.
_THREADS, _BATCH = 2, 8
# Of a view, so many pieces are fetched at most; a moving camera is looked at so often.
_MOST_PIECES, _REST = 256, 0.1  # pieces, seconds
# Pieces that are known before all are forgotten, and found again by the index.
_MOST_KNOWN = 8192
PATIENCE = 1.0  # seconds
# Samples around a block that its slopes are made of.
_RING = 2


class Descent:
    """A thread that finds all that a view needs, by the index alone, and fetches it.

    The scene learns of a piece's children when the piece has been built: where nothing is here
    yet, each level would wait for the one above it to be fetched, decoded and built.

    Parameters
    ----------
    mode : Mode
        For its tree and what it wants; its `wanted` looks at a table of the thread's own.
    prefetch, units : callable
        As of `ReadAhead`.
    """

    def __init__(
        self,
        mode: "Mode",
        prefetch: Callable[[Sequence[Block]], object],
        units: Callable[[Piece], Sequence[Block]],
    ) -> None:
        self._mode, self._prefetch, self._units = mode, prefetch, units
        self._table = self._roots()
        self._wish: _Wish | None = None
        self._seen: Camera | None = None
        self._changed = threading.Condition()
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, name="terrainwave-descent", daemon=True)
        self._thread.start()

    def look(self, view: View, tau: float, is_here: Callable[[Piece], bool]) -> None:
        """Fetch what a view needs from now on; `is_here` says what need not be."""
        if view.camera == self._seen:
            return
        self._seen = view.camera
        with self._changed:
            self._wish = _Wish(view, tau, is_here)
            self._changed.notify_all()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed or self._wish is not None)
                if self._is_closed:
                    return
                wish, self._wish = self._wish, None
            assert wish is not None
            # Who builds a piece will meet an error again, and says so.
            with suppress(TerrainwaveError):
                self._fetch(self._pieces(wish))
            time.sleep(_REST)

    def _roots(self) -> NodeTable:
        """Return a table that knows the roots alone."""
        table = NodeTable()
        for info in self._mode.roots():
            table.add(info)
        return table

    def _pieces(self, wish: "_Wish") -> list[Piece]:
        """Return the pieces that are not here, the coarsest first; reads the index."""
        if self._table.n_known > _MOST_KNOWN:
            self._table = self._roots()
        table, mode = self._table, self._mode
        while True:
            nodes = mode.wanted(table, wish.view, wish.tau, _MOST_PIECES, wish.view.camera)
            new = nodes[~table.is_known[nodes] & ~table.are_fine(wish.view, nodes, wish.tau)]
            if not len(new) or self._is_stale:
                break
            for node in new.tolist():
                table.add_children(node, mode.children(table.pieces[node]))
        pieces = [table.pieces[node] for node in nodes.tolist()]
        return [piece for piece in pieces if not wish.is_here(piece)]

    def _fetch(self, pieces: list[Piece]) -> None:
        for first in range(0, len(pieces), _BATCH):
            if self._is_stale:
                return
            batch = pieces[first : first + _BATCH]
            self._prefetch(list(dict.fromkeys(key for one in batch for key in self._units(one))))

    @property
    def _is_stale(self) -> bool:
        return self._is_closed or self._wish is not None

    def close(self) -> None:
        """Stop the thread; a request on its way is not waited for long."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._thread.join(PATIENCE)


class _Wish(NamedTuple):
    """What to fetch: a view, its τ, and what is here already."""

    view: View
    tau: float
    is_here: Callable[[Piece], bool]


class ReadAhead:
    """Threads that fetch payloads of pieces, the most urgent first, and decode nothing.

    Parameters
    ----------
    prefetch : callable
        Fetches what decoding some units will need, in few requests.
    units : callable
        Returns the units that a piece is made of.
    descent : Descent, optional
        Closed with it.
    """

    def __init__(
        self,
        prefetch: Callable[[Sequence[Block]], object],
        units: Callable[[Piece], Sequence[Block]],
        descent: Descent | None = None,
    ) -> None:
        self._prefetch, self._units, self._descent = prefetch, units, descent
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

    def look(self, view: View, tau: float, is_here: Callable[[Piece], bool]) -> None:
        """Fetch what a view needs on all levels, also what nobody can ask for yet."""
        if self._descent is not None:
            self._descent.look(view, tau, is_here)

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
        if self._descent is not None:
            self._descent.close()


def units_of_piece(terrain: "TerrainFile", piece: Piece) -> list[Block]:
    """Return the keys of the units that hold a block and the samples around it."""
    grid = terrain.grid
    level = Region(0, 0, *grid.level_shape(piece.level))
    return units_of(grid, piece.level, grid.block_region(piece.block, _RING).intersect(level))


def read_ahead_of(terrain: "TerrainFile", mode: "Mode") -> ReadAhead | None:
    """Return what reads ahead for a mode that draws blocks of a file on a server, else None."""
    if replies_of(terrain) is None or not hasattr(mode, "builder"):
        return None

    def units(piece: Piece) -> list[Block]:
        return units_of_piece(terrain, piece)

    prefetch = terrain.decoder.prefetch
    return ReadAhead(prefetch, units, Descent(mode, prefetch, units))
