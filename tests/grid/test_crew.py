"""Crews: everything is done once, in any order, by so many threads; the first error counts."""

import signal
import sys
import threading
import time

import pytest

from terrainwave import interrupts
from terrainwave.grid.crew import Crew

CREWS = pytest.mark.parametrize("n_threads", [1, 2, 5])


@CREWS
def test_results_come_in_order(n_threads):
    def doubled(number):
        time.sleep(0.002 if number % 3 == 0 else 0)  # so that later ones are done earlier
        return 2 * number

    with Crew(n_threads) as crew:
        assert list(crew.map(doubled, range(50))) == list(range(0, 100, 2))
        assert list(crew.map(doubled, [])) == []


def test_a_task_gets_one_of_each_iterable():
    with Crew(2) as crew:
        assert list(crew.map(pow, [2, 3, 4], [5, 2, 9, 9])) == [32, 9, 4**9]


@CREWS
def test_so_many_threads_work_and_the_asking_one_is_one_of_them(n_threads):
    # Passed only when all are there.
    together = threading.Barrier(n_threads, timeout=20)

    def meet(_):
        together.wait()
        return threading.current_thread()

    with Crew(n_threads) as crew:
        threads = set(crew.map(meet, range(n_threads)))
    assert len(threads) == n_threads
    assert threading.current_thread() in threads


@CREWS
def test_the_first_error_in_order_is_raised_and_ends_the_work(n_threads):
    done = []

    def work(number):
        if number == 3:
            raise KeyError(number)
        done.append(number)
        return number

    with Crew(n_threads) as crew:
        found = crew.map(work, range(1000))
        assert [next(found) for _ in range(3)] == [0, 1, 2]
        with pytest.raises(KeyError, match="3"):
            next(found)
    assert len(done) < 1000


def test_what_nobody_takes_after_an_error_is_not_done():
    """The traceback keeps the iterator: it is not closed before the crew is."""
    done = []

    def work(number):
        time.sleep(0)
        done.append(number)

    def failing():
        with Crew(2) as crew:
            found = crew.map(work, range(10**6))
            next(found)
            raise KeyError("the one that takes has failed")

    with pytest.raises(KeyError):
        failing()
    assert len(done) < 10**6


def test_a_request_that_was_raised_stops_the_other_threads():
    found = []

    def check():
        try:
            interrupts.check()
        except KeyboardInterrupt as stopped:
            found.append(stopped)

    request = KeyboardInterrupt()
    interrupts.request(request)
    try:
        with Crew(2) as crew:
            crew.submit(check).result()
            assert found == []  # the main thread comes first
            with pytest.raises(KeyboardInterrupt):
                interrupts.check()
            crew.submit(check).result()
    finally:
        interrupts.reset()
    assert len(found) == 1


def test_the_newest_is_done_first():
    done = []

    def children(node):
        done.append(node)
        return [2 * node, 2 * node + 1] if node < 4 else []

    with Crew(1) as crew:
        crew.grow(children, [1])
    assert done == [1, 2, 4, 5, 3, 6, 7]


@pytest.mark.parametrize("n_threads", [1, 3])
def test_an_error_ends_growth(n_threads):
    def children(node):
        if node == 8:
            raise KeyError(node)
        return [2 * node, 2 * node + 1]  # without end

    with Crew(n_threads) as crew, pytest.raises(KeyError, match="8"):
        crew.grow(children, [1])


def test_an_error_of_another_thread_is_raised():
    here = threading.current_thread()
    started = threading.Event()

    def work(_):
        if threading.current_thread() is here:
            assert started.wait(20)
            return []
        started.set()
        raise KeyError("there")

    with Crew(2) as crew, pytest.raises(KeyError, match="there"):
        crew.grow(work, [1, 2])


def test_a_crew_that_works_for_others_keeps_nobody_waiting():
    is_free, done = threading.Event(), []
    with Crew(2) as crew:
        crew.submit(is_free.wait)
        crew.grow(lambda number: done.append(number) or [], [1, 2, 3])
        assert list(crew.map(abs, [-1, -2])) == [1, 2]
        assert not is_free.is_set()
        is_free.set()
    assert done == [1, 2, 3]


@pytest.mark.skipif(sys.platform == "win32", reason="no signal to send to one thread only")
def test_an_interrupted_end_still_waits_for_the_threads():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    is_done = False

    def work():
        nonlocal is_done
        time.sleep(0.5)
        is_done = True

    def interrupt():
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    def work_in_crew():
        with Crew(3) as crew:
            crew.submit(work)
            threading.Timer(0.1, interrupt).start()

    try:
        with pytest.raises(KeyboardInterrupt):
            work_in_crew()
    finally:
        signal.signal(signal.SIGINT, before)
    assert is_done


def test_one_thread_starts_no_other():
    before = threading.active_count()
    with Crew(1) as crew:
        assert list(crew.map(lambda _: threading.active_count(), range(3))) == [before] * 3
        crew.grow(lambda number: range(number), [3])
        assert threading.active_count() == before
