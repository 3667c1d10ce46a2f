"""Do tasks run after their parents, in order, and as many at once as there may be?"""

import threading
from concurrent.futures import Future, ThreadPoolExecutor

import pytest

from terrainwave.read.schedule import run_after_parents

# A path from the root to each key, as tuples; the parent is the path without its end.
KEYS = [(), (0,), (0, 0), (0, 1), (1,), (1, 0)]


def parent_of(key):
    return key[:-1] if key else None


def run_at_once(work, key):
    """Submit to a thread that is always free."""
    future = Future()
    try:
        future.set_result(work(key))
    except ValueError as error:
        future.set_exception(error)
    return future


def test_parents_come_first_and_earlier_keys_before_later_ones():
    done = []
    run_after_parents(run_at_once, 1, KEYS, parent_of, done.append)
    assert done == KEYS


def test_a_parent_that_is_no_key_is_not_waited_for():
    done = []
    run_after_parents(run_at_once, 1, [(0, 1), (1, 0)], parent_of, done.append)
    assert done == [(0, 1), (1, 0)]


def test_branches_run_beside_each_other():
    """Both children of the root wait for each other: neither would end alone."""
    barrier = threading.Barrier(2, timeout=30)
    with ThreadPoolExecutor(2) as executor:
        run_after_parents(
            executor.submit, 3, KEYS, parent_of, lambda key: len(key) == 1 and barrier.wait()
        )


def test_no_more_are_submitted_at_once_than_asked():
    open_, most = 0, []
    lock = threading.Lock()

    def submit(work, key):
        nonlocal open_
        with lock:
            open_ += 1
            most.append(open_)
        return executor.submit(work, key)

    def work(key):
        nonlocal open_
        with lock:
            open_ -= 1

    with ThreadPoolExecutor(8) as executor:
        run_after_parents(submit, 3, range(200), lambda key: None, work)
    assert max(most) <= 3


def test_an_error_stops_what_has_not_begun():
    done = []

    def work(key):
        done.append(key)
        if key == (0,):
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        run_after_parents(run_at_once, 1, KEYS, parent_of, work)
    assert done == [(), (0,)]
