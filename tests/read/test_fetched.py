"""Payloads on their way: fetched by one thread each, waited for by the others."""

import os
import threading

import pytest
from forks import holds_in_a_fork

from terrainwave.errors import CorruptStreamError, StorageError
from terrainwave.grid.quadtree import Block
from terrainwave.read import fetched
from terrainwave.read.fetched import FetchedPayloads

KEYS = [Block(0, 0, col) for col in range(4)]


def test_what_is_on_its_way_is_waited_for_and_asked_for_once():
    gate, calls = threading.Event(), []

    def payloads(keys):
        calls.append(list(keys))
        gate.wait(30)
        return [bytes([key.col]) for key in keys]

    store, found = FetchedPayloads(payloads), []
    threads = [threading.Thread(target=store.fetch, args=(KEYS[:3],))]
    threads[0].start()
    while not calls:
        pass
    store.fetch(KEYS[1:3])  # all on their way: returns at once
    threads.append(threading.Thread(target=lambda: found.append(store.take(KEYS[1]))))
    threads[1].start()
    gate.set()
    for thread in threads:
        thread.join(30)
    assert (calls, found) == ([KEYS[:3]], [b"\1"])
    assert store.take(KEYS[0]) == b"\0"
    assert store.take(KEYS[3]) == b"\3"  # fetched by itself
    assert len(calls) == 2


@pytest.mark.parametrize("error", [CorruptStreamError, StorageError])
def test_what_could_not_be_fetched_is_left_for_take_to_report(error):
    def payloads(keys):
        raise error("no")

    store = FetchedPayloads(payloads)
    if error is StorageError:
        with pytest.raises(StorageError):
            store.fetch(KEYS)
    else:
        store.fetch(KEYS)
    with pytest.raises(error):
        store.take(KEYS[0])


def test_the_oldest_of_what_nobody_takes_goes(monkeypatch):
    calls = []

    def payloads(keys):
        calls.append(list(keys))
        return [bytes(10) for _ in keys]

    monkeypatch.setattr(fetched, "_MAX_BYTES", 15)
    store = FetchedPayloads(payloads)
    store.fetch(KEYS[:2])  # what was just fetched stays, however much
    store.fetch(KEYS[2:])
    for key in KEYS:
        store.take(key)
    assert calls == [KEYS[:2], KEYS[2:], [KEYS[0]]]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_fork_fetches_what_is_on_its_way_to_a_thread_of_its_parent():
    parent, is_asked, gate = os.getpid(), threading.Event(), threading.Event()

    def payloads(keys):
        is_asked.set()
        if os.getpid() == parent:
            gate.wait(30)
        return [bytes([key.col]) for key in keys]

    store = FetchedPayloads(payloads)
    thread = threading.Thread(target=store.fetch, args=(KEYS[:2],))
    thread.start()
    is_asked.wait(30)
    try:
        assert holds_in_a_fork(lambda: store.take(KEYS[1]) == b"\1")
    finally:
        gate.set()
        thread.join(30)
