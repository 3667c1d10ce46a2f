"""Lines that neighbouring units share, coded from the line alone (format-rapid.md, R.3).

As `codec.border` does for the other methods, but by rows like everything of `rapid`: no sample
waits for the one before it.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.border import plan_border
from terrainwave.codec.rapid_code import code_span
from terrainwave.codec.rapid_layout import (
    GOAL,
    LEAST,
    LINE,
    MOST,
    PREDICTED,
    RESULT,
    SUM,
    TWIST,
    VALID,
)
from terrainwave.codec.rapid_magnitude import expect_on_line, fill_contexts, round_predictions
from terrainwave.codec.refiner import GroupSpec, Sides
from terrainwave.coding.jit import inlined_kernel, kernel
from terrainwave.grid.quadtree import Region

# Fields of a line in `Plan`: place of its first sample and step in the region; samples; those coded
# are first … stop - 1; the parent's lines at or before and at or after it, and the step along them;
# whether the even samples are the parent's.
START, STEP, LENGTH, FIRST, STOP, BEFORE, AFTER, PARENT_STEP, INHERITED = range(9)
# Fields of a corner: its place in the region, then the four parent samples around.
_N_AROUND = 4
# Corners are coded in rows of so many.
_MOST_CORNERS = 64
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


@kernel
def code_shared(goal, valid, has_void, out, parent, corners, lines, origin, workspace, scale, s):
    """Encode or decode (`goal` None) all shared samples of a group into `out`.

    `goal`, `valid`, `out` and `parent` are flat; `corners` and `lines` are of `plan_lines`.
    """
    for first in range(0, corners.shape[0], _MOST_CORNERS):
        n = min(corners.shape[0] - first, _MOST_CORNERS)
        _code_corners(
            goal, valid, has_void, out, parent, corners, first, n, origin, workspace, scale, s
        )
    for line in range(lines.shape[0]):
        _code_line(goal, valid, has_void, out, parent, lines, line, origin, workspace, scale, s)


@inlined_kernel
def _clamped(height, origin, m, scale):
    """Return a height of the region or the parent as the workspace has it."""
    return m.dtype.type(min(max(np.int64(height) - origin, scale.low), scale.high))


@kernel
def _code_corners(
    goal, valid, has_void, out, parent, corners, first, n, origin, workspace, scale, s
):
    """Code samples where lines cross, each from the parent's four around it."""
    m = workspace.m
    cast = m.dtype.type
    for j in range(n):
        k = np.uint64(j)
        a = _clamped(parent[corners[first + j, 1]], origin, m, scale)
        b = _clamped(parent[corners[first + j, 2]], origin, m, scale)
        c = _clamped(parent[corners[first + j, 3]], origin, m, scale)
        d = _clamped(parent[corners[first + j, 4]], origin, m, scale)
        m[k + LEAST], m[k + MOST] = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
        m[k + SUM] = cast(a + b + c + d)
        m[k + PREDICTED] = cast(16 * m[k + SUM])
        m[k + TWIST] = abs(cast(a - b - c + d))
        if goal is not None:
            m[k + GOAL] = np.int64(goal[corners[first + j, 0]]) - origin
        m[k + VALID] = valid[corners[first + j, 0]] if has_void else 1
    _code_prepared(goal, n, has_void, workspace, scale, s)
    for j in range(n):
        out[corners[first + j, 0]] = m[RESULT + np.uint64(j)] + origin


@kernel
def _code_prepared(goal, n, has_void, workspace, scale, s):
    """Code `n` samples that have been predicted into `RESULT`."""
    m = workspace.m
    expect_on_line(m, n, scale)
    round_predictions(m, n, scale)
    fill_contexts(m, workspace.reals, workspace.bits_of_reals, n, scale)
    first = np.int64(0)
    code_span(goal, m, first, n, RESULT, has_void, scale, s)


@kernel
def _code_line(goal, valid, has_void, out, parent, lines, line, origin, workspace, scale, s):
    """Code a line: even samples from the two parent lines, where they aren't one; then odd ones."""
    m = workspace.m
    cast = m.dtype.type
    start, step, n = lines[line, START], lines[line, STEP], lines[line, LENGTH]
    first, stop = lines[line, FIRST], lines[line, STOP]
    before, after = lines[line, BEFORE], lines[line, AFTER]
    parent_step = lines[line, PARENT_STEP]
    n_even = (n + 1) >> 1
    if lines[line, INHERITED] == 0:
        # Predictions in `LINE`, then only those to code.
        for j in range(n_even):
            a = _clamped(parent[before + j * parent_step], origin, m, scale)
            b = _clamped(parent[after + j * parent_step], origin, m, scale)
            m[LINE + np.uint64(j)] = cast(a + b)
        _mirror_line(m, n_even)
        skipped = (first + 1) >> 1
        for j in range(skipped, (stop + 1) >> 1):
            k, at = np.uint64(j - skipped), LINE + np.uint64(j)
            a = _clamped(parent[before + j * parent_step], origin, m, scale)
            b = _clamped(parent[after + j * parent_step], origin, m, scale)
            m[k + LEAST], m[k + MOST] = min(a, b), max(a, b)
            m[k + SUM] = cast(2 * m[at])
            m[k + PREDICTED] = cast(32 * m[at])
            m[k + TWIST] = abs(cast(m[at - _U1] - 2 * m[at] + m[at + _U1]))
        _code_places(
            goal, valid, has_void, out, start + 2 * skipped * step, 2 * step,
            ((stop + 1) >> 1) - skipped, origin, workspace, scale, s,
        )  # fmt: skip
        for j in range(n_even):
            m[LINE + np.uint64(j)] = _clamped(out[start + 2 * j * step], origin, m, scale)
    else:
        for j in range(n_even):
            height = parent[before + j * parent_step]
            m[LINE + np.uint64(j)] = _clamped(height, origin, m, scale)
            if first <= 2 * j < stop:
                out[start + 2 * j * step] = height
    _mirror_line(m, n_even)
    skipped = first >> 1
    for j in range(skipped, stop >> 1):
        k, at = np.uint64(j - skipped), LINE + np.uint64(j)
        a, b, c, d = m[at - _U1], m[at], m[at + _U1], m[at + _U2]
        # The range of all four: a line may pass between two of them above or below both.
        m[k + LEAST], m[k + MOST] = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
        m[k + SUM] = cast(2 * (b + c))
        m[k + PREDICTED] = cast(4 * (9 * (b + c) - a - d))
        m[k + TWIST] = abs(cast(a - b - c + d))
    _code_places(
        goal, valid, has_void, out, start + (2 * skipped + 1) * step, 2 * step,
        (stop >> 1) - skipped, origin, workspace, scale, s,
    )  # fmt: skip


@inlined_kernel
def _mirror_line(m, n):
    """Make `LINE` readable beside its first and last sample."""
    m[LINE - _U1] = m[LINE + np.uint64(min(1, n - 1))]
    before_last = m[LINE + np.uint64(max(n - 2, 0))]
    m[LINE + np.uint64(n)] = before_last
    m[LINE + np.uint64(n + 1)] = m[LINE + np.uint64(max(n - 3, 0))]


@kernel
def _code_places(goal, valid, has_void, out, start, step, n, origin, workspace, scale, s):
    """Code `n` predicted samples that lie at every `step`-th place of `out` from `start` on."""
    m = workspace.m
    if n <= 0:
        return
    if goal is not None:
        for j in range(n):
            m[GOAL + np.uint64(j)] = np.int64(goal[start + j * step]) - origin
    for j in range(n):
        m[VALID + np.uint64(j)] = valid[start + j * step] if has_void else 1
    _code_prepared(goal, n, has_void, workspace, scale, s)
    for j in range(n):
        out[start + j * step] = m[RESULT + np.uint64(j)] + origin
