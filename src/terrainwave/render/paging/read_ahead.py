"""Fetches the data of queued pieces from a server, before they are decoded."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

from terrainwave.errors import TerrainwaveError
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Block, Region
from terrainwave.read.decoder import units_of
from terrainwave.render.modes.mode import Mode
from terrainwave.render.paging.problems import replies_of
from terrainwave.render.paging.threads import Threads
from terrainwave.render.scene.camera import Camera
from terrainwave.render.scene.selection import NodeTable, Piece, View

# Two simultaneous calls, so that the line is never idle between them; each with few pieces, so that
# another camera need not wait long for its own.
_THREADS, _BATCH = 2, 8
# Largest number of pieces to fetch for a view; interval of checks of a moving camera.
_MOST_PIECES, _REST = 256, 0.1  # pieces, seconds
# Largest number of known pieces; then all are forgotten, and found again in the index.
_MOST_KNOWN = 8192
PATIENCE = 1.0  # seconds
# Samples around a block that its slopes depend on.
_RING = 2


# A view, its τ, and which pieces are loaded.
_Wish = tuple[View, float, Callable[[Piece], bool]]


class Descent(Threads):
    """Thread that finds the data of a view, only by the index, and fetches them.

    The scene learns a piece's children when the piece has been built: initially each level would
    wait for the one above it to be fetched, decoded and built.
    """

    def __init__(
        self,
        # for its tree and its wanted pieces; its `wanted` uses a table of this thread's own
        mode: Mode,
        # `prefetch, units`: as of `ReadAhead`
        prefetch: Callable[[Sequence[Block]], object],
        units: Callable[[Piece], Sequence[Block]],
    ) -> None:
        self._mode, self._prefetch, self._units = mode, prefetch, units
        self._table = self._roots()
        self._wish: _Wish | None = None
        self._seen: Camera | None = None
        super().__init__("descent", 1)

    def look(self, view: View, tau: float, is_here: Callable[[Piece], bool]) -> None:
        """Fetch the data of a view from now on, except pieces for which `is_here` is true."""
        if view.camera == self._seen:
            return
        self._seen = view.camera
        with self._changed:
            self._wish = view, tau, is_here
            self._changed.notify_all()

    def _has_work(self) -> bool:
        return self._wish is not None

    def _take(self) -> _Wish | None:
        wish, self._wish = self._wish, None
        return wish

    def _do(self, work: _Wish) -> None:
        # Building the piece will raise the error again, and report it.
        with suppress(TerrainwaveError):
            self._fetch(self._pieces(work))
        time.sleep(_REST)

    def _roots(self) -> NodeTable:
        table = NodeTable()
        for info in self._mode.roots():
            table.add(info)
        return table

    def _pieces(self, wish: _Wish) -> list[Piece]:
        """Return the missing pieces, the coarsest first; reads the index."""
        if self._table.n_known > _MOST_KNOWN:
            self._table = self._roots()
        table, mode, (view, tau, is_here) = self._table, self._mode, wish
        while True:
            nodes = mode.wanted(table, view, tau, _MOST_PIECES, view.camera)
            new = nodes[~table.is_known[nodes] & ~table.are_fine(view, nodes, tau)]
            if not len(new) or self._is_stale:
                break
            for node in new.tolist():
                table.add_children(node, mode.children(table.pieces[node]))
        pieces = [table.pieces[node] for node in nodes.tolist()]
        return [piece for piece in pieces if not is_here(piece)]

    def _fetch(self, pieces: list[Piece]) -> None:
        for first in range(0, len(pieces), _BATCH):
            if self._is_stale:
                return
            batch = pieces[first : first + _BATCH]
            self._prefetch(list(dict.fromkeys(key for one in batch for key in self._units(one))))

    @property
    def _is_stale(self) -> bool:
        return self._is_closed or self._wish is not None


class ReadAhead(Threads):
    """Threads that fetch payloads of pieces, the most urgent first, and decode nothing."""

    def __init__(
        self,
        # fetches the data needed to decode some units, in few requests
        prefetch: Callable[[Sequence[Block]], object],
        units: Callable[[Piece], Sequence[Block]],  # returns the units of a piece
        descent: Descent | None = None,  # closed with it
    ) -> None:
        self._prefetch, self._units, self._descent = prefetch, units, descent
        self._queue: list[Piece] = []
        self._done: set[Piece] = set()
        super().__init__("ahead", _THREADS)

    def request(self, pieces: Sequence[Piece]) -> None:
        """Replace the wanted pieces, the most urgent first."""
        with self._changed:
            self._done &= set(pieces)
            self._queue = [piece for piece in pieces if piece not in self._done]
            self._changed.notify_all()

    def look(self, view: View, tau: float, is_here: Callable[[Piece], bool]) -> None:
        """Fetch the data of a view on all levels, including pieces that cannot be requested yet."""
        if self._descent is not None:
            self._descent.look(view, tau, is_here)

    def _has_work(self) -> bool:
        return bool(self._queue)

    def _take(self) -> list[Piece]:
        batch, self._queue = self._queue[:_BATCH], self._queue[_BATCH:]
        self._done.update(batch)
        return batch

    def _do(self, work: list[Piece]) -> None:
        keys = dict.fromkeys(key for piece in work for key in self._units(piece))
        try:
            self._prefetch(list(keys))
        except TerrainwaveError:  # building the piece will raise it again, and report it
            with self._changed:
                self._done.difference_update(work)

    def close(self, patience: float | None = PATIENCE) -> None:
        """Stop the threads, without a long wait for pending requests."""
        super().close(patience)
        if self._descent is not None:
            self._descent.close(patience)


def units_of_piece(terrain: TerrainFile, piece: Piece) -> list[Block]:
    """Return the keys of the units that hold a block and the samples around it."""
    grid = terrain.grid
    level = Region(0, 0, *grid.level_shape(piece.level))
    return units_of(grid, piece.level, grid.block_region(piece.block, _RING).intersect(level))


def read_ahead_of(terrain: TerrainFile, mode: Mode) -> ReadAhead | None:
    """Return the read-ahead for a mode with blocks of a file on a server, else None."""
    if replies_of(terrain) is None or not hasattr(mode, "builder"):
        return None

    units = partial(units_of_piece, terrain)
    prefetch = terrain.decoder.prefetch
    return ReadAhead(prefetch, units, Descent(mode, prefetch, units))
