"""The `cdf97` method: wavelet coefficients in joint zero trees plus residuals (FORMAT.md §7).

E. Yusov, V. Turlapov 2010, §2: difference layers between the levels of a low-pass 9/7 pyramid, each
transformed inside its group, quantised, and followed by a residual that keeps the bound.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.cdf97 import trained
from terrainwave.codec.cdf97.residual import (
    BASE_BITS,
    CODED,
    FRAME,
    KNOWN,
    VOID,
    ResidualRows,
    code_residuals,
    frame_base,
    new_scratch,
    open_loop_costs,
    rounding_of,
)
from terrainwave.codec.cdf97.zerotree import (
    FRAME_COLS,
    FRAME_ROWS,
    Bands,
    Nodes,
    choose_along,
    code_tree,
    mark_labels,
    measure_roughness,
    node_offsets,
    places_of_bands,
)
from terrainwave.codec.refiner import GroupSpec, Heights, Labels, Mask, as_array
from terrainwave.codec.shared_lines import code_border
from terrainwave.codec.varint import decode_varint, encode_varint
from terrainwave.coding.filters import (
    BAND_GAINS,
    MAX_HEIGHT,
    forward_transform,
    inverse_transform,
    n_transforms,
    synthesise,
)
from terrainwave.coding.jit import kernel
from terrainwave.coding.rangecoder import (
    code_raw,
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
)
from terrainwave.coding.status import raise_for_status
from terrainwave.coding.zerotrees import JZTC, JZTR, map_of_labels
from terrainwave.errors import CorruptStreamError, TruncatedStreamError

# Fraction bits of wavelet coefficients, and their largest value: with it no stream can overflow the
# inverse transform (proof: tests/coding/test_filters.py). Larger ones are clamped, and residuals
# correct that.
FRACTION_BITS = 6
MAX_COEFF = 1 << 40
MAX_INDEX = 1 << 30

_HAS_COEFFS, _HAS_RESIDUALS, _IS_RAW = 1, 2, 4
# Base step in 1/16 of n/2.
_STEP_UNIT = 16
_MAX_STEP_CODE = 1 << 32


# Steps tried by effort, on the finest level and on coarser ones; 0 means no coefficients. With
# effort 1 the finest level tries the others only if the first gives many bits per sample.
_FINEST_STEPS = ((0,), (0, 40), (0, 28, 40, 64, 128))
_COARSE_STEPS = ((20,), (0, 20, 40), (0, 14, 17, 20, 27, 40, 64))
_RATE_OF_TRIALS = 1.5
# The one step of faithful files, 2.25 (delta + p / 2), which is small near 2 bits per sample (Y10
# leaves it to its reference 14, which was not available).
FAITHFUL_STEP = 36
# Bits that children pay for a parent's sample with errors spread evenly over a step.
_NOISE_BITS = 0.8


class Coding(NamedTuple):
    """The parameters in a payload's header."""

    flags: int
    step_code: int = 0
    offset: int = 0
    along: int = 0
    term_set: int = 0
    raw_width: int = 0
    raw_base: int = 0


class RegionArrays(NamedTuple):
    """Scratch arrays for one region."""

    field: NDArray[np.int64]
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    nodes: Nodes
    base: NDArray[np.int64]
    rows: ResidualRows


def _workspace(shape: tuple[int, int]) -> RegionArrays:
    rows, cols = (shape[0] + 1) >> 1, (shape[1] + 1) >> 1
    offsets = np.zeros(32, dtype=np.int64)
    n_levels = node_offsets(*shape, offsets)
    nodes = Nodes(
        offsets,
        np.empty(offsets[n_levels], dtype=np.uint8),
        np.zeros((rows, cols), dtype=np.int64),
        np.zeros((2, 3, rows + FRAME_ROWS, cols + FRAME_COLS), dtype=np.uint8),
        np.zeros((3, rows, cols), dtype=np.int64),
    )
    return RegionArrays(
        np.zeros(shape, dtype=np.int64),
        np.zeros(cols + 3, dtype=np.int64),
        np.zeros(cols + 3, dtype=np.int64),
        nodes,
        np.zeros((shape[0] + 2 * FRAME, shape[1] + 2 * FRAME), dtype=np.int64),
        new_scratch(shape[1]),
    )


class Cdf97Refiner:
    """Wavelet refiner; see `Refiner`."""

    name = "cdf97"

    def encode(
        self, spec: GroupSpec, parent: Heights | None, target: Heights, mask: Mask | None
    ) -> tuple[bytes, Heights, Labels | None]:
        """Return the payload, its decoded heights, and the zero trees of the core."""
        return _Encoder(spec, parent, target, mask).run()

    def decode(
        self, spec: GroupSpec, parent: Heights | None, mask: Mask | None, payload: bytes
    ) -> tuple[Heights, Labels | None]:
        """Rebuild the heights of ``spec.region`` and the zero trees of its core."""
        coding, start = _read_header(payload)
        border = new_decoder(payload[start:], trained.start_border_models())
        mask = as_array(mask, spec.region.shape)
        heights, is_known = _predict(spec, parent)
        core = spec.core.slices_in(spec.region)
        prediction = heights[core].copy()  # before shared lines are written
        code_border(spec, parent, None, mask, border, heights, is_known, is_nested=False)
        inner = np.ascontiguousarray(heights[core])
        trees = None
        if coding.flags & _IS_RAW:
            coded = mask[core] & ~is_known[core]
            _code_raw_heights(
                None, coding.raw_base, coding.raw_width, spec.step, coded, border, inner
            )
        else:
            work = _workspace(inner.shape)
            _measure_parent(spec, parent, work)
            _no_labels(work.nodes.labels)
            if coding.flags & _HAS_COEFFS:
                bands = _bands(spec.step, coding, n_transforms(*inner.shape))
                coder = border._replace(models=trained.start_tree_models())
                code_tree(None, work.field, bands, work.nodes, coder)
                inverse_transform(work.field, work.low, work.high)
            _fill_base(prediction, work.field, work.base)
            if spec.wants_labels:
                trees = _zero_trees(work.nodes, inner.shape)
            if coding.flags & _HAS_RESIDUALS:
                frame_base(work.base)
                code_residuals(
                    None, inner, _kinds(mask[core], is_known[core]), work.base, spec.step,
                    rounding_of(spec.step, is_coarse=spec.has_coarse_residuals),
                    trained.TERM_WEIGHTS[coding.term_set], trained.E_WEIGHTS, work.rows,
                    border._replace(models=trained.start_residual_models()),
                )  # fmt: skip
            else:
                _round_base(work.base, is_known[core], inner)
        raise_for_status(*finish_decoder(border.state, border.stream))
        heights[core] = inner
        return heights, trees


class _Encoder:
    """One encoding: state shared by all candidates, and the best of them so far."""

    def __init__(
        self, spec: GroupSpec, parent: Heights | None, target: Heights, mask: Mask | None
    ) -> None:
        self.spec = spec
        mask = as_array(mask, spec.region.shape)
        self.heights, is_known = _predict(spec, parent)
        self.core = core = spec.core.slices_in(spec.region)
        self.prediction = self.heights[core].copy()  # before shared lines are written
        self.out = np.empty(5 * target.size + 1024, dtype=np.uint8)
        self.coder = new_encoder(self.out, trained.start_border_models())
        code_border(spec, parent, target, mask, self.coder, self.heights, is_known, is_nested=False)
        self.border_state = self.coder.state.copy()
        self.is_known = np.ascontiguousarray(is_known[core])
        self.coded = mask[core] & ~self.is_known
        # The coefficients aim at the originals on the shared lines too: the decoded lines carry
        # noise of up to half a step, which would only cost coefficients.
        self.target = np.ascontiguousarray(target[core])
        self.start = np.ascontiguousarray(self.heights[core])
        self.work = _workspace(self.target.shape)
        _measure_parent(spec, parent, self.work)
        self.n_levels = n_transforms(*self.target.shape)
        self.detail = np.subtract(self.target, self.prediction, dtype=np.int64) << FRACTION_BITS
        forward_transform(self.detail, self.work.low, self.work.high)
        self.quants = np.zeros(self.target.shape, dtype=np.int32)
        self.kinds = _kinds(mask[core], self.is_known)
        self.least, self.n_bits = 0.0, 0
        self.best: tuple[bytes, Heights, Labels | None] | None = None

    def run(self) -> tuple[bytes, Heights, Labels | None]:
        """Return the payload, the heights and the zero trees of the best coding."""
        if self.spec.is_faithful:
            self.attempt(FAITHFUL_STEP)
            if self.best is None:  # indices too large: only at extreme heights
                self.attempt_raw()
        else:
            self.attempt_steps()
            if self.best is None:
                self.attempt(0)
            self.attempt_raw()
        assert self.best is not None
        payload, inner, labels = self.best
        heights = self.heights
        heights[self.core] = inner
        if labels is None or not self.spec.wants_labels:
            return payload, heights, None
        nodes = self.work.nodes._replace(labels=labels)
        return payload, heights, _zero_trees(nodes, inner.shape)

    def attempt_steps(self) -> None:
        """Try several steps; keep the smallest result, or the one that serves finer levels best."""
        effort = self.spec.effort
        for step_code in (_FINEST_STEPS if self.spec.is_finest else _COARSE_STEPS)[effort]:
            self.attempt(step_code)
            least = _RATE_OF_TRIALS * self.target.size
            if self.spec.is_finest and effort == 1 and self.n_bits < least:
                break

    def attempt(self, step_code: int) -> None:
        """Encode with this step, 0 for no coefficients; keep the result if it costs least.

        The result is dropped if an index exceeds MAX_INDEX.
        """
        coding = Coding(0, step_code)
        spec, work = self.spec, self.work
        state = self.coder.state
        state[:] = self.border_state
        labels = work.nodes.labels
        _no_labels(labels)
        work.field[:] = 0
        if step_code:
            bands = _bands(spec.step, coding, self.n_levels)
            if _quantize(self.detail, bands.steps, self.quants) > MAX_INDEX:
                return
            if mark_labels(self.quants, work.nodes.offsets, labels) or self.quants[0, 0]:
                coding = coding._replace(flags=_HAS_COEFFS, along=choose_along(self.quants))
                bands = bands._replace(along=coding.along)
                coder = self.coder._replace(models=trained.start_tree_models())
                code_tree(self.quants, work.field, bands, work.nodes, coder)
                inverse_transform(work.field, work.low, work.high)
        inner = self.start.copy()
        _fill_base(self.prediction, work.field, work.base)
        _round_base(work.base, self.is_known, inner)
        if _squared_error(self.target, inner, self.coded)[1] > spec.half:
            inner[:] = self.start
            frame_base(work.base)
            coding = coding._replace(
                flags=coding.flags | _HAS_RESIDUALS, term_set=self._choose_terms()
            )
            code_residuals(
                self.target, inner, self.kinds, work.base, spec.step,
                rounding_of(spec.step, is_coarse=spec.has_coarse_residuals),
                trained.TERM_WEIGHTS[coding.term_set], trained.E_WEIGHTS, work.rows,
                self.coder._replace(models=trained.start_residual_models()),
            )  # fmt: skip
        n_bytes = finish_encoder(state, self.out)
        header = _write_header(coding)
        n_bits = 8 * (n_bytes + len(header))
        cost = float(n_bits)
        if not spec.is_finest:
            # Noise in a parent costs its children, so the smallest payload is not the goal.
            squares, _ = _squared_error(self.target, inner, self.coded)
            cost += _NOISE_BITS * 12 * squares / spec.step**2
        if self.best is None or cost < self.least:
            self.least = cost
            self.n_bits = n_bits
            self.best = (header + self.out[:n_bytes].tobytes(), inner, labels.copy())

    def _choose_terms(self) -> int:
        """Return the set of weights that suits the framed base best, by errors on some rows."""
        sets = trained.TERM_WEIGHTS
        costs = np.zeros(sets.shape[0], dtype=np.int64)
        every = 8 if self.target.size > 16384 else 2
        open_loop_costs(
            self.target, self.kinds, self.work.base, self.spec.step, sets, every, self.work.rows,
            costs,
        )  # fmt: skip
        return int(costs.argmin())

    def attempt_raw(self) -> None:
        """Encode the samples in plain bits; keep the result if it is the smallest."""
        spec = self.spec
        valid = self.target[self.coded]
        base = int(valid.min()) if valid.size else 0
        width = (
            ((int(valid.max()) - base + spec.half) // spec.step).bit_length() if valid.size else 0
        )
        if self.best is not None and len(self.best[0]) < (width * valid.size) >> 3:
            return
        self.coder.state[:] = self.border_state
        inner = self.start.copy()
        _code_raw_heights(self.target, base, width, spec.step, self.coded, self.coder, inner)
        n_bytes = finish_encoder(self.coder.state, self.out)
        header = _write_header(Coding(_IS_RAW, raw_width=width, raw_base=base))
        if self.best is None or n_bytes + len(header) < len(self.best[0]):
            self.best = (header + self.out[:n_bytes].tobytes(), inner, None)


def _kinds(mask: Mask, is_known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Classify each sample for the residual coder: `VOID`, `CODED` or `KNOWN`."""
    kinds = np.full(mask.shape, VOID, dtype=np.uint8)
    np.copyto(kinds, CODED, where=mask)
    np.copyto(kinds, KNOWN, where=is_known)
    return kinds


def _no_labels(labels: Labels) -> None:
    """Set the labels of empty nodes, in place."""
    labels[:] = JZTC
    labels[0] = JZTR


def _zero_trees(nodes: Nodes, shape: tuple[int, int]) -> Labels:
    """Return the map of zero trees (`coding.zerotrees`) of the labels of all node grids."""
    trees = np.empty(((shape[0] + 1) >> 1, (shape[1] + 1) >> 1), dtype=np.uint8)
    if nodes.labels[0] == JZTR:
        trees[:] = n_transforms(*shape)
        return trees
    map_of_labels(nodes.labels, nodes.offsets, n_transforms(*shape), trees)
    return trees


def _predict(spec: GroupSpec, parent: Heights | None) -> tuple[Heights, NDArray[np.bool_]]:
    """Return the prediction of the region from its parent, and a fresh map of known samples."""
    heights = np.zeros(spec.region.shape, dtype=np.int32)
    if parent is not None:
        assert spec.parent_region is not None
        synthesise(
            np.ascontiguousarray(parent),
            spec.region.row - 2 * spec.parent_region.row,
            spec.region.col - 2 * spec.parent_region.col,
            np.zeros(parent.shape[1] + 4, dtype=np.int64),
            np.zeros((parent.shape[0] + 4, heights.shape[1]), dtype=np.int64),
            heights,
        )
    return heights, np.zeros(heights.shape, dtype=np.bool_)


def _measure_parent(spec: GroupSpec, parent: Heights | None, work: RegionArrays) -> None:
    """Fill the roughness of the nodes; zeros in a root block."""
    if parent is not None:
        assert spec.parent_region is not None
        measure_roughness(
            np.ascontiguousarray(parent),
            (spec.core.row >> 1) - spec.parent_region.row,
            (spec.core.col >> 1) - spec.parent_region.col,
            spec.step,
            work.nodes.rough,
        )


def _bands(step: int, coding: Coding, n_levels: int) -> Bands:
    """Return the quantiser of a payload's coefficients."""
    steps = np.empty((n_levels, 4), dtype=np.int64)
    limits = np.empty((n_levels, 4), dtype=np.int64)
    for t in range(n_levels):
        for band in range(4):
            base = coding.step_code * step
            value = (base << FRACTION_BITS) * int(BAND_GAINS[t, band]) // (_STEP_UNIT * 2 * 4096)
            steps[t, band] = min(max(value, 1), MAX_COEFF)
            limits[t, band] = MAX_COEFF // int(steps[t, band]) + 1
    return Bands(steps, limits, coding.offset, coding.along)


def _write_header(coding: Coding) -> bytes:
    out = bytearray([coding.flags])
    if coding.flags & _IS_RAW:
        out.append(coding.raw_width)
        out += encode_varint(
            coding.raw_base << 1 if coding.raw_base >= 0 else ~(coding.raw_base << 1)
        )
    if coding.flags & _HAS_COEFFS:
        out += encode_varint(coding.step_code)
        out.append(coding.offset | coding.along << 4)
    if coding.flags & _HAS_RESIDUALS:
        out.append(coding.term_set)
    return bytes(out)


def _read_header(payload: bytes) -> tuple[Coding, int]:
    if not payload:
        raise TruncatedStreamError("the payload is empty")
    flags = payload[0]
    if flags >= 8 or (flags & _IS_RAW and flags != _IS_RAW):
        raise CorruptStreamError(f"payload flags {flags:#x} are not defined")
    if flags & _IS_RAW:
        if len(payload) < 2:
            raise TruncatedStreamError("the payload ends inside its header")
        code, pos = decode_varint(payload, 2)
        base = code >> 1 if not code & 1 else ~(code >> 1)
        if payload[1] > 32 or abs(base) > MAX_HEIGHT:
            raise CorruptStreamError("raw heights outside the range of heights")
        return Coding(flags, raw_width=payload[1], raw_base=base), pos
    coding, pos = Coding(flags), 1
    if flags & _HAS_COEFFS:
        step_code, pos = decode_varint(payload, pos)
        if pos >= len(payload):
            raise TruncatedStreamError("the payload ends inside its header")
        if not 1 <= step_code <= _MAX_STEP_CODE:
            raise CorruptStreamError(f"step code {step_code} is outside 1 to {_MAX_STEP_CODE}")
        if payload[pos] >> 6:
            raise CorruptStreamError("reserved bits of the payload's header are not 0")
        coding = coding._replace(
            step_code=step_code, offset=payload[pos] & 15, along=payload[pos] >> 4
        )
        pos += 1
    if flags & _HAS_RESIDUALS:
        if pos >= len(payload):
            raise TruncatedStreamError("the payload ends inside its header")
        if payload[pos] >= trained.TERM_WEIGHTS.shape[0]:
            raise CorruptStreamError(f"set {payload[pos]} of residual weights does not exist")
        coding = coding._replace(term_set=payload[pos])
        pos += 1
    return coding, pos


def _quantize(
    detail: NDArray[np.int64], steps: NDArray[np.int64], quants: NDArray[np.int32]
) -> int:
    """Fill `quants` with indices of `detail`; return the largest index.

    An index rounds up from 0.58: 2-5 % smaller than from 0.5.
    """
    largest = 0
    for at, t, band in places_of_bands(detail.shape):
        step = int(steps[t, band])
        sizes = (np.abs(detail[at]) + (step * 27 >> 6)) // step
        largest = max(largest, int(sizes.max(initial=0)))
        quants[at] = np.sign(detail[at]) * np.minimum(sizes, MAX_INDEX)
    return largest


@kernel
def _squared_error(target, heights, coded):
    """Return the sum of squared errors of coded samples (float64) and the largest error."""
    total = 0.0
    largest = np.int64(0)
    for row in range(target.shape[0]):
        for col in range(target.shape[1]):
            if coded[row, col]:
                error = np.int64(target[row, col]) - np.int64(heights[row, col])
                largest = max(largest, abs(error))
                total += float(error) * float(error)
    return total, largest


@kernel
def _fill_base(predicted, field, base):
    """Fill the inside of `base` with predicted heights plus detail, in 1/64."""
    limit = MAX_HEIGHT << BASE_BITS
    for row in range(field.shape[0]):
        line = base[row + FRAME]
        for col in range(field.shape[1]):
            value = (np.int64(predicted[row, col]) << BASE_BITS) + field[row, col]
            line[col + FRAME] = min(max(value, -limit), limit)


@kernel
def _round_base(base, is_known, heights):
    """Set `heights` to the rounded base where nothing is known, in place."""
    half = 1 << (BASE_BITS - 1)
    for row in range(heights.shape[0]):
        for col in range(heights.shape[1]):
            if not is_known[row, col]:
                heights[row, col] = (base[row + FRAME, col + FRAME] + half) >> BASE_BITS


@kernel
def _code_raw_heights(target, base, width, step, coded, coder, heights):
    """Encode round((target - base) / step) in `width` bits each, or decode if `target` is None.

    Fills `heights`.
    """
    most = 2 * MAX_HEIGHT // step + 1
    for row in range(heights.shape[0]):
        for col in range(heights.shape[1]):
            if coded[row, col]:
                index = np.int64(0)
                if target is not None:
                    index = (np.int64(target[row, col]) - base + (step >> 1)) // step
                index = min(code_raw(coder, width, index), most)
                heights[row, col] = min(base + index * step, MAX_HEIGHT)
