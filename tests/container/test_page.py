"""Index pages (FORMAT.md §3.3): round trip, size, and every rule with a valid checksum."""

import zlib
from dataclasses import replace

import numpy as np
import pytest

from terrainwave.container.page import (
    empty_page,
    file_order,
    pack_columns,
    pack_page,
    page_layout,
    page_length,
    payload_starts,
    unpack_page,
)
from terrainwave.errors import CorruptStreamError, TerrainwaveError
from terrainwave.grid.quadtree import Block, Grid

GRID = Grid(2000, 1999, 32)  # k_max = 6: level 2's sixteen blocks are heads of segments
TOP = page_layout(GRID, None)
BELOW = page_layout(GRID, Block(2, 0, 0))


def filled_page(layout, seed=1):
    rng = np.random.default_rng(seed)
    n_keys, n_blocks, n_children = map(len, layout)

    def crcs(lengths):
        drawn = rng.integers(0, 2**32, n_keys, dtype=np.uint32)
        return np.where(lengths > 0, drawn, 0).astype(np.uint32)

    lengths = rng.integers(0, 3, n_keys, dtype=np.uint32) * rng.integers(0, 40_000, n_keys)
    meshes = np.where(rng.integers(0, 2, n_keys) > 0, 1000, 0)
    page_lengths = rng.integers(13, 2000, n_children)
    return replace(
        empty_page(layout),
        payload_lengths=lengths.astype(np.uint32),
        payload_crcs=crcs(lengths),
        mesh_lengths=meshes.astype(np.uint32),
        mesh_crcs=crcs(meshes),
        codes=rng.integers(0, 256, (n_blocks, 4), dtype=np.uint8),
        child_page_lengths=page_lengths.astype(np.uint32),
        child_lengths=(page_lengths + rng.integers(0, 2**40, n_children)).astype(np.uint64),
        first_child=2**40 if n_children else 0,
    )


def packed(page):
    return pack_page(pack_columns(page), page.first_child)


@pytest.mark.parametrize("layout", [TOP, BELOW, page_layout(Grid(1, 1, 32), None)])
def test_a_page_comes_back_from_its_bytes(layout):
    page = filled_page(layout)
    found = unpack_page(packed(page), layout, "the page")
    for name, column in vars(page).items():
        np.testing.assert_array_equal(getattr(found, name), column, strict=name != "first_child")


@pytest.mark.parametrize(
    ("n_rows", "n_cols", "block"),
    [(1, 1, 32), (1, 2**31, 32), (2**25, 2**25, 32), (2**25, 2**25, 1024), (2**21, 2**29, 64)],
)
def test_no_page_lists_more_than_the_limits_of_format_10(n_rows, n_cols, block):
    grid = Grid(n_rows, n_cols, block)
    heads = [None]
    while heads:
        layout = page_layout(grid, heads[0])
        limits = (22, 85, 64) if heads[0] is None else (85, 340, 256)
        assert all(len(rows) <= limit for rows, limit in zip(layout, limits))
        heads = layout.children[:1]


@pytest.mark.parametrize("side", [1, 100, 300])  # no, two and, below a page of its own, four levels
def test_keys_and_blocks_of_the_top_page_begin_with_the_root(side):
    layout = page_layout(Grid(side, side, 32), None)
    assert layout.keys[0] == Block(-1, 0, 0)
    assert [b for b in layout.keys if b.level == -1] == layout.keys[:1]
    assert layout.blocks[0] == Block(0, 0, 0)


@pytest.mark.parametrize("side", [1, 33, 65, 129, 257, 300, 1000, 2000, 2100, 5000])
def test_keys_and_children_are_the_segments_of_the_quadtree(side):
    grid = Grid(side, (side + 2) // 3, 32)
    heads = [None]
    for head in grid.segment_heads():
        layout = page_layout(grid, head)
        assert [key for key in layout.keys if key.level >= 0] == grid.segment_groups(head)
        assert layout.children == grid.segment_children(head)
        heads += layout.children
    assert heads == list(grid.segment_heads())


def test_payloads_lie_in_the_order_of_format_3_2():
    grid = Grid(2000, 2000, 32)
    keys = page_layout(grid, Block(2, 0, 0)).keys
    order = [keys[row] for row in file_order(keys)]
    assert order[0] == (2, 0, 0)
    assert order[1:6] == [(3, 0, 0), (4, 0, 0), (4, 0, 1), (4, 1, 0), (4, 1, 1)]
    assert order[6:8] == [(3, 0, 1), (4, 0, 2)]
    assert order[16:21] == [(3, 1, 1), (4, 2, 2), (4, 2, 3), (4, 3, 2), (4, 3, 3)]
    assert order[21:24] == [(5, 7, 7), (5, 7, 6), (5, 6, 7)]
    assert order[-1] == (5, 0, 0)
    assert sorted(order) == sorted(keys)


@pytest.mark.parametrize(("side", "last"), [(30, -1), (60, 0), (100, 1), (250, 2)])
def test_the_root_lies_first_and_the_fourth_level_of_the_top_segment_backwards(side, last):
    keys = page_layout(Grid(side, side, 32), None).keys
    order = [keys[row] for row in file_order(keys)]
    assert order[-1].level == keys[-1].level == last
    assert order == (keys if last < 2 else keys[:6] + keys[:5:-1])


def test_each_payload_begins_where_the_one_before_it_in_the_file_ends():
    layout = page_layout(Grid(2000, 2000, 32), Block(2, 0, 0))
    page = empty_page(layout)
    page.payload_lengths[:] = np.arange(len(layout.keys)) + 10
    page.mesh_lengths[::3] = 7
    starts = payload_starts(page, layout, 1000)
    end = 1000
    for row in file_order(layout.keys):
        assert starts[row] == end
        end += int(page.payload_lengths[row] + page.mesh_lengths[row])
    assert end == 1000 + page.body_length


def test_blocks_are_those_of_the_keys_in_their_order():
    grid = Grid(5000, 3000, 32)
    for head in grid.segment_heads():
        layout = page_layout(grid, head)
        assert layout.blocks == [b for key in layout.keys for b in grid.key_blocks(key)]
        levels = [b.level for b in layout.blocks]
        assert levels == sorted(levels)


def test_a_page_of_85_groups_stays_within_24_bytes_per_group():
    # As at 0.1 bit/sample: 2.5 kB per group, differing by a third; codes of some four bits.
    grid = Grid(16 * 32 + 1, 16 * 32 + 1, 32)
    assert grid.k_max == 4
    layout = page_layout(grid, Block(0, 0, 0))
    rng = np.random.default_rng(3)
    assert len(layout.keys) == 85
    codes = rng.geometric(0.12, (340, 4)).clip(0, 255).astype(np.uint8)
    codes[:, 3] = 0
    page = replace(
        empty_page(layout),
        payload_lengths=rng.integers(1500, 3500, 85).astype(np.uint32),
        payload_crcs=rng.integers(0, 2**32, 85, dtype=np.uint32),
        codes=codes,
    )
    assert page_length(pack_columns(page)) <= 24 * 85


def changed(layout, **columns):
    page = filled_page(layout)
    arrays = {}
    for name, (row, value) in columns.items():
        arrays[name] = getattr(page, name).copy()
        arrays[name][row] = value
    return replace(page, **arrays)


@pytest.mark.parametrize(
    ("page", "message"),
    [
        (changed(TOP, mesh_lengths=(1, 2**31)), "mesh of more than"),
        (changed(TOP, payload_lengths=(1, 0), payload_crcs=(1, 1)), "empty payload"),
        (changed(TOP, child_lengths=(3, 0)), "without segment"),
        (changed(TOP, child_page_lengths=(3, 2**15 + 1)), "13 ... 2"),
        (changed(TOP, child_page_lengths=(3, 500), child_lengths=(3, 499)), "shorter"),
        (replace(filled_page(BELOW), first_child=1), "below the finest"),
    ],
)
def test_a_rule_broken_under_a_right_checksum_is_corrupt(page, message):
    layout = TOP if len(page.child_lengths) else BELOW
    with pytest.raises(CorruptStreamError, match=message):
        unpack_page(packed(page), layout, "the page")


def test_lengths_that_would_overflow_64_bits_add_up_right():
    page = changed(TOP, child_lengths=(slice(None), 2**64 - 1))
    n_pages = page.child_page_lengths.sum().item()
    assert page.children_end == page.first_child + 16 * (2**64 - 1) - n_pages


@pytest.mark.parametrize("other", [BELOW, page_layout(GRID, Block(2, 3, 3))])
def test_a_page_of_another_segment_has_the_wrong_number_of_bytes(other):
    with pytest.raises(CorruptStreamError, match="inflates to"):
        unpack_page(packed(filled_page(TOP)), other, "the page")


def test_a_page_that_inflates_without_end_is_stopped():
    bomb = zlib.compress(bytes(10_000_000), 9)
    with pytest.raises(CorruptStreamError, match="inflates to more than"):
        unpack_page(pack_page(bomb, 0), BELOW, "the page")


def test_every_prefix_of_a_page_is_corrupt():
    data = packed(filled_page(BELOW))
    for length in range(len(data)):
        with pytest.raises(CorruptStreamError):
            unpack_page(data[:length], BELOW, "the page")


def test_the_longest_payloads_and_meshes_are_legal_and_add_up():
    longest = np.full(len(TOP.keys), 2**31 - 1, dtype=np.uint32)
    page = replace(filled_page(TOP), payload_lengths=longest, mesh_lengths=longest)
    found = unpack_page(packed(page), TOP, "the page")
    assert found.sections_length == 2 * len(TOP.keys) * (2**31 - 1)


def test_any_columns_under_a_right_checksum_give_a_page_or_our_own_error():
    rng = np.random.default_rng(5)
    for _ in range(300):
        content = bytearray(zlib.decompress(pack_columns(filled_page(TOP))))
        for _ in range(3):
            content[rng.integers(len(content))] = rng.integers(256)
        try:
            page = unpack_page(pack_page(zlib.compress(bytes(content)), 2**40), TOP, "the page")
        except TerrainwaveError:
            continue
        assert len(page.flags) == len(TOP.keys)
