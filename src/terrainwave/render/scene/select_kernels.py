"""Kernels of selection: visibility of nodes, and their errors on screen.

A box is two corners: the lowest and the highest x, y and z.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.jit import inlined_kernel, kernel
from terrainwave.render.scene.horizon import is_below


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


@inlined_kernel
def _box_of(node, nodes, z_scale, spread):
    """Return a node's box with heights times `z_scale`, higher and lower by `spread`."""
    low, high = nodes.low, nodes.high
    return (
        (low[node, 0], low[node, 1], low[node, 2] * z_scale - spread),
        (high[node, 0], high[node, 1], high[node, 2] * z_scale + spread),
    )


@kernel
def is_outside(planes, low, high):
    """Return whether a box lies wholly behind one of the planes (false also for some outside).

    A plane is (x, y, z, w), inwards: a point is inside if x·p + w >= 0.
    """
    for k in range(planes.shape[0]):
        x, y, z = planes[k, 0], planes[k, 1], planes[k, 2]
        # The corner that lies furthest along the plane's normal.
        most = x * (high[0] if x > 0 else low[0])
        most += y * (high[1] if y > 0 else low[1])
        most += z * (high[2] if z > 0 else low[2])
        if most + planes[k, 3] < 0:
            return True
    return False


@inlined_kernel
def _away(eye, low, high):
    """Return the least distance of a box from the eye along each axis."""
    return (
        max(low[0] - eye[0], 0.0, eye[0] - high[0]),
        max(low[1] - eye[1], 0.0, eye[1] - high[1]),
        max(low[2] - eye[2], 0.0, eye[2] - high[2]),
    )


@inlined_kernel
def _distance(eye, low, high):
    x, y, z = _away(eye, low, high)
    return np.sqrt(x * x + y * y + z * z)


@inlined_kernel
def _is_hidden(node, nodes, sight):
    low, high = _box_of(node, nodes, sight.z_scale, 0.0)
    return is_outside(sight.planes, low, high) or is_below(
        sight.slopes, sight.aim, low[0], low[1], high[0], high[1], high[2]
    )


@kernel
def oriented_distance(eye, low, high):
    """Return an effective distance of a box for vertical steps in it.

    Yusov 2006, §3.3, weighs errors with the sine of the angle between the ray and the vertical;
    here it holds for any step and point (`pixels_per_metre`): 1 / d is the maximum of h / (h² + v²)
    over the box, v its least vertical distance: it grows up to h = v, then falls. It is never more
    than 1 / the distance to the box, and 0 straight below or above.
    """
    x, y, v = _away(eye, low, high)
    far_x = max(abs(low[0] - eye[0]), abs(high[0] - eye[0]))
    far_y = max(abs(low[1] - eye[1]), abs(high[1] - eye[1]))
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
def pixels_per_metre(eye, low, high, lens, is_oriented):
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
    distance = _distance(eye, low, high)
    oriented = oriented_distance(eye, low, high) if is_oriented else distance
    if oriented <= 0:
        return np.inf
    if lens[LENS_SLANT] <= 1.0:
        return lens[LENS_SCALE] / oriented
    x, y = (low[0] + high[0]) / 2 - eye[0], (low[1] + high[1]) / 2 - eye[1]
    z = (low[2] + high[2]) / 2 - eye[2]
    half_x, half_y, half_z = (high[0] - low[0]) / 2, (high[1] - low[1]) / 2, (high[2] - low[2]) / 2
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


@inlined_kernel
def _scale_of(node, nodes, sight, spread):
    """Return pixels on screen per metre of a node's vertical error; inf if the eye is in it."""
    low, high = _box_of(node, nodes, sight.z_scale, spread)
    return pixels_per_metre(sight.eye, low, high, sight.lens, sight.is_oriented)


@kernel
def node_scales(asked, nodes, sight, out):
    """Fill `out` with pixels on screen per metre of each node of `asked`."""
    nodes, sight = borrowed(nodes), borrowed(sight)
    for k in range(asked.shape[0]):
        out[k] = _scale_of(asked[k], nodes, sight, 0.0)


@inlined_kernel
def _screen_error(node, nodes, sight):
    """Return a bound of a node's error on screen, pixels; inf if the eye is in its box."""
    error = nodes.errors[node] * sight.z_scale
    return error * _scale_of(node, nodes, sight, 0.0) if error > 0 else 0.0


# Fields of `Sight.tolerance`: τ; the tolerance for sufficiently dense samples, both pixels; pixels
# per unit of tangent.
TOLERANCE_TAU, TOLERANCE_DENSE, TOLERANCE_LENGTH = range(3)


@inlined_kernel
def _node_distance(node, nodes, sight):
    low, high = _box_of(node, nodes, sight.z_scale, 0.0)
    return _distance(sight.eye, low, high)


@kernel
def is_fine(node, nodes, sight):
    """Return whether a node need not be split: its error is within τ on screen.

    Or within the second tolerance, if its samples, seen squarely from the nearest point of its box,
    are no further apart than pixels.
    """
    error = _screen_error(node, nodes, sight)
    if error <= sight.tolerance[TOLERANCE_TAU]:
        return True
    if error > sight.tolerance[TOLERANCE_DENSE]:
        return False
    pixels = nodes.spacings[node] * sight.tolerance[TOLERANCE_LENGTH]
    return pixels <= _node_distance(node, nodes, sight)


@kernel
def fine_nodes(asked, nodes, sight, out):
    """Fill `out` with whether each node of `asked` need not be split (`is_fine`)."""
    nodes, sight = borrowed(nodes), borrowed(sight)
    for k in range(asked.shape[0]):
        out[k] = is_fine(asked[k], nodes, sight)


@kernel
def select_nodes(roots, nodes, is_resident, n_triangles, sight, stack, out_nodes, out_distances):
    """Fill the nodes to draw and their distances; return (their number, their triangles).

    A node is split if it is not fine enough and all of its children in view are resident; otherwise
    it is drawn instead of them. `stack`, `out_nodes` and `out_distances` have as many entries as
    there are nodes.
    """
    nodes, sight = borrowed(nodes), borrowed(sight)
    n_out, total, top = 0, 0, 0
    for root in roots[::-1]:
        stack[top] = root
        top += 1
    while top > 0:
        top -= 1
        node = stack[top]
        if not is_resident[node] or _is_hidden(node, nodes, sight):
            continue
        first = top
        is_split = nodes.is_known[node] and not is_fine(node, nodes, sight)
        if is_split:
            has_children = False
            for k in range(4):
                child = nodes.children[node, k]
                if child < 0:
                    continue
                has_children = True
                if _is_hidden(child, nodes, sight):
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
            out_distances[n_out] = _node_distance(node, nodes, sight)
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
    nodes, sight = borrowed(nodes), borrowed(sight)
    n_out, done = 0, 0
    for root in roots:
        if n_out < out_nodes.shape[0] and not _is_hidden(root, nodes, sight):
            out_nodes[n_out] = root
            n_out += 1
    while done < n_out:
        node = out_nodes[done]
        done += 1
        if not nodes.is_known[node] or is_fine(node, nodes, sight):
            continue
        for k in range(4):
            child = nodes.children[node, k]
            if child < 0 or n_out == out_nodes.shape[0]:
                continue
            if not _is_hidden(child, nodes, sight):
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
    nodes, sight = borrowed(nodes), borrowed(sight)
    for k in range(drawn.shape[0]):
        node = drawn[k]
        own, spread = nodes.errors[node] * sight.z_scale, morphs[node] * sight.z_scale
        allowed = end / max(_scale_of(node, nodes, sight, spread), LEAST_SCALE)
        share, parent = 0.0, parents[node]
        if parent >= 0 and end > start:
            above = _screen_error(parent, nodes, sight)
            share = min(max((end - above) / (end - start), 0.0), 1.0)
            if spread > 0:
                share = min(share, max(allowed - own, 0.0) / spread)
        out[k, 0], out[k, 1], out[k, 2] = share, own + share * spread, allowed
