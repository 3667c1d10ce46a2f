"""Masks of units: valid samples, and those valid by themselves (FORMAT.md §5.2).

A sample of a coarse level is valid where any full-grid sample near it is. It is valid by itself,
*own*, where the full-grid sample at its place is; the other valid ones are *fills*. On the finest
level all valid samples are own.

Own samples are coded from level to level, each once: those on even rows and columns are the
parent's. The others lie between them in planes HH, HL, LH, and each has four neighbours that are
known before: its context. So all contexts of a plane are made at once. Where the four agree, 32
samples share one bit that says whether any is unlike them.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.annexes import read_tables
from terrainwave.codec.refiner import ALL_VALID, Mask, Validity, as_array
from terrainwave.coding.jit import kernel
from terrainwave.coding.native_library import also_in_c
from terrainwave.coding.status import Status, raise_for_status
from terrainwave.errors import CorruptStreamError
from terrainwave.grid.quadtree import Region

_IN_C = "terrainwave.codec.in_c"
# Contexts: four neighbours that are void, or own; that of samples implied to be void.
_NONE, _ALL, _IMPLIED = 0, 15, 16
# Samples of a row that share a bit.
GROUP = 32
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
# Of costs.
_UNIT = 1 << 10


class Above(NamedTuple):
    """Validity of the level above, around a unit."""

    region: Region
    validity: Validity


Bits = NDArray[np.uint8]


class _Notes(NamedTuple):
    """The bits of a mask with their models, in order."""

    models: list[Bits]
    bits: list[Bits]

    def code(self, models: NDArray[np.integer], bits: Mask) -> Mask:
        """Note bits and return them."""
        self.models.append(models.astype(np.uint8))
        self.bits.append(bits.astype(np.uint8))
        return bits


class _Reader(NamedTuple):
    """A reader of bits; `places`: the next word, and the next bit's number."""

    freqs: NDArray[np.uint32]
    words: NDArray[np.uint16]
    states: NDArray[np.uint32]
    places: NDArray[np.int64]

    def code(self, models: NDArray[np.integer], bits: Mask) -> Mask:
        """Return the bits of some models, whose number is that of `bits`."""
        read = np.empty(bits.shape, dtype=np.bool_)
        _read(models.astype(np.uint8), self.freqs, self.words, self.states, self.places, read)
        return read


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
    _, models, bits = code_known(own, mask, region, above, is_finest)
    return _packed(models, bits)


def decode_validity(
    section: bytes, region: Region, above: Above | None, *, is_finest: bool
) -> Validity:
    """Undo `encode_validity`; whatever the bytes, all own samples are valid."""
    if not section and (above is None or above.validity.own_mask is None):
        return ALL_VALID
    if not section:
        nothing = np.zeros(region.shape, dtype=np.bool_)
        cells, _, _ = code_known(None, nothing, region, above, is_finest)
    else:
        cells = read_section(section, region, above, is_finest)
    own = (cells & 1).view(np.bool_)
    if is_finest:
        return Validity.of(own)
    return Validity.of((cells >> 1 & 1).view(np.bool_), own)


@also_in_c(_IN_C)
def read_section(
    section: bytes, region: Region, above: Above | None, is_finest: bool
) -> NDArray[np.uint8]:
    """Read the samples of a unit, own + 2 · valid, from its section."""
    reader = _unpacked(section)
    unknown = np.zeros(region.shape, dtype=np.bool_)
    cells = _code(reader, unknown, unknown, region, above, is_finest)
    n_read, n_words = int(reader.places[0]), reader.words.size
    if n_read > n_words:
        raise_for_status(Status.TRUNCATED, len(section))
    if n_read < n_words or (reader.states != _STATE_START).any():
        raise_for_status(Status.TRAILING, len(section) - 2 * (n_words - n_read))
    return cells


@also_in_c(_IN_C)
def code_known(
    own: Mask | None, mask: Mask, region: Region, above: Above | None, is_finest: bool
) -> tuple[NDArray[np.uint8], Bits, Bits]:
    """Return the samples of a unit, own + 2 · valid, and the models and bits that code them.

    If `own` is None, the samples are those that follow from `above` alone, without bits.
    """
    none = np.zeros(0, dtype=np.uint8)
    notes = _Notes([none], [none])
    if own is None:
        cells = _code(None, mask, mask, region, above, is_finest)
    else:
        cells = _code(notes, own, mask, region, above, is_finest)
    return cells, np.concatenate(notes.models), np.concatenate(notes.bits)


def _code(
    coder: _Notes | _Reader | None, own: Mask, mask: Mask, region: Region, above: Above | None,
    is_finest: bool,
) -> NDArray[np.uint8]:  # fmt: skip
    """Code a unit's validity and return it; without a coder, what follows from `above`.

    A root block is coded in lattices of more and more samples, as if each were a unit below the one
    before.
    """
    steps = [(region, own)]
    if above is None:
        corner = np.ones(1, dtype=np.bool_)
        if coder is not None:
            corner = coder.code(np.full(1, _CORNER), own[0, :1])
        above = Above(Region(0, 0, 1, 1), Validity(None, corner[None]))
        while max(steps[0][0].shape) > 2:
            (_, _, n_rows, n_cols), finer = steps[0]
            steps.insert(0, (Region(0, 0, n_rows + 1 >> 1, n_cols + 1 >> 1), finer[::2, ::2]))
    for at, truth in steps:
        own, implied = _code_lattice(coder, truth, at, above)
        above = Above(at, Validity(None, own))
    valid = own
    if not is_finest:
        near = np.pad(own, 1)
        beside = near[:-2] | near[1:-1] | near[2:]
        valid = (beside[:, :-2] | beside[:, 1:-1] | beside[:, 2:]) & ~implied
        unknown = ~(valid | implied)
        filled = mask[unknown]
        valid[unknown] = coder is None or coder.code(np.full(filled.size, _FILL), filled)
    return own + 2 * valid.view(np.uint8)


def _code_lattice(
    coder: _Notes | _Reader | None, truth: Mask, region: Region, above: Above
) -> tuple[Mask, Mask]:
    """Code own samples between those above; return these, and which are implied to be void."""
    p, q = region.row & 1, region.col & 1
    outer = above.region
    # The parent's samples, with one more on each side; outside of the parent its border.
    rows = np.arange(region.row + 1 >> 1, (region.row + region.n_rows + 1 >> 1) + 2) - outer.row - 1
    cols = np.arange(region.col + 1 >> 1, (region.col + region.n_cols + 1 >> 1) + 2) - outer.col - 1
    parent, valid = (
        as_array(part, outer.shape).take(rows, 0, mode="clip").take(cols, 1, mode="clip")
        for part in (above.validity.own_mask, above.validity.mask)
    )
    own, implied = np.zeros((2, *region.shape), dtype=np.bool_)
    own[p::2, q::2], implied[p::2, q::2] = parent[1:-1, 1:-1], ~valid[1:-1, 1:-1]
    corners = own[1 - p :: 2, 1 - q :: 2]
    for plane, row, col in ((0, 1 - p, 1 - q), (1, p, 1 - q), (2, 1 - p, q)):
        at = slice(row, None, 2), slice(col, None, 2)
        n_rows, n_cols = shape = truth[at].shape
        if n_rows == 0 or n_cols == 0:
            continue
        downs = (1,) if plane == 1 else (1 - p, 2 - p)
        rights = (1,) if plane == 2 else (1 - q, 2 - q)
        places = [np.s_[i : i + n_rows, j : j + n_cols] for i in downs for j in rights]
        near = [parent[place] for place in places]
        implied[at] = ~np.logical_and.reduce([valid[place] for place in places])
        if plane and corners.shape[plane - 1]:
            axis = plane - 1
            first = np.arange(shape[axis]) + (p, q)[axis] - 1
            near += [corners.take(first + k, axis, mode="clip") for k in (0, 1)]
        elif plane:
            near += near
        own[at] = _code_plane(coder, plane, near, implied[at], truth[at])
    return own, implied


def _code_plane(
    coder: _Notes | _Reader | None, plane: int, near: list[Mask], implied: Mask, truth: Mask
) -> Mask:
    """Code the own samples of a plane, given which of their four neighbours are own."""
    if coder is None:
        return ~implied
    n_rows, n_cols = implied.shape
    shape = n_rows, -(-n_cols // GROUP), GROUP
    contexts = np.full((n_rows, shape[1] * GROUP), _IMPLIED, dtype=np.uint8)
    contexts[:, :n_cols] = sum(part.view(np.uint8) << k for k, part in enumerate(near))
    contexts[:, :n_cols][implied] = _IMPLIED
    truths = np.zeros(contexts.shape, dtype=np.bool_)
    truths[:, :n_cols] = truth
    contexts, truths = contexts.reshape(shape), truths.reshape(shape)
    own = contexts == _ALL
    is_plain = own | (contexts == _NONE)
    n_plain = np.count_nonzero(is_plain, axis=2)
    is_mixed = n_plain + np.count_nonzero(contexts == _IMPLIED, axis=2) < GROUP
    kinds = np.where(n_plain < GROUP // 2, _FEW, _MANY)
    kinds[~is_mixed] = _UNIFORM
    kinds[own.all(axis=2)] = _ALL_OWN
    is_open = n_plain > 0
    unlike = (is_plain & (truths != own)).any(axis=2)
    is_open[is_open] = coder.code(_GROUPS + 4 * plane + kinds[is_open], unlike[is_open])
    is_coded = (contexts != _IMPLIED) & (is_open[..., None] | ~is_plain)
    own[is_coded] = coder.code(16 * plane + contexts[is_coded], truths[is_coded])
    return own.reshape(n_rows, -1)[:, :n_cols]


@kernel
def _read(models, freqs, words, states, places, bits):
    """Read bits; bit i of a section by state i mod their number. Missing words are 0."""
    at, n_before = places
    for i in range(models.shape[0]):
        k = (n_before + i) & (states.shape[0] - 1)
        state, freq = np.int64(states[k]), np.int64(freqs[models[i]])
        slot, whole = state & (N_SLOTS - 1), state >> SLOT_BITS
        bits[i] = slot < freq
        state = freq * whole + slot if slot < freq else (N_SLOTS - freq) * whole + slot - freq
        if state < _STATE_START:
            state = state << 16 | (np.int64(words[at]) if at < words.shape[0] else np.int64(0))
            at += 1
        states[k] = state
    places[0], places[1] = at, n_before + models.shape[0]


# Sections


def _unpacked(section: bytes) -> _Reader:
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
    words = np.frombuffer(section, "<u2", offset=n_head).astype(np.uint16)
    states = np.frombuffer(section, "<u4", n_states, 1 + n_freqs).astype(np.uint32)
    return _Reader(freqs, words, states, np.zeros(2, dtype=np.int64))


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
