"""Zhang et al. 2012: the pyramid, the criterion, skirts, morphs, loading, and τ on screen."""

import numpy as np
import pytest
from render.scenes import ListStore, hills, random_camera, terrain_of

from terrainwave.errors import InvalidArgumentError
from terrainwave.grid.quadtree import Region
from terrainwave.render.camera import Camera, Viewport, focal_length, home, project
from terrainwave.render.modes.block_surface import grid_mesh
from terrainwave.render.modes.neville import NevillePyramid
from terrainwave.render.modes.regular import fill_vertices, surface_height
from terrainwave.render.scene import Scene

VIEWPORT = Viewport(480, 320)


def rasters():
    with_voids = np.round(hills(71, 58, 2)).astype(np.int16)
    with_voids[20:30, 15:28] = -32768
    with_voids[np.random.default_rng(3).random(with_voids.shape) < 0.01] = -32768
    return {
        "rough": (np.round(hills(75, 105, 1)).astype(np.int16), {"max_error": 0}),
        "voids": (with_voids, {"max_error": 2, "nodata": -32768}),
        "floats": (hills(80, 60, 4).astype(np.float32), {"max_error": 0.5}),
    }


@pytest.fixture(params=list(rasters()))
def original_and_terrain(request):
    heights, options = rasters()[request.param]
    valid = heights != options.get("nodata", -99999)
    with terrain_of(heights, block=32, **options) as terrain:
        yield heights, valid, terrain


def pyramid_of(heights, n_levels, tmp_path, **options):
    def read(region):
        return heights[region.slices_in(Region(0, 0, *heights.shape))].astype(np.float32)

    return NevillePyramid(heights.shape, read, n_levels, tmp_path, **options)


# The pyramid


def test_the_filter_of_order_four_keeps_cubics(tmp_path):
    rows, cols = np.mgrid[0:40, 0:24] / 10

    def cubic(r, c):
        return 2 + r - 3 * c + r * c - r**2 + 0.5 * c**3 + 0.25 * r * c**2

    pyramid = pyramid_of(cubic(rows, cols), 2, tmp_path)
    found = pyramid.window(1, Region(1, 1, 18, 10), replicate=False)
    # Sample i of level l lies at (i + ½) · 2^l − ½.
    r, c = np.mgrid[1:19, 1:11] * 2 + 0.5
    np.testing.assert_allclose(found, cubic(r / 10, c / 10), atol=1e-5)


def test_the_filter_has_the_weights_of_the_paper(tmp_path):
    """Fig. 2b: inner four 10/32, the eight beside them -1/32, corners 0."""
    impulse = np.zeros((8, 8))
    impulse[3, 4] = 32
    found = pyramid_of(impulse, 2, tmp_path).window(1, Region(0, 0, 4, 4), replicate=False)
    expected = np.zeros((4, 4))
    expected[1, 2], expected[1, 1], expected[2, 2] = 10, -1, -1
    np.testing.assert_array_equal(found, expected)


def test_the_filter_of_order_two_takes_the_mean_of_the_four_samples_it_replaces(tmp_path):
    """Fig. 2a: four times 1/4; planes are kept."""
    heights = np.random.default_rng(8).random((12, 8))
    found = pyramid_of(heights, 2, tmp_path, order=2).window(1, Region(0, 0, 6, 4), replicate=False)
    expected = heights.reshape(6, 2, 4, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_border_is_repeated_and_voids_are_left_out(tmp_path):
    constant = np.full((13, 9), 7.0)
    constant[4:8, 2:6] = np.nan
    constant[5, 3] = 7.0
    pyramid = pyramid_of(constant, 4, tmp_path)
    assert pyramid.shapes == [(13, 9), (7, 5), (4, 3), (2, 2)]
    level = pyramid.window(1, Region(0, 0, 7, 5), replicate=False)
    expected = np.full((7, 5), 7.0)
    expected[2:4, 1:3] = np.nan
    expected[2, 1] = 7.0  # one of its inner four is valid
    np.testing.assert_array_equal(level, expected)
    beyond = pyramid.window(1, Region(-1, -1, 2, 2), replicate=False)
    assert np.isnan(beyond[0]).all()
    assert np.isnan(beyond[1, 0])
    assert beyond[1, 1] == 7.0


# The surface of a block


def test_blocks_of_one_level_meet_on_equal_vertices():
    rng = np.random.default_rng(1)
    samples = rng.random((10, 6)).astype(np.float32)
    upper, lower = np.empty((6, 6), np.float32), np.empty((6, 6), np.float32)
    fill_vertices(samples[:6], upper)
    fill_vertices(samples[4:], lower)
    np.testing.assert_array_equal(upper[-1], lower[0])
    np.testing.assert_allclose(upper[-1, 1:-1], (samples[4, 1:-1] + samples[5, 1:-1]) / 2)


def test_the_measured_surface_is_that_of_the_triangles_drawn():
    n = 6
    rng = np.random.default_rng(2)
    vertices = rng.random((n, n)).astype(np.float32)
    places, triangles = grid_mesh(n)
    at = np.clip(places[: n * n] - 0.5, 0, n - 2)  # cells: column, row
    n_cells = 2 * (n - 1) ** 2
    for triangle in triangles[:n_cells]:
        weights = rng.dirichlet([1, 1, 1])
        col, row = weights @ at[triangle]
        expected = weights @ vertices.ravel()[triangle].astype(float)
        assert surface_height(vertices, row, col) == pytest.approx(expected, abs=1e-6)
    assert (places[n * n :, 0] >= 1 << 15).all()
    assert len(triangles) - n_cells == 8 * (n - 1)
    assert triangles.max() == len(places) - 1


# What is drawn


def drawn_samples(scene, frames, heights):
    """Yield node, rows, cols and drawn metres of the samples under each block."""
    side, mode = scene.terrain.grid.block, scene.mode
    for node, morph in zip(frames.nodes.tolist(), frames.morphs.tolist(), strict=True):
        block = scene.store.patches[node]
        level, row, col, _ = scene.table.pieces[node]
        size = 1 << (mode.n_levels - 1 - level)
        z = block.heights.astype(float)
        z = z[..., 0] + morph * (z[..., 1] - z[..., 0])
        rows = np.arange(row * side * size, min((row + 1) * side * size, heights.shape[0]))
        cols = np.arange(col * side * size, min((col + 1) * side * size, heights.shape[1]))
        found = np.array(
            [
                [
                    surface_height(z, (r + 0.5) / size - row * side, (c + 0.5) / size - col * side)
                    for c in cols
                ]
                for r in rows
            ]
        )
        inside = np.argwhere(~np.isnan(found))
        yield node, rows[inside[:, 0]], cols[inside[:, 1]], found[tuple(inside.T)] + block.base


@pytest.mark.large
def test_no_original_in_view_is_further_than_tau_from_the_surface(original_and_terrain):
    heights, valid, terrain = original_and_terrain
    rng = np.random.default_rng(4)
    n_compared = n_coarse = n_morphed = 0
    with Scene(terrain, ListStore(), mode="batched") as scene:
        finest = scene.mode.n_levels - 1
        for _ in range(24):
            camera, tau = random_camera(rng, scene), rng.uniform(1, 25)
            view = scene.view(camera, VIEWPORT, tau)
            frames = scene.settle(view)
            distances = dict(zip(frames.nodes.tolist(), frames.distances, strict=True))
            n_morphed += (frames.morphs > 0).sum()
            for node, rows, cols, z in drawn_samples(scene, frames, heights):
                known = valid[rows, cols]
                rows, cols, z = rows[known], cols[known], z[known]
                xy = scene.frame.samples_to_local(rows, cols)
                drawn = project(camera, VIEWPORT, np.column_stack([xy, z]))
                true = project(camera, VIEWPORT, np.column_stack([xy, heights[rows, cols]]))
                with np.errstate(invalid="ignore"):
                    seen = ((true >= 0) & (true <= [480, 320, np.inf])).all(axis=1)
                    seen &= ((drawn >= 0) & (drawn <= [480, 320, np.inf])).all(axis=1)
                apart = np.hypot(*(drawn - true)[seen, :2].T)
                allowed = tau
                if scene.table.pieces[node].level == finest:  # the file's own error
                    own = view.gamma * scene.table.errors[node] / max(distances[node], 1e-9)
                    allowed = max(tau, own)
                else:
                    n_coarse += 1
                assert apart.max(initial=0) <= allowed + 1e-3
                n_compared += len(apart)
    assert n_compared > 5000
    assert n_coarse > 3
    assert n_morphed > 0


@pytest.mark.large
def test_every_valid_sample_lies_under_one_block(original_and_terrain):
    heights, valid, terrain = original_and_terrain
    with Scene(terrain, ListStore(), mode="batched") as scene:
        frames = scene.settle(scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, 0.3))
        count = np.zeros(heights.shape, dtype=int)
        for _, rows, cols, _ in drawn_samples(scene, frames, heights):
            count[rows, cols] += 1
        assert count.max() == 1
        if valid.all():
            assert count.min() == 1


@pytest.mark.large
def test_boxes_hold_the_originals_and_all_vertices(original_and_terrain):
    heights, valid, terrain = original_and_terrain
    side = terrain.grid.block
    with Scene(terrain, ListStore(), mode="batched") as scene:
        scene.settle(scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, 0.01))
        for node, block in scene.store.patches.items():
            level, row, col, _ = scene.table.pieces[node]
            size = side << (scene.mode.n_levels - 1 - level)
            at = np.s_[row * size : (row + 1) * size, col * size : (col + 1) * size]
            inside = heights[at][valid[at]].astype(float)
            low, high = scene.table.low[node, 2], scene.table.high[node, 2]
            z = block.heights[..., 0] + block.base
            assert low <= min(inside.min(initial=np.inf), np.nanmin(z)) + 1e-3
            assert high >= max(inside.max(initial=-np.inf), np.nanmax(z)) - 1e-3


# The paper's criterion


@pytest.fixture(params=[None, 1.25])
def paper_scene(request):
    with terrain_of(np.round(hills(150, 140, 5)).astype(np.int16), block=32) as terrain:
        options = {"mode": "batched", "error": "paper", "detail": request.param}
        with Scene(terrain, ListStore(), **options) as scene:
            yield scene


@pytest.fixture
def mu(request):
    """The constant of eq. 2 that `paper_scene` was asked for; without, the paper's first."""
    return request.node.callspec.params["paper_scene"] or 0.5


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"detail": 1.0}, "expected error 'paper'"),
        ({"detail": -1.0, "error": "paper"}, "expected a number > 0"),
        ({"order": 3}, "expected 2 or 4"),
        ({"order": 2, "mode": "adaptive"}, "expected mode batched"),
        ({"stepwise": True}, "expected mode dynamic or vertex-texture"),
    ],
)
def test_options_that_a_mode_does_not_have_are_refused(options, words):
    heights = np.zeros((40, 40), dtype=np.int16)
    with terrain_of(heights, block=32) as terrain, pytest.raises(InvalidArgumentError, match=words):
        Scene(terrain, ListStore(), **{"mode": "batched", **options})


def levels_of(scene, nodes):
    """Return the paper's levels, 0 the finest."""
    return scene.mode.n_levels - 1 - scene.table.keys[nodes, 0]


@pytest.mark.large
def test_levels_follow_from_distances_as_in_equation_6(paper_scene, mu):
    scene, seen = paper_scene, set()
    rng = np.random.default_rng(6)
    spacing = 30.0
    for _ in range(10):
        camera, tau = random_camera(rng, scene), rng.uniform(0.5, 30)
        frames = scene.settle(scene.view(camera, VIEWPORT, tau))
        alpha = 2 / VIEWPORT.height * np.tan(np.radians(camera.fov) / 2) * tau
        assert alpha == pytest.approx(tau / focal_length(camera, VIEWPORT))
        levels = levels_of(scene, frames.nodes)
        # ⌊log2(ε(P′) / ε_0)⌋ of the block is its level at least, of its parent less than that's.
        own = np.floor(np.log2(alpha * np.maximum(frames.distances, 1e-9) / (mu * spacing)))
        assert ((levels <= own) | (levels == 0)).all()
        parents = scene.table.parents[frames.nodes]
        selection = scene.table.select(scene.view(camera, VIEWPORT), tau)
        assert set(selection.nodes) == set(frames.nodes)
        low, high = scene.table.low[parents], scene.table.high[parents]
        apart = np.maximum(np.maximum(low - camera.eye, camera.eye - high), 0)
        away = np.linalg.norm(apart, axis=1)
        assert (alpha * away < mu * spacing * 2.0 ** (levels + 1) + 1e-6)[parents >= 0].all()
        seen |= set(levels.tolist())
    assert len(seen) > 2


@pytest.mark.large
def test_skirts_and_morphs_are_those_of_equations_10_and_12(paper_scene, mu):
    scene = paper_scene
    camera = Camera((0.0, -2500.0, scene.frame.box[1][2] + 300), 0, -25, 60)
    tau = 3 * mu
    frames = scene.settle(scene.view(camera, VIEWPORT, tau))
    alpha = tau / focal_length(camera, VIEWPORT)
    levels = levels_of(scene, frames.nodes)
    errors = mu * 30.0 * 2.0**levels
    largest_step = np.log2((32 - 1) * alpha / mu + 2)
    np.testing.assert_allclose(frames.skirts, (2**largest_step + 1) * errors)
    assert (frames.skirts >= 3 * errors).all()
    new, old = errors / alpha, 2 * errors / alpha
    share = 1 - (frames.distances - old) / (new - old)
    np.testing.assert_allclose(frames.morphs, np.clip(share, 0, 1), atol=1e-9)
    assert ((frames.morphs > 0) & (frames.morphs < 1)).any()


# Loading


@pytest.mark.large
def test_all_blocks_in_view_are_loaded_breadth_first_once_the_needed_are_here():
    heights = np.round(hills(200, 200, 7)).astype(np.int16)
    with terrain_of(heights, block=32) as terrain:
        with Scene(terrain, ListStore(max_blocks=20), mode="batched") as scene:
            view = scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, 20.0)
            needed = scene.settle(view)
            assert len(needed.nodes) < 20
            for _ in range(40):
                scene._pager.wait(5)
                scene.update(view)
            assert len(scene.store.patches) == 20
            levels = levels_of(scene, np.array(list(scene.store.patches)))
            counts = np.bincount(levels)
            # 2 x 2 roots, their children, and as many of the next as fit; of these none before.
            assert counts[-1] == 4
            assert counts[-2] == 16
            before = set(scene.store.patches)
            scene.update(view)
            assert not scene._requested
            assert set(scene.store.patches) == before
