"""The `predictive` method: nested grids, fitted stencils, closed-loop quantising (FORMAT.md).

Each sample is predicted from everything decoded so far and its error quantised around zero, so that
it comes back within the bound on every level, in one stage.
"""

import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.magnitudes import N_DETAIL_MODELS, N_MIXERS, cell_limits
from terrainwave.codec.planes import (
    PAD,
    PASSES,
    A,
    Pass,
    fill_bends,
    fill_between,
    fill_frame,
    merge,
    parity,
    plane_sizes,
    split,
)
from terrainwave.codec.predictive import trained
from terrainwave.codec.predictive.file_tables import (
    PLANES,
    FileTables,
    Tables,
    all_tables,
    pack_file_tables,
    parse_file_tables,
)
from terrainwave.codec.predictive.fit import features_of, fit_features, fit_tables, windows_of
from terrainwave.codec.predictive.passes import (
    CODED,
    KNOWN,
    N_ROW_BUFFERS,
    VOID,
    Arrays,
    PassTables,
    Range,
    code_pass,
    fill_noisy,
    fits_narrow,
    n_reached,
    open_loop_cost,
)
from terrainwave.codec.refiner import (
    NO_CORRECTIONS,
    Corrections,
    Each,
    GroupSpec,
    Heights,
    Labels,
    Mask,
    as_array,
)
from terrainwave.codec.shared_lines import N_BORDER_MODELS, code_border, code_root_sample, put_back
from terrainwave.coding.rangecoder import (
    OUT_POS,
    RANGE,
    Coder,
    code_raw,
    finish_decoder,
    finish_encoder,
    n_bytes_begun,
    new_decoder,
    new_encoder,
    new_mixers,
)
from terrainwave.coding.status import raise_for_status
from terrainwave.errors import CorruptStreamError, TruncatedStreamError
from terrainwave.grid.quadtree import Grid, Region
from terrainwave.grid.sample_windows import HeightsOf, MaskOf

_MIXED, _CLAMP = 1, 2
# Lattices of fewer samples use the first stencil set; others state theirs.
_MIN_CHOICE = 1024
_SET_BITS = 4
# Classes of context weights: mean details below 0.12 and 0.7 (in 1/256), and above.
CLASS_LIMITS = (31, 179)
_N_CLASSES = 3
# By effort: number of stencil sets to try, and their largest distance in cost (%) from the best.
_N_TRIALS = (1, 2, 8)
_CLOSE = (100, 106, 140)
# Feature weights fitted to the file must save this multiple of their own bits.
_WORTH = 2
_WINDOW = 80
# Largest lattice, in samples, whose arrays a thread keeps for the next one.
_MAX_KEPT = 1 << 20


# By plane: features of the expected magnitude and |details|, collected for fitting.
_Seen = dict[int, list[tuple[NDArray[np.float64], NDArray[np.float64]]]]


class _Unit(NamedTuple):
    """One payload being written or read: coders of details and shared lines, and its tables."""

    coder: Coder
    mixers: NDArray[np.int64]
    border: Coder
    flags: int
    tables: Tables
    seen: _Seen | None = None


class Choice(NamedTuple):
    """Tables of a plane: a set of `Tables.stencils`, a class of `Tables.e_weights`."""

    stencil_set: int
    e_class: int


class _Rows(NamedTuple):
    """Row buffers, and the largest height that occurs."""

    most: int
    narrow: NDArray[np.int32]
    wide: NDArray[np.int64]

    def of(
        self, weights: NDArray[np.int64], e_weights: NDArray[np.int64]
    ) -> NDArray[np.int32] | NDArray[np.int64]:
        """Return the faster buffers if sums with these weights fit them."""
        is_narrow = fits_narrow(self.most, weights, e_weights)
        return self.narrow if is_narrow else self.wide


class _Scratch(NamedTuple):
    """Memory of a lattice."""

    arrays: Arrays
    rows: _Rows


class _Memory(threading.local):
    """Memory of a thread, reused by lattices: fresh pages cost as much as decoding."""

    def __init__(self) -> None:
        self.memory = np.zeros(0, dtype=np.int32)

    def scratch(self, shape: tuple[int, int], most: int) -> _Scratch:
        """Return arrays for a lattice with heights within +/- `most`; errors, activity are 0."""
        n_rows, n_cols = plane_sizes(shape)[A]
        padded = n_rows + 2 * PAD, n_cols + 2 * PAD
        size = padded[0] * padded[1]
        memory = self.memory
        if memory.size < 13 * size:
            memory = np.empty(13 * size, dtype=np.int32)
            if shape[0] * shape[1] <= _MAX_KEPT:
                self.memory = memory
        planes, errors, activity = memory[: 12 * size].reshape(3, 4, *padded)
        errors.fill(0)
        activity.fill(0)
        bends = memory[12 * size : 13 * size].reshape(padded)
        rows = _Rows(
            most,
            np.zeros((N_ROW_BUFFERS, n_cols), dtype=np.int32),
            np.zeros((N_ROW_BUFFERS, n_cols), dtype=np.int64),
        )
        return _Scratch(Arrays(planes, errors, activity, bends), rows)


_WORKSPACE = _Memory()


class PredictiveRefiner:
    """The nested refiner; see `Refiner`."""

    name = "predictive"

    def __init__(self, file_tables: bytes = b"", added: FileTables | None = None) -> None:
        """Parse a file's tables, unless they are given parsed (`added`)."""
        self.file_tables = file_tables
        self._tables = all_tables(parse_file_tables(file_tables) if added is None else added)

    def fitted(
        self,
        grid: Grid,
        step: int,
        heights: HeightsOf,
        mask: MaskOf,
        *,
        each: Each = map,  # noqa: ARG002, coding takes most of the time
    ) -> "PredictiveRefiner":
        """Return a refiner with tables fitted to a raster, if they are worth their bytes.

        `heights` and `mask` return targets and validity of a region of a level.
        """
        added = fit_tables(grid, step, heights, mask)
        windows = windows_of(grid, 0, heights, mask, _WINDOW)
        e_weights = _fit_e_weights(added, windows, step, grid.n_rows * grid.n_cols)
        added = added._replace(e_weights=e_weights)
        return PredictiveRefiner(pack_file_tables(added), added)

    def encode(
        self,
        spec: GroupSpec,
        parent: Heights | None,
        target: Heights,
        mask: Mask | None,
        corrections: Corrections = NO_CORRECTIONS,
    ) -> tuple[bytes, Heights, Labels | None]:
        """Return the payload and the heights that `decode` makes of it."""
        flags = _CLAMP | (_MIXED if spec.effort else 0)
        out = np.empty(6 * target.size + 1024, dtype=np.uint8)
        coder = new_encoder(out, trained.start_models(N_DETAIL_MODELS))
        unit = _new_unit(coder, flags, self._tables)
        heights = _code_unit(spec, parent, target, mask, unit, corrections)
        n_bytes = finish_encoder(coder.state, out)
        return bytes([flags]) + out[:n_bytes].tobytes(), heights, None

    def decode(
        self,
        spec: GroupSpec,
        parent: Heights | None,
        mask: Mask | None,
        payload: bytes,
        corrections: Corrections = NO_CORRECTIONS,
    ) -> tuple[Heights, Labels | None]:
        """Rebuild the heights of ``spec.region``."""
        if not payload:
            raise TruncatedStreamError("the payload is empty")
        if payload[0] & ~(_MIXED | _CLAMP):
            raise CorruptStreamError(f"payload flags {payload[0]:#x} are not defined")
        coder = new_decoder(payload[1:], trained.start_models(N_DETAIL_MODELS))
        unit = _new_unit(coder, payload[0], self._tables)
        heights = _code_unit(spec, parent, None, mask, unit, corrections)
        raise_for_status(*finish_decoder(coder.state, coder.stream))
        return heights, None


def _fit_e_weights(
    added: FileTables, windows: list[tuple[Heights, Mask]], step: int, n_in_file: int
) -> dict[int, NDArray[np.int64] | None]:
    """Return feature weights by plane fitted to coded windows, None if not worth storing."""
    none: dict[int, NDArray[np.int64] | None] = dict.fromkeys(PLANES)
    seen: _Seen = {plane: [] for plane in PLANES}
    tables = all_tables(added)
    # Windows of one colour of a chessboard are for fitting, the others for validation.
    judges = windows[1::2]
    for window in windows[::2]:
        _code_window(*window, step, tables, seen)
        coded = [part[1] for parts in seen.values() for part in parts]
        n_coded = sum(sizes.size for sizes in coded)
        if 256 * sum(int(sizes.sum()) for sizes in coded) < CLASS_LIMITS[-1] * max(n_coded, 1):
            return none  # few details: their size doesn't matter
    weights = dict(none)
    for plane, parts in seen.items():
        if not parts:
            continue
        sizes = np.concatenate([part[1] for part in parts])
        if int(256 * sizes.sum()) >= CLASS_LIMITS[-1] * sizes.size:
            weights[plane] = fit_features(np.concatenate([part[0] for part in parts]), sizes)
    if not judges or all(weights[plane] is None for plane in PLANES):
        return none
    both = added._replace(e_weights=weights)
    n_bits = sum(_code_window(*window, step, tables, None) for window in judges)
    n_bits -= sum(_code_window(*window, step, all_tables(both), None) for window in judges)
    n_stored = 8 * (len(pack_file_tables(both)) - len(pack_file_tables(added)))
    n_judged = sum(mask.size for _, mask in judges)
    return weights if n_bits * n_in_file > _WORTH * n_stored * n_judged else none


def _code_window(
    target: Heights, mask: Mask, step: int, all_sets: Tables, seen: _Seen | None
) -> int:
    """Return the bits of a window coded separately, given its even samples; append to `seen`."""
    low, high = int(target.min()), int(target.max())
    region = Region(0, 0, *target.shape)
    spec = GroupSpec.alone(region, step, low, high)
    out = np.empty(6 * target.size + 1024, dtype=np.uint8)
    coder = new_encoder(out, trained.start_models(N_DETAIL_MODELS))
    unit = _new_unit(coder, _CLAMP | _MIXED, all_sets, seen)
    kinds = np.where(mask, CODED, VOID).astype(np.uint8)
    coarse = np.ascontiguousarray(target[::2, ::2])
    padded = np.zeros((coarse.shape[0] + 2 * PAD, coarse.shape[1] + 2 * PAD), dtype=np.int32)
    fill_noisy(coarse, padded, step)
    heights = np.zeros_like(target)
    heights[::2, ::2] = padded[PAD:-PAD, PAD:-PAD]
    _code_lattice(heights, kinds, target, spec, unit)
    return 8 * finish_encoder(coder.state, out)


def _new_unit(coder: Coder, flags: int, all_sets: Tables, seen: _Seen | None = None) -> _Unit:
    border = coder._replace(models=trained.start_border_models(N_BORDER_MODELS))
    return _Unit(coder, new_mixers(N_MIXERS), border, flags, all_sets, seen)


def _code_unit(
    spec: GroupSpec,
    parent: Heights | None,
    target: Heights | None,
    mask: Mask | None,
    unit: _Unit,
    corrections: Corrections,
) -> Heights:
    """Encode `target`, or decode if it is None; return the decoded heights of the region."""
    heights = np.zeros(spec.region.shape, dtype=np.int32)
    is_known = np.zeros(spec.region.shape, dtype=np.bool_)
    mask = as_array(mask, spec.region.shape)
    core = spec.core.slices_in(spec.region)
    code_border(
        spec, parent, target, mask, unit.border, heights, is_known, is_nested=True,
        corrections=corrections,
    )  # fmt: skip
    inner = np.ascontiguousarray(heights[core])
    kinds = mask[core].astype(np.uint8)  # CODED or VOID
    if any(spec.shared):
        kinds[is_known[core]] = KNOWN
    goal = None if target is None else np.ascontiguousarray(target[core])
    if parent is None:
        stride = 1
        while stride < max(inner.shape) - 1:
            stride *= 2
        _code_corners(inner, kinds, goal, stride, spec, unit.border, corrections)
        while stride > 1:
            stride >>= 1
            at = slice(None, None, stride)
            part = np.ascontiguousarray(inner[at, at])
            goal_part = None if goal is None else goal[at, at]
            changes = _part(corrections, (at, at))
            _code_lattice(part, np.ascontiguousarray(kinds[at, at]), goal_part, spec, unit, changes)
            inner[at, at] = part
    else:
        assert spec.parent_region is not None
        row = (spec.core.row >> 1) - spec.parent_region.row
        col = (spec.core.col >> 1) - spec.parent_region.col
        n_rows, n_cols = plane_sizes(inner.shape)[A]
        inner[::2, ::2] = parent[row : row + n_rows, col : col + n_cols]
        _code_lattice(inner, kinds, goal, spec, unit, _part(corrections, core))
    if inner.base is not heights:
        heights[core] = inner
    return heights


def _code_corners(
    inner: Heights,
    kinds: NDArray[np.uint8],
    goal: Heights | None,
    stride: int,
    spec: GroupSpec,
    coder: Coder,
    corrections: Corrections,
) -> None:
    """Code the samples that no pass reaches, those on multiples of `stride`, on the fixed grid."""
    for row in range(0, inner.shape[0], stride):
        for col in range(0, inner.shape[1], stride):
            if kinds[row, col] != KNOWN:
                height = None if goal is None else int(goal[row, col])
                height = code_root_sample(height, kinds[row, col] == CODED, spec.step, coder)
                place = row * inner.shape[1] + col
                inner[row, col] = put_back(height, spec, corrections, place)


def _code_lattice(
    heights: Heights,
    kinds: NDArray[np.uint8],
    goal: Heights | None,
    spec: GroupSpec,
    unit: _Unit,
    corrections: Corrections = NO_CORRECTIONS,
) -> None:
    """Code the three passes of a lattice; `heights` holds the coarse and the known samples."""
    shape = heights.shape
    sizes = plane_sizes(shape)
    most = max(abs(spec.z_min), abs(spec.z_max)) + spec.step
    most = max(most, -int(heights.min()), int(heights.max()))
    scratch = _WORKSPACE.scratch(shape, most)
    planes, errors, activity, bends = scratch.arrays
    if goal is not None:
        planes.fill(0)  # `_choose` uses the rims of planes before they are coded
    split(heights, planes)
    fill_frame(planes[A], 0, 0, *shape)
    if min(shape) == 1:
        fill_between(planes)
        split(heights, planes)
    fill_bends(planes[A], most, bends)
    for geometry in PASSES:
        own = geometry.plane
        if 0 in sizes[own]:
            continue
        row_parity, col_parity = parity(own)
        own_kinds = np.ascontiguousarray(kinds[row_parity::2, col_parity::2])
        own_goal = None
        if goal is not None:
            own_goal = np.ascontiguousarray(goal[row_parity::2, col_parity::2])
        own_part = slice(row_parity, None, 2), slice(col_parity, None, 2)
        changes = Corrections(*map(np.ascontiguousarray, _part(corrections, own_part)))
        plane = _Plane(own_goal, own_kinds, geometry, spec, scratch, unit, changes)
        if shape[0] * shape[1] < _MIN_CHOICE:
            plane.code(Choice(0, _N_CLASSES - 1))
        elif own_goal is None:
            plane.code(plane.read_choice())
        else:
            plane.encode_smallest(own_goal)
        if changes.kept.size:
            corrections.added[own_part] = changes.added
        fill_frame(planes[own], row_parity, col_parity, *shape)
        fill_frame(errors[own], row_parity, col_parity, *shape)
        fill_frame(activity[own], row_parity, col_parity, *shape)
    merge(planes, heights)


def _part(corrections: Corrections, at: tuple[slice, slice]) -> Corrections:
    """Return views of corrections at some samples; empty ones stay empty."""
    return Corrections(*(part[at] if part.size else part for part in corrections))


class _Plane(NamedTuple):
    """A plane of a lattice being coded."""

    goal: Heights | None
    kinds: NDArray[np.uint8]
    geometry: Pass
    spec: GroupSpec
    scratch: _Scratch
    unit: _Unit
    corrections: Corrections

    @property
    def stencils(self) -> NDArray[np.int64]:
        return self.unit.tables.stencils[self.geometry.plane]

    @property
    def e_weights(self) -> NDArray[np.int64]:
        return self.unit.tables.e_weights[self.geometry.plane]

    def code(self, choice: Choice) -> None:
        """Encode or decode the plane with the tables chosen."""
        own, spec, unit, arrays = self.geometry.plane, self.spec, self.unit, self.scratch.arrays
        weights, e_weights = self.stencils[choice.stencil_set], self.e_weights[choice.e_class]
        limits = cell_limits(spec.step) if unit.flags & _MIXED else None
        tables = PassTables(weights, e_weights, bool(unit.flags & _CLAMP), limits)
        code_pass(
            self.goal, self.kinds, arrays, self.geometry, tables,
            Range(spec.step, spec.z_min, spec.z_max), self.scratch.rows.of(weights, e_weights),
            unit.coder, unit.mixers, Corrections(*(part.ravel() for part in self.corrections)),
        )  # fmt: skip
        if unit.seen is not None:
            unit.seen[own].append(features_of(self.kinds, arrays, self.geometry, tables, spec.step))

    def read_choice(self) -> Choice:
        code = int(code_raw(self.unit.coder, _SET_BITS + 2, 0))
        choice = Choice(code >> 2, code & 3)
        if choice.stencil_set >= len(self.stencils) or choice.e_class >= len(self.e_weights):
            raise CorruptStreamError(f"stencil set and contexts {code} do not exist")
        return choice

    def encode_smallest(self, goal: Heights) -> None:
        """Encode the plane with the one of several choices that takes least, and that choice.

        The likeliest is tried last, so that the result of the last trial usually needs no copy.
        """
        choices = self._choices(goal)
        own, coder = self.geometry.plane, self.unit.coder
        planes, errors, activity, _ = self.scratch.arrays
        # Bytes before this one are final.
        first = max(int(coder.state[OUT_POS]), 0)
        arrays = [
            coder.state, coder.models, self.unit.mixers, coder.stream[first:],
            planes[own], errors[own], activity[own], self.corrections.added,
        ]  # fmt: skip
        start = [array.copy() for array in arrays[:3]] if len(choices) > 1 else []
        known = planes[own].copy() if len(choices) > 1 else planes[own]
        kept: list[NDArray[np.generic]] = []
        smallest = 1 << 62
        for n_left, choice in reversed(list(enumerate(choices))):
            if start and n_left < len(choices) - 1:
                coder.state[:], coder.models[:], self.unit.mixers[:] = start
                planes[own] = known
            code_raw(coder, _SET_BITS + 2, choice.stencil_set * 4 + choice.e_class)
            self.code(choice)
            n_bits = 8 * int(n_bytes_begun(coder.state)) - int(coder.state[RANGE]).bit_length()
            if n_bits <= smallest:
                smallest, kept = n_bits, []
                if n_left:
                    arrays[3] = coder.stream[first : max(int(coder.state[OUT_POS]), first)]
                    kept = [array.copy() for array in arrays]
        for array, values in zip(arrays, kept, strict=False):
            array[:] = values

    def _choices(self, goal: Heights) -> list[Choice]:
        """Return the stencil sets and classes of contexts to try, the likeliest first.

        Sets are ranked by their errors on some rows; the best few, if close, are worth trying. If
        heights must stay, only the set that they were coded with is: with another one, each would
        take a correction.
        """
        own, spec, planes = self.geometry.plane, self.spec, self.scratch.arrays.planes
        saved = planes[own].copy()
        fill_noisy(goal, planes[own], spec.step)
        every = 8 if goal.size > 16384 else 2
        costs = [
            open_loop_cost(
                goal, self.kinds, planes, own, self.geometry, weights, spec.step, every,
                self.scratch.rows.of(weights, self.e_weights[0]),
            )
            for weights in self.stencils
        ]  # fmt: skip
        coded_with = self._set_of_kept(goal)
        planes[own] = saved
        ranking = sorted(range(len(costs)), key=lambda k: costs[k][0])
        # Costs include 64, log8(256), for each sample, whatever its error.
        base = 64 * costs[0][2]
        limit = base + (costs[ranking[0]][0] - base) * _CLOSE[spec.effort] // 100
        ranking = [k for k in ranking[: _N_TRIALS[spec.effort]] if costs[k][0] <= limit]
        if coded_with is not None:
            ranking = [coded_with]
        # A file's own weights replace the last class.
        last = len(self.e_weights) - 1
        classes = {k: sum(costs[k][1] >= edge for edge in CLASS_LIMITS) for k in ranking}
        return [
            Choice(k, last if classes[k] == _N_CLASSES - 1 else classes[k]) for k in ranking
        ] or [Choice(0, _N_CLASSES - 1)]

    def _set_of_kept(self, goal: Heights) -> int | None:
        """Return the stencil set that reaches most heights that must stay; None if it reaches none.

        Overwrites the plane.
        """
        kept, spec, planes = self.corrections.kept, self.spec, self.scratch.arrays.planes
        if not kept.size:
            return None
        own, n_rows, n_cols = self.geometry.plane, *goal.shape
        planes[own, PAD : PAD + n_rows, PAD : PAD + n_cols] = goal
        reached = [
            n_reached(
                goal, self.kinds, kept.ravel(), planes, own, self.geometry, weights,
                bool(self.unit.flags & _CLAMP), spec.step, spec.z_min, spec.z_max,
                self.scratch.rows.of(weights, self.e_weights[0]),
            )
            for weights in self.stencils
        ]  # fmt: skip
        most = int(np.argmax(reached))
        return most if reached[most] else None
