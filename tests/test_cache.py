"""The cache: what stays, what goes, and how often values are made."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from forks import holds_in_a_fork
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.cache import Cache


def test_the_one_not_asked_for_longest_goes_first():
    cache = Cache(2)
    cache.put("a", 1)
    cache.put("b", 2)
    assert cache.get("a") == 1
    cache.put("c", 3)
    assert [cache.get(key) for key in "abc"] == [1, None, 3]


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(1, 9))))
def test_sizes_stay_within_the_limit_or_one_value_is_left(puts):
    dropped = []
    cache = Cache(12, size_of=lambda value: value[1], drop=dropped.append)
    for key, size in puts:
        cache.put(key, (key, size))
        kept = [value for value in map(cache.get, range(6)) if value is not None]
        assert sum(size for _, size in kept) <= 12
        assert (key, size) in kept or cache.get(key) is not None
    kept = [value for value in map(cache.get, range(6)) if value is not None]
    cache.clear()
    assert sorted(dropped[-len(kept) :] if kept else []) == sorted(kept)
    assert [cache.get(key) for key in range(6)] == [None] * 6


def test_a_value_larger_than_the_limit_stays_alone():
    cache = Cache(10, size_of=len)
    cache.put("small", "12345")
    cache.put("large", "x" * 100)
    assert cache.get("small") is None
    assert cache.get("large") == "x" * 100


def test_what_goes_is_closed_once():
    closed = []
    cache = Cache(1, drop=closed.append)
    cache.put("a", "first")
    cache.put("a", "equal")
    cache.put("b", "second")
    cache.clear()
    cache.clear()
    assert closed == ["first", "second"]


class Asked:
    """A key that says when four threads have looked it up."""

    def __init__(self):
        self.threads, self.by_all = set(), threading.Event()

    def __hash__(self):
        self.threads.add(threading.get_ident())
        if len(self.threads) == 4:
            self.by_all.set()
        return 1


def test_threads_that_ask_for_one_value_share_its_making():
    cache, made, key = Cache(4), [], Asked()

    def make():
        made.append(1)
        assert key.by_all.wait(60)
        return "value"

    with ThreadPoolExecutor(4) as pool:
        answers = [pool.submit(cache.get_or_make, key, make) for _ in range(4)]
        assert [answer.result(60) for answer in answers] == ["value"] * 4
    assert len(made) == 1


def test_a_value_that_could_not_be_made_is_tried_again_by_the_next():
    cache, attempts = Cache(4), []

    def make():
        attempts.append(1)
        if len(attempts) == 1:
            raise ValueError("damaged")
        return "value"

    with pytest.raises(ValueError, match="damaged"):
        cache.get_or_make("key", make)
    assert cache.get_or_make("key", make) == "value"


def test_making_one_value_may_ask_for_another():
    cache = Cache(4)
    below = cache.get_or_make("below", lambda: cache.get_or_make("above", lambda: 1) + 1)
    assert (below, cache.get("above")) == (2, 1)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_fork_makes_anew_what_a_thread_of_its_parent_is_making():
    cache, is_in_work, may_end = Cache(4), threading.Event(), threading.Event()

    def make():
        with cache._lock:  # as a thread may hold it
            is_in_work.set()
            may_end.wait(30)
        return "the parent's"

    with ThreadPoolExecutor(1) as pool:
        pool.submit(cache.get_or_make, "key", make)
        is_in_work.wait(30)
        try:
            assert holds_in_a_fork(lambda: cache.get_or_make("key", lambda: "own") == "own")
        finally:
            may_end.set()


def test_a_value_that_is_not_enough_is_made_anew_and_counts_once():
    cache = Cache(100, size_of=len)
    assert cache.get_or_make("a", lambda: "xx", lambda value: len(value) >= 2) == "xx"
    assert cache.get_or_make("a", lambda: "never", lambda value: len(value) >= 2) == "xx"
    assert cache.get_or_make("a", lambda: "xxxx", lambda value: len(value) >= 3) == "xxxx"
    assert cache.get("a") == "xxxx"
    assert (len(cache), cache._size) == (1, 4)
