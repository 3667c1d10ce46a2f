"""Modes whose mesh is made anew each frame, without a GPU: what is drawn, what is read."""

from itertools import pairwise

import numpy as np
import pytest
from render.scenes import ListStore, hills, terrain_of
from tri.slow_dynamic import surfaces_at

from terrainwave.errors import InvalidArgumentError
from terrainwave.grid.quadtree import Region
from terrainwave.render.camera import Camera, Viewport, home, project
from terrainwave.render.modes import rqt
from terrainwave.render.scene import Scene

pytestmark = pytest.mark.large

VIEWPORT = Viewport(320, 240)


@pytest.fixture(scope="module")
def small():
    with terrain_of(np.round(hills(40, 50, 1)).astype(np.int16), max_error=0) as terrain:
        yield terrain


def cameras(frame, n, seed=1):
    rng = np.random.default_rng(seed)
    low, high = frame.box
    for _ in range(n):
        x, y = rng.uniform(low[:2], high[:2])
        z = high[2] + rng.uniform(30, 0.4 * (high - low).max())
        heading = np.degrees(np.arctan2(-x, -y)) + rng.uniform(-60, 60)
        yield Camera((x, y, z), heading % 360, rng.uniform(-80, -15), rng.uniform(30, 80))


def largest_error(scene, camera, every):
    """How far originals in view are on screen from the mesh drawn, pixels; NaN if none is."""
    heights = scene.terrain.read()
    rows, cols = np.divmod(np.arange(0, heights.size, every), heights.shape[1])
    xy = scene.frame.samples_to_local(rows, cols)
    points = np.column_stack([xy, heights[rows, cols] * scene.frame.exaggeration])
    seen = project(camera, VIEWPORT, points)
    found = [np.nan]
    for point, pixel in zip(points, seen, strict=True):
        if not (0 <= pixel[0] <= VIEWPORT.width and 0 <= pixel[1] <= VIEWPORT.height):
            continue
        over = surfaces_at(scene.mode.drawn, *point[:2])
        if len(over):
            above = np.column_stack([np.tile(point[:2], (len(over), 1)), over])
            apart = project(camera, VIEWPORT, above)[:, :2] - pixel[:2]
            found.append(float(np.linalg.norm(apart, axis=1).max()))
    return np.nanmax(found)


@pytest.mark.parametrize("mode", ["dynamic", "rqt"])
def test_originals_are_within_tau_of_what_is_drawn(small, mode):
    with Scene(small, ListStore(), mode=mode, exaggeration=1.5) as scene:
        found = []
        for tau in (1.5, 8.0):
            for camera in cameras(scene.frame, 2):
                frames = scene.settle(scene.view(camera, VIEWPORT, tau))
                assert frames.tau == tau
                assert frames.n_triangles == len(scene.mode.drawn.triangles)
                found.append(largest_error(scene, camera, 13) / tau)
        assert 0.05 < np.nanmax(found) <= 1


def test_rqt_splits_by_the_coefficients_of_the_file(monkeypatch):
    """Vertices of tiles and overview have at least the file's own coefficient as their error."""
    monkeypatch.setattr(rqt, "TILE", 16)
    heights = np.round(hills(60, 70, 3)).astype(np.int16)
    with (
        terrain_of(heights, max_error=0, method="cdf53") as terrain,
        Scene(terrain, ListStore(), mode="rqt", error="coefficient") as scene,
    ):
        camera, counts = home(scene.frame.box, VIEWPORT), []
        for tau in (2.0, 10.0, 60.0):
            counts.append(scene.settle(scene.view(camera, VIEWPORT, tau)).n_triangles)
        assert counts[0] > counts[1] > counts[2] > 0
        found = terrain.decoder.coefficients(terrain.n_levels - 1, Region(0, 0, *terrain.shape))
        mesh = scene.mode._mesh
        assert mesh.n_loaded > 1
        for row, col in np.argwhere(mesh._tiles._slot_of >= 0):
            own = found[16 * row : 16 * row + 17, 16 * col : 16 * col + 17]
            errors = np.abs(mesh._tiles._errors[mesh._tiles._slot_of[row, col]])
            inside = np.s_[: own.shape[0], : own.shape[1]]
            own[::16, ::16] = 0  # corners of tiles always are vertices
            assert (errors[inside] >= own).all()
            assert (errors[inside] == own).mean() > 0.2


def test_coefficients_are_refused_where_there_are_none(small):
    for mode, words in (("rqt", "method cdf53"), ("dynamic", "measured, paper")):
        with pytest.raises(InvalidArgumentError, match=words):
            Scene(small, ListStore(), mode=mode, error="coefficient")


@pytest.mark.parametrize("mode", ["dynamic", "rqt"])
def test_a_larger_tau_draws_fewer_triangles(small, mode):
    with Scene(small, ListStore(), mode=mode) as scene:
        camera = home(scene.frame.box, VIEWPORT)
        counts = [
            scene.settle(scene.view(camera, VIEWPORT, tau)).n_triangles for tau in (1.0, 8.0, 60.0)
        ]
        assert counts[0] > counts[1] > counts[2] > 0


@pytest.mark.parametrize("mode", ["dynamic", "rqt", "vertex-texture"])
def test_triangles_keep_to_their_limit_and_tau_says_so(small, mode):
    with Scene(small, ListStore(), mode=mode, max_triangles=300) as scene:
        camera = home(scene.frame.box, VIEWPORT)
        frames = scene.settle(scene.view(camera, VIEWPORT, 0.5))
        assert 30 < frames.n_triangles <= 300
        assert frames.tau > 0.5
        if mode != "vertex-texture":  # the GPU makes its mesh
            assert largest_error(scene, camera, 13) <= frames.tau
        for _ in range(400):
            frames = scene.update(scene.view(camera, VIEWPORT, 500.0))
        assert frames.tau == 500.0


def largest_jump(scene, n_steps):
    """The largest way on screen that what is drawn over a sample moves in one step of a flight."""
    rows, cols = (places.ravel() for places in np.mgrid[8:36:7, 8:46:6])
    xy = scene.frame.samples_to_local(rows, cols)
    top, jumps, before = float(scene.frame.box[1][2]), [], None
    for share in np.linspace(0, 1, n_steps):
        camera = Camera((100 * share, -1400 + 400 * share, top + 900), 0, -40, 70)
        scene.settle(scene.view(camera, VIEWPORT, 60.0))
        z = np.array([surfaces_at(scene.mode.drawn, *at)[0] for at in xy])
        if before is not None:
            a, b = (project(camera, VIEWPORT, np.column_stack([xy, at])) for at in (before, z))
            jumps.append(float(np.linalg.norm((a - b)[:, :2], axis=1).max()))
        before = z
    return max(jumps)


@pytest.mark.parametrize("mode", ["dynamic", "rqt"])
def test_nothing_pops(small, mode):
    """A tenth of a camera's step moves what is drawn a tenth as far."""
    with Scene(small, ListStore(), mode=mode) as scene:
        coarse, fine = (largest_jump(scene, n_steps) for n_steps in (9, 81))
        assert fine < 0.3 * coarse
        assert 0 < fine < 0.5  # without a morph: 4


@pytest.mark.parametrize("mode", ["dynamic", "vertex-texture"])
def test_steps_change_one_height_a_frame_and_what_they_keep_is_said(small, mode):
    with Scene(small, ListStore(), mode=mode, stepwise=True, exaggeration=1.5) as scene:
        low, high = scene.frame.box
        far = Camera((0.0, 0.0, float(high[2]) + 1e6), 0, -90, 40)
        near = Camera((0.0, float(low[1]), float(high[2]) + 500), 0, -50, 60)
        scene.settle(scene.view(far, VIEWPORT, 1.5))
        view, kept, counts = scene.view(near, VIEWPORT, 1.5), [], []
        while not kept or scene.mode.followed.n_changed:
            frames = scene.update(view)
            kept.append(frames.tau)
            counts.append(scene.mode.followed.n_vertices)
            if mode == "dynamic":
                assert largest_error(scene, near, 7) <= frames.tau
        # From patches' roots to samples, and a frame in which nothing changes.
        assert 5 < len(kept) <= 10
        assert kept[0] > 20 * kept[-1]
        assert kept[-1] == 1.5
        assert kept == sorted(kept, reverse=True)
        assert all(after <= 4 * before for before, after in pairwise(counts))


def test_from_high_up_the_overview_is_drawn_alone(monkeypatch):
    """Tiles come with the view, near ones first; what they replace stands in for them."""
    monkeypatch.setattr(rqt, "TILE", 16)
    heights = np.round(hills(60, 70, 3)).astype(np.int16)
    store = ListStore()
    with terrain_of(heights, max_error=0) as terrain, Scene(terrain, store, mode="rqt") as scene:
        stride = scene.mode._overview_stride
        assert stride > 1
        high = Camera((0.0, 0.0, 1e6), 0, -90, 50)
        scene.settle(scene.view(high, VIEWPORT, 1.0))
        assert len(store.patches) == 1
        assert (scene.mode.frame_mesh.places % stride == 0).all()
        low, top = scene.frame.box
        near = Camera((float(low[0]), 0.0, float(top[2]) + 50), 90, -35, 30)
        view = scene.view(near, VIEWPORT, 1.0)
        first = scene.update(view)
        assert first.n_missing > 0
        assert first.n_triangles > 0
        scene.settle(view)
        assert 1 < len(store.patches) < 1 + 4 * 5
        assert (scene.mode.frame_mesh.places % stride != 0).any()


@pytest.fixture
def tiled(monkeypatch):
    """A terrain of many tiles, small enough to look at each sample."""
    monkeypatch.setattr(rqt, "TILE", 16)
    monkeypatch.setattr(rqt, "_OVERVIEW_LEVELS", 2)
    with terrain_of(np.round(hills(120, 130, 3)).astype(np.int16), max_error=0) as terrain:
        yield terrain


def low_flight(scene, n_steps):
    """Across the terrain, near enough to see few tiles."""
    low, high = scene.frame.box
    for share in np.linspace(0.1, 0.9, n_steps):
        x, y = low[:2] + share * (high - low)[:2]
        yield Camera((float(x), float(y), float(high[2]) + 300), 60 + 90 * share, -50, 25)


def test_originals_are_within_tau_where_tiles_come_with_the_view(tiled):
    with Scene(tiled, ListStore(), mode="rqt") as scene:
        n_tiles = int(np.prod(scene.mode._n_tiles))
        for camera in low_flight(scene, 5):
            frames = scene.settle(scene.view(camera, VIEWPORT, 1.0))
            assert frames.tau == 1.0
            assert largest_error(scene, camera, 11) <= 1.0
        assert 4 < scene.mode._mesh.n_loaded < n_tiles


def test_memory_for_tiles_keeps_to_its_limit_on_a_flight(tiled):
    n_most = 12
    with Scene(tiled, ListStore(max_blocks=1 + n_most), mode="rqt") as scene:
        seen = set()
        for camera in low_flight(scene, 12):
            frames = scene.settle(scene.view(camera, VIEWPORT, 2.0))
            loaded = np.argwhere(scene.mode._mesh._tiles._slot_of >= 0).tolist()
            assert len(loaded) == len(scene.store.patches) - 1 <= n_most
            assert scene.mode._mesh._tiles._slot_of.max() < n_most  # slots are used again
            assert largest_error(scene, camera, 31) <= frames.tau
            seen |= {tuple(tile) for tile in loaded}
        assert len(seen) > 2 * n_most


def test_tiles_that_do_not_fit_raise_tau(tiled):
    with Scene(tiled, ListStore(max_blocks=4), mode="rqt") as scene:
        camera = home(scene.frame.box, VIEWPORT)
        frames = scene.settle(scene.view(camera, VIEWPORT, 0.2))
        assert scene.mode._mesh.n_loaded <= 3
        assert frames.tau > 0.2
        assert largest_error(scene, camera, 31) <= frames.tau


def test_slopes_of_the_overview_are_spread_linearly(monkeypatch):
    """A function that is linear between every fourth sample is kept; the last samples repeat."""
    monkeypatch.setattr(rqt, "TILE", 4)
    rows, cols = np.mgrid[0:10, 0:11]
    expected = np.stack([rows + 2.0 * cols, 8.0 - cols], axis=-1)
    found = rqt.spread_slopes(expected[::4, ::4].astype(np.float16), 4, (10, 11))
    np.testing.assert_array_equal(found[:9, :9], expected[:9, :9])
    np.testing.assert_array_equal(found[9], found[8])
    np.testing.assert_array_equal(found[:, 10], found[:, 8])


def test_a_raster_of_one_row_draws_nothing():
    heights = np.arange(9, dtype=np.int16)[None]
    with terrain_of(heights, max_error=0) as terrain:
        for mode in ("dynamic", "rqt", "vertex-texture"):
            with Scene(terrain, ListStore(), mode=mode) as scene:
                view = scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT)
                assert scene.settle(view).n_triangles == 0
