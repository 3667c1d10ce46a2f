"""Heights of a lattice: plane A made from the parent, the others predicted and settled.

Planes hold ``(height - origin) >> shift`` within ±LIMIT, whatever the heights are: all sums fit
32 bits, and a unit of any relief is coded by the same code. Heights themselves are exact.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.corrections import corrected
from terrainwave.codec.rapid.layout import HH, HL, LANES, LH, LIMIT, PAD, A
from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.jit import kernel, kernel_part

# Whole numbers are 64 bits wide in numba wherever two meet: of those that fit 32, each sum is made
# so again, so that twice as many fit a register.
_i32 = np.int32
_ONE, _TWO = np.uint64(1), np.uint64(2)


class Parent(NamedTuple):
    """Parent heights in a flat array: where the first is, how far apart rows are, and samples."""

    heights: NDArray[np.int32]
    first: int
    pitch: int
    spacing: int


class Aim(NamedTuple):
    """Target of an encoder, and corrections; arrays without any are empty."""

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
            x, y, z, w = _i32(here[j]), _i32(here[j + 1]), _i32(south[j]), _i32(south[j + 1])
            most, least = max(max(x, y), max(z, w)), min(min(x, y), min(z, w))
            to_range[j] = np.int16(most - least)
            across = _i32(abs(_i32(_i32(west[j]) + y - x - x)))
            along = _i32(abs(_i32(_i32(north[j]) + z - x - x)))
            to_bend[j] = np.int16(min(_i32(across + along), _i32(LIMIT)))


@kernel_part
def _load_narrow(heights, at, low, high, origin, to, n):
    """Fill a row of A of a unit whose levels are heights less the origin, within 16 bits."""
    at, pad = np.uint64(at), np.uint64(PAD)
    for col in range(np.uint64(n)):
        to[pad + col] = np.int16(min(max(heights[at + col], low), high) - origin)


@kernel
def load_parent(parent, lattice, rows, features, work):
    """Fill `rows` of plane A, and the PAD rows and columns outside that mirror what is there.

    Then the ranges and bends of rows `features`, from -1 on.
    """
    heights, planes, spacing = borrowed(parent.heights), borrowed(work.planes), parent.spacing
    low, high, origin = lattice.low, lattice.high, lattice.origin
    n_rows, n_cols = (lattice.n_rows + 1) // 2, (lattice.n_cols + 1) // 2
    for row in range(rows[0] - PAD, rows[1] + PAD):
        # Of an odd number of rows, the last one of A is the lattice's last; of an even one, not.
        inside = min(_mirrored(2 * row, lattice.n_rows) // 2, n_rows - 1)
        if not rows[0] <= inside < rows[1]:
            continue
        at = parent.first + inside * parent.pitch
        to = planes[A, row + PAD]
        if lattice.is_narrow and spacing == 1:
            _load_narrow(heights, at, _i32(low), _i32(high), _i32(origin), to, n_cols)
        else:
            for col in range(n_cols):
                height = min(max(np.int64(heights[at + col * spacing]), low), high)
                to[PAD + col] = _level_with(height, lattice)
        for col in range(1, PAD + 1):
            mirrored = min(_mirrored(-2 * col, lattice.n_cols) // 2, n_cols - 1)
            to[PAD - col] = to[PAD + mirrored]
            last = n_cols - 1 + col
            mirrored = min(_mirrored(2 * last, lattice.n_cols) // 2, n_cols - 1)
            to[PAD + last] = to[PAD + mirrored]
    _look(borrowed(work), features, n_cols + 2)


@kernel_part
def _filled(n):
    """Return the number of predicted samples of a row."""
    return (n + LANES - 1) // LANES * LANES


@kernel_part
def _quarters(total, a, b, c, d, is_fine):
    """Return a prediction in quarters from its sum, and -1 where its detail changes its sign.

    It lies between the four nearest samples. The absolute weights add up to 2**18 at most, samples
    are below 2**13: sums are below 2**31.
    """
    # No sample is part of a sum here, and none is shifted before it is compared: what is, numba has
    # LLVM widen to 64 bits, with all products.
    low, high, below, above = min(a, b), max(a, b), min(c, d), max(c, d)
    least, most = min(low, below), max(high, above)
    total = max(min(total, _i32(_i32(most << 12) | _i32(1023))), _i32(least << 12))
    quarters = _i32(total >> 10)
    is_above = _i32(_i32(quarters + _i32(2)) & _i32(-4)) > quarters
    is_turned = is_above if is_fine else quarters > _i32(low + high + below + above)
    return quarters, -_i32(is_turned)


@kernel_part
def _predict_row(flat, sizes, plane, weights, at, n, is_fine, predicted, sides):
    """Predict a row of a plane by the weights of `layout.TAPS`, as `_quarters` does each sample.

    `at` is the place of its first sample in plane A; places are unsigned, so that no index needs to
    be checked for a sign. A row's end is filled up to `LANES`: nothing is left of it for a slower
    loop.
    """
    size, pitch, here = np.uint64(sizes[0]), np.uint64(sizes[1]), np.uint64(at)
    up, down, low = here - pitch, here + pitch, here + pitch + pitch
    h = here + size * np.uint64(HH)
    h2, h1, hd = h - pitch - pitch, h - pitch, h + pitch
    x = here + size * np.uint64(HL)
    xd = x + pitch
    w0, w1, w2, w3 = _i32(weights[0]), _i32(weights[1]), _i32(weights[2]), _i32(weights[3])
    w4, w5, w6, w7 = _i32(weights[4]), _i32(weights[5]), _i32(weights[6]), _i32(weights[7])
    w8, w9, w10, w11 = _i32(weights[8]), _i32(weights[9]), _i32(weights[10]), _i32(weights[11])
    w12, w13, w14, w15 = _i32(weights[12]), _i32(weights[13]), _i32(weights[14]), _i32(weights[15])
    w16, w17, w18, w19 = _i32(weights[16]), _i32(weights[17]), _i32(weights[18]), _i32(weights[19])
    w20, w21, w22, w23 = _i32(weights[20]), _i32(weights[21]), _i32(weights[22]), _i32(weights[23])
    n = np.uint64(_filled(n))
    if plane == HH:
        for j in range(n):
            a, b = _i32(flat[here + j]), _i32(flat[here + j + _ONE])
            c, d = _i32(flat[down + j]), _i32(flat[down + j + _ONE])
            total = _i32(
                w0 * _i32(flat[up + j - _ONE]) + w1 * _i32(flat[up + j])
                + w2 * _i32(flat[up + j + _ONE]) + w3 * _i32(flat[up + j + _TWO])
                + w4 * _i32(flat[here + j - _ONE]) + w5 * a + w6 * b
                + w7 * _i32(flat[here + j + _TWO])
                + w8 * _i32(flat[down + j - _ONE]) + w9 * c + w10 * d
                + w11 * _i32(flat[down + j + _TWO])
                + w12 * _i32(flat[low + j - _ONE]) + w13 * _i32(flat[low + j])
                + w14 * _i32(flat[low + j + _ONE]) + w15 * _i32(flat[low + j + _TWO])
            )  # fmt: skip
            predicted[j], sides[j] = _quarters(total, a, b, c, d, is_fine)
    elif plane == HL:
        for j in range(n):
            a, b = _i32(flat[here + j]), _i32(flat[here + j + _ONE])
            c, d = _i32(flat[h1 + j]), _i32(flat[h + j])
            total = _i32(
                w0 * _i32(flat[up + j - _ONE]) + w1 * _i32(flat[up + j])
                + w2 * _i32(flat[up + j + _ONE]) + w3 * _i32(flat[up + j + _TWO])
                + w4 * _i32(flat[here + j - _ONE]) + w5 * a + w6 * b
                + w7 * _i32(flat[here + j + _TWO])
                + w8 * _i32(flat[down + j - _ONE]) + w9 * _i32(flat[down + j])
                + w10 * _i32(flat[down + j + _ONE]) + w11 * _i32(flat[down + j + _TWO])
                + w12 * _i32(flat[h2 + j])
                + w13 * _i32(flat[h1 + j - _ONE]) + w14 * c + w15 * _i32(flat[h1 + j + _ONE])
                + w16 * _i32(flat[h + j - _ONE]) + w17 * d + w18 * _i32(flat[h + j + _ONE])
                + w19 * _i32(flat[hd + j])
            )  # fmt: skip
            predicted[j], sides[j] = _quarters(total, a, b, c, d, is_fine)
    else:
        for j in range(n):
            a, b = _i32(flat[here + j]), _i32(flat[down + j])
            c, d = _i32(flat[h + j - _ONE]), _i32(flat[h + j])
            total = _i32(
                w0 * _i32(flat[up + j - _ONE]) + w1 * _i32(flat[up + j])
                + w2 * _i32(flat[up + j + _ONE])
                + w3 * _i32(flat[here + j - _ONE]) + w4 * a + w5 * _i32(flat[here + j + _ONE])
                + w6 * _i32(flat[down + j - _ONE]) + w7 * b + w8 * _i32(flat[down + j + _ONE])
                + w9 * _i32(flat[low + j - _ONE]) + w10 * _i32(flat[low + j])
                + w11 * _i32(flat[low + j + _ONE])
                + w12 * _i32(flat[h1 + j - _ONE]) + w13 * _i32(flat[h1 + j])
                + w14 * _i32(flat[h + j - _TWO]) + w15 * c + w16 * d
                + w17 * _i32(flat[h + j + _ONE])
                + w18 * _i32(flat[hd + j - _ONE]) + w19 * _i32(flat[hd + j])
                + w20 * _i32(flat[x + j - _ONE]) + w21 * _i32(flat[x + j])
                + w22 * _i32(flat[xd + j - _ONE]) + w23 * _i32(flat[xd + j])
            )  # fmt: skip
            predicted[j], sides[j] = _quarters(total, a, b, c, d, is_fine)


@kernel_part
def _settle_narrow(predicted, sides, lattice, details, source, flat, at, n):
    """Add details to a predicted row.

    The step is at most LIMIT, a detail times it below 2**30 + 2**13 (`Lattice.most`, or 31 steps).
    """
    step, low = _i32(lattice.step), _i32(lattice.low - lattice.origin)
    high, source, at = _i32(lattice.high - lattice.origin), np.uint64(source), np.uint64(at)
    for j in range(np.uint64(n)):
        detail = _i32(_i32(details[source + j] ^ sides[j]) - sides[j])
        height = _i32(_i32(_i32(predicted[j] + _i32(2)) >> 2) + _i32(detail * step))
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

    In float64, as processors divide several of them at once: all numbers are whole and below 2**50,
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
                flat, (size, pitch), plane, stencils[plane - 1], at, n, lattice.step <= 3,
                predicted, sides,
            )  # fmt: skip
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
    for row in range((rows[3][0] + 1) // 2 * 2, rows[3][1], 2):
        at = parent.first + (row >> 1) * parent.pitch
        for j in range(0 if lattice.is_narrow else n_a_cols):
            height = np.int64(above[at + j * parent.spacing])
            out[row, 2 * j] = np.int32(min(max(height, lattice.low), lattice.high))


@kernel
def write_rows(planes, origin, rows, n_cols, out, row_spacing):
    """Write rows of a narrow lattice, heights of planes and `origin`, to flat memory.

    Row 0 of the lattice is at its start, row 1 `row_spacing` further.
    """
    flat, out, n_cols = borrowed(planes.reshape(-1)), borrowed(out), np.uint64(n_cols)
    size, pitch = planes.shape[1] * planes.shape[2], planes.shape[2]
    for row in range(rows[0], rows[1]):
        at = (PAD + (row >> 1)) * pitch + PAD
        even, odd = (LH, HH) if row & 1 else (A, HL)
        x, y = np.uint64(even * size + at), np.uint64(odd * size + at)
        to, n = np.uint64(row * row_spacing), n_cols >> _ONE
        for j in range(n):
            # Of 32 bits, whatever `out` is of.
            out[to + j + j] = _i32(_i32(flat[x + j]) + _i32(origin))
            out[to + j + j + _ONE] = _i32(_i32(flat[y + j]) + _i32(origin))
        if n_cols & _ONE:
            out[to + n + n] = _i32(_i32(flat[x + n]) + _i32(origin))
