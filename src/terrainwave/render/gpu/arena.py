"""Allocator of ranges in one large buffer: first fit over a list of free ranges."""

from bisect import bisect


class Arena:
    """Allocates ranges of ``capacity`` items; adjacent free ranges are joined."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.used = 0
        self._free: list[tuple[int, int]] = [(0, capacity)] if capacity else []

    def take(self, size: int) -> int | None:
        """Return the start of a range of `size` items, None if none is free."""
        if size == 0:
            return 0
        for index, (start, length) in enumerate(self._free):
            if length >= size:
                if length == size:
                    del self._free[index]
                else:
                    self._free[index] = (start + size, length - size)
                self.used += size
                return start
        return None

    def give_back(self, start: int, size: int) -> None:
        if size == 0:
            return
        self.used -= size
        place = bisect(self._free, (start, size))
        if place < len(self._free) and start + size == self._free[place][0]:
            size += self._free.pop(place)[1]
        if place and sum(self._free[place - 1]) == start:
            start, size = self._free[place - 1][0], self._free[place - 1][1] + size
            self._free[place - 1] = (start, size)
        else:
            self._free.insert(place, (start, size))

    def grow(self, capacity: int) -> None:
        added = capacity - self.capacity
        start, self.capacity = self.capacity, capacity
        self.used += added
        self.give_back(start, added)
