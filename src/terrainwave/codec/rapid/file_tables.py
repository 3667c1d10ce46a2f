"""Tables of a file of method `rapid`, and their bytes (format-rapid.md, R.10)."""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.planes import HH, HL, LH, MAX_WEIGHT, FileStencil
from terrainwave.codec.rapid import trained, trained_reach
from terrainwave.codec.rapid.layout import (
    CORES,
    F_DIAGONAL,
    F_FAR,
    F_NEAR,
    F_NORTH,
    F_NORTH_2,
    F_RANGE,
    F_TWIST,
    FEATURE_TAPS,
    MAX_TAPS,
    N_FEATURES,
    TAPS,
)
from terrainwave.codec.rapid.magnitude import N_CONTEXTS
from terrainwave.codec.rapid.symbols import ESCAPE, N_SYMBOLS
from terrainwave.coding.jit import kernel, rare_kernel
from terrainwave.coding.rangecoder import (
    MAGNITUDE_MODELS,
    N_UNARY,
    code_bit,
    code_magnitude,
    code_raw,
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
    new_models,
)
from terrainwave.coding.rans import N_SLOTS, packed_freqs, slots_of
from terrainwave.coding.status import raise_for_status
from terrainwave.errors import CorruptStreamError, UnsupportedVersionError

N_CLASSES = 4  # levels: the finest, the next two, all coarser ones
PLANES = (HH, HL, LH)
SHIFTS = (0, 2, 3, 4, 5)
# Families of contexts by the mean, then those of contexts by reach (R.7).
N_FAMILIES = 2 * trained.N_FAMILIES
_LAYOUTS = _BY_MEAN, _BY_REACH, _WITH_WEIGHTS = 1, 3, 5
_K_MAX_BITS, _FAMILY_BITS, _BASE_BITS, _SHIFT_BITS = 5, 3, 4, 3
_N_WEIGHTED_BITS = 2
# Of a stencil's numbers: the set, whether there are deltas, their shift; then the deltas.
_BASE, _HAS_DELTAS, _SHIFT, _DELTAS = range(4)
_HEAD_K_MAX, _HEAD_FAMILY, _HEAD_REACH, _HEAD_WEIGHTED = range(4)
_NO_TAP = -1
# What can be wrong with the numbers of a section.
_FINE, _BAD_FAMILY, _BAD_WEIGHT, _BAD_CODE, _BAD_FEATURE = range(5)
# Models: magnitudes of core taps and of other taps; six groups for frequencies; one for weights of
# features; a flag.
_CORE, _OTHER, _FREQ = 0, MAGNITUDE_MODELS, 2 * MAGNITUDE_MODELS
_FEATURE, _OWN = 8 * MAGNITUDE_MODELS, 9 * MAGNITUDE_MODELS
_N_MODELS = _OWN + 2
_EXACT = 32  # frequencies below have a code each; above, 16 codes an octave
MAX_CODE = 127
# Weights of features that a file brings along: codes of frequencies, shifted by so many bits. Those
# of the finest class are told as changes of usual ones, those of others of the finer class.
WEIGHT_SHIFTS = np.array([14, 7, 7, 7, 13, 13, 9, 7, 7], dtype=np.int64)
USUAL_WEIGHTS = np.array(
    [
        [12, 58, 50, 25, 33, 35, 57, 0, 0],
        [4, 39, 37, 10, 25, 24, 37, 49, 32],
        [4, 35, 19, 18, 22, 22, 35, 48, 23],
    ],
    dtype=np.int64,
)
# Of the sum of weights times features, in units of what ranges add: less keeps it below 2**31.
_MOST_EXPECTED = (1 << 24) - (1 << 15)
_TIMES_ERROR = 8
_OF_ERRORS = (F_NORTH, F_DIAGONAL, F_NORTH_2, F_NEAR, F_FAR)


class FileTables(NamedTuple):
    """What a file brings along.

    `stencils` by class and plane; `codes` of the frequencies of contexts that have their own, by
    context; `family` says which trained frequencies they change, and the table of features;
    `weights` are codes of the weights of features of the finest classes, shape (n, 3, N_FEATURES),
    None where all are of the table.
    """

    k_max: int
    family: int
    stencils: tuple[tuple[FileStencil, ...], ...]
    codes: dict[int, NDArray[np.int64]]
    weights: NDArray[np.int64] | None = None


class Tables:
    """What a file is coded with.

    Attributes
    ----------
    k_max : int
        The level of the full grid.
    stencils : ndarray of int64, shape (N_CLASSES, 3, MAX_TAPS)
    features : ndarray of int64, shape (N_CLASSES, 4, N_FEATURES)
        Weights in 2**-24 per step: of the planes, then of lines.
    is_by_reach : bool
        Whether contexts are by reach.
    arranged : dict
        Where the refiner keeps both as kernels want them: by depth, stride and step.
    """

    def __init__(self, file: FileTables | None) -> None:
        self._file = file
        self.k_max = 0 if file is None else file.k_max
        layout, family = divmod(0 if file is None else file.family, trained.N_FAMILIES)
        self.features = trained.FEATURES[family // trained.N_STEPS]
        if file is not None and file.weights is not None:
            self.features = self.features.copy()
            self.features[: len(file.weights), : len(PLANES)] = weights_of_codes(file.weights)
        self.is_by_reach = layout > 0
        self.stencils = np.zeros((N_CLASSES, len(PLANES), MAX_TAPS), dtype=np.int64)
        for which in range(N_CLASSES):
            for index, plane in enumerate(PLANES):
                stencil = FileStencil(0) if file is None else file.stencils[which][index]
                weights = weights_of(plane, stencil)
                self.stencils[which, index, : len(weights)] = weights
        self.arranged: dict[tuple[int, int, int], NDArray[np.int64]] = {}
        self._slots: dict[int, NDArray[np.uint32]] = {}
        self._packed: dict[int, NDArray[np.uint32]] = {}

    def slots(self, step: int) -> NDArray[np.uint32]:
        """Return the decoder's table of symbols and frequencies."""
        family = self._family(step)
        if family not in self._slots:
            slots = default_slots(family)
            if self._own.size:
                slots = slots.copy()
                slots.reshape(-1, N_SLOTS)[self._own] = slots_of(self._own_freqs(family)).reshape(
                    -1, N_SLOTS
                )
            self._slots[family] = slots
        return self._slots[family]

    def packed_freqs(self, step: int) -> NDArray[np.uint32]:
        """Return of each context and symbol the sum of frequencies before and its own."""
        family = self._family(step)
        if family not in self._packed:
            self._packed[family] = packed_freqs(self._freqs(family))
        return self._packed[family]

    def _family(self, step: int) -> int:
        return trained.family_of(step) if self._file is None else self._file.family

    def _freqs(self, family: int) -> NDArray[np.int64]:
        freqs = default_freqs(family)
        if self._own.size:
            freqs = freqs.copy()
            freqs[self._own] = self._own_freqs(family)
        return freqs

    @property
    def _own(self) -> NDArray[np.int64]:
        """Return the contexts that have frequencies of the file's own."""
        return np.array([] if self._file is None else list(self._file.codes), dtype=np.int64)

    def _own_freqs(self, family: int) -> NDArray[np.int64]:
        assert self._file is not None
        codes = np.stack(list(self._file.codes.values()))
        return freqs_of(codes, rest_symbols(family)[self._own])


@cache
def missing_tap(plane: int) -> int:
    """Return the tap whose weight follows from the others: the first of the core."""
    return TAPS[plane].index(CORES[plane][0])


@cache
def core_taps(plane: int) -> list[bool]:
    """Return of each tap whether it is one of the core."""
    return [tap in CORES[plane] for tap in TAPS[plane]]


def weights_of(plane: int, stencil: FileStencil) -> NDArray[np.int64]:
    """Return the weights of a file's stencil, checked."""
    return stencil.weights(trained.STENCILS[plane], missing_tap(plane), plane)


def weights_of_codes(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the weights of features, in 2**-24 per step, that codes stand for."""
    weights: NDArray[np.int64] = FREQ_OF_CODE[codes] << WEIGHT_SHIFTS
    return weights


def are_sound(codes: NDArray[np.int64]) -> bool:
    """Say whether no expected magnitude by weights of these codes can pass 31 bits.

    `codes` have the shape (n, 3, N_FEATURES).
    """
    return bool(((weights_of_codes(codes) * _most_features()).sum(-1) < _MOST_EXPECTED).all())


@cache
def _most_features() -> NDArray[np.int64]:
    """Return how large features can be, by plane, in units of a range's largest."""
    most = np.zeros((len(PLANES), N_FEATURES), dtype=np.int64)
    most[:, (F_RANGE, F_TWIST)] = 1
    for index, plane in enumerate(PLANES):
        for feature, taps in FEATURE_TAPS[plane].items():
            most[index, feature] = len(taps) * (_TIMES_ERROR if feature in _OF_ERRORS else 1)
    return most


# Frequencies ------------------------------------------------------------------------------------


def code_of(freq: int) -> int:
    """Return the code of the frequencies around `freq`."""
    if freq < _EXACT:
        return freq
    shift = freq.bit_length() - 5
    return _EXACT + 16 * (shift - 1) + (freq >> shift) - 16


def freq_of(code: int) -> int:
    """Return the frequency that a code stands for: `code_of` undone but for its rounding."""
    if code < _EXACT:
        return code
    shift = ((code - _EXACT) >> 4) + 1
    return ((16 + (code & 15)) << shift) + (1 << shift >> 1)


FREQ_OF_CODE = np.array([freq_of(code) for code in range(MAX_CODE + 1)], dtype=np.int64)
CODE_OF_FREQ = np.array([code_of(freq) for freq in range(N_SLOTS)], dtype=np.int64)


def freqs_of(codes: NDArray[np.int64], rests: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the frequencies of contexts; that of each one's rest symbol is what the others leave.

    Parameters
    ----------
    codes : ndarray of int64, shape (n, N_SYMBOLS)
    rests : ndarray of int64, shape (n,)

    Raises
    ------
    CorruptStreamError
        If they leave nothing, or the escape is impossible.
    """
    freqs = FREQ_OF_CODE[codes]
    every = np.arange(len(codes))
    freqs[every, rests] = 0
    freqs[every, rests] = N_SLOTS - freqs.sum(1)
    if (freqs[every, rests] < 1).any() or (freqs[:, ESCAPE] < 1).any():
        raise CorruptStreamError("the frequencies of a context do not fit")
    return freqs


@cache
def _all_codes() -> NDArray[np.int64]:
    """Return the trained codes of all families and contexts."""
    both = trained.default_codes(), trained_reach.default_codes()
    return np.concatenate(both).astype(np.int64)


@cache
def _all_rests() -> NDArray[np.int64]:
    return _all_codes().argmax(2).astype(np.int64)


def default_codes(family: int) -> NDArray[np.int64]:
    """Return the trained codes of all contexts."""
    codes: NDArray[np.int64] = _all_codes()[family]
    return codes


def rest_symbols(family: int) -> NDArray[np.int64]:
    """Return each context's symbol whose frequency is not stored: the likeliest trained one."""
    rests: NDArray[np.int64] = _all_rests()[family]
    return rests


@cache
def default_freqs(family: int) -> NDArray[np.int64]:
    """Return the trained frequencies, shape (N_CONTEXTS, N_SYMBOLS)."""
    return freqs_of(default_codes(family), rest_symbols(family))


@cache
def default_slots(family: int) -> NDArray[np.uint32]:
    """Return what `slots_of` makes of the trained frequencies."""
    return slots_of(default_freqs(family))


# Bytes ------------------------------------------------------------------------------------------


def pack_file_tables(tables: FileTables) -> bytes:
    """Return the parameters section."""
    out = np.zeros(1 << 16, dtype=np.uint8)
    coder = new_encoder(out, new_models(_N_MODELS))
    numbers = _Numbers.empty()
    is_by_reach, family = divmod(tables.family, trained.N_FAMILIES)
    layout = _BY_REACH if is_by_reach else _BY_MEAN
    if tables.weights is not None:
        layout = _WITH_WEIGHTS
        numbers.weights[: len(tables.weights)] = tables.weights
    numbers.head[:] = tables.k_max, family, is_by_reach, _n_weighted(tables)
    for index, stencil in enumerate(stencil for row in tables.stencils for stencil in row):
        own = numbers.stencils[index]
        own[:_DELTAS] = stencil.base, bool(stencil.deltas), stencil.shift
        own[_DELTAS : _DELTAS + len(stencil.deltas)] = stencil.deltas
    for context, codes in tables.codes.items():
        numbers.is_own[context], numbers.codes[context] = 1, codes
    _code_tables(coder, layout, *numbers, *_annexes())
    n_bytes = finish_encoder(coder.state, out)
    return bytes([layout]) + out[:n_bytes].tobytes()


def parse_file_tables(section: bytes) -> Tables:
    """Undo `pack_file_tables`, trusting nothing; no bytes stand for trained tables alone.

    Raises
    ------
    UnsupportedVersionError
        If the layout is not known.
    CorruptStreamError
        If a value is out of range or the section does not end where it should.
    """
    if not section:
        return Tables(None)
    if section[0] not in _LAYOUTS:
        raise UnsupportedVersionError(
            f"the tables of the file have layout {section[0]}, which this terrainwave does not"
            " know: install a newer one"
        )
    coder = new_decoder(section[1:], new_models(_N_MODELS))
    numbers = _Numbers.empty()
    numbers.head[_HEAD_REACH] = section[0] == _BY_REACH
    status, which = _code_tables(coder, section[0], *numbers, *_annexes())
    if status == _BAD_FAMILY:
        raise CorruptStreamError(f"family {which} of frequencies does not exist")
    if status == _BAD_WEIGHT:
        raise CorruptStreamError(f"a stencil of plane {which} has a weight beyond 2^15")
    if status == _BAD_CODE:
        raise CorruptStreamError(f"context {which} has a frequency code that does not exist")
    k_max, family, is_by_reach, n_weighted = numbers.head.tolist()
    family += is_by_reach * trained.N_FAMILIES
    weights = numbers.weights[:n_weighted] if n_weighted else None
    if status == _BAD_FEATURE or (weights is not None and not are_sound(weights)):
        raise CorruptStreamError("a weight of what details are expected to be is out of range")
    own = np.flatnonzero(numbers.is_own)
    freqs_of(numbers.codes[own], rest_symbols(family)[own])  # checks them
    raise_for_status(*finish_decoder(coder.state, coder.stream))
    stencils = [
        FileStencil(base, shift, tuple(deltas[: len(TAPS[PLANES[index % len(PLANES)]])]))
        if has_deltas
        else FileStencil(base)
        for index, (base, has_deltas, shift, *deltas) in enumerate(numbers.stencils.tolist())
    ]
    by_class = tuple(
        tuple(stencils[first : first + len(PLANES)])
        for first in range(0, len(stencils), len(PLANES))
    )
    codes = {int(context): numbers.codes[context] for context in own}
    return Tables(FileTables(k_max, family, by_class, codes, weights))


class _Numbers(NamedTuple):
    """The numbers of a parameters section.

    Attributes
    ----------
    head : ndarray of int64, shape (4,)
        `k_max`; family, counted from the first of its contexts; whether these are by reach; of how
        many classes there are weights.
    stencils : ndarray of int64, shape (N_CLASSES * 3, _DELTAS + MAX_TAPS)
        By class and plane: the set, whether there are deltas, their shift, the deltas.
    weights : ndarray of int64, shape (N_CLASSES, 3, N_FEATURES)
        Codes of the weights of features.
    is_own : ndarray of int64, shape (N_CONTEXTS,)
        Whether a context has codes of its own.
    codes : ndarray of int64, shape (N_CONTEXTS, N_SYMBOLS)
    """

    head: NDArray[np.int64]
    stencils: NDArray[np.int64]
    weights: NDArray[np.int64]
    is_own: NDArray[np.int64]
    codes: NDArray[np.int64]

    @classmethod
    def empty(cls) -> "_Numbers":
        """Return numbers to be filled."""
        return cls(
            np.zeros(4, dtype=np.int64),
            np.zeros((N_CLASSES * len(PLANES), _DELTAS + MAX_TAPS), dtype=np.int64),
            np.zeros((N_CLASSES, len(PLANES), N_FEATURES), dtype=np.int64),
            np.zeros(N_CONTEXTS, dtype=np.int64),
            np.zeros((N_CONTEXTS, N_SYMBOLS), dtype=np.int64),
        )


@cache
def _tap_kinds() -> NDArray[np.int64]:
    """Return by plane which model a tap's delta takes; _NO_TAP if it has none."""
    kinds = np.full((len(PLANES), MAX_TAPS), _NO_TAP, dtype=np.int64)
    for index, plane in enumerate(PLANES):
        are_core = core_taps(plane)
        kinds[index, : len(are_core)] = [_CORE if is_core else _OTHER for is_core in are_core]
        kinds[index, missing_tap(plane)] = _NO_TAP
    return kinds


def _annexes() -> tuple[NDArray[np.int64], ...]:
    """Return what `_code_tables` knows beforehand."""
    return _tap_kinds(), USUAL_WEIGHTS, _most_features(), _all_codes(), _all_rests()


def _n_weighted(tables: FileTables) -> int:
    return 0 if tables.weights is None else len(tables.weights)


@rare_kernel
def _code_tables(
    coder, layout, head, stencils, weights, is_own, codes, tap_kinds, usual, most, trained, rests
):  # fmt: skip
    """Code the numbers of a section in place; return what is wrong with them, and where.

    A decoder's need hold nothing but whether contexts are by reach. `trained` and `rests` are those
    of all families, `usual` the codes of weights, and features whose `most` is 0 have none.
    """
    head[_HEAD_K_MAX] = code_raw(coder, np.int64(_K_MAX_BITS), head[_HEAD_K_MAX])
    family = head[_HEAD_FAMILY] = code_raw(coder, np.int64(_FAMILY_BITS), head[_HEAD_FAMILY])
    n_families = trained.shape[0] >> 1
    if family >= n_families:
        return _BAD_FAMILY, family
    if layout == _WITH_WEIGHTS:
        head[_HEAD_REACH] = code_raw(coder, np.int64(1), head[_HEAD_REACH])
        n = code_raw(coder, np.int64(_N_WEIGHTED_BITS), head[_HEAD_WEIGHTED] - 1)
        head[_HEAD_WEIGHTED] = n + 1
    if head[_HEAD_REACH]:
        family += n_families
    for index in range(stencils.shape[0]):
        plane, own = index % tap_kinds.shape[0], stencils[index]
        own[_BASE] = code_raw(coder, np.int64(_BASE_BITS), own[_BASE])
        own[_HAS_DELTAS] = code_raw(coder, np.int64(1), own[_HAS_DELTAS])
        if not own[_HAS_DELTAS]:
            continue
        own[_SHIFT] = code_raw(coder, np.int64(_SHIFT_BITS), own[_SHIFT])
        for tap in range(MAX_TAPS):
            first = tap_kinds[plane, tap]
            if first == _NO_TAP:
                continue
            delta = own[_DELTAS + tap]
            size = code_magnitude(coder, first, first + N_UNARY, np.int64(0), abs(delta))
            if size > 2 * MAX_WEIGHT:
                return _BAD_WEIGHT, np.int64(plane + HH)
            is_less = np.int64(0)
            if size > 0:
                is_less = code_raw(coder, np.int64(1), np.int64(delta < 0))
            own[_DELTAS + tap] = -size if is_less else size
    for which in range(head[_HEAD_WEIGHTED]):
        if _code_weights(coder, usual if which == 0 else weights[which - 1], most, weights[which]):
            return _BAD_FEATURE, np.int64(which)
    was_own = np.int64(0)
    for context in range(is_own.shape[0]):
        was_own = code_bit(coder, _OWN + was_own, is_own[context])
        is_own[context] = was_own
        if was_own and _code_codes(
            coder, trained[family, context], rests[family, context], codes[context]
        ):
            return _BAD_CODE, np.int64(context)
    return _FINE, np.int64(0)


@kernel
def _code_weights(coder, usual, most, weights):
    """Code the weights' codes of a class in place; return whether one is out of range."""
    for index in range(weights.shape[0]):
        for feature in range(weights.shape[1]):
            if feature > 0 and most[index, feature] == 0:
                continue
            change = weights[index, feature] - usual[index, feature]
            size = code_magnitude(coder, _FEATURE, _FEATURE + N_UNARY, np.int64(0), abs(change))
            is_less = np.int64(0)
            if size > 0:
                is_less = code_raw(coder, np.int64(1), np.int64(change < 0))
            code = usual[index, feature] + (-size if is_less else size)
            if size > MAX_CODE or code < 0 or code > MAX_CODE:
                return True
            weights[index, feature] = code
    return False


@kernel
def _code_codes(coder, trained, rest, codes):
    """Code the codes of a context in place; return whether a value is out of range.

    A decoder's `codes` need hold nothing. (Literal numbers would be types of their own to compile
    for.)
    """
    last = np.int64(0)
    for symbol in range(N_SYMBOLS):
        usual = trained[symbol]
        if symbol == rest:
            codes[symbol] = usual
            continue
        change = codes[symbol] - usual
        # By whether the symbol is usual, and by the last change.
        group = 3 * np.int64(usual > 0) + min(last, (last >> 1) + 1, 2)
        first = _FREQ + group * MAGNITUDE_MODELS
        last = code_magnitude(coder, first, first + N_UNARY, np.int64(0), abs(change))
        is_less = np.int64(0)
        if last > 0 and usual > 0:
            is_less = code_raw(coder, np.int64(1), np.int64(change < 0))
        codes[symbol] = usual - last if is_less else usual + last
        if last > MAX_CODE or codes[symbol] < 0 or codes[symbol] > MAX_CODE:
            return True
    return False
