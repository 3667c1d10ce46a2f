"""Reading in rounds: earlier rounds give the positions of later ranges."""

from collections.abc import Sequence

from terrainwave.container.sources.byte_source import ByteSource
from terrainwave.container.sources.ranges import ByteRange, FetchedBytes, budget_of, merge_ranges


class RoundReader:
    """Fetches ranges of a source, a round at a time; all rounds share one budget.

    Parameters
    ----------
    start : bytes
        Beginning of the source, as far as it is known.
    """

    def __init__(self, source: ByteSource, start: bytes) -> None:
        self._source = source
        self._fetched = FetchedBytes()
        self._fetched.add(0, start)
        self._n_requests = 0
        self._n_read = 0

    def fetch(self, wanted: Sequence[ByteRange]) -> None:
        """Fetch the missing parts of `wanted`, in one round.

        `wanted` are all ranges known to be needed, including those of earlier rounds. Ranges that
        turn out to be unnecessary count as wasted from the next round on.
        """
        missing = [part for place in wanted for part in self._fetched.missing(place)]
        n_wanted = sum(place.length for place in wanted)
        n_useful = n_wanted - sum(part.length for part in missing)
        n_wasted = max(0, self._n_read - n_useful)
        budget = budget_of(n_wanted, self._n_requests, n_wasted)
        if self._source.is_local:
            budget = budget._replace(most_waste=budget.waste)
        merged = merge_ranges(missing, budget)
        spans = [span for span, _ in merged]
        for span, data in zip(spans, self._source.read_spans(spans), strict=True):
            self._fetched.add(span.offset, data)
            self._n_read += span.length
        self._n_requests += len(spans)

    def has(self, place: ByteRange) -> bool:
        """Return whether a range is fetched already."""
        return not self._fetched.missing(place)

    def take(self, place: ByteRange) -> bytes:
        """Return the bytes of a wanted range."""
        return self._fetched.take(place)
