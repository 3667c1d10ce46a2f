"""Damaged files and files that end too early: what is there is given, and what is lost is named."""

import pickle
import random

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from strategies import terrain_like

import terrainwave
from terrainwave import Terrain
from terrainwave.cli import main
from terrainwave.codec.cdf53.tile_layout import TileLayout
from terrainwave.errors import (
    CorruptStreamError,
    TerrainwaveError,
    TruncatedStreamError,
)
from terrainwave.grid.quadtree import Block, Region
from terrainwave.read.decoder import unit_key

METHODS = ("rapid", "predictive", "cdf97", "cdf53", "store")
HEIGHTS = terrain_like(300, 420)


@pytest.fixture(scope="module", params=METHODS)
def whole(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "dem.twz"
    terrainwave.compress(
        HEIGHTS, path, max_error=1, method=request.param, block=32, mesh="none", digest=False
    )
    return path


def cut(path, n_bytes):
    part = path.with_name("cut.twz")
    part.write_bytes(path.read_bytes()[:n_bytes])
    return part


@pytest.mark.few(1)
def test_a_plain_open_refuses_a_file_that_ends_too_early(whole):
    n_bytes = whole.stat().st_size
    part = cut(whole, n_bytes - 1)
    with pytest.raises(TruncatedStreamError, match=f"has {n_bytes - 1} of its {n_bytes} bytes"):
        terrainwave.open(part)


@pytest.mark.few(1)
def test_what_is_there_is_given_and_nothing_else(whole):
    """At 50 places: each unit whose payload, and those above it, are whole; as they were."""
    n_bytes = whole.stat().st_size
    with Terrain(whole, threads=1) as terrain:
        levels = [terrain.read_with_mask(level=level) for level in range(terrain.n_levels)]
        ends = ends_of_units(terrain)
        start = terrain.container.extents.top_start + terrain.container.extents.top_page_length
    n_given = []
    for place in [*random.Random(3).sample(range(start, n_bytes), 48), start, n_bytes - 1]:
        with terrainwave.open(cut(whole, place), on_error="mask", threads=1) as part:
            assert part.container.n_missing == n_bytes - place
            n_valid = 0
            for level, (heights, valid) in enumerate(levels):
                found, is_there = part.read_with_mask(level=level)
                expected = np.zeros_like(valid)
                for key, end in ends[level].items():
                    if end <= place:
                        region = region_of(part.grid, key)
                        expected[region.slices_in(Region(0, 0, *valid.shape))] = True
                assert np.array_equal(is_there, expected & valid)
                assert np.array_equal(found[is_there], heights[is_there])
                n_valid += int(is_there.sum())
                n_lost = sum(end > place for end in ends[level].values())
                assert sum(one.level == level for one in part.lost) == n_lost
            n_given.append((place, n_valid))
    counts = [n for _, n in sorted(n_given)]
    assert counts == sorted(counts)
    # One tile of cdf53 holds all of this raster, and ends with the file.
    assert (counts[0] < counts[-1]) == (terrain.header.method != "cdf53")


def region_of(grid, key):
    if key.is_root_key:
        return grid.block_region(Block(0, key.row, key.col))
    return grid.group_region(key)


def ends_of_units(terrain):
    """Return for each level where in the file the last byte lies that each unit needs."""
    grid, container = terrain.grid, terrain.container
    tiles = TileLayout(grid) if terrain.header.method == "cdf53" else None

    def end_of(key, above=0):
        # Units of several levels lie in the payload of their tile; their own page tells so.
        keys = [key] if tiles is None else [key, tiles.key_of(key)]
        for one in keys:
            head = None if one.is_root_key else grid.segment_head(one)
            segment = container.segment(head)
            payload = segment.payload_range(segment.layout.key_rows[one])
            above = max(above, end_of_page(head), payload.end)
        return above

    def end_of_page(head):
        if head is None:
            return container.extents.top_start + container.extents.top_page_length
        parent = None if head.level == 0 else grid.segment_head(head.parent)
        return container.segment(parent).page_range(head).end

    ends = [{key: end_of(key) for key in grid.root_keys()}]
    for level in range(grid.k_max):
        ends.append(
            {block: end_of(block, ends[level][unit_key(block)]) for block in grid.blocks(level)}
        )
    return ends


def test_a_file_cut_within_its_header_is_one_line(whole):
    for place in (0, 3, 40, 130):
        with pytest.raises(TerrainwaveError):
            terrainwave.open(cut(whole, place), on_error="mask")


def damaged(path):
    """Return a file with a flipped byte in the payload of its last unit."""
    with Terrain(path) as terrain:
        place = max(end for ends in ends_of_units(terrain) for end in ends.values())
    data = bytearray(path.read_bytes())
    data[place - 3] ^= 255
    other = path.with_name("damaged.twz")
    other.write_bytes(data)
    return other


def test_reads_follow_how_the_file_was_opened(whole):
    path = damaged(whole)
    with terrainwave.open(path) as terrain:
        with pytest.raises(CorruptStreamError):
            terrain.read()
        assert terrain.lost == []
        terrain.read(on_error="mask")
        assert terrain.lost
    with terrainwave.open(path, on_error="mask") as terrain:
        again = pickle.loads(pickle.dumps(terrain))
        for one in (terrain, again):
            valid = one.read_with_mask()[1]
            for lost in one.lost:
                row, col, n_rows, n_cols = lost.window
                assert lost.level == one.n_levels - 1
                assert "checksum" in lost.problem
                assert not valid[row : row + n_rows, col : col + n_cols].all()
            assert valid.any() or one.header.method == "cdf53"  # whose tile is the whole level
            with pytest.raises(CorruptStreamError):
                one.read(on_error="raise")
        again.close()


def test_decompress_names_what_is_lost(whole, tmp_path):
    path = damaged(whole)
    run = CliRunner().invoke
    refused = run(main, ["decompress", str(path), str(tmp_path / "a.tif")])
    assert refused.exit_code == 1
    assert not (tmp_path / "a.tif").exists()
    done = run(main, ["decompress", str(path), str(tmp_path / "a.tif"), "--on-error", "mask"])
    assert done.exit_code == 0, done.stderr
    assert "lost: level" in done.stderr
    assert "% of the samples" in done.stderr
    with Terrain(path, on_error="mask") as terrain, rasterio.open(tmp_path / "a.tif") as raster:
        heights, valid = terrain.read_with_mask()
        assert np.array_equal(raster.read_masks(1) != 0, valid)
        assert np.array_equal(raster.read(1)[valid], heights[valid])


def test_verify_lists_what_is_damaged(whole):
    told = CliRunner().invoke(main, ["verify", str(damaged(whole))])
    assert told.exit_code == 1
    assert "checksum of the pa" in told.output
    assert "of the samples cannot be read" in told.output
    n_bytes = whole.stat().st_size
    told = CliRunner().invoke(main, ["verify", str(cut(whole, n_bytes // 2))])
    assert told.exit_code == 1
    assert f"the file has {n_bytes // 2:,} of its {n_bytes:,} bytes" in told.output
    assert told.output.rstrip().endswith("not ok")
