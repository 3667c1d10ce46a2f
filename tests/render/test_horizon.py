"""Blocks behind nearer ground: what is left out is hidden, and what is left is the same picture."""

from dataclasses import replace

import numpy as np
import pytest
from render.scenes import ListStore, hills, terrain_of
from scipy import ndimage

from terrainwave.render.gpu.canvas import Canvas
from terrainwave.render.look.style import Style
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Camera, Viewport, project
from terrainwave.render.scene.horizon import OVERLAP, SIDE, floors_of

VIEWPORT = Viewport(640, 400)
HEIGHTS = np.round(hills(400, 500, 3, 2000.0)).astype(np.int16)
ABOVE = 60.0


@pytest.fixture(scope="module")
def mountains():
    with terrain_of(HEIGHTS, max_error=0, block=32) as terrain:
        yield terrain


def low_cameras(frame, n, seed=1):
    """Return cameras a little above the ground, looking about level."""
    rng = np.random.default_rng(seed)
    cameras = []
    for _ in range(n):
        row, col = rng.integers(40, 360), rng.integers(40, 460)
        x, y = frame.samples_to_local(np.array([row]), np.array([col]))[0]
        z = HEIGHTS[row - 2 : row + 3, col - 2 : col + 3].max() + ABOVE
        cameras.append(Camera((x, y, float(z)), rng.uniform(0, 360), rng.uniform(-15, 5), 50.0))
    return cameras


def are_hidden(frame, camera, points):
    """Say of points whether the ground, bilinear, is above the line of sight before them."""
    a, b, c, d, e, f = frame.sample_matrix
    inverse = np.linalg.inv(np.array([[a, b], [d, e]]))
    share = np.linspace(0.0, 1.0, 1200)[:-8, None, None]
    way = camera.eye + share * (points - camera.eye)
    cols, rows = np.moveaxis((way[..., :2] - (c, f)) @ inverse.T, -1, 0)
    ground = ndimage.map_coordinates(HEIGHTS.astype(float), [rows, cols], order=1)
    return (way[..., 2] < ground).any(axis=0)


@pytest.mark.full
@pytest.mark.parametrize("mode", ["adaptive", "batched", "loose"])
def test_what_is_left_out_lies_behind_the_ground(mountains, mode):
    rng = np.random.default_rng(2)
    n_drawn = n_all = n_wanted = n_wanted_all = 0
    with Scene(mountains, ListStore(), mode=mode) as scene:
        for camera in low_cameras(scene.frame, 9)[-4:]:
            view = scene.view(camera, VIEWPORT, 1.0)
            drawn = scene.settle(view).nodes
            n_drawn, n_wanted = n_drawn + len(drawn), n_wanted + len(scene.wanted)
            scene.has_horizon = False
            everything = scene.settle(view).nodes
            n_all, n_wanted_all = n_all + len(everything), n_wanted_all + len(scene.wanted)
            scene.has_horizon = True
            assert set(drawn) <= set(everything)
            for node in np.setdiff1d(everything, drawn).tolist():
                region = mountains.grid.full_region(scene.table.pieces[node].block)
                rows = rng.integers(region.row, region.row + region.n_rows, 80)
                cols = rng.integers(region.col, region.col + region.n_cols, 80)
                xy = scene.frame.samples_to_local(rows, cols)
                points = np.column_stack([xy, HEIGHTS[rows, cols]])
                pixels = project(camera, VIEWPORT, points)
                with np.errstate(invalid="ignore"):
                    seen = ((pixels >= 0) & (pixels <= [640, 400, np.inf])).all(axis=1)
                assert are_hidden(scene.frame, camera, points[seen]).all()
    assert n_drawn < 0.85 * n_all
    assert n_wanted < 0.9 * n_wanted_all


@pytest.mark.full
@pytest.mark.gl
@pytest.mark.usefixtures("no_gl_errors")
@pytest.mark.parametrize("mode", ["adaptive", "batched"])
def test_no_pixel_changes_beyond_tau(context, mountains, mode):
    pictures = []
    with Scene(mountains, ListStore()) as scene:
        cameras = low_cameras(scene.frame, 10, seed=5)[::3] + low_cameras(scene.frame, 9)[-3:]
    for horizon in (False, True):
        with Canvas(
            mountains, (320, 200), mode=mode, samples=0, context=context, horizon=horizon
        ) as canvas:
            pictures.append([canvas.picture(camera, Style())[0].astype(int) for camera in cameras])
    for free, found in zip(*pictures, strict=True):
        # Skirts, which follow the largest error drawn, may be shorter: by less than τ, a pixel.
        size, few = (3, 3, 1), 16
        assert (found >= ndimage.minimum_filter(free, size) - few).all()
        assert (found <= ndimage.maximum_filter(free, size) + few).all()
        assert (found != free).any(axis=2).mean() < 1e-3


def settled(mountains, **options):
    scene = Scene(mountains, ListStore(), **options)
    return scene, scene.view(low_cameras(scene.frame, 9)[8], VIEWPORT, 1.0)


@pytest.mark.full
def test_where_a_parent_stands_in_for_what_hides_nothing_is_left_out(mountains):
    scene, view = settled(mountains)
    with scene:
        scene.settle(view)
        frames = scene.update(view)
        scene.has_horizon = False
        n_all = len(scene.settle(view).nodes)
        scene.has_horizon = True
        frames = scene.settle(view)
        assert len(frames.nodes) < n_all
        leaves = [n for n in frames.nodes.tolist() if scene.table.parents[n] >= 0]
        nearest = leaves[0]
        scene._drop(nearest)
        scene._pager.close()  # it does not come back
        again = scene.update(view)
        assert scene.table.parents[nearest] in again.nodes
        free = scene.table.select(view, scene._split_error(view))
        assert sorted(again.nodes) == sorted(free.nodes)


@pytest.mark.few(2)
@pytest.mark.large
@pytest.mark.parametrize(
    ("move", "options"),
    [((0, 0, -400), {}), ((0, 50_000, 0), {}), ((0, 0, 0), {"error": "paper"}),
     ((0, 0, 0), {"horizon": False}), ((0, 0, 0), {"mode": "rqt"})],
)  # fmt: skip
def test_from_below_from_beside_and_where_errors_do_not_hold_nothing_is_hidden(
    mountains, move, options
):
    scene, view = settled(mountains, **options)
    with scene:
        if options.get("mode") != "rqt":  # it is drawn into one surface
            scene.settle(view)
        camera = replace(view.camera, position=tuple(view.camera.eye + move))
        assert not scene._horizon(view, camera).slopes.size


def test_floors_are_the_least_heights_of_cells_and_what_is_around_them():
    heights = np.random.default_rng(3).uniform(0, 100, (70, 67))
    heights[33, 21] = -np.inf
    matrix = np.array([30.0, 0.0, 0.0, 0.0, -30.0, 0.0])
    floors = floors_of(heights, matrix, (64, 62), (OVERLAP, 0))
    for i in range(SIDE):
        for j in range(SIDE):
            rows, cols = (slice(*(floors[of][k] + (0, 1)).astype(int))
                          for of, k in (("rows", i), ("cols", j)))  # fmt: skip
            assert floors["heights"][i, j] == heights[rows, cols].min()
    assert floors["rows"][0, 0] == 0
    assert floors["rows"][-1, 1] == 64 + 2 * OVERLAP
    assert floors["cols"][0, 0] == 0
    assert floors["cols"][-1, 1] == 62 + OVERLAP
    assert 1 <= np.isinf(floors["heights"]).sum() <= 9
