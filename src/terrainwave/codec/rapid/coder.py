"""Units of the `rapid` method: nested grids by rows, coded and decoded (docs/format-rapid.md).

Like `predictive` it predicts each sample from everything decoded so far and quantises the error
around zero. But no sample waits for its neighbour in the row, and symbols are coded with the fixed
frequencies of contexts, so that all but the symbols themselves runs in vectors.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.corrections import correct
from terrainwave.codec.memory import Spares, flat, new_heights
from terrainwave.codec.rapid.file_tables import Tables
from terrainwave.codec.rapid.layout import (
    MAX_COLS,
    Scale,
    Workspace,
    arranged_weights,
    new_workspace,
)
from terrainwave.codec.rapid.line_coder import plan_lines
from terrainwave.codec.rapid.magnitude import N_CONTEXTS, scale_of, scaled_features
from terrainwave.codec.rapid.symbols import (
    BIT_POS,
    COUNT,
    SPARE_BITS,
    SPARE_WORDS,
    WORD_POS,
    Streams,
)
from terrainwave.codec.rapid.wavefront import Known, Lattice, code_rows
from terrainwave.codec.refiner import (
    ALL_ROWS,
    NO_CORRECTIONS,
    Corrections,
    GroupSpec,
    Heights,
    Labels,
    Mask,
    Rows,
)
from terrainwave.codec.varint import decode_varint, encode_varint
from terrainwave.coding.rans import (
    N_STATES,
    STATE_START,
    SYMBOL_BITS,
    count_symbols,
    encode_symbols,
)
from terrainwave.errors import CorruptStreamError, TruncatedStreamError

_WIDE, _SINGLE = 1, 2
# Units of fewer samples have one state instead of eight: 28 bytes less.
_MANY_SAMPLES = 1 << 14
_NONE_KNOWN = Known(0, 0, 0, 0)
_SIDES_KNOWN = Known(3, 3, 3, 3)
_NO_GOAL = np.zeros(1, dtype=np.int32)
_NO_LOG = np.zeros(1, dtype=np.uint8)
_NONE_SHARED = np.zeros((0, 5), dtype=np.int64), np.zeros((0, 9), dtype=np.int64)
_NO_SLOTS = np.zeros(1, dtype=np.uint32)
_NO_FREQS = np.zeros(1, dtype=np.uint32)
# For counting: no symbol is impossible yet.
_ANY_SYMBOL = np.ones(N_CONTEXTS << SYMBOL_BITS, dtype=np.uint32)
_NO_WORDS = np.zeros(SPARE_WORDS, dtype=np.uint16)
# The validity of units without voids, which no kernel looks at.
_NO_MASK = np.ones(1, dtype=np.uint8)
_LIMIT32 = (1 << 31) - 64
_MOST_NARROW_STEP = 1 << 24


class _Logs:
    """What an encoder logs of a unit before it knows what comes first."""

    def __init__(self, n: int) -> None:
        self.raw = np.zeros(2 * n + SPARE_BITS // 32, dtype=np.uint32)
        self.contexts = np.empty(n, dtype=np.uint8)
        self.symbols = np.empty(n, dtype=np.uint8)
        self.words = np.empty(n, dtype=np.uint16)


class _Memory:
    """Memory that units take turns with."""

    def __init__(self) -> None:
        self._workspaces: dict[bool, Workspace] = {}
        self._logs = _Logs(0)

    def logs(self, n: int) -> "_Logs":
        """Return where to log a unit of `n` samples, its raw bits all 0; see `put_back`."""
        logs, self._logs = self._logs, _Logs(0)  # should coding fail, it is not used again
        return logs if len(logs.symbols) >= n else _Logs(n)

    def put_back(self, logs: "_Logs", streams: Streams) -> None:
        """Keep where a unit has been logged for the next one."""
        logs.raw[: (int(streams.places[BIT_POS]) >> 5) + 2] = 0
        self._logs = logs

    def workspace(self, is_wide: bool) -> Workspace:
        """Return the arrays to code a unit in."""
        if is_wide not in self._workspaces:
            self._workspaces[is_wide] = new_workspace(np.int64 if is_wide else np.int32)
        return self._workspaces[is_wide]


_MEMORY = Spares(_Memory)


class _Unit(NamedTuple):
    """A unit as kernels see it."""

    spec: GroupSpec
    is_encoding: bool
    goal: NDArray[np.int32]
    valid: NDArray[np.uint8]  # 1 or 0
    has_void: bool
    out: NDArray[np.int32]
    origin: int
    scale: Scale
    memory: _Memory
    workspace: Workspace
    streams: Streams
    kept: NDArray[np.int32]
    added: NDArray[np.int32]


class UnitCoder:
    """Codes units with tables; see `Refiner` for what `encode` and `decode` promise."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables

    @cached_property
    def _widest(self) -> int:
        """The largest sum of absolute weights of a stencil."""
        return int(np.abs(self._tables.stencils).sum(-1).max())

    def encode(
        self,
        spec: GroupSpec,
        parent: Heights | None,
        target: Heights,
        mask: Mask | None,
        corrections: Corrections = NO_CORRECTIONS,
    ) -> tuple[bytes, Heights, Labels | None]:
        """Return the payload and the heights `decode` makes of it."""
        flags = self._flags(spec, parent, target, mask)
        n_states = 1 if flags & _SINGLE else N_STATES
        freqs = self._tables.packed_freqs(spec.step)
        with _MEMORY.lent() as memory:
            logs = memory.logs(target.size)
            heights, streams = self._encode(
                spec, parent, target, mask, flags, freqs, memory, logs, corrections=corrections
            )
            n_symbols, n_bits = int(streams.places[COUNT]), int(streams.places[BIT_POS])
            words = logs.words[:n_symbols]
            n_words = encode_symbols(
                logs.contexts, logs.symbols, n_symbols, freqs, n_states, words, streams.states
            )
            used = logs.raw[: (n_bits + 31) // 32]
            payload = (
                bytes([flags])
                + encode_varint(n_words)
                + streams.states[:n_states].astype("<u4").tobytes()
                + words[n_symbols - n_words :].astype("<u2").tobytes()
                + used.astype("<u4").tobytes()[: (n_bits + 7) // 8]
            )
            memory.put_back(logs, streams)
        return payload, heights, None

    def count(
        self,
        spec: GroupSpec,
        target: Heights,
        mask: Mask | None,
        counts: NDArray[np.int64],
        *,
        is_inner: bool = False,
    ) -> Heights:
        """Count contexts and symbols of a part of a raster, a root block; return decoded heights.

        If it `is_inner`, three rows and columns at the sides of each lattice are taken as they are,
        so that it does not seem to end there. As if no symbol had the frequency 0. `counts`, shape
        (2, N_CONTEXTS << SYMBOL_BITS), get one more at ``context << SYMBOL_BITS | symbol``, in
        either row.
        """
        flags = self._flags(spec, None, target, mask)
        with _MEMORY.lent() as memory:
            logs = memory.logs(target.size)
            heights, streams = self._encode(
                spec,
                None,
                target,
                mask,
                flags,
                _ANY_SYMBOL,
                memory,
                logs,
                _SIDES_KNOWN if is_inner else _NONE_KNOWN,
            )
            count_symbols(logs.contexts, logs.symbols, int(streams.places[COUNT]), counts)
            memory.put_back(logs, streams)
        return heights

    def _flags(
        self, spec: GroupSpec, parent: Heights | None, target: Heights, mask: Mask | None
    ) -> int:
        is_wide = self._is_wide(spec, parent, target, mask)
        return (_WIDE if is_wide else 0) | (_SINGLE if target.size < _MANY_SAMPLES else 0)

    def _encode(
        self, spec: GroupSpec, parent: Heights | None, target: Heights, mask: Mask | None,
        flags: int, freqs: NDArray[np.uint32], memory: _Memory, logs: _Logs,
        known: Known = _NONE_KNOWN, corrections: Corrections = NO_CORRECTIONS,
    ) -> tuple[Heights, Streams]:  # fmt: skip
        """Return decoded heights, and the logs of what is to be written."""
        streams = Streams(
            places=np.zeros(3, dtype=np.int64),
            slots=_NO_SLOTS,
            words=_NO_WORDS,
            n_words=0,
            states=np.zeros(N_STATES, dtype=np.uint64),
            n_states=N_STATES,
            raw=logs.raw,
            n_bits=1 << 40,
            freqs=freqs,
            contexts_log=logs.contexts,
            symbols_log=logs.symbols,
        )
        heights = new_heights(spec.region.shape)
        target = np.ascontiguousarray(target)
        if known != _NONE_KNOWN:
            heights[:] = target
        self._code(spec, parent, target, mask, flags, streams, heights, memory, corrections, known)
        return heights, streams

    def decode(
        self,
        spec: GroupSpec,
        parent: Heights | None,
        mask: Mask | None,
        payload: bytes,
        corrections: Corrections = NO_CORRECTIONS,
    ) -> tuple[Heights, Labels | None]:
        """Rebuild the heights of ``spec.region``.

        Raises
        ------
        CorruptStreamError
            If the payload contradicts format-rapid.md; `TruncatedStreamError` if it is too short.
        """
        heights = new_heights(spec.region.shape)
        self.decode_into(spec, parent, mask, payload, heights, corrections)
        return heights, None

    def decode_into(
        self,
        spec: GroupSpec,
        parent: Heights | None,
        mask: Mask | None,
        payload: bytes,
        out: Heights,
        corrections: Corrections = NO_CORRECTIONS,
        rows: Rows = ALL_ROWS,
    ) -> None:
        """Rebuild the heights of ``spec.region`` in `out`; see `decode` and `DirectRefiner`."""
        if not payload:
            raise TruncatedStreamError("the payload is empty")
        flags = payload[0]
        if flags & ~(_WIDE | _SINGLE):
            raise CorruptStreamError(f"payload flags {flags:#x} are not defined")
        streams = self._read_streams(payload, flags, spec.step)
        with _MEMORY.lent() as memory:
            self._code(
                spec, parent, None, mask, flags, streams, out, memory, corrections, n_rows=rows.end
            )
        _check_end(streams, is_part=rows.end < spec.region.n_rows)

    def rows_above(self, spec: GroupSpec, payload: bytes, rows: Rows) -> Rows:  # noqa: ARG002
        """Return all rows."""
        return ALL_ROWS

    def _read_streams(self, payload: bytes, flags: int, step: int) -> Streams:
        n_states = 1 if flags & _SINGLE else N_STATES
        n_words, byte_pos = decode_varint(payload, 1)
        first_word = byte_pos + 4 * n_states
        first_raw = first_word + 2 * n_words
        if first_raw > len(payload):
            raise TruncatedStreamError(
                f"{n_states} states and {n_words} words need {first_raw} bytes, found"
                f" {len(payload)}"
            )
        states = np.zeros(N_STATES, dtype=np.uint64)
        states[:n_states] = np.frombuffer(payload, "<u4", n_states, byte_pos)
        words = np.zeros(n_words + SPARE_WORDS, dtype=np.uint16)
        words[:n_words] = np.frombuffer(payload, "<u2", n_words, first_word)
        n_raw = len(payload) - first_raw
        raw = np.zeros((n_raw >> 2) + 1 + SPARE_BITS // 32, dtype="<u4")
        raw.view(np.uint8)[:n_raw] = np.frombuffer(payload, np.uint8, n_raw, first_raw)
        return Streams(
            places=np.zeros(3, dtype=np.int64),
            slots=self._tables.slots(step),
            words=words,
            n_words=n_words,
            states=states,
            n_states=n_states,
            raw=raw.astype(np.uint32, copy=False),
            n_bits=8 * n_raw,
            freqs=_NO_FREQS,
            contexts_log=_NO_LOG,
            symbols_log=_NO_LOG,
        )

    def _is_wide(
        self, spec: GroupSpec, parent: Heights | None, target: Heights, mask: Mask | None
    ) -> bool:
        """Return whether a unit needs 64 bits: it has heights far from its origin."""
        if spec.step >= _MOST_NARROW_STEP:
            return True
        limit, origin = _LIMIT32 // self._widest, self._origin(spec, parent)
        if origin - limit <= spec.z_min and spec.z_max <= origin + limit:
            return False
        heights = target if mask is None else target[mask]
        seen = [heights] if parent is None else [heights, parent]
        low = min((int(part.min()) for part in seen if part.size), default=origin)
        high = max((int(part.max()) for part in seen if part.size), default=origin)
        return max(low, spec.z_min) < origin - limit or min(high, spec.z_max) > origin + limit

    def _origin(self, spec: GroupSpec, parent: Heights | None) -> int:
        """Return the height that a narrow unit's are less: 0 where the header's range fits."""
        if parent is None or max(-spec.z_min, spec.z_max) * self._widest <= _LIMIT32:
            return 0
        return (int(parent.min()) + int(parent.max())) >> 1

    def _code(
        self, spec: GroupSpec, parent: Heights | None, target: Heights | None, mask: Mask | None,
        flags: int, streams: Streams, out: Heights, memory: _Memory, corrections: Corrections,
        known: Known = _NONE_KNOWN, n_rows: int = ALL_ROWS.end,
    ) -> None:  # fmt: skip
        """Encode `target`, or decode where it is None; fill `out` with the region's heights."""
        is_wide = bool(flags & _WIDE)
        origin = self._origin(spec, parent)
        low, high = spec.z_min - origin, spec.z_max - origin
        if not is_wide:
            limit = _LIMIT32 // self._widest
            low, high = max(low, -limit), min(high, limit)
            if low > high:
                raise CorruptStreamError(
                    "all heights of a unit that is not wide are too far from 0"
                )
        # A lattice fills all but the apron, whose lines may not meet.
        aprons = _aprons(spec, out)
        for side in aprons:
            side[:] = 0
        unit = _Unit(
            spec=spec,
            is_encoding=target is not None,
            goal=_NO_GOAL if target is None else target.ravel(),
            valid=_NO_MASK if mask is None else mask.ravel().view(np.uint8),
            has_void=mask is not None,
            out=out.ravel(),
            origin=origin,
            scale=scale_of(spec.step, low, high, self._tables.is_by_reach),
            memory=memory,
            workspace=memory.workspace(is_wide),
            streams=streams,
            kept=corrections.kept.ravel(),
            added=corrections.added.ravel(),
        )
        if parent is None:
            self._code_root(unit, known)
        else:
            self._code_group(unit, parent, n_rows)
        for side in aprons:
            np.clip(side, spec.z_min, spec.z_max, out=side)

    def _code_group(self, unit: _Unit, parent: Heights, n_rows: int) -> None:
        spec = unit.spec
        assert spec.parent_region is not None
        row = (spec.core.row >> 1) - spec.parent_region.row
        col = (spec.core.col >> 1) - spec.parent_region.col
        source, pitch = flat(parent)
        coarse = Lattice(row * pitch + col, pitch, 1)
        rings = 1 + (spec.rings >> 1)
        known = Known(*(rings if is_shared else 0 for is_shared in spec.shared))
        n_core = max(n_rows - (spec.core.row - spec.region.row), 1)
        self._code_rows(unit, 1, source, coarse, known, plan_lines(spec, pitch), n_core)

    def _code_root(self, unit: _Unit, known: Known) -> None:
        """Code the corners on a fixed grid, then lattices of half the stride each."""
        n_rows, n_cols = unit.spec.core.shape
        stride = 1
        while stride < max(n_rows, n_cols) - 1:
            stride *= 2
        pitch = unit.spec.region.shape[1]
        first = _first(unit.spec)
        for row in range(0, n_rows, stride):
            for col in range(0, n_cols, stride):
                _code_corner(unit, first + row * pitch + col)
        if stride > 1:
            coarse = Lattice(first, 2 * pitch, 2)
            self._code_rows(unit, stride >> 1, unit.out, coarse, known, _NONE_SHARED)

    def _weights_from(self, level: int, stride: int, scale: Scale) -> NDArray[np.int64]:
        """Return weights of lattices: each `stride`-th row of a level, half of that, … each row.

        Each has those of the level on whose rows it is.
        """
        depth = self._tables.k_max - level
        key = depth, stride, scale.step
        arranged = self._tables.arranged
        if key not in arranged:
            last = len(self._tables.stencils) - 1
            depths = range(depth + stride.bit_length() - 1, depth - 1, -1)
            classes = [min(max(own, 0), last) for own in depths]
            weights = {
                which: arranged_weights(
                    self._tables.stencils[which],
                    scaled_features(self._tables.features[which], scale),
                    scale,
                )
                for which in set(classes)
            }
            arranged[key] = np.stack([weights[which] for which in classes])
        return arranged[key]

    def _code_rows(
        self, unit: _Unit, stride: int, source: Heights, coarse: Lattice, known: Known,
        shared: tuple[NDArray[np.int64], NDArray[np.int64]], n_rows: int = ALL_ROWS.end,
    ) -> None:  # fmt: skip
        """Code the lattice of every `stride`-th sample, those of half the stride, … all samples.

        `source` has the coarse samples, those of the last lattice where `coarse` says, whose first
        `n_rows` are enough.
        """
        spec = unit.spec
        assert spec.core.n_cols <= 2 * MAX_COLS
        code_rows(
            unit.is_encoding, unit.has_void, unit.goal, unit.valid, unit.out, source, *shared,
            Lattice(_first(spec), spec.region.shape[1], 1), coarse, spec.core.shape, stride,
            self._weights_from(spec.level, stride, unit.scale), known, unit.origin, unit.workspace,
            unit.scale, unit.streams, unit.kept, unit.added, n_rows,
        )  # fmt: skip


def _code_corner(unit: _Unit, place: int) -> None:
    """Encode or decode a sample that nothing predicts, on a grid of steps from the lowest height.

    It takes raw bits; a void one none, and the middle of the range of heights. There are a few of
    these in a file, too few to compile anything for.
    """
    scale, streams = unit.scale, unit.streams
    if unit.has_void and not unit.valid[place]:
        _put(unit, place, (scale.low + scale.high) >> 1)
        return
    n_bits = ((scale.high - scale.low) // scale.step).bit_length()
    bit_pos = min(int(streams.places[BIT_POS]), streams.n_bits)
    word, shift = bit_pos >> 5, bit_pos & 31
    if unit.is_encoding:
        index = (int(unit.goal[place]) - unit.origin - scale.low) // scale.step
        streams.raw[word] |= (index << shift) & 0xFFFFFFFF
        streams.raw[word + 1] |= index << shift >> 32
    else:
        both = int(streams.raw[word]) | int(streams.raw[word + 1]) << 32
        index = both >> shift & ((1 << n_bits) - 1)
    streams.places[BIT_POS] += n_bits
    height = scale.low + index * scale.step + (scale.step >> 1)
    _put(unit, place, min(height, scale.high))


def _put(unit: _Unit, place: int, height: int) -> None:
    """Take the height of a corner of a root block, less the origin, and correct it."""
    height += unit.origin
    limits = unit.scale.low + unit.origin, unit.scale.high + unit.origin
    unit.out[place] = correct(height, unit.kept, unit.added, place, limits, limits)


def _aprons(spec: GroupSpec, out: Heights) -> list[Heights]:
    """Return the rows and columns of a unit that are not its core's."""
    if spec.region == spec.core:
        return []
    rows, cols = spec.core.slices_in(spec.region)
    return [out[: rows.start], out[rows.stop :], out[:, : cols.start], out[:, cols.stop :]]


def _first(spec: GroupSpec) -> int:
    """Return the place of the core's first sample in the flat region."""
    row, col = spec.core.slices_in(spec.region)
    return int(row.start) * spec.region.shape[1] + int(col.start)


def _check_end(streams: Streams, *, is_part: bool) -> None:
    """Raise unless a unit's streams have been used up exactly; by a part of it, not exceeded."""
    places, states = streams.places.tolist(), streams.states[: streams.n_states].tolist()
    word_pos, bit_pos = places[WORD_POS], places[BIT_POS]
    if word_pos > streams.n_words or bit_pos > streams.n_bits:
        raise TruncatedStreamError("the payload ends inside its data")
    if is_part:
        return
    if word_pos < streams.n_words or (bit_pos + 7) // 8 < streams.n_bits // 8:
        raise CorruptStreamError("bytes are left over after the last symbol")
    if states != [STATE_START] * streams.n_states:
        raise CorruptStreamError("the symbols do not end in the state that they began with")
    if bit_pos % 8 and int(streams.raw[bit_pos >> 5]) >> (bit_pos & 31):
        raise CorruptStreamError("the last byte of raw bits is not filled with 0")
