"""Lines that neighbouring units share, coded from the line alone (format-rapid.md, R.3).

As `codec.border` does for the other methods, but by rows like everything of `rapid`: no sample
waits for the one before it.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.border import plan_border
from terrainwave.codec.rapid_layout import (
    EXPECTED,
    LEAST,
    LINE,
    MOST,
    PREDICTED,
    SUM,
    TWIST,
)
from terrainwave.codec.refiner import GroupSpec, Sides
from terrainwave.coding.jit import kernel_part
from terrainwave.grid.quadtree import Region

# Fields of a line in `Plan`: place of its first sample and step in the region; samples; those coded
# are first … stop - 1; the parent's lines at or before and at or after it, and the step along them;
# whether the even samples are the parent's.
START, STEP, LENGTH, FIRST, STOP, BEFORE, AFTER, PARENT_STEP, INHERITED = range(9)
# Fields of a corner: its place in the region, then the four parent samples around.
_N_AROUND = 4
# Corners are coded in rows of so many.
MOST_CORNERS = 64
_U1, _U2 = np.uint64(1), np.uint64(2)


def plan_lines(spec: GroupSpec) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return what is shared in a group: corner samples and lines, in coding order.

    Places are those in flat region and flat parent.
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
    )


@lru_cache(maxsize=256)
def _plan(
    shape: tuple[int, int],
    core: tuple[int, int, int, int],
    parent_shape: tuple[int, int],
    offset: tuple[int, int],
    shared: Sides,
    rings: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    region = Region(0, 0, *shape)
    spec = GroupSpec(1, Region(*core), region, None, shared, 1, 0, 0, (1, 0), rings, 0)
    plan = plan_border(spec)
    last = parent_shape[0] - 1, parent_shape[1] - 1
    pitch = parent_shape[1]
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
        step, between = (shape[1], 1) if line.is_column else (1, shape[1])
        parent_step, parent_between = (pitch, 1) if line.is_column else (1, pitch)
        last_line = last[1] if line.is_column else last[0]
        place, begin = line.place + across, (line.start + along) >> 1
        before, after = min(place >> 1, last_line), min((place + 1) >> 1, last_line)
        lines.append(
            [
                line.place * between + line.start * step, step, line.n, line.first, line.stop,
                before * parent_between + begin * parent_step,
                after * parent_between + begin * parent_step,
                parent_step, int(not place & 1),
            ]
        )  # fmt: skip
    return (
        np.array(corners, dtype=np.int64).reshape(-1, 1 + _N_AROUND),
        np.array(lines, dtype=np.int64).reshape(-1, INHERITED + 1),
    )


@kernel_part
def _clamped(height, origin, m, scale):
    """Return a height of the region or the parent as the workspace has it."""
    return m.dtype.type(min(max(np.int64(height) - origin, scale.low), scale.high))


@kernel_part
def _note_around(m, k, a, b, c, d):
    """Fill `LEAST`, `MOST` and `TWIST` of a sample that has four around it."""
    cast = m.dtype.type
    m[LEAST + k], m[MOST + k] = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    m[TWIST + k] = abs(cast(a - b - c + d))
    m[EXPECTED + k] = 0


@kernel_part
def prepare_corners(m, parent, corners, first, origin, scale):
    """Predict a row of samples where lines cross, each from the parent's four; return how many."""
    n = min(corners.shape[0] - first, MOST_CORNERS)
    for j in range(n):
        k = np.uint64(j)
        a = _clamped(parent[corners[first + j, 1]], origin, m, scale)
        b = _clamped(parent[corners[first + j, 2]], origin, m, scale)
        c = _clamped(parent[corners[first + j, 3]], origin, m, scale)
        d = _clamped(parent[corners[first + j, 4]], origin, m, scale)
        _note_around(m, k, a, b, c, d)
        m[SUM + k] = a + b + c + d
        m[PREDICTED + k] = 16 * m[SUM + k]
    return n


@kernel_part
def prepare_even(m, out, parent, lines, line, origin, scale):
    """Predict a line's even samples from the two parent lines, or copy them where they are one.

    Return how many are skipped, and how many are to be coded.
    """
    start, step = lines[line, START], lines[line, STEP]
    first, stop = lines[line, FIRST], lines[line, STOP]
    before, after = lines[line, BEFORE], lines[line, AFTER]
    parent_step = lines[line, PARENT_STEP]
    is_inherited = lines[line, INHERITED] != 0
    n_even = (lines[line, LENGTH] + 1) >> 1
    skipped, n = (first + 1) >> 1, ((stop + 1) >> 1) - ((first + 1) >> 1)
    for j in range(n_even):
        height = parent[before + j * parent_step]
        a = _clamped(height, origin, m, scale)
        b = _clamped(parent[after + j * parent_step], origin, m, scale)
        m[LINE + np.uint64(j)] = a if is_inherited else a + b
        if is_inherited:
            if first <= 2 * j < stop:
                out[start + 2 * j * step] = height
        elif 0 <= j - skipped < n:
            k = np.uint64(j - skipped)
            m[LEAST + k], m[MOST + k] = min(a, b), max(a, b)
    if is_inherited:
        return skipped, np.int64(0)
    _mirror_line(m, n_even)
    for j in range(n):
        k, at = np.uint64(j), LINE + np.uint64(j + skipped)
        m[SUM + k] = 2 * m[at]
        m[PREDICTED + k] = 32 * m[at]
        m[TWIST + k] = abs(m.dtype.type(m[at - _U1] - 2 * m[at] + m[at + _U1]))
        m[EXPECTED + k] = 0
    return skipped, n


@kernel_part
def prepare_odd(m, out, lines, line, origin, scale):
    """Predict a line's odd samples from the even ones, which `prepare_even` left or are in `out`.

    Return how many are skipped, and how many are to be coded.
    """
    start, step = lines[line, START], lines[line, STEP]
    n_even = (lines[line, LENGTH] + 1) >> 1
    if lines[line, INHERITED] == 0:
        for j in range(n_even):
            m[LINE + np.uint64(j)] = _clamped(out[start + 2 * j * step], origin, m, scale)
    _mirror_line(m, n_even)
    skipped = lines[line, FIRST] >> 1
    n = (lines[line, STOP] >> 1) - skipped
    for j in range(n):
        k, at = np.uint64(j), LINE + np.uint64(j + skipped)
        a, b, c, d = m[at - _U1], m[at], m[at + _U1], m[at + _U2]
        # The range of all four: a line may pass between two of them above or below both.
        _note_around(m, k, a, b, c, d)
        m[SUM + k] = 2 * (b + c)
        m[PREDICTED + k] = 4 * (9 * (b + c) - a - d)
    return skipped, n


@kernel_part
def _mirror_line(m, n):
    """Make `LINE` readable beside its first and last sample."""
    m[LINE - _U1] = m[LINE + np.uint64(min(1, n - 1))]
    before_last = m[LINE + np.uint64(max(n - 2, 0))]
    m[LINE + np.uint64(n)] = before_last
    m[LINE + np.uint64(n + 1)] = m[LINE + np.uint64(max(n - 3, 0))]
