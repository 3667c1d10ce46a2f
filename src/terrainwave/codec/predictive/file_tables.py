"""Tables of `predictive` stored in a file: their bytes (FORMAT.md: predictive, P.10).

A file's stencils follow the trained ones of `trained.STENCILS`, its weights of the expected
magnitude those of `trained.E_WEIGHTS`.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.planes import CORES, MAX_WEIGHT, TAPS, FileStencil
from terrainwave.codec.predictive import trained
from terrainwave.codec.predictive.passes import N_FEATURES
from terrainwave.coding.rangecoder import (
    MAGNITUDE_MODELS,
    N_UNARY,
    Coder,
    code_magnitude,
    code_raw,
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
    new_models,
)
from terrainwave.coding.status import raise_for_status
from terrainwave.errors import CorruptStreamError, UnsupportedVersionError

PLANES = (1, 2, 3)
MAX_SETS = 16  # limit of a plane's header
_LAYOUT = 1
MAX_FEATURE_WEIGHT = 1 << 12
# Models of magnitudes: core taps, other taps, feature weights.
_CORE, _OTHER, _FEATURE = 0, MAGNITUDE_MODELS, 2 * MAGNITUDE_MODELS


class FileTables(NamedTuple):
    """Tables added by a file, by plane: stencils, and a vector of feature weights or none."""

    stencils: dict[int, list[FileStencil]]
    e_weights: dict[int, NDArray[np.int64] | None]


class Tables(NamedTuple):
    """All sets that planes of a file may use, trained ones first."""

    stencils: dict[int, NDArray[np.int64]]
    e_weights: dict[int, NDArray[np.int64]]


NO_TABLES = FileTables({plane: [] for plane in PLANES}, dict.fromkeys(PLANES))


@cache
def missing_tap(plane: int) -> int:
    """Return the tap whose weight follows from the others: the first of the core."""
    return [tuple(tap) for tap in TAPS[plane]].index(tuple(CORES[plane][0]))


def weights_of(plane: int, stencil: FileStencil) -> NDArray[np.int64]:
    """Return the weights of a file's stencil, checked."""
    return stencil.weights(trained.STENCILS[plane], missing_tap(plane), plane)


def all_tables(added: FileTables) -> Tables:
    """Return trained and file tables together."""
    stencils, e_weights = {}, {}
    for plane in PLANES:
        sets = trained.STENCILS[plane]
        own = [weights_of(plane, stencil) for stencil in added.stencils[plane]]
        stencils[plane] = np.vstack([sets, *own])
        features = added.e_weights[plane]
        own = [] if features is None else [features]
        e_weights[plane] = np.vstack([trained.E_WEIGHTS[plane], *own])
    return Tables(stencils, e_weights)


def is_empty(added: FileTables) -> bool:
    """Return whether there is nothing to store."""
    return not any(added.stencils[p] or added.e_weights[p] is not None for p in PLANES)


def pack_file_tables(added: FileTables) -> bytes:
    """Return the parameters section; no bytes if there is nothing to store."""
    if is_empty(added):
        return b""
    out = np.zeros(1 << 16, dtype=np.uint8)
    coder = new_encoder(out, new_models(3 * MAGNITUDE_MODELS))
    _code_tables(coder, added)
    n_bytes = finish_encoder(coder.state, out)
    return bytes([_LAYOUT]) + out[:n_bytes].tobytes()


def parse_file_tables(section: bytes) -> FileTables:
    """Undo `pack_file_tables`; the bytes are untrusted."""
    if not section:
        return NO_TABLES
    if section[0] != _LAYOUT:
        raise UnsupportedVersionError(
            f"the tables of the file have layout {section[0]}, which this terrainwave does not"
            " know: install a newer one"
        )
    coder = new_decoder(section[1:], new_models(3 * MAGNITUDE_MODELS))
    added = _code_tables(coder, None)
    raise_for_status(*finish_decoder(coder.state, coder.stream))
    return added


def _code_tables(coder: Coder, goal: FileTables | None) -> FileTables:
    """Encode tables, or decode them if `goal` is None; return them."""
    found = FileTables({plane: [] for plane in PLANES}, dict.fromkeys(PLANES))
    for plane in PLANES:
        stencils = [] if goal is None else goal.stencils[plane]
        n_sets = int(code_raw(coder, 4, len(stencils)))
        if goal is None and n_sets + len(trained.STENCILS[plane]) > MAX_SETS:
            raise CorruptStreamError(f"{n_sets} stencils for plane {plane} are too many")
        nothing = FileStencil(0, 0, (0,) * len(TAPS[plane]))
        for stencil in stencils or [nothing] * n_sets:
            coded = _code_stencil(coder, plane, stencil)
            if goal is None:
                weights_of(plane, coded)  # checks them
            found.stencils[plane].append(coded)
        features = None if goal is None else goal.e_weights[plane]
        if code_raw(coder, 1, int(features is not None)):
            known = [0] * N_FEATURES if features is None else features.tolist()
            weights = [_code_magnitude(coder, _FEATURE, weight) for weight in known]
            if goal is None and max(weights) > MAX_FEATURE_WEIGHT:
                raise CorruptStreamError(f"a feature weighs {max(weights)}, more than 2^12")
            found.e_weights[plane] = np.array(weights, dtype=np.int64)
    return found


def _code_stencil(coder: Coder, plane: int, goal: FileStencil) -> FileStencil:
    """Code a stencil (ignored by a decoder); return it."""
    base, shift = int(code_raw(coder, 4, goal.base)), int(code_raw(coder, 3, goal.shift))
    core = {tuple(tap) for tap in CORES[plane]}
    deltas = []
    for tap, (place, delta) in enumerate(zip(TAPS[plane], goal.deltas, strict=True)):
        size = 0
        if tap != missing_tap(plane):
            first = _CORE if tuple(place) in core else _OTHER
            size = _code_magnitude(coder, first, abs(delta))
            if coder.is_encoder is None and size > 2 * MAX_WEIGHT:
                raise CorruptStreamError(f"a stencil of plane {plane} has a weight beyond 2^15")
        deltas.append(-size if size and code_raw(coder, 1, int(delta < 0)) else size)
    return FileStencil(base, shift, tuple(deltas))


def _code_magnitude(coder: Coder, first: int, value: int) -> int:
    """Code a value (ignored by a decoder); return it."""
    return int(code_magnitude(coder, first, first + N_UNARY, 0, value))
