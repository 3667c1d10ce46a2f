import numpy as np
import pytest
from tri.slow_dynamic import (
    NORTH_UP,
    VIEWPORT,
    areas,
    cameras,
    drawn_samples,
    eye_of,
    pixel_errors,
    roots_of_samples,
    screen_errors,
    snapped,
    surfaces_at,
    triangles_of,
)

from terrainwave.render.scene.camera import Camera, project
from terrainwave.tri.dynamic.dynamic import (
    DynamicMesh,
    ForestPart,
    draw_together,
    mark_bottom_up,
    mark_top_down,
)
from terrainwave.tri.dynamic.fans import INNER, ROOT
from terrainwave.tri.dynamic.haar import ERROR, HIGH, LOW, OUTLINE, _measure, build_tree

pytestmark = pytest.mark.slow_compile


def rough(shape, seed=1, amplitude=4.0):
    """Steps, slopes and noise of mixed sizes."""
    rng = np.random.default_rng(seed)
    rows, cols = np.indices(shape)
    heights = amplitude * np.sin(rows / 5) * np.cos(cols / 7) + 0.3 * rows
    heights += np.where(cols > shape[1] // 2, rng.normal(size=shape) * amplitude / 4, 0)
    return heights


def with_void(shape):
    mask = np.ones(shape, dtype=bool)
    mask[3:6, 4:9] = False
    mask[-4:, -3:] = False
    return mask


CASES = [((16, 16), 16, False), ((16, 24), 8, False), ((13, 19), 8, True), ((5, 3), 4, False)]


def test_parents_are_means_and_the_papers_error_is_the_largest_haar_coefficient():
    # By hand: (1 + 3 + 5 + 11) / 4 = 5; ¼|1 - 3 + 5 - 11| = 2, ¼|1 + 3 - 5 - 11| = 3,
    # ¼|1 - 3 - 5 + 11| = 1.
    tree = build_tree(np.array([[1.0, 3.0], [5.0, 11.0]]), patch=2, error="paper")
    assert tree.z.tolist() == [1, 3, 5, 11, 5]
    assert tree.bounds.tolist() == [[3, 1, 11]]


def test_voids_do_not_count_and_nodes_at_an_outline_have_no_error():
    heights = np.array([[1.0, 3.0, np.nan], [5.0, np.nan, np.nan]])
    tree = build_tree(heights, patch=2)
    np.testing.assert_array_equal(tree.z[-2:], [3, np.nan])
    np.testing.assert_array_equal(tree.bounds[:, ERROR], [OUTLINE, 0])


def test_errors_and_boxes_of_parents_hold_those_of_children():
    tree = build_tree(rough((32, 32)), patch=32)
    first = int(tree.layout[1, 0])
    for height in range(2, 6):
        start, n_rows, n_cols = tree.layout[height].tolist()
        below = int(tree.layout[height - 1, 0])
        own = tree.bounds[start - first :][: n_rows * n_cols].reshape(n_rows, n_cols, 3)
        children = tree.bounds[below - first :][: 4 * n_rows * n_cols]
        children = children.reshape(2 * n_rows, 2 * n_cols, 3)
        for r in (0, 1):
            for c in (0, 1):
                child = children[r::2, c::2]
                is_outline = own[..., ERROR] == OUTLINE
                assert (is_outline | (own[..., ERROR] >= child[..., ERROR])).all()
                assert (is_outline | (child[..., ERROR] != OUTLINE)).all()
                assert (own[..., LOW] <= child[..., LOW]).all()
                assert (own[..., HIGH] >= child[..., HIGH]).all()


@pytest.mark.parametrize("error", ["measured", "paper"])
@pytest.mark.parametrize(("shape", "patch", "has_void"), CASES)
def test_the_first_marks_are_those_of_the_definition(shape, patch, has_void, error):
    mask = with_void(shape) if has_void else None
    for camera in cameras(shape, 4):
        mesh = DynamicMesh(
            rough(shape), mask=mask, sample_matrix=NORTH_UP, patch=patch, error=error
        )
        eye = eye_of(camera)
        frame = mesh.update(eye, 3.0)
        expected = roots_of_samples(mesh, eye, 3.0)
        vertices = {tuple(node) for node in frame.nodes.tolist()}
        assert len(vertices) == len(frame.nodes)
        assert vertices == {root for root in expected.values() if _has_height(mesh, root)}


def _has_height(mesh, node):
    first, _, n_cols = mesh.tree.layout[node[0]].tolist()
    return not np.isnan(mesh.tree.z[first + node[1] * n_cols + node[2]])


@pytest.mark.parametrize("is_stepwise", [False, True])
def test_following_a_camera_ends_where_marking_all_nodes_does(is_stepwise):
    shape = (24, 24)
    followed = DynamicMesh(rough(shape), sample_matrix=NORTH_UP, patch=8)
    n_roots = set()
    for camera in cameras(shape, 8):
        eye = eye_of(camera)
        frame = followed.update(eye, 4.0, is_stepwise=is_stepwise)
        n_steps = 1
        while is_stepwise and frame.n_changed:
            frame = followed.update(eye, 4.0, is_stepwise=True)
            n_steps += 1
        # A change of all heights takes one step each, and one more to see that nothing is left.
        assert n_steps <= 5
        tree, marks = followed.tree, np.empty_like(followed.marks)
        view = followed._view(eye)
        mark_bottom_up(tree.layout, tree.z, tree.bounds, view, eye.planes, 4.0, marks)
        np.testing.assert_array_equal(followed.marks, marks)
        n_roots.add(len(frame.nodes))
    assert len(n_roots) > 4


def test_a_view_that_stays_touches_only_what_it_shows():
    """Not the nodes below roots (§3.4): those that are drawn, and the nodes above them."""
    mesh = DynamicMesh(rough((32, 32)), sample_matrix=NORTH_UP, patch=32)
    eye = eye_of(Camera((16, -40, 20), 0, -30, 40))
    mesh.update(eye, 6.0)
    frame = mesh.update(eye, 6.0)
    assert frame.n_changed == 0
    drawn = np.count_nonzero((mesh.marks == ROOT) | (mesh.marks == INNER))
    assert drawn / 4 < frame.n_touched <= drawn < 0.7 * mesh.n_nodes
    tree, view = mesh.tree, mesh._view(eye)
    before = mesh.marks.copy()
    mesh.has_changed[...] = False
    counts = mark_top_down(
        tree.layout, tree.z, tree.bounds, view, eye.planes, 6.0, True, mesh._stack, mesh.marks,
        mesh.has_changed,
    )  # fmt: skip
    assert counts == (drawn, 0, 0, 0.0)
    assert not mesh.has_changed.any()
    np.testing.assert_array_equal(mesh.marks, before)


@pytest.mark.parametrize("error", ["measured", "paper"])
@pytest.mark.parametrize(("shape", "patch", "has_void"), CASES)
def test_fans_are_the_full_grid_with_all_samples_at_their_roots(shape, patch, has_void, error):
    mask = with_void(shape) if has_void else np.ones(shape, dtype=bool)
    sizes = set()
    for camera in cameras(shape, 6):
        mesh = DynamicMesh(
            rough(shape), mask=mask, sample_matrix=NORTH_UP, patch=patch, error=error
        )
        eye = eye_of(camera)
        frame = mesh.update(eye, 3.0)
        roots = roots_of_samples(mesh, eye, 3.0)
        padded = np.zeros(tuple(mesh.tree.layout[0, 1:]), dtype=bool)
        padded[: shape[0], : shape[1]] = mask
        assert triangles_of(frame) == snapped(roots, padded)
        sizes |= set(frame.nodes[:, 0].tolist())
    assert len(sizes) > (max(shape) > 8)


def test_a_mesh_is_watertight_and_covers_the_area_once():
    """Patches of very different roots side by side; no edge is open but on the outline."""
    shape, rng = (32, 32), np.random.default_rng(5)
    heights = rng.normal(size=shape) * (rng.random(shape) > 0.995) * 9
    mesh = DynamicMesh(heights, sample_matrix=NORTH_UP, patch=16, error="paper")
    n_mixed = 0
    for camera in cameras(shape, 6, seed=2):
        frame = mesh.update(eye_of(camera)._replace(planes=np.empty((0, 4))), 1.0)
        assert (areas(frame) > 0).all()
        edges = {tuple(e) for k in range(3) for e in frame.triangles[:, [k, (k + 1) % 3]].tolist()}
        assert len(edges) == 3 * len(frame.triangles)
        open_edges = {(a, b) for a, b in edges if (b, a) not in edges}
        side = 1 << frame.nodes[:, 0]
        on_outline = (frame.nodes[:, 1:] == 0) | (
            (frame.nodes[:, 1:] + 1) * side[:, None] == shape[0]
        )
        assert all((on_outline[a] & on_outline[b]).any() for a, b in open_edges)
        for x, y in rng.uniform(1, 30, (200, 2)):
            row, col = round(y), round(x)
            root = drawn_samples(frame, shape)[row, col]
            is_inside = 0 < root[0] < 31 and -31 < root[1] < 0
            assert len(surfaces_at(frame, x, -y)) <= 1 + (not is_inside)
        n_mixed += np.ptp(frame.nodes[:, 0]) > 2
        # One component with one border: V - E + F = 1.
        n_edges = (len(edges) + len(open_edges)) // 2
        if len(frame.triangles):
            assert len(frame.vertices) - n_edges + len(frame.triangles) == 1
    assert n_mixed > 2


@pytest.mark.parametrize("morph", [1.0, 1.5])
@pytest.mark.parametrize(("shape", "patch", "has_void"), CASES[1:3])
def test_no_sample_is_further_than_tau_on_screen(shape, patch, has_void, morph):
    heights, mask = rough(shape), with_void(shape) if has_void else np.ones(shape, dtype=bool)
    mesh = DynamicMesh(heights, mask=mask, sample_matrix=NORTH_UP, patch=patch)
    used, coarsest = [], 0
    for tau in (2.0, 12.0):
        for camera in cameras(shape, 5, seed=3):
            frame = mesh.update(eye_of(camera), tau, morph=morph)
            errors = pixel_errors(frame, heights, mask, camera)
            assert errors.max(initial=0) <= tau
            used.append(errors.max(initial=0) / tau)
            coarsest = max(coarsest, int(frame.nodes[:, 0].max(initial=0)))
    assert max(used) > 0.2
    assert coarsest > 1


def open_edges(frame):
    """Edges of one triangle, each from its smaller vertex."""
    of = frame.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges, counts = np.unique(np.sort(of, axis=1), axis=0, return_counts=True)
    return {tuple(edge) for edge in edges[counts == 1].tolist()}


TREE, TREES = 4, (9, 11)
RINGS = 2  # of which the outer one tells errors in the inner one
# Rows and columns of trees of each mesh, without the rings of trees around them.
CUTS = [
    (slice(top, bottom), slice(left, right))
    for top, bottom in ((0, 3), (3, 7), (7, 9))
    for left, right in ((0, 2), (2, 6), (6, 11))
]


def side_by_side(heights, eye, tau, error, cuts):
    """The frames of meshes of parts of a raster."""
    parts = []
    for cut in cuts:
        wide = [
            slice(max(own.start - RINGS, 0), min(own.stop + RINGS, n))
            for own, n in zip(cut, TREES, strict=True)
        ]
        (row, col) = (trees.start for trees in wide)
        owned = tuple(
            slice(own.start - trees.start, own.stop - trees.start)
            for own, trees in zip(cut, wide, strict=True)
        )
        samples = tuple(slice(s.start * TREE, s.stop * TREE) for s in wide)
        x, y = col * TREE, -row * TREE
        mesh = DynamicMesh(
            heights[samples], sample_matrix=(1.0, 0.0, x, 0.0, -1.0, y), patch=TREE, error=error,
            open_sides=(True,) * 4,
        )  # fmt: skip
        mesh.base_error = 0.0  # what float32 rounds differs by part
        followed = mesh.follow(eye, tau, morph=1.5)
        # Rows and columns of trees may count from anywhere.
        parts.append(ForestPart(mesh, followed, (row - 5, col + 7), owned))
    return draw_together(parts, eye)


def welded(frames):
    """One frame of many: vertices at one place are one."""
    vertices = np.concatenate([frame.vertices for frame in frames])
    vertices, at = np.unique(vertices, axis=0, return_inverse=True)
    starts = np.cumsum([0, *(len(frame.vertices) for frame in frames)])
    pairs = list(zip(frames, starts, strict=False))
    triangles = at[np.concatenate([frame.triangles + start for frame, start in pairs])]
    edges = at[np.concatenate([frame.edges + start for frame, start in pairs])]
    return frames[0]._replace(vertices=vertices, triangles=triangles, edges=edges)


def places_of(frame):
    """Places of the corners of its triangles and of its rim's edges, in one order."""
    return [
        sorted(sorted(map(tuple, part)) for part in np.round(frame.vertices[which], 5).tolist())
        for which in (frame.triangles, frame.edges)
    ]


@pytest.mark.large
@pytest.mark.parametrize("has_void", [False, True])
@pytest.mark.parametrize("error", ["measured", "paper"])
def test_meshes_side_by_side_are_the_mesh_of_the_whole_raster(error, has_void):
    """Fans do not see whose trees their nodes are in: the same triangles, the same rim."""
    heights = rough((TREES[0] * TREE, TREES[1] * TREE))
    if has_void:
        heights[8:17, 20:31] = np.nan  # over corners of meshes
    counts = set()
    above = eye_of(Camera((20, -60, 60), 0, -40, 60))._replace(planes=np.empty((0, 4)))
    views = [(above, tau) for tau in (0.6, 2.0, 3.0, 8.0, 16.0)]
    for eye, tau in [*views, *((eye_of(at), 6.0) for at in cameras(heights.shape, 2, seed=2))]:
        whole = DynamicMesh(
            heights, sample_matrix=NORTH_UP, patch=TREE, error=error, open_sides=(True,) * 4
        )
        whole.base_error = 0.0
        expected = whole.draw(eye, whole.follow(eye, tau, morph=1.5))
        found = welded(side_by_side(heights, eye, tau, error, CUTS))
        assert places_of(found) == places_of(expected)
        counts.add(len(expected.triangles))
    assert len(counts) > 3


@pytest.mark.large
@pytest.mark.parametrize("missing", [[4], [0, 4], [1, 3, 5, 7], [6, 7, 8]])
def test_where_a_mesh_is_missing_triangles_are_those_of_the_whole_raster(missing):
    """So they are within the same error: nodes in rings are measured with all around them."""
    heights = np.zeros((TREES[0] * TREE, TREES[1] * TREE))
    peaks = np.random.default_rng(5)
    for row, col in zip(peaks.integers(0, 36, 12), peaks.integers(0, 44, 12), strict=True):
        heights[row, col] = 40.0
    cuts = [cut for number, cut in enumerate(CUTS) if number not in missing]
    eye = eye_of(Camera((20, -60, 60), 0, -40, 60))._replace(planes=np.empty((0, 4)))
    n_found = 0
    for tau in (1.0, 4.0, 12.0):
        whole = DynamicMesh(
            heights, sample_matrix=NORTH_UP, patch=TREE, error="measured", open_sides=(True,) * 4
        )
        whole.base_error = 0.0
        expected = places_of(whole.draw(eye, whole.follow(eye, tau, morph=1.5)))[0]
        found = places_of(welded(side_by_side(heights, eye, tau, "measured", cuts)))[0]
        assert {str(one) for one in found} <= {str(one) for one in expected}
        n_found += len(found)
    assert n_found > 300


@pytest.mark.large
@pytest.mark.parametrize("missing", [[4], [0, 4], [1, 3, 5, 7], [0, 1, 2, 3, 5, 6, 7, 8]])
def test_where_a_mesh_is_missing_the_others_reach_over_its_trees_and_name_where_they_end(missing):
    """No triangle has a neighbour too many; all that the others own is covered once."""
    heights = rough((TREES[0] * TREE, TREES[1] * TREE))
    cuts = [cut for number, cut in enumerate(CUTS) if number not in missing]
    eye = eye_of(Camera((20, -60, 60), 0, -40, 60))._replace(planes=np.empty((0, 4)))
    for tau in (4.0, 12.0, 20.0, 1e3):
        frames = side_by_side(heights, eye, tau, "measured", cuts)
        whole = welded(frames)
        edges = np.sort(whole.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        counts = np.unique(edges, axis=0, return_counts=True)[1]
        assert counts.max() == 2
        assert {tuple(sorted(edge)) for edge in whole.edges.tolist()} == open_edges(whole)
        assert (areas(whole) > 0).all()
        rng = np.random.default_rng(1)
        for rows, cols in cuts:
            for _ in range(30):
                # A raster ends half a tree inside at most.
                row = rng.uniform(
                    max(rows.start * TREE - 0.5, 1.5), min(rows.stop * TREE - 0.5, 33.5)
                )
                col = rng.uniform(
                    max(cols.start * TREE - 0.5, 1.5), min(cols.stop * TREE - 0.5, 41.5)
                )
                assert len(surfaces_at(whole, col, -row)) == 1
        owned = np.zeros(TREES, dtype=bool)
        for cut in cuts:
            owned[cut] = True
        cols, rows = (whole.vertices[:, :2] * (1, -1) + 0.5).T // TREE
        is_own = owned[rows.astype(int), cols.astype(int)]
        assert is_own[whole.triangles].any(axis=1).all()


@pytest.mark.parametrize("tau", [20.0, 60.0])
def test_where_the_raster_goes_on_the_mesh_ends_short_of_its_last_samples(tau):
    """By half a tree at most, with the edges that the frame names; errors there are measured."""
    rng = np.random.default_rng(1)
    heights = rng.normal(size=(32, 40)) * 3
    mesh = DynamicMesh(heights, patch=8, sample_matrix=NORTH_UP, open_sides=(True,) * 4)
    eye = eye_of(Camera((20, -60, 60), 0, -40, 60))._replace(planes=np.empty((0, 4)))
    followed = mesh.follow(eye, tau, morph=1.5)
    frame = mesh.draw(eye, followed)
    assert {tuple(sorted(edge)) for edge in frame.edges.tolist()} == open_edges(frame)
    ends = frame.vertices[np.unique(frame.edges)]
    inside = np.minimum(ends[:, :2] * (1, -1), (39, 31) - ends[:, :2] * (1, -1)).min(axis=1)
    assert inside.max() <= 3.5
    apart = [
        np.abs(over - heights[row, col]).max()
        for row, col in np.ndindex(32, 40)
        if len(over := surfaces_at(frame, col, -row))
    ]
    assert len(apart) > 800
    assert max(apart) <= mesh.largest_error(eye, followed) < 4 * max(apart)
    if tau > 50:
        assert len(frame.vertices) < 250  # no outline that splits all nodes along it


def test_the_surface_between_samples_counts_half_way_to_those_around():
    """By hand: around four samples at 0 lie others at 8, in the corners of a cell with three."""
    z = np.full((4, 4), 8.0)
    z[1:3, 1:3] = 0.0
    for is_surface, expected in ((False, 0.0), (True, 6.0)):
        bound = np.zeros(3)
        _measure(
            (1, 1, 2, 2), is_surface, np.array([[0, 4, 4]]), z.ravel(), 0.0, np.empty((0, 3)), 0,
            bound,
        )  # fmt: skip
        assert bound.tolist() == [expected, 0.0, expected]


@pytest.mark.large
def test_the_budget_is_kept_and_tau_sinks_again():
    mesh = DynamicMesh(rough((32, 32)), sample_matrix=NORTH_UP, patch=16)
    eye = eye_of(Camera((16, -16, 30), 0, -80, 60))
    free = mesh.update(eye, 1.0)
    assert len(free.vertices) > 200
    tight = mesh.update(eye, 1.0, max_vertices=200)
    assert len(tight.vertices) <= 200
    assert tight.tau > 1.0
    for _ in range(200):
        again = mesh.update(eye, 1.0, max_vertices=1024)
    assert again.tau == 1.0
    assert len(again.vertices) == len(free.vertices)


def largest_jumps(mesh, shape, n_steps, morph):
    """The largest way that a sample's root is drawn away from where it was a step before."""
    jumps, before = [], None
    for share in np.linspace(0, 1, n_steps):
        # Nothing is out of view: nodes jump where they are.
        eye = eye_of(Camera((8 + 4 * share, -60 + 30 * share, 20), 0, -20, 40))
        eye = eye._replace(planes=np.empty((0, 4)))
        drawn = drawn_samples(mesh.update(eye, 3.0, morph=morph), shape)
        if before is not None:
            jumps.append(float(np.abs(drawn - before).max()))
        before = drawn
    return max(jumps)


@pytest.mark.large
@pytest.mark.parametrize("error", ["measured", "paper"])
def test_nothing_jumps_with_a_morph(error):
    """A tenth of the step makes a tenth of the way; without a morph vertices jump all the same."""
    shape = (16, 16)
    meshes = [
        DynamicMesh(rough(shape), sample_matrix=NORTH_UP, patch=16, error=error) for _ in range(3)
    ]
    coarse = largest_jumps(meshes[0], shape, 41, 2.0)
    fine = largest_jumps(meshes[1], shape, 401, 2.0)
    assert fine < 0.25 * coarse
    assert fine < 0.3
    assert largest_jumps(meshes[2], shape, 401, 1.0) > 0.4


def test_children_lie_at_their_parent_when_it_merges():
    """On the way there they are between the two, by the share of the parent's error (§3.6)."""
    heights = np.zeros((4, 4))
    heights[1, 1] = 1.0
    mesh = DynamicMesh(heights, sample_matrix=NORTH_UP, patch=4)
    eye = eye_of(Camera((1.5, -40, 20), 0, -25, 40))
    error = screen_errors(mesh, eye, 1)[0, 0]
    for share in (0.0, 0.25, 1.0):
        # (error − τ/2) / (τ − τ/2) = share
        tau = 2 * error / (1 + share) * (1 - 1e-9)
        frame = mesh.update(eye, tau, morph=2.0)
        node = [tuple(node) for node in frame.nodes.tolist()].index((0, 1, 1))
        place = np.array([0.5, -0.5, 0.25])
        place += share * (np.array([1.0, -1.0, 1.0]) - place)
        np.testing.assert_allclose(frame.vertices[node], place, atol=1e-6)


def test_errors_on_screen_bound_what_a_step_in_a_box_moves():
    """Against differences of projections of points in the box."""
    rng = np.random.default_rng(7)
    heights = rough((16, 16))
    mesh = DynamicMesh(heights, sample_matrix=NORTH_UP, patch=16)
    first = int(mesh.tree.layout[1, 0])
    n_checked = 0
    for camera in cameras((16, 16), 20, seed=8):
        errors = screen_errors(mesh, eye_of(camera), 2)
        for row, col in np.ndindex(4, 4):
            node = int(mesh.tree.layout[2, 0]) + 4 * row + col - first
            error, low, high = mesh.tree.bounds[node]
            if error == OUTLINE:
                continue
            xy = rng.uniform(-4, 4, (50, 2)) + np.array([4 * col + 1.5, -4 * row - 1.5])
            z = rng.uniform(low, high - min(error, high - low), 50)
            points = np.column_stack([xy, z])
            moved = points + np.array([0, 0, min(error, high - low)])
            a, b = (project(camera, VIEWPORT, p) for p in (points, moved))
            is_seen = (np.abs(a[:, :2] - (160, 120)) < (160, 120)).all(axis=1)
            is_seen &= (np.abs(b[:, :2] - (160, 120)) < (160, 120)).all(axis=1)
            apart = np.linalg.norm(a[is_seen, :2] - b[is_seen, :2], axis=1)
            assert apart.max(initial=0) <= errors[row, col] * (1 + 1e-9)
            n_checked += is_seen.sum()
    assert n_checked > 200


@pytest.mark.parametrize("has_cliff", [False, True])
def test_measured_errors_bound_triangles_with_neighbours_of_all_smaller_sizes(has_cliff):
    """Those that meet half way along a side, of each pair of sizes; by brute force.

    With a cliff beside it the node's own cell is flat: what counts lies in the windows around it.
    """
    rng = np.random.default_rng(9)
    heights = np.cumsum(rng.normal(size=(32, 32)), axis=1)
    if has_cliff:
        heights = np.tile(np.where(np.arange(32) < 16, 0.0, 50.0), (32, 1))
    tree = build_tree(heights, patch=32)
    means = [heights]
    while len(means[-1]) > 1:
        z = means[-1]
        means.append((z[::2, ::2] + z[1::2, ::2] + z[::2, 1::2] + z[1::2, 1::2]) / 4)

    def corner(height, row, col):
        side = 1 << height
        return (row + 0.5) * side - 0.5, (col + 0.5) * side - 0.5, means[height][row, col]

    tightest = 0.0
    for height, row, col in [(h, r, c) for h in (2, 3) for r in (1, 2) for c in (0, 1)]:
        side, node = 1 << height, row * (32 >> height) + col
        error = tree.bounds[int(tree.layout[height, 0] - tree.layout[1, 0]) + node, ERROR]
        if error == OUTLINE:
            continue
        for upper, lower in np.ndindex(height, height):
            meeting, right = row * side + side // 2, (col + 1) * side
            corners = [corner(height, row, col)]
            corners += [corner(upper, (meeting >> upper) - 1, right >> upper)]
            corners += [corner(lower, meeting >> lower, right >> lower)]
            a = np.array(corners)
            system = np.vstack([a[:, :2].T, np.ones(3)])
            for place in np.ndindex(heights.shape):
                weights = np.linalg.solve(system, [*place, 1])
                if weights.min() >= -1e-9:
                    apart = abs(weights @ a[:, 2] - heights[place])
                    assert apart <= error * (1 + 1e-6) + 1e-9
                    tightest = max(tightest, apart / max(error, 1e-3))
    assert tightest > 0.3
