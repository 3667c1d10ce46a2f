"""Kernels of selection and of building patches. They stand in one file: they share constants."""

import numpy as np

from terrainwave.coding.jit import inlined_kernel, kernel

# Rows of a frustum: inward planes (x, y, z, w), a point is inside where x·p + w >= 0.
N_PLANES = 5
SKIRT_FLAG = 1 << 15


@kernel
def is_outside(planes, low_x, low_y, low_z, high_x, high_y, high_z):
    """Say whether a box lies wholly behind one of the planes (false also for some outside)."""
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
def _is_hidden(node, low, high, z_scale, planes):
    return is_outside(
        planes,
        low[node, 0],
        low[node, 1],
        low[node, 2] * z_scale,
        high[node, 0],
        high[node, 1],
        high[node, 2] * z_scale,
    )


@kernel
def _node_distance(node, low, high, z_scale, eye):
    return _distance(
        eye,
        low[node, 0],
        low[node, 1],
        low[node, 2] * z_scale,
        high[node, 0],
        high[node, 1],
        high[node, 2] * z_scale,
    )


@kernel
def oriented_distance(eye, low_x, low_y, low_z, high_x, high_y, high_z):
    """Return a d to be taken for the distance of a box as to vertical steps in it.

    Yusov 2006, §3.3, weighs errors with the sine of the angle between the ray and the vertical;
    here so that it holds for any step and point (`pixels_per_metre`): 1 / d is the maximum of
    h / (h² + v²) over the box, v its least vertical distance: it grows up to h = v, then sinks.
    It is never more than 1 / the distance to the box, and nothing straight below or above.
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


# What `View.lens` holds: pixels per unit of tangent, the largest (distance / depth)² in view, the
# largest K² there (see `pixels_per_metre`), the view's direction.
LENS_SCALE, LENS_SLANT, LENS_STEP, LENS_X, LENS_Y, LENS_Z = range(6)
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
    (Yusov 2006, §3.3, who weighs errors with the sine of the angle between ray and vertical); and
    then also K / (p_D q_D) <= S² h / (|p| |q|), whose maximum `oriented_distance` has.

    Where the lens has S = 1 it is the lens's γ over the distance.
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
    step = lens[LENS_STEP]
    if depth > 0:
        step = min(step, _largest_step(x, y, z, half_x, half_y, half_z, lens))
    if not is_oriented:
        step = max(step, 1.0)
    depth = max(depth, distance / np.sqrt(lens[LENS_SLANT]))
    least = np.sqrt(step) / depth if depth > 0 else np.inf
    if is_oriented:
        least = min(least, lens[LENS_SLANT] / oriented)
    return lens[LENS_SCALE] * least


@kernel
def _largest_step(x, y, z, half_x, half_y, half_z, lens):
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
    """Return pixels on screen per metre of a node's vertical error; inf where the eye is in it."""
    return pixels_per_metre(
        eye,
        low[node, 0],
        low[node, 1],
        low[node, 2] * z_scale,
        high[node, 0],
        high[node, 1],
        high[node, 2] * z_scale,
        lens,
        is_oriented,
    )


@kernel
def node_scales(nodes, low, high, z_scale, eye, lens, is_oriented, out):
    """Fill `out` with the `node_scale` of each node."""
    for k in range(nodes.shape[0]):
        out[k] = node_scale(nodes[k], low, high, z_scale, eye, lens, is_oriented)


@kernel
def _screen_error(node, low, high, errors, z_scale, eye, lens, is_oriented):
    """Return a bound of a node's error on screen, pixels; inf where the eye is in its box."""
    error = errors[node] * z_scale
    if error <= 0:
        return 0.0
    return error * node_scale(node, low, high, z_scale, eye, lens, is_oriented)


# What `View.tolerance` holds: τ; what is let be where samples are dense enough, both pixels; pixels
# per unit of tangent.
TOLERANCE_TAU, TOLERANCE_DENSE, TOLERANCE_LENGTH = range(3)


@kernel
def is_fine(node, low, high, errors, spacings, z_scale, eye, lens, is_oriented, tolerance):
    """Say whether a node need not be split: its error is within τ on screen.

    Or within the second tolerance, and its samples, seen squarely from the nearest place of its
    box, are no further apart than pixels.
    """
    error = _screen_error(node, low, high, errors, z_scale, eye, lens, is_oriented)
    if error <= tolerance[TOLERANCE_TAU]:
        return True
    if error > tolerance[TOLERANCE_DENSE]:
        return False
    pixels = spacings[node] * tolerance[TOLERANCE_LENGTH]
    return pixels <= _node_distance(node, low, high, z_scale, eye)


@kernel
def fine_nodes(nodes, low, high, errors, spacings, z_scale, eye, lens, is_oriented, tolerance, out):
    """Fill `out` with whether each node need not be split (`is_fine`)."""
    for k in range(nodes.shape[0]):
        out[k] = is_fine(
            nodes[k], low, high, errors, spacings, z_scale, eye, lens, is_oriented, tolerance
        )


@kernel
def select_nodes(
    roots,
    low,
    high,
    errors,
    spacings,
    children,
    is_known,
    is_resident,
    n_triangles,
    planes,
    eye,
    z_scale,
    lens,
    is_oriented,
    tolerance,
    stack,
    out_nodes,
    out_distances,
):
    """Fill the nodes to draw and their distances; return (their number, their triangles).

    A node is split while it is not fine enough and all of its children in view are resident: else
    it stands in for them. `stack`, `out_nodes` and `out_distances` hold as many entries as there
    are nodes.
    """
    n_out, total, top = 0, 0, 0
    for root in roots[::-1]:
        stack[top] = root
        top += 1
    while top > 0:
        top -= 1
        node = stack[top]
        if not is_resident[node] or _is_hidden(node, low, high, z_scale, planes):
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
                if _is_hidden(child, low, high, z_scale, planes):
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
def wanted_nodes(
    roots,
    low,
    high,
    errors,
    spacings,
    children,
    is_known,
    planes,
    eye,
    z_scale,
    lens,
    is_oriented,
    tolerance,
    out_nodes,
):
    """Fill the nodes in view that are needed, breadth first; return their number.

    Zhang et al. 2012, §4.2: the roots in view in the order given, then children in view, until
    `out_nodes` is full. Unlike there, children whose parent is good enough are left out; τ < 0
    takes them all.
    """
    n_out, done = 0, 0
    for root in roots:
        if n_out < out_nodes.shape[0] and not _is_hidden(root, low, high, z_scale, planes):
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
            if not _is_hidden(child, low, high, z_scale, planes):
                out_nodes[n_out] = child
                n_out += 1
    return n_out


@kernel
def bounded_errors(
    nodes,
    low,
    high,
    errors,
    morphs,
    parents,
    z_scale,
    eye,
    lens,
    is_oriented,
    start,
    end,
    out,
):
    """Fill `out`, float64 (n, 3), with share of the parent's surface, error drawn, error allowed.

    Metres, with exaggeration. The share is 0 where the parent's error on screen is `end` pixels, 1
    where it is `start`, and no more than leaves the error drawn, a block's own and share ·
    distance to the parent's surface, within `end`; that surface may lie outside of the box.
    """
    for k in range(nodes.shape[0]):
        node = nodes[k]
        own, spread = errors[node] * z_scale, morphs[node] * z_scale
        scale = pixels_per_metre(
            eye,
            low[node, 0],
            low[node, 1],
            low[node, 2] * z_scale - spread,
            high[node, 0],
            high[node, 1],
            high[node, 2] * z_scale + spread,
            lens,
            is_oriented,
        )
        allowed = end / max(scale, LEAST_SCALE)
        share, parent = 0.0, parents[node]
        if parent >= 0 and end > start:
            above = _screen_error(parent, low, high, errors, z_scale, eye, lens, is_oriented)
            share = min(max((end - above) / (end - start), 0.0), 1.0)
            if spread > 0:
                share = min(share, max(allowed - own, 0.0) / spread)
        out[k, 0], out[k, 1], out[k, 2] = share, own + share * spread, allowed


@kernel
def priorities(nodes, low, high, z_scale, eye, forward, out):
    """Fill w = u·V / d of each node: u and d towards its centre (Zhang et al. 2012, eq. 13)."""
    for k in range(nodes.shape[0]):
        node = nodes[k]
        x = (low[node, 0] + high[node, 0]) / 2 - eye[0]
        y = (low[node, 1] + high[node, 1]) / 2 - eye[1]
        z = (low[node, 2] + high[node, 2]) / 2 * z_scale - eye[2]
        square = max(x * x + y * y + z * z, 1e-12)
        out[k] = (x * forward[0] + y * forward[1] + z * forward[2]) / square


@kernel
def surface_at(rows, cols, heights, triangles, factor, first_row, first_col, numbers, out):
    """Fill `out`, float64, with a mesh's heights at points of a grid; others stay as they are.

    `numbers`, int32, has the points: place (r, c), which is (first_row + r, first_col + c) in units
    of which a vertex's row and column count `factor` each, is point `numbers[r, c]`, or none where
    that is < 0.
    """
    n_rows, n_cols = numbers.shape
    for t in range(triangles.shape[0]):
        p_0, p_1, p_2 = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        row_0 = np.int64(rows[p_0]) * factor - first_row
        row_1 = np.int64(rows[p_1]) * factor - first_row
        row_2 = np.int64(rows[p_2]) * factor - first_row
        top, bottom = max(min(row_0, row_1, row_2), 0), min(max(row_0, row_1, row_2), n_rows - 1)
        if top > bottom:
            continue
        col_0 = np.int64(cols[p_0]) * factor - first_col
        col_1 = np.int64(cols[p_1]) * factor - first_col
        col_2 = np.int64(cols[p_2]) * factor - first_col
        left, right = max(min(col_0, col_1, col_2), 0), min(max(col_0, col_1, col_2), n_cols - 1)
        area = (col_1 - col_0) * (row_2 - row_0) - (col_2 - col_0) * (row_1 - row_0)
        if left > right or area <= 0:
            continue
        z_0 = float(heights[p_0])
        rise_1, rise_2 = float(heights[p_1]) - z_0, float(heights[p_2]) - z_0
        step_1, step_2 = row_2 - row_0, row_0 - row_1
        for row in range(top, bottom + 1):
            weight_1 = (left - col_0) * (row_2 - row_0) - (col_2 - col_0) * (row - row_0)
            weight_2 = (col_1 - col_0) * (row - row_0) - (left - col_0) * (row_1 - row_0)
            for col in range(left, right + 1):
                # All three weights are >= 0.
                if (weight_1 | weight_2 | (area - weight_1 - weight_2)) >= 0:
                    number = numbers[row, col]
                    if number >= 0:
                        out[number] = z_0 + (weight_1 * rise_1 + weight_2 * rise_2) / area
                weight_1 += step_1
                weight_2 += step_2


@kernel
def bilinear_at(rows, cols, heights, mask, first_row, first_col, fallback, out):
    """Fill `out`, float64, with heights of a coarser level at vertices, between its samples.

    Parameters
    ----------
    rows, cols : ndarray of int32, shape (n,)
        Of vertices, in half samples of their level from their block's first.
    heights, mask : ndarray, 2-D
        Samples of the level above it, from the sample at that place on. Past their sides the last
        two go on linearly.
    first_row, first_col : int
        Half samples from there to the block's first.
    fallback : ndarray of float64, shape (n,)
        What is taken beside voids.
    """
    last_row, last_col = max(heights.shape[0] - 2, 0), max(heights.shape[1] - 2, 0)
    step_row, step_col = min(heights.shape[0] - 1, 1), min(heights.shape[1] - 1, 1)
    for k in range(rows.shape[0]):
        at_row, at_col = rows[k] + first_row, cols[k] + first_col
        row, col = min(at_row >> 2, last_row), min(at_col >> 2, last_col)
        down, right = (at_row - 4 * row) / 4, (at_col - 4 * col) / 4
        below, beside = row + step_row, col + step_col
        if mask[row, col] and mask[row, beside] and mask[below, col] and mask[below, beside]:
            upper = heights[row, col] * (1 - right) + heights[row, beside] * right
            lower = heights[below, col] * (1 - right) + heights[below, beside] * right
            out[k] = upper * (1 - down) + lower * down
        else:
            out[k] = fallback[k]


@kernel
def fill_texels(heights, mask, first_row, first_col, n_rows, n_cols, slopes_of, colors_of, out):
    """Fill `out` with slopes to the east and north and heights to colour by, as float16.

    Parameters
    ----------
    heights, mask : ndarray, 2-D
        Samples around a block.
    first_row, first_col, n_rows, n_cols : int
        The part of them that `out` begins with may reach past all sides of it: place (r, c) is
        sample (first_row + r, first_col + c), or the nearest one of the `n_rows` x `n_cols` from
        (max(first_row, 0), max(first_col, 0)) on.
    slopes_of : ndarray of float64, shape (5,)
        Slopes are ``(a c + b r, d c + e r)`` of differences per column c and row r, 0 below the
        fifth.
    colors_of : ndarray of float64, shape (3,)
        Of heights: factor, shift, and what is the most.
    out : ndarray of uint16, shape (m, 3 n)
        Bits of float16; what is below 2⁻¹⁴ is 0.
    """
    texels = np.empty(out.shape[1], dtype=np.float32)
    bits = texels.view(np.uint32)
    is_valid = mask.all()
    a, b, d, e, least = slopes_of
    factor, shift, most = colors_of
    low_row, low_col = max(first_row, 0), max(first_col, 0)
    last_row, last_col = heights.shape[0] - 1, heights.shape[1] - 1
    for r in range(out.shape[0]):
        row = min(max(first_row + r, low_row), low_row + n_rows - 1)
        above, below = max(row - 1, 0), min(row + 1, last_row)
        for c in range(out.shape[1] // 3):
            col = min(max(first_col + c, low_col), low_col + n_cols - 1)
            left, right = max(col - 1, 0), min(col + 1, last_col)
            across, down = 0.0, 0.0
            if is_valid:
                height = float(heights[row, col]) * factor + shift
                if right > left:
                    across = (float(heights[row, right]) - float(heights[row, left])) / (
                        right - left
                    )
                if below > above:
                    down = (float(heights[below, col]) - float(heights[above, col])) / (
                        below - above
                    )
            elif mask[row, col]:
                height = float(heights[row, col]) * factor + shift
                across = _difference(heights, mask, row, left, row, col, row, right)
                down = _difference(heights, mask, above, col, row, col, below, col)
            else:
                height = _mean_around(heights, mask, row, col, factor, shift)
            east, north = a * across + b * down, d * across + e * down
            texels[3 * c] = min(max(east, -most), most) if abs(east) >= least else 0.0
            texels[3 * c + 1] = min(max(north, -most), most) if abs(north) >= least else 0.0
            texels[3 * c + 2] = min(max(height, -most), most)
        for k in range(out.shape[1]):
            out[r, k] = _half(bits[k])


@inlined_kernel
def _half(bits):
    """Return the bits of a float16, rounded to even, of a float32's; below 2⁻¹⁴ that is 0."""
    whole = np.int64(bits)
    magnitude = whole & 0x7FFFFFFF
    if magnitude < 0x38800000:
        return np.uint16(0)
    rounded = (magnitude + 0x0FFF + ((magnitude >> 13) & 1)) >> 13
    return np.uint16((rounded - 0x1C000) | ((whole >> 16) & 0x8000))


@kernel
def _difference(heights, mask, row_0, col_0, row, col, row_1, col_1):
    """Return the difference per sample over a valid one: central, one-sided, or 0."""
    low = high = float(heights[row, col])
    n = 0
    if (row_0 != row or col_0 != col) and mask[row_0, col_0]:
        low = float(heights[row_0, col_0])
        n += 1
    if (row_1 != row or col_1 != col) and mask[row_1, col_1]:
        high = float(heights[row_1, col_1])
        n += 1
    return (high - low) / n if n else 0.0


@kernel
def _mean_around(heights, mask, row, col, factor, shift):
    """Return the mean of valid samples around a void one, so that colours don't change beside it.

    Samples past the side count as those at it; 0 where none is valid.
    """
    total, n = 0.0, 0
    for r in range(row - 1, row + 2):
        for c in range(col - 1, col + 2):
            at = min(max(r, 0), heights.shape[0] - 1), min(max(c, 0), heights.shape[1] - 1)
            if mask[at]:
                total += float(heights[at]) * factor + shift
                n += 1
    return total / n if n else 0.0


@kernel
def border_edges(rows, cols, triangles, last_row, last_col, lower, edges):
    """Fill the edges of triangles on the border of a block; return their number and ends'.

    `last_row` and `last_col` are those of the block in half samples. `edges` is int32 (n, 2),
    `lower`, of each vertex, is filled with its number among the ends of edges, -1 elsewhere.
    """
    n_edges, n_ends = 0, 0
    for v in range(rows.shape[0]):
        is_border = rows[v] == 0 or rows[v] == last_row or cols[v] == 0 or cols[v] == last_col
        lower[v] = -1 if is_border else -2
    for t in range(triangles.shape[0]):
        for k in range(3):
            a = triangles[t, k]
            if lower[a] == -2:
                continue
            b = triangles[t, (k + 1) % 3]
            if lower[b] == -2:
                continue
            same_row = rows[a] == rows[b] and (rows[a] == 0 or rows[a] == last_row)
            same_col = cols[a] == cols[b] and (cols[a] == 0 or cols[a] == last_col)
            if (same_row or same_col) and n_edges < edges.shape[0]:
                edges[n_edges, 0] = a
                edges[n_edges, 1] = b
                n_edges += 1
                for end in (a, b):
                    if lower[end] == -1:
                        lower[end] = n_ends
                        n_ends += 1
    return n_edges, n_ends
