"""Zhang et al. 2012: the filters, the criterion, skirts, morphs, loading, and τ on screen."""

from dataclasses import replace

import numpy as np
import pytest
from render.scenes import ListStore, apart_on_screen, hills, random_camera, terrain_of

from terrainwave.errors import InvalidArgumentError
from terrainwave.render.gpu.block_surface import grid_mesh
from terrainwave.render.modes.neville import fill_details, filtered
from terrainwave.render.modes.regular import half_place, largest_deviation
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Camera, Viewport, focal_length, home

VIEWPORT = Viewport(480, 320)


def rasters():
    with_voids = np.round(hills(71, 58, 2)).astype(np.int16)
    with_voids[20:30, 15:28] = -32768
    with_voids[np.random.default_rng(3).random(with_voids.shape) < 0.01] = -32768
    return {
        "rough": (np.round(hills(75, 105, 1)).astype(np.int16), {"max_error": 0}),
        "voids": (with_voids, {"max_error": 2, "nodata": -32768}),
        "wavelets": (hills(80, 60, 4).astype(np.float32), {"max_error": 0.5, "method": "cdf97"}),
    }


@pytest.fixture(params=list(rasters()))
def original_and_terrain(request):
    heights, options = rasters()[request.param]
    valid = heights != options.get("nodata", -99999)
    with terrain_of(heights, block=32, **options) as terrain:
        yield heights, valid, terrain


def coarser(fine, order, valid=None):
    """Return the level above `fine`, and NaN where its samples are void."""
    valid = np.ones(fine.shape, bool) if valid is None else valid
    return filtered(fine, valid, order, np.full((np.array(fine.shape) + 1) // 2, np.nan))


@pytest.mark.parametrize("order", [2, 4])
def test_filters_keep_the_polynomials_of_their_order(order):
    r, c = np.mgrid[0:17, 0:25] / 10
    heights = 2 + r - 3 * c + r * c
    if order == 4:
        heights += -(r**2) + 0.5 * c**3 + 0.25 * r**2 * c
    found = coarser(heights, order)
    inner = np.s_[3:-3, 3:-3] if order == 4 else np.s_[:]
    np.testing.assert_allclose(found[inner], heights[::2, ::2][inner], atol=1e-12)


@pytest.mark.parametrize(("order", "near", "far", "beside", "beyond"), [
    (4, 10 / 32, -1 / 32, 9 / 16, -1 / 16), (2, 1 / 4, 0, 1 / 2, 0)
])  # fmt: skip
def test_the_filters_have_the_weights_of_the_paper(order, near, far, beside, beyond):
    """Fig. 2: inner four 10/32, the eight beside them -1/32, corners 0; or four times 1/4."""
    impulse, details = np.full((23, 23), np.nan), np.empty((23, 23))
    impulse[3:-3, 3:-3] = 0
    impulse[11, 11] = 1
    fill_details(impulse, order, details)
    expected = np.zeros((17, 17))
    expected[7:10:2, 7:10:2] = -near
    expected[5:12:6, 7:10:2] = expected[7:10:2, 5:12:6] = -far
    expected[8, 7:10:2] = expected[7:10:2, 8] = -beside
    expected[8, 5:12:6] = expected[5:12:6, 8] = -beyond
    np.testing.assert_allclose(details[3:-3, 3:-3], expected, atol=1e-15)


def test_the_update_is_a_quarter_of_the_transposed_filter_and_leaves_no_range():
    impulse = np.zeros((17, 17))
    impulse[7, 9] = 1
    expected = np.zeros((9, 9))
    expected[3:5, 4:6] = 10 / 32 / 4  # the eight beside these would be below all around them
    np.testing.assert_allclose(coarser(impulse, 4), expected, atol=1e-15)


def test_the_border_follows_from_its_line_alone_and_voids_stay():
    rng = np.random.default_rng(1)
    one, two = rng.random((17, 17)), rng.random((17, 17))
    two[:, 0] = one[:, -1]
    for order in (2, 4):
        left, right = coarser(one, order), coarser(two, order)
        np.testing.assert_array_equal(left[:, -1], right[:, 0])
        assert left[0, 0] == one[0, 0]
        assert (left[1:-1, 1:-1] != one[2:-2:2, 2:-2:2]).any()
    valid = np.ones((17, 17), bool)
    valid[4:9, 4:9] = False
    found = coarser(one, 4, valid)
    assert np.isnan(found[2:5, 2:5]).all()
    assert np.isnan(found).sum() == 9


def height_at(vertices, row, col):
    """Return the height of a surface of cells cut from (0, 0) to (1, 1); NaN in voids."""
    r, c = min(int(row), vertices.shape[0] - 2), min(int(col), vertices.shape[1] - 2)
    t, s = row - r, col - c
    corner = (0, 1, s - t) if s >= t else (1, 0, t - s)
    corners = (0, 0, 1 - max(s, t)), corner, (1, 1, min(s, t))
    return sum(float(vertices[r + i, c + j]) * weight for i, j, weight in corners if weight > 0)


def test_the_measured_surface_is_that_of_the_triangles_drawn():
    n = 6
    rng = np.random.default_rng(2)
    vertices = rng.random((n, n)).astype(np.float32)
    places, triangles = grid_mesh(n)
    at = places[: n * n].astype(float)  # column, row
    n_cells = 2 * (n - 1) ** 2
    for triangle in triangles[:n_cells]:
        heights = vertices.ravel()[triangle].astype(float)
        for one, two in ((0, 1), (1, 2), (2, 0)):
            col, row = at[triangle[one]] + at[triangle[two]]
            found = half_place(vertices, int(row), int(col))
            assert found == pytest.approx((heights[one] + heights[two]) / 2, abs=1e-6)
        weights = rng.dirichlet([1, 1, 1])
        col, row = weights @ at[triangle]
        assert height_at(vertices, row, col) == pytest.approx(weights @ heights, abs=1e-6)
    assert (places[n * n :, 0] >= 1 << 15).all()
    assert len(triangles) - n_cells == 8 * (n - 1)
    assert triangles.max() == len(places) - 1


def test_the_deviation_is_the_largest_between_a_bilinear_surface_and_the_triangles():
    rng = np.random.default_rng(3)
    vertices = rng.random((3, 4)).astype(np.float32)
    fine = np.array([[half_place(vertices, r, c) for c in range(7)] for r in range(5)])
    fine += rng.random(fine.shape) / 10
    valid = np.ones(fine.shape, bool)
    n = 24  # places per cell of `fine`
    places = np.arange(4 * n + 1) / n, np.arange(6 * n + 1) / n
    apart = max(
        abs(bilinear(fine, row, col) - height_at(vertices, row / 2, col / 2))
        for row in places[0]
        for col in places[1]
    )
    found = largest_deviation(vertices, fine, valid, (0, 5), (0, 7), True)
    assert apart <= found <= apart * 1.01
    at_samples = max(
        abs(fine[row, col] - height_at(vertices, row / 2, col / 2)) for row, col in np.ndindex(5, 7)
    )
    assert largest_deviation(vertices, fine, valid, (0, 5), (0, 7), False) == pytest.approx(
        at_samples
    )
    assert at_samples < found


def bilinear(fine, row, col):
    r, c = min(int(row), fine.shape[0] - 2), min(int(col), fine.shape[1] - 2)
    t, s = row - r, col - c
    return np.array([1 - t, t]) @ fine[r : r + 2, c : c + 2] @ np.array([1 - s, s])


def drawn_samples(scene, frames, heights):
    """Yield node, rows, cols and drawn metres of the samples under each block."""
    side, grid = scene.terrain.grid.block, scene.terrain.grid
    for node, morph in zip(frames.nodes.tolist(), frames.morphs.tolist(), strict=True):
        block = scene.store.patches[node]
        region, size = (
            grid.full_region(scene.table.pieces[node].block),
            grid.stride(scene.table.pieces[node].level),
        )
        z = block.heights.astype(float)
        assert z.shape == (side + 1, side + 1, 2)
        z = z[..., 0] + morph * (z[..., 1] - z[..., 0])
        found = np.array(
            [
                [height_at(z, row / size, col / size) for col in range(region.n_cols)]
                for row in range(region.n_rows)
            ]
        )
        inside = np.argwhere(~np.isnan(found))
        yield (
            node, inside[:, 0] + region.row, inside[:, 1] + region.col,
            found[tuple(inside.T)] + block.base,
        )  # fmt: skip


@pytest.mark.few(1)
@pytest.mark.parametrize("orientation", [False, True])
def test_no_original_in_view_is_further_than_tau_from_the_surface(
    original_and_terrain, orientation
):
    heights, valid, terrain = original_and_terrain
    rng = np.random.default_rng(4)
    n_compared = n_coarse = n_morphed = 0
    with Scene(terrain, ListStore(), mode="batched", orientation=orientation) as scene:
        finest = scene.mode.n_levels - 1
        for number in range(24):
            camera, tau = random_camera(rng, scene), rng.uniform(1, 25)
            if orientation and number % 2:
                camera = replace(camera, pitch=-90.0 + number)
            view = scene.view(camera, VIEWPORT, tau)
            frames = scene.settle(view)
            distances = dict(zip(frames.nodes.tolist(), frames.distances, strict=True))
            n_morphed += (frames.morphs > 0).sum()
            for node, rows, cols, z in drawn_samples(scene, frames, heights):
                apart = apart_on_screen(view, scene, heights, valid, rows, cols, z)
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


def test_every_valid_sample_is_drawn_and_no_block_twice(original_and_terrain):
    heights, valid, terrain = original_and_terrain
    with Scene(terrain, ListStore(), mode="batched") as scene:
        for tau in (0.3, 30.0):
            frames = scene.settle(scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, tau))
            is_drawn = np.zeros(heights.shape, dtype=bool)
            for _, rows, cols, _ in drawn_samples(scene, frames, heights):
                is_drawn[rows, cols] = True
            assert is_drawn[valid].all()
            regions = [scene.terrain.grid.full_region(scene.table.pieces[node].block)
                       for node in frames.nodes.tolist()]  # fmt: skip
            n_cells = sum((region.n_rows - 1) * (region.n_cols - 1) for region in regions)
            assert n_cells == (heights.shape[0] - 1) * (heights.shape[1] - 1)


def test_boxes_hold_the_originals_and_all_vertices(original_and_terrain):
    heights, valid, terrain = original_and_terrain
    with Scene(terrain, ListStore(), mode="batched") as scene:
        scene.settle(scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, 0.01))
        for node, block in scene.store.patches.items():
            region = terrain.grid.full_region(scene.table.pieces[node].block)
            at = (slice(region.row, region.row + region.n_rows),
                  slice(region.col, region.col + region.n_cols))  # fmt: skip
            inside = heights[at][valid[at]].astype(float)
            low, high = scene.table.low[node, 2], scene.table.high[node, 2]
            z = block.heights[..., 0] + block.base
            assert low <= min(inside.min(initial=np.inf), np.nanmin(z)) + 1e-3
            assert high >= max(inside.max(initial=-np.inf), np.nanmax(z)) - 1e-3


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


def levels_of(scene, nodes):
    """Return the paper's levels, 0 the finest."""
    return scene.mode.n_levels - 1 - scene.table.keys[nodes, 0]


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


def test_skirts_and_morphs_are_those_of_equations_10_and_12(paper_scene, mu):
    scene = paper_scene
    camera = Camera((0.0, -2500.0, scene.frame.box[1][2] + 300), 0, -25, 60)
    tau = 3 * mu
    frames = scene.settle(scene.view(camera, VIEWPORT, tau))
    alpha = tau / focal_length(camera, VIEWPORT)
    levels = levels_of(scene, frames.nodes)
    errors = mu * 30.0 * 2.0**levels
    largest_step = np.log2(32 * alpha / mu + 2)
    np.testing.assert_allclose(frames.skirts, (2**largest_step + 1) * errors)
    assert (frames.skirts >= 3 * errors).all()
    new, old = errors / alpha, 2 * errors / alpha
    share = 1 - (frames.distances - old) / (new - old)
    np.testing.assert_allclose(frames.morphs, np.clip(share, 0, 1), atol=1e-9)
    assert ((frames.morphs > 0) & (frames.morphs < 1)).any()


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
            # The root, its children, and as many of the next as fit; of these none before.
            assert counts[-1] == 1
            assert counts[-2] == 4
            assert counts[-3] == 15
            before = set(scene.store.patches)
            scene.update(view)
            assert not scene._requested
            assert set(scene.store.patches) == before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"detail": 1.0}, "expected error 'paper'"),
        ({"detail": -1.0, "error": "paper"}, "expected a finite number > 0"),
        ({"order": 3}, "expected 2 or 4"),
        ({"order": 2, "mode": "adaptive"}, "expected mode batched"),
        ({"stepwise": True}, "expected mode dynamic or vertex-texture"),
        ({"tree": 32}, "expected mode dynamic or vertex-texture"),
        ({"tree": 24, "mode": "dynamic"}, "found tree 24, expected a power of two, 2 … 256"),
        ({"tree": 512, "mode": "vertex-texture"}, "found tree 512, expected a power of two"),
    ],
)
def test_options_that_a_mode_does_not_have_are_refused(options, words):
    heights = np.zeros((40, 40), dtype=np.int16)
    with terrain_of(heights, block=32) as terrain, pytest.raises(InvalidArgumentError, match=words):
        Scene(terrain, ListStore(), **{"mode": "batched", **options})
