"""Lines that neighbouring groups share, coded from the line alone (FORMAT.md §7.3).

D. Yusov, V. Turlapov 2010, §2.3 codes contours around each group for the same end. Here each line
is predicted in one dimension from the parent's decoded samples on it, which both neighbours hold
identically, so both decode the same bits without seeing each other (DESIGN.md §3.3).
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.refiner import GroupSpec
from terrainwave.codec.zerotree import (
    BIN_OF_SUM,
    N_BINS,
    SUM_LIMIT,
    decode_magnitude_at,
    encode_magnitude_at,
)
from terrainwave.coding.filters import MAX_HEIGHT, extend_line, synthesise_line
from terrainwave.coding.jit import kernel
from terrainwave.coding.rangecoder import (
    LOW,
    N_PREFIX,
    N_UNARY,
    RANGE,
    decode_bit,
    decode_raw,
    encode_bit,
    encode_raw,
)

# Models: a zero flag and unary steps for each (pass, context bin). Passes: even and odd samples;
# in a root block strides of 4 or more, 2 and 1.
_N_PASSES = 5
_MAG_MODELS = _N_PASSES * N_BINS
_PREFIX_MODELS = _MAG_MODELS + _N_PASSES * N_BINS * N_UNARY
N_BORDER_MODELS = _PREFIX_MODELS + _N_PASSES * N_PREFIX
_EVEN, _ODD, _ROOT = 0, 1, 2

_SYNTHESIS_BITS = 14


class Line(NamedTuple):
    """One line to code: its place in the region, and the place of the parent's lines under it.

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
    """What is shared in a region: corner samples, then lines, in coding order."""

    corners: list[tuple[int, int]]
    lines: list[Line]


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

    # A dictionary keeps order and drops what small regions meet twice.
    corners = dict.fromkeys(
        (r, c)
        for row in rows
        for col in cols
        for r in around(row, n_rows)
        for c in around(col, n_cols)
    )
    lines: dict[Line, None] = {}
    for is_column, places, size, start, n, before, after in (
        (False, rows, n_rows, left, spec.core.n_cols, shared.left, shared.right),
        (True, cols, n_cols, top, spec.core.n_rows, shared.top, shared.bottom),
    ):
        first = reach + 1 if before else 0
        stop = n - reach - 1 if after else n
        for place in places:
            for p in around(place, size):
                lines[Line(is_column, p, start, n, first, stop)] = None
    return Plan(list(corners), list(lines))


def code_border(
    spec: GroupSpec,
    parent: NDArray[np.int32] | None,
    target: NDArray[np.int32] | None,
    mask: NDArray[np.bool_],
    heights: NDArray[np.int32],
    is_known: NDArray[np.bool_],
    state: NDArray[np.int64],
    stream: NDArray[np.uint8],
    models: NDArray[np.uint32],
    *,
    is_nested: bool,
) -> None:
    """Encode the shared samples of `target`, or decode them where it is None.

    Fills `heights` and sets `is_known` at the shared samples, in place. With `is_nested`, samples
    of a group on even rows and columns are the parent's, not coded; without, the parent is a
    low-pass level.
    """
    plan = plan_border(spec)
    encoding = target is not None
    source = heights if target is None else target
    above = None if parent is None else _Parent(spec, parent, is_nested)
    streams = state, stream, models
    for row, col in plan.corners:
        prediction, is_coded = 0, bool(mask[row, col])
        if above is not None:
            prediction, is_inherited = above.predict_corner(row, col)
            is_coded = is_coded and not is_inherited
        heights[row, col] = code_corner(
            encoding, prediction, int(source[row, col]), is_coded, above is None, spec.step,
            *streams,
        )  # fmt: skip
        is_known[row, col] = True
    for line in plan.lines:
        if line.first >= line.stop:
            continue
        at = slice(line.start, line.start + line.n)
        index = (at, line.place) if line.is_column else (line.place, at)
        goal = np.ascontiguousarray(source[index])
        coded = mask[index].copy()
        # Only what lies before `first` and after `stop` is looked at: corner samples.
        decoded = heights[index].astype(np.int64)
        if above is None:
            known = np.ones(line.n, dtype=np.bool_)
            known[line.first : line.stop] = False
            _code_closed_line(encoding, goal, coded, known, spec.step, decoded, *streams)
        else:
            predicted, is_inherited = above.predict_line(line)
            if is_inherited:
                coded[::2] = False
            _code_line(
                encoding, predicted, goal, coded, spec.step, line.first, line.stop, decoded,
                *streams,
            )  # fmt: skip
        inner = slice(line.start + line.first, line.start + line.stop)
        index = (inner, line.place) if line.is_column else (line.place, inner)
        heights[index] = decoded[line.first : line.stop]
        is_known[index] = True


class _Parent:
    """A parent's decoded heights, and what they predict on the lines its group shares."""

    def __init__(self, spec: GroupSpec, heights: NDArray[np.int32], is_nested: bool) -> None:
        assert spec.parent_region is not None
        self._heights = heights
        self._row_offset = spec.region.row - 2 * spec.parent_region.row
        self._col_offset = spec.region.col - 2 * spec.parent_region.col
        self._is_nested = is_nested

    def predict_corner(self, row: int, col: int) -> tuple[int, bool]:
        """Return the mean of the four samples around a place, and whether it is one of them."""
        heights = self._heights
        r, c = row + self._row_offset, col + self._col_offset
        last_row, last_col = heights.shape[0] - 1, heights.shape[1] - 1
        r0, r1 = min(r >> 1, last_row), min((r + 1) >> 1, last_row)
        c0, c1 = min(c >> 1, last_col), min((c + 1) >> 1, last_col)
        total = int(heights[r0, c0]) + int(heights[r0, c1]) + int(heights[r1, c0])
        is_inherited = self._is_nested and not (r & 1 or c & 1)
        return total + int(heights[r1, c1]) + 2 >> 2, is_inherited

    def predict_line(self, line: Line) -> tuple[NDArray[np.int64], bool]:
        """Return a line from the two around it, and whether its even samples are the parent's."""
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
def _code_symbol(encoding, value, pass_, sums, state, stream, models):
    """Encode or decode a signed value: zero flag, magnitude, sign; return it."""
    bin_ = np.int64(BIN_OF_SUM[min(sums, SUM_LIMIT)])
    zero = pass_ * N_BINS + bin_
    first = _MAG_MODELS + zero * N_UNARY
    prefix = _PREFIX_MODELS + pass_ * N_PREFIX
    if encoding:
        encode_bit(state, stream, models, zero, 1 if value != 0 else 0)
        if value != 0:
            state[RANGE], state[LOW] = encode_magnitude_at(
                state[RANGE],
                state[LOW],
                state,
                stream,
                models,
                first,
                prefix,
                np.int64(0),
                abs(value) - 1,
            )
            encode_raw(state, stream, 1 if value < 0 else 0, np.int64(1))
        return value
    if not decode_bit(state, stream, models, zero):
        return np.int64(0)
    value = decode_magnitude_at(state, stream, models, first, prefix, np.int64(0)) + 1
    if decode_raw(state, stream, np.int64(1)):
        return -value
    return value


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


@kernel
def code_corner(encoding, prediction, target, is_valid, is_root, step, state, stream, models):
    """Encode or decode one corner sample; return its decoded height."""
    index = np.int64(0)
    if is_valid:
        if encoding:
            index = (
                np.int64(target) // step if is_root else _quantum_index(target - prediction, step)
            )
        pass_ = _ROOT if is_root else _EVEN
        index = _code_symbol(encoding, index, pass_, np.int64(16), state, stream, models)
    if is_root:
        return _rebuild(np.int64(step >> 1), index, step)
    return _rebuild(np.int64(prediction), index, step)


@kernel
def _code_line(
    encoding, predicted, target, mask, step, first, stop, decoded, state, stream, models
):
    """Encode or decode samples `first` to `stop` - 1 of a line into `decoded` (int64).

    Even samples first, then odd ones, each corrected by what its neighbours' errors of prediction
    turned out to be.
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
                if encoding:
                    index = _quantum_index(target[i] - prediction, step)
                index = _code_symbol(
                    encoding, index, phase, min(sums, SUM_LIMIT), state, stream, models
                )
            decoded[i] = _rebuild(prediction, index, step)
            before_last = last
            last = min(abs(int(index)), 255)


@kernel
def _interpolate_line(pairs, predicted):
    """Fill `predicted` from `pairs`, twice the values at even places, rounding half up.

    Between four samples (-1, 9, 9, -1) / 16; at an end the missing one is mirrored about the end.
    """
    n_pairs = pairs.shape[0]
    for i in range(predicted.shape[0]):
        k = i >> 1
        if i & 1 == 0:
            predicted[i] = (pairs[k] + 1) >> 1
        elif k + 1 >= n_pairs:
            # Past the last even sample: go on as before.
            before = pairs[max(k - 1, 0)]
            predicted[i] = (3 * pairs[k] - before + 2) >> 2
        else:
            left = pairs[k - 1] if k > 0 else pairs[k + 1]
            right = pairs[k + 2] if k + 2 < n_pairs else pairs[k]
            predicted[i] = (9 * (pairs[k] + pairs[k + 1]) - left - right + 16) >> 5


@kernel
def _code_closed_line(encoding, target, mask, known, step, decoded, state, stream, models):
    """Encode or decode the unknown samples of a line into `decoded`, coarse to fine.

    Samples 0 and the last multiple of the largest stride that are not known lie on the fixed grid.
    """
    n = decoded.shape[0]
    mags = np.zeros(n, dtype=np.int64)
    top = 1
    while top < n - 1:
        top *= 2
    for i in range(0, n, top):
        if not known[i]:
            decoded[i] = code_corner(
                encoding, np.int64(0), target[i], mask[i], True, step, state, stream, models
            )
    stride = top >> 1
    while stride > 0:
        pass_ = _ROOT + (0 if stride > 2 else 3 - stride)
        for i in range(stride, n, 2 * stride):
            if known[i]:
                continue
            left, right = i - stride, i + stride
            near = 2 * mags[left]
            bend = np.int64(0)
            prediction = decoded[left]
            before = left - 2 * stride
            if right < n:
                prediction = (decoded[left] + decoded[right] + 1) >> 1
                near = mags[left] + mags[right]
                after = right + 2 * stride
                if before >= 0 and after < n:
                    outer = decoded[before] + decoded[after]
                    inner = decoded[left] + decoded[right]
                    prediction = (9 * inner - outer + 8) >> 4
                    bend = abs(outer - inner)
                elif before >= 0 or after < n:
                    third = decoded[before] if before >= 0 else decoded[after]
                    near_one = decoded[left] if before >= 0 else decoded[right]
                    far_one = decoded[right] if before >= 0 else decoded[left]
                    bend = 2 * abs(third - 2 * near_one + far_one)
                    prediction = (3 * far_one + 6 * near_one - third + 4) >> 3
                else:
                    bend = abs(decoded[left] - decoded[right])
            elif before >= 0:
                prediction += (decoded[left] - decoded[before]) >> 1
                bend = abs(decoded[left] - decoded[before])
            last = mags[i - 2 * stride] if i >= 2 * stride else near
            index = np.int64(0)
            if mask[i]:
                sums = 2 * near + 2 * last + min(2 * bend // step, 1024)
                if encoding:
                    index = _quantum_index(target[i] - prediction, step)
                index = _code_symbol(
                    encoding, index, pass_, min(sums, SUM_LIMIT), state, stream, models
                )
            decoded[i] = _rebuild(prediction, index, step)
            mags[i] = min(abs(index), 255)
        stride >>= 1
