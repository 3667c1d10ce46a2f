"""The tree of digests is that of FORMAT.md §4.8, and tells any change of heights and places."""

import dataclasses
import zlib
from fractions import Fraction

import numpy as np
import pytest

from terrainwave.container.digests import DigestTree, TileDigests, tile_digests, unpack_digests
from terrainwave.container.header import Header
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Region
from terrainwave.reference import digests as slow


def tree_of(heights, valid, side=512):
    """Return the tree of heights that were seen in windows of `side` samples."""
    whole = Region(0, 0, *heights.shape)
    tiles = TileDigests(heights.shape)
    for window in whole.tiles(side, side):
        part = window.slices_in(whole)
        tiles.add(tile_digests(window, heights[part], valid[part]))
    return tiles.tree()


def raster(shape, dtype, seed=0):
    """Return heights of all numbers and some voids, which hold anything."""
    rng = np.random.default_rng(seed)
    bits = rng.integers(0, 256, (*shape, np.dtype(dtype).itemsize), dtype=np.uint8)
    heights = bits.view(dtype)[..., 0]
    return np.nan_to_num(heights), rng.random(shape) < 0.9


# One leaf, several, and levels of nodes above them.
SHAPES = [(1, 1), (5, 5), (512, 512), (513, 511), (3, 4097), (4096, 2), (1, 33_000), (40_000, 3)]


@pytest.mark.few(1)
@pytest.mark.parametrize("shape", SHAPES)
def test_the_section_is_that_of_the_slow_decoder(shape):
    heights, valid = raster(shape, "int16")
    assert tree_of(heights, valid).pack() == slow.section_of(heights, valid)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "int32", "float32", "float64"])
def test_tiles_hold_the_bytes_of_their_dtype(dtype):
    heights, valid = raster((9, 13), dtype)
    assert tree_of(heights, valid).pack() == slow.section_of(heights, valid)


def test_windows_of_several_tiles_give_the_same_tree():
    heights, valid = raster((1030, 2100), "uint8")
    assert tree_of(heights, valid, 2048).pack() == tree_of(heights, valid).pack()


def test_what_voids_hold_does_not_count():
    heights, valid = raster((30, 40), "float32")
    assert tree_of(np.where(valid, heights, np.nan), valid).top == tree_of(heights, valid).top


def test_a_void_and_a_height_of_0_differ():
    heights = np.zeros((3, 3), np.int16)
    valid = np.ones((3, 3), np.bool_)
    first = tree_of(heights, valid).top
    valid[1, 1] = False
    assert tree_of(heights, valid).top != first


def test_nodes_without_heights_take_no_digests():
    heights, valid = raster((2, 100_000), "int16")
    valid[:, 5000:] = False
    # Top, its children (4 of 32,768 columns), and those of the one that has heights (8 leaves).
    assert len(tree_of(heights, valid).pack()) == 32 * (1 + 4 + 8) + 8
    valid[:] = False
    assert tree_of(heights, valid).pack()[:32] == bytes(32)


@pytest.mark.parametrize("shape", [(3, 3), (2, 9000), (1, 70_000)])
def test_a_section_gives_its_tree_again(shape):
    tree = tree_of(*raster(shape, "uint8"))
    found = unpack_digests(tree.pack(), shape)
    assert found.top == tree.top
    assert dict(found.leaves) == dict(tree.leaves)
    assert list(found.differences(tree)) == []


def test_any_other_byte_is_found():
    shape = 1, 70_000
    section = tree_of(*raster(shape, "uint8")).pack()
    for at in range(len(section)):
        changed = bytearray(section)
        changed[at] ^= 4
        with pytest.raises(CorruptStreamError, match="digests"):
            unpack_digests(bytes(changed), shape)


def test_a_digest_that_does_not_follow_from_those_below_is_found_behind_a_right_checksum():
    shape = 1, 70_000
    heights, valid = raster(shape, "uint8")
    tree = tree_of(heights, valid)
    leaves = dict(tree.leaves) | {(0, 3): bytes(31) + b"\1"}
    other = DigestTree(shape, leaves)
    # The top is that of other leaves than those listed.
    section = tree.top + other.pack()[32:]
    body = section[:-8]
    section = body + zlib.crc32(body).to_bytes(4, "little") + section[-4:]
    with pytest.raises(CorruptStreamError, match="not that of the digests below"):
        unpack_digests(section, shape)


def test_a_tree_names_the_leaves_that_differ():
    shape = 10, 9000
    heights, valid = raster(shape, "uint8")
    first = tree_of(heights, valid)
    heights[valid & (np.arange(9000) == 8999)] ^= 1
    assert list(tree_of(heights, valid).differences(first)) == [Region(0, 8192, 10, 808)]


METADATA = {
    "crs": "EPSG:32611", "units": "m", "area_or_point": "Point", "heights_are": "depth",
    "transform": [30, 0.0, 4e5, 0.0, -30.0, 4e6], "scale": 0.1, "offset": -7,
    "coordinate_epoch": 2020.5,
}  # fmt: skip


def header_of(metadata=METADATA, **changes):
    header = Header(
        n_rows=3, n_cols=4, block=32, border_rings=1, method="rapid", dtype="int16", effort=1,
        quantum=Fraction(1), base=0, step=1, z_min=0, z_max=9, max_error=1.0, effective_bound=0.0,
        rho=0.0, metadata=metadata,
    )  # fmt: skip
    return dataclasses.replace(header, **changes)


def root(header):
    shape = header.n_rows, header.n_cols
    return tree_of(np.ones(shape, header.dtype), np.ones(shape, np.bool_)).root(header)


@pytest.mark.parametrize(
    "metadata",
    [
        METADATA,
        {},
        dict.fromkeys(METADATA),
        METADATA | {"heights_are": "other"},
        METADATA | {"heights_are": ["depth"]},
        METADATA | {"coordinate_epoch": "soon"},
        METADATA | {"coordinate_epoch": True},
        METADATA | {"crs": 'PROJCRS["Größe"]', "offset": -0.0, "scale": 2**60 + 1},
    ],
)
def test_the_root_is_that_of_the_slow_decoder(metadata):
    header = header_of(metadata)
    heights = np.ones((3, 4), np.int16)
    tree = tree_of(heights, np.ones((3, 4), np.bool_))
    assert tree.root(header) == slow.root_of(header, metadata, "int16", tree.top)


@pytest.mark.parametrize("key", METADATA)
def test_the_root_tells_what_heights_are_and_where(key):
    assert root(header_of(METADATA | {key: None})) != root(header_of())


def test_the_root_tells_type_and_size():
    found = {root(header_of(**change)) for change in ({}, {"dtype": "uint16"}, {"n_rows": 4})}
    assert len(found) == 3


@pytest.mark.parametrize(
    "changes",
    [
        {"block": 64}, {"method": "store"}, {"effort": 2}, {"step": 3}, {"base": 5, "z_min": -5},
        {"max_error": 2.0}, {"mesh": "halves"}, {"features": 16},
        {"metadata": METADATA | {"nodata": -9, "mask_kind": "nodata", "description": "other"}},
    ],
)  # fmt: skip
def test_the_root_does_not_tell_how_a_file_is_coded(changes):
    assert root(header_of(**changes)) == root(header_of())


def test_a_missing_key_is_what_it_means():
    usual = {"transform": [1, 0, 0, 0, 1, 0], "scale": 1, "offset": 0}
    assert root(header_of(usual)) == root(header_of({}))
