"""Tables of a file of method `rapid`, and their bytes (format-rapid.md, R.10)."""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec import rapid_tables
from terrainwave.codec.lattice import HH, HL, LH
from terrainwave.codec.rapid_code import ESCAPE, N_SYMBOLS
from terrainwave.codec.rapid_layout import CORES, MAX_TAPS, TAPS
from terrainwave.codec.rapid_magnitude import N_CONTEXTS
from terrainwave.coding.jit import kernel
from terrainwave.coding.rangecoder import (
    MAGNITUDE_MODELS,
    N_UNARY,
    Coder,
    code_bit,
    code_magnitude,
    code_raw,
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
    new_models,
)
from terrainwave.coding.rans import N_SLOTS, slots_of
from terrainwave.coding.status import raise_for_status
from terrainwave.errors import CorruptStreamError, UnsupportedVersionError

N_CLASSES = 4  # levels: the finest, the next two, all coarser ones
PLANES = (HH, HL, LH)
WHOLE = 4096
MAX_WEIGHT = (1 << 15) - 1
SHIFTS = (0, 2, 3, 4, 5)
_LAYOUT = 1
_K_MAX_BITS, _FAMILY_BITS, _BASE_BITS, _SHIFT_BITS = 5, 3, 4, 3
# Models: magnitudes of core taps and of other taps; six groups for frequencies; a flag.
_CORE, _OTHER, _FREQ = 0, MAGNITUDE_MODELS, 2 * MAGNITUDE_MODELS
_OWN = 8 * MAGNITUDE_MODELS
_N_MODELS = _OWN + 2
_EXACT = 32  # frequencies below have a code each; above, 16 codes an octave
MAX_CODE = 127


class FileStencil(NamedTuple):
    """A stencil as a file stores it: trained set `base`, plus ``deltas * 2**shift`` if there are.

    The weight of `missing_tap` follows from the others, whose sum with it is 4096.
    """

    base: int
    shift: int = 0
    deltas: tuple[int, ...] = ()


class FileTables(NamedTuple):
    """What a file brings along.

    `stencils` by class and plane; `codes` of the frequencies of contexts that have their own, by
    context; `family` says which trained frequencies they change, and the table of features.
    """

    k_max: int
    family: int
    stencils: tuple[tuple[FileStencil, ...], ...]
    codes: dict[int, NDArray[np.int64]]


class Tables:
    """What a file is coded with.

    Attributes
    ----------
    k_max : int
        The level of the full grid.
    stencils : ndarray of int64, shape (N_CLASSES, 3, MAX_TAPS)
    features : ndarray of int64, shape (N_CLASSES, 4, N_FEATURES)
        Weights in 2**-24 per step: of the planes, then of lines.
    """

    def __init__(self, file: FileTables | None) -> None:
        self._file = file
        self.k_max = 0 if file is None else file.k_max
        self.features = rapid_tables.FEATURES[
            0 if file is None else file.family // rapid_tables.N_STEPS
        ]
        self.stencils = np.zeros((N_CLASSES, len(PLANES), MAX_TAPS), dtype=np.int64)
        for which in range(N_CLASSES):
            for index, plane in enumerate(PLANES):
                stencil = FileStencil(0) if file is None else file.stencils[which][index]
                weights = weights_of(plane, stencil)
                self.stencils[which, index, : len(weights)] = weights
        self._slots: dict[int, NDArray[np.uint32]] = {}
        self._packed: dict[int, NDArray[np.uint32]] = {}

    def slots(self, step: int) -> NDArray[np.uint32]:
        """Return the decoder's table of frequencies."""
        family = self._family(step)
        if family not in self._slots:
            self._slots[family] = slots_of(self._freqs(family))
        return self._slots[family]

    def packed_freqs(self, step: int) -> NDArray[np.uint32]:
        """Return the encoder's: of each context and symbol, the sum of those before and its own."""
        family = self._family(step)
        if family not in self._packed:
            freqs = self._freqs(family)
            before = np.cumsum(freqs, 1) - freqs
            self._packed[family] = (before << 16 | freqs).astype(np.uint32)
        return self._packed[family]

    def _family(self, step: int) -> int:
        return rapid_tables.family_of(step) if self._file is None else self._file.family

    def _freqs(self, family: int) -> NDArray[np.int64]:
        freqs = default_freqs(family).copy()
        for context, codes in ({} if self._file is None else self._file.codes).items():
            freqs[context] = freqs_of(codes, rest_symbol(family, context))
        return freqs


@cache
def missing_tap(plane: int) -> int:
    """Return the tap whose weight follows from the others: the first of the core."""
    return TAPS[plane].index(CORES[plane][0])


@cache
def core_taps(plane: int) -> list[bool]:
    """Return of each tap whether it is one of the core."""
    return [tap in CORES[plane] for tap in TAPS[plane]]


def weights_of(plane: int, stencil: FileStencil) -> NDArray[np.int64]:
    """Return the weights of a file's stencil.

    Raises
    ------
    CorruptStreamError
        If the set does not exist or a weight is out of range.
    """
    trained = rapid_tables.STENCILS[plane]
    if stencil.base >= len(trained):
        raise CorruptStreamError(f"a stencil builds on set {stencil.base}, which does not exist")
    weights: NDArray[np.int64] = trained[stencil.base].astype(np.int64)
    if stencil.deltas:
        weights += np.array(stencil.deltas, dtype=np.int64) << stencil.shift
        missing = missing_tap(plane)
        weights[missing] = 0
        weights[missing] = WHOLE - weights.sum()
        if np.abs(weights).max() > MAX_WEIGHT:
            raise CorruptStreamError(f"a stencil of plane {plane} has a weight beyond 2^15")
    return weights


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


def freqs_of(codes: NDArray[np.int64], rest: int) -> NDArray[np.int64]:
    """Return the frequencies of one context; that of symbol `rest` is what the others leave.

    Raises
    ------
    CorruptStreamError
        If they leave nothing, or the escape is impossible.
    """
    freqs = FREQ_OF_CODE[codes]
    freqs[rest] = 0
    freqs[rest] = N_SLOTS - freqs.sum()
    if freqs[rest] < 1 or freqs[ESCAPE] < 1:
        raise CorruptStreamError("the frequencies of a context do not fit")
    return freqs


@cache
def default_codes(family: int) -> NDArray[np.int64]:
    """Return the trained codes of all contexts."""
    return rapid_tables.default_codes()[family].astype(np.int64)


@cache
def rest_symbols(family: int) -> NDArray[np.int64]:
    """Return each context's symbol whose frequency is not stored: the likeliest trained one."""
    return default_codes(family).argmax(1).astype(np.int64)


def rest_symbol(family: int, context: int) -> int:
    """Return the symbol of a context whose frequency is not stored."""
    return int(rest_symbols(family)[context])


@cache
def default_freqs(family: int) -> NDArray[np.int64]:
    """Return the trained frequencies, shape (N_CONTEXTS, N_SYMBOLS)."""
    codes = default_codes(family)
    return np.stack([freqs_of(codes[c], rest_symbol(family, c)) for c in range(N_CONTEXTS)])


# Bytes ------------------------------------------------------------------------------------------


def pack_parameters(tables: FileTables) -> bytes:
    """Return the parameters section."""
    out = np.zeros(1 << 16, dtype=np.uint8)
    coder = new_encoder(out, new_models(_N_MODELS))
    code_raw(coder, _K_MAX_BITS, tables.k_max)
    code_raw(coder, _FAMILY_BITS, tables.family)
    for row in tables.stencils:
        for plane, stencil in zip(PLANES, row, strict=True):
            code_raw(coder, _BASE_BITS, stencil.base)
            code_raw(coder, 1, int(bool(stencil.deltas)))
            if not stencil.deltas:
                continue
            code_raw(coder, _SHIFT_BITS, stencil.shift)
            for tap, delta in enumerate(stencil.deltas):
                if tap == missing_tap(plane):
                    continue
                first = _CORE if core_taps(plane)[tap] else _OTHER
                _code_magnitude(coder, first, abs(delta))
                if delta:
                    code_raw(coder, 1, int(delta < 0))
    was_own = 0
    for context in range(N_CONTEXTS):
        is_own = int(context in tables.codes)
        code_bit(coder, _OWN + was_own, is_own)
        was_own = is_own
        if not is_own:
            continue
        trained = default_codes(tables.family)[context]
        codes = tables.codes[context].copy()
        _code_codes(coder, trained, rest_symbol(tables.family, context), codes)
    n_bytes = finish_encoder(coder.state, out)
    return bytes([_LAYOUT]) + out[:n_bytes].tobytes()


def parse_parameters(section: bytes) -> Tables:
    """Undo `pack_parameters`, trusting nothing; no bytes stand for trained tables alone.

    Raises
    ------
    UnsupportedVersionError
        If the layout is not known.
    CorruptStreamError
        If a value is out of range or the section does not end where it should.
    """
    if not section:
        return Tables(None)
    if section[0] != _LAYOUT:
        raise UnsupportedVersionError(
            f"the tables of the file have layout {section[0]}, which this terrainwave does not"
            " know: install a newer one"
        )
    coder = new_decoder(section[1:], new_models(_N_MODELS))
    k_max = int(code_raw(coder, _K_MAX_BITS, 0))
    family = int(code_raw(coder, _FAMILY_BITS, 0))
    if family >= rapid_tables.N_FAMILIES:
        raise CorruptStreamError(f"family {family} of frequencies does not exist")
    stencils = tuple(
        tuple(_parse_stencil(coder, plane) for plane in PLANES) for _ in range(N_CLASSES)
    )
    codes = {}
    was_own = 0
    for context in range(N_CONTEXTS):
        was_own = int(code_bit(coder, _OWN + was_own, 0))
        if was_own:
            codes[context] = _parse_codes(coder, family, context)
            freqs_of(codes[context], rest_symbol(family, context))  # checks them
    raise_for_status(*finish_decoder(coder.state, coder.stream))
    return Tables(FileTables(k_max, family, stencils, codes))


def _code_magnitude(coder: Coder, first: int, value: int = 0) -> int:
    """Code a value with the magnitude models from `first`; return it."""
    return int(code_magnitude(coder, first, first + N_UNARY, 0, value))


@kernel
def _code_codes(coder, trained, rest, codes):
    """Code the codes of a context in place; return whether a value is out of range.

    A decoder's `codes` need hold nothing.
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
        last = code_magnitude(coder, first, first + N_UNARY, 0, abs(change))
        is_less = np.int64(0)
        if last > 0 and usual > 0:
            is_less = code_raw(coder, 1, np.int64(change < 0))
        codes[symbol] = usual - last if is_less else usual + last
        if last > MAX_CODE or codes[symbol] < 0 or codes[symbol] > MAX_CODE:
            return True
    return False


def _parse_stencil(coder: Coder, plane: int) -> FileStencil:
    base = int(code_raw(coder, _BASE_BITS, 0))
    if not code_raw(coder, 1, 0):
        return FileStencil(base)
    shift = int(code_raw(coder, _SHIFT_BITS, 0))
    deltas = []
    for tap, is_core in enumerate(core_taps(plane)):
        delta = 0
        if tap != missing_tap(plane):
            delta = int(_code_magnitude(coder, _CORE if is_core else _OTHER))
            if delta > 2 * MAX_WEIGHT:
                raise CorruptStreamError(f"a stencil of plane {plane} has a weight beyond 2^15")
            if delta and code_raw(coder, 1, 0):
                delta = -delta
        deltas.append(delta)
    return FileStencil(base, shift, tuple(deltas))


def _parse_codes(coder: Coder, family: int, context: int) -> NDArray[np.int64]:
    trained = default_codes(family)[context]
    codes = trained.copy()
    if _code_codes(coder, trained, rest_symbol(family, context), codes):
        raise CorruptStreamError(f"context {context} has a frequency code that does not exist")
    return codes
