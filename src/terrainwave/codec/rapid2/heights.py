"""Heights of a unit's planes: A made from the parent, the others predicted and settled.

Planes hold ``(height - origin) >> shift`` within ±LIMIT, whatever the heights are: all sums fit
32 bits, and a unit of any relief is coded by the same code. Heights themselves are exact.
"""

import numpy as np

from terrainwave.codec.corrections import corrected
from terrainwave.codec.rapid2.layout import HH, HL, LH, LIMIT, PAD, A
from terrainwave.coding.jit import kernel, kernel_part

_LIMIT = np.int32(LIMIT)
_TWO, _FOUR = np.int32(2), np.int32(4)
_TO_QUARTERS = np.int32(10)


@kernel_part
def _mirrored(number, n):
    """Return a place of 0 ... n - 1 by symmetry about the first and the last one."""
    if n == 1:
        return 0
    period = 2 * (n - 1)
    number %= period
    return min(number, period - number)


@kernel
def load_parent(parent, shape, origin, shift, low, high, planes):
    """Fill plane A, with PAD samples outside by symmetry of the lattice of `shape`."""
    n_rows, n_cols = (shape[0] + 1) // 2, (shape[1] + 1) // 2
    for row in range(-PAD, n_rows + PAD):
        source = parent[min(_mirrored(2 * row, shape[0]) // 2, n_rows - 1)]
        to = planes[A, row + PAD]
        for col in range(n_cols):
            height = min(max(np.int64(source[col]), low), high) - origin
            to[col + PAD] = np.int16(min(max(height >> shift, -LIMIT), LIMIT))
        for col in range(1, PAD + 1):
            to[PAD - col] = to[PAD + min(_mirrored(-2 * col, shape[1]) // 2, n_cols - 1)]
            last = n_cols - 1 + col
            to[PAD + last] = to[PAD + min(_mirrored(2 * last, shape[1]) // 2, n_cols - 1)]


@kernel
def look_at_parent(planes, n_rows, n_cols, ranges, bends):
    """Fill the ranges of cells and the bends of samples of A, from one row and column outside on.

    ``ranges[i + 1, j + 1]`` is that of samples (i, j) ... (i + 1, j + 1), n_rows and n_cols those
    of A. Both arrays have two more rows and columns than A.
    """
    a = planes[A]
    for i in range(n_rows + 2):
        north, here, south = a[i + PAD - 2], a[i + PAD - 1], a[i + PAD]
        for j in range(n_cols + 2):
            k = j + PAD - 1
            x, y = np.int32(here[k]), np.int32(here[k + 1])
            z, w = np.int32(south[k]), np.int32(south[k + 1])
            most, least = max(max(x, y), max(z, w)), min(min(x, y), min(z, w))
            ranges[i, j] = np.int16(most - least)
            across = abs(np.int32(here[k - 1]) + y - _TWO * x)
            along = abs(np.int32(north[k]) + z - _TWO * x)
            bends[i, j] = np.int16(min(across + along, _LIMIT))


@kernel
def predict_row(planes, runs, weights, core, row, n_cols, is_fine, predicted, sides):
    """Predict a row of a plane, in quarters, and which sign its details tend to.

    `sides` are -1 where details change their sign, else 0.
    """
    first = PAD + row
    for j in range(n_cols):
        predicted[j] = 0
    for k in range(weights.shape[0]):
        source = planes[runs[0][k], first + runs[1][k]]
        at = PAD + runs[2][k]
        a, b = weights[k, 0], weights[k, 1]
        left, right = source[at : at + n_cols], source[at + 1 : at + 1 + n_cols]
        for j in range(n_cols):
            predicted[j] += a * np.int32(left[j]) + b * np.int32(right[j])
    c0, c1 = PAD + core[0, 2], PAD + core[1, 2]
    c2, c3 = PAD + core[2, 2], PAD + core[3, 2]
    p0 = planes[core[0, 0], first + core[0, 1]][c0 : c0 + n_cols]
    p1 = planes[core[1, 0], first + core[1, 1]][c1 : c1 + n_cols]
    p2 = planes[core[2, 0], first + core[2, 1]][c2 : c2 + n_cols]
    p3 = planes[core[3, 0], first + core[3, 1]][c3 : c3 + n_cols]
    for j in range(n_cols):
        x, y, z, w = np.int32(p0[j]), np.int32(p1[j]), np.int32(p2[j]), np.int32(p3[j])
        least, most = min(min(x, y), min(z, w)), max(max(x, y), max(z, w))
        quarters = min(max(predicted[j] >> _TO_QUARTERS, _FOUR * least), _FOUR * most)
        whole = ((quarters + _TWO) >> _TWO) * _FOUR
        is_turned = whole > quarters if is_fine else quarters > x + y + z + w
        predicted[j] = quarters
        sides[j] = -np.int32(is_turned)


@kernel_part
def settle_narrow(predicted, sides, details, step, low, high, own, n_cols):
    """Add details to a predicted row; `low` and `high` less the origin; no shift."""
    for j in range(n_cols):
        detail = (np.int32(details[j]) ^ sides[j]) - sides[j]
        height = ((predicted[j] + _TWO) >> _TWO) + detail * step
        own[PAD + j] = np.int16(min(max(height, low), high))


@kernel_part
def settle_wide(predicted, sides, details, step, low, high, origin, shift, own, out, n_cols):
    """Add details to a predicted row of a unit that needs 32 bits; `out` takes the heights."""
    for j in range(n_cols):
        side = np.int64(sides[j])
        detail = (np.int64(details[j]) ^ side) - side
        height = (((np.int64(predicted[j]) << shift) + 2) >> 2) + origin + detail * step
        height = min(max(height, low), high)
        out[j] = np.int32(height)
        own[PAD + j] = np.int16(min(max((height - origin) >> shift, -LIMIT), LIMIT))


@kernel_part
def repeat_ends(own, n_cols):
    """Repeat the first and the last sample of a row of a plane outside."""
    for k in range(1, PAD + 1):
        own[PAD - k] = own[PAD]
        own[PAD + n_cols - 1 + k] = own[PAD + n_cols - 1]


@kernel_part
def _quantise(goal, of_row, first, predicted, sides, step, origin, shift, has_void, valid, details,
              n_cols):  # fmt: skip
    """Fill the details that bring a predicted row nearest to the goal; 0 where void."""
    half = np.int64(step) >> 1
    for j in range(n_cols):
        place = first + 2 * j
        detail = np.int64(0)
        if not has_void or valid[of_row, place]:
            whole = (((np.int64(predicted[j]) << shift) + 2) >> 2) + origin
            detail = (np.int64(goal[of_row, place]) - whole + half) // step
        side = np.int64(sides[j])
        details[j] = np.int32((detail ^ side) - side)


@kernel_part
def _repeat_rows(planes, plane, n_rows):
    for k in range(1, PAD + 1):
        planes[plane, PAD - k] = planes[plane, PAD]
        planes[plane, PAD + n_rows - 1 + k] = planes[plane, PAD + n_rows - 1]


@kernel
def code_heights(
    is_encoding, goal, has_void, valid, is_narrow, step, low, high, origin, shift, shape, known,
    lines, all_runs, all_weights, cores, planes, details, predicted, sides, heights, out,
    kept, added,
):  # fmt: skip
    """Settle planes HH, HL and LH of a unit, and write its rows; encoding, find its details first.

    `lines` are the heights of the known samples at top, left, bottom and right, one row each. Plane
    A is in `planes`; its heights are in `out` already.
    """
    n_rows = (shape[0] // 2, (shape[0] + 1) // 2, shape[0] // 2)
    n_cols = (shape[1] // 2, shape[1] // 2, (shape[1] + 1) // 2)
    for plane in (HH, HL, LH):
        if n_rows[plane - 1] == 0 or n_cols[plane - 1] == 0:
            planes[plane] = planes[A]
            continue
        runs, weights, core = all_runs[plane - 1], all_weights[plane - 1], cores[plane - 1]
        n = n_cols[plane - 1]
        down, across = plane != HL, plane != LH
        for row in range(n_rows[plane - 1]):
            own, of_row = planes[plane, PAD + row], 2 * row + down
            predict_row(planes, runs, weights, core, row, n, step <= 3, predicted, sides)
            of_details = details[plane - 1, row]
            if is_encoding:
                _quantise(goal, of_row, across, predicted, sides, step, origin, shift, has_void,
                          valid, of_details, n)  # fmt: skip
            if is_narrow:
                settle_narrow(
                    predicted, sides, of_details, np.int32(step), np.int32(low - origin),
                    np.int32(high - origin), own, n,
                )  # fmt: skip
                for j in range(n):
                    heights[j] = np.int32(own[PAD + j]) + np.int32(origin)
            else:
                settle_wide(
                    predicted, sides, of_details, np.int64(step), low, high, origin, shift, own,
                    heights, n,
                )  # fmt: skip
            is_changed = False
            if plane == HL and row == 0 and known[0]:
                heights[:n] = lines[0, :n]
                is_changed = True
            elif plane == HL and row == n_rows[1] - 1 and known[2]:
                heights[:n] = lines[2, :n]
                is_changed = True
            elif plane == LH and (known[1] or known[3]):
                if known[1]:
                    heights[0] = lines[1, row]
                if known[3]:
                    heights[n - 1] = lines[3, row]
                is_changed = True
            if added.shape[0] > 0:
                for j in range(n):
                    place = of_row * shape[1] + across + 2 * j
                    heights[j] = corrected(
                        np.int64(heights[j]), kept, added, place, (low, high), (low, high)
                    )
                is_changed = True
            if is_changed:
                for j in range(n):
                    less = (np.int64(heights[j]) - origin) >> shift
                    own[PAD + j] = np.int16(min(max(less, -LIMIT), LIMIT))
            repeat_ends(own, n)
            to = out[of_row]
            for j in range(n):
                to[across + 2 * j] = heights[j]
        _repeat_rows(planes, plane, n_rows[plane - 1])
