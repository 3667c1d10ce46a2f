"""Damage: every prefix, one more byte, each byte changed, forged files with right checksums."""

from dataclasses import replace

import numpy as np
import pytest
from cases import some
from container.toys import forge, toy_file, toy_header, toy_payload
from containers import open_container
from costs import n_calls, peak_memory
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.annexes import read_annex
from terrainwave.coding.deflate import deflate
from terrainwave.container.header import MAGIC
from terrainwave.container.page import empty_page, pack_columns, pack_page, page_layout
from terrainwave.errors import (
    CorruptStreamError,
    TerrainwaveError,
    TruncatedStreamError,
)
from terrainwave.grid.quadtree import Block

HEADER = toy_header(1030, 2)  # k_max = 6: level 2's three blocks are heads of segments
DATA = toy_file(HEADER)


def problems(data):
    """Return what is found in `data` by opening and checking it."""
    try:
        with open_container(data) as container:
            return list(container.check())
    except TerrainwaveError as error:
        return [error]


def test_the_file_has_segments_below_the_top_one_and_is_sound():
    assert HEADER.grid.k_max == 6
    assert len(open_container(DATA).segment(None).layout.children) == 3
    assert problems(DATA) == []


def test_every_prefix_is_truncated():
    for length in range(len(DATA)):
        with pytest.raises(TruncatedStreamError):
            open_container(DATA[:length])


@pytest.mark.parametrize("change", some([0x01, 0x80, 0xFF], 3))
def test_every_changed_byte_is_found(change):
    unnoticed = []
    for byte_pos in range(len(DATA)):
        damaged = bytearray(DATA)
        damaged[byte_pos] ^= change
        if not problems(bytes(damaged)):
            unnoticed.append(byte_pos)
    assert unnoticed == []


def test_two_exchanged_bytes_are_found():
    for byte_pos in range(8, len(DATA) - 1):
        damaged = bytearray(DATA)
        damaged[byte_pos], damaged[byte_pos + 1] = damaged[byte_pos + 1], damaged[byte_pos]
        assert bytes(damaged) == DATA or problems(bytes(damaged))


def test_a_damaged_payload_is_named_and_others_still_read():
    key = Block(5, 10, 0)
    container = open_container(DATA)
    segment = container.segment(container.grid.segment_head(key))
    start = segment.payload_range(segment.layout.key_rows[key]).offset
    damaged = bytearray(DATA)
    damaged[start] ^= 1
    container = open_container(bytes(damaged))
    with pytest.raises(CorruptStreamError, match=r"payload of group \(level 5, row 10, col 0\)"):
        container.payload(key)
    assert container.payload(Block(5, 9, 0)) == toy_payload(Block(5, 9, 0))
    assert len(list(container.check())) == 1


def test_the_damaged_root_is_named():
    damaged = bytearray(DATA)
    damaged[open_container(DATA).segment(None).sections_start] ^= 1
    with pytest.raises(CorruptStreamError, match=r"root block \(level 0, row 0, col 0\)"):
        open_container(bytes(damaged)).payload(Block(-1, 0, 0))


@given(st.binary(max_size=400))
def test_any_bytes_are_refused(data):
    for damaged in (data, MAGIC + data, DATA[:124] + data):
        with pytest.raises(TerrainwaveError):
            open_container(damaged)


@given(st.integers(128, len(DATA) - 1), st.binary(min_size=1, max_size=40))
def test_any_bytes_in_the_middle_are_found(start, data):
    damaged = (DATA[:start] + data + DATA[start + len(data) :])[: len(DATA)]
    assert damaged == DATA or problems(damaged)


# Forged: the checksums are right.

TOP = page_layout(HEADER.grid, None)


def with_children(lengths, page_lengths=None):
    lengths = np.array(lengths, dtype=np.uint64)
    page_lengths = np.minimum(lengths, 13) if page_lengths is None else np.array(page_lengths)
    return replace(
        empty_page(TOP), child_lengths=lengths, child_page_lengths=page_lengths.astype(np.uint32)
    )


def test_a_forged_file_without_faults_is_sound():
    assert problems(forge(HEADER, empty_page(TOP))) == []
    assert problems(forge(toy_header(), empty_page(page_layout(toy_header().grid, None)))) == []


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (forge(HEADER, with_children([20, 20, 21]), rest=bytes(21)), "do not fill|beyond"),
        (forge(HEADER, with_children([20, 20, 20]), rest=bytes(22)), "do not fill"),
        (forge(HEADER, with_children([20, 20, 20]), rest=bytes(21), first_child=-1), "follow"),
        (forge(HEADER, with_children([20, 20, 20]), rest=bytes(21), first_child=1), "follow"),
        (forge(HEADER, with_children([2**63, 2**63, 20]), rest=bytes(20)), "do not fill|beyond"),
        (forge(HEADER, empty_page(TOP), body=b"x"), "follow"),
        (forge(toy_header(), empty_page(page_layout(toy_header().grid, None)), body=b"x"), "fill"),
        (
            forge(HEADER, empty_page(TOP), metadata=deflate(b"[]", read_annex("dictionary.txt"))),
            "not a JSON object",
        ),
    ],
)
def test_segments_that_do_not_tile_the_file_are_corrupt(data, message):
    with pytest.raises(CorruptStreamError, match=message):
        open_container(data)


DEEP = toy_header(4 * 32 * 256 + 1, 2)  # k_max = 10: segments on levels 2 and 6
DEEP_TOP = page_layout(DEEP.grid, None)
BODIES = 16 * 87


def deep_top(n, page_length, body_length):
    """Return a top page with n child segments."""
    page = empty_page(DEEP_TOP)
    page.child_page_lengths[:n] = page_length
    page.child_lengths[:n] = page_length + body_length
    return page


def deep_forgery(*first_children, n_bytes=None):
    """Return a file whose segments on level 2 each point at sixteen bodies of 87 zeros.

    The pages of these are 13 zeros each. `first_children` map the end of the top segment's body and
    the end of level 2's to where.
    """
    below = page_layout(DEEP.grid, DEEP_TOP.children[0])
    assert len(below.children) == 16
    child = replace(
        empty_page(below),
        child_lengths=np.full(16, 100, np.uint64),
        child_page_lengths=np.full(16, 13, np.uint32),
    )
    columns, n = pack_columns(child), len(first_children)
    page = deep_top(n, len(pack_page(columns, 0)), 16 * 13)
    n_bytes = BODIES * n if n_bytes is None else n_bytes
    end_of_top = len(forge(DEEP, page))
    end_of_level = end_of_top + 16 * 13 * n
    pages = [pack_page(columns, place(end_of_top, end_of_level)) for place in first_children]
    return forge(DEEP, page, rest=bytes(16 * 13 * n + n_bytes), pages=b"".join(pages))


def test_all_faults_of_a_forgery_are_found_and_none_twice():
    data = deep_forgery(lambda top, level: level, lambda top, level: level + BODIES)
    assert DEEP.grid.k_max == 10
    assert len(problems(data)) == 32
    assert all("has only" in problem or "checksum" in problem for problem in problems(data))


def test_segments_on_the_same_bytes_are_found_and_visited_once():
    data = deep_forgery(lambda top, level: level, lambda top, level: level, n_bytes=BODIES)
    found = problems(data)
    assert sum("checksum" in problem for problem in found) == 16
    assert sum("begins at byte" in problem for problem in found) == 16
    assert len(found) == 32


def test_bytes_after_the_last_segment_are_found():
    data = forge(DEEP, empty_page(DEEP_TOP), rest=bytes(7))
    (problem,) = problems(data)
    assert problem == f"the segments end at byte {len(data) - 7} of {len(data)}"


def test_a_child_of_the_top_segment_beyond_the_end_of_the_file_is_corrupt():
    with pytest.raises(CorruptStreamError, match="beyond the end"):
        open_container(forge(DEEP, deep_top(2, 13, 50), rest=bytes(99)))


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (lambda top, level: top, "overlap"),  # itself
        (lambda top, level: level - 1, "overlap"),
        (lambda top, level: 0, "overlap"),
        (lambda top, level: 2**63, "beyond the end"),
        (lambda top, level: level + 1, "beyond the end"),
    ],
)
def test_children_are_neither_ancestors_nor_outside_the_file(place, message):
    container = open_container(deep_forgery(place))
    with pytest.raises(CorruptStreamError, match=message):
        container.segment(DEEP_TOP.children[0])
    assert any(message in problem for problem in container.check())


@pytest.mark.parametrize(
    ("n_rows", "n_cols", "block"),
    [(10**6, 10**6, 256), (2**25, 2**25, 32), (2**31, 2**19, 1024), (1, 2**31, 32)],
)
def test_a_tiny_file_may_claim_a_huge_raster_at_no_cost(n_rows, n_cols, block):
    header = toy_header(n_rows, n_cols, block)
    layout = page_layout(header.grid, None)
    data = forge(header, empty_page(layout))
    assert len(data) < 1200

    def read_and_check():
        container = open_container(data)
        level = container.grid.k_max - 1
        rows, cols = container.grid.level_blocks(level)
        assert container.payload(Block(level, rows - 1, cols - 1)) == b""
        assert list(container.check()) == []

    assert peak_memory(read_and_check) < 8e6
    assert n_calls(read_and_check) < 20_000
