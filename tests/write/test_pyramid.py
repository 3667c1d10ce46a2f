"""Target heights, masks and fills of the levels, against `reference.py`."""

import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from strategies import terrain_like, valid_masks

from terrainwave.container.targets.kept import Kept
from terrainwave.grid.quadtree import Grid, Region
from terrainwave.grid.quantum import HeightScan
from terrainwave.raster_io import temporary
from terrainwave.raster_io.temporary import Spool
from terrainwave.write.pyramid import DTYPES, Base, Pyramid, SubtreeRegion


class ArraySource:
    """Windows of an array, as the pyramid asks for them."""

    def __init__(self, heights, valid):
        self.heights, self.valid = heights, valid

    def read(self, row, col, n_rows, n_cols):
        at = np.s_[row : row + n_rows, col : col + n_cols]
        return self.heights[at].copy(), self.valid[at].copy()


class Levels:
    """The whole levels of a small raster, the finest first."""

    def __init__(self, heights, valid=None, kind="lowpass", block=32, threads=1):
        valid = np.ones(heights.shape, dtype=bool) if valid is None else valid
        scan = HeightScan(heights.dtype.name)
        scan.update(heights, valid)
        quantizer = scan.quantizer(Fraction(0))
        grid = Grid(*heights.shape, block)
        self.quanta = quantizer.quantize(heights, valid)
        self.z_min, self.z_max = quantizer.z_min, quantizer.z_max
        with tempfile.TemporaryDirectory() as directory, ThreadPoolExecutor(threads) as executor:
            pyramid = Pyramid(
                ArraySource(heights, valid),
                quantizer,
                grid,
                kind=kind,
                has_voids=scan.has_voids,
                directory=Path(directory),
                executor=executor,
            )
            pyramid.build(lambda done, total: None)
            regions = [
                (level, Region(0, 0, *grid.level_shape(level)))
                for level in range(grid.k_max, -1, -1)
            ]
            self.heights = [pyramid.heights(*at) for at in regions]
            self.masks = [pyramid.mask(*at) for at in regions]
            self.own = [pyramid.own(*at) for at in regions]
            pyramid.close()


def whole_heights(shape, seed=0):
    return terrain_like(*shape, dtype="int32", seed=seed)


def assert_levels_equal(found, expected):
    assert len(found) == len(expected)
    for one, other in zip(found, expected):
        np.testing.assert_array_equal(one, other)


SHAPES = [(140, 3), (1, 131), (2, 258), (137, 66)]
shapes = pytest.mark.parametrize("shape", SHAPES)


@shapes
def test_coarse_levels_are_convolutions_with_mirrored_edges(shape):
    levels = Levels(whole_heights(shape))
    assert len(levels.heights) >= 2
    for fine, coarse in zip(levels.heights, levels.heights[1:]):
        expected = np.clip(reference.lowpass(fine), levels.z_min, levels.z_max)
        np.testing.assert_array_equal(coarse, expected)


@shapes
def test_coarse_levels_are_those_of_the_printed_filter_but_for_rounding(shape):
    levels = Levels(whole_heights(shape))
    # Rounding, and taps rounded to 2^-15 each: eight of them and the centre, in two directions.
    allowed = 0.5 + 2 * 16 * 2.0**-15 * np.abs(levels.heights[0]).max() * 1.6
    expected = reference.lowpass_unrounded(levels.heights[0])
    expected = np.clip(expected, levels.z_min, levels.z_max)
    assert np.abs(levels.heights[1] - expected).max() <= allowed


@pytest.mark.parametrize("sign", [1, -1])
def test_targets_stay_within_the_range_of_the_raster(sign):
    heights = np.zeros((140, 5), dtype="int32")
    heights[71:] = 1000 * sign
    heights[20, 2] = sign  # so that the quantum is 1
    levels = Levels(heights)
    overshoot = sign * reference.lowpass(levels.heights[0])
    # Beyond the step the taps at -1 … 4 make 1.068 of it.
    assert overshoot.max() - overshoot.min() == pytest.approx(1068, abs=2)
    assert np.ptp(levels.heights[1]) == 1000


@given(st.data(), st.sampled_from([(140, 2), (2, 261), (131, 4), (1, 300)]))
def test_masks_are_as_the_definition_says(data, shape):
    valid = data.draw(valid_masks(shape) | st.just(np.indices(shape).sum(0) % 37 == 5))
    levels = Levels(np.zeros(shape, dtype="int16"), valid)
    expected = [reference.level_mask(valid, shift) for shift in range(len(levels.masks))]
    assert_levels_equal(levels.masks, expected)
    own = [valid[:: 1 << shift, :: 1 << shift] for shift in range(len(levels.own))]
    assert_levels_equal(levels.own, own)


@pytest.mark.parametrize("shape", [(140, 3), (1, 131), (35, 31)])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.97])
def test_voids_are_filled_by_push_and_pull(shape, share):
    valid = np.random.default_rng(1).random(shape) < share
    levels = Levels(whole_heights(shape), valid)
    expected = reference.push_pull(levels.quanta, valid)
    np.testing.assert_array_equal(levels.heights[0], expected.astype(np.int32))


def test_what_lies_in_voids_does_not_matter():
    shape = (137, 20)
    valid = np.random.default_rng(2).random(shape) < 0.6
    clean = np.where(valid, whole_heights(shape), -32768)
    dirty = np.where(valid, clean, np.random.default_rng(3).integers(-32768, 32767, shape))
    one, other = Levels(clean, valid), Levels(dirty, valid)
    assert_levels_equal(one.heights, other.heights)


def test_fills_lie_between_the_valid_heights_around():
    heights = whole_heights((140, 30))
    valid = np.ones(heights.shape, dtype=bool)
    valid[40:70, 5:20] = False
    levels = Levels(heights, valid)
    fill = levels.heights[0][~valid]
    assert levels.quanta[valid].min() <= fill.min()
    assert fill.max() <= levels.quanta[valid].max()


def test_valid_heights_are_targets_as_they_are():
    shape = (137, 20)
    valid = np.random.default_rng(4).random(shape) < 0.5
    levels = Levels(whole_heights(shape), valid)
    np.testing.assert_array_equal(levels.heights[0][valid], levels.quanta[valid])


def test_one_valid_sample_fills_everything_with_its_height():
    heights = np.full((140, 9), -1, dtype="int32")
    heights[77, 3] = 500
    levels = Levels(heights, heights == 500)
    assert {int(h) for level in levels.heights for h in np.unique(level)} == {0}


@pytest.mark.parametrize("limit", [0, 10**9])
def test_spooling_to_disk_does_not_matter(monkeypatch, limit):
    shape = (137, 300)
    valid = np.random.default_rng(6).random(shape) < 0.7
    in_memory = Levels(whole_heights(shape), valid)
    monkeypatch.setattr("terrainwave.raster_io.temporary.MEMORY_LIMIT", limit)
    on_disk = Levels(whole_heights(shape), valid)
    assert_levels_equal(on_disk.heights, in_memory.heights)


@pytest.mark.parametrize("limit", [0, 10**9])
def test_a_part_of_a_level_is_that_part_of_the_whole(monkeypatch, limit):
    monkeypatch.setattr("terrainwave.raster_io.temporary.MEMORY_LIMIT", limit)
    with tempfile.TemporaryDirectory() as directory:
        spool = Spool((600, 300), np.int32, Path(directory))
        whole = np.arange(600 * 300, dtype=np.int32).reshape(600, 300)
        for row in range(0, 600, 170):  # not along the spool's tiles
            n_rows = min(170, 600 - row)
            spool.write(Region(row, 0, n_rows, 300), whole[row : row + n_rows])
        part = Region(250, 255, 12, 3)
        np.testing.assert_array_equal(spool.read(part), whole[250:262, 255:258])
        spool.close()


def test_what_nobody_reads_any_more_is_not_on_the_disk(monkeypatch, tmp_path):
    monkeypatch.setattr("terrainwave.raster_io.temporary.MEMORY_LIMIT", 2000)
    heights = whole_heights((301, 280))
    valid = np.random.default_rng(6).random(heights.shape) < 0.7
    scan = HeightScan("int32")
    scan.update(heights, valid)
    with ThreadPoolExecutor(1) as executor, Kept(tmp_path) as kept:
        pyramid = Pyramid(
            ArraySource(heights, valid),
            scan.quantizer(Fraction(0)),
            Grid(*heights.shape, 32),
            kind="nested",
            has_voids=True,
            directory=tmp_path,
            executor=executor,
        )
        pyramid.kept = kept
        pyramid.build(lambda done, total: None)
        pyramid.close()
    arrays = {path.name for path in tmp_path.glob("*-?.array")}
    # Masks of level 3, of 1330 bytes, are in memory: a run that goes on makes it of level 2.
    assert {name for name in arrays if name.startswith(("averages", "known"))} == {
        "averages-2.array",
        "averages-3.array",
        "known-2.array",
    }
    assert {name for name in arrays if name.startswith("fills")} == {"fills-nested-1.array"}
    assert {name for name in arrays if name.startswith("nested")} == {
        f"nested-{shift}.array" for shift in (1, 2, 3)
    }


@pytest.mark.parametrize(("distance", "n_bytes"), [(255, 1), (256, 2), (65535, 2), (65536, 4)])
def test_tiles_take_as_many_bytes_as_their_range_needs(monkeypatch, tmp_path, distance, n_bytes):
    monkeypatch.setattr(temporary, "MEMORY_LIMIT", 0)
    side = temporary.TILE
    whole = np.full((side, side + 9), -(2**31), dtype=np.int32)
    whole[3, 5] += distance
    whole[:, side:] = 2**31 - 1  # a tile that the edge cuts
    whole[7, side] -= distance
    spool = Spool(whole.shape, np.int32, tmp_path)
    spool.write(spool.region, whole)
    assert os.fstat(spool._file.fileno()).st_size == 2 * n_bytes * side**2
    np.testing.assert_array_equal(spool.read(spool.region), whole)
    part = Region(1, side - 2, 9, 5)
    np.testing.assert_array_equal(spool.read(part), whole[1:10, side - 2 : side + 3])
    spool.close()


@pytest.mark.parametrize("dtype", ["int16", "int32", "uint16", "float32"])
def test_a_tile_that_is_written_again_holds_what_was_written_last(monkeypatch, tmp_path, dtype):
    monkeypatch.setattr(temporary, "MEMORY_LIMIT", 0)
    side = temporary.TILE
    whole = (np.arange(side * side) % 200).reshape(side, side).astype(dtype)
    spool = Spool(whole.shape, dtype, tmp_path)
    for place, value in [(Region(9, 9, 3, 4), 30_000), (spool.region, 5), (Region(0, 0, 9, 9), 7)]:
        spool.write(spool.region, whole)
        whole[place.slices_in(spool.region)] = value
        whole[0, 0] = 1
        spool.write(place, whole[place.slices_in(spool.region)])
        spool.write(Region(0, 0, 1, 1), whole[:1, :1])
        np.testing.assert_array_equal(spool.read(spool.region), whole)
    spool.close()


SPLIT = 2  # the shift at which parts end and the base begins


def is_void(row, col):
    """Return a few holes, larger than what a part sees of its surroundings."""
    return (row - 40) ** 2 + (col - 50) ** 2 < 30**2 or (row % 29 == 3 and col % 31 < 4)


VOIDS = np.array([[is_void(row, col) for col in range(150)] for row in range(131)])
PARTS = [
    Region(row, col, min(65, 131 - row), min(65, 150 - col))
    for row in (0, 64, 128)
    for col in (0, 64, 128)
]


class SplitPyramids:
    """The pyramid of a raster, whole, and in parts with a base above them."""

    def __init__(self, kind, voids, directory, executor):
        heights = whole_heights(voids.shape, seed=4)
        scan = HeightScan("int32")
        scan.update(heights, ~voids)
        self.grid = Grid(*voids.shape, 32)
        self._source = ArraySource(heights, ~voids), scan.quantizer(Fraction(0)), self.grid
        self._more = {
            "kind": kind,
            "has_voids": scan.has_voids,
            "directory": Path(directory),
            "executor": executor,
        }
        self.whole = self.pyramid()
        if scan.has_voids:
            self.whole.push()
            self.whole.pull()
            at = Region(0, 0, *self.grid.level_shape(self.grid.k_max - SPLIT))
            self.fills = self.spool(self.whole.fills(SPLIT, at))  # nobody asks for them later
        self.whole.make_heights(lambda done, total: None)
        self.level = self.grid.k_max - SPLIT
        self.shape = self.grid.level_shape(self.level)

    def pyramid(self, **more):
        return Pyramid(*self._source, **self._more, **more)

    def spool(self, values):
        spool = Spool(values.shape, values.dtype, self._more["directory"])
        spool.write(spool.region, values)
        return spool

    def coarse(self, region):
        """Return a part's core on the level of the base."""
        row, col = region.row >> SPLIT, region.col >> SPLIT
        n_rows = (region.row + region.n_rows - 1 >> SPLIT) - row + 1
        return Region(row, col, n_rows, (region.col + region.n_cols - 1 >> SPLIT) - col + 1)

    def base(self):
        """Return the base, its heights from the whole pyramid, the rest pushed part by part."""
        heights = self.spool(self.whole.heights(self.level, Region(0, 0, *self.shape)))
        if not self._more["has_voids"]:
            return Base(SPLIT, {"heights": heights})
        names = "mask", "averages", "known", "own"
        spools = [self.spool(np.zeros(self.shape, DTYPES[name])) for name in names]
        for region in PARTS:
            part = self.pyramid(part=SubtreeRegion(region, SPLIT))
            part.push()
            at = self.coarse(region)
            mask, own = part.mask(self.level, at), part.own(self.level, at)
            found = mask, *part.pushed(SPLIT, at), own
            for spool, values in zip(spools, found, strict=True):
                spool.write(at, values)
            part.close()
        return Base(SPLIT, {"heights": heights, **dict(zip(names, spools, strict=True))})


@pytest.fixture(params=["nested", "lowpass"])
def split(request, tmp_path):
    with ThreadPoolExecutor(1) as executor:
        yield lambda voids: SplitPyramids(request.param, voids, tmp_path, executor)


@pytest.mark.parametrize("voids", [VOIDS, np.zeros_like(VOIDS)], ids=["voids", "valid"])
def test_a_base_has_the_same_levels_above_it(split, voids):
    pyramids = split(voids)
    top = pyramids.pyramid(base=pyramids.base())
    top.build(lambda done, total: None)
    for level in range(pyramids.level + 1):
        region = Region(0, 0, *pyramids.grid.level_shape(level))
        np.testing.assert_array_equal(
            top.heights(level, region), pyramids.whole.heights(level, region)
        )
        np.testing.assert_array_equal(top.mask(level, region), pyramids.whole.mask(level, region))
        np.testing.assert_array_equal(top.own(level, region), pyramids.whole.own(level, region))
    if voids.any():
        base = Region(0, 0, *pyramids.shape)
        np.testing.assert_array_equal(top.fills(SPLIT, base), pyramids.fills.read(base))


@pytest.mark.parametrize("voids", [VOIDS, np.zeros_like(VOIDS)], ids=["voids", "valid"])
@pytest.mark.parametrize("region", [PARTS[0], PARTS[4], PARTS[8], Region(37, 61, 40, 33)])
def test_a_part_has_the_same_levels(split, voids, region):
    pyramids = split(voids)
    part = pyramids.pyramid(part=SubtreeRegion(region, SPLIT))
    if voids.any():
        part.push()
        part.pull(pyramids.spool(pyramids.fills.read(Region(0, 0, *pyramids.shape))))
    part.make_heights(lambda done, total: None)
    for shift in range(SPLIT + 1):
        level = pyramids.grid.k_max - shift
        first = -(-region.row >> shift), -(-region.col >> shift)
        last = region.row + region.n_rows - 1 >> shift, region.col + region.n_cols - 1 >> shift
        core = Region(*first, last[0] - first[0] + 1, last[1] - first[1] + 1)
        framed = Region(core.row - 1, core.col - 1, core.n_rows + 2, core.n_cols + 2)
        framed = framed.intersect(Region(0, 0, *pyramids.grid.level_shape(level)))
        np.testing.assert_array_equal(
            part.heights(level, framed), pyramids.whole.heights(level, framed)
        )
        np.testing.assert_array_equal(part.mask(level, framed), pyramids.whole.mask(level, framed))
        np.testing.assert_array_equal(part.own(level, framed), pyramids.whole.own(level, framed))
