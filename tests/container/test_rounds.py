"""Reading in rounds: nothing is fetched twice, and all rounds share one budget."""

import numpy as np
import pytest

from terrainwave.container.sources.byte_source import BufferSource
from terrainwave.container.sources.ranges import AIMED_REQUESTS, ByteRange, RoundReader

KIB = 1024
DATA = np.random.default_rng(1).bytes(4000 * KIB)


class CountingSource(BufferSource):
    def __init__(self):
        super().__init__(DATA)
        self.rounds = []

    def read_spans(self, spans):
        self.rounds.append(list(spans))
        return super().read_spans(spans)


@pytest.fixture
def source():
    return CountingSource()


def of_data(place):
    return DATA[place.offset : place.end]


def apart(first, n_ranges, length, distance):
    return [ByteRange(first + number * distance, length) for number in range(n_ranges)]


def test_how_the_source_begins_is_not_fetched_again(source):
    reader = RoundReader(source, DATA[:100])
    inside, beyond = ByteRange(20, 80), ByteRange(90, 30)
    reader.fetch([inside, beyond])
    assert source.rounds == [[ByteRange(100, 20)]]
    assert (reader.take(inside), reader.take(beyond)) == (of_data(inside), of_data(beyond))


def test_later_rounds_fetch_only_what_is_missing(source):
    reader = RoundReader(source, b"")
    early, late = ByteRange(1000, 50), ByteRange(1040, 60)
    reader.fetch([early])
    reader.fetch([late])
    reader.fetch([early, late])
    assert source.rounds == [[early], [ByteRange(1050, 50)], []]
    assert reader.take(late) == of_data(late)


def test_requests_of_earlier_rounds_count(source):
    reader = RoundReader(source, b"")
    first = apart(0, 2, 60 * KIB, 200 * KIB)  # 140 KiB between them: more than 120 KiB wanted allow
    reader.fetch(first[:1])
    reader.fetch(first[1:])
    assert list(map(len, source.rounds)) == [1, 1]
    second = apart(1300 * KIB, 4, 50 * KIB, 160 * KIB)
    reader.fetch(second)
    assert len(source.rounds[2]) == AIMED_REQUESTS - 2
    assert all(reader.take(place) == of_data(place) for place in [*first, *second])


def test_a_local_source_reads_little_that_is_not_wanted(source):
    wanted = apart(0, 8, 60 * KIB, 120 * KIB)
    RoundReader(source, b"").fetch(wanted)
    assert len(source.rounds[0]) == AIMED_REQUESTS
    source.is_local = True
    RoundReader(source, b"").fetch(wanted)
    assert len(source.rounds[1]) == 8 - 2  # a quarter of 480 KiB


def test_missing_parts_lie_before_between_and_after_what_came(source):
    reader = RoundReader(source)
    for first in (500, 2000):  # pieces as long as no gap that is bridged
        reader.fetch([ByteRange(first * KIB, 1100 * KIB)])
    wanted = ByteRange(400 * KIB, 2800 * KIB)
    assert not reader.has(wanted)
    reader.fetch([wanted])
    places = ((400, 100), (1600, 400), (3100, 100))
    assert source.rounds[2] == [ByteRange(first * KIB, n * KIB) for first, n in places]
    assert reader.take(wanted) == of_data(wanted)
