"""Memory shared by threads in turn, or reused by consecutive arrays.

Untouched memory costs a process a page fault every 4 KB: half as much as decoding into it.
"""

import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.refiner import Heights

Memory = TypeVar("Memory")


class Spares(Generic[Memory]):
    """Pool of memory; it keeps as many objects as were in use at once."""

    def __init__(self, make: Callable[[], Memory]) -> None:
        self._make = make
        self._spare: list[Memory] = []

    @contextmanager
    def lent(self) -> Iterator[Memory]:
        """Lend an object to one thread until the end of the `with` block."""
        try:
            memory = self._spare.pop()
        except IndexError:
            memory = self._make()
        try:
            yield memory
        finally:
            self._spare.append(memory)


# Memory kept for the next arrays: a window of 512 samples a side needs a dozen units.
_MOST_KEPT = 1 << 24
_PIECE = 1 << 16  # sizes are multiples of this, so that memory of one unit fits most others


class _Recycler:
    """Arrays whose memory is reused once nothing refers to it."""

    def __init__(self) -> None:
        self._spare: dict[int, list[NDArray[np.uint8]]] = {}
        self._n_bytes = 0  # approximate: threads may miscount by a piece

    def heights(self, shape: tuple[int, int]) -> Heights:
        """Return an uninitialised array of this shape."""
        size = shape[0] * shape[1]
        n_bytes = -(-4 * size // _PIECE) * _PIECE
        try:
            memory = self._spare[n_bytes].pop()
            self._n_bytes -= n_bytes
        except (KeyError, IndexError):
            memory = np.empty(n_bytes, dtype=np.uint8)
        # All views of it refer to this array, which refers to no other array: numpy's search for
        # the owner ends at a memoryview.
        owner = np.frombuffer(memory.data, dtype=np.int32)
        weakref.finalize(owner, self._take_back, memory).atexit = False
        return owner[:size].reshape(shape)

    def _take_back(self, memory: NDArray[np.uint8]) -> None:
        if self._n_bytes + memory.size <= _MOST_KEPT:
            self._n_bytes += memory.size
            self._spare.setdefault(memory.size, []).append(memory)


new_heights = _Recycler().heights


def flat(heights: Heights) -> tuple[Heights, int]:
    """Return a flat array that begins with heights, and the distance of their rows in it.

    A part of a unit is not copied: its memory is that of `new_heights`.
    """
    found = flat_view(heights)
    if found is None:
        copied = new_heights(heights.shape)
        copied[:] = heights
        found = copied.ravel(), heights.shape[1]
    return found


def flat_view(heights: NDArray[Any]) -> tuple[NDArray[Any], int] | None:
    """Do as `flat` for any numbers, without a copy; None where there is no such view."""
    owner = heights.base
    if heights.flags.c_contiguous:
        return heights.reshape(-1), heights.shape[1]
    if isinstance(owner, np.ndarray) and (owner.ndim, owner.dtype) == (1, heights.dtype):
        row_spacing, col_spacing = (size // owner.itemsize for size in heights.strides)
        if owner.flags.c_contiguous and col_spacing == 1:
            first = (_address(heights) - _address(owner)) // owner.itemsize
            return owner[first:], row_spacing
    return None


def _address(heights: NDArray[Any]) -> int:
    return int(heights.__array_interface__["data"][0])
