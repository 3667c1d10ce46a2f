"""Memory that threads take turns with.

What a process has not touched before costs it a page fault every 4 KB: half as much as decoding
what goes there.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

Memory = TypeVar("Memory")


class Spares(Generic[Memory]):
    """Hands out memory, and again when it has come back; as much stays as was out at once."""

    def __init__(self, make: Callable[[], Memory]) -> None:
        self._make = make
        self._spare: list[Memory] = []

    @contextmanager
    def lent(self) -> Iterator[Memory]:
        """Lend some until the end of the `with` block, to one thread."""
        try:
            memory = self._spare.pop()
        except IndexError:
            memory = self._make()
        try:
            yield memory
        finally:
            self._spare.append(memory)
