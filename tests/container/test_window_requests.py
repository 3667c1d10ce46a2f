"""What windows over several segments cost of a file as large as real ones, payloads being zeros."""

import io

import numpy as np
import pytest
from container.toys import paths_to_corner, toy_codes, toy_header

from terrainwave.container.page import page_layout
from terrainwave.container.reader import Container
from terrainwave.container.sources.byte_source import BufferSource
from terrainwave.container.sources.ranges import AIMED_REQUESTS
from terrainwave.container.spool import SegmentSpool
from terrainwave.container.writer import assemble

# Mean bytes of payloads of levels -1 ... 5 of benchmarks/remote.py's file, rounded.
MEAN_LENGTHS = (26_000, 64_000, 54_000, 44_000, 31_000, 18_000, 7_500)


class Counting(BufferSource):
    def __init__(self, data):
        super().__init__(data)
        self.rounds = []

    def read_spans(self, spans):
        self.rounds.append([span.length for span in spans])
        return super().read_spans(spans)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A file of six levels of groups in 1 + 16 segments."""
    rng = np.random.default_rng(7)
    header = toy_header(64 * 32, 64 * 32)
    grid = header.grid
    assert (grid.k_max, len(page_layout(grid, None).children)) == (6, 16)
    spools = {}
    for head in grid.segment_heads():
        spools[head] = SegmentSpool(tmp_path_factory.mktemp("spools"))
        for key in page_layout(grid, head).keys:
            codes = bytes(code for block in grid.key_blocks(key) for code in toy_codes(block))
            length = int(MEAN_LENGTHS[key.level + 1] * rng.uniform(0.9, 1.1))
            spools[head].add(key, bytes(length), 0, codes)
    out = io.BytesIO()
    assemble(out, header, spools)
    return Counting(out.getvalue())


@pytest.mark.parametrize("row", [8, 16, 24])
@pytest.mark.parametrize("col", [8, 16, 24])
def test_a_window_where_four_segments_meet_takes_few_requests(source, row, col):
    container = Container(source)
    keys = paths_to_corner(container.grid, row, col)
    source.rounds.clear()
    n_needed = sum(map(len, container.payloads(keys)))
    assert len(source.rounds) == 2
    assert sum(map(len, source.rounds)) <= AIMED_REQUESTS
    assert sum(map(sum, source.rounds)) <= 1.5 * n_needed


@pytest.mark.parametrize("place", [(3, 3), (11, 14), (31, 1)])
def test_a_window_in_one_segment_costs_little_more_than_it_needs(source, place):
    container = Container(source)
    keys = paths_to_corner(container.grid, *place)
    source.rounds.clear()
    n_needed = sum(map(len, container.payloads(keys)))
    assert sum(map(len, source.rounds)) <= AIMED_REQUESTS
    assert sum(map(sum, source.rounds)) <= 1.3 * n_needed
