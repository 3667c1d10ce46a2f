"""Heights of a lattice: plane A made from the parent, the others predicted and settled.

Planes hold ``(height - origin) >> shift`` within ±LIMIT, whatever the heights are: all sums fit
32 bits, and a unit of any relief is coded by the same code. Heights themselves are exact.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.corrections import corrected
from terrainwave.codec.rapid.layout import HH, HL, LH, LIMIT, PAD, A
from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.jit import kernel, kernel_part

_LIMIT = np.int32(LIMIT)
_TWO, _FOUR = np.int32(2), np.int32(4)
_TO_QUARTERS = np.int32(10)


class Parent(NamedTuple):
    """Parent heights in a flat array: where the first is, how far apart rows are, and samples."""

    heights: NDArray[np.int32]
    first: int
    pitch: int
    spacing: int


class Aim(NamedTuple):
    """What an encoder aims at, and what corrections there are; empty arrays where there is none."""

    heights: NDArray[np.int32]
    valid: NDArray[np.uint8]
    kept: NDArray[np.int32]
    added: NDArray[np.int32]


@kernel_part
def _mirrored(number, n):
    """Return a place of 0 ... n - 1 by symmetry about the first and the last one."""
    if n == 1:
        return 0
    period = 2 * (n - 1)
    number %= period
    return min(number, period - number)


@kernel_part
def _level_with(height, lattice):
    """Return what a plane holds of a height."""
    return np.int16(min(max((height - lattice.origin) >> lattice.shift, -LIMIT), LIMIT))


@kernel
def load_parent(parent, lattice, rows, work):
    """Fill `rows` of plane A, and the PAD rows and columns outside that mirror what is there."""
    heights, planes, spacing = borrowed(parent.heights), borrowed(work.planes), parent.spacing
    low, high, origin, shift = lattice.low, lattice.high, lattice.origin, lattice.shift
    n_rows, n_cols = (lattice.n_rows + 1) // 2, (lattice.n_cols + 1) // 2
    for row in range(rows[0] - PAD, rows[1] + PAD):
        # Of an odd number of rows, the last one of A is the lattice's last; of an even one, not.
        inside = min(_mirrored(2 * row, lattice.n_rows) // 2, n_rows - 1)
        if not rows[0] <= inside < rows[1]:
            continue
        at = parent.first + inside * parent.pitch
        to = planes[A, row + PAD]
        for col in range(n_cols):
            height = np.int64(heights[at + col * spacing])
            height = min(max(height, low), high) - origin
            to[PAD + col] = np.int16(min(max(height >> shift, -LIMIT), LIMIT))
        for col in range(1, PAD + 1):
            mirrored = min(_mirrored(-2 * col, lattice.n_cols) // 2, n_cols - 1)
            to[PAD - col] = to[PAD + mirrored]
            last = n_cols - 1 + col
            mirrored = min(_mirrored(2 * last, lattice.n_cols) // 2, n_cols - 1)
            to[PAD + last] = to[PAD + mirrored]


@kernel
def look_at_parent(lattice, rows, work):
    """Fill the ranges of cells and the bends of samples of A, of one column outside on each side.

    `rows` of A, from -1 on; ``ranges[i + 1, j + 1]`` is that of samples (i, j) ... (i + 1, j + 1).
    Differences of heights within ±LIMIT, doubled and added, are below 2**16.
    """
    a, ranges, bends = borrowed((work.planes[A], work.ranges, work.bends))
    n = (lattice.n_cols + 1) // 2 + 2
    for i in range(rows[0], rows[1]):
        north, here = a[PAD + i - 1, PAD - 1 :], a[PAD + i, PAD - 1 :]
        west, south = a[PAD + i, PAD - 2 :], a[PAD + i + 1, PAD - 1 :]
        to_range, to_bend = ranges[i + 1], bends[i + 1]
        for j in range(n):
            x, y = np.int32(here[j]), np.int32(here[j + 1])
            z, w = np.int32(south[j]), np.int32(south[j + 1])
            most, least = max(max(x, y), max(z, w)), min(min(x, y), min(z, w))
            to_range[j] = np.int16(most - least)
            across = abs(np.int32(west[j]) + y - _TWO * x)
            along = abs(np.int32(north[j]) + z - _TWO * x)
            to_bend[j] = np.int16(min(across + along, _LIMIT))


@kernel_part
def _core_row(planes, core, k, first, n):
    """Return the row of one of the four nearest known samples."""
    at = PAD + core[k, 2]
    return planes[core[k, 0], first + core[k, 1]][at : at + n]


@kernel_part
def predict_row(planes, stencil, row, n, is_fine, predicted, sides):
    """Predict a row of a plane, in quarters, and which sign its details tend to.

    `sides` are -1 where details change their sign, else 0. The absolute weights add up to 2**18 at
    most, samples are below 2**13: sums are below 2**31.
    """
    runs, weights, core = stencil
    first = PAD + row
    for k in range(0, weights.shape[0], 2):
        row_of, at = planes[runs[0][k], first + runs[1][k]], PAD + runs[2][k]
        x, y = row_of[at : at + n], row_of[at + 1 : at + 1 + n]
        row_of, at = planes[runs[0][k + 1], first + runs[1][k + 1]], PAD + runs[2][k + 1]
        z, w = row_of[at : at + n], row_of[at + 1 : at + 1 + n]
        w0, w1 = np.int32(weights[k, 0]), np.int32(weights[k, 1])
        w2, w3 = np.int32(weights[k + 1, 0]), np.int32(weights[k + 1, 1])
        if k == 0:
            for j in range(n):
                total = w0 * np.int32(x[j]) + w1 * np.int32(y[j])
                predicted[j] = total + w2 * np.int32(z[j]) + w3 * np.int32(w[j])
        else:
            for j in range(n):
                total = w0 * np.int32(x[j]) + w1 * np.int32(y[j])
                predicted[j] += total + w2 * np.int32(z[j]) + w3 * np.int32(w[j])
    p0, p1 = _core_row(planes, core, 0, first, n), _core_row(planes, core, 1, first, n)
    p2, p3 = _core_row(planes, core, 2, first, n), _core_row(planes, core, 3, first, n)
    for j in range(n):
        a, b, c, d = np.int32(p0[j]), np.int32(p1[j]), np.int32(p2[j]), np.int32(p3[j])
        least, most = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
        quarters = min(max(predicted[j] >> _TO_QUARTERS, _FOUR * least), _FOUR * most)
        whole = ((quarters + _TWO) >> _TWO) * _FOUR
        is_turned = whole > quarters if is_fine else quarters > a + b + c + d
        predicted[j] = quarters
        sides[j] = -np.int32(is_turned)


@kernel_part
def settle_narrow(predicted, sides, lattice, details, own, n):
    """Add details to a predicted row.

    The step is at most LIMIT, a detail times it below 2**30 + 2**13 (`Lattice.most`, or 31 steps).
    """
    step = np.int32(lattice.step)
    low, high = np.int32(lattice.low - lattice.origin), np.int32(lattice.high - lattice.origin)
    own = own[PAD:]
    for j in range(n):
        detail = (details[j] ^ sides[j]) - sides[j]
        height = ((predicted[j] + _TWO) >> _TWO) + detail * step
        own[j] = np.int16(min(max(height, low), high))


@kernel_part
def settle_wide(predicted, sides, lattice, details, own, heights, n):
    """Add details to a predicted row of a unit that needs 32 bits, in `own` and in `heights`."""
    for j in range(n):
        side = np.int64(sides[j])
        detail = (np.int64(details[j]) ^ side) - side
        height = (((np.int64(predicted[j]) << lattice.shift) + 2) >> 2) + lattice.origin
        height = min(max(height + detail * lattice.step, lattice.low), lattice.high)
        heights[j] = np.int32(height)
        own[PAD + j] = _level_with(height, lattice)


@kernel_part
def _quantised(goal, whole, step):
    """Return the detail that brings a prediction nearest to a goal."""
    return (np.int64(goal) - whole + (np.int64(step) >> 1)) // step


@kernel_part
def _quantise(goal, valid, place, lattice, work, details, n):
    """Fill the details of a predicted row; 0 where void. `place` is that of the first sample."""
    of_row, first = place
    for j in range(n):
        col = first + 2 * j
        detail = np.int64(0)
        if not lattice.has_void or valid[of_row, col]:
            whole = ((np.int64(work.predicted[j]) << lattice.shift) + 2) >> 2
            detail = _quantised(goal[of_row, col], whole + lattice.origin, lattice.step)
        side = np.int64(work.sides[j])
        details[j] = np.int32((detail ^ side) - side)


@kernel_part
def _on_line(heights, first, spacing, n, k):
    """Return a parent's sample of a line by symmetry."""
    return np.int64(heights[first + _mirrored(k, n) * spacing])


@kernel
def predict_on_line(parent, line, step):
    """Predict a sample of a line that units share, in 64 bits; also whether its detail is turned.

    From the parent's samples of the line alone: both units find the same height. `line` says where
    the first of these is, how far apart they are, how many, and the number of the one before.
    """
    heights = borrowed(parent.heights)
    first, spacing, n, k = line
    a, b = _on_line(heights, first, spacing, n, k - 1), _on_line(heights, first, spacing, n, k)
    c = _on_line(heights, first, spacing, n, k + 1)
    d = _on_line(heights, first, spacing, n, k + 2)
    least, most = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    quarters = min(max((9 * (b + c) - a - d) >> 2, 4 * least), 4 * most)
    whole = (quarters + 2) >> 2
    return whole, 4 * whole > quarters if step <= 3 else quarters > 2 * (b + c)


@kernel
def settle_on_line(is_encoding, goal, place, lattice, parent, line, details, j, work, own):
    """Settle sample j of a row, which is on a line that units share."""
    whole, is_turned = predict_on_line(parent, line, lattice.step)
    if is_encoding:
        detail = np.int64(0)
        if not lattice.has_void or goal.valid[place]:
            detail = _quantised(goal.heights[place], whole, lattice.step)
        details[j] = np.int32(-detail if is_turned else detail)
    detail = np.int64(details[j])
    height = whole + (-detail if is_turned else detail) * lattice.step
    height = min(max(height, lattice.low), lattice.high)
    work.heights[j] = np.int32(height)
    own[PAD + j] = _level_with(height, lattice)


@kernel_part
def _repeat(planes, plane, row, n):
    """Repeat the first and the last sample of a row of a plane outside."""
    own = planes[plane, PAD + row]
    for k in range(1, PAD + 1):
        own[PAD - k] = own[PAD]
        own[PAD + n - 1 + k] = own[PAD + n - 1]


@kernel
def code_heights(is_encoding, goal, lattice, work, parent, known, stencils, rows, out):
    """Settle planes HH, HL and LH of a lattice, and write its rows; encoding, find its details.

    `known` says which sides are shared: top, left, bottom, right. `rows` are those of HH, HL, LH
    that are wanted, and those of the lattice to be written. Plane A is in ``work.planes``.
    """
    goal, parent, work, out = borrowed((goal, parent, work, out))
    planes, predicted, sides, heights = work.planes, work.predicted, work.sides, work.heights
    n_rows = (lattice.n_rows // 2, (lattice.n_rows + 1) // 2, lattice.n_rows // 2)
    n_cols = (lattice.n_cols // 2, lattice.n_cols // 2, (lattice.n_cols + 1) // 2)
    n_a_rows, n_a_cols = (lattice.n_rows + 1) // 2, (lattice.n_cols + 1) // 2
    last_row = parent.first + (n_a_rows - 1) * parent.pitch
    last_col = parent.first + (n_a_cols - 1) * parent.spacing
    for plane in (HH, HL, LH):
        n = n_cols[plane - 1]
        if n_rows[plane - 1] == 0 or n == 0:
            planes[plane] = planes[A]
            continue
        down, across = np.int64(plane != HL), np.int64(plane != LH)
        pitch = n + (n & 1)
        for row in range(rows[plane - 1][0], rows[plane - 1][1]):
            own, of_row = planes[plane, PAD + row], 2 * row + down
            details = work.details[plane - 1, pitch * row : pitch * row + n]
            predict_row(planes, stencils[plane - 1], row, n, lattice.step <= 3, predicted, sides)
            if is_encoding:
                _quantise(goal.heights, goal.valid, (of_row, across), lattice, work, details, n)
                if pitch > n:
                    # An odd end is a pair with nothing: memory holds what was coded before.
                    work.details[plane - 1, pitch * row + n] = 0
            if lattice.is_narrow:
                settle_narrow(predicted, sides, lattice, details, own, n)
            else:
                settle_wide(predicted, sides, lattice, details, own, heights, n)
            if plane == HL and ((row == 0 and known[0]) or (row == n_rows[1] - 1 and known[2])):
                first = parent.first if row == 0 and known[0] else last_row
                for j in range(n):
                    settle_on_line(
                        is_encoding, goal, (of_row, 2 * j + 1), lattice, parent,
                        (first, parent.spacing, n_a_cols, j), details, j, work, own,
                    )  # fmt: skip
            elif plane == LH:
                for side in (1, 3):
                    if known[side]:
                        first, j = (parent.first, 0) if side == 1 else (last_col, n - 1)
                        settle_on_line(
                            is_encoding, goal, (of_row, 2 * j), lattice, parent,
                            (first, parent.pitch, n_a_rows, row), details, j, work, own,
                        )  # fmt: skip
            if goal.added.shape[0] > 0:
                for j in range(n):
                    height = np.int64(own[PAD + j]) + lattice.origin
                    if not lattice.is_narrow:
                        height = np.int64(heights[j])
                    place = of_row * lattice.n_cols + across + 2 * j
                    limits = lattice.low, lattice.high
                    height = corrected(height, goal.kept, goal.added, place, limits, limits)
                    heights[j] = np.int32(height)
                    own[PAD + j] = _level_with(height, lattice)
            _repeat(planes, plane, row, n)
            if not lattice.is_narrow and rows[3][0] <= of_row < rows[3][1]:
                to = out[of_row]
                for j in range(n):
                    to[across + 2 * j] = heights[j]
        for k in range(1, PAD + 1):
            planes[plane, PAD - k] = planes[plane, PAD]
            last = PAD + n_rows[plane - 1] - 1
            planes[plane, last + k] = planes[plane, last]
    for row in range(rows[3][0], rows[3][1]):
        if lattice.is_narrow:
            write_row(planes, lattice, row, out[row])
        elif not row & 1:
            at = parent.first + (row >> 1) * parent.pitch
            for j in range(n_a_cols):
                height = np.int64(parent.heights[at + j * parent.spacing])
                out[row, 2 * j] = np.int32(min(max(height, lattice.low), lattice.high))


@kernel_part
def write_row(planes, lattice, row, out):
    """Write a row of a narrow lattice from its planes."""
    origin, i, n = np.int32(lattice.origin), PAD + (row >> 1), lattice.n_cols // 2
    first = planes[LH if row & 1 else A, i, PAD:]
    second = planes[HH if row & 1 else HL, i, PAD:]
    for j in range(n):
        out[2 * j] = np.int32(first[j]) + origin
        out[2 * j + 1] = np.int32(second[j]) + origin
    if lattice.n_cols & 1:
        out[2 * n] = np.int32(first[n]) + origin
