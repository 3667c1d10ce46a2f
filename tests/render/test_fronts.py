"""Modes whose mesh is made anew each frame: what is drawn, what is read."""

from itertools import pairwise

import numpy as np
import pytest
from render.scenes import ListStore, hills, terrain_of
from tri.slow_dynamic import areas, surfaces_at

from terrainwave.errors import InvalidArgumentError
from terrainwave.read.tile_decoder import with_coefficients
from terrainwave.render.modes.dynamic import Dynamic
from terrainwave.render.modes.front import eye_of
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Camera, Viewport, home, project

# What these modes compile takes a minute.
pytestmark = [pytest.mark.full, pytest.mark.large]

VIEWPORT = Viewport(320, 240)
MODES = ["dynamic", "rqt", "vertex-texture"]


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


def without_skirts(drawn):
    return drawn._replace(triangles=drawn.triangles[np.abs(areas(drawn)) > 1e-9])


def largest_error(scene, camera, every):
    """How far originals in view are on screen from the mesh drawn, pixels; NaN if none is."""
    heights = scene.terrain.read()
    rows, cols = np.divmod(np.arange(0, heights.size, every), heights.shape[1])
    xy = scene.frame.samples_to_local(rows, cols)
    points = np.column_stack([xy, heights[rows, cols] * scene.frame.exaggeration])
    seen = project(camera, VIEWPORT, points)
    found, drawn = [np.nan], without_skirts(scene.mode.drawn)
    for point, pixel in zip(points, seen, strict=True):
        if not (0 <= pixel[0] <= VIEWPORT.width and 0 <= pixel[1] <= VIEWPORT.height):
            continue
        over = surfaces_at(drawn, *point[:2])
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


def test_rqt_splits_by_the_coefficients_of_the_file(small_patches):
    """Vertices have at least the file's own coefficient as their error."""
    heights = np.round(hills(60, 70, 3)).astype(np.int16)
    with (
        terrain_of(heights, max_error=0, method="cdf53") as terrain,
        Scene(terrain, ListStore(), mode="rqt", error="coefficient") as scene,
    ):
        camera, counts = home(scene.frame.box, VIEWPORT), []
        for tau in (2.0, 10.0, 60.0):
            counts.append(scene.settle(scene.view(camera, VIEWPORT, tau)).n_triangles)
        assert counts[0] > counts[1] > counts[2] > 0
        patches = list(scene.store.patches.values())
        assert len(patches) > 4
        tiles = with_coefficients(terrain.decoder)
        for patch in patches:
            own = tiles.coefficients(patch.piece.level, patch.region)
            errors = np.abs(patch.mesh._errors)[: own.shape[0], : own.shape[1]]
            own[::32, ::32] = 0  # corners of patches always are vertices
            assert (errors >= own).all()
            assert (errors == own).mean() > 0.2


def test_coefficients_are_refused_where_there_are_none(small):
    for mode, words in (("rqt", "method cdf53"), ("dynamic", "measured, paper")):
        with pytest.raises(InvalidArgumentError, match=words):
            Scene(small, ListStore(), mode=mode, error="coefficient")


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


def low_flight(scene, n_steps):
    """Across the terrain, its near parts much nearer than its far ones."""
    low, high = scene.frame.box
    for share in np.linspace(0.25, 0.75, n_steps):
        x, y = low[:2] + share * (high - low)[:2]
        yield Camera((float(x), float(y), float(high[2]) + 100), 720 * share % 360, -20, 40)


@pytest.mark.parametrize("mode", ["dynamic", "rqt"])
def test_originals_are_within_tau_where_patches_come_with_the_view(gentle, small_patches, mode):
    levels = set()
    with Scene(gentle, ListStore(), mode=mode, exaggeration=1.5) as scene:
        for tau, camera in zip((1.0, 2.0, 8.0), low_flight(scene, 3), strict=True):
            frames = scene.settle(scene.view(camera, VIEWPORT, tau))
            assert frames.tau == tau
            assert 0.1 * tau < largest_error(scene, camera, 37) <= tau
            levels |= {patch.piece.level for patch in scene.mode.shown}
    assert len(levels) > 2


@pytest.mark.parametrize("tree", [2, 32])
def test_originals_are_within_tau_with_trees_of_any_size(gentle, monkeypatch, tree):
    """As large as a patch, too, which then begins where its neighbour's samples do."""
    monkeypatch.setattr(Dynamic, "samples", 32)
    n_triangles, largest = 0, 0.0
    with Scene(gentle, ListStore(), mode="dynamic", tree=tree, exaggeration=1.5) as scene:
        for tau, camera in zip((1.0, 8.0), low_flight(scene, 2), strict=True):
            frames = scene.settle(scene.view(camera, VIEWPORT, tau))
            assert frames.tau == tau
            largest = max(largest, largest_error(scene, camera, 37) / tau)
            n_triangles += frames.n_triangles
            assert {patch.mesh.tree.top for patch in scene.mode.shown} == {tree.bit_length() - 1}
    assert 0.1 < largest <= 1
    assert n_triangles > 1000


@pytest.mark.parametrize("mode", ["dynamic", "rqt"])
def test_skirts_reach_what_neighbours_draw(gentle, small_patches, mode):
    """At every vertex on its border a patch is no higher over a neighbour than its skirt is deep.

    The neighbour is looked at a hair's breadth inside, as borders may be the same.
    """
    n_checked = 0
    with Scene(gentle, ListStore(), mode=mode) as scene:
        for camera in low_flight(scene, 2):
            view = scene.view(camera, VIEWPORT, 3.0)
            frames = scene.settle(view)
            parts = list(parts_of(scene.mode))
            for k, part in enumerate(parts):
                for x, y, z, depth in skirts_of(part):
                    seen = project(camera, VIEWPORT, np.array([[x, y, z]]))[0]
                    if not (0 <= seen[0] <= VIEWPORT.width and 0 <= seen[1] <= VIEWPORT.height):
                        continue
                    # No deeper than the shader lets it be, either.
                    away = np.array([x, y, z]) - camera.eye
                    reach = scene.skirt_reach(view, frames) * (away @ away) / np.hypot(*away[:2])
                    bottom = z - min(depth, reach)
                    assert depth == pytest.approx(frames.skirts[k])
                    for other in parts[:k] + parts[k + 1 :]:
                        beside = surfaces_at(without_skirts(other), x, y)
                        n_checked += len(beside)
                        assert (beside >= bottom - 1e-6).all()
    assert n_checked > (100 if mode == "rqt" else 50)  # fewer end anywhere


def open_edges(scene):
    """The edges that only one triangle has, skirts left out: places of both ends, metres."""
    drawn = without_skirts(scene.mode.drawn)
    places, at = np.unique(drawn.vertices, axis=0, return_inverse=True)
    edges = np.sort(at[drawn.triangles][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, counts = np.unique(edges, axis=0, return_counts=True)
    assert counts.max() == 2
    return places[edges[counts == 1]]


def are_inside_and_in_view(scene, camera, edges, margin=0.0):
    """Which edges have an end in view over the raster, whose outline cuts the mesh off."""
    last = np.array(scene.terrain.shape[::-1]) - 1
    a, b, c, d, e, f = scene.frame.sample_matrix
    ends = edges.reshape(-1, 3)
    samples = (ends[:, :2] - (c, f)) @ np.linalg.inv([[a, b], [d, e]]).T
    inside = ((samples > margin) & (samples < last - margin)).all(axis=1)
    seen = project(camera, VIEWPORT, ends)[:, :2]
    inside &= ((seen > 0) & (seen < [VIEWPORT.width, VIEWPORT.height])).all(axis=1)
    return inside.reshape(-1, 2).any(axis=1)


def single_level_views(scene):
    """Cameras near the ground all around, that see patches of the full grid alone."""
    low, high = scene.frame.box
    for heading in (20, 110, 200, 290):
        middle = (low + high) / 2
        camera = Camera(
            (float(middle[0]), float(middle[1]), float(high[2]) + 150), heading, -30, 60
        )
        yield camera, scene.settle(scene.view(camera, VIEWPORT, 0.4))
        assert {patch.piece.level for patch in scene.mode.shown} == {scene.terrain.n_levels - 1}
        assert len(scene.mode.shown) > 5


@pytest.mark.parametrize("tree", [2, 4])
def test_patches_of_one_level_are_one_mesh(gentle, small_patches, monkeypatch, tree):
    """No crack and no T-junction: in view all edges have two triangles, and no skirts hang there.

    The mesh of each alone, which overlaps its neighbours and ends in skirts, has more triangles.
    """
    monkeypatch.setattr(Dynamic, "tree", tree)
    n_alone = n_joined = 0
    with Scene(gentle, ListStore(), mode="dynamic", exaggeration=1.5) as scene:
        for camera, frames in single_level_views(scene):
            edges = open_edges(scene)
            assert not are_inside_and_in_view(scene, camera, edges).any()
            n_joined += frames.n_triangles
            eye = eye_of(scene.view(camera, VIEWPORT, 0.4))
            for patch, followed in zip(scene.mode.shown, scene.mode.followed, strict=True):
                alone = patch.mesh.draw(eye, followed)
                n_alone += len(alone.triangles) + 2 * len(alone.edges)
    assert 0.4 * n_alone < n_joined < 0.95 * n_alone


def parts_of(mode):
    """The mesh of each patch."""
    starts = mode.first_vertices
    for first, end in pairwise(starts):
        inside = (mode.drawn.triangles >= first).all(1) & (mode.drawn.triangles < end).all(1)
        yield mode.drawn._replace(
            vertices=mode.drawn.vertices[first:end], triangles=mode.drawn.triangles[inside] - first,
            depths=mode.drawn.depths[first:end],
        )  # fmt: skip


def skirts_of(part):
    """Each vertex of the upper end of a skirt: x, y, z and how deep it is."""
    is_below = part.depths >= 0
    for (x, y, z), depth in zip(part.vertices[is_below], part.depths[is_below], strict=True):
        yield x, y, z, depth


def test_a_raster_of_one_row_draws_nothing():
    heights = np.arange(9, dtype=np.int16)[None]
    with terrain_of(heights, max_error=0) as terrain:
        for mode in ("dynamic", "rqt", "vertex-texture"):
            with Scene(terrain, ListStore(), mode=mode) as scene:
                view = scene.view(home(scene.frame.box, VIEWPORT), VIEWPORT)
                assert scene.settle(view).n_triangles == 0
