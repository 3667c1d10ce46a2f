"""Whole files: what is written comes back, the same bytes for any order, random access."""

import io
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from container.toys import (
    everything_expected,
    read_everything,
    toy_file,
    toy_header,
    toy_payload,
)
from containers import open_container
from golden_files import GOLDEN
from hypothesis import given, settings
from hypothesis import strategies as st

from terrainwave.container.header import HEADER_SIZE
from terrainwave.container.page import page_layout
from terrainwave.container.reader import Container
from terrainwave.container.sources.byte_source import BufferSource
from terrainwave.container.sources.opening import open_source
from terrainwave.container.sources.ranges import ByteRange
from terrainwave.container.spool import SectionFile, SegmentSpool
from terrainwave.container.writer import assemble
from terrainwave.grid.quadtree import Block

sides = st.integers(1, 700) | st.sampled_from(
    [1, 2, 32, 33, 34, 65, 129, 257, 513, 514, 1025, 2049]
)


@settings(max_examples=40)
@given(n_rows=sides, n_cols=sides, block=st.sampled_from([32, 64]))
def test_everything_written_comes_back(n_rows, n_cols, block):
    header = toy_header(n_rows, n_cols, block)
    data = toy_file(header)
    with open_container(data) as container:
        assert container.header == header
        assert list(container.check()) == []
    assert read_everything(data) == everything_expected(header.grid)


@pytest.mark.parametrize(
    ("n_rows", "n_cols", "k_max"),
    [
        (1, 1, 0),
        (1, 20_000, 10),
        (40_000, 2, 11),
        (17_000, 40, 10),
        (33, 33, 0),
        (34, 1, 1),
        (1, 257, 3),
        (1, 513, 4),
        (8193, 2, 8),
    ],
)
def test_strips_and_deep_trees_come_back(n_rows, n_cols, k_max):
    header = toy_header(n_rows, n_cols, 32)
    assert header.grid.k_max == k_max
    data = toy_file(header)
    assert read_everything(data) == everything_expected(header.grid)
    assert list(open_container(data).check()) == []


def test_the_order_in_which_payloads_arrive_does_not_change_a_byte():
    header = toy_header(1500, 900)
    rng = np.random.default_rng(2)

    def shuffled(keys):
        return [keys[i] for i in rng.permutation(len(keys))]

    assert toy_file(header, shuffled) == toy_file(header) == toy_file(header, lambda k: k[::-1])


def test_bodies_lie_in_the_file_by_level_then_morton():
    header = toy_header(17_000, 3000)
    data = toy_file(header)
    with open_container(data) as container:
        segments = [container.segment(head) for head in header.grid.segment_heads()]
        end_of_page = container.extents.top_start + container.extents.top_page_length
    starts = [(one.page_starts or [one.sections_start])[0] for one in segments]
    ends = [one.end for one in segments]
    assert starts == [end_of_page, *ends[:-1]]
    assert ends[-1] == len(data)
    assert len({one.head.level for one in segments[1:]}) == 2


@pytest.mark.full
def test_pages_of_children_lie_together_before_the_payloads_above_them():
    header = toy_header(17_000, 3000)
    with open_container(toy_file(header)) as container:
        for head in header.grid.segment_heads():
            segment = container.segment(head)
            places = [segment.page_range(child) for child in segment.layout.children]
            assert [place.end for place in places[:-1]] == [place.offset for place in places[1:]]
            assert not places or places[-1].end == segment.sections_start


def test_the_top_segment_is_page_then_root_then_groups():
    header = toy_header(200, 100)
    data = toy_file(header)
    extents = open_container(data).extents
    body = data[extents.top_start + extents.top_page_length :]
    layout = page_layout(header.grid, None)
    assert layout.keys[0] == Block(-1, 0, 0)
    assert body.startswith(toy_payload(Block(-1, 0, 0)))
    assert data[HEADER_SIZE + extents.metadata_length :].startswith(b"par")


class Recording(BufferSource):
    """Remembers what was read."""

    def __init__(self, data):
        super().__init__(data)
        self.reads = []

    def read(self, offset, length):
        self.reads.append(ByteRange(offset, length))
        return super().read(offset, length)


def test_a_deep_payload_costs_one_read_per_page_on_its_path_and_one_for_itself():
    noise = "".join(chr(code) for code in np.random.default_rng(1).integers(32, 126, 20_000))
    header = toy_header(17_000, 40, metadata={"own": noise})  # all payloads beyond 16 KiB
    key = Block(9, 250, 0)
    source = Recording(toy_file(header))
    container = Container(source)
    source.reads.clear()
    assert container.payload(key) == toy_payload(key)
    assert len(source.reads) == 3  # pages headed on levels 2 and 6, payload
    source.reads.clear()
    assert container.payload(Block(9, 252, 0))
    assert len(source.reads) == 1


def test_what_opening_has_read_is_not_read_again():
    header = toy_header(300, 300)
    data = toy_file(header)
    assert len(data) < 16384
    source = Recording(data)
    container = Container(source)
    source.reads.clear()
    keys = header.grid.blocks(3)
    assert container.payloads(keys) == [toy_payload(key) for key in keys]
    assert source.reads == []


def test_payloads_near_each_other_are_read_together():
    header = toy_header(2000, 1999)
    source = Recording(toy_file(header))
    container = Container(source)
    keys = header.grid.blocks(5)
    container.payloads(keys)
    source.reads.clear()
    assert container.payloads(keys) == [toy_payload(key) for key in keys]
    assert len(source.reads) == 1


@pytest.mark.parametrize(
    "key",
    [
        Block(-1, 1, 0), Block(-1, -1, 0), Block(-2, 0, 0), Block(6, 0, 0), Block(7, 0, 0),
        Block(0, 1, 0), Block(2, 4, 0), Block(4, -1, 0), Block(5, 0, 32),
    ],
)  # fmt: skip
def test_a_key_outside_the_grid_is_a_key_error(key):
    container = open_container(toy_file(toy_header(2000, 1999)))
    for method in (container.payload, container.mesh):
        with pytest.raises(KeyError):
            method(key)


def test_eight_threads_read_what_one_reads():
    header = toy_header(2000, 1999)
    container = Container(BufferSource(toy_file(header)), cached_segments=3)
    keys = [key for level in range(6) for key in header.grid.blocks(level)]
    wrong = []

    def work(seed):
        for i in np.random.default_rng(seed).permutation(len(keys))[:300]:
            if container.payload(keys[i]) != toy_payload(keys[i]):
                wrong.append(keys[i])

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(8)))
    assert not wrong


# Absent segments (FORMAT.md §3.4)


def silent_spools(grid, directory, loud=()):
    spools = {}
    for head in grid.segment_heads():
        spools[head] = SegmentSpool(SectionFile(directory))
        layout = page_layout(grid, head)
        for key in layout.keys:
            n_blocks = 1 if key.level < 0 else len(grid.children(key))
            spools[head].add(key, b"loud" if key in loud else b"")
            spools[head].codes[key] = bytes(4 * n_blocks)
    return spools


def assembled(header, spools):
    out = io.BytesIO()
    assemble(out, header, spools)
    return out.getvalue()


def test_segments_without_any_content_take_no_bytes(tmp_path):
    header = toy_header(2000, 1999)
    data = assembled(header, silent_spools(header.grid, tmp_path))
    assert len(data) < 500
    with open_container(data) as container:
        assert list(container.check()) == []
        assert container.payload(Block(5, 9, 9)) == b""
        assert container.codes(Block(6, 9, 9)) == (0, 0, 0, 0)


def test_an_empty_segment_above_one_with_content_is_present(tmp_path):
    header = toy_header(17_000, 40)
    loud = Block(9, 200, 0)
    data = assembled(header, silent_spools(header.grid, tmp_path, {loud}))
    with open_container(data) as container:
        assert list(container.check()) == []
        assert container.payload(loud) == b"loud"
        assert container.payload(Block(9, 0, 0)) == b""
        assert container.segment(Block(6, 0, 0)).page.is_empty


def test_a_check_reads_index_pages_that_are_known(tmp_path):
    data = bytearray((GOLDEN / "v2" / "store-int16-segments.twz").read_bytes())
    path = tmp_path / "a.twz"
    path.write_bytes(data)
    with Container(open_source(path)) as container:
        assert list(container.check()) == []
        *_, last = container.present_segments()
        data[container.segment(None).page_range(last.head).offset] ^= 1
        path.write_bytes(data)
        assert any("checksum of the page" in line for line in container.check())
