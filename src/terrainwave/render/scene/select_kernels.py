"""Kernels of selection: visibility of nodes, and their errors on screen."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.jit import kernel
from terrainwave.render.scene.horizon import is_below

# Rows of a frustum: inward planes (x, y, z, w), a point is inside if x·p + w >= 0.
N_PLANES = 5


class NodeArrays(NamedTuple):
    """Arrays of nodes, by number: boxes and errors in metres, children or -1."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    errors: NDArray[np.float64]
    spacings: NDArray[np.float64]
    children: NDArray[np.int32]
    is_known: NDArray[np.bool_]


class Sight(NamedTuple):
    """View of nodes: fields as of `View` and its horizon, with the factor of heights."""

    planes: NDArray[np.float64]
    eye: NDArray[np.float64]
    z_scale: float
    lens: NDArray[np.float64]
    is_oriented: bool
    tolerance: NDArray[np.float64]
    slopes: NDArray[np.float64]
    aim: NDArray[np.float64]


@kernel
def is_outside(planes, low_x, low_y, low_z, high_x, high_y, high_z):
    """Return whether a box lies wholly behind one of the planes (false also for some outside)."""
    for k in range(planes.shape[0]):
        x, y, z = planes[k, 0], planes[k, 1], planes[k, 2]
        # The corner that lies furthest along the plane's normal.
        most = x * (high_x if x > 0 else low_x)
        most += y * (high_y if y > 0 else low_y)
        most += z * (high_z if z > 0 else low_z)
        if most + planes[k, 3] < 0:
            return True
    return False


@kernel
def _distance(eye, low_x, low_y, low_z, high_x, high_y, high_z):
    x = max(low_x - eye[0], 0.0, eye[0] - high_x)
    y = max(low_y - eye[1], 0.0, eye[1] - high_y)
    z = max(low_z - eye[2], 0.0, eye[2] - high_z)
    return np.sqrt(x * x + y * y + z * z)


@kernel
def _is_hidden(node, low, high, z_scale, planes, slopes, aim):
    if is_outside(
        planes, low[node, 0], low[node, 1], low[node, 2] * z_scale,
        high[node, 0], high[node, 1], high[node, 2] * z_scale,
    ):  # fmt: skip
        return True
    return is_below(
        slopes, aim, low[node, 0], low[node, 1], high[node, 0], high[node, 1],
        high[node, 2] * z_scale,
    )  # fmt: skip


@kernel
def _node_distance(node, low, high, z_scale, eye):
    return _distance(
        eye, low[node, 0], low[node, 1], low[node, 2] * z_scale,
        high[node, 0], high[node, 1], high[node, 2] * z_scale,
    )  # fmt: skip


@kernel
def oriented_distance(eye, low_x, low_y, low_z, high_x, high_y, high_z):
    """Return an effective distance of a box for vertical steps in it.

    Yusov 2006, §3.3, weighs errors with the sine of the angle between the ray and the vertical;
    here it holds for any step and point (`pixels_per_metre`): 1 / d is the maximum of h / (h² + v²)
    over the box, v its least vertical distance: it grows up to h = v, then falls. It is never more
    than 1 / the distance to the box, and 0 straight below or above.
    """
    x = max(low_x - eye[0], 0.0, eye[0] - high_x)
    y = max(low_y - eye[1], 0.0, eye[1] - high_y)
    v = max(low_z - eye[2], 0.0, eye[2] - high_z)
    far_x = max(abs(low_x - eye[0]), abs(high_x - eye[0]))
    far_y = max(abs(low_y - eye[1]), abs(high_y - eye[1]))
    h = min(max(v, np.sqrt(x * x + y * y)), np.sqrt(far_x * far_x + far_y * far_y))
    if h > 0:
        return h + v * (v / h)
    return np.inf if v > 0 else 0.0


# Fields of `View.lens`: pixels per unit of tangent, the largest (distance / depth)² in view, the
# largest K² there (see `pixels_per_metre`), the view's direction.
LENS_SCALE, LENS_SLANT, LENS_RISE, LENS_X, LENS_Y, LENS_Z = range(6)
# Pixels per metre that count as none.
LEAST_SCALE = 1e-12


@kernel
def pixels_per_metre(eye, low_x, low_y, low_z, high_x, high_y, high_z, lens, is_oriented):
    """Return a bound of pixels on screen per metre of vertical steps in a box.

    Let p be a point and q = p + s ẑ, |s| <= e, both in the box and in the picture, relative to the
    eye, and p' and q' their projections to the plane at depth 1, which is f pixels per unit. In the
    camera's axes ẑ is (u, sin φ), φ the pitch and u = (0, cos φ), so

        q' − p' = (s u − s p' sin φ) / q_D,    |q' − p'| = |s| K / q_D,    K = |u − p' sin φ|.

    K is the length of an affine function of p', hence convex, and largest at a corner of the box's
    projection: K² = 1 − 2 sin φ p_z / p_D + sin² φ (|p| / p_D)². Or it is the largest K of the
    picture's corners, if that is less. The depth q_D is at least that of the box's nearest corner,
    and at least d / S, d the distance of the box and S the largest distance / depth in view.

    Seen from above K is less than 1, as steps are seen from their end. That counts if oriented
    (Yusov 2006, §3.3, who weighs errors with the sine of the angle between ray and vertical). Then
    also K / (p_D q_D) <= S² h / (|p| |q|), whose maximum is in `oriented_distance`.

    If the lens has S = 1, it is the lens's γ over the distance.
    """
    distance = _distance(eye, low_x, low_y, low_z, high_x, high_y, high_z)
    if is_oriented:
        oriented = oriented_distance(eye, low_x, low_y, low_z, high_x, high_y, high_z)
    else:
        oriented = distance
    if oriented <= 0:
        return np.inf
    if lens[LENS_SLANT] <= 1.0:
        return lens[LENS_SCALE] / oriented
    x, y = (low_x + high_x) / 2 - eye[0], (low_y + high_y) / 2 - eye[1]
    z = (low_z + high_z) / 2 - eye[2]
    half_x, half_y, half_z = (high_x - low_x) / 2, (high_y - low_y) / 2, (high_z - low_z) / 2
    depth = x * lens[LENS_X] + y * lens[LENS_Y] + z * lens[LENS_Z]
    depth -= half_x * abs(lens[LENS_X]) + half_y * abs(lens[LENS_Y]) + half_z * abs(lens[LENS_Z])
    rise = lens[LENS_RISE]
    if depth > 0:
        rise = min(rise, _largest_rise(x, y, z, half_x, half_y, half_z, lens))
    if not is_oriented:
        rise = max(rise, 1.0)
    depth = max(depth, distance / np.sqrt(lens[LENS_SLANT]))
    least = np.sqrt(rise) / depth if depth > 0 else np.inf
    if is_oriented:
        least = min(least, lens[LENS_SLANT] / oriented)
    return lens[LENS_SCALE] * least


@kernel
def _largest_rise(x, y, z, half_x, half_y, half_z, lens):
    """Return the largest K² of a box before the eye, given by its centre and halves."""
    largest, sine = 0.0, lens[LENS_Z]
    for k in range(8):
        p_x = x + (half_x if k & 1 else -half_x)
        p_y = y + (half_y if k & 2 else -half_y)
        p_z = z + (half_z if k & 4 else -half_z)
        depth = p_x * lens[LENS_X] + p_y * lens[LENS_Y] + p_z * lens[LENS_Z]
        square = (p_x * p_x + p_y * p_y + p_z * p_z) / (depth * depth)
        largest = max(largest, 1.0 - 2.0 * sine * p_z / depth + sine * sine * square)
    return largest


@kernel
def node_scale(node, low, high, z_scale, eye, lens, is_oriented):
    """Return pixels on screen per metre of a node's vertical error; inf if the eye is in it."""
    return pixels_per_metre(
        eye, low[node, 0], low[node, 1], low[node, 2] * z_scale,
        high[node, 0], high[node, 1], high[node, 2] * z_scale, lens, is_oriented,
    )  # fmt: skip


@kernel
def node_scales(asked, nodes, sight, out):
    """Fill `out` with the `node_scale` of each node of `asked`."""
    low, high, z_scale, eye = nodes.low, nodes.high, sight.z_scale, sight.eye
    lens, is_oriented = sight.lens, sight.is_oriented
    for k in range(asked.shape[0]):
        out[k] = node_scale(asked[k], low, high, z_scale, eye, lens, is_oriented)


@kernel
def _screen_error(node, low, high, errors, z_scale, eye, lens, is_oriented):
    """Return a bound of a node's error on screen, pixels; inf if the eye is in its box."""
    error = errors[node] * z_scale
    if error <= 0:
        return 0.0
    return error * node_scale(node, low, high, z_scale, eye, lens, is_oriented)


# Fields of `View.tolerance`: τ; the tolerance for sufficiently dense samples, both pixels; pixels
# per unit of tangent.
TOLERANCE_TAU, TOLERANCE_DENSE, TOLERANCE_LENGTH = range(3)


@kernel
def is_fine(node, low, high, errors, spacings, z_scale, eye, lens, is_oriented, tolerance):
    """Return whether a node need not be split: its error is within τ on screen.

    Or within the second tolerance, if its samples, seen squarely from the nearest point of its box,
    are no further apart than pixels.
    """
    error = _screen_error(node, low, high, errors, z_scale, eye, lens, is_oriented)
    if error <= tolerance[TOLERANCE_TAU]:
        return True
    if error > tolerance[TOLERANCE_DENSE]:
        return False
    pixels = spacings[node] * tolerance[TOLERANCE_LENGTH]
    return pixels <= _node_distance(node, low, high, z_scale, eye)


@kernel
def fine_nodes(asked, nodes, sight, out):
    """Fill `out` with whether each node of `asked` need not be split (`is_fine`)."""
    low, high, errors, spacings, _, _ = nodes
    _, eye, z_scale, lens, is_oriented, tolerance, _, _ = sight
    for k in range(asked.shape[0]):
        out[k] = is_fine(
            asked[k], low, high, errors, spacings, z_scale, eye, lens, is_oriented, tolerance
        )


@kernel
def select_nodes(roots, nodes, is_resident, n_triangles, sight, stack, out_nodes, out_distances):
    """Fill the nodes to draw and their distances; return (their number, their triangles).

    A node is split if it is not fine enough and all of its children in view are resident; otherwise
    it is drawn instead of them. `stack`, `out_nodes` and `out_distances` have as many entries as
    there are nodes.
    """
    low, high, errors, spacings, children, is_known = nodes
    planes, eye, z_scale, lens, is_oriented, tolerance, slopes, aim = sight
    n_out, total, top = 0, 0, 0
    for root in roots[::-1]:
        stack[top] = root
        top += 1
    while top > 0:
        top -= 1
        node = stack[top]
        if not is_resident[node] or _is_hidden(node, low, high, z_scale, planes, slopes, aim):
            continue
        first = top
        is_split = is_known[node] and not is_fine(
            node, low, high, errors, spacings, z_scale, eye, lens, is_oriented, tolerance
        )
        if is_split:
            has_children = False
            for k in range(4):
                child = children[node, k]
                if child < 0:
                    continue
                has_children = True
                if _is_hidden(child, low, high, z_scale, planes, slopes, aim):
                    continue
                if not is_resident[child]:
                    is_split = False
                    break
                stack[top] = child
                top += 1
            is_split = is_split and has_children
        if not is_split:
            top = first
            out_nodes[n_out] = node
            out_distances[n_out] = _node_distance(node, low, high, z_scale, eye)
            n_out += 1
            total += n_triangles[node]
    return n_out, total


@kernel
def wanted_nodes(roots, nodes, sight, out_nodes):
    """Fill the needed nodes in view, breadth first; return their number.

    Zhang et al. 2012, §4.2: the roots in view in the given order, then children in view, until
    `out_nodes` is full. Unlike there, children of a sufficiently fine parent are left out; τ < 0
    includes them all.
    """
    low, high, errors, spacings, children, is_known = nodes
    planes, eye, z_scale, lens, is_oriented, tolerance, slopes, aim = sight
    n_out, done = 0, 0
    for root in roots:
        if n_out < out_nodes.shape[0] and not _is_hidden(
            root, low, high, z_scale, planes, slopes, aim
        ):
            out_nodes[n_out] = root
            n_out += 1
    while done < n_out:
        node = out_nodes[done]
        done += 1
        if not is_known[node]:
            continue
        if is_fine(node, low, high, errors, spacings, z_scale, eye, lens, is_oriented, tolerance):
            continue
        for k in range(4):
            child = children[node, k]
            if child < 0 or n_out == out_nodes.shape[0]:
                continue
            if not _is_hidden(child, low, high, z_scale, planes, slopes, aim):
                out_nodes[n_out] = child
                n_out += 1
    return n_out


@kernel
def bounded_errors(drawn, nodes, morphs, parents, sight, start, end, out):
    """Fill `out`, float64 (n, 3), with share of the parent's surface, drawn error, allowed error.

    Metres, with exaggeration. The share is 0 if the parent's error on screen is `end` pixels, 1 if
    it is `start`. It is limited so that the drawn error, a block's own plus share · distance to the
    parent's surface, is within `end`; that surface may lie outside of the box.
    """
    low, high, errors, _, _, _ = nodes
    _, eye, z_scale, lens, is_oriented, _, _, _ = sight
    for k in range(drawn.shape[0]):
        node = drawn[k]
        own, spread = errors[node] * z_scale, morphs[node] * z_scale
        scale = pixels_per_metre(
            eye, low[node, 0], low[node, 1], low[node, 2] * z_scale - spread,
            high[node, 0], high[node, 1], high[node, 2] * z_scale + spread, lens, is_oriented,
        )  # fmt: skip
        allowed = end / max(scale, LEAST_SCALE)
        share, parent = 0.0, parents[node]
        if parent >= 0 and end > start:
            above = _screen_error(parent, low, high, errors, z_scale, eye, lens, is_oriented)
            share = min(max((end - above) / (end - start), 0.0), 1.0)
            if spread > 0:
                share = min(share, max(allowed - own, 0.0) / spread)
        out[k, 0], out[k, 1], out[k, 2] = share, own + share * spread, allowed


@kernel
def priorities(asked, nodes, sight, forward, out):
    """Fill w = u·V / d of each node: u and d towards its centre (Zhang et al. 2012, eq. 13)."""
    low, high, eye, z_scale = nodes.low, nodes.high, sight.eye, sight.z_scale
    for k in range(asked.shape[0]):
        node = asked[k]
        x = (low[node, 0] + high[node, 0]) / 2 - eye[0]
        y = (low[node, 1] + high[node, 1]) / 2 - eye[1]
        z = (low[node, 2] + high[node, 2]) / 2 * z_scale - eye[2]
        square = max(x * x + y * y + z * z, 1e-12)
        out[k] = (x * forward[0] + y * forward[1] + z * forward[2]) / square
