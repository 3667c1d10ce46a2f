"""Method cdf53: lossless tiles, streams cut to a goal, reading in part."""

import numpy as np
import pytest
from strategies import terrain_like
from twz import twz_bytes

from terrainwave.codec.cdf53 import tile_layout
from terrainwave.codec.cdf53.refiner import PIECE, decode_tile, encode_tile, plane_cut, unpack_head
from terrainwave.codec.cdf53.tile_layout import TileLayout
from terrainwave.codec.refiner import ALL_VALID
from terrainwave.errors import CorruptStreamError, InvalidHeightsError, TruncatedStreamError
from terrainwave.grid.quadtree import Block, Grid
from terrainwave.terrain import Terrain

HEIGHTS = terrain_like(150, 140, seed=5)


@pytest.fixture
def small_tiles(monkeypatch):
    """Make tiles of two levels of 32 x 32 blocks: 129 x 129 samples."""
    monkeypatch.setattr(tile_layout, "_TILE_LOG2", 7)


def file_of(heights, **options):
    return twz_bytes(heights, method="cdf53", **options)


def read(data, **options):
    with Terrain(data, threads=1) as terrain:
        return terrain.read(**options)


def root_tile(heights):
    """Return spec, coded tile and validity of a raster that is one tile."""
    grid = Grid(*heights.shape, 32)
    spec = TileLayout(grid).spec(Block(-1, 0, 0))
    levels = [ALL_VALID] * len(spec.regions)
    return spec, encode_tile(spec, heights.astype(np.int32), levels, None)


def test_tiles_of_256_blocks_have_1025_samples_on_a_side():
    layout = TileLayout(Grid(4096, 4096, 256))
    finest = layout.spec(Block(2, 1, 1))
    assert finest.region.shape == (1025, 1025)
    assert (finest.first, finest.last, finest.n_below) == (3, 4, 0)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (2, 2), (5, 3), (33, 34), (66, 65)])
def test_whole_numbers_come_back_exactly(shape):
    heights = terrain_like(*shape, seed=1)
    np.testing.assert_array_equal(read(file_of(heights)), heights)


@pytest.mark.large
@pytest.mark.parametrize("shape", [(150, 140), (129, 258), (130, 385), (257, 40)])
def test_several_tiles_come_back_exactly(small_tiles, shape):
    heights = terrain_like(*shape, seed=2)
    np.testing.assert_array_equal(read(file_of(heights)), heights)


@pytest.mark.large
def test_voids_on_borders_of_tiles_come_back(small_tiles):
    heights = HEIGHTS.copy()
    heights[100:140, 110:] = -32768
    heights[128, ::3] = -32768
    np.testing.assert_array_equal(read(file_of(heights, nodata=-32768)), heights)


def test_coarse_levels_are_the_inverse_stopped_early():
    # By the definition of s and d on a row: s = x + ((d_left + d_right + 2) >> 2).
    row = np.array([[3, 9, 4, 1, 8, 2, 6, 5, 7] * 8], dtype="int16")[:, :65]
    x = row[0].astype(int)
    d = x[1::2] - (x[0:-2:2] + x[2::2] >> 1)
    left, right = np.r_[d[0], d], np.r_[d, d[-1]]
    expected = np.clip(x[::2] + (left + right + 2 >> 2), x.min(), x.max())
    np.testing.assert_array_equal(read(file_of(row), level=-2)[0], expected)


@pytest.mark.parametrize("max_error", [1, 4, 20])
def test_a_bound_above_zero_holds_and_saves_bytes(max_error):
    heights = HEIGHTS[:40, :40]
    data = file_of(heights, max_error=max_error)
    assert np.abs(read(data).astype(int) - heights).max() <= max_error
    assert len(data) < len(file_of(heights))


@pytest.mark.large
@pytest.mark.parametrize("rate", [1.5, 3])
def test_a_rate_is_kept_and_nearly_used(small_tiles, rate):
    data = file_of(HEIGHTS, rate=rate)
    bits = 8 * len(data) / HEIGHTS.size
    # What is left free for pages is some hundred bytes at most.
    assert rate - 0.4 < bits <= rate


@pytest.mark.large
@pytest.mark.parametrize("psnr", [30, 45])
def test_a_psnr_is_reached_and_hardly_more(psnr):
    decoded = read(file_of(HEIGHTS, psnr=psnr)).astype(float)
    error = np.sqrt(np.mean((decoded - HEIGHTS) ** 2))
    found = 20 * np.log10(np.ptp(HEIGHTS) / error)
    assert psnr <= found < psnr + 1


@pytest.mark.large
def test_the_bound_of_a_cut_file_is_the_measured_maximum(small_tiles):
    data = file_of(HEIGHTS, rate=2)
    with Terrain(data, threads=1) as terrain:
        measured = np.abs(terrain.read().astype(int) - HEIGHTS).max()
        assert terrain.effective_error == terrain.max_error == measured > 0
        assert list(terrain.check()) == []


@pytest.mark.large
def test_tiles_of_a_cut_file_agree_on_their_border(small_tiles):
    with Terrain(file_of(HEIGHTS, rate=1.5), threads=1) as terrain:
        grid, decoder = terrain.grid, terrain.decoder
        for level in range(grid.k_max + 1):
            for block in grid.blocks(level):
                right = Block(level, block.row, block.col + 1)
                if grid.contains(right):
                    here, there = decoder.block(block), decoder.block(right)
                    np.testing.assert_array_equal(here.heights[:, -1], there.heights[:, 0])


@pytest.mark.large
def test_floats_on_no_grid_can_be_cut():
    heights = terrain_like(70, 60, seed=3).astype("float32") * np.float32(np.pi)
    decoded = read(file_of(heights, psnr=40))
    error = np.sqrt(np.mean((decoded.astype(float) - heights) ** 2))
    assert 20 * np.log10(np.ptp(heights) / error) >= 40


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 1, "max_error": 1}, "max_error and rate, expected one of them"),
        ({"rate": 1, "psnr": 40}, "rate=1 and psnr=40, expected one of them"),
        ({"rate": 0}, "rate 0, expected a finite number > 0"),
        ({"psnr": float("nan")}, "psnr nan, expected a finite number"),
        ({"rate": 0.01}, "give a larger one"),
    ],
)
def test_goals_that_cannot_be_kept_are_refused(options, message):
    with pytest.raises(InvalidHeightsError, match=message):
        twz_bytes(HEIGHTS[:9, :9], **{"method": "cdf53", **options})


@pytest.mark.large
def test_more_bytes_give_a_better_surface_and_all_of_them_the_raster(small_tiles):
    heights = terrain_like(300, 280, seed=9) * 8
    with Terrain(file_of(heights), threads=1) as terrain:
        errors, sizes = [], []
        for quality in (0.5, 2, 4, 100):
            found = terrain.read_early(quality=quality)
            errors.append(np.square(found.heights.astype(float) - heights).mean())
            sizes.append(found.n_bytes)
            assert 8 * found.n_bytes <= quality * heights.size or quality == 0.5
    assert sizes == sorted(sizes)
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] == 0


def test_a_prefix_of_a_payload_decodes_to_its_whole_pieces():
    noise = np.random.default_rng(3).integers(-30000, 30000, (65, 65))
    spec, coded = root_tile(noise)
    payload = coded.payload()
    start = unpack_head(spec, payload)[1]
    one_piece = coded.payload(PIECE)
    expected = decode_tile(spec, None, one_piece)[-1].heights
    for n_bytes in (PIECE + 4, PIECE + 5, 2 * PIECE):
        found = decode_tile(spec, None, payload[: start + n_bytes], is_prefix=True)
        np.testing.assert_array_equal(found[-1].heights, expected)


def test_a_position_counts_planes_from_the_finest():
    ends = (10, 30, 70)
    assert [plane_cut(ends, 70, position) for position in (0, 1, 1.25, 2, 3, 9)] == [
        70, 30, 25, 10, 0, 0,
    ]  # fmt: skip


@pytest.mark.large
def test_every_prefix_of_a_payload_is_rejected():
    spec, coded = root_tile(HEIGHTS[:20, :20])
    payload = coded.payload()
    for n_bytes in range(1, len(payload)):
        with pytest.raises(CorruptStreamError):
            decode_tile(spec, None, payload[:n_bytes])


def test_a_changed_piece_is_noticed_when_read_in_part():
    spec, coded = root_tile(HEIGHTS[:20, :20])
    payload = bytearray(coded.payload())
    payload[-9] ^= 1
    with pytest.raises(CorruptStreamError, match="checksum of a piece"):
        decode_tile(spec, None, bytes(payload), is_prefix=True)


def test_a_head_cut_short_asks_for_more_bytes():
    spec, coded = root_tile(HEIGHTS[:20, :20])
    with pytest.raises(TruncatedStreamError):
        unpack_head(spec, coded.payload()[:6])


def test_other_methods_cannot_be_read_in_part():
    with Terrain(twz_bytes(HEIGHTS[:9, :9], max_error=0, method="store")) as terrain:
        with pytest.raises(InvalidHeightsError, match="expected one of method cdf53"):
            terrain.read_early(quality=1)
