"""Ranges of bytes: requests that cover them, and reading in rounds.

A request to a server a hundred milliseconds away takes as long as some 500 KiB, and storage is
billed by the request. So gaps between wanted ranges are bridged, the shortest first: that saves
most requests for a number of unwanted bytes. `native/gdal/source.cpp` and `js/src/source.js` do the
same.
"""

from bisect import bisect_right, insort
from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate
from typing import NamedTuple, Protocol

MAX_GAP = 1024 * 1024
MAX_REQUEST = 16 * 1024 * 1024
# Target number of requests for a window, in all rounds (docs/decisions/0010).
AIMED_REQUESTS = 3
# Bytes in gaps to bridge, as a share of the wanted bytes: always, and while there are more requests
# than the target. With few wanted bytes, at least 64 and 512 KiB.
_WASTE, _MOST_WASTE = 0.25, 1.5
_FREE_WASTE, _MOST_FREE_WASTE = 64 * 1024, 512 * 1024


class ByteRange(NamedTuple):
    """`length` bytes from `offset`."""

    offset: int
    length: int

    @property
    def end(self) -> int:
        return self.offset + self.length


class Budget(NamedTuple):
    """Target number of requests of one round, and bytes in gaps to bridge: always, and above it."""

    n_requests: int
    waste: int
    most_waste: int


def budget_of(n_wanted: int, n_requests: int = 0, n_wasted: int = 0) -> Budget:
    """Return the budget that is left of a whole read of `n_wanted` bytes, after earlier rounds."""
    waste = max(_FREE_WASTE, int(_WASTE * n_wanted))
    most_waste = max(_MOST_FREE_WASTE, int(_MOST_WASTE * n_wanted))
    return Budget(AIMED_REQUESTS - n_requests, waste - n_wasted, most_waste - n_wasted)


def merge_ranges(ranges: Iterable[ByteRange], budget: Budget | None = None) -> list[ByteRange]:
    """Return requests that cover `ranges`, by offset, up to 16 MiB each.

    The shortest gaps are bridged, none above 1 MiB, within `budget`; by default that of these
    ranges.
    """
    runs: list[ByteRange] = []
    for wanted in sorted(part for part in ranges if part.length):
        if not runs or not _extend(runs, wanted, max_gap=0):
            runs.append(wanted)
    bridged = _gaps_to_bridge(runs, budget or budget_of(sum(span.length for span in runs)))
    merged: list[ByteRange] = []
    for number, span in enumerate(runs):
        if number not in bridged or not _extend(merged, span, MAX_GAP):
            merged.append(span)
    return merged


def _extend(merged: list[ByteRange], span: ByteRange, max_gap: int) -> bool:
    """Add `span` to the last request if it fits; return whether it does."""
    last = merged[-1]
    end = max(last.end, span.end)
    if span.offset - last.end > max_gap or end - last.offset > MAX_REQUEST:
        return False
    merged[-1] = ByteRange(last.offset, end - last.offset)
    return True


def _gaps_to_bridge(runs: Sequence[ByteRange], budget: Budget) -> set[int]:
    """Return the numbers of the runs to join to their predecessors."""
    gaps = [(runs[number].offset - runs[number - 1].end, number) for number in range(1, len(runs))]
    shortest = [(gap, number) for gap, number in sorted(gaps) if gap <= MAX_GAP]
    costs = list(accumulate(gap for gap, _ in shortest))
    n_aimed = len(runs) - max(budget.n_requests, 1)
    n_bridged = min(n_aimed, bisect_right(costs, budget.most_waste))
    n_bridged = max(n_bridged, bisect_right(costs, budget.waste))
    return {number for _, number in shortest[:n_bridged]}


class _Source(Protocol):
    is_local: bool

    def read_spans(self, spans: Sequence[ByteRange]) -> list[bytes]: ...


class RoundReader:
    """Fetches ranges of a source in rounds that share one budget; all bytes fetched stay.

    `start`: beginning of the source, as far as it is known.
    """

    def __init__(self, source: _Source, start: bytes = b"") -> None:
        self._source = source
        self._pieces: list[tuple[int, bytes]] = []  # disjoint, by offset
        self._add(0, start)
        self._wanted: dict[ByteRange, None] = {}
        self._n_requests = 0
        self._n_read = 0

    def fetch(self, wanted: Iterable[ByteRange]) -> None:
        """Fetch the missing parts of `wanted` in one round, which still needs earlier ones."""
        self._wanted |= dict.fromkeys(wanted)
        missing = [part for place in self._wanted for part in self._missing(place)]
        n_wanted = sum(place.length for place in self._wanted)
        n_useful = n_wanted - sum(part.length for part in missing)
        n_wasted = max(0, self._n_read - n_useful)
        budget = budget_of(n_wanted, self._n_requests, n_wasted)
        if self._source.is_local:
            budget = budget._replace(most_waste=budget.waste)
        spans = merge_ranges(missing, budget)
        for span, data in zip(spans, self._source.read_spans(spans), strict=True):
            self._add(span.offset, data)
            self._n_read += span.length
        self._n_requests += len(spans)

    def has(self, place: ByteRange) -> bool:
        return not self._missing(place)

    def take(self, wanted: ByteRange) -> bytes:
        return b"".join(
            piece[max(0, wanted.offset - start) : wanted.end - start]
            for start, piece in self._overlapping(wanted)
        )

    def _add(self, offset: int, data: bytes) -> None:
        """Store bytes from `offset` on; existing bytes do not change."""
        for part in self._missing(ByteRange(offset, len(data))):
            insort(self._pieces, (part.offset, data[part.offset - offset : part.end - offset]))

    def _missing(self, wanted: ByteRange) -> list[ByteRange]:
        parts, pos = [], wanted.offset
        for start, piece in self._overlapping(wanted):
            if pos < start:
                parts.append(ByteRange(pos, start - pos))
            pos = start + len(piece)
        if pos < wanted.end:
            parts.append(ByteRange(pos, wanted.end - pos))
        return parts

    def _overlapping(self, wanted: ByteRange) -> Iterator[tuple[int, bytes]]:
        first = bisect_right(self._pieces, wanted.offset, key=lambda piece: piece[0]) - 1
        for at in range(max(0, first), len(self._pieces)):
            start, piece = self._pieces[at]
            if start >= wanted.end:
                break
            if start + len(piece) > wanted.offset:
                yield start, piece
