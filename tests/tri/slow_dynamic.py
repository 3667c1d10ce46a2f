"""The dynamic triangulation, slow and obvious. Never imported by src."""

import math
from collections import Counter

import numpy as np

from terrainwave.render.scene.camera import Camera, Viewport, project
from terrainwave.render.scene.frustum import frustum_planes
from terrainwave.tri.dynamic.dynamic import screen_error
from terrainwave.tri.dynamic.haar import N_ROWS
from terrainwave.tri.followed import Eye

VIEWPORT = Viewport(320, 240)
NORTH_UP = (1.0, 0.0, 0.0, 0.0, -1.0, 0.0)


def eye_of(camera, z_scale=1.0):
    tangent = math.tan(math.radians(camera.fov) / 2)
    slant = math.sqrt(1 + tangent**2 * (1 + VIEWPORT.aspect**2))
    planes = frustum_planes(camera, VIEWPORT)
    return Eye(camera.eye, camera.forward, planes, VIEWPORT.height / 2 / tangent, slant, z_scale)


def random_camera(rng, shape, pixel=1.0, low=0.0, high=40.0):
    """A camera above or beside a north-up raster whose first sample lies at 0, 0."""
    x, y = rng.uniform(-0.2, 1.2, 2) * (shape[1] * pixel, -shape[0] * pixel)
    z = high + rng.uniform(-0.5, 1.5) * (high - low)
    heading = np.degrees(np.arctan2(shape[1] * pixel / 2 - x, -shape[0] * pixel / 2 - y))
    heading += rng.uniform(-40, 40)
    return Camera((x, y, z), heading % 360, rng.uniform(-85, 5), rng.uniform(25, 90))


def cameras(shape, n, seed=1):
    """Cameras anywhere around a raster of 1 m."""
    rng = np.random.default_rng(seed)
    return [random_camera(rng, shape) for _ in range(n)]


def screen_errors(mesh, eye, height):
    """The errors on screen of all nodes of a height >= 1, pixels."""
    tree = mesh.tree
    errors = np.empty(tuple(tree.layout[height, N_ROWS:].tolist()))
    view = mesh._view(eye)
    for row, col in np.ndindex(errors.shape):
        errors[row, col] = screen_error(
            height, row, col, tree.layout, tree.z, tree.bounds, view, eye.planes
        )
    return errors


def roots_of_samples(mesh, eye, tau):
    """The root of each sample (§3.4): the highest node that is good enough, as all below it are."""
    top = mesh.tree.top
    is_good = {0: np.ones(tuple(mesh.tree.layout[0, 1:]), dtype=bool)}
    for height in range(1, top + 1):
        below = is_good[height - 1]
        children = [below[r::2, c::2] for r in (0, 1) for c in (0, 1)]
        good = screen_errors(mesh, eye, height) < tau
        is_good[height] = np.logical_and.reduce([good, *children])
    rows, cols = is_good[0].shape
    return {
        (r, c): max(
            (h, r >> h, c >> h) for h in range(top + 1) if is_good[h][r >> h, c >> h]
        )
        for r in range(rows)
        for c in range(cols)
    }  # fmt: skip


def snapped(roots, mask):
    """Triangles of the full grid whose samples have moved to their roots (§3.5.1), cyclic order."""
    found = Counter()
    for r in range(mask.shape[0] - 1):
        for c in range(mask.shape[1] - 1):
            ring = [(r, c), (r, c + 1), (r + 1, c + 1), (r + 1, c)]
            ring = [roots[p] for p in ring]
            for corners in _full_grid(ring, mask):
                if len(set(corners)) == 3:
                    found[turned(corners)] += 1
    return found


def _full_grid(ring, mask):
    """The two triangles of a quad, or the one of those corners that are not wholly void."""
    valid = [node for node in ring if not is_void(node, mask)]
    if len(valid) == 4:
        return [(ring[0], ring[1], ring[2]), (ring[0], ring[2], ring[3])]
    return [tuple(valid)] if len(valid) == 3 else []


def is_void(node, mask):
    height, row, col = node
    side = 1 << height
    return not mask[row * side : (row + 1) * side, col * side : (col + 1) * side].any()


def turned(corners):
    """The same triangle, its least corner first."""
    first = corners.index(min(corners))
    return corners[first:] + corners[:first]


def triangles_of(frame):
    """The triangles of a frame as nodes, least first, in the order of `snapped` (clockwise)."""
    nodes = [tuple(node) for node in frame.nodes.tolist()]
    return Counter(turned(tuple(nodes[v] for v in t[::-1])) for t in frame.triangles.tolist())


def areas(frame):
    a, b, c = (frame.vertices[frame.triangles[:, k], :2] for k in range(3))
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])


def surfaces_at(frame, x, y):
    """Heights of all triangles over a point."""
    a, b, c = (frame.vertices[frame.triangles[:, k]] for k in range(3))
    whole = areas(frame)
    with np.errstate(invalid="ignore", divide="ignore"):
        one = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (y - a[:, 1])) / whole
        two = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])) / whole
        is_inside = (one >= -1e-9) & (two >= -1e-9) & (one + two <= 1 + 1e-9)
    is_over = (np.abs(whole) > 1e-9) & is_inside
    one, two, a, b, c = (values[is_over] for values in (one, two, a, b, c))
    return a[:, 2] + one * (b[:, 2] - a[:, 2]) + two * (c[:, 2] - a[:, 2])


def drawn_samples(frame, shape):
    """Where the root of each sample is drawn; NaN for void ones."""
    found = np.full((*shape, 3), np.nan)
    for (height, row, col), place in zip(frame.nodes.tolist(), frame.vertices, strict=True):
        side = 1 << height
        found[row * side : (row + 1) * side, col * side : (col + 1) * side] = place
    return found


def pixel_errors(frame, heights, mask, camera, *, pixel=1.0, z_scale=1.0, every=1):
    """How far samples in view are on screen from the mesh: from what lies over or under them.

    Where nothing does, from the vertex they moved to. Only one of `every` samples is looked at.
    """
    rows, cols = (places[::every] for places in np.nonzero(mask))
    places = np.column_stack([cols * pixel, -rows * pixel, heights[rows, cols] * z_scale])
    seen = project(camera, VIEWPORT, places.astype(float))
    with np.errstate(invalid="ignore"):
        is_seen = (np.abs(seen[:, 0] - VIEWPORT.width / 2) <= VIEWPORT.width / 2) & (
            np.abs(seen[:, 1] - VIEWPORT.height / 2) <= VIEWPORT.height / 2
        )
    roots = drawn_samples(frame, mask.shape)
    errors = []
    for row, col, place, at in zip(
        rows[is_seen], cols[is_seen], places[is_seen], seen[is_seen], strict=True
    ):
        over = surfaces_at(frame, place[0], place[1])
        if not len(over):
            points = roots[row, col][None]
        else:
            points = np.column_stack([np.tile(place[:2], (len(over), 1)), over])
        apart = project(camera, VIEWPORT, points)[:, :2] - at[:2]
        errors.append(np.linalg.norm(apart, axis=1).max())
    return np.array(errors)
