"""Run tasks that wait for one another in threads."""

import heapq
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import TypeVar

Key = TypeVar("Key")


def run_after_parents(
    submit: Callable[[Callable[[Key], None], Key], "Future[None]"],
    n_at_once: int,
    keys: Sequence[Key],
    parent_of: Callable[[Key], Key | None],
    work: Callable[[Key], None],
) -> None:
    """Call `work` for every key, after its parent if that is a key too; earlier keys first.

    No thread waits for another's key while there is one that can be begun: a window's chain of
    ancestors keeps all threads busy as far as it branches. `n_at_once` are handed to `submit` at
    most; one more than there are threads, and none waits for the next key.

    Raises
    ------
    Exception
        What `work` raised first; keys not begun by then are left, those begun are waited for.
    """
    places = {key: place for place, key in enumerate(keys)}
    below: defaultdict[Key, list[int]] = defaultdict(list)
    ready: list[int] = []  # ascending, and so a heap
    for place, key in enumerate(keys):
        parent = parent_of(key)
        if parent is not None and parent in places:
            below[parent].append(place)
        else:
            ready.append(place)
    running: dict[Future[None], Key] = {}
    try:
        while ready or running:
            while ready and len(running) < n_at_once:
                key = keys[heapq.heappop(ready)]
                running[submit(work, key)] = key
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                key = running.pop(future)
                future.result()
                for place in below.pop(key, ()):
                    heapq.heappush(ready, place)
    finally:
        for future in running:
            future.cancel()
        wait(running)
