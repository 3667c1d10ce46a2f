"""Masks of units: valid samples, and those valid by themselves (FORMAT.md §5.2).

A sample of a coarse level is valid where any full-grid sample near it is. It is valid by itself,
*own*, where the full-grid sample at its place is; the other valid ones are *fills*. On the finest
level all valid samples are own.

Own samples are coded from level to level, each once: those on even rows and columns are the
parent's. The others lie between them in planes HH, HL, LH, and each has four neighbours that are
known before: its context. So all contexts of a plane are made at once, and static rANS reads them
without waiting. Where the four agree, 32 samples share one bit that says whether any is unlike
them. Of fills only those are coded that lie beside no own sample: few.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.annexes import read_tables
from terrainwave.codec.memory import new_heights
from terrainwave.codec.refiner import ALL_VALID, Mask, Validity, as_array
from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.jit import kernel, kernel_part
from terrainwave.coding.native_library import also_in_c
from terrainwave.coding.status import Status, raise_for_status
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Region

_IN_C = "terrainwave.codec.in_c"
# Planes of a lattice: the parent's samples; odd rows and columns; odd columns; odd rows.
_A, _HH, _HL, _LH = 0, 1, 2, 3
# Of a sample: whether it is own, and whether voids of the parent imply that it is void. A context
# has the own bits of four neighbours; more where the sample is implied to be void.
_OWN, _VALID, _UNKNOWN_BIT, _IMPLIED = 1, 2, 2, 16
_UNKNOWN = 1 << _UNKNOWN_BIT
_NONE, _ALL = 0, 15
# Samples of a row that share a bit, as words of 8.
GROUP = 32
_WORDS = GROUP // 8
# Models: of samples by plane and context; of a lattice's first sample; of fills; of groups by
# plane and kind.
_CORNER = 48
_FILL = FIRST_OF_GROUPS = 49
_GROUPS = 50
_ALL_OWN, _UNIFORM, _FEW, _MANY = 0, 1, 2, 3
N_MODELS = _GROUPS + 12
# Sets of frequencies: of samples, and of groups and fills.
N_SETS, N_GROUP_SETS = 16, 7
# The file, which tools/train_masks.py writes.
ANNEX = "masks.bin"
LAYOUT = np.dtype([
    ("samples", "<u2", (N_SETS, FIRST_OF_GROUPS)),
    ("groups", "<u2", (N_GROUP_SETS, N_MODELS - FIRST_OF_GROUPS)),
])  # fmt: skip
# Instead, a section may bring frequencies of its own: a byte for each model, in steps of 16.
_OWN_FREQS = N_GROUP_SETS * N_SETS
_FREQ_STEP = 16
SLOT_BITS = 12
N_SLOTS = 1 << SLOT_BITS
_STATE_START = 1 << 16
# Long sections have states that take turns, so that a processor works on several at a time.
_N_STATES = 4
_LONG = 1600  # bits
_HAS_STATES = 0x80
# Columns of memory before a plane's first one, for the neighbour outside.
_LEFT = 8
# Words past the end that may be read before anyone looks how many there are.
_AHEAD = 32
# Of costs.
_UNIT = 1 << 10


class Above(NamedTuple):
    """Validity of the level above, around a unit."""

    region: Region
    validity: Validity


class CodedBits(NamedTuple):
    """Models and bits of a section in order, and the places of the samples being coded."""

    models: NDArray[np.uint8]
    bits: NDArray[np.uint8]
    places: NDArray[np.uint32]


class _Coder(NamedTuple):
    """State of a reader of bits; `places`: the next word, and 1 if words ran out."""

    freqs: NDArray[np.uint32]
    words: NDArray[np.uint16]
    states: NDArray[np.uint32]
    places: NDArray[np.int64]


class _Lattice(NamedTuple):
    """A lattice of samples between those of the level above.

    `planes` hold contexts, then what becomes of them, each with a row and a column more on all
    sides, `pitch` apart from row to row; `words` is the same memory. `truth`: own samples that are
    noted, in the same places. `groups`: whether one is mixed, and 2 if it has a bit. `p` and `q`
    are 1 if the first row and column are odd.
    """

    planes: NDArray[np.uint8]
    words: NDArray[np.uint64]
    truth: NDArray[np.uint8]
    groups: NDArray[np.uint8]
    cells: NDArray[np.uint8]
    pitch: int
    p: int
    q: int


# What a kernel does with bits: reads them, notes those of a mask, or takes all to be 1.
_READS, _NOTES, _SKIPS = 0, 1, 2
_NOTHING = np.zeros((1, 1), dtype=np.bool_)
_NO_CODER = _Coder(*(np.zeros(n, kind) for n, kind in ((1, "u4"), (1, "u2"), (1, "u4"), (2, "i8"))))


@cache
def frequencies() -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return the frequencies of a 1 by set and model: of samples, and of groups and fills.

    Each is one of 1 … 4095 of 4096.
    """
    tables = read_tables(ANNEX, LAYOUT)
    return tables["samples"].astype(np.uint32), tables["groups"].astype(np.uint32)


def encode_validity(
    validity: Validity, region: Region, above: Above | None, *, is_finest: bool
) -> bytes:
    """Return the section of a unit's validity (FORMAT.md §5.2); empty if it follows from `above`.

    Parameters
    ----------
    validity : Validity
        Void where voids of the parent imply it. All valid samples are own on the finest level;
        those at the parent's samples where these are.
    above : Above or None
        None for a root block.
    """
    shape = region.shape
    mask, own = as_array(validity.mask, shape), as_array(validity.own_mask, shape)
    simplest = decode_validity(b"", region, above, is_finest=is_finest)
    if np.array_equal(as_array(simplest.mask, shape), mask) and (
        is_finest or np.array_equal(as_array(simplest.own_mask, shape), own)
    ):
        return b""
    log = _new_log(region)
    _, n = code_known(own, mask, region, above, is_finest, log)
    return _packed(log.models[:n], log.bits[:n])


def decode_validity(
    section: bytes, region: Region, above: Above | None, *, is_finest: bool
) -> Validity:
    """Undo `encode_validity`; whatever the bytes, all own samples are valid.

    Raises
    ------
    CorruptStreamError
        If a section is not exactly what it should be.
    """
    if not section and (above is None or above.validity.own_mask is None):
        return ALL_VALID
    if not section:
        cells, _ = code_known(None, _NOTHING, region, above, is_finest, _new_log(region))
    else:
        coder, log = _unpacked(section), _new_log(region)
        cells, _ = _code(_READS, _NOTHING, _NOTHING, region, above, is_finest, log, coder)
        n_read, is_short = coder.places.tolist()
        n_words = coder.words.shape[0] - _AHEAD
        if is_short or n_read > n_words:
            raise_for_status(Status.TRUNCATED, len(section))
        if n_read < n_words or (coder.states != _STATE_START).any():
            raise_for_status(Status.TRAILING, len(section) - 2 * (n_words - n_read))
    own = (cells & _OWN).view(np.bool_)
    if is_finest:
        return Validity.of(own)
    return Validity.of((cells >> 1 & 1).view(np.bool_), own)


@also_in_c(_IN_C)
def code_known(
    own: Mask | None, mask: Mask, region: Region, above: Above | None, is_finest: bool,
    log: CodedBits,
) -> tuple[NDArray[np.uint8], int]:  # fmt: skip
    """Note the bits of a mask; of None, what follows from `above` alone.

    Return its samples, own + 2 · valid, and how many bits there are.
    """
    if own is None:
        return _code(_SKIPS, _NOTHING, mask, region, above, is_finest, log, _NO_CODER)
    return _code(_NOTES, own, mask, region, above, is_finest, log, _NO_CODER)


def _new_log(region: Region) -> CodedBits:
    """Return room for all that a unit may code: each sample and its group's bit, and fills."""
    n = region.n_rows * region.n_cols + GROUP
    return CodedBits(_memory(3 * n), _memory(3 * n), new_heights((1, n)).ravel().view(np.uint32))


def _memory(n: int) -> NDArray[np.uint8]:
    """Return bytes that have been used before."""
    return new_heights((1, -(-n // 4))).ravel().view(np.uint8)


def _code(
    task: int, own: Mask, mask: Mask, region: Region, above: Above | None, is_finest: bool,
    log: CodedBits, coder: _Coder,
) -> tuple[NDArray[np.uint8], int]:  # fmt: skip
    """Code a unit's validity; return it, own + 2 · valid, and how many bits were coded.

    A root block is coded in lattices of more and more samples, as if each were a unit below the one
    before.
    """
    n, steps = 0, [(region, own)]
    if above is None:
        n, corner = 1, np.ones((1, 1), dtype=np.bool_)
        log.models[0], log.bits[0] = _CORNER, own[0, 0]
        if task == _READS:
            _read(0, 1, log, coder)
        if task != _SKIPS:
            corner[0, 0] = log.bits[0]
        above = Above(Region(0, 0, 1, 1), Validity(None, corner))
        while max(steps[0][0].shape) > 2:
            (_, _, n_rows, n_cols), finer = steps[0]
            steps.insert(0, (Region(0, 0, n_rows + 1 >> 1, n_cols + 1 >> 1), finer[::2, ::2]))
    for at, truth in steps:
        cells, n = _code_lattice(task, truth, at, above, n, log, coder)
        above = Above(at, Validity(None, (cells & _OWN).view(np.bool_)))
    if not is_finest:
        beside = np.zeros(cells.shape[1] + 2, dtype=np.uint8)
        n = _code_fills(task, np.ascontiguousarray(mask), cells, beside, n, log, coder)
    return cells, n


def _code_lattice(
    task: int, own: Mask, region: Region, above: Above, n: int, log: CodedBits, coder: _Coder
) -> tuple[NDArray[np.uint8], int]:
    """Code own samples between those above; return these and implied voids, and how many bits."""
    n_rows, n_cols = region.n_rows // 2 + 1, region.n_cols // 2 + 1
    pitch = _LEFT + (n_cols // GROUP + 1) * GROUP
    planes = _memory(4 * (n_rows + 2) * pitch)
    n_cells = region.n_rows * region.n_cols
    lattice = _Lattice(
        planes, planes.view(np.uint64),
        np.empty(planes.size if task == _NOTES else 1, dtype=np.uint8),
        np.empty(n_rows * (pitch // GROUP) + 1, dtype=np.uint8),
        _memory(n_cells)[:n_cells].reshape(region.shape), pitch, region.row & 1, region.col & 1,
    )  # fmt: skip
    known = (above.validity.own_mask, above.validity.mask)
    own_above, valid_above = (
        np.ascontiguousarray(as_array(part, above.region.shape)).view(np.uint8) for part in known
    )
    # The parent's sample at the first even row and column.
    row, col = (region.row + 1 >> 1) - above.region.row, (region.col + 1 >> 1) - above.region.col
    own = np.ascontiguousarray(own)
    n = _code_planes(task, own, own_above, valid_above, row, col, lattice, n, log, coder)
    return lattice.cells, n


@kernel
def _read(first, last, log, coder):
    """Read bits `first` … `last` − 1; bit i by state i mod their number."""
    freqs, words, states, places = coder.freqs, coder.words, coder.states, coder.places
    models, bits = log.models, log.bits
    mask, at = np.uint64(states.shape[0] - 1), np.uint64(places[0])
    most, slots = np.uint64(words.shape[0] - _AHEAD), np.uint32(N_SLOTS)
    start, end = np.uint64(first), np.uint64(last)
    while start < end:
        stop = min(start + np.uint64(_AHEAD), end)
        if at > most:
            places[1] = 1
            at = most
        for i in range(start, stop):
            state = states[i & mask]
            freq = freqs[np.uint64(models[i])]
            slot, whole = state & np.uint32(N_SLOTS - 1), state >> np.uint32(SLOT_BITS)
            is_one = slot < freq
            own = freq if is_one else slots - freq
            before = np.uint32(0) if is_one else freq
            state = np.uint32(np.uint32(own * whole) + np.uint32(slot - before))
            bits[i] = np.uint8(is_one)
            is_low = np.uint32(state < np.uint32(_STATE_START))
            filled = np.uint32(np.uint32(state << np.uint32(16)) | np.uint32(words[at]))
            states[i & mask] = filled if is_low else state
            at += np.uint64(is_low)
        start = stop
    places[0] = np.int64(at)


@kernel
def _contexts(planes, to, n, first, second, third, fourth, kept):
    """Fill the contexts of a row of `n` samples from their four neighbours, each a row, too.

    What is implied of the third and fourth ones counts if `kept`, which is 255, else 1, leaves it.
    """
    for k in range(np.uint64(n)):
        near = np.uint8(planes[first + k] | np.uint8(planes[second + k] << np.uint8(1)))
        far = np.uint8(planes[third + k] & kept) << np.uint8(2)
        far = np.uint8(far) | np.uint8(np.uint8(planes[fourth + k] & kept) << np.uint8(3))
        planes[to + k] = np.uint8(near | np.uint8(far))


@kernel
def _shape_of(lattice, plane):
    """Return rows and columns of a plane, and the place of its first sample."""
    n_rows, n_cols = lattice.cells.shape
    rows, cols = (n_rows + 1 - lattice.p) >> 1, (n_cols + 1 - lattice.q) >> 1
    rows = n_rows - rows if plane == _HH or plane == _LH else rows
    cols = n_cols - cols if plane == _HH or plane == _HL else cols
    return rows, cols, plane * (lattice.planes.shape[0] >> 2) + lattice.pitch + _LEFT


@kernel_part
def _take_above(own, valid, row0, col0, lattice):
    """Take the parent's samples, with one more on each side; outside of the parent its border."""
    planes, void, one = lattice.planes, np.uint8(4), np.uint8(1)
    n_rows, n_cols, start = _shape_of(lattice, _A)
    for i in range(-1, n_rows + 1):
        row = min(max(row0 + i, 0), own.shape[0] - 1)
        own_row, valid_row = own[row], valid[row]
        to, first = np.uint64(start + i * lattice.pitch), np.uint64(col0)
        for j in range(np.uint64(n_cols)):
            is_void = np.uint8((valid_row[first + j] ^ one) << void)
            planes[to + j] = np.uint8(own_row[first + j] | is_void)
        for j in (-1, n_cols):
            col = min(max(col0 + j, 0), own.shape[1] - 1)
            is_void = np.uint8((valid_row[col] ^ one) << void)
            planes[start + i * lattice.pitch + j] = np.uint8(own_row[col] | is_void)


@kernel_part
def _frame(planes, start, pitch, n_rows, n_cols):
    """Repeat the border of a plane outside."""
    for i in range(n_rows):
        at = start + i * pitch
        planes[at - 1] = planes[at]
        planes[at + n_cols] = planes[at + n_cols - 1]
    for j in range(-1, n_cols + 1):
        planes[start - pitch + j] = planes[start + j]
        planes[start + n_rows * pitch + j] = planes[start + (n_rows - 1) * pitch + j]


@kernel
def _kind_of_group(planes, at):
    """Return the kind of a group's bit, −1 without one, and whether samples are mixed."""
    n_none, n_all, n_implied = np.uint8(0), np.uint8(0), np.uint8(0)
    for k in range(np.uint64(GROUP)):
        context = planes[at + k]
        n_none = np.uint8(n_none + np.uint8(context == np.uint8(_NONE)))
        n_all = np.uint8(n_all + np.uint8(context == np.uint8(_ALL)))
        n_implied = np.uint8(n_implied + np.uint8(context >= np.uint8(_IMPLIED)))
    n = np.int64(n_none) + np.int64(n_all)
    is_mixed = n + np.int64(n_implied) < GROUP
    if n == 0:
        return -1, is_mixed
    if not is_mixed:
        return (_ALL_OWN if n == GROUP and n_none == 0 else _UNIFORM), is_mixed
    return (_FEW if n < GROUP // 2 else _MANY), is_mixed


@kernel
def _is_unlike(planes, truth, at):
    """Return whether a sample of a group is unlike its four neighbours, which agree."""
    n = np.uint8(0)
    for k in range(np.uint64(GROUP)):
        context = planes[at + k]
        is_none = np.uint8(context == np.uint8(_NONE)) & truth[at + k]
        is_all = np.uint8(context == np.uint8(_ALL)) & np.uint8(truth[at + k] ^ np.uint8(1))
        n = np.uint8(n | is_none | is_all)
    return n


@kernel_part
def _list_samples(lattice, at, is_open, base, n, log, n_places):
    """List the samples of a group that are coded: all that are not implied, or the mixed ones."""
    low, high = (_NONE, _ALL) if is_open else (_NONE + 1, _ALL - 1)
    low, high = np.uint8(low), np.uint8(high)
    for word in range(_WORDS):
        first = np.uint64(at + 8 * word)
        contexts = lattice.words[first >> np.uint64(3)]
        if not is_open and (contexts == np.uint64(0x0F0F0F0F0F0F0F0F) or contexts == np.uint64(0)):
            continue
        for k in range(np.uint64(8)):
            context = lattice.planes[first + k]
            log.models[n] = np.uint8(base + context)
            log.places[n_places] = np.uint32(first + k)
            is_coded = np.int64((context >= low) & (context <= high))
            n += is_coded
            n_places += is_coded
    return n, n_places


@kernel_part
def _row_contexts(lattice, plane, i):
    """Fill the contexts of row `i` of a plane."""
    pitch, p, q = lattice.pitch, lattice.p, lattice.q
    _, _, above = _shape_of(lattice, _A)
    odd_rows, odd_cols, corners = _shape_of(lattice, _HH)
    _, n, to = _shape_of(lattice, plane)
    to, kept = to + i * pitch, np.uint8(1)
    if plane == _HH:
        a = above + (i - p) * pitch - q
        b, c, d, kept = a + 1, a + pitch, a + pitch + 1, np.uint8(255)
    elif plane == _HL:
        a, c = above + i * pitch - q, corners + (i - 1 + p) * pitch
        b, d = a + 1, c + pitch
        if odd_rows == 0:
            c, d = a, b
    else:
        a, c = above + (i - p) * pitch, corners + i * pitch - 1 + q
        b, d = a + pitch, c + 1
        if odd_cols == 0:
            c, d = a, b
    a, b, c, d = np.uint64(a), np.uint64(b), np.uint64(c), np.uint64(d)
    _contexts(lattice.planes, np.uint64(to), n, a, b, c, d, kept)
    for j in range(n, (n + GROUP - 1) // GROUP * GROUP):
        lattice.planes[to + j] = _IMPLIED


@kernel_part
def _note_truth(own, lattice, plane):
    """Note which samples of a plane are own."""
    rows, cols, start = _shape_of(lattice, plane)
    row0 = lattice.p if plane == _HL else 1 - lattice.p
    col0 = lattice.q if plane == _LH else 1 - lattice.q
    for i in range(rows):
        to = start + i * lattice.pitch
        lattice.truth[to : to + (cols + GROUP - 1) // GROUP * GROUP] = 0
        for j in range(cols):
            lattice.truth[to + j] = own[row0 + 2 * i, col0 + 2 * j]


@kernel_part
def _list_groups(task, lattice, plane, n, log):
    """Make the contexts of a plane, and list its groups that have a bit; return how many bits."""
    rows, cols, start = _shape_of(lattice, plane)
    group = 0
    for i in range(rows):
        _row_contexts(lattice, plane, i)
        for k in range((cols + GROUP - 1) // GROUP if task != _SKIPS else 0):
            at = np.uint64(start + i * lattice.pitch + k * GROUP)
            kind, is_mixed = _kind_of_group(lattice.planes, at)
            lattice.groups[group] = is_mixed
            if kind >= 0:
                log.models[n] = _GROUPS + 4 * (plane - 1) + kind
                lattice.groups[group] |= 2
                if task == _NOTES:
                    log.bits[n] = _is_unlike(lattice.planes, lattice.truth, at)
                n += 1
            group += 1
    return n


@kernel_part
def _list_coded(lattice, plane, bit, n, log):
    """List the samples of a plane that have bits; return how many bits there are, and of these."""
    rows, cols, start = _shape_of(lattice, plane)
    group, n_places = 0, 0
    for i in range(rows):
        for k in range((cols + GROUP - 1) // GROUP):
            is_open = False
            if lattice.groups[group] & 2:
                is_open = log.bits[bit] == 1
                bit += 1
            if is_open or lattice.groups[group] & 1:
                at = start + i * lattice.pitch + k * GROUP
                n, n_places = _list_samples(
                    lattice, at, is_open, 16 * (plane - 1), n, log, n_places
                )
            group += 1
    return n, n_places


@kernel_part
def _settle(task, lattice, plane):
    """Make own samples of contexts: what agrees is as its neighbours are.

    Without a section, all that is not implied to be void is own.
    """
    rows, cols, start = _shape_of(lattice, plane)
    planes, least = lattice.planes, np.uint8(_NONE if task == _SKIPS else _ALL)
    for i in range(rows):
        to = np.uint64(start + i * lattice.pitch)
        for j in range(np.uint64(cols)):
            context = planes[to + j]
            is_own = np.uint8((context >= least) & (context <= np.uint8(_ALL)))
            is_void = np.uint8(context >= np.uint8(_IMPLIED)) << np.uint8(4)
            planes[to + j] = np.uint8(is_own | np.uint8(is_void))


@kernel_part
def _join(lattice):
    """Put the planes together."""
    planes, cells, pitch = lattice.planes, lattice.cells, lattice.pitch
    size = planes.shape[0] >> 2
    for row in range(cells.shape[0]):
        is_odd = (row + lattice.p) & 1
        i = (row - (1 - lattice.p if is_odd else lattice.p)) >> 1
        evens, odds = (_LH, _HH) if is_odd else (_A, _HL)
        if lattice.q:
            evens, odds = odds, evens
        first = evens * size + (i + 1) * pitch + _LEFT
        second = odds * size + (i + 1) * pitch + _LEFT
        for j in range(np.uint64(cells.shape[1] >> 1)):
            cells[row, 2 * j] = planes[np.uint64(first) + j]
            cells[row, 2 * j + np.uint64(1)] = planes[np.uint64(second) + j]
        if cells.shape[1] & 1:
            cells[row, cells.shape[1] - 1] = planes[first + (cells.shape[1] >> 1)]


@kernel
def _code_planes(task, own, own_above, valid_above, row, col, lattice, n, log, coder):
    """Code a lattice whose parent samples are known; return the number of bits."""
    lattice, log, coder = borrowed((lattice, log, coder))
    _take_above(own_above, valid_above, row, col, lattice)
    for plane in (_HH, _HL, _LH):
        rows, cols, start = _shape_of(lattice, plane)
        if rows == 0 or cols == 0:
            continue
        if task == _NOTES:
            _note_truth(own, lattice, plane)
        first_bit, n_places = n, 0
        n = _list_groups(task, lattice, plane, n, log)
        if task == _READS:
            _read(first_bit, n, log, coder)
        first = n
        if task != _SKIPS:
            n, n_places = _list_coded(lattice, plane, first_bit, n, log)
        if task == _READS:
            _read(first, n, log, coder)
        for k in range(n_places if task == _NOTES else 0):
            log.bits[first + k] = lattice.truth[log.places[k]]
        _settle(task, lattice, plane)
        for k in range(n_places):
            lattice.planes[log.places[k]] = log.bits[first + k]
        if plane == _HH:
            _frame(lattice.planes, start, lattice.pitch, rows, cols)
    _join(lattice)
    return n


@kernel
def _code_fills(task, mask, cells, beside, n, log, coder):
    """Code which samples are valid, own ones known; add 2 to those that are. Return how many bits.

    Valid are, unless implied to be void, all samples beside own ones.
    """
    models, bits, places = log.models, log.bits, log.places
    n_rows, n_cols = cells.shape
    first, n_places = n, 0
    for row in range(n_rows):
        here, north, south = cells[row], cells[max(row - 1, 0)], cells[min(row + 1, n_rows - 1)]
        for col in range(np.uint64(n_cols)):
            beside[col + np.uint64(1)] = (here[col] | north[col] | south[col]) & np.uint8(_OWN)
        for col in range(np.uint64(n_cols)):
            near = beside[col] | beside[col + np.uint64(1)] | beside[col + np.uint64(2)]
            known = np.uint8(_VALID) if near else np.uint8(_UNKNOWN)
            here[col] |= np.uint8(0) if here[col] & np.uint8(_IMPLIED) else known
        for start in range(0, n_cols, GROUP):
            stop = min(start + GROUP, n_cols)
            any_of = np.uint8(0)
            for col in range(np.uint64(start), np.uint64(stop)):
                any_of |= here[col]
            if any_of & np.uint8(_UNKNOWN):
                for col in range(np.uint64(start), np.uint64(stop)):
                    places[n_places] = np.uint32(np.uint64(row * n_cols) + col)
                    n_places += np.int64(here[col] >> np.uint8(_UNKNOWN_BIT)) & 1
    for k in range(n_places):
        models[n] = _FILL
        bits[n] = 1
        if task == _NOTES:
            bits[n] = mask[places[k] // n_cols, places[k] % n_cols]
        n += 1
    if task == _READS:
        _read(first, n, log, coder)
    for k in range(n_places):
        cells[places[k] // n_cols, places[k] % n_cols] |= bits[first + k] << np.uint8(1)
    return n


# Sections


def _unpacked(section: bytes) -> _Coder:
    """Return what the bits of a section are read with."""
    sets, n_states = section[0], _N_STATES if section[0] & _HAS_STATES else 1
    has_own = sets & _OWN_FREQS == _OWN_FREQS
    if has_own and sets % N_SETS:
        raise CorruptStreamError("a mask section has frequencies of its own and names a set")
    n_freqs = N_MODELS if has_own else 0
    n_head = 1 + n_freqs + 4 * n_states
    if len(section) < n_head:
        raise_for_status(Status.TRUNCATED, len(section))
    if (len(section) - n_head) & 1:
        raise CorruptStreamError(f"a mask section has {len(section)} bytes, half a word too many")
    freqs = _own_freqs(section[1 : 1 + n_freqs]) if has_own else _freqs_of(sets)
    coded = np.frombuffer(section, "<u2", offset=n_head)
    words = np.zeros(coded.size + _AHEAD, dtype=np.uint16)
    words[: coded.size] = coded
    states = np.frombuffer(section, "<u4", n_states, 1 + n_freqs).astype(np.uint32)
    return _Coder(freqs, words, states, np.zeros(2, dtype=np.int64))


def _freqs_of(sets: int) -> NDArray[np.uint32]:
    """Return the frequencies of a 1 by model, of the sets that a section's first byte names."""
    samples, groups = frequencies()
    return np.concatenate([samples[sets % N_SETS], groups[sets // N_SETS % 8]])


def _own_freqs(coded: bytes) -> NDArray[np.uint32]:
    """Return the frequencies that a section brings."""
    return np.frombuffer(coded, np.uint8) * np.uint32(_FREQ_STEP) + np.uint32(_FREQ_STEP // 2)


def _packed(models: NDArray[np.uint8], bits: NDArray[np.uint8]) -> bytes:
    """Return the section of coded bits, with the sets that make it shortest."""
    counts = np.bincount(2 * models.astype(np.int64) + bits, minlength=2 * N_MODELS)
    zeros, ones = counts[::2], counts[1::2]
    parts = np.s_[:_FILL], np.s_[_FILL:]
    costs = [
        _costs(freqs, zeros[at], ones[at]) for freqs, at in zip(frequencies(), parts, strict=True)
    ]
    chosen = [int(cost.argmin()) for cost in costs]
    n_bits, sets = int(sum(map(min, costs))), chosen[0] + N_SETS * chosen[1]
    freqs, coded = _freqs_of(sets), b""
    shares = N_SLOTS // _FREQ_STEP * ones // np.maximum(ones + zeros, 1)
    own = np.minimum(shares, 255).astype(np.uint8).tobytes()
    n_own = int(_costs(_own_freqs(own)[None], zeros, ones)[0]) + 8 * N_MODELS * _UNIT
    if n_own < n_bits:
        n_bits, sets, freqs, coded = n_own, _OWN_FREQS, _own_freqs(own), own
    n_states = 1
    if n_bits > _LONG * _UNIT:
        sets, n_states = sets | _HAS_STATES, _N_STATES
    words = np.empty(models.size, dtype=np.uint16)
    states = np.full(n_states, _STATE_START, dtype=np.uint32)
    at = write_bits(models, bits, freqs, words, states)
    head = bytes([sets]) + coded + states.astype("<u4").tobytes()
    return head + words[at:].astype("<u2").tobytes()


def _costs(
    freqs: NDArray[np.uint32], zeros: NDArray[np.int64], ones: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the cost of counted bits of each model with each set, in 1/_UNIT bits."""
    of_one, of_zero = (
        np.rint(_UNIT * (SLOT_BITS - np.log2(part))).astype(np.int64)
        for part in (freqs, N_SLOTS - freqs)
    )
    return of_one @ ones + of_zero @ zeros


@also_in_c(_IN_C)
@kernel
def write_bits(models, bits, freqs, words, states):
    """Code bits, the last one first; return where in `words` the first word is."""
    at, mask = words.shape[0], states.shape[0] - 1
    for i in range(models.shape[0] - 1, -1, -1):
        freq = np.int64(freqs[models[i]])
        own, before = (freq, np.int64(0)) if bits[i] else (N_SLOTS - freq, freq)
        state = np.int64(states[i & mask])
        if state >= own << (32 - SLOT_BITS):
            at -= 1
            words[at] = np.uint16(state & 0xFFFF)
            state >>= 16
        states[i & mask] = np.uint32((state // own << SLOT_BITS) + state % own + before)
    return at
