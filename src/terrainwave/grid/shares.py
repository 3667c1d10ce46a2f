"""Distribution of things on a grid to threads."""

from collections.abc import Callable, Iterable
from itertools import zip_longest
from typing import TypeVar

T = TypeVar("T")

# Number of blocks two levels above that are processed in parallel.
_AT_ONCE = 8


def shares_of(things: Iterable[T], place: Callable[[T], tuple[int, int]]) -> list[list[T]]:
    """Return things in shares, one for each block of the level above them.

    Consecutive shares lie below different blocks of the level above that: threads that take them in
    turns seldom wait for each other's ancestors. They still stay close together, so that few such
    blocks are in use at a time.

    Parameters
    ----------
    place : callable
        Returns the row and column of a thing, in blocks of its level.
    """
    shares: dict[tuple[int, int], dict[tuple[int, int], list[T]]] = {}
    for thing in things:
        row, col = place(thing)
        own = shares.setdefault((row >> 2, col >> 2), {})
        own.setdefault((row >> 1, col >> 1), []).append(thing)
    below = [list(own.values()) for own in shares.values()]
    runs = [below[first : first + _AT_ONCE] for first in range(0, len(below), _AT_ONCE)]
    return [share for run in runs for turn in zip_longest(*run) for share in turn if share]
