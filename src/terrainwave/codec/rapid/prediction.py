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


@kernel_part
def _look(work, rows, n):
    """Fill the ranges of cells and the bends of samples of A, of one column outside on each side.

    ``ranges[i + 1, j + 1]`` is that of samples (i, j) ... (i + 1, j + 1).
    Differences of heights within ±LIMIT, doubled and added, are below 2**16.
    """
    a, ranges, bends = work.planes[A], work.ranges, work.bends
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


@kernel
def load_parent(parent, lattice, rows, features, work):
    """Fill `rows` of plane A, and the PAD rows and columns outside that mirror what is there.

    Then the ranges and bends of rows `features`, from -1 on.
    """
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
    _look(borrowed(work), features, n_cols + 2)


@kernel_part
def _place(tap, k, at, size, pitch):
    """Return where tap k of the sample at a place of all planes lies, in flat memory."""
    return np.uint64(at + tap[0][k] * size + tap[1][k] * pitch + tap[2][k])


@kernel_part
def _predict_row(flat, sizes, stencil, at, n, is_fine, predicted, sides):
    """Predict a row of a plane, in quarters, and which sign its details tend to.

    `at` is the place of its first sample in plane A; places are unsigned, so that no index needs to
    be checked for a sign. `sides` are -1 where details change their sign, else 0. The absolute
    weights add up to 2**18 at most, samples are below 2**13: sums are below 2**31.
    """
    runs, weights, core = stencil
    size, pitch = sizes
    n, one = np.uint64(n), np.uint64(1)
    for k in range(0, weights.shape[0], 2):
        x, z = _place(runs, k, at, size, pitch), _place(runs, k + 1, at, size, pitch)
        y, w = x + one, z + one
        w0, w1 = np.int32(weights[k, 0]), np.int32(weights[k, 1])
        w2, w3 = np.int32(weights[k + 1, 0]), np.int32(weights[k + 1, 1])
        if k == 0:
            for j in range(n):
                total = w0 * np.int32(flat[x + j]) + w1 * np.int32(flat[y + j])
                predicted[j] = total + w2 * np.int32(flat[z + j]) + w3 * np.int32(flat[w + j])
        else:
            for j in range(n):
                total = w0 * np.int32(flat[x + j]) + w1 * np.int32(flat[y + j])
                predicted[j] += total + w2 * np.int32(flat[z + j]) + w3 * np.int32(flat[w + j])
    x, y = _place(core, 0, at, size, pitch), _place(core, 1, at, size, pitch)
    z, w = _place(core, 2, at, size, pitch), _place(core, 3, at, size, pitch)
    for j in range(n):
        a, b = np.int32(flat[x + j]), np.int32(flat[y + j])
        c, d = np.int32(flat[z + j]), np.int32(flat[w + j])
        least, most = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
        quarters = min(max(predicted[j] >> _TO_QUARTERS, _FOUR * least), _FOUR * most)
        whole = ((quarters + _TWO) >> _TWO) * _FOUR
        is_turned = whole > quarters if is_fine else quarters > a + b + c + d
        predicted[j] = quarters
        sides[j] = -np.int32(is_turned)


@kernel_part
def _settle_narrow(predicted, sides, lattice, details, source, flat, at, n):
    """Add details to a predicted row.

    The step is at most LIMIT, a detail times it below 2**30 + 2**13 (`Lattice.most`, or 31 steps).
    """
    step = np.int32(lattice.step)
    low, high = np.int32(lattice.low - lattice.origin), np.int32(lattice.high - lattice.origin)
    source, at = np.uint64(source), np.uint64(at)
    for j in range(np.uint64(n)):
        detail = (details[source + j] ^ sides[j]) - sides[j]
        height = ((predicted[j] + _TWO) >> _TWO) + detail * step
        flat[at + j] = np.int16(min(max(height, low), high))


@kernel_part
def _settle_wide(predicted, sides, lattice, details, source, flat, at, heights, n):
    """Add details to a predicted row of a unit that needs 32 bits, in a plane and in `heights`."""
    for j in range(n):
        side = np.int64(sides[j])
        detail = (np.int64(details[source + j]) ^ side) - side
        height = (((np.int64(predicted[j]) << lattice.shift) + 2) >> 2) + lattice.origin
        height = min(max(height + detail * lattice.step, lattice.low), lattice.high)
        heights[j] = np.int32(height)
        flat[at + j] = _level_with(height, lattice)


@kernel_part
def _quantised(goal, whole, step):
    """Return the detail that brings a prediction nearest to a goal."""
    return (np.int64(goal) - whole + (np.int64(step) >> 1)) // step


@kernel_part
def _quantise(aim, place, lattice, work, details, source, n):
    """Fill the details of a predicted row; 0 where void. `place` is that of the first sample.

    In float64, of which processors divide several at once: all numbers are whole and below 2**50,
    so that no quotient is rounded to the next whole number.
    """
    of_row, first = place
    goals, valid = aim.heights.reshape(-1), aim.valid.reshape(-1)
    at = np.uint64(of_row * lattice.n_cols + first)
    step, scale = np.float64(lattice.step), np.float64(np.int64(1) << lattice.shift)
    most = np.float64(lattice.origin - (lattice.step >> 1))
    source = np.uint64(source)
    for j in range(np.uint64(n)):
        whole = np.floor((np.float64(work.predicted[j]) * scale + 2.0) * 0.25)
        detail = np.int32(np.floor((np.float64(goals[at + j + j]) - whole - most) / step))
        side = work.sides[j]
        details[source + j] = (detail ^ side) - side
    if lattice.has_void:
        for j in range(np.uint64(n)):
            if not valid[at + j + j]:
                details[source + j] = 0
    if n & 1:
        # An odd end is a pair with nothing: memory holds what was coded before.
        details[source + np.uint64(n)] = 0


@kernel_part
def _on_line(heights, first, spacing, n, k):
    """Return a parent's sample of a line by symmetry."""
    return np.int64(heights[first + _mirrored(k, n) * spacing])


@kernel
def predict_on_line(heights, line, step):
    """Predict a sample of a line that units share, in 64 bits; also whether its detail is turned.

    From the parent's samples of the line alone: both units find the same height. `line` says where
    the first of these is, how far apart they are, how many, and the number of the one before.
    """
    heights = borrowed(heights)
    first, spacing, n, k = line
    a, b = _on_line(heights, first, spacing, n, k - 1), _on_line(heights, first, spacing, n, k)
    c = _on_line(heights, first, spacing, n, k + 1)
    d = _on_line(heights, first, spacing, n, k + 2)
    least, most = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    quarters = min(max((9 * (b + c) - a - d) >> 2, 4 * least), 4 * most)
    whole = (quarters + 2) >> 2
    return whole, 4 * whole > quarters if step <= 3 else quarters > 2 * (b + c)


@kernel_part
def _settle_on_line(is_encoding, aim, place, lattice, above, line, details, source):
    """Return the height of a sample on a line that units share; encoding, find its detail."""
    whole, is_turned = predict_on_line(above, line, lattice.step)
    sign = np.int64(-1 if is_turned else 1)
    if is_encoding:
        detail = np.int64(0)
        if not lattice.has_void or aim.valid[place]:
            detail = sign * _quantised(aim.heights[place], whole, lattice.step)
        details[source] = np.int32(detail)
    height = whole + sign * np.int64(details[source]) * lattice.step
    return min(max(height, lattice.low), lattice.high)


@kernel
def code_heights(is_encoding, aim, lattice, work, parent, known, stencils, rows, out):
    """Settle planes HH, HL and LH of a lattice, and write its rows; encoding, find its details.

    `known` says which sides are shared: top, left, bottom, right. `rows` are those of HH, HL, LH
    that are wanted, and those of the lattice to be written. Plane A is in ``work.planes``.
    """
    aim, work, above, out = borrowed((aim, work, parent.heights, out))
    planes, predicted, sides, heights = work.planes, work.predicted, work.sides, work.heights
    flat, details = borrowed((planes.reshape(-1), work.details.reshape(-1)))
    size, pitch = planes.shape[1] * planes.shape[2], planes.shape[2]
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
        for row in range(rows[plane - 1][0], rows[plane - 1][1]):
            of_row, at = 2 * row + down, (PAD + row) * pitch + PAD
            own, source = (
                at + plane * size,
                (plane - 1) * work.details.shape[1] + (n + (n & 1)) * row,
            )
            _predict_row(
                flat, (size, pitch), stencils[plane - 1], at, n, lattice.step <= 3, predicted, sides
            )
            if is_encoding:
                _quantise(aim, (of_row, across), lattice, work, details, source, n)
            if lattice.is_narrow:
                _settle_narrow(predicted, sides, lattice, details, source, flat, own, n)
            else:
                _settle_wide(predicted, sides, lattice, details, source, flat, own, heights, n)
            is_top = row == 0 and known[0]
            if plane == HL and (is_top or (row == n_rows[1] - 1 and known[2])):
                for j in range(n):
                    line = (parent.first if is_top else last_row, parent.spacing, n_a_cols, j)
                    place = (of_row, 2 * j + 1)
                    heights[j] = _settle_on_line(
                        is_encoding, aim, place, lattice, above, line, details, source + j
                    )
                    flat[own + j] = _level_with(np.int64(heights[j]), lattice)
            for side in (1, 3):
                if plane == LH and known[side]:
                    j = 0 if side == 1 else n - 1
                    line = (parent.first if side == 1 else last_col, parent.pitch, n_a_rows, row)
                    place = (of_row, 2 * j)
                    heights[j] = _settle_on_line(
                        is_encoding, aim, place, lattice, above, line, details, source + j
                    )
                    flat[own + j] = _level_with(np.int64(heights[j]), lattice)
            if aim.added.shape[0] > 0:
                for j in range(n):
                    height = np.int64(flat[own + j]) + lattice.origin
                    if not lattice.is_narrow:
                        height = np.int64(heights[j])
                    place = of_row * lattice.n_cols + across + 2 * j
                    limits = lattice.low, lattice.high
                    height = corrected(height, aim.kept, aim.added, place, limits, limits)
                    heights[j] = np.int32(height)
                    flat[own + j] = _level_with(height, lattice)
            for k in range(1, PAD + 1):
                flat[own - k], flat[own + n - 1 + k] = flat[own], flat[own + n - 1]
            if not lattice.is_narrow and rows[3][0] <= of_row < rows[3][1]:
                for j in range(n):
                    out[of_row, across + 2 * j] = heights[j]
        last = PAD + n_rows[plane - 1] - 1
        for k in range(1, PAD + 1):
            planes[plane, PAD - k], planes[plane, last + k] = (
                planes[plane, PAD],
                planes[plane, last],
            )
    for row in range(rows[3][0], rows[3][1]):
        at = (PAD + (row >> 1)) * pitch + PAD
        if lattice.is_narrow:
            first, second = (LH, HH) if row & 1 else (A, HL)
            _write_row(flat, first * size + at, second * size + at, lattice, out[row])
        elif not row & 1:
            at = parent.first + (row >> 1) * parent.pitch
            for j in range(n_a_cols):
                height = np.int64(above[at + j * parent.spacing])
                out[row, 2 * j] = np.int32(min(max(height, lattice.low), lattice.high))


@kernel_part
def _write_row(flat, first, second, lattice, out):
    """Write a row of a narrow lattice from rows of two planes, which begin at places of `flat`."""
    origin, n, first, second = (
        np.int32(lattice.origin),
        lattice.n_cols,
        np.uint64(first),
        np.uint64(second),
    )
    for j in range(np.uint64(n // 2)):
        out[j + j] = np.int32(flat[first + j]) + origin
        out[j + j + np.uint64(1)] = np.int32(flat[second + j]) + origin
    if n & 1:
        out[n - 1] = np.int32(flat[first + np.uint64(n // 2)]) + origin
