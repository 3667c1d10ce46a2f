"""How much is read with a page: the wanted payloads next to it, by an estimate of their lengths."""

from dataclasses import replace

import numpy as np
import pytest

from terrainwave.container.page import empty_page, file_order, page_layout
from terrainwave.container.segment import page_and_payloads, segment_of_page
from terrainwave.container.sources.ranges import ByteRange
from terrainwave.grid.quadtree import Block, Grid

GRID = Grid(2000, 2000, 32)  # six levels of keys, two of them in the top segment
HEAD = Block(2, 1, 2)
LAYOUT = page_layout(GRID, HEAD)
PAGE_LENGTH, START = 500, 1_000_000
# Below a payload of 10000 bytes, each level's are 1000 bytes shorter than those above.
KEYS = [LAYOUT.keys[row] for row in file_order(LAYOUT.keys)]
LENGTHS = np.array([9000, 8000, 7000, 6000])[[key.level - HEAD.level for key in KEYS]]


def top_segment(body_length, above, sibling_factor=1):
    """Return a top segment whose child `HEAD` has a body of so many bytes."""
    layout = page_layout(GRID, None)
    page = empty_page(layout)
    page.payload_lengths[:] = above
    lengths = [
        PAGE_LENGTH + int(body_length * (1 if child == HEAD else sibling_factor))
        for child in layout.children
    ]
    page.child_lengths[:] = lengths
    page.child_page_lengths[:] = PAGE_LENGTH
    first = START - sum(lengths[: layout.children.index(HEAD)])
    return segment_of_page(None, layout, replace(page, first_child=first), 0, 100, first)


def ahead(parent, wanted):
    """Return the bytes that are read beyond the page."""
    span = page_and_payloads(parent, HEAD, LAYOUT, wanted)
    assert span.offset == START
    return span.length - PAGE_LENGTH


@pytest.mark.parametrize("n_wanted", [1, 2, 3])
def test_wanted_payloads_next_to_the_page_are_read_with_it_and_little_more(n_wanted):
    parent = top_segment(int(LENGTHS.sum()), 10_000)
    n_next = int(LENGTHS[:n_wanted].sum())
    assert n_next <= ahead(parent, set(KEYS[:n_wanted])) <= 1.3 * n_next


def test_payloads_behind_one_that_is_not_wanted_are_not_read_with_the_page():
    parent = top_segment(int(LENGTHS.sum()), 10_000)
    assert ahead(parent, {KEYS[0], KEYS[2]}) == ahead(parent, {KEYS[0]})
    assert ahead(parent, set(KEYS[1:])) == ahead(parent, set()) == 0


def test_the_payload_above_counts_by_the_segments_part_of_what_is_below_it():
    n_bytes = int(LENGTHS.sum())
    # The three beside it are a third as long, so what is above holds half as much for them all.
    parent = top_segment(n_bytes, 5000, sibling_factor=1 / 3)
    assert 9000 <= ahead(parent, {HEAD}) <= 1.3 * 9000


def test_never_more_than_the_segment_nor_a_mebibyte_is_read_with_its_page():
    everything = set(KEYS)
    n_bytes = int(LENGTHS.sum())
    assert ahead(top_segment(n_bytes, 10_000), everything) == n_bytes
    assert ahead(top_segment(10, 2**31 - 1), everything) == 10
    assert ahead(top_segment(2**40, 0), everything) == 2**20
    assert ahead(top_segment(2**30, 2**31 - 1), {HEAD}) == 2**20


def test_a_segment_without_bytes_or_payloads_is_its_page():
    assert ahead(top_segment(0, 10_000), {HEAD}) == 0
    parent = top_segment(100, 10_000)
    parent.page.child_lengths[parent.layout.child_rows[HEAD]] = 0
    parent.page.child_page_lengths[parent.layout.child_rows[HEAD]] = 0
    assert page_and_payloads(parent, HEAD, LAYOUT, {HEAD}) == ByteRange(START, 0)
