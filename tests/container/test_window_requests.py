"""What windows over several segments cost of a file as large as real ones, payloads being zeros."""

import io

import numpy as np
import pytest
from container.toys import paths_to_corner, toy_codes, toy_header

from terrainwave.container.page import page_layout
from terrainwave.container.reader import Container
from terrainwave.container.sources.byte_source import BufferSource
from terrainwave.container.spool import SectionFile, SegmentSpool
from terrainwave.container.writer import assemble

# Mean bytes of payloads of levels -1 ... 5 of benchmarks/remote.py's file, rounded.
MEAN_LENGTHS = (26_000, 64_000, 54_000, 44_000, 31_000, 18_000, 7_500)


class Counting(BufferSource):
    def __init__(self, data):
        super().__init__(data)
        self.rounds, self.reads = [], []

    def read(self, offset, length):
        self.reads.append((offset, length))
        return super().read(offset, length)

    def read_spans(self, spans):
        self.rounds.append([span.length for span in spans])
        return super().read_spans(spans)


def file_of(header, folder, lengths):
    """Return a file whose payloads have these lengths in the mean, from level -1 on."""
    rng = np.random.default_rng(7)
    grid, spools = header.grid, {}
    for head in grid.segment_heads():
        spools[head] = SegmentSpool(SectionFile(folder))
        for key in page_layout(grid, head).keys:
            codes = bytes(code for block in grid.key_blocks(key) for code in toy_codes(block))
            length = int(lengths[key.level + 1] * rng.uniform(0.9, 1.1))
            spools[head].add(key, bytes(length))
            spools[head].codes[key] = codes
    out = io.BytesIO()
    assemble(out, header, spools)
    return out.getvalue()


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A file of six levels of groups in 1 + 16 segments."""
    header = toy_header(64 * 32, 64 * 32)
    assert (header.grid.k_max, len(page_layout(header.grid, None).children)) == (6, 16)
    return Counting(file_of(header, tmp_path_factory.mktemp("spools"), MEAN_LENGTHS))


def cost(source, keys):
    """Return rounds, requests, and bytes over those needed of a window of a file just opened."""
    container = Container(source)
    source.rounds.clear()
    n_needed = sum(map(len, container.payloads(keys)))
    n_bytes = sum(map(sum, source.rounds))
    return len(source.rounds), sum(map(len, source.rounds)), n_bytes / n_needed


@pytest.mark.parametrize("row", [8, 16, 24])
@pytest.mark.parametrize("col", [8, 16, 24])
def test_a_window_where_four_segments_meet_takes_few_requests(source, row, col):
    n_rounds, n_requests, ratio = cost(source, paths_to_corner(Container(source).grid, row, col))
    assert (n_rounds, n_requests <= 8) == (1, True)
    assert ratio <= 2.5


@pytest.mark.parametrize("place", [(3, 3), (11, 14), (31, 1), (28, 20), (12, 4)])
def test_a_window_in_one_segment_takes_three_requests(source, place):
    n_rounds, n_requests, ratio = cost(source, paths_to_corner(Container(source).grid, *place))
    assert (n_rounds, n_requests <= 3) == (1, True)
    assert ratio <= 2.5


@pytest.mark.parametrize("place", [(4, 4), (3, 3), (1, 6)])
def test_a_file_of_one_segment_opens_by_one_request_and_a_window_takes_three(place, tmp_path):
    header = toy_header(16 * 32, 16 * 32)
    data = file_of(header, tmp_path, (46_000, 104_000, 56_000, 19_000, 7_000))
    assert header.grid.k_max == 4
    source = Counting(data)
    container = Container(source)
    assert source.reads == [(0, 16384)]
    n_rounds, n_requests, ratio = cost(source, paths_to_corner(container.grid, *place))
    assert (n_rounds, n_requests <= 3, ratio <= 2.5) == (1, True, True)


def test_pages_that_did_not_come_at_the_opening_come_with_the_payloads_above_them(tmp_path):
    noise = "".join(chr(code) for code in np.random.default_rng(1).integers(32, 126, 20_000))
    header = toy_header(64 * 32, 64 * 32, metadata={"own": noise})
    source = Counting(file_of(header, tmp_path, MEAN_LENGTHS))
    n_rounds, n_requests, ratio = cost(source, paths_to_corner(header.grid, 3, 3))
    assert (n_rounds, len(source.rounds[0])) == (2, 1)
    assert n_requests <= 4
    assert ratio <= 2.5
