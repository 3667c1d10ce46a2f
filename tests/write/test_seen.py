"""Tiles that a scan finds even cost as little as those that an index tells, at equal bytes."""

import itertools

import numpy as np
import pytest
import rasterio
from strategies import terrain_like

import terrainwave as tw
from terrainwave.grid.quadtree import Region
from terrainwave.raster_io.even import Even
from terrainwave.raster_io.source import RasterSource
from terrainwave.write import encoder
from terrainwave.write.passes import seen
from terrainwave.write.passes.seen import SeenTiles

VOID = -9999


@pytest.fixture(autouse=True)
def small_tiles(monkeypatch):
    monkeypatch.setattr(seen, "SIDE", 16)


def noted(heights, valid, cuts, path=None):
    """Return what is known when windows of a raster have been noted."""
    tiles = SeenTiles(heights.shape, heights.dtype, path)
    rows, cols = ([0, *cut, size] for cut, size in zip(cuts, heights.shape, strict=True))
    for row, next_row in itertools.pairwise(rows):
        for col, next_col in itertools.pairwise(cols):
            region = Region(row, col, next_row - row, next_col - col)
            there = np.s_[row:next_row, col:next_col]
            tiles.note(region, heights[there], valid[there])
    return tiles


def patchy(dtype, seed):
    """Return heights of rectangles of few values, some of one sample, and which are valid."""
    rng = np.random.default_rng(seed)
    heights = np.zeros((100, 150), dtype=dtype)
    valid = np.ones(heights.shape, dtype=bool)
    for _ in range(rng.integers(1, 9)):
        row, col = rng.integers(0, 90), rng.integers(0, 140)
        there = np.s_[row : row + rng.choice([1, 40]), col : col + rng.choice([1, 60])]
        if rng.random() < 0.4:
            valid[there] = False
        else:
            heights[there] = rng.choice([0, 1, 7])
    if heights.dtype.kind == "f":
        heights[20:60, 20:60] *= -1  # some of these are -0.0
    return heights, valid


@pytest.mark.few(8)
@pytest.mark.parametrize("dtype", ["int16", "uint8", "float32", "float64"])
@pytest.mark.parametrize("seed", range(8))
def test_what_is_said_of_a_region_is_what_all_its_samples_are(dtype, seed):
    heights, valid = patchy(dtype, seed)
    rng = np.random.default_rng(seed)
    cuts = [sorted(rng.choice(np.arange(1, size), 3, replace=False)) for size in heights.shape]
    tiles = noted(heights, valid, cuts)
    n_even = 0
    for _ in range(400):
        row, col = rng.integers(0, 100), rng.integers(0, 150)
        region = Region(
            row, col, min(rng.choice([1, 9, 30]), 100 - row), min(rng.choice([1, 9]), 150 - col)
        )
        even = tiles.even(region)
        if even is None:
            continue
        n_even += 1
        there = region.slices_in(Region(0, 0, 100, 150))
        assert (valid[there] == even.is_valid).all()
        if even.is_valid:
            bits = np.full(region.shape, even.value, dtype=dtype).tobytes()
            assert heights[there].tobytes() == bits
    whole = [
        (row, col)
        for row in range(0, 96, 16)
        for col in range(0, 144, 16)
        if len(np.unique(heights[row : row + 16, col : col + 16])) == 1
        and valid[row : row + 16, col : col + 16].all()
        and not np.signbit(heights[row : row + 16, col : col + 16].astype(float)).any()
    ]
    assert whole
    assert all(tiles.even(Region(row, col, 16, 16)) is not None for row, col in whole)
    assert n_even


def test_one_sample_that_differs_is_found_wherever_it_is():
    for row in range(16):
        for col in range(16):
            heights = np.full((16, 16), 5, dtype=np.int16)
            valid = np.ones((16, 16), dtype=bool)
            heights[row, col] = 6
            assert noted(heights, valid, ((), ())).even(Region(3, 3, 2, 2)) is None
            heights[row, col], valid[row, col] = 5, False
            assert noted(heights, valid, ((), ())).even(Region(3, 3, 2, 2)) is None


def test_windows_that_are_noted_again_change_nothing(tmp_path):
    heights, valid = patchy("int16", 3)
    path = tmp_path / "seen.array"
    first = noted(heights, valid, ((40,), (77,)), path)
    before = first._tiles.copy()
    first.close()
    again = noted(heights, valid, ((13, 50), ()), path)
    assert again.was_there
    np.testing.assert_array_equal(again._tiles, before)


def test_parts_that_an_index_tells_are_put_together_with_those_that_are_read():
    tiles = SeenTiles((64, 64), np.int16, None)
    tiles.note_even(Region(0, 0, 64, 40), Even(np.int16(7), True))
    heights = np.full((64, 24), 7, dtype=np.int16)
    tiles.note(Region(0, 40, 64, 24), heights, np.ones(heights.shape, dtype=bool))
    assert tiles.even(Region(0, 0, 64, 64)) == (7, True)
    tiles.note_even(Region(60, 60, 1, 1), Even(np.int16(8), True))
    assert tiles.even(Region(0, 0, 64, 64)) is None
    assert tiles.even(Region(0, 0, 64, 48)) == (7, True)


def sea_or_void(kind, tmp_path):
    """Write a raster that is mostly sea, or void, with bytes for each block; return its path."""
    is_float = kind.endswith("float")
    heights = np.zeros((600, 700), dtype=np.float32 if is_float else np.int16)
    ground = terrain_like(130, 150, dtype="int16", seed=4)
    heights[150:280, 50:200] = ground
    heights[500:530, 600:640] = ground[:30, :40] + 30
    nodata = None
    if kind.startswith("void"):
        nodata = np.nan if is_float else VOID
        heights[heights == 0] = nodata
    elif is_float:
        heights[400:, :350] *= -1  # a sea of -0.0 beside one of 0.0
    path = tmp_path / f"{kind}.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=700, height=600, count=1, dtype=heights.dtype,
        nodata=nodata, tiled=True, blockxsize=64, blockysize=64, crs="EPSG:32633",
        transform=rasterio.Affine(30, 0, 5e5, 0, -30, 5e6),
    ) as dataset:  # fmt: skip
        dataset.write(heights, 1)
    with RasterSource(path, warn=False) as source:
        assert source.even(Region(0, 0, 20, 20)) is None
    return path


@pytest.mark.few(2)
@pytest.mark.parametrize("kind", ["sea", "void", "sea of float", "void of float"])
@pytest.mark.parametrize(
    ("method", "max_error", "mesh"),
    [("rapid", 1, "halves"), ("rapid", 0, "none"), ("predictive", 0.5, "none"),
     ("cdf53", 1, "none"), ("store", 1, "none")],
)  # fmt: skip
def test_files_are_the_same_and_units_of_seas_are_coded_once(
    kind, method, max_error, mesh, tmp_path, monkeypatch
):
    source = sea_or_void(kind, tmp_path)
    n_coded = 0
    code = encoder.TreeEncoder.code_unit

    def counted(*arguments):
        nonlocal n_coded
        n_coded += 1
        return code(*arguments)

    monkeypatch.setattr(encoder.TreeEncoder, "code_unit", counted)
    options = {"max_error": max_error, "method": method, "mesh": mesh, "block": 32}
    tw.compress(source, tmp_path / "seen.twz", **options)
    n_with, n_coded = n_coded, 0
    monkeypatch.setattr(SeenTiles, "even", lambda *_: None)
    tw.compress(source, tmp_path / "coded.twz", **options)
    assert (tmp_path / "seen.twz").read_bytes() == (tmp_path / "coded.twz").read_bytes()
    if method != "cdf53":
        assert n_with < 0.7 * n_coded
    assert tw.verify(tmp_path / "seen.twz", source).ok


@pytest.mark.parametrize("void", [False, True])
def test_heights_that_change_after_the_scan_are_found_by_the_proof(void, tmp_path):
    heights = np.zeros((900, 1000), dtype=np.int16)
    heights[:, 700:] = terrain_like(900, 300, dtype="int16", seed=4)
    nodata = 0 if void else None

    def change(progress):
        if progress.stage != "scanning":
            heights[300:303, 200:205] = 500

    with pytest.raises(tw.StorageError, match=r"changed in .* from row"):
        tw.compress(heights, tmp_path / "a.twz", block=32, nodata=nodata, progress=change)
    assert not (tmp_path / "a.twz").exists()
