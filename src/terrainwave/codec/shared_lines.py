"""Lines that neighbouring groups share, coded from only the line itself (FORMAT.md §7.3).

E. Yusov, V. Turlapov 2010, §2.3 codes contours around each group for the same purpose. Here each
line is predicted in one dimension from the parent's decoded samples on it. Both neighbours hold
these identically, so both decode the same bits without seeing each other.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.corrections import correct, corrected
from terrainwave.codec.magnitudes import BIN_OF_SUM, N_BINS, SUM_LIMIT
from terrainwave.codec.refiner import FREE, NO_CORRECTIONS, Corrections, GroupSpec, Mask
from terrainwave.coding.filters import MAX_HEIGHT, extend_line, synthesise_line
from terrainwave.coding.jit import kernel, rare_kernel
from terrainwave.coding.rangecoder import (
    N_PREFIX,
    N_UNARY,
    Coder,
    code_bit,
    code_magnitude,
    code_raw,
)

# Models: a zero flag and unary steps for each (pass, context bin). Passes: even samples, odd ones,
# corners of a root block; the last two have models and no samples.
_N_PASSES = 5
_MAG_MODELS = _N_PASSES * N_BINS
_PREFIX_MODELS = _MAG_MODELS + _N_PASSES * N_BINS * N_UNARY
N_BORDER_MODELS = _PREFIX_MODELS + _N_PASSES * N_PREFIX
_EVEN, _ODD, _ROOT = 0, 1, 2
# Context sum of corner samples and of samples on the fixed grid, which have no neighbours yet.
_ALONE = 16

_SYNTHESIS_BITS = 14
_LIMITS = -MAX_HEIGHT, MAX_HEIGHT


class SharedLine(NamedTuple):
    """One line to code: its position in the region, and that of the parent's lines under it.

    Samples run along rows (`is_column` False: a row) or columns; `place` is the fixed index.
    ``first`` … ``stop`` - 1 are coded, the samples before and after are corner patches; `start` is
    the region index of the segment's sample 0 and `n` its length.
    """

    is_column: bool
    place: int
    start: int
    n: int
    first: int
    stop: int


class Plan(NamedTuple):
    """Shared samples of a region: corner samples, then lines, in coding order."""

    corners: list[tuple[int, int]]
    lines: list[SharedLine]


def plan_border(spec: GroupSpec) -> Plan:
    """Return the corner samples and the lines of `spec`, in indices of its region."""
    n_rows, n_cols = spec.region.shape
    top, left = spec.core.row - spec.region.row, spec.core.col - spec.region.col
    bottom, right = top + spec.core.n_rows - 1, left + spec.core.n_cols - 1
    reach = spec.rings >> 1
    shared = spec.shared
    rows = [row for row, is_shared in ((top, shared.top), (bottom, shared.bottom)) if is_shared]
    cols = [col for col, is_shared in ((left, shared.left), (right, shared.right)) if is_shared]

    def around(place: int, size: int) -> Iterator[int]:
        return (p for p in range(place - reach, place + reach + 1) if 0 <= p < size)

    # A dictionary keeps the order and drops duplicates, which small regions have.
    corners = dict.fromkeys(
        (r, c)
        for row in rows
        for col in cols
        for r in around(row, n_rows)
        for c in around(col, n_cols)
    )
    lines: dict[SharedLine, None] = {}
    for is_column, places, size, start, n, before, after in (
        (False, rows, n_rows, left, spec.core.n_cols, shared.left, shared.right),
        (True, cols, n_cols, top, spec.core.n_rows, shared.top, shared.bottom),
    ):
        first = reach + 1 if before else 0
        stop = n - reach - 1 if after else n
        for place in places:
            for p in around(place, size):
                lines[SharedLine(is_column, p, start, n, first, stop)] = None
    return Plan(list(corners), list(lines))


def shared_samples(spec: GroupSpec) -> Mask:
    """Return which samples of a unit's region neighbours code as well."""
    shared = np.zeros(spec.region.shape, dtype=np.bool_)
    reach = spec.rings >> 1
    core, sides = spec.core.slices_in(spec.region), spec.shared
    for at, lines, is_first, is_last in (
        (core[0], shared, sides.top, sides.bottom),
        (core[1], shared.T, sides.left, sides.right),
    ):
        if is_first:
            lines[max(at.start - reach, 0) : at.start + reach + 1] = True
        if is_last:
            lines[max(at.stop - 1 - reach, 0) : at.stop + reach] = True
    return shared


def code_border(
    spec: GroupSpec,
    parent: NDArray[np.int32] | None,
    target: NDArray[np.int32] | None,
    mask: NDArray[np.bool_],
    coder: Coder,
    heights: NDArray[np.int32],
    is_known: NDArray[np.bool_],
    *,
    is_nested: bool,
    corrections: Corrections = NO_CORRECTIONS,
) -> None:
    """Encode the shared samples of `target`, or decode them if it is None.

    Fills `heights` and sets `is_known` at the shared samples, in place. With `is_nested`, samples
    of a group on even rows and columns are the parent's and not coded; otherwise the parent is a
    low-pass level.
    """
    if parent is None:  # the root block has no neighbours
        return
    plan = plan_border(spec)
    above = _Parent(spec, parent, is_nested)
    for row, col in plan.corners:
        goal = None if target is None else int(target[row, col])
        prediction, is_inherited = above.predict_corner(row, col)
        is_coded = bool(mask[row, col]) and not is_inherited
        height = _code_corner(goal, prediction, is_coded, spec.step, coder)
        if not is_inherited:
            height = put_back(height, spec, corrections, row * spec.region.n_cols + col)
        heights[row, col] = height
        is_known[row, col] = True
    for line in plan.lines:
        if line.first >= line.stop:
            continue
        at = slice(line.start, line.start + line.n)
        index = (at, line.place) if line.is_column else (line.place, at)
        goals = None if target is None else np.ascontiguousarray(target[index])
        coded = mask[index].copy()
        # Only corner samples before `first` and after `stop` are used.
        decoded = heights[index].astype(np.int64)
        predicted, is_inherited = above.predict_line(line)
        if is_inherited:
            coded[::2] = False
        kept, added = (part[index].copy() if part.size else part.ravel() for part in corrections)
        if is_inherited and added.size:
            kept[::2] = FREE
        _code_line(
            goals, predicted, coded, spec.step, line.first, line.stop, coder, decoded, kept, added,
            (np.int64(spec.z_min), np.int64(spec.z_max)),
        )  # fmt: skip
        if kept.size:
            corrections.added[index] = added
        inner = slice(line.start + line.first, line.start + line.stop)
        index = (inner, line.place) if line.is_column else (line.place, inner)
        heights[index] = decoded[line.first : line.stop]
        is_known[index] = True


def put_back(height: int, spec: GroupSpec, corrections: Corrections, place: int) -> int:
    """Return a corrected height outside of lattices; `place` counts the region's samples."""
    kept, added = corrections.kept.reshape(-1), corrections.added.reshape(-1)
    return int(correct(height, kept, added, place, _LIMITS, (spec.z_min, spec.z_max)))


class _Parent:
    """A parent's decoded heights, and their predictions of the lines its group shares."""

    def __init__(self, spec: GroupSpec, heights: NDArray[np.int32], is_nested: bool) -> None:
        assert spec.parent_region is not None
        self._heights = heights
        self._row_offset = spec.region.row - 2 * spec.parent_region.row
        self._col_offset = spec.region.col - 2 * spec.parent_region.col
        self._is_nested = is_nested

    def predict_corner(self, row: int, col: int) -> tuple[int, bool]:
        """Return the mean of the four samples around a position, and whether it is one of them."""
        heights = self._heights
        r, c = row + self._row_offset, col + self._col_offset
        last_row, last_col = heights.shape[0] - 1, heights.shape[1] - 1
        r0, r1 = min(r >> 1, last_row), min((r + 1) >> 1, last_row)
        c0, c1 = min(c >> 1, last_col), min((c + 1) >> 1, last_col)
        total = int(heights[r0, c0]) + int(heights[r0, c1]) + int(heights[r1, c0])
        is_inherited = self._is_nested and not (r & 1 or c & 1)
        return total + int(heights[r1, c1]) + 2 >> 2, is_inherited

    def predict_line(self, line: SharedLine) -> tuple[NDArray[np.int64], bool]:
        """Return a line predicted from two, and whether its even samples are the parent's."""
        along, across = self._row_offset, self._col_offset
        parents = self._heights.T
        if not line.is_column:
            along, across, parents = across, along, self._heights
        begin, n_parent = (line.start + along) >> 1, (line.n + 1) >> 1
        place, last = line.place + across, parents.shape[0] - 1
        pairs = parents[min(place >> 1, last), begin : begin + n_parent].astype(np.int64)
        pairs += parents[min((place + 1) >> 1, last), begin : begin + n_parent]
        predicted = np.zeros(line.n, dtype=np.int64)
        if self._is_nested:
            _interpolate_line(pairs, predicted)
            return predicted, not place & 1
        extended = np.zeros(n_parent + 4, dtype=np.int64)
        extended[2:-2] = pairs
        _predict_line(extended, n_parent, predicted)
        return predicted, False


@kernel
def _predict_line(extended, n_parent, predicted):
    """Fill `predicted` from the sum of two parent lines: synthesis, rounded half up."""
    extend_line(extended, n_parent)
    synthesise_line(extended, np.int64(0), predicted)
    for i in range(predicted.shape[0]):
        predicted[i] = (predicted[i] + (1 << _SYNTHESIS_BITS)) >> (_SYNTHESIS_BITS + 1)


@kernel
def _code_index(index, pass_, sums, coder):
    """Code a signed index: zero flag, magnitude, sign; return it."""
    zero = pass_ * N_BINS + np.int64(BIN_OF_SUM[min(sums, SUM_LIMIT)])
    if not code_bit(coder, zero, np.int64(index != 0)):
        return np.int64(0)
    first = _MAG_MODELS + zero * N_UNARY
    prefix = _PREFIX_MODELS + pass_ * N_PREFIX
    mag = code_magnitude(coder, first, prefix, np.int64(0), abs(index) - 1) + 1
    return -mag if code_raw(coder, np.int64(1), np.int64(index < 0)) else mag


@kernel
def _quantum_index(error, step):
    """Return `error` / `step` rounded to the nearest; `step` is odd, so there are no ties."""
    index = (abs(error) + (step >> 1)) // step
    return index if error >= 0 else -index


@kernel
def _rebuild(prediction, index, step):
    """Return ``prediction + index * step``, clamped to the range of heights without overflow."""
    most = 4 * MAX_HEIGHT // step + 1
    height = prediction + min(max(index, -most), most) * step
    return min(max(height, -MAX_HEIGHT), MAX_HEIGHT)


@rare_kernel
def code_root_sample(goal, is_coded, step, coder):
    """Encode a sample on the fixed grid, or decode it if `goal` is None; return its height."""
    index = np.int64(0)
    if is_coded:
        if goal is not None:
            index = np.int64(goal) // step
        index = _code_index(index, np.int64(_ROOT), np.int64(_ALONE), coder)
    return _rebuild(np.int64(step >> 1), index, step)


@kernel
def _code_corner(goal, prediction, is_coded, step, coder):
    """Encode a predicted corner sample, or decode it if `goal` is None; return its height."""
    index = np.int64(0)
    if is_coded:
        if goal is not None:
            index = _quantum_index(goal - prediction, step)
        index = _code_index(index, np.int64(_EVEN), np.int64(_ALONE), coder)
    return _rebuild(np.int64(prediction), index, step)


@kernel
def _code_line(
    goals, predicted, mask, step, first, stop, coder, decoded, kept, added, shown
):  # fmt: skip
    """Encode samples `first` to `stop` - 1 of a line, or decode if `goals` is None.

    Fills `decoded` (int64). Even samples first, then odd ones, each predicted with its neighbours'
    known errors of prediction. `kept` and `added` are `Corrections` of the line, or empty.
    """
    n = decoded.shape[0]
    for phase in range(2):
        last = before_last = 0
        for i in range(first + ((first + phase) & 1), stop, 2):
            correction = np.int64(0)
            near = last + before_last
            if phase == 1:
                after = i + 1 if i + 1 < n else i - 1
                left, right = decoded[i - 1] - predicted[i - 1], decoded[after] - predicted[after]
                correction = (left + right) >> 1
                near = (2 * abs(left - correction) + 2 * abs(right - correction)) // step + last
            prediction = predicted[i] + correction
            index = np.int64(0)
            if mask[i]:
                bend = np.int64(0)
                if 0 < i < n - 1:
                    bend = abs(predicted[i - 1] - 2 * predicted[i] + predicted[i + 1])
                sums = 4 * near + min(8 * bend // step, 1024)
                if goals is not None:
                    index = _quantum_index(goals[i] - prediction, step)
                index = _code_index(index, phase, sums, coder)
            height = _rebuild(prediction, index, step)
            decoded[i] = corrected(height, kept, added, i, _LIMITS, shown)
            before_last = last
            last = min(abs(int(index)), 255)


@kernel
def _interpolate_line(pairs, predicted):
    """Fill `predicted` from `pairs`, twice the values at even positions, rounding half up.

    Between four samples (-1, 9, 9, -1) / 16; at an end the missing one is mirrored about the end.
    """
    n_pairs = pairs.shape[0]
    for i in range(predicted.shape[0]):
        k = i >> 1
        if i & 1 == 0:
            predicted[i] = (pairs[k] + 1) >> 1
        elif k + 1 >= n_pairs:
            # After the last even sample: continue as before.
            before = pairs[max(k - 1, 0)]
            predicted[i] = (3 * pairs[k] - before + 2) >> 2
        else:
            left = pairs[k - 1] if k > 0 else pairs[k + 1]
            right = pairs[k + 2] if k + 2 < n_pairs else pairs[k]
            predicted[i] = (9 * (pairs[k] + pairs[k + 1]) - left - right + 16) >> 5
