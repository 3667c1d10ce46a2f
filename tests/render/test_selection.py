"""Frustum, selection, wanted lists and limits against obvious versions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrainwave.render.gpu.arena import Arena
from terrainwave.render.scene.camera import Camera, Viewport, focal_length, project
from terrainwave.render.scene.frustum import frustum_planes, may_see
from terrainwave.render.scene.select_kernels import pixels_per_metre
from terrainwave.render.scene.selection import ErrorGovernor, NodeInfo, NodeTable, Piece, View

VIEWPORT = Viewport(640, 480)


def random_camera(rng):
    x, y, z = rng.uniform(-600, 600), rng.uniform(-600, 600), rng.uniform(5, 400)
    return Camera((x, y, z), rng.uniform(0, 360), rng.uniform(-60, 10), rng.uniform(30, 90))


def test_a_box_with_a_visible_point_is_never_culled():
    rng = np.random.default_rng(1)
    n_seen = n_culled = 0
    for _ in range(2000):
        camera = random_camera(rng)
        low = rng.uniform(-800, 800, 3)
        high = low + rng.uniform(0, 200, 3)
        points = rng.uniform(low, high, (40, 3))
        pixels = project(camera, VIEWPORT, points)
        with np.errstate(invalid="ignore"):
            inside = (pixels[:, 0] >= 0) & (pixels[:, 0] <= 640)
            inside &= (pixels[:, 1] >= 0) & (pixels[:, 1] <= 480)
        is_seen = may_see(frustum_planes(camera, VIEWPORT), low, high)
        if inside.any():
            assert is_seen
            n_seen += 1
        n_culled += not is_seen
    assert n_seen > 100
    assert n_culled > 1000  # most boxes elsewhere do go


def random_tree(rng, depth=5, share_resident=0.8):
    """Return a table of a quadtree over ±512 m with random errors, boxes and absences."""
    table = NodeTable()

    def info(level, row, col):
        side = 1024 / (1 << level)
        x, y = -512 + col * side, -512 + row * side
        z = rng.uniform(0, 50)
        return NodeInfo(
            Piece(level, row, col), (x, y, z), (x + side, y + side, z + rng.uniform(0, 40)),
            rng.uniform(0, 30) / (1 << level), side / 16,
        )  # fmt: skip

    def grow(node, level, row, col):
        table.is_resident[node] = level == 0 or rng.random() < share_resident
        table.n_triangles[node] = rng.integers(1, 100)
        if level == depth or (level and rng.random() < 0.1):
            return
        places = [(2 * row + r, 2 * col + c) for r in (0, 1) for c in (0, 1) if rng.random() < 0.9]
        table.add_children(node, [info(level + 1, *place) for place in places])
        for place in places:
            child = table.find(Piece(level + 1, *place))
            grow(child, level + 1, *place)

    for place in ((0, 0),):
        grow(table.add(info(0, *place)), 0, *place)
    return table


def brute_selection(table, view, tau):
    planes, scale = view.planes, np.array([1.0, 1.0, view.exaggeration])

    def is_seen(node):
        corners = np.array(np.meshgrid(*zip(table.low[node] * scale, table.high[node] * scale)))
        distances = corners.reshape(3, -1).T @ planes[:, :3].T + planes[:, 3]
        return bool((distances.max(axis=0) >= 0).all())

    def distance(node):
        low, high = table.low[node] * scale, table.high[node] * scale
        return np.linalg.norm(np.clip(view.camera.eye, low, high) - view.camera.eye)

    def visit(node):
        if not table.is_resident[node] or not is_seen(node):
            return []
        children = [child for child in table.children[node] if child >= 0]
        seen = [child for child in children if is_seen(child)]
        away = distance(node)
        on_screen = view.gamma * table.errors[node] * view.exaggeration
        is_sparse = focal_length(view.camera, VIEWPORT) * table.spacings[node] > away
        if (
            on_screen > tau * (1 if is_sparse else view.flatness) * away
            and children
            and all(table.is_resident[child] for child in seen)
        ):
            return [found for child in seen for found in visit(child)]
        return [int(node)]

    return [found for root in table.roots for found in visit(root)]


@pytest.mark.parametrize("seed", range(12))
def test_selection_is_that_of_the_obvious_recursion(seed):
    rng = np.random.default_rng(seed)
    table = random_tree(rng)
    for _ in range(10):
        view = View(random_camera(rng), VIEWPORT, rng.uniform(0.5, 20), exaggeration=1.5)
        found = table.select(view)
        assert sorted(found.nodes.tolist()) == sorted(
            brute_selection(table, view, view.max_pixel_error)
        )
        assert found.n_triangles == table.n_triangles[found.nodes].sum()


@pytest.mark.parametrize("seed", range(4))
def test_of_flat_terrain_no_more_than_a_sample_for_each_pixel_is_asked_for(seed):
    rng = np.random.default_rng(seed)
    table = random_tree(rng, share_resident=1.0)
    table.spacings /= 16  # dense enough somewhere
    n_left = 0
    for _ in range(10):
        view = View(random_camera(rng), VIEWPORT, 0.05, flatness=rng.uniform(2, 80))
        found = table.select(view)
        assert sorted(found.nodes.tolist()) == sorted(brute_selection(table, view, 0.05))
        assert set(found.nodes.tolist()) <= set(table.wanted(view, 10_000).tolist())
        n_left += len(table.select(replace(view, flatness=1.0)).nodes) - len(found.nodes)
        fine = table.are_fine(view, found.nodes, 0.05)
        assert (fine | (table.children[found.nodes] < 0).all(axis=1)).all()
        on_screen = table.on_screen(view, found.nodes[fine])
        assert (on_screen <= 0.05 * view.flatness).all()
    assert n_left > 50


def in_picture(camera, points):
    pixels = project(camera, VIEWPORT, points)
    with np.errstate(invalid="ignore"):
        seen = ((pixels >= 0) & (pixels <= [640, 480, np.inf])).all(axis=1)
    return pixels[:, :2], seen


@pytest.mark.parametrize("pitch", [-90, -60, -20, 0])
def test_a_vertical_step_in_a_box_is_never_longer_on_screen_than_its_error(pitch):
    rng = np.random.default_rng(90 + pitch)
    largest = 0.0
    for _ in range(150):
        camera = Camera((0.0, 0.0, 0.0), rng.uniform(0, 360), pitch, rng.uniform(20, 110))
        low = camera.forward * rng.uniform(0, 500) - rng.uniform(0, 200, 3)
        high = low + rng.uniform(0, 400, 3) * rng.choice([0.1, 1.0])
        p, q = rng.uniform(low, high, (2, 100, 3))
        q[:, :2] = p[:, :2]
        p[0], q[0] = (*low[:2], high[2]), low  # steps as high as the box, in its corner
        (at, seen), (to, also) = in_picture(camera, p), in_picture(camera, q)
        pixels = (np.linalg.norm(to - at, axis=1) / abs(q - p)[:, 2])[seen & also].max(initial=0)
        nearest = np.linalg.norm(np.clip(0, low, high))
        for is_oriented, is_exact in ((False, True), (True, False), (True, True)):
            view = View(camera, VIEWPORT, is_oriented=is_oriented, is_exact=is_exact)
            scale = pixels_per_metre(camera.eye, tuple(low), tuple(high), view.lens, is_oriented)
            assert pixels <= scale * (1 + 1e-9)
            assert nearest == 0 or scale <= view.gamma / nearest * (1 + 1e-9)
        largest = max(largest, pixels / scale)
    assert largest > 0.98  # the last of them is hardly more than it has to be


def test_the_coarsest_levels_are_whole_or_not_at_all():
    table = random_tree(np.random.default_rng(3), share_resident=0.5)
    levels = table.keys[: len(table), 0]
    for most in (0, 1, 4, 21, len(table)):
        nodes = table.coarse_nodes(most)
        assert len(nodes) <= most
        left = np.setdiff1d(np.arange(len(table)), nodes)
        if len(left):
            assert len(nodes) == 0 or levels[nodes].max() < levels[left].min()
            assert len(nodes) + (levels == levels[left].min()).sum() > most


def test_what_is_wanted_comes_breadth_first_with_its_ancestors():
    rng = np.random.default_rng(5)
    table = random_tree(rng, share_resident=0.0)
    view = View(Camera((0, -600, 200), 0, -20, 60), VIEWPORT, 1.0)
    wanted = table.wanted(view, 1000).tolist()
    levels = [table.pieces[node].level for node in wanted]
    assert levels == sorted(levels)
    assert all(table.parents[node] in {-1, *wanted} for node in wanted)
    assert table.wanted(view, 7).tolist() == wanted[:7]
    # Once all of it is here, the selection needs nothing that was not wanted.
    table.is_resident[wanted] = True
    assert set(table.select(view).nodes.tolist()) <= set(wanted)


def test_eviction_takes_leaves_with_the_lowest_priority_first():
    """w = u·V / d (Zhang et al. 2012, eq. 13)."""
    rng = np.random.default_rng(6)
    table = random_tree(rng, share_resident=1.0)
    view = View(Camera((0, -600, 200), 0, -20, 60), VIEWPORT)
    keep = np.zeros(len(table), dtype=bool)
    keep[table.wanted(view, 20)] = True
    order = table.lowest_priority(view, keep)
    assert len(order) > 10
    assert not keep[order].any()
    assert all((table.children[node] < 0).all() for node in order)
    away = (table.low[order] + table.high[order]) / 2 - view.camera.eye
    ranks = (away @ view.camera.forward) / (away**2).sum(axis=1)
    assert (np.diff(ranks) >= 0).all()


def test_a_triangle_budget_raises_tau_and_is_kept():
    table = random_tree(np.random.default_rng(7), share_resident=1.0)
    view = View(Camera((0, -600, 200), 0, -20, 60), VIEWPORT, 0.5)
    free = table.select(view)
    found, tau = ErrorGovernor(free.n_triangles // 2).select(table, view)
    assert found.n_triangles <= free.n_triangles // 2
    assert tau > 0.5
    assert ErrorGovernor(free.n_triangles).select(table, view)[1] == 0.5


def test_slow_frames_raise_tau_and_fast_ones_lower_it_to_what_was_asked():
    governor = ErrorGovernor(1000, target_ms=10)
    for _ in range(20):
        governor.after_frame(40)
    assert governor.factor > 4
    for _ in range(200):
        governor.after_frame(2)
    assert governor.factor == 1.0


@given(sizes=st.lists(st.integers(0, 40), max_size=60), seed=st.integers(0, 9))
def test_an_arena_never_hands_out_an_item_twice(sizes, seed):
    rng = np.random.default_rng(seed)
    arena, taken = Arena(256), []
    for size in sizes:
        start = arena.take(size)
        if start is None:
            assert arena.used + size > 128  # 256 items in at most 60 pieces are not that broken up
        elif size:
            assert not any(start < s + n and s < start + size for s, n in taken)
            assert start + size <= arena.capacity
            taken.append((start, size))
        if taken and rng.random() < 0.4:
            arena.give_back(*taken.pop(rng.integers(len(taken))))
        assert arena.used == sum(n for _, n in taken)
    for part in taken:
        arena.give_back(*part)
    assert arena.take(256) == 0
    arena.give_back(0, 256)
    arena.grow(512)
    assert arena.take(512) == 0


def test_a_table_forgets_what_nobody_needs_and_gives_its_numbers_to_others():
    rng = np.random.default_rng(17)
    table = random_tree(rng, share_resident=0.2)
    pieces, n = list(table.pieces), len(table)
    resident = {pieces[node] for node in np.flatnonzero(table.is_resident[:n])}
    used = rng.choice(n, 9, replace=False).astype(np.int32)
    needed = resident | {pieces[node] for node in used}
    parent_of = {pieces[k]: pieces[p] if p >= 0 else None for k, p in enumerate(table.parents[:n])}

    def has_needed(piece):
        return piece in needed or any(has_needed(c) for c, p in parent_of.items() if p == piece)

    # By the definition: children go together, with those below them.
    opened = {p for p in pieces if p in resident or any(
        has_needed(child) for child, parent in parent_of.items() if parent == p
    )}  # fmt: skip
    kept = {piece for piece in pieces if parent_of[piece] is None or parent_of[piece] in opened}
    assert 20 < len(kept) < n - 20

    def errors():
        return {p: table.errors[k] for p in kept if (k := table.find(p)) is not None}

    before = errors()
    table.forget_children([used])
    assert table.n_known == len(kept)
    assert {piece for piece in pieces if table.find(piece) is not None} == kept
    assert errors() == before
    for piece in kept:
        children = table.children[table.find(piece)]
        own = {table.pieces[child] for child in children[children >= 0]}
        assert own == {c for c, p in parent_of.items() if p == piece and piece in opened}
    assert len(table.coarse_nodes(1 << 20)) == len(kept)
    table.forget_children([used])
    assert table.n_known == len(kept)
    # Others come in their place, not known further and not in the store.
    leaf = next(node for node in range(n) if table.find(table.pieces[node]) == node
                and not table.is_known[node])  # fmt: skip
    infos = [NodeInfo(Piece(9, k, 0), (0, 0, 0), (1, 1, 1), 1.0, 1.0) for k in range(4)]
    table.add_children(leaf, infos)
    assert len(table) == n
    new = table.children[leaf]
    assert (table.parents[new] == leaf).all()
    assert not table.is_resident[new].any()
    assert not table.is_known[new].any()
    assert (table.children[new] == -1).all()
    assert (table.n_triangles[new] == 0).all()
