"""The block under the terrain: walls, floor, hatched voids, and the haze over it."""

import numpy as np
import pytest
from render.scenes import LOUD, eroded, hills, loud, terrain_of, terrain_with_hole

from terrainwave.read.resample import fill_voids
from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
from terrainwave.render.scene.camera import Camera, home, top_view
from terrainwave.render.scene.frame import Frame, frame_of
from terrainwave.render.scene.walls import (
    BASE,
    LID,
    TOP,
    build_solid,
    distance_to_walls,
    haze_of,
)

SIZE = (160, 120)
FLAT = Frame((0.0, 0.0), (1.0, 1.0, 1.0), (10.0, 0.0, -500.0, 0.0, -10.0, 400.0), (81, 101),
             (0.0, 60.0))  # fmt: skip


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


def test_walls_of_a_coarser_level_end_below_the_terrain_between_its_samples(
    with_voids, monkeypatch
):
    monkeypatch.setattr("terrainwave.render.scene.walls._WALL_SIDE", 60)
    heights = with_voids.read().astype(float)
    vertices, _ = solid_of(with_voids)
    tops = vertices[vertices["kind"] == TOP]
    north = tops[tops["normal"][:, 1] == 1]
    np.testing.assert_array_equal(north["col"], [*range(0, 109, 2), 109])
    line = np.append(heights[0, ::2], heights[0, 108])
    lowest = np.minimum(
        line, np.minimum(np.append(line[0], line[:-1]), np.append(line[1:], line[-1]))
    )
    np.testing.assert_array_equal(north["height"], lowest)


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


def test_a_triangle_of_three_valid_samples_stays_the_terrains():
    heights = np.array([[1, 2], [-9, 4]], dtype=np.int16)
    with terrain_of(heights, max_error=0, nodata=-9) as terrain:
        vertices, triangles = solid_of(terrain)
    found = vertices["height"][vertices["kind"] == LID]
    assert 1 <= found.min() <= found.max() <= 4
    lids = triangles[(vertices["kind"][triangles] == LID).all(axis=1)]
    assert [sorted(vertices[["row", "col"]][lid].tolist()) for lid in lids] == [
        [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)]
    ]


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


@pytest.mark.parametrize(
    ("eye", "distance"),
    [
        ((0.0, 0.0, 30.0), "floor"), ((480.0, 0.0, 50.0), 20.0), ((530.0, 0.0, 50.0), 30.0),
        ((530.0, 0.0, 100.0), 50.0), ((-500.0, 440.0, 10.0), "corner"),
    ],
)  # fmt: skip
def test_the_distance_to_walls_and_floor_is_that_of_the_nearest(eye, distance):
    expected = {"floor": 30.0 - FLAT.base, "corner": 40.0}.get(distance, distance)
    assert distance_to_walls(FLAT, np.array(eye)) == pytest.approx(expected)


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_haze_fits_the_extent(scale):
    """The same shares for a hill and a planet: 1 - exp(-(density · distance)²)."""
    a, _, c, _, e, f = FLAT.sample_matrix
    frame = Frame((0.0, 0.0), (1.0, 1.0, 1.0),
                  (a * scale, 0.0, c * scale, 0.0, e * scale, f * scale), FLAT.shape,
                  (0.0, 60.0 * scale))  # fmt: skip
    shares = []
    for x, z in ((0.0, 0.0), (0.0, 1000.0), (0.0, 5000.0)):
        eye = np.array([x, -700.0, z]) * scale
        start, density = haze_of(frame, eye, 0.25)
        low, high = frame.box
        beside = np.maximum(np.maximum(low - eye, eye - high), 0)
        assert start == pytest.approx(np.linalg.norm(beside))
        farthest = np.linalg.norm(np.maximum(abs(low - eye), abs(high - eye)))
        shares.append(1 - np.exp(-(((farthest - start) * density) ** 2)))
    assert shares == pytest.approx([0.49, 0.15, 0.01], abs=0.02)
    assert haze_of(frame, np.zeros(3), 0.0)[1] == 0


@pytest.mark.gl
@pytest.mark.large
@pytest.mark.parametrize(
    "mode", ["adaptive", "full", pytest.param("dynamic", marks=pytest.mark.full)]
)
def test_voids_are_hatched_where_the_sky_showed_and_no_terrain_is_hidden(context, with_voids, mode):
    plain = {"coloring": "plain", "shade": 0.0, "haze": 0.0}
    with Canvas(with_voids, SIZE, samples=0, context=context, mode=mode) as canvas:
        camera = top_view(canvas.scene.frame.box, canvas.viewport)
        # The finest blocks: a coarser surface may lie below the lids beside it, by up to τ.
        fine = {"max_pixel_error": 0.3}
        before, _ = canvas.picture(camera, Style(background=LOUD, solid=False, **plain), **fine)
        after, _ = canvas.picture(camera, Style(background=LOUD, **plain), **fine)
        holes = loud(before) & ~loud(after)
        assert holes.sum() > 800
        seen = eroded(~loud(before))
        np.testing.assert_array_equal(after[seen], before[seen])
        # Two greys and what lies between them.
        hatch = after[holes].astype(int)
        assert np.quantile(np.ptp(hatch, axis=1), 0.99) < 5  # a wall's edge may be among them
        assert np.quantile(hatch[:, 0], [0.1, 0.9]) == pytest.approx([153, 204], abs=8)
        row, col = (int(part) for part in np.argwhere(eroded(holes, 3))[0])
        assert canvas.pick(col + 0.5, row + 0.5) is None
        assert canvas.pick(SIZE[0] / 2, 20.5) is not None


@pytest.mark.gl
@pytest.mark.large
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


@pytest.mark.gl
@pytest.mark.large
def test_sky_is_above_the_terrain_and_ground_around_it(context, with_voids):
    with Canvas(with_voids, SIZE, context=context) as canvas:
        camera = home(canvas.scene.frame.solid_box, canvas.viewport)
        image = canvas.picture(camera, Style())[0].astype(int)
        sky, ground = image[0], image[-1]
        assert (sky[:, 2] - sky[:, 0] > 15).all()
        assert (np.ptp(ground, axis=1) < 12).all()
        # A colour of one's own takes the place of both.
        image, _ = canvas.picture(camera, Style(background=LOUD))
        assert loud(image)[0].all()
        assert loud(image)[-1].all()


@pytest.mark.gl
@pytest.mark.large
def test_a_picture_of_nothing_but_hatch_and_walls_shows_no_terrain(context, with_voids):
    with Canvas(with_voids, SIZE, context=context) as canvas:
        x, y = canvas.scene.frame.samples_to_local(np.array([35]), np.array([52]))[0]
        above = Camera((x, y, canvas.scene.frame.box[1][2] + 100.0), 0, -90, 20)
        image, _ = canvas.picture(above, Style())
        assert np.ptp(image.astype(int), axis=2).max() < 12
        assert canvas.is_blank()
        canvas.picture(home(canvas.scene.frame.box, canvas.viewport), Style())
        assert not canvas.is_blank()
