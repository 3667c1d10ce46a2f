"""What could not be read: held back for growing pauses, or damaged for good."""

import re
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from render.scenes import ListStore, hills

import terrainwave
from benchmarks import slow_server
from benchmarks.slow_server import SlowServer
from terrainwave.errors import CorruptStreamError, SourceUnavailableError
from terrainwave.render.paging.problems import Problems
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Viewport, home

VIEWPORT = Viewport(480, 320)
LOST = SourceUnavailableError("cannot read a: refused")


@pytest.fixture
def world():
    """A clock and a count of replies that tests move."""
    return SimpleNamespace(now=100.0, n_replies=3)


@pytest.fixture
def problems(world):
    return Problems(retries=True, n_replies=lambda: world.n_replies, clock=lambda: world.now)


def test_pauses_grow_while_the_server_is_away_and_end_when_it_replies(world, problems):
    pauses = []
    for _ in range(7):
        problems.add("a", LOST)
        problems.add("b", LOST)  # the same interruption
        started = world.now
        while problems.holds("a"):
            world.now += 0.5
        pauses.append(world.now - started)
        assert not problems.holds("b")
    assert pauses == [1, 2, 4, 8, 16, 30, 30]
    problems.came()  # of what was here already
    assert problems.lines() == ["connection lost, trying again: cannot read a: refused"]
    world.n_replies += 1
    problems.came()
    assert problems.lines() == []
    problems.add("a", LOST)
    assert problems.lines()[0].startswith("connection lost, trying again in 1 s")


def test_damaged_pieces_are_counted_and_never_asked_for_again(world, problems):
    problems.add("a", CorruptStreamError("the group is damaged"))
    world.now += 1e6
    assert problems.holds("a")
    assert problems.lines() == ["1 damaged block drawn coarser"]


@pytest.fixture
def held(monkeypatch):
    """Servers answer while `replies` is set; `asked` is set when a request waits for that."""
    events = SimpleNamespace(asked=threading.Event(), replies=threading.Event())
    events.replies.set()
    answer = slow_server._Handler.do_GET

    def answer_when_told(handler):
        if not events.replies.is_set():
            events.asked.set()
        events.replies.wait(30)
        answer(handler)

    monkeypatch.setattr(slow_server._Handler, "do_GET", answer_when_told)
    yield events
    events.replies.set()


@pytest.mark.large
def test_a_scene_comes_through_an_interruption_without_its_roots_and_never_waits(
    tmp_path, world, held
):
    heights = np.round(hills(150, 210, 1)).astype(np.int16)
    terrainwave.compress(heights, tmp_path / "a.twz", max_error=0, block=32)
    with terrainwave.open(tmp_path / "a.twz") as terrain, Scene(terrain, ListStore()) as scene:
        scene.settle(scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, 0.5))  # compiles
    with SlowServer(tmp_path, 0) as server:
        with terrainwave.open(server.url("a.twz")) as terrain:
            with Scene(terrain, ListStore(), retries=True) as scene:
                view = scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, 0.5)
                world.now = scene.problems._clock()
                scene.problems._clock = lambda: world.now
                # Opening brought all of so small a file.
                terrain.container.source._start = terrain.container._start = b""
                held.replies.clear()
                n_replies = server.n_requests
                scene.update(view)
                assert held.asked.wait(30)
                for _ in range(3):
                    scene.update(view)
                assert server.n_requests == n_replies  # each came back before a reply
                server.is_down = True
                held.replies.set()
                lost = _draw_until(scene, view, world, lambda _: bool(scene.problems.lines()))
                assert re.match(r"connection lost, .*: cannot read http://127\.0\.0\.1", lost)
                server.is_down = False
                done = _draw_until(scene, view, world, lambda frames: not frames.n_missing)
                assert done is None
                assert scene.problems.lines() == []
                assert len(scene.update(view).nodes)


def _draw_until(scene, view, world, is_done):
    """Update a scene until it is so, and return what is to be said of problems."""
    for _ in range(1000):
        frames = scene.update(view)
        if is_done(frames) and (scene.table.is_resident.any() or scene.problems.lines()):
            return next(iter(scene.problems.lines()), None)
        assert scene._pager.wait(30)
        world.now += 0.1
    raise TimeoutError
