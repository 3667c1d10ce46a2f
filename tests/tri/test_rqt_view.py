from itertools import pairwise

import numpy as np
import pytest
from cases import some
from tri.slow_dynamic import NORTH_UP, VIEWPORT, areas, cameras, eye_of, surfaces_at

from terrainwave.render.scene.camera import Camera, project
from terrainwave.tri.rqt.stored import neighbours
from terrainwave.tri.rqt.view import RestrictedMesh

# What it compiles takes half a minute.
pytestmark = pytest.mark.slow_compile

RANGE = (-30.0, 60.0)
SHAPES = [((17, 17), 16, False), ((17, 25), 8, False), ((14, 19), 8, True)]


def heights_of(shape, has_void, seed=1):
    rng = np.random.default_rng(seed)
    rows, cols = np.indices(shape)
    heights = 4 * np.sin(rows / 5) * np.cos(cols / 7) + 0.3 * rows
    heights += np.where(cols > shape[1] // 2, rng.normal(size=shape), 0)
    if has_void:
        heights[3:6, 4:9] = np.nan
        heights[10, 2] = np.nan
    return heights


def mesh_of(shape, tile, has_void, **options):
    heights = heights_of(shape, has_void)
    mesh = RestrictedMesh(heights, tile=tile, sample_matrix=NORTH_UP, **options)
    mesh._limits = RANGE  # boxes as high as those of `cameras`
    return mesh


def vertices_below_corners(mesh):
    """All places of the padded grid but the tiles' corners, with what they depend on."""
    n_rows, n_cols = mesh._is_active.shape
    for row, col in np.ndindex(n_rows, n_cols):
        if row % mesh.tile == 0 and col % mesh.tile == 0:
            continue
        stride = (row | col) & -(row | col)
        _, _, _, _, r2, c2, r3, c3 = neighbours(row, col, stride)
        needs = [(r, c) for r, c in ((r2, c2), (r3, c3)) if 0 <= r < n_rows and 0 <= c < n_cols]
        yield (row, col), needs


@pytest.mark.parametrize(("shape", "tile", "has_void"), SHAPES)
def test_active_are_those_whose_error_on_screen_is_above_tau(shape, tile, has_void):
    """Whatever was before; and then what they depend on is active by itself (nested errors)."""
    mesh = mesh_of(shape, tile, has_void)
    counts = set()
    for camera in cameras(shape, 6):
        eye = eye_of(camera)
        frame = mesh.update(eye, 3.0)
        for (row, col), needs in vertices_below_corners(mesh):
            assert mesh._is_active[row, col] == (mesh.screen_error(eye, row, col) > 3.0)
            if mesh._is_active[row, col]:
                assert all(mesh._is_active[place] for place in needs)
        assert frame.n_active == mesh._is_active.sum()
        counts.add(frame.n_active)
    assert len(counts) > 3


@pytest.mark.parametrize("error", ["measured", "paper"])
@pytest.mark.parametrize(("shape", "tile", "has_void"), SHAPES)
def test_no_edge_is_open_and_the_area_is_covered_once(shape, tile, has_void, error):
    mesh = mesh_of(shape, tile, has_void, error=error)
    rng = np.random.default_rng(2)
    for camera in cameras(shape, 5, seed=4):
        eye = eye_of(camera)._replace(planes=np.empty((0, 4)))
        frame = mesh.update(eye, 2.0)
        assert (areas(frame) > 0).all()
        edges = {tuple(e) for k in range(3) for e in frame.triangles[:, [k, (k + 1) % 3]].tolist()}
        assert len(edges) == 3 * len(frame.triangles)
        counts = [len(surfaces_at(frame, *xy)) for xy in rng.uniform(0.1, 13.1, (100, 2)) * (1, -1)]
        assert max(counts) <= 1
        if not has_void and shape[0] == 17:
            assert min(counts) == 1
            assert areas(frame).sum() == 2 * 16 * (shape[1] - 1)
            side = frame.places[:, None] == np.array([[0, 0], [16, shape[1] - 1]])
            open_edges = {(a, b) for a, b in edges if (b, a) not in edges}
            assert all((side[a] & side[b]).any() for a, b in open_edges)


@pytest.mark.parametrize("morph", some([1.25, 1.0, 3.0], 3))
@pytest.mark.parametrize(("shape", "tile", "has_void"), SHAPES)
def test_no_sample_is_further_than_tau_on_screen(shape, tile, has_void, morph):
    mesh, heights = mesh_of(shape, tile, has_void), heights_of(shape, has_void)
    largest, n_seen = 0.0, 0
    for tau in (2.0, 8.0):
        for camera in cameras(shape, 6, seed=3):
            frame = mesh.update(eye_of(camera), tau, morph=morph)
            for row, col in np.argwhere(~np.isnan(heights)).tolist():
                at = np.array([[col, -row, heights[row, col]]])
                pixel = project(camera, VIEWPORT, at)[0]
                if not (0 <= pixel[0] <= VIEWPORT.width and 0 <= pixel[1] <= VIEWPORT.height):
                    continue
                over = surfaces_at(frame, col, -row)
                if not len(over):
                    # At a void: the nearest vertex stands for it.
                    seen = project(camera, VIEWPORT, frame.vertices)[:, :2]
                    assert np.nanmin(np.linalg.norm(seen - pixel[:2], axis=1)) <= tau
                    continue
                points = np.column_stack([np.tile(at[0, :2], (len(over), 1)), over])
                apart = project(camera, VIEWPORT, points)[:, :2] - pixel[:2]
                largest = max(largest, float(np.linalg.norm(apart, axis=1).max()) / tau)
                n_seen += 1
    assert n_seen > 200
    assert 0.1 < largest <= 1


def test_borders_where_the_raster_goes_on_are_named_and_measured():
    """By hand: a bump of 2 on the first row, on an edge from corner to corner."""
    heights = np.zeros((17, 17))
    heights[0, 5] = 2.0
    mesh = RestrictedMesh(heights, tile=16, sample_matrix=NORTH_UP, open_sides=(True,) * 4)
    eye = eye_of(Camera((8, -80, 40), 0, -30, 60))._replace(planes=np.empty((0, 4)))
    assert mesh.update(eye, 1e9).border_error == 2.0
    assert len(mesh.update(eye, 1e9).edges) == 4
    away = np.array([[0.0, -1.0, 0.0, -1.0]])  # y <= -1: the first row is out of view
    assert mesh.update(eye._replace(planes=away), 1e9).border_error == 0.0
    frame = mesh.update(eye, 1.0)
    assert frame.border_error < 0.01
    of = frame.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges, counts = np.unique(np.sort(of, axis=1), axis=0, return_counts=True)
    np.testing.assert_array_equal(
        np.unique(np.sort(frame.edges, axis=1), axis=0), edges[counts == 1]
    )
    assert len(frame.edges) > 10


def surface_of(frame, shape, every=1):
    """Heights of a mesh over samples; NaN where it has none."""
    found = np.full(shape, np.nan)
    for row, col in [*np.ndindex(shape)][::every]:
        over = surfaces_at(frame, col, -row)
        if len(over):
            np.testing.assert_allclose(over, over[0], rtol=0, atol=1e-9)  # no crack
            found[row, col] = over[0]
    return found


@pytest.mark.parametrize("error", some(["paper", "measured"], 2))
def test_what_is_drawn_is_the_mean_of_the_surfaces_for_all_thresholds(error):
    """Those change where a vertex's error is passed: the integral is a sum."""
    shape, tau, morph = (9, 9), 100.0, 16.0
    mesh, slow = (mesh_of(shape, 8, False, error=error) for _ in range(2))
    n_between = 0
    for camera in cameras(shape, 3, seed=5):
        eye = eye_of(camera)._replace(planes=np.empty((0, 4)))
        drawn = surface_of(mesh.update(eye, tau, morph=morph), shape)
        errors = {slow.screen_error(eye, *place) for place, _ in vertices_below_corners(slow)}
        inside = {error for error in errors if tau / morph < error < tau}
        limits = np.array([tau / morph, *sorted(inside), tau])
        mean = np.zeros(shape)
        for low, high in pairwise(limits):
            mean += (high - low) * surface_of(slow.update(eye, (low + high) / 2), shape)
        np.testing.assert_allclose(drawn, mean / (tau - tau / morph), rtol=0, atol=1e-6)
        n_between += len(inside)
    assert n_between > 20


def largest_jump(mesh, shape, n_steps, morph):
    """The largest way that the surface over a sample moves in one step of a flight."""
    jumps, before = [], None
    for share in np.linspace(0, 1, n_steps):
        # Nothing is out of view: there it may jump.
        eye = eye_of(Camera((8 + 4 * share, -60 + 30 * share, 61), 0, -20, 40))
        eye = eye._replace(planes=np.empty((0, 4)))
        surface = surface_of(mesh.update(eye, 60.0, morph=morph), shape, every=7)
        if before is not None:
            jumps.append(float(np.nanmax(np.abs(surface - before))))
        before = surface
    return max(jumps)


@pytest.mark.large
@pytest.mark.parametrize("error", some(["measured", "paper"], 2))
def test_nothing_jumps_with_a_morph(error):
    """A tenth of the step makes a tenth of the way; without a morph vertices jump all the same."""
    shape = (17, 17)
    coarse, fine, without = (
        largest_jump(mesh_of(shape, 16, False, error=error), shape, n_steps, morph)
        for n_steps, morph in ((17, 2.0), (161, 2.0), (161, 1.0))
    )
    assert fine < 0.25 * coarse
    assert without > 4 * fine


def test_the_budget_is_kept_and_tau_sinks_again():
    mesh = mesh_of((17, 17), 8, False)
    eye = eye_of(Camera((8, -8, 90), 0, -80, 60))
    free = mesh.update(eye, 4.0, morph=1.25)
    assert free.tau == 4.0
    assert free.n_active > 100
    tight = mesh.update(eye, 4.0, morph=1.25, max_vertices=free.n_active - 20)
    assert 9 < tight.n_active <= free.n_active - 20
    assert 4.0 < tight.tau < 4.0 * 1.02**50
    for _ in range(50):
        again = mesh.update(eye, 4.0, morph=1.25, max_vertices=free.n_active)
    assert again.tau == 4.0
    assert again.n_active == free.n_active


def test_errors_are_not_below_the_distance_of_any_sample_from_the_triangles_that_are_split():
    shape = (17, 17)
    mesh, heights = mesh_of(shape, 16, False), heights_of(shape, False)
    n_equal = 0
    for (row, col), needs in vertices_below_corners(mesh):
        stride = (row | col) & -(row | col)
        r0, c0, r1, c1 = neighbours(row, col, stride)[:4]
        worst = 0.0
        for top in needs:
            corners = np.array([[r0, c0], [r1, c1], top], dtype=float)
            plane = np.linalg.solve(
                np.column_stack([corners, np.ones(3)]),
                [heights[r0, c0], heights[r1, c1], heights[top]],
            )
            for place in np.ndindex(shape):
                weights = np.linalg.solve(np.vstack([corners.T, np.ones(3)]), [*place, 1])
                if weights.min() >= -1e-9:
                    worst = max(worst, abs(np.dot([*place, 1], plane) - heights[place]))
        assert mesh._errors[row, col] >= worst * (1 - 1e-6)
        n_equal += abs(mesh._errors[row, col] - worst) < 1e-4
    assert n_equal > 100


def test_errors_by_coefficient_are_those_given_and_of_what_depends_on_a_vertex():
    """Against the least errors that hold those of dependents, vertex by vertex, finest first."""
    shape = (33, 33)
    given = np.random.default_rng(5).random(shape)
    mesh = RestrictedMesh(
        heights_of(shape, has_void=False), tile=32, sample_matrix=NORTH_UP, error="coefficient",
        coefficients=given,
    )  # fmt: skip
    expected = given.astype(np.float32)
    below = sorted(vertices_below_corners(mesh), key=lambda found: _order(*found[0]))
    for (row, col), needs in below:
        for place in needs:
            expected[place] = max(expected[place], expected[row, col])
    for (row, col), _ in below:
        assert mesh._errors[row, col] == expected[row, col]


def _order(row, col):
    """Middles of edges before the centres of their stride, fine strides first."""
    stride = (row | col) & -(row | col)
    return stride, bool(row & stride and col & stride)
