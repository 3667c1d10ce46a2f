"""The promise on screen, borders, memory: a scene on a list as its store."""

from dataclasses import replace

import numpy as np
import pytest
from mesh_cases import terrain as mesh_terrain
from render.scenes import (
    ListStore,
    apart_on_screen,
    drawn_heights,
    hills,
    random_camera,
    terrain_of,
)

from terrainwave.errors import CorruptStreamError, LimitExceededError
from terrainwave.mesh.sections import mesher_of
from terrainwave.render.modes.bounded import MORPH_START
from terrainwave.render.paging.motion import AHEAD, Motion
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Camera, Viewport, fly, home, look, project
from terrainwave.render.scene.selection import Piece

pytestmark = pytest.mark.large

VIEWPORT = Viewport(480, 320)


def folds(shape, amplitude):
    """Ridges above which meshes of coarse levels rise (`mesh_cases.terrain`)."""
    return np.round(amplitude * mesh_terrain("ridges", shape, 0)).astype(np.int16)


def rasters():
    rough = np.round(hills(150, 210, 1)).astype(np.int16)
    with_voids = np.round(hills(133, 97, 2)).astype(np.int16)
    with_voids[40:60, 30:55] = -32768
    with_voids[np.random.default_rng(3).random(with_voids.shape) < 0.01] = -32768
    smooth = hills(180, 120, 4).astype(np.float32)
    return {
        "rough": (rough, {"max_error": 0}),
        "voids": (with_voids, {"max_error": 2, "nodata": -32768}),
        "floats": (smooth, {"max_error": 0.5}),
        "trees": (smooth, {"max_error": 0.5, "method": "cdf97", "mesh": "zerotree"}),
        "measured": (rough, {"max_error": 0, "measure_meshes": True}),
        "ridges": (folds((161, 129), 60), {"max_error": 1, "block": 32}),
        "no meshes": (rough[:100, :90], {"max_error": 1, "mesh": "none"}),
    }


@pytest.fixture(params=list(rasters()))
def original_and_terrain(request):
    heights, options = rasters()[request.param]
    valid = heights != options.get("nodata", -99999)
    with terrain_of(heights, **options) as terrain:
        yield heights, valid, terrain


@pytest.mark.few(3)
@pytest.mark.parametrize("options", [
    {}, {"error": "paper"}, {"mode": "loose"}, {"orientation": True, "exaggeration": 3.0},
])  # fmt: skip
def test_no_original_in_view_is_further_than_tau_from_the_surface(original_and_terrain, options):
    heights, valid, terrain = original_and_terrain
    rng = np.random.default_rng(4)
    n_compared = n_coarse = n_morphed = worst = 0
    with Scene(terrain, ListStore(), **options) as scene:
        for number in range(8):
            camera = random_camera(rng, scene)
            if "orientation" in options and number % 2:
                camera = replace(camera, pitch=-90.0 + 5 * (number // 2))
            tau = rng.uniform(1, 12)
            view = scene.view(camera, VIEWPORT, tau)
            frames = scene.settle(view)
            if options.get("mode") == "loose":  # says how far off its meshes are
                assert frames.tau >= tau * (1 - 1e-9)
                worst, tau = max(worst, frames.tau / tau), frames.tau
            assert frames.tau == pytest.approx(tau)
            finest = terrain.n_levels - 1
            n_coarse += sum(scene.table.pieces[n].level < finest for n in frames.nodes)
            n_morphed += (frames.morphs > 0).sum()
            for (rows, cols, z), distance, node in zip(
                drawn_heights(scene, frames, heights.shape), frames.distances, frames.nodes
            ):
                # Where even the finest mesh is coarser than τ, its own error is what holds.
                own = scene.table.errors[node] * view.exaggeration
                allowed = max(tau, view.gamma * own / max(distance, 1e-9))
                if scene.table.pieces[node][0] < finest or scene.table.pieces[node].variant:
                    allowed = tau
                apart = apart_on_screen(view, scene, heights, valid, rows, cols, z)
                assert apart.max(initial=0) <= allowed + 1e-3
                n_compared += len(apart)
    assert n_compared > 20_000
    assert n_coarse > 5
    assert n_morphed > 0
    assert (worst > 1.1) == (options.get("mode") == "loose")


def test_paper_errors_follow_equations_2_and_3():
    """Err = max Err of the children + Err_Int + δ, plus Err_Tri; checked sample by sample."""
    heights = np.round(hills(70, 90, 11)).astype(np.int16)
    with terrain_of(heights, max_error=2, measure_meshes=True) as terrain:
        builder = Scene(terrain, ListStore(), error="paper").mode.builder
        grid, delta = terrain.grid, terrain.effective_error

        def appr(block):
            if block.level == grid.k_max:
                return delta
            own, stride = grid.block_region(block), 2
            coarse = terrain.read(own, level=block.level).astype(float)
            fine = terrain.read(
                (own.row * 2, own.col * 2, own.n_rows * 2 - 1, own.n_cols * 2 - 1),
                level=block.level + 1,
            )
            apart = 0.0
            for r, c in np.ndindex(fine.shape):
                near = coarse[r // stride : -(-r // stride) + 1, c // stride : -(-c // stride) + 1]
                if near.shape == (1 + r % 2, 1 + c % 2):
                    apart = max(apart, abs(near.mean() - fine[r, c]))
            return max(appr(child) for child in grid.children(block)) + apart + delta

        for level in range(terrain.n_levels):
            for block in grid.blocks(level):
                tolerance = mesher_of(terrain).tolerance(block) / 16 * terrain.info().quantum
                error = builder.error(Piece(*block))
                assert error == pytest.approx(appr(block) + tolerance)
                # What is measured is less: an upper bound stays one.
                assert error >= terrain.mesh_error(block) - 1e-9


def test_a_block_whose_mesh_is_worse_than_was_thought_is_split():
    with terrain_of(folds((129, 129), 160), max_error=0, block=32) as terrain:
        with Scene(terrain, ListStore()) as scene:
            view = scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, 1000.0)
            (root,) = scene.table.roots.tolist()
            thought = scene.table.errors[root]
            frames = scene.settle(view)
            assert frames.nodes.tolist() == [root]
            derived = scene.table.errors[root]
            assert derived > 1.3 * thought > 0
            between = np.array([(thought + derived) / 2])
            tau = MORPH_START * scene.table.on_screen(view, frames.nodes, between)[0]
        with Scene(terrain, ListStore()) as scene:
            view = scene.view(view.camera, VIEWPORT, tau)
            assert scene.table.are_fine(view, scene.table.roots, tau / MORPH_START).all()
            frames = scene.settle(view)
            assert root not in frames.nodes.tolist()
            assert scene.drawn_error(view, frames) <= view.max_pixel_error * (1 + 1e-9)


def test_boxes_of_pieces_reach_as_far_as_their_errors_once_these_are_known():
    with (
        terrain_of(folds((129, 129), 160), max_error=0, block=32) as terrain,
        Scene(terrain, ListStore()) as scene,
    ):
        scene.settle(scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, 0.05))
        table = scene.table
        coarse = [n for n in scene.store.patches if table.pieces[n].level < terrain.n_levels - 1]
        assert len(coarse) == 5
        for node in coarse:
            low, high = terrain.block_box(table.pieces[node].block)
            assert table.low[node, 2] <= low - table.errors[node] + 1e-6
            assert table.high[node, 2] >= high + table.errors[node] - 1e-6


@pytest.mark.few(2)
def test_a_morph_never_takes_more_than_the_error_leaves(original_and_terrain):
    """error + share · distance to the parent's surface <= τ / pixels per metre, for each block."""
    _, _, terrain = original_and_terrain
    rng = np.random.default_rng(14)
    n_limited = 0
    with Scene(terrain, ListStore()) as scene:
        for _ in range(60):
            camera = random_camera(rng, scene)
            view = scene.view(camera, VIEWPORT, rng.uniform(0.3, 6))
            frames = scene.settle(view)
            patches = [scene.store.patches[node] for node in frames.nodes.tolist()]
            errors = np.array([patch.error for patch in patches])
            spread = np.array([patch.morph for patch in patches])
            allowed = frames.tau / scene.table.scales(view, frames.nodes)
            used = errors + frames.morphs * spread
            assert (used <= np.maximum(allowed, errors) * (1 + 1e-9)).all()
            n_limited += ((frames.morphs > 0) & (errors + spread > allowed)).sum()
    assert n_limited > 0


@pytest.mark.few(3)
def test_what_is_drawn_covers_every_valid_cell_in_view_once(original_and_terrain):
    heights, valid, terrain = original_and_terrain
    whole = valid[:-1, :-1] & valid[1:, :-1] & valid[:-1, 1:] & valid[1:, 1:]
    inner = np.zeros_like(valid)
    inner[1:-1, 1:-1] = whole[:-1, :-1] & whole[1:, :-1] & whole[:-1, 1:] & whole[1:, 1:]
    rng = np.random.default_rng(5)
    with Scene(terrain, ListStore()) as scene:
        for _ in range(4):
            camera = random_camera(rng, scene)
            frames = scene.settle(scene.view(camera, VIEWPORT, 0.3))
            count = np.zeros(heights.shape, dtype=int)
            for rows, cols, _ in drawn_heights(scene, frames, heights.shape):
                count[rows, cols] += 1
            rows, cols = np.nonzero(inner)
            xy = scene.frame.samples_to_local(rows, cols)
            pixels = project(camera, VIEWPORT, np.column_stack([xy, heights[rows, cols]]))
            with np.errstate(invalid="ignore"):
                seen = ((pixels >= 0) & (pixels <= [480, 320, np.inf])).all(axis=1)
            # Coarse levels lose samples beside voids; without voids nothing is missing.
            missing = (count[rows, cols] == 0) & seen
            assert missing.sum() <= (0 if valid.all() else 0.2 * seen.sum())


def test_slopes_are_those_of_a_plane():
    rows, cols = np.mgrid[0:70, 0:90]
    plane = (3.0 * cols - 6.0 * rows).astype(np.float32)  # 30 m pixels, rows to the south
    with terrain_of(plane, max_error=0.01) as terrain, Scene(terrain, ListStore()) as scene:
        for level in range(terrain.n_levels):
            for block in terrain.grid.blocks(level):
                slopes = scene.mode.builder.slopes(block).astype(float)
                np.testing.assert_allclose(slopes[..., 0], 0.1, atol=2e-3)
                np.testing.assert_allclose(slopes[..., 1], 0.2, atol=2e-3)


@pytest.mark.few(3)
def test_skirts_reach_the_neighbours_surface(original_and_terrain):
    """Where two drawn patches share samples, the upper one's skirt covers the step."""
    heights, _, terrain = original_and_terrain
    rng = np.random.default_rng(6)
    n_shared = 0
    with Scene(terrain, ListStore()) as scene:
        for _ in range(4):
            view = scene.view(random_camera(rng, scene), VIEWPORT, 1.5)
            frames = scene.settle(view)
            # What the shader leaves of the skirts of a block, at least.
            nearest = scene.table.distances(view, frames.nodes)
            reach = scene.skirt_reach(view, frames) * nearest
            top = np.full(heights.shape, -np.inf)
            low, skirt = np.full(heights.shape, np.inf), np.full(heights.shape, np.inf)
            drawn = drawn_heights(scene, frames, heights.shape)
            for (rows, cols, z), depth in zip(drawn, np.minimum(frames.skirts, reach), strict=True):
                top[rows, cols] = np.maximum(top[rows, cols], z)
                low[rows, cols] = np.minimum(low[rows, cols], z)
                skirt[rows, cols] = np.minimum(skirt[rows, cols], depth)
            shared = (top > low) & np.isfinite(low)
            n_shared += shared.sum()
            assert ((top - low)[shared] <= skirt[shared] + 1e-6).all()
    assert n_shared > 10


@pytest.mark.full
def test_memory_keeps_to_its_limit_on_a_flight_and_parents_stand_in():
    heights = np.round(hills(300, 300, 7)).astype(np.int16)
    store = ListStore(max_blocks=30)
    with terrain_of(heights, max_error=0) as terrain, Scene(terrain, store) as scene:
        camera = home(scene.frame.box, VIEWPORT)
        scene.settle(scene.view(camera, VIEWPORT, 2.0))
        n_dropped, seen = 0, set(store.patches)
        for step in range(150):
            camera = look(fly(camera, 0, 0, 60), 7 if step % 20 < 10 else -11, 0)
            scene._pager.wait(5)
            frames = scene.update(scene.view(camera, VIEWPORT, 1.0))
            assert len(store.patches) <= 30
            resident = scene.table.is_resident[: len(scene.table)]
            assert set(store.patches) == set(np.flatnonzero(resident))
            assert resident[frames.nodes].all()
            n_dropped += len(seen - set(store.patches))
            seen |= set(store.patches)
        assert n_dropped > 30
        frames = scene.settle(scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, 2.0))
        assert len(frames.nodes)


def test_a_store_that_holds_no_block_at_all_is_an_error_rather_than_a_wait_for_ever():
    store = ListStore()
    store.put = lambda node, patch: False
    with terrain_of(np.zeros((9, 9), np.int16), max_error=0) as terrain:
        with Scene(terrain, store) as scene:
            with pytest.raises(LimitExceededError, match="does not fit"):
                scene.settle(scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT))


def test_what_the_camera_flies_to_is_read_ahead():
    heights = np.round(hills(300, 300, 9)).astype(np.int16)
    with terrain_of(heights, max_error=0) as terrain, Scene(terrain, ListStore()) as scene:
        low, high = scene.frame.box
        x, z = float(low[0]), float(high[2]) + 500
        now = [0.0]
        scene._motion = Motion(lambda: now[0])

        def camera(seconds):
            return Camera((x + 800 * seconds, 0.0, z), 90, -60, 25)

        for now[0] in (0.0, 0.5, 1.0):
            scene.settle(scene.view(camera(now[0]), VIEWPORT, 1.0))
        view = scene.view(camera(1.0), VIEWPORT, 1.0)
        needed = set(scene._wanted(view, scene._split_error(view)).tolist())
        soon = scene.view(camera(1.0 + AHEAD[-1]), VIEWPORT, 1.0)
        later = set(scene.table.wanted(soon, 10_000, scene._split_error(soon)).tolist())
        assert later - needed
        for _ in range(60):  # a camera each, a level of the tree at a time
            scene.update(view)
            assert scene._pager.wait(30)
        assert scene.table.is_resident[list(later)].all()


def test_a_damaged_block_is_drawn_coarser_and_named():
    heights = np.round(hills(150, 210, 1)).astype(np.int16)
    with terrain_of(heights, max_error=0) as terrain, Scene(terrain, ListStore()) as scene:
        build = scene.mode.builder.build

        def damaged(piece, is_cancelled=lambda: False):
            if piece.level == terrain.n_levels - 1 and piece.row == 1:
                raise CorruptStreamError("the group is damaged")
            return build(piece, is_cancelled)

        scene._pager._build = damaged
        frames = scene.settle(scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, 0.2))
        assert len(frames.nodes)
        assert set(scene.problems.damaged.values()) == {"the group is damaged"}


def test_all_finest_blocks_in_view_come_in_parts_that_fit():
    heights = np.round(hills(150, 210, 1)).astype(np.int16)
    store = ListStore(max_blocks=5)
    with terrain_of(heights, max_error=0) as terrain, Scene(terrain, store, mode="full") as scene:
        view = scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT)
        count = np.zeros(heights.shape, dtype=int)
        for frames in scene.parts(view):
            assert len(store.patches) <= 5
            for rows, cols, z in drawn_heights(scene, frames, heights.shape):
                count[rows, cols] += 1
                assert np.abs(z - heights[rows, cols]).max() <= 1
        assert (count > 0).all()
        assert not store.patches


@pytest.mark.full
def test_a_long_flight_keeps_few_pieces_known_and_draws_the_same(monkeypatch):
    heights = np.round(hills(1200, 1600, 5)).astype(np.int16)
    viewport, n_known, n_drawn = Viewport(200, 140), [], 0
    with terrain_of(heights, max_error=0, block=32) as terrain:
        with Scene(terrain, ListStore(1000)) as patient:
            monkeypatch.setattr("terrainwave.render.paging.scene._MOST_KNOWN", 100)
            with Scene(terrain, ListStore(40)) as scene:
                low, high = scene.frame.box
                for across, along in np.ndindex(4, 15):
                    share = 0.05 + 0.06 * along, 0.15 + 0.25 * across
                    x, y = low[:2] + (high - low)[:2] * share
                    camera = Camera((float(x), float(y), float(high[2])), 90.0, -75.0)
                    drawn = []
                    for one in (patient, scene):
                        view = one.view(camera, viewport, 2.0)
                        one.settle(view)
                        frames = one.update(view)
                        drawn.append({one.table.pieces[node] for node in frames.nodes})
                    assert drawn[0] == drawn[1]
                    n_drawn += len(drawn[1])
                    n_known.append(scene.table.n_known)
                assert patient.table.n_known > 800
                assert max(n_known) < 450
                assert len(scene.table) < 450
    assert n_drawn > 100


def test_a_full_store_raises_tau_rather_than_wait_for_ever():
    heights = np.round(hills(200, 200, 8)).astype(np.int16)
    store = ListStore(max_blocks=12)
    store.put = lambda node, patch, put=store.put: len(store.patches) < 9 and put(node, patch)
    with terrain_of(heights, max_error=0) as terrain, Scene(terrain, store) as scene:
        view = scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT, 0.5)
        frames = scene.settle(view, timeout=60)
        assert frames.tau > 0.5
