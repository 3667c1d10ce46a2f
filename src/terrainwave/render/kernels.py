"""Kernels of selection and of building patches. They stand in one file: they share constants."""

import numpy as np

from terrainwave.coding.jit import kernel

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
def oriented_distance(eye, direction, low_x, low_y, low_z, high_x, high_y, high_z):
    """Return a d for which γ · e / d bounds all vertical steps of length e in a box on screen.

    `direction` is that of the view, a unit vector, and γ / f, f the focal length.

    Yusov 2006, §3.3, weighs errors with the sine of the angle between the ray and the vertical;
    here so that it holds for any step and point. Let p be a point and q = p + s ẑ, |s| <= e, both
    in the box and in the picture, relative to the eye, and p' = p / p_D, q' = q / q_D on the plane
    at depth 1. The triangle (eye, p', q') has the area ½ |p' × q'|, and ½ |p' − q'| times the
    distance of the line through p' and q' from the eye, which is >= 1: so

        |p' − q'| <= |p' × q'| = |p × q| / (p_D q_D) = |s| h / (p_D q_D),

    h being the horizontal distance of both from the eye. That bounds it twice. No depth is less
    than the box's least, z, nor h more than its largest: f |s| h / z². And no depth is less than
    |p| / S, S the largest distance / depth in view, of which γ >= f S²: γ |s| h / (|p| |q|), which
    is at most γ |s| times the maximum of h / (h² + v²) over the box, v its least vertical
    distance: it grows up to h = v, then sinks. The latter is never more than 1 / the distance to
    the box, and both are nothing straight below or above.
    """
    x = max(low_x - eye[0], 0.0, eye[0] - high_x)
    y = max(low_y - eye[1], 0.0, eye[1] - high_y)
    v = max(low_z - eye[2], 0.0, eye[2] - high_z)
    far_x = max(abs(low_x - eye[0]), abs(high_x - eye[0]))
    far_y = max(abs(low_y - eye[1]), abs(high_y - eye[1]))
    furthest = np.sqrt(far_x * far_x + far_y * far_y)
    h = min(max(v, np.sqrt(x * x + y * y)), furthest)
    if h <= 0:
        return np.inf if v > 0 else 0.0
    depth = direction[0] * ((low_x if direction[0] > 0 else high_x) - eye[0])
    depth += direction[1] * ((low_y if direction[1] > 0 else high_y) - eye[1])
    depth += direction[2] * ((low_z if direction[2] > 0 else high_z) - eye[2])
    depth = max(depth, 0.0)
    return max(h + v * (v / h), direction[3] * depth * (depth / furthest))


@kernel
def box_distances(low, high, eye, direction):
    """Return the distances of boxes, `low` and `high` (n, 3), as `_screen_error` takes them."""
    out = np.empty(low.shape[0])
    for k in range(out.shape[0]):
        if direction[3] > 0:
            out[k] = oriented_distance(
                eye, direction, low[k, 0], low[k, 1], low[k, 2], high[k, 0], high[k, 1], high[k, 2]
            )
        else:
            out[k] = _distance(
                eye, low[k, 0], low[k, 1], low[k, 2], high[k, 0], high[k, 1], high[k, 2]
            )
    return out


@kernel
def _screen_error(node, low, high, errors, z_scale, eye, gamma, direction):
    """Return a bound of a node's error on screen, pixels; inf where the eye is in its box.

    `direction` is that of `oriented_distance`, or all 0: then it is γ · error / distance.
    """
    error = errors[node] * z_scale
    if error <= 0:
        return 0.0
    if direction[3] > 0:
        distance = oriented_distance(
            eye,
            direction,
            low[node, 0],
            low[node, 1],
            low[node, 2] * z_scale,
            high[node, 0],
            high[node, 1],
            high[node, 2] * z_scale,
        )
    else:
        distance = _node_distance(node, low, high, z_scale, eye)
    return gamma * error / distance if distance > 0 else np.inf


@kernel
def select_nodes(
    roots,
    low,
    high,
    errors,
    children,
    is_known,
    is_resident,
    n_triangles,
    planes,
    eye,
    z_scale,
    gamma,
    direction,
    tau,
    stack,
    out_nodes,
    out_distances,
):
    """Fill the nodes to draw and their distances; return (their number, their triangles).

    A node is split while its error on screen exceeds `tau` and all of its children in view are
    resident: else it stands in for them. `stack`, `out_nodes` and `out_distances` hold as many
    entries as there are nodes.
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
        is_split = is_known[node] and (
            _screen_error(node, low, high, errors, z_scale, eye, gamma, direction) > tau
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
    children,
    is_known,
    planes,
    eye,
    z_scale,
    gamma,
    direction,
    tau,
    out_nodes,
):
    """Fill the nodes in view that are needed, breadth first; return their number.

    Zhang et al. 2012, §4.2: the roots in view in the order given, then children in view, until
    `out_nodes` is full. Unlike there, children whose parent is good enough are left out; tau < 0
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
        if _screen_error(node, low, high, errors, z_scale, eye, gamma, direction) <= tau:
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
def rasterize(rows, cols, heights, triangles, factor, first_row, first_col, out):
    """Fill `out`, float64, with a mesh's heights at places of a grid, NaN where it has none.

    Place (r, c) of `out` is (first_row + r, first_col + c) in units of which a vertex's row and
    column count `factor` each.
    """
    n_rows, n_cols = out.shape
    out[:] = np.nan
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
                if weight_1 >= 0 and weight_2 >= 0 and weight_1 + weight_2 <= area:
                    out[row, col] = z_0 + (weight_1 * rise_1 + weight_2 * rise_2) / area
                weight_1 += step_1
                weight_2 += step_2


@kernel
def slopes(heights, mask, first_row, first_col, out):
    """Fill `out`, float32 (n_rows, n_cols, 2), with differences per column and per row.

    Central where both neighbours are valid, one-sided where one is, else 0. `out` covers the
    samples of `heights` from (first_row, first_col); its rest around them is the apron.
    """
    n_rows, n_cols = heights.shape
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            row, col = first_row + r, first_col + c
            out[r, c, 0] = 0.0
            out[r, c, 1] = 0.0
            if not mask[row, col]:
                continue
            here = float(heights[row, col])
            low, high, n = here, here, 0
            if col > 0 and mask[row, col - 1]:
                low = float(heights[row, col - 1])
                n += 1
            if col + 1 < n_cols and mask[row, col + 1]:
                high = float(heights[row, col + 1])
                n += 1
            if n > 0:
                out[r, c, 0] = (high - low) / n
            low, high, n = here, here, 0
            if row > 0 and mask[row - 1, col]:
                low = float(heights[row - 1, col])
                n += 1
            if row + 1 < n_rows and mask[row + 1, col]:
                high = float(heights[row + 1, col])
                n += 1
            if n > 0:
                out[r, c, 1] = (high - low) / n


@kernel
def border_edges(rows, cols, triangles, last_row, last_col, out):
    """Fill the edges of triangles on the border of a block; return their number.

    `last_row` and `last_col` are those of the block in half samples. `out` is int32 (n, 2).
    """
    n_out = 0
    for t in range(triangles.shape[0]):
        for k in range(3):
            a, b = triangles[t, k], triangles[t, (k + 1) % 3]
            same_row = rows[a] == rows[b] and (rows[a] == 0 or rows[a] == last_row)
            same_col = cols[a] == cols[b] and (cols[a] == 0 or cols[a] == last_col)
            if (same_row or same_col) and n_out < out.shape[0]:
                out[n_out, 0] = a
                out[n_out, 1] = b
                n_out += 1
    return n_out
