"""Tables that a file brings along, and their bytes (format-rapid.md, R.10 and R.11)."""

from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.annexes import read_tables
from terrainwave.codec.planes import MAX_WEIGHT, FileStencil
from terrainwave.codec.rapid.layout import (
    CORES,
    HH,
    HL,
    LH,
    MAX_SUM,
    N_LEVEL_CLASSES,
    N_TAPS,
    TAPS,
)
from terrainwave.codec.rapid.symbols import (
    ESCAPED,
    N_CLASSES,
    N_SLOTS,
    N_SYMBOLS,
    N_TABLES,
    NOTHING,
    PAIR_ESCAPE,
    SINGLE_ESCAPE,
    SINGLE_LIMIT,
    SINGLES,
    frequencies_of,
)
from terrainwave.codec.rapid.tables import Tables
from terrainwave.coding.jit import kernel, rare_kernel
from terrainwave.coding.native_library import also_in_c
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
from terrainwave.coding.status import raise_for_status
from terrainwave.errors import CorruptStreamError

PLANES = (HH, HL, LH)
N_SETS, MOST_TAPS = 16, 24
# What is weighed: a constant, the range, the bend and what is near, which HH has not.
N_FEATURES, NEAR = 4, 3
# Kinds of steps: 1, 3, and greater ones.
N_FAMILIES, N_KINDS_OF_STEPS = 6, 3
MAX_CODE = 255
N_PAIR_SYMBOLS, N_SINGLE_SYMBOLS = PAIR_ESCAPE + 1, SINGLE_ESCAPE + 1
MOST_K = 31
_K_BITS = 5
_BASE_BITS, _SHIFT_BITS, _CUT_BITS = 4, 3, 6
# Of a stencil's numbers: the set, whether there are deltas, their shift; then the deltas.
_BASE, _HAS_DELTAS, _SHIFT, _DELTAS = range(4)
_EXACT = 32  # numbers below have a code each; above, 16 codes an octave
# Models: magnitudes of core taps and of other taps, six groups for frequencies, six for weights;
# a flag.
_CORE, _OTHER, _FREQUENCIES, _WEIGHTS = (MAGNITUDE_MODELS * group for group in (0, 1, 2, 8))
_OWN = 14 * MAGNITUDE_MODELS
_N_MODELS = _OWN + 2
_NONE = -1
_FINE, _BAD_STENCIL, _BAD_WEIGHT, _BAD_CUT, _BAD_FREQUENCY = range(5)


class FileTables(NamedTuple):
    """Tables that a file stores.

    Attributes
    ----------
    k_max : int
        Level of the full grid.
    family : int
        Trained weights, cut and frequencies that the file's own differ from.
    stencils : tuple of tuple of FileStencil
        By class of levels and plane.
    weights : ndarray of int64, shape (4, 3, 4)
        Codes of `Tables.weights`.
    cut : int
        As in `Frequencies`.
    codes : dict of int to ndarray of int64, shape (N_SYMBOLS,)
        Codes of frequencies of the tables that are not the family's.
    """

    k_max: int
    family: int
    stencils: tuple[tuple[FileStencil, ...], ...]
    weights: NDArray[np.int64]
    cut: int
    codes: dict[int, NDArray[np.int64]]


class Annex(NamedTuple):
    """Trained tables, to which files store differences.

    Attributes
    ----------
    stencils : ndarray of int16, shape (3, N_SETS, MOST_TAPS)
    cuts : ndarray of int64, shape (N_FAMILIES,)
    weights : ndarray of int64, shape (N_FAMILIES, 4, 3, 4)
        Codes.
    codes : ndarray of int64, shape (N_FAMILIES, N_TABLES, N_SYMBOLS)
        Codes of frequencies.
    """

    stencils: NDArray[np.int16]
    cuts: NDArray[np.int64]
    weights: NDArray[np.int64]
    codes: NDArray[np.int64]


# The annex --------------------------------------------------------------------------------------

ANNEX = "rapid.bin"
LAYOUT = np.dtype(
    [
        ("stencils", "<i2", (len(PLANES), N_SETS, MOST_TAPS)),
        ("cuts", "|u1", (N_FAMILIES,)),
        ("weights", "|u1", (N_FAMILIES, N_LEVEL_CLASSES, len(PLANES), N_FEATURES)),
        ("pairs", "|u1", (N_FAMILIES, N_CLASSES, N_PAIR_SYMBOLS)),
        ("samples", "|u1", (N_FAMILIES, N_CLASSES + 1, N_SINGLE_SYMBOLS)),
    ]
)
# Tables of samples, in the order of the annex and of a file.
_OF_SINGLES = [*range(SINGLES, SINGLES + N_CLASSES), ESCAPED]


@cache
def annex() -> Annex:
    """Return the trained tables.

    Raises `StorageError` if their file cannot be read.
    """
    return unpacked(read_tables(ANNEX, LAYOUT))


def unpacked(tables: np.void) -> Annex:
    """Return the tables of an annex as fits and files use them."""
    codes = np.zeros((N_FAMILIES, N_TABLES, N_SYMBOLS), dtype=np.int64)
    codes[:, :N_CLASSES, :N_PAIR_SYMBOLS] = tables["pairs"]
    codes[:, _OF_SINGLES, :N_SINGLE_SYMBOLS] = tables["samples"]
    return Annex(
        tables["stencils"].astype(np.int16),
        tables["cuts"].astype(np.int64),
        tables["weights"].astype(np.int64),
        codes,
    )


def packed(tables: Annex) -> bytes:
    """Return the bytes of an annex: undo `unpacked`."""
    parts = np.zeros((), dtype=LAYOUT)
    parts["stencils"], parts["cuts"] = tables.stencils.tolist(), tables.cuts.tolist()
    parts["weights"] = tables.weights.tolist()
    parts["pairs"] = tables.codes[:, :N_CLASSES, :N_PAIR_SYMBOLS].tolist()
    parts["samples"] = tables.codes[:, _OF_SINGLES, :N_SINGLE_SYMBOLS].tolist()
    return parts.tobytes()


# Numbers of a file ------------------------------------------------------------------------------


def family_of(step: int) -> int:
    """Return the family of a step in a file that says nothing else."""
    return min((step - 1) >> 1, N_KINDS_OF_STEPS - 1)


def plain_tables(k_max: int, family: int) -> FileTables:
    """Return tables without anything of a file's own."""
    stencils = ((FileStencil(0),) * len(PLANES),) * N_LEVEL_CLASSES
    trained = annex()
    return FileTables(
        k_max, family, stencils, trained.weights[family], int(trained.cuts[family]), {}
    )


def missing_tap(plane: int) -> int:
    """Return the tap whose weight follows from the others: the first of the core."""
    return TAPS[plane].index(CORES[plane][0])


def core_taps(plane: int) -> list[bool]:
    """Return of each tap whether it is one of the core."""
    return [tap in CORES[plane] for tap in TAPS[plane]]


def _number_of(code: int) -> int:
    if code < _EXACT:
        return code
    shift = ((code - _EXACT) >> 4) + 1
    return ((16 + (code & 15)) << shift) + (1 << shift >> 1)


# What a code stands for.
NUMBER_OF_CODE = np.array([_number_of(code) for code in range(MAX_CODE + 1)], dtype=np.int64)


def codes_of(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the codes whose numbers are nearest to `numbers`, which are not negative."""
    middles = (NUMBER_OF_CODE[1:] + NUMBER_OF_CODE[:-1] + 1) >> 1
    return np.searchsorted(middles, numbers, side="right").astype(np.int64)


def _of_tables() -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Return which symbols tables have, what they have beside their number, and the rest symbol."""
    exists = np.zeros((N_TABLES, N_SYMBOLS), dtype=np.bool_)
    exists[:N_CLASSES, :N_PAIR_SYMBOLS] = True
    exists[_OF_SINGLES, :N_SINGLE_SYMBOLS] = True
    least = exists.astype(np.int64)
    least[:N_CLASSES, :PAIR_ESCAPE] = 0
    rests = np.where(np.arange(N_TABLES) < SINGLES, NOTHING, SINGLE_LIMIT)
    return exists, least, rests


EXISTS, LEAST, RESTS = _of_tables()


def freqs_of(
    codes: NDArray[np.int64], tables: NDArray[np.int64] | slice = np.s_[:]
) -> NDArray[np.int64]:
    """Return the frequencies of tables, each of N_SLOTS in all; tables that do not exist have none.

    Parameters
    ----------
    codes : ndarray of int64, shape (n, N_SYMBOLS)
    tables : ndarray of int64, shape (n,)
        The numbers of the tables; by default all.

    Raises `CorruptStreamError` if they leave nothing to a rest symbol.
    """
    freqs = np.where(EXISTS[tables], NUMBER_OF_CODE[codes] + LEAST[tables], 0)
    every, rests = np.arange(len(freqs)), RESTS[tables]
    freqs[every, rests] = 0
    left = np.where(EXISTS[tables].any(1), N_SLOTS - freqs.sum(1), 1)
    if (left < 1).any():
        which = np.arange(N_TABLES)[tables][left < 1][0]
        raise CorruptStreamError(
            f"the frequencies of table {which} leave {left[left < 1][0]} slots to details of 0,"
            " expected 1 at least"
        )
    freqs[every, rests] = np.where(EXISTS[tables].any(1), left, 0)
    return freqs


def tables_from(file: FileTables) -> Tables:
    """Return the tables that units are coded by.

    Raises `CorruptStreamError` if a stencil or a frequency is out of range.
    """
    codes = annex().codes[file.family].copy()
    for table, own in file.codes.items():
        codes[table] = own
    weights = NUMBER_OF_CODE[file.weights]
    weights[:, HH - 1, NEAR] = 0
    frequencies = frequencies_of(file.cut, freqs_of(codes))
    return Tables(file.k_max, stencils_from(file), weights, frequencies)


def stencils_from(file: FileTables) -> NDArray[np.int64]:
    """Return `Tables.stencils`.

    Raises `CorruptStreamError` if a weight, or the sum of absolute ones, is out of range.
    """
    stencils = np.zeros((N_LEVEL_CLASSES, len(PLANES), MOST_TAPS), dtype=np.int64)
    for which, row in enumerate(file.stencils):
        for index, (plane, stencil) in enumerate(zip(PLANES, row, strict=True)):
            sets = annex().stencils[index, :, : N_TAPS[plane]]
            weights = stencil.weights(sets, missing_tap(plane), plane)
            if np.abs(weights).sum() > MAX_SUM:
                raise CorruptStreamError(
                    f"a stencil of plane {plane} has absolute weights of {np.abs(weights).sum()} in"
                    f" all, expected at most {MAX_SUM}"
                )
            stencils[which, index, : len(weights)] = weights
    return stencils


# Bytes ------------------------------------------------------------------------------------------


class _Numbers(NamedTuple):
    """The numbers of a stream: stencils and weights by class and plane, then the rest."""

    stencils: NDArray[np.int64]
    weights: NDArray[np.int64]
    cut: NDArray[np.int64]
    is_own: NDArray[np.int64]
    codes: NDArray[np.int64]


def _new_numbers() -> _Numbers:
    return _Numbers(
        np.zeros((N_LEVEL_CLASSES * len(PLANES), _DELTAS + MOST_TAPS), dtype=np.int64),
        np.zeros((N_LEVEL_CLASSES * len(PLANES), N_FEATURES), dtype=np.int64),
        np.zeros(1, dtype=np.int64),
        np.zeros(N_TABLES, dtype=np.int64),
        np.zeros((N_TABLES, N_SYMBOLS), dtype=np.int64),
    )


@cache
def _known(family: int) -> tuple[NDArray[np.int64], ...]:
    """Return what `_code_tables` knows beforehand."""
    kinds = np.full((len(PLANES), MOST_TAPS), _NONE, dtype=np.int64)
    for index, plane in enumerate(PLANES):
        are_core = core_taps(plane)
        kinds[index, : len(are_core)] = [_CORE if is_core else _OTHER for is_core in are_core]
        kinds[index, missing_tap(plane)] = _NONE
    skipped = np.tile([NEAR, _NONE, _NONE], N_LEVEL_CLASSES)
    trained = annex()
    weights = trained.weights[family].reshape(-1, N_FEATURES)
    return kinds, skipped, weights, EXISTS.sum(1), RESTS, trained.codes[family]


def pack_file_tables(file: FileTables) -> bytes:
    """Return the parameters section."""
    head = bytes([file.k_max | file.family << _K_BITS])
    plain = plain_tables(file.k_max, file.family)
    if file.stencils == plain.stencils and not file.codes and file.cut == plain.cut:
        if np.array_equal(file.weights, plain.weights):
            return head
    numbers = _new_numbers()
    for own, stencil in zip(numbers.stencils, sum(file.stencils, ()), strict=True):
        own[:_DELTAS] = stencil.base, bool(stencil.deltas), stencil.shift
        own[_DELTAS : _DELTAS + len(stencil.deltas)] = stencil.deltas
    numbers.weights[:], numbers.cut[0] = file.weights.reshape(-1, N_FEATURES), file.cut
    for table, codes in file.codes.items():
        numbers.is_own[table], numbers.codes[table] = 1, codes
    out = np.zeros(1 << 16, dtype=np.uint8)
    coder = new_encoder(out, new_models(_N_MODELS))
    code_tables(coder, *numbers, *_known(file.family))
    return head + out[: finish_encoder(coder.state, out)].tobytes()


def parse_file_tables(section: bytes, step: int) -> FileTables:
    """Undo `pack_file_tables`, trusting nothing; the step decides where there are no bytes.

    Raises `CorruptStreamError` if a value is out of range or the section does not end where it
    should.
    """
    k_max, family = section[0] & MOST_K if section else 0, family_of(step)
    if section:
        family = section[0] >> _K_BITS
    if family >= N_FAMILIES:
        raise CorruptStreamError(
            f"the tables build on family {family} of trained ones, and there are {N_FAMILIES}"
        )
    if len(section) < 2:
        return plain_tables(k_max, family)
    numbers = _new_numbers()
    coder = new_decoder(section[1:], new_models(_N_MODELS))
    status, which = code_tables(coder, *numbers, *_known(family))
    if status == _BAD_STENCIL:
        plane = PLANES[which]
        raise CorruptStreamError(f"a stencil of plane {plane} has a weight beyond {MAX_WEIGHT}")
    if status == _BAD_WEIGHT:
        raise CorruptStreamError("a weight of what details are expected to be has no code")
    if status == _BAD_CUT:
        raise CorruptStreamError(
            f"pairs of classes below {which} have tables, and there are {N_CLASSES} classes"
        )
    if status == _BAD_FREQUENCY:
        raise CorruptStreamError(f"table {which} has a frequency without a code")
    raise_for_status(*finish_decoder(coder.state, coder.stream))
    stencils = [
        FileStencil(base, shift, tuple(deltas[: N_TAPS[PLANES[index % len(PLANES)]]]))
        if has_deltas
        else FileStencil(base)
        for index, (base, has_deltas, shift, *deltas) in enumerate(numbers.stencils.tolist())
    ]
    by_class = tuple(
        tuple(stencils[first : first + len(PLANES)])
        for first in range(0, len(stencils), len(PLANES))
    )
    weights = numbers.weights.reshape(N_LEVEL_CLASSES, len(PLANES), N_FEATURES)
    codes = {int(table): numbers.codes[table] for table in np.flatnonzero(numbers.is_own)}
    return FileTables(k_max, family, by_class, weights, int(numbers.cut[0]), codes)


@lru_cache(maxsize=8)
def tables_of(section: bytes, step: int) -> Tables:
    """Return the tables of a file's parameters section.

    Raises `CorruptStreamError` if they are none.
    """
    return tables_from(parse_file_tables(section, step))


@also_in_c("terrainwave.codec.rapid.tables_in_c")
def code_tables(*arguments: Any) -> tuple[int, int]:
    """Code the numbers of a stream in place; return what is wrong with them, and where."""
    found: tuple[int, int] = _code_tables(*arguments)
    return found


@rare_kernel
def _code_tables(
    coder, stencils, weights, cut, is_own, codes, tap_kinds, skipped, trained_weights, n_symbols,
    rests, trained,
):  # fmt: skip
    """Code the numbers of a stream in place; return what is wrong with them, and where."""
    for index in range(stencils.shape[0]):
        plane, own = index % tap_kinds.shape[0], stencils[index]
        own[_BASE] = code_raw(coder, np.int64(_BASE_BITS), own[_BASE])
        own[_HAS_DELTAS] = code_raw(coder, np.int64(1), own[_HAS_DELTAS])
        if not own[_HAS_DELTAS]:
            continue
        own[_SHIFT] = code_raw(coder, np.int64(_SHIFT_BITS), own[_SHIFT])
        for tap in range(tap_kinds.shape[1]):
            first = tap_kinds[plane, tap]
            if first == _NONE:
                continue
            delta = own[_DELTAS + tap]
            size = code_magnitude(coder, first, first + N_UNARY, np.int64(0), abs(delta))
            if size > 2 * MAX_WEIGHT:
                return _BAD_STENCIL, np.int64(plane)
            is_less = np.int64(0)
            if size > 0:
                is_less = code_raw(coder, np.int64(1), np.int64(delta < 0))
            own[_DELTAS + tap] = -size if is_less else size
    for row in range(weights.shape[0]):
        n = np.int64(weights.shape[1])
        if _code_codes(coder, _WEIGHTS, n, skipped[row], trained_weights[row], weights[row]):
            return _BAD_WEIGHT, np.int64(row)
    cut[0] = code_raw(coder, np.int64(_CUT_BITS), cut[0])
    if cut[0] > N_CLASSES:
        return _BAD_CUT, cut[0]
    was_own = np.int64(0)
    for table in range(is_own.shape[0]):
        # Pairs of classes from the cut on, and tables that do not exist, have none.
        if n_symbols[table] == 0 or cut[0] <= table < SINGLES:
            continue
        was_own = code_bit(coder, _OWN + was_own, is_own[table])
        is_own[table] = was_own
        if was_own and _code_codes(
            coder, _FREQUENCIES, n_symbols[table], rests[table], trained[table], codes[table]
        ):
            return _BAD_FREQUENCY, np.int64(table)
    return _FINE, np.int64(0)


@kernel
def _code_codes(coder, groups, n, skipped, trained, codes):
    """Code `n` codes in place, all but the one `skipped`; return whether one is out of range."""
    last = np.int64(0)
    for k in range(n):
        usual = trained[k]
        if k == skipped:
            codes[k] = usual
            continue
        change = codes[k] - usual
        # By whether the code is usually 0, and by the last change.
        group = 3 * np.int64(usual > 0) + min(last, (last >> 1) + 1, 2)
        first = groups + group * MAGNITUDE_MODELS
        last = code_magnitude(coder, first, first + N_UNARY, np.int64(0), abs(change))
        is_less = np.int64(0)
        if last > 0 and usual > 0:
            is_less = code_raw(coder, np.int64(1), np.int64(change < 0))
        codes[k] = usual - last if is_less else usual + last
        if last > MAX_CODE or codes[k] < 0 or codes[k] > MAX_CODE:
            return True
    return False
