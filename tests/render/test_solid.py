"""The block under the terrain: walls, floor, hatched voids, and the haze over it."""

import numpy as np
import pytest
from render.scenes import LOUD, eroded, hills, loud, terrain_of, terrain_with_hole

from terrainwave.read.resample import fill_voids
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
from terrainwave.render.scene.camera import home
from terrainwave.render.scene.frame import frame_of
from terrainwave.render.scene.walls import (
    BASE,
    LID,
    TOP,
    build_solid,
)

SIZE = (160, 120)


@pytest.fixture(scope="module")
def with_voids():
    with terrain_with_hole((90, 110), np.s_[20:50, 30:75]) as terrain:
        yield terrain


def solid_of(terrain):
    vertices, triangles = build_solid(terrain, frame_of(terrain))
    return vertices, triangles.astype(int)


def test_walls_follow_the_border_and_stand_outside_of_it(with_voids):
    heights = with_voids.read()
    vertices, _ = solid_of(with_voids)
    tops, bases = (vertices[vertices["kind"] == kind] for kind in (TOP, BASE))
    assert len(tops) == len(bases) == 2 * (90 + 110)
    rows, cols = tops["row"].astype(int), tops["col"].astype(int)
    assert set(zip(rows, cols, strict=True)) == {
        (r, c) for r in range(90) for c in range(110) if r in (0, 89) or c in (0, 109)
    }
    np.testing.assert_array_equal(tops["height"], heights[rows, cols])
    # x is east, y north; the first row is the northern one.
    outwards = {(0.0, 1.0): rows == 0, (0.0, -1.0): rows == 89,
                (-1.0, 0.0): cols == 0, (1.0, 0.0): cols == 109}  # fmt: skip
    for normal, is_there in outwards.items():
        assert is_there[(tops["normal"] == normal).all(axis=1)].all()


@pytest.mark.parametrize("side", [641, 40])
def test_a_lid_covers_all_voids_and_no_valid_sample(with_voids, monkeypatch, side):
    monkeypatch.setattr("terrainwave.render.scene.walls._LID_SIDE", side)
    vertices, triangles = solid_of(with_voids)
    lids = triangles[(vertices["kind"][triangles] == LID).all(axis=1)]
    corners = np.stack([vertices["row"], vertices["col"]], axis=1)[lids].astype(int)
    is_void = with_voids.read() == -32768
    covered = np.zeros(is_void.shape, dtype=bool)
    for (row, col), (below, right) in zip(corners.min(axis=1), corners.max(axis=1), strict=True):
        assert is_void[row + 1 : below, col + 1 : right].all()
        covered[row : below + 1, col : right + 1] = True
    if side == 641:
        assert covered[is_void].all()
        assert covered.sum() < is_void.sum() + 4 * (30 + 45) + 8
    valid = with_voids.read()[~is_void]
    found = vertices["height"][vertices["kind"] == LID]
    assert valid.min() <= found.min() <= found.max() <= valid.max()


def test_voids_are_filled_between_the_heights_around_them():
    heights = np.tile(3.0 * np.arange(50), (40, 1))
    valid = np.ones(heights.shape, dtype=bool)
    valid[12:25, 15:33] = False
    filled = fill_voids(np.where(valid, heights, 1e9), valid, 6)
    np.testing.assert_array_equal(filled[valid], heights[valid])
    assert 3 * 14 <= filled[~valid].min() <= filled[~valid].max() <= 3 * 33
    assert filled[18, 31] - filled[18, 16] > 20  # it goes up with what is around
    nothing = np.zeros((3, 4), dtype=bool)
    np.testing.assert_array_equal(fill_voids(heights[:3, :4], nothing, 6), heights[:3, :4])


@pytest.mark.gl
@pytest.mark.parametrize("mode", ["adaptive", "full", pytest.param("rqt", marks=pytest.mark.full)])
def test_walls_close_the_block_and_hide_no_terrain(context, mode):
    heights = np.round(hills(90, 110, 1)).astype(np.int16)
    with (
        terrain_of(heights, max_error=0) as terrain,
        Canvas(terrain, SIZE, samples=0, context=context, mode=mode) as canvas,
    ):
        camera = home(canvas.scene.frame.solid_box, canvas.viewport)
        bare, _ = canvas.picture(camera, Style(background=LOUD, solid=False))
        block, _ = canvas.picture(camera, Style(background=LOUD))
        walls = loud(bare) & ~loud(block)
        assert walls.sum() > 400
        seen = eroded(~loud(bare), 1)  # outlines may move by τ
        np.testing.assert_array_equal(block[seen], bare[seen])
        # Below the terrain there is wall down to one edge: no gap in any column.
        for column in range(20, SIZE[0] - 20):
            solid = np.flatnonzero(~loud(block)[:, column])
            assert len(solid) == solid[-1] - solid[0] + 1
            assert walls[solid[-1] - 1 : solid[-1] + 1, column].all()
