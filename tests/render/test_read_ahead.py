"""Reading ahead: what queued pieces need comes in few calls, before they are built."""

import threading

import numpy as np
from render.scenes import ListStore, hills, terrain_of

from terrainwave.errors import StorageError
from terrainwave.grid.quadtree import Block
from terrainwave.render.paging.read_ahead import Descent, ReadAhead, units_of_piece
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Viewport, home
from terrainwave.render.scene.selection import Piece

VIEWPORT = Viewport(480, 320)


def test_pieces_are_fetched_once_the_first_ones_first_and_again_after_an_error():
    calls, done, fails = [], threading.Event(), [False]

    def prefetch(keys):
        calls.append(keys)
        if sum(map(len, calls)) >= 20:
            done.set()
        if fails[0]:
            raise StorageError("lost")

    pieces = [Piece(1, 0, col) for col in range(20)]
    ahead = ReadAhead(prefetch, lambda piece: [piece.block])
    ahead.request(pieces)
    assert done.wait(30)
    ahead.request(pieces)
    found = [key.col for keys in calls for key in keys]
    assert sorted(found) == list(range(20))
    assert calls[0] == [Block(1, 0, col) for col in range(8)]
    fails[0], more = True, [*pieces, Piece(2, 0, 0)]
    ahead.request(more)
    while len(calls) < 4:
        pass
    ahead.close()
    assert ahead._done == set(pieces)


def test_all_that_a_piece_is_made_of_is_read_ahead():
    heights = np.round(hills(150, 210, 1)).astype(np.int16)
    with terrain_of(heights, max_error=0) as terrain:
        level = terrain.n_levels - 1
        asked = set()
        unit = terrain.decoder.unit

        def noting(key, *rest):
            asked.add(key)
            return unit(key, *rest)

        terrain.decoder.unit = noting
        from terrainwave.render.scene.frame import frame_of
        from terrainwave.render.scene.patches import PatchBuilder

        PatchBuilder(terrain, frame_of(terrain)).build(Piece(level, 0, 0))
        of_level = {key for key in asked if key.level == level - 1}
        assert of_level <= set(units_of_piece(terrain, Piece(level, 0, 0)))


def test_a_view_is_fetched_on_all_levels_at_once_but_for_what_is_here():
    heights = np.round(hills(150, 210, 1)).astype(np.int16)
    with (
        terrain_of(heights, max_error=0, block=32) as terrain,
        Scene(terrain, ListStore(), exaggeration=4.0) as scene,
    ):
        view = scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, 2.0)
        scene.settle(view)
        nodes = scene._wanted(view, scene._split_error(view))
        wanted = {scene.table.pieces[node] for node in nodes.tolist()}
        for here in (set(), wanted):
            fetched = fetched_for(scene, view, here)
            assert fetched & here == set()
            assert fetched | here == wanted
        assert len({piece.level for piece in wanted}) > 1


def fetched_for(scene, view, here):
    """Return the pieces that a descent fetches for a view."""
    fetched, done = set(), threading.Event()
    descent = Descent(scene.mode, fetched.update, lambda piece: [piece])
    fetch = descent._fetch
    descent._fetch = lambda pieces: (fetch(pieces), done.set())
    descent.look(view, scene._split_error(view), here.__contains__)
    assert done.wait(30)
    descent.close()
    return fetched
