"""Memory that threads take turns with.

What a process has not touched before costs it a page fault every 4 KB: half as much as decoding
what goes there.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

import numpy as np

from terrainwave.codec.refiner import Heights

Memory = TypeVar("Memory")


class HeightMemory:
    """Memory for the heights of a unit."""

    def __init__(self) -> None:
        self._heights = np.empty(0, dtype=np.int32)

    def heights(self, shape: tuple[int, int]) -> Heights:
        """Return an array of this shape, the same memory each time."""
        size = shape[0] * shape[1]
        if self._heights.size < size:
            self._heights = np.empty(size, dtype=np.int32)
        return self._heights[:size].reshape(shape)


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
