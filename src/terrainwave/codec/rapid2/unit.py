"""Units of heights as payloads: lines that they share, details, then heights."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.memory import Spares, new_heights
from terrainwave.codec.rapid2.details import Features, Space, code_details, n_strips, new_space
from terrainwave.codec.rapid2.heights import code_heights, load_parent, look_at_parent
from terrainwave.codec.rapid2.layout import (
    HH,
    HL,
    LH,
    LIMIT,
    N_PLANES,
    PAD,
    RUNS,
    core_of,
    run_weights,
)
from terrainwave.codec.rapid2.lines import code_lines
from terrainwave.codec.rapid2.symbols import (
    BIT,
    IS_BAD,
    MOST_STATES,
    N_LOGGED,
    N_SYMBOLS,
    N_TABLES,
    STATE_START,
    VALUES,
    WORD,
    Log,
    count_log,
    encode_log,
)
from terrainwave.codec.rapid2.tables import Tables, weights_of
from terrainwave.codec.refiner import NO_CORRECTIONS, Corrections, GroupSpec, Heights, Labels, Mask
from terrainwave.codec.varint import decode_varint, encode_varint
from terrainwave.errors import CorruptStreamError, TruncatedStreamError

_NARROW, _STATES, _BANDS, _DEFINED = 1, 1, 3, 31
_N_STATES = (1, 8, MOST_STATES)
# Units of fewer samples have fewer states.
_SAMPLES_OF_STATES = (0, 1 << 10, 1 << 14)
_MOST_SHIFT = 30
# A payload of more bytes has parts that can be read alone, for windows.
_BYTES_OF_BANDS, _MOST_BANDS = 1 << 14, 4
_SPARE_BYTES = 16
# Symbols of what is not of the samples: odd ends of rows and lines.
_ROOM = 1 << 13
# Raw bits of a symbol, at most: those of its class, and what is beyond it.
_BYTES_OF_SYMBOL = 6
_NONE_KNOWN = (False, False, False, False)
_NO_MASK = np.ones((1, 1), dtype=np.uint8)
_NO_GOAL = np.zeros((1, 1), dtype=np.int32)
_NO_LINES = np.zeros((4, 1), dtype=np.int32)
_NO_RAW = np.zeros(_SPARE_BYTES, dtype=np.uint8)
_NO_WORDS = np.zeros(MOST_STATES, dtype=np.uint16)
_NO_LOG = Log(*(np.zeros(1, dtype=np.uint8) for _ in range(4)))
_ALL_RUNS = tuple(tuple(RUNS[plane][:3]) for plane in (HH, HL, LH))
_CORES = tuple(core_of(plane) for plane in (HH, HL, LH))


class _Memory:
    """Arrays that units take turns with, for planes of at most so many samples a side."""

    def __init__(self) -> None:
        self.side = 0

    def grown(self, side: int) -> "_Memory":
        """Return this, with room for planes of `side` samples a side."""
        if side > self.side:
            self.side = side
            all_ = side + 2 * PAD
            self.planes = np.zeros((1 + N_PLANES, all_, all_ + 1), dtype=np.int16)
            self.ranges = np.zeros((side + 2, side + 2), dtype=np.int16)
            self.bends = np.zeros((side + 2, side + 2), dtype=np.int16)
            self.near = np.zeros((2, side + 2, side + 2), dtype=np.int16)
            self.details = np.zeros((N_PLANES, side, side), dtype=np.int32)
            self.rows = np.zeros((3, side), dtype=np.int32)
            self.space: Space = new_space(side)
        return self


_MEMORY = Spares(_Memory)


class _Streams(NamedTuple):
    """What kernels read or write of a band of strips."""

    states: NDArray[np.uint32]
    words: NDArray[np.uint16]
    raw: NDArray[np.uint8]
    log: Log
    places: NDArray[np.int64]


class _Head(NamedTuple):
    """What a payload says before its bands."""

    is_narrow: bool
    shift: int
    n_states: int
    bands: list[_Streams]


class _Lattice(NamedTuple):
    """A lattice to be coded: a group, or every so many samples of a root block."""

    shape: tuple[int, int]
    parent: Heights
    known: tuple[bool, bool, bool, bool]
    goal: Heights | None
    valid: NDArray[np.uint8] | None
    out: Heights
    level: int
    corrections: Corrections


class UnitCoder:
    """Codes units with tables; see `Refiner` for what `encode` and `decode` promise."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables

    def encode(
        self,
        spec: GroupSpec,
        parent: Heights | None,
        target: Heights,
        mask: Mask | None,
        corrections: Corrections = NO_CORRECTIONS,
    ) -> tuple[bytes, Heights, Labels | None]:
        """Return the payload and the heights `decode` makes of it."""
        out = new_heights(spec.region.shape)
        head = self._new_head(spec, parent, target, mask, 1)
        self._code(spec, parent, np.ascontiguousarray(target), mask, head, out, corrections)
        payload = self._pack(head)
        if parent is not None and len(payload) > _BYTES_OF_BANDS:
            head = self._new_head(spec, parent, target, mask, _MOST_BANDS)
            self._code(spec, parent, np.ascontiguousarray(target), mask, head, out, corrections)
            payload = self._pack(head)
        return payload, out, None

    def count(
        self,
        spec: GroupSpec,
        parent: Heights | None,
        target: Heights,
        mask: Mask | None,
        counts: NDArray[np.int64],
    ) -> Heights:
        """Count the symbols of a unit in `counts`, shape (N_TABLES, N_SYMBOLS); return heights."""
        out = new_heights(spec.region.shape)
        head = self._new_head(spec, parent, target, mask, 1)
        self._code(spec, parent, np.ascontiguousarray(target), mask, head, out, NO_CORRECTIONS)
        assert counts.shape == (N_TABLES, N_SYMBOLS)
        for streams in head.bands:
            count_log(streams.log, int(streams.places[N_LOGGED]), counts)
        return out

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
        out = new_heights(spec.region.shape)
        head = self._read_head(payload)
        self._code(spec, parent, None, mask, head, out, corrections)
        for streams in head.bands:
            _check_end(streams)
        return out, None

    def _new_head(
        self,
        spec: GroupSpec,
        parent: Heights | None,
        target: Heights,
        mask: Mask | None,
        n_bands: int,
    ) -> _Head:
        heights = target if mask is None else target[mask]
        seen = [part for part in (heights, parent) if part is not None and part.size]
        origin = _origin(spec, parent)
        most = max((int(np.abs(part.astype(np.int64) - origin).max()) for part in seen), default=0)
        is_narrow = most + spec.half <= LIMIT and spec.step <= LIMIT
        shift = 0
        while not is_narrow and most >> shift > LIMIT:
            shift += 1
        n_states = _N_STATES[sum(target.size >= least for least in _SAMPLES_OF_STATES) - 1]
        room = 2 * target.size + _ROOM
        bands = []
        for _ in range(n_bands):
            tables, symbols, lanes = (np.zeros(room, dtype=np.uint8) for _ in range(3))
            log = Log(tables, symbols, lanes, np.zeros(_BYTES_OF_SYMBOL * room, dtype=np.uint8))
            states = np.full(n_states, STATE_START, dtype=np.uint32)
            bands.append(_Streams(states, _NO_WORDS, _NO_RAW, log, np.zeros(4, dtype=np.int64)))
        return _Head(is_narrow, shift, n_states, bands)

    def _pack(self, head: _Head) -> bytes:
        flags = (head.is_narrow * _NARROW) | _N_STATES.index(head.n_states) << _STATES
        parts = [bytes([flags | (len(head.bands) - 1) << _BANDS])]
        if not head.is_narrow:
            parts.append(bytes([head.shift]))
        sizes, contents = [], []
        frequencies = self._tables.frequencies
        for states, _, _, log, places in head.bands:
            words = np.zeros(int(places[N_LOGGED]), dtype=np.uint16)
            n_words = encode_log(
                log, len(words), frequencies.freqs, frequencies.starts, words, states
            )
            raw = log.raw[: (int(places[BIT]) + 7) // 8]
            sizes += [encode_varint(n_words), encode_varint(len(raw))]
            contents += [
                states.astype("<u4").tobytes(),
                words[len(words) - n_words :].astype("<u2").tobytes(),
                raw.tobytes(),
            ]
        return b"".join([*parts, *sizes, *contents])

    def _read_head(self, payload: bytes) -> _Head:
        if not payload:
            raise TruncatedStreamError("the payload is empty")
        flags, at = payload[0], 1
        which = flags >> _STATES & 3
        if flags & ~_DEFINED or which >= len(_N_STATES):
            raise CorruptStreamError(f"payload flags {flags:#x} are not defined")
        shift = 0
        if not flags & _NARROW:
            if len(payload) < 2:
                raise TruncatedStreamError("the payload ends before its shift")
            shift, at = payload[1], 2
            if shift > _MOST_SHIFT:
                raise CorruptStreamError(f"a shift of {shift} bits, expected {_MOST_SHIFT} at most")
        n_states, sizes = _N_STATES[which], []
        for _ in range((flags >> _BANDS & 3) + 1):
            n_words, at = decode_varint(payload, at)
            n_raw, at = decode_varint(payload, at)
            sizes.append((n_words, n_raw))
        needed = at + sum(4 * n_states + 2 * n_words + n_raw for n_words, n_raw in sizes)
        if needed != len(payload):
            kind = TruncatedStreamError if needed > len(payload) else CorruptStreamError
            raise kind(f"the payload has {len(payload)} bytes, its parts need {needed}")
        bands = []
        for n_words, n_raw in sizes:
            words = np.zeros(n_words + MOST_STATES, dtype=np.uint16)
            words[:n_words] = np.frombuffer(payload, "<u2", n_words, at + 4 * n_states)
            raw = np.zeros(n_raw + _SPARE_BYTES, dtype=np.uint8)
            raw[:n_raw] = np.frombuffer(payload, np.uint8, n_raw, at + 4 * n_states + 2 * n_words)
            states = np.frombuffer(payload, "<u4", n_states, at).astype(np.uint32)
            bands.append(_Streams(states, words, raw, _NO_LOG, np.zeros(4, dtype=np.int64)))
            at += 4 * n_states + 2 * n_words + n_raw
        return _Head(bool(flags & _NARROW), shift, n_states, bands)

    def _code(
        self, spec: GroupSpec, parent: Heights | None, target: Heights | None, mask: Mask | None,
        head: _Head, out: Heights, corrections: Corrections,
    ) -> None:  # fmt: skip
        valid = None if mask is None else np.ascontiguousarray(mask).view(np.uint8)
        if parent is not None:
            known = (spec.shared.top, spec.shared.left, spec.shared.bottom, spec.shared.right)
            self._code_lattice(
                spec,
                head,
                _Lattice(
                    spec.core.shape, parent, known, target, valid, out, spec.level, corrections
                ),
                head.bands,
            )  # fmt: skip
            return
        n_rows, n_cols = spec.core.shape
        stride = 1
        while stride < max(n_rows, n_cols) - 1:
            stride *= 2
        for row in range(0, n_rows, stride):
            for col in range(0, n_cols, stride):
                _code_corner(spec, head.bands[0], target, valid, out, row, col)
        depth = stride.bit_length() - 1
        while stride > 1:
            parents = np.ascontiguousarray(out[::stride, ::stride])
            stride, depth = stride >> 1, depth - 1
            part = np.s_[::stride, ::stride]
            shape = -(-n_rows // stride), -(-n_cols // stride)
            own = np.zeros(shape, dtype=np.int32)
            own[::2, ::2] = parents
            lattice = _Lattice(
                shape, parents, _NONE_KNOWN,
                None if target is None else np.ascontiguousarray(target[part]),
                None if valid is None else np.ascontiguousarray(valid[part]),
                own, spec.level - depth, NO_CORRECTIONS,
            )  # fmt: skip
            self._code_lattice(spec, head, lattice, head.bands)
            out[part] = own

    def _code_lattice(
        self,
        spec: GroupSpec,
        head: _Head,
        lattice: _Lattice,
        bands: list[_Streams],
    ) -> None:
        shape, (n_a_rows, n_a_cols) = lattice.shape, lattice.parent.shape
        origin = _origin(spec, None if spec.parent_region is None else lattice.parent)
        low, high = spec.z_min, spec.z_max
        if head.is_narrow:
            low, high = max(low, origin - LIMIT), min(high, origin + LIMIT)
            if low > high:
                raise CorruptStreamError("all heights of a narrow unit are too far from its origin")
        tables = self._tables
        which = tables.level_class(lattice.level)
        weights = weights_of(tables.weights[which], spec.step, head.shift)
        is_encoding = lattice.goal is not None
        goal = _NO_GOAL if lattice.goal is None else lattice.goal
        valid = _NO_MASK if lattice.valid is None else lattice.valid
        has_void = lattice.valid is not None
        cut, slots, freqs, _ = tables.frequencies
        most = (spec.z_max - spec.z_min) // spec.step + 1
        lattice.out[::2, ::2] = lattice.parent
        with _MEMORY.lent() as memory:
            memory = memory.grown(max(n_a_rows, n_a_cols) + 1)
            planes, details = memory.planes, memory.details
            load_parent(lattice.parent, shape, origin, head.shift, low, high, planes)
            look_at_parent(planes, n_a_rows, n_a_cols, memory.ranges, memory.bends)
            memory.near[:] = 0
            details[:] = 0
            lines = _NO_LINES
            if any(lattice.known):
                lines = self._code_lines(spec, lattice, bands[0], memory)
            features = Features(memory.ranges, memory.bends, memory.near, weights[:3])
            predicted, sides, heights = memory.rows

            def code_all_details() -> None:
                n = n_strips(shape)
                for k, (states, words, raw, log, places) in enumerate(bands):
                    code_details(
                        is_encoding, has_void, valid, lattice.known, shape,
                        (k * n // len(bands), (k + 1) * n // len(bands)), features, details, most,
                        VALUES, cut, slots, freqs, head.n_states, states, words, raw, log, places,
                        memory.space,
                    )  # fmt: skip

            if not is_encoding:
                code_all_details()
            code_heights(
                is_encoding, goal, has_void, valid, head.is_narrow, spec.step, low, high, origin,
                head.shift, shape, lattice.known, lines, _ALL_RUNS,
                tuple(run_weights(p, tables.stencils[which, p - 1]) for p in (HH, HL, LH)),
                _CORES, planes, details, predicted, sides, heights, lattice.out,
                lattice.corrections.kept.ravel(), lattice.corrections.added.ravel(),
            )  # fmt: skip
            if is_encoding:
                code_all_details()
                self._see(which, head.shift, lattice, features, details)

    def _see(
        self,
        which: int,
        shift: int,
        lattice: _Lattice,
        features: Features,
        details: NDArray[np.int32],
    ) -> None:
        """Look at a lattice of class `which` that has been coded: nothing to see here (`fit`)."""

    def _code_lines(
        self, spec: GroupSpec, lattice: _Lattice, streams: _Streams, memory: _Memory
    ) -> NDArray[np.int32]:
        """Code the samples at odd places of the sides that are shared; return their heights."""
        ends = np.s_[0], np.s_[:, 0], np.s_[-1], np.s_[:, -1]
        evens = [np.ascontiguousarray(lattice.parent[end]) for end in ends]
        odds = [_odd(lattice.out, end) for end in ends]
        most = max(len(odd) for odd in odds) + 1
        lines = np.zeros((4, most), dtype=np.int32)
        goals, valid = np.zeros((4, most), dtype=np.int32), np.ones((4, most), dtype=np.uint8)
        all_evens = np.zeros((4, max(map(len, evens))), dtype=np.int32)
        for side, end in enumerate(ends):
            all_evens[side, : len(evens[side])] = evens[side]
            if lattice.goal is not None:
                goals[side, : len(odds[side])] = _odd(lattice.goal, end)
            if lattice.valid is not None:
                valid[side, : len(odds[side])] = _odd(lattice.valid, end)
        shift = 0
        while (spec.z_max - spec.z_min) >> shift > 2 * LIMIT:
            shift += 1
        tables = self._tables
        weights = weights_of(tables.weights[tables.level_class(lattice.level)], spec.step, shift)[3]
        cut, slots, freqs, _ = tables.frequencies
        states, words, raw, log, places = streams
        code_lines(
            lattice.goal is not None, goals, lattice.valid is not None, valid, lattice.known,
            all_evens, tuple(map(len, evens)), tuple(map(len, odds)), spec.step, spec.z_min,
            spec.z_max, shift, weights.astype(np.int64),
            (spec.z_max - spec.z_min) // spec.step + 1, VALUES, cut, slots, freqs, len(states),
            states, words, raw, log, places, memory.space, lines,
        )  # fmt: skip
        return lines


def _odd(array: NDArray[Any], end: Any) -> NDArray[Any]:
    odd: NDArray[Any] = array[end][1::2]
    return odd


def _origin(spec: GroupSpec, parent: Heights | None) -> int:
    """Return the height that a unit's are less in planes: the middle of its parent's."""
    if parent is None:
        return (spec.z_min + spec.z_max) >> 1
    return (int(parent.min()) + int(parent.max())) >> 1


def _code_corner(
    spec: GroupSpec, streams: _Streams, target: Heights | None,
    valid: NDArray[np.uint8] | None, out: Heights, row: int, col: int,
) -> None:  # fmt: skip
    """Encode or decode a sample that nothing predicts, on a grid of steps from the lowest height.

    It takes raw bits; a void one none, and the middle of the range of heights.
    """
    low, high, step = spec.z_min, spec.z_max, spec.step
    if valid is not None and not valid[row, col]:
        out[row, col] = (low + high) >> 1
        return
    n_bits = ((high - low) // step).bit_length()
    bit = int(streams.places[BIT])
    if target is not None:
        index = (int(target[row, col]) - low) // step
        for k in range(n_bits):
            streams.log.raw[(bit + k) >> 3] |= (index >> k & 1) << ((bit + k) & 7)
    else:
        index = 0
        for k in range(n_bits):
            at = min((bit + k) >> 3, len(streams.raw) - 1)
            index |= (int(streams.raw[at]) >> ((bit + k) & 7) & 1) << k
    streams.places[BIT] += n_bits
    out[row, col] = min(low + index * step + (step >> 1), high)


def _check_end(streams: _Streams) -> None:
    """Raise unless a band's streams have been used up exactly."""
    n_words = len(streams.words) - MOST_STATES
    n_bits = 8 * (len(streams.raw) - _SPARE_BYTES)
    word, bit = int(streams.places[WORD]), int(streams.places[BIT])
    if streams.places[IS_BAD] or word > n_words or bit > n_bits:
        raise TruncatedStreamError("the payload ends inside its data")
    if word < n_words or (bit + 7) // 8 < n_bits // 8:
        raise CorruptStreamError("bytes are left over after the last symbol")
    if (streams.states != STATE_START).any():
        raise CorruptStreamError("the symbols do not end in the state that they began with")
    if bit % 8 and int(streams.raw[bit >> 3]) >> (bit & 7):
        raise CorruptStreamError("the last byte of raw bits is not filled with 0")
