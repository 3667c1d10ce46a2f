"""Lines that neighbouring units share, coded from the line alone (format-rapid.md, R.3).

As `codec.shared_lines` does for the other methods, but by rows like everything of `rapid`: no
sample waits for the one before it.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.rapid.layout import EXPECTED, LEAST, LINE, MOST, PREDICTED, SUM, TWIST
from terrainwave.codec.refiner import GroupSpec, Sides
from terrainwave.codec.shared_lines import plan_border
from terrainwave.coding.jit import kernel, kernel_part
from terrainwave.grid.quadtree import Region

# Fields of a line in `Plan`: place of its first sample and spacing in the region; samples; those
# coded are first … stop - 1; the parent's lines at or before and at or after it, and the spacing on
# them; whether the even samples are the parent's.
START, SPACING, LENGTH, FIRST, STOP, BEFORE, AFTER, PARENT_SPACING, INHERITED = range(9)
# Fields of a corner: its place in the region, then the four parent samples around.
_N_AROUND = 4
# Corners are coded in rows of so many.
MOST_CORNERS = 64
_U1, _U2 = np.uint64(1), np.uint64(2)


def plan_lines(spec: GroupSpec, pitch: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the shared samples of a group: corners and lines, in coding order.

    Places are those in the flat region and in the flat parent, whose rows are `pitch` apart.
    """
    assert spec.parent_region is not None
    core = spec.core.slices_in(spec.region)
    return _plan(
        spec.region.shape,
        (core[0].start, core[1].start, *spec.core.shape),
        spec.parent_region.shape,
        (
            spec.region.row - 2 * spec.parent_region.row,
            spec.region.col - 2 * spec.parent_region.col,
        ),
        spec.shared,
        spec.rings,
        pitch,
    )


@lru_cache(maxsize=256)
def _plan(
    shape: tuple[int, int],
    core: tuple[int, int, int, int],
    parent_shape: tuple[int, int],
    offset: tuple[int, int],
    shared: Sides,
    rings: int,
    pitch: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    region = Region(0, 0, *shape)
    spec = GroupSpec.alone(Region(*core), 1, 0, 0, region=region, shared=shared)
    spec = replace(spec, rings=rings)
    plan = plan_border(spec)
    last = parent_shape[0] - 1, parent_shape[1] - 1
    corners = []
    for row, col in plan.corners:
        r, c = row + offset[0], col + offset[1]
        if not r & 1 and not c & 1:
            continue  # inherited
        rows = [min(r >> 1, last[0]), min((r + 1) >> 1, last[0])]
        cols = [min(c >> 1, last[1]), min((c + 1) >> 1, last[1])]
        corners.append([row * shape[1] + col, *(p * pitch + q for p in rows for q in cols)])
    lines = []
    for line in plan.lines:
        if line.first >= line.stop:
            continue
        across, along = offset if not line.is_column else offset[::-1]
        spacing, between = (shape[1], 1) if line.is_column else (1, shape[1])
        parent_spacing, parent_between = (pitch, 1) if line.is_column else (1, pitch)
        last_line = last[1] if line.is_column else last[0]
        place, begin = line.place + across, (line.start + along) >> 1
        before, after = min(place >> 1, last_line), min((place + 1) >> 1, last_line)
        lines.append(
            [
                line.place * between + line.start * spacing, spacing, line.n, line.first, line.stop,
                before * parent_between + begin * parent_spacing,
                after * parent_between + begin * parent_spacing,
                parent_spacing, int(not place & 1),
            ]
        )  # fmt: skip
    return (
        np.array(corners, dtype=np.int64).reshape(-1, 1 + _N_AROUND),
        np.array(lines, dtype=np.int64).reshape(-1, INHERITED + 1),
    )


@kernel
def prepare_shared(m, out, parent, corners, lines, index, origin, scale):
    """Predict a row of shared samples; return its first place in `out`, the spacing, and how many.

    Parameters
    ----------
    out, parent : ndarray of int32, flat
        Region and parent.
    corners, lines : ndarray of int64
        As `plan_lines` returns them.
    index : int
        First come rows of corner samples, whose places are in `corners` from the returned one on;
        then of each line its even samples, 0 if they are the parent's, and its odd ones.
    """
    n_corner_rows = (corners.shape[0] + MOST_CORNERS - 1) // MOST_CORNERS
    if index < n_corner_rows:
        first = np.int64(index * MOST_CORNERS)
        n = min(corners.shape[0] - first, MOST_CORNERS)
        _predict_corners(m, parent, corners, first, n, origin, scale)
        return first, np.int64(1), n
    line, is_odd = (index - n_corner_rows) >> 1, (index - n_corner_rows) & 1
    start, spacing = lines[line, START], lines[line, SPACING]
    first, stop = lines[line, FIRST], lines[line, STOP]
    skipped = (first + 1 - is_odd) >> 1
    n = ((stop + 1 - is_odd) >> 1) - skipped
    _load_line(m, out, parent, lines, line, is_odd, origin, scale)
    if is_odd:
        _predict_odd(m, skipped, n)
    elif lines[line, INHERITED]:
        n = np.int64(0)
    else:
        _predict_even(m, parent, lines, line, skipped, n, origin, scale)
    return start + (2 * skipped + is_odd) * spacing, 2 * spacing, n


@kernel_part
def _predict_corners(m, parent, corners, first, n, origin, scale):
    """Predict a row of samples where lines cross, each from the parent's four."""
    cast = m.dtype.type
    for j in range(n):
        k = np.uint64(j)
        least, most = np.int64(scale.high), np.int64(scale.low)
        total = twist = np.int64(0)
        for corner in range(_N_AROUND):
            height = np.int64(parent[corners[first + j, 1 + corner]]) - origin
            height = min(max(height, scale.low), scale.high)
            least, most = min(least, height), max(most, height)
            total += height
            twist += height if corner == 0 or corner == _N_AROUND - 1 else -height
        m[LEAST + k], m[MOST + k] = least, most
        m[SUM + k], m[PREDICTED + k] = total, 16 * total
        m[TWIST + k] = abs(cast(twist))
        m[EXPECTED + k] = 0


@kernel_part
def _load_line(m, out, parent, lines, line, is_odd, origin, scale):
    """Fill `LINE` with a line's even samples, or twice their predictions before they are coded.

    Those that are the parent's go to `out`.
    """
    start, spacing = lines[line, START], 2 * lines[line, SPACING]
    first, stop = lines[line, FIRST], lines[line, STOP]
    before, after = lines[line, BEFORE], lines[line, AFTER]
    parent_spacing = lines[line, PARENT_SPACING]
    is_inherited = lines[line, INHERITED] != 0
    n = (lines[line, LENGTH] + 1) >> 1
    for j in range(n):
        is_coded = is_odd and not is_inherited
        height = out[start + j * spacing] if is_coded else parent[before + j * parent_spacing]
        value = min(max(np.int64(height) - origin, scale.low), scale.high)
        if is_inherited:
            if first <= 2 * j < stop:
                out[start + j * spacing] = height
        elif not is_odd:
            other = np.int64(parent[after + j * parent_spacing]) - origin
            value += min(max(other, scale.low), scale.high)
        m[LINE + np.uint64(j)] = value
    m[LINE - _U1] = m[LINE + np.uint64(min(1, n - 1))]
    before_last = m[LINE + np.uint64(max(n - 2, 0))]
    m[LINE + np.uint64(n)] = before_last
    m[LINE + np.uint64(n + 1)] = m[LINE + np.uint64(max(n - 3, 0))]


@kernel_part
def _predict_even(m, parent, lines, line, skipped, n, origin, scale):
    """Predict a line's even samples from the parent's lines on both sides."""
    cast = m.dtype.type
    parent_spacing = lines[line, PARENT_SPACING]
    before = lines[line, BEFORE] + skipped * parent_spacing
    for j in range(n):
        k, at = np.uint64(j), LINE + np.uint64(j + skipped)
        a = np.int64(parent[before + j * parent_spacing]) - origin
        a = min(max(a, scale.low), scale.high)
        b = m[at] - a
        m[LEAST + k], m[MOST + k] = min(a, b), max(a, b)
        m[SUM + k] = 2 * m[at]
        m[PREDICTED + k] = 32 * m[at]
        m[TWIST + k] = abs(cast(m[at - _U1] - 2 * m[at] + m[at + _U1]))
        m[EXPECTED + k] = 0


@kernel_part
def _predict_odd(m, skipped, n):
    """Predict a line's odd samples from the even ones."""
    cast = m.dtype.type
    for j in range(n):
        k, at = np.uint64(j), LINE + np.uint64(j + skipped)
        a, b, c, d = m[at - _U1], m[at], m[at + _U1], m[at + _U2]
        # The range of all four: a line may pass between two of them above or below both.
        m[LEAST + k], m[MOST + k] = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
        m[SUM + k] = 2 * (b + c)
        m[PREDICTED + k] = 4 * (9 * (b + c) - a - d)
        m[TWIST + k] = abs(cast(a - b - c + d))
        m[EXPECTED + k] = 0
