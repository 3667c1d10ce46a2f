"""Workers: order, cancelling, bounds, errors."""

import threading

import pytest

from terrainwave.render.paging.pager import Pager
from terrainwave.render.scene.patches import Cancelled


@pytest.fixture
def gate():
    """An event that a build waits for; opened at the end so that no thread stays."""
    event = threading.Event()
    yield event
    event.set()


def finish(pager, n_results):
    found = []
    while len(found) < n_results:
        assert pager.wait(30)
        taken = pager.take(10)
        assert taken, f"no work is left, and {len(found)} results came"
        found += taken
    return found


def test_results_come_in_the_order_asked_for():
    pager = Pager(lambda key, _: key * 10, n_workers=1)
    pager.request([3, 1, 2])
    assert [(built.key, built.value) for built in finish(pager, 3)] == [(3, 30), (1, 10), (2, 20)]
    pager.close()


def test_what_is_no_longer_wanted_is_not_built(gate):
    built, started = [], threading.Event()

    def build(key, _):
        started.set()
        gate.wait(30)
        built.append(key)
        return key

    pager = Pager(build, n_workers=1)
    pager.request([1, 2, 3])
    assert started.wait(30)
    pager.request([1, 9])
    gate.set()
    assert [result.key for result in finish(pager, 2)] == [1, 9]
    assert built == [1, 9]
    pager.close()


def test_running_work_is_told_that_it_is_cancelled(gate):
    started, stopped = threading.Event(), threading.Event()

    def build(key, is_cancelled):
        started.set()
        gate.wait(30)
        if is_cancelled():
            stopped.set()
            raise Cancelled
        return key

    pager = Pager(build, n_workers=1)
    pager.request(["a"])
    assert started.wait(30)
    pager.request([])
    gate.set()
    assert stopped.wait(30)
    assert pager.wait(30)
    assert pager.take(10) == []
    pager.close()


def test_workers_rest_while_results_are_not_taken():
    n_kept = []

    def build(key, _):
        with pager._changed:
            n_kept.append(len(pager._ready) + len(pager._running))
        return key

    pager = Pager(build, n_workers=2, max_ready=3)
    pager.request(list(range(100)))
    with pager._changed:
        assert pager._changed.wait_for(lambda: len(pager._ready) >= 3, 30)
    assert len(finish(pager, 100)) == 100
    assert max(n_kept) <= 3 + 2
    pager.close()


def test_taking_never_waits(gate):
    started = threading.Event()

    def build(key, _):
        started.set()
        gate.wait(30)

    pager = Pager(build, n_workers=1)
    pager.request([1])
    assert started.wait(30)
    assert pager.take(5) == []  # the result, had it waited
    gate.set()
    pager.close()


def test_an_error_is_a_result():
    def build(key, _):
        raise ValueError(f"bad {key}")

    pager = Pager(build, n_workers=1)
    pager.request([4])
    (built,) = finish(pager, 1)
    assert (built.key, str(built.error)) == (4, "bad 4")
    pager.close()


def test_a_finished_result_is_not_built_again():
    n_built = []
    pager = Pager(lambda key, _: n_built.append(key), n_workers=1)
    pager.request([1])
    assert pager.wait(30)
    pager.request([1])
    assert len(finish(pager, 1)) == 1
    assert pager.wait(30)  # nothing is under work
    assert pager.take(1) == []
    assert n_built == [1]
    pager.close()
