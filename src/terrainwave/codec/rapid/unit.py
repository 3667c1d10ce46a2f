"""Units of heights as payloads: details, then heights (docs/format-rapid.md)."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.corrections import correct
from terrainwave.codec.memory import Spares, flat, flat_view, new_heights
from terrainwave.codec.rapid.details import log_details, read_details
from terrainwave.codec.rapid.layout import (
    HH,
    HL,
    LH,
    LIMIT,
    Lattice,
    Workspace,
    new_workspace,
    plane_shape,
)
from terrainwave.codec.rapid.needed import band_strips, needed_for
from terrainwave.codec.rapid.prediction import (
    Aim,
    Parent,
    code_heights,
    load_parent,
    write_rows,
)
from terrainwave.codec.rapid.symbols import (
    BIT,
    IS_BAD,
    MOST_STATES,
    N_LOGGED,
    STATE_START,
    WORD,
    Frequencies,
    Log,
    Streams,
    count_log,
    encode_log,
)
from terrainwave.codec.rapid.tables import Tables, weights_of
from terrainwave.codec.refiner import (
    ALL_ROWS,
    FREE,
    NO_CORRECTIONS,
    Corrections,
    GroupSpec,
    Heights,
    Labels,
    Mask,
    Raw,
    Rows,
)
from terrainwave.codec.varint import decode_varint, encode_varint
from terrainwave.coding.native_library import also_in_c
from terrainwave.errors import CorruptStreamError, TruncatedStreamError

_IN_C = "terrainwave.codec.rapid.unit_in_c"
_NARROW, _STATES, _BANDS, _HAS_ORIGIN, _DEFINED = 1, 1, 3, 32, 63
_N_STATES = (1, 8, MOST_STATES)
# A payload of fewer words has fewer states: each takes two bytes.
_WORDS_OF_STATES = (0, 1 << 7, 1 << 11)
_MOST_SHIFT = 30
_MOST_DETAIL = 2**31 - 1
# Origins are the middle of the range of heights, or 2**10 such numbers as planes hold, from there.
_ORIGIN_BITS = 10
# A payload has a part that can be read alone, for windows, for so many bytes.
_BYTES_OF_BAND, _MOST_BANDS = 1 << 15, 4
_Whole = NDArray[np.int32]
_EVERY = 3  # one detail in so many counts for the estimate of their bits
_SPARE_RAW = 2
# Planes of fewer rows or columns are not kept: much work for few samples.
LEAST_SIDE = 10
# Symbols of what is not of the samples: odd ends of rows.
_ROOM = 1 << 13
_NONE_KNOWN = (False, False, False, False)
_NO_HEIGHTS = np.zeros((1, 1), dtype=np.int32)
_NO_MASK = np.ones((1, 1), dtype=np.uint8)
_NO_RAW = np.zeros(_SPARE_RAW, dtype=np.uint32)
_NO_WORDS = np.zeros(MOST_STATES, dtype=np.uint16)
_NO_LOG = Log(*(np.zeros(1, dtype=np.uint8) for _ in range(3)))


class _Memory:
    """A workspace, and room for what is logged, that grow with what is coded in them."""

    def __init__(self) -> None:
        self._workspace, self._streams = new_workspace(0), _new_streams(0)

    def of(self, shape: tuple[int, int]) -> Workspace:
        """Return arrays for lattices of this shape."""
        side = (max(shape) + 1) // 2
        if side > self._workspace.side:
            self._workspace = new_workspace(side)
        return self._workspace

    def streams(self, n: int) -> Streams:
        """Return where to log a band of at most `n` samples; the one logged before is gone."""
        if len(self._streams.log.tables) < 2 * n + _ROOM:
            self._streams = _new_streams(n)
        # Raw bits are added to what is there.
        self._streams.raw[: (int(self._streams.places[BIT]) >> 5) + 2] = 0
        self._streams.places[:] = 0
        return self._streams


_MEMORY = Spares(_Memory)


class _Head(NamedTuple):
    """Head of a payload; `sizes` are the words and bytes of raw bits of each band."""

    is_narrow: bool
    shift: int
    number: int  # of the origin, 0 in the middle of the range of heights
    n_states: int
    sizes: list[tuple[int, int]]
    n_bytes: int

    def origin(self, spec: GroupSpec) -> int:
        """Return the height that those in planes are less."""
        return ((spec.z_min + spec.z_max) >> 1) + (self.number << (_ORIGIN_BITS + self.shift))

    def limits(self, spec: GroupSpec) -> tuple[int, int]:
        """Return the lowest and the highest height; the origin lies between them."""
        if not self.is_narrow:
            return spec.z_min, spec.z_max
        origin = self.origin(spec)
        return max(spec.z_min, origin - LIMIT), min(spec.z_max, origin + LIMIT)


class _Unit(NamedTuple):
    """A unit that is coded: what all of its lattices have in common."""

    spec: GroupSpec
    head: _Head
    target: Heights | None
    valid: NDArray[np.uint8] | None
    corrections: Corrections
    bands: list[Streams]
    memory: _Memory

    def aim(self, stride: int) -> Aim:
        """Return target, validity and corrections at a stride, for kernels."""
        part = np.s_[::stride, ::stride]
        return Aim(
            _NO_HEIGHTS if self.target is None else np.ascontiguousarray(self.target[part]),
            _NO_MASK if self.valid is None else np.ascontiguousarray(self.valid[part]),
            *(np.ascontiguousarray(array[part]).ravel() for array in self.corrections),
        )

    def write(
        self, lattice: Lattice, base: int, rows: tuple[int, int], n_cols: int,
        out: NDArray[Any], row_spacing: int,
    ) -> None:  # fmt: skip
        """Write rows of a narrow lattice, and `base` more, to flat memory."""
        planes = self.memory.of((lattice.n_rows, lattice.n_cols)).planes
        write_rows(planes, lattice.origin + base, rows, n_cols, out, row_spacing)

    def keep_added(self, stride: int, aim: Aim) -> None:
        """Keep the corrections that an encoder found at a stride."""
        if aim.added.size and stride > 1:
            part = self.corrections.added[::stride, ::stride]
            part[:] = aim.added.reshape(part.shape)


class UnitCoder:
    """Codes units with tables; see `DirectRefiner` for what its functions promise."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables

    def tables(self, step: int) -> Tables:  # noqa: ARG002
        """Return the tables that units of a step are coded by."""
        return self._tables

    @also_in_c(_IN_C)
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
        with _MEMORY.lent() as memory:
            unit = _new_unit(spec, parent, target, mask, corrections, memory)
            # How many bands a group has is known when its details are.
            unit = unit if parent is None else unit._replace(bands=[])
            lattice, n_bands = self._code(unit, parent, ALL_ROWS, out), 1
            logged: Iterable[Streams] = unit.bands
            if parent is not None and lattice is not None:
                n_bands = _n_bands(lattice, memory.of(out.shape))
                logged = self._logged(unit, lattice, n_bands)
            payload = self._pack(unit, logged, is_alone=n_bands == 1)
        return payload, out, None

    @also_in_c(_IN_C)
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
        with _MEMORY.lent() as memory:
            unit = _new_unit(spec, parent, target, mask, NO_CORRECTIONS, memory)
            self._code(unit, parent, ALL_ROWS, out)
            streams = unit.bands[0]
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

        Raises `CorruptStreamError` if the payload contradicts format-rapid.md;
        `TruncatedStreamError` if it is too short.
        """
        out = new_heights(spec.region.shape)
        self.decode_into(spec, parent, mask, payload, out, corrections)
        return out, None

    @also_in_c(_IN_C)
    def decode_into(
        self,
        spec: GroupSpec,
        parent: Heights | None,
        mask: Mask | None,
        payload: bytes,
        out: Heights,
        corrections: Corrections = NO_CORRECTIONS,
        rows: Rows = ALL_ROWS,
        raw: Raw | None = None,
    ) -> bool:
        """Rebuild the heights of ``spec.region`` in `out`; see `decode` and `DirectRefiner`."""
        rows = ALL_ROWS if parent is None else rows
        head = _read_head(spec, payload)
        bands = _read_bands(head, payload)
        with _MEMORY.lent() as memory:
            unit = _Unit(spec, head, None, _as_bytes(mask), corrections, bands, memory)
            wanted = None
            if raw is not None and parent is not None and head.is_narrow:
                wanted = flat_view(raw.heights)
            lattice = self._code(unit, parent, rows, out, is_written=wanted is None)
            needed = needed_for(out.shape, rows, len(bands))
            all_ = band_strips(out.shape[0], len(bands))
            for k, (streams, (_, n_raw)) in enumerate(zip(bands, head.sizes, strict=True)):
                _check_end(streams, n_raw, is_part=needed.strips[k] != all_[k])
            # Not before all is known to be good.
            if raw is not None and wanted is not None and lattice is not None:
                (first, end), shape = needed.planes[3], raw.heights.shape
                unit.write(lattice, raw.base, (first, min(end, shape[0])), shape[1], *wanted)
        return wanted is not None

    def rows_above(self, spec: GroupSpec, payload: bytes, rows: Rows) -> Rows:
        """Return which rows of its parent heights a group needs; see `DirectRefiner`."""
        n_bands = len(_read_head(spec, payload).sizes)
        return Rows(*needed_for(spec.core.shape, rows, n_bands).parent)

    def _code(
        self, unit: _Unit, parent: Heights | None, rows: Rows, out: Heights, *,
        is_written: bool = True,
    ) -> Lattice | None:  # fmt: skip
        """Encode a unit, or decode rows of it; return its lattice, the last one of a root block.

        Rows of narrow groups may be left to be written.
        """
        spec = unit.spec
        if parent is not None:
            source, pitch = flat(parent)
            above = Parent(source, 0, pitch, 1)
            shared = tuple(spec.shared)
            return self._code_lattice(unit, 1, above, shared, rows, out, is_written=is_written)
        stride, lattice = 1, None
        while stride < max(out.shape) - 1:
            stride *= 2
        for row in range(0, out.shape[0], stride):
            for col in range(0, out.shape[1], stride):
                _code_corner(unit, out, row, col)
        while stride > 1:
            above = Parent(out.ravel(), 0, stride * out.shape[1], stride)
            stride >>= 1
            part = out[::stride, ::stride]
            own = np.empty(part.shape, dtype=np.int32)
            lattice = self._code_lattice(unit, stride, above, _NONE_KNOWN, rows, own)
            part[:] = own
        return lattice

    def _code_lattice(
        self, unit: _Unit, stride: int, parent: Parent, known: tuple[bool, ...], rows: Rows,
        out: Heights, *, is_written: bool = True,
    ) -> Lattice:  # fmt: skip
        """Code the lattice of a unit at one stride."""
        spec, head = unit.spec, unit.head
        low, high = head.limits(spec)
        # Levels are rounded down: predictions lie up to one level below the lowest height.
        most = (spec.z_max - spec.z_min + (1 << head.shift)) // spec.step + 1
        lattice = Lattice(
            out.shape[0], out.shape[1], spec.step, low, high, min(most, _MOST_DETAIL),
            head.origin(spec), head.shift, head.is_narrow, unit.valid is not None,
        )  # fmt: skip
        aim = unit.aim(stride)
        work = unit.memory.of(out.shape)
        needed = needed_for(out.shape, rows, len(unit.bands))
        load_parent(parent, lattice, needed.parent, needed.features, work)
        tables = self.tables(spec.step)
        which = tables.level_class(spec.level - (stride.bit_length() - 1))
        if unit.target is None:
            self._code_details(unit, which, lattice, aim.valid, needed.strips)
        code_heights(
            unit.target is not None, aim, lattice, work, parent, known,
            tables.stencils[which].astype(np.int32), needed.planes, out,
        )  # fmt: skip
        if head.is_narrow and is_written:
            unit.write(lattice, 0, needed.planes[3], lattice.n_cols, out.reshape(-1), out.shape[1])
        if unit.target is not None:
            unit.keep_added(stride, aim)
            self._code_details(unit, which, lattice, aim.valid, needed.strips)
            self._see(which, lattice, work, aim.valid)
        return lattice

    # Takes the samples of planes that have been encoded (`fit_weights`). None: nobody wants them.
    keep: Callable[[int, int, int, _Whole, _Whole, NDArray[np.bool_]], None] | None = None

    def _see(self, which: int, lattice: Lattice, work: Workspace, valid: NDArray[np.uint8]) -> None:
        """Look at a lattice of a class of levels that has been encoded (`fit_weights`)."""

    def _code_details(
        self, unit: _Unit, which: int, lattice: Lattice, valid: NDArray[np.uint8],
        strips: tuple[tuple[int, int], ...],
    ) -> None:  # fmt: skip
        """Read or log the details of strips of each band, with the tables of a class of levels."""
        tables, work = self.tables(unit.spec.step), unit.memory.of((lattice.n_rows, lattice.n_cols))
        made = weights_of(tables.weights[which], lattice.step, lattice.shift)
        for streams, own in zip(unit.bands, strips, strict=True):
            if own[0] < own[1]:
                code = read_details if unit.target is None else log_details
                code(lattice, work, valid, own, made, tables.frequencies, streams)

    def _logged(self, unit: _Unit, lattice: Lattice, n_bands: int) -> Iterator[Streams]:
        """Yield the bands of a group, each logged where the one before was."""
        which, valid = self.tables(unit.spec.step).level_class(unit.spec.level), unit.aim(1).valid
        for strips in band_strips(lattice.n_rows, n_bands):
            streams = unit.memory.streams(lattice.n_rows * lattice.n_cols)
            self._code_details(unit._replace(bands=[streams]), which, lattice, valid, (strips,))
            yield streams

    def _pack(self, unit: _Unit, logged: Iterable[Streams], *, is_alone: bool) -> bytes:
        """Return the payload of a unit whose bands have been logged."""
        frequencies, head = self.tables(unit.spec.step).frequencies, unit.head
        sizes, contents, which = [], [], len(_N_STATES) - 1
        for streams in logged:
            words, states = _words(streams, _N_STATES[which], frequencies)
            # Several bands are large enough for all states.
            if is_alone and len(words) < _WORDS_OF_STATES[which]:
                which = sum(len(words) >= least for least in _WORDS_OF_STATES) - 1
                words, states = _words(streams, _N_STATES[which], frequencies)
            n_raw = (int(streams.places[BIT]) + 7) // 8
            sizes += [encode_varint(len(words)), encode_varint(n_raw)]
            raw = streams.raw[: (n_raw + 3) // 4].astype("<u4").tobytes()[:n_raw]
            contents += [states.astype("<u4").tobytes(), words.astype("<u2").tobytes(), raw]
        flags = head.is_narrow * _NARROW | which << _STATES | (len(sizes) // 2 - 1) << _BANDS
        parts = [b"" if head.is_narrow else bytes([head.shift])]
        if head.number:
            flags |= _HAS_ORIGIN
            parts.append(
                encode_varint(2 * head.number if head.number > 0 else -2 * head.number - 1)
            )
        return b"".join([bytes([flags]), *parts, *sizes, *contents])


def _n_bands(lattice: Lattice, work: Workspace) -> int:
    """Return how many bands a group should have, by about how many bits its details take."""
    n, octaves = 0, 0
    for plane in (HH, HL, LH):
        n_rows, n_cols = plane_shape(plane, (lattice.n_rows, lattice.n_cols))
        some = work.details[plane - HH, : n_rows * (n_cols + (n_cols & 1)) : _EVERY]
        n += len(some)
        sizes = np.abs(some).astype(np.float32)
        sizes += sizes
        sizes += 1
        # The bits of a float32 tell its logarithm, in 2**-23 of an octave above 2**-127.
        octaves += int(sizes.view(np.int32).sum(dtype=np.int64)) - (len(some) * 127 << 23)
    n_bits = _EVERY * min(2 * octaves, octaves + (3 * n << 22)) >> 23
    return min(1 + n_bits // (8 * _BYTES_OF_BAND), _MOST_BANDS)


def _words(
    streams: Streams, n_states: int, frequencies: Frequencies
) -> tuple[NDArray[np.uint16], NDArray[np.uint32]]:
    """Return what has been logged as words, and the states that decoders begin with."""
    states = np.full(n_states, STATE_START, dtype=np.uint32)
    words = np.empty(int(streams.places[N_LOGGED]), dtype=np.uint16)
    n_words = encode_log(streams._replace(states=states), frequencies, words)
    return words[len(words) - n_words :], states


def _as_bytes(mask: Mask | None) -> NDArray[np.uint8] | None:
    """Return validity as kernels read it; None where all samples are valid."""
    return None if mask is None else np.ascontiguousarray(mask).view(np.uint8)


def _new_streams(n: int) -> Streams:
    """Return where to log `n` samples: three symbols for each two, and 50 raw bits for each."""
    room = 2 * n + _ROOM
    log = Log(*(np.empty(room, dtype=np.uint8) for _ in range(3)))
    raw, places = np.zeros(2 * room, dtype=np.uint32), np.zeros(4, dtype=np.int64)
    return Streams(np.zeros(MOST_STATES, dtype=np.uint32), _NO_WORDS, raw, log, places)


def _new_unit(
    spec: GroupSpec, parent: Heights | None, target: Heights, mask: Mask | None,
    corrections: Corrections, memory: _Memory,
) -> _Unit:  # fmt: skip
    """Return a unit to be encoded: by 16 bits if its heights, and what may be asked for, fit."""
    kept = corrections.kept[corrections.kept != FREE]
    seen = [part for part in (target if mask is None else target[mask], parent, kept)
            if part is not None and part.size]  # fmt: skip
    middle = (spec.z_min + spec.z_max) >> 1
    # Heights of voids may be kept that lie beyond all limits: they come back within these.
    least = max(min((int(part.min()) for part in seen), default=middle), spec.z_min)
    most = min(max((int(part.max()) for part in seen), default=middle), spec.z_max)
    head = next(
        head
        for shift in range(_MOST_SHIFT + 1)
        for head in _heads(spec, least, most, shift)
        if head is not None
    )
    target = np.ascontiguousarray(target)
    bands = [memory.streams(target.size)]
    return _Unit(spec, head, target, _as_bytes(mask), corrections, bands, memory)


def _heads(spec: GroupSpec, least: int, most: int, shift: int) -> list[_Head]:
    """Return what a payload of so large a shift may begin with; nothing if heights do not fit."""
    middle, bits = (spec.z_min + spec.z_max) >> 1, _ORIGIN_BITS + shift
    offset = ((least + most) >> 1) - middle
    # Towards the middle, so that an origin stays within the range of heights.
    nearest = offset >> bits if offset >= 0 else -(-offset >> bits)
    found = []
    for number in (0, nearest):
        origin = middle + (number << bits)
        far = max(most - origin, origin - least)
        is_narrow = shift == 0 and far + spec.half <= LIMIT and spec.step <= LIMIT
        if far >> shift <= LIMIT:
            found.append(_Head(is_narrow, shift, number, MOST_STATES, [], 0))
    return sorted(found, key=lambda head: not head.is_narrow)


def _read_head(spec: GroupSpec, payload: bytes) -> _Head:
    if not payload:
        raise TruncatedStreamError("the payload is empty")
    flags, at = payload[0], 1
    which, n_bands = flags >> _STATES & 3, (flags >> _BANDS & 3) + 1
    if flags & ~_DEFINED or which >= len(_N_STATES):
        raise CorruptStreamError(f"payload flags {flags:#x} are not defined")
    is_narrow = bool(flags & _NARROW)
    if is_narrow and spec.step > LIMIT:
        raise CorruptStreamError(
            f"a narrow unit with a step of {spec.step}, expected {LIMIT} at most"
        )
    if spec.parent_region is None and n_bands > 1:
        raise CorruptStreamError(f"a root block of {n_bands} bands, expected 1")
    shift = number = 0
    if not is_narrow:
        if len(payload) < 2:
            raise TruncatedStreamError("the payload ends before its shift")
        shift, at = payload[1], 2
        if shift > _MOST_SHIFT:
            raise CorruptStreamError(f"a shift of {shift} bits, expected {_MOST_SHIFT} at most")
    if flags & _HAS_ORIGIN:
        number, at = decode_varint(payload, at)
        number = number >> 1 if number % 2 == 0 else -(number >> 1) - 1
    sizes = []
    for _ in range(n_bands):
        n_words, at = decode_varint(payload, at)
        n_raw, at = decode_varint(payload, at)
        sizes.append((n_words, n_raw))
    head = _Head(is_narrow, shift, number, _N_STATES[which], sizes, at)
    if not spec.z_min <= head.origin(spec) <= spec.z_max:
        raise CorruptStreamError(
            f"an origin of {head.origin(spec)}, expected one from {spec.z_min} to {spec.z_max}"
        )
    return head


def _read_bands(head: _Head, payload: bytes) -> list[Streams]:
    at, bands = head.n_bytes, []
    needed = at + sum(4 * head.n_states + 2 * n_words + n_raw for n_words, n_raw in head.sizes)
    if needed != len(payload):
        kind = TruncatedStreamError if needed > len(payload) else CorruptStreamError
        raise kind(f"the payload has {len(payload)} bytes, its parts need {needed}")
    for n_words, n_raw in head.sizes:
        states = np.frombuffer(payload, "<u4", head.n_states, at).astype(np.uint32)
        if states.min() < STATE_START:
            raise CorruptStreamError(f"a state of {states.min()}, expected {STATE_START} at least")
        at += 4 * head.n_states
        words = np.zeros(n_words + MOST_STATES, dtype=np.uint16)
        words[:n_words] = np.frombuffer(payload, "<u2", n_words, at)
        at += 2 * n_words
        raw = np.zeros((n_raw + 3) // 4 + _SPARE_RAW, dtype="<u4")
        raw.view(np.uint8)[:n_raw] = np.frombuffer(payload, np.uint8, n_raw, at)
        at += n_raw
        places = np.array([0, 0, 0, 0], dtype=np.int64)
        bands.append(Streams(states, words, raw.astype(np.uint32, copy=False), _NO_LOG, places))
    return bands


def _code_corner(unit: _Unit, out: Heights, row: int, col: int) -> None:
    """Encode or decode a sample that nothing predicts, on a grid of steps from the lowest height.

    It takes raw bits; a void one none, and the middle of the range of heights.
    """
    (low, high), step, streams = unit.head.limits(unit.spec), unit.spec.step, unit.bands[0]
    height = (low + high) >> 1
    if unit.valid is None or unit.valid[row, col]:
        n_bits = ((high - low) // step).bit_length()
        bit = int(streams.places[BIT])
        streams.places[BIT] += n_bits
        at, shift = min(bit >> 5, len(streams.raw) - 2), bit & 31
        if unit.target is not None:
            index = (int(unit.target[row, col]) - low) // step
            streams.raw[at] |= (index << shift) & 0xFFFFFFFF
            streams.raw[at + 1] |= index << shift >> 32
        else:
            both = int(streams.raw[at]) | int(streams.raw[at + 1]) << 32
            index = both >> shift & ((1 << n_bits) - 1)
        height = min(low + index * step + (step >> 1), high)
    kept, added = (array.ravel() for array in unit.corrections)
    place = row * out.shape[1] + col
    out[row, col] = correct(height, kept, added, place, (low, high), (low, high))


def _check_end(streams: Streams, n_raw: int, *, is_part: bool) -> None:
    """Raise unless a band's streams have been used up exactly; by a part of it, not exceeded."""
    n_words, n_bits = len(streams.words) - MOST_STATES, 8 * n_raw
    word, bit = int(streams.places[WORD]), int(streams.places[BIT])
    if streams.places[IS_BAD] or word > n_words or bit > n_bits:
        raise TruncatedStreamError("the payload ends inside its data")
    if is_part:
        return
    if word < n_words or (bit + 7) // 8 < n_raw:
        raise CorruptStreamError("bytes are left over after the last symbol")
    if (streams.states != STATE_START).any():
        raise CorruptStreamError("the symbols do not end in the state that they began with")
    if bit % 8 and int(streams.raw[bit >> 5]) >> (bit & 31):
        raise CorruptStreamError("the last byte of raw bits is not filled with 0")
