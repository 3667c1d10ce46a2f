"""Which samples of a unit are valid, in files that tell fills (FORMAT.md §5.4).

A sample of a coarse level is valid where any full-grid sample near it is. It is valid by itself,
*own*, where the full-grid sample at its place is; the other valid ones are *fills*. On the finest
level all valid samples are own.

Own samples are coded from level to level, each once: those on even rows and columns are the
parent's. They say nearly all of the masks, so that the two together take no more bytes than masks
alone do in a file without fills.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.refiner import ALL_VALID, Mask, Validity, as_array
from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.jit import inlined_kernel, kernel, kernel_part
from terrainwave.coding.rangecoder import (
    SETTLED_ON_ONES,
    code_ones,
    code_step,
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
    new_models,
    put_back,
    take_out,
)
from terrainwave.coding.status import raise_for_status
from terrainwave.grid.quadtree import Region

# What is known of a sample before it is coded: nothing, that it is void, or that it is valid.
UNKNOWN, VOID, VALID = 0, 1, 2
# By west; north, north-west and north-east; what is known of east, south, south-east, south-west.
_N_AHEAD = 3**4
_WEST = 8 * _N_AHEAD
N_MODELS = 2 * _WEST
_KNOWN = -1
_INSIDE = 7 * _N_AHEAD  # contexts of samples with ones to the north, north-west and north-east
# An adaptive bit costs at most 16 bits, so this is room for any mask.
_BYTES_PER_SAMPLE = 2

Knowledge = NDArray[np.uint8]


class Sections(NamedTuple):
    """The coded validity of a unit; empty where it follows from what is known."""

    mask: bytes
    own: bytes


class Above(NamedTuple):
    """Validity by itself of the level above, around a unit; None where all are valid."""

    region: Region
    own: Mask | None


def encode_validity(
    validity: Validity, implied: Mask, region: Region, above: Above | None, *, is_finest: bool
) -> Sections:
    """Return the sections of a unit's validity (FORMAT.md §5.4).

    Parameters
    ----------
    validity : Validity
        All valid samples are so by themselves on the finest level; those at the parent's samples
        where these are.
    implied : ndarray of bool, shape ``region.shape``
        Samples that are void because of voids of the parent.
    above : Above or None
        None for a root block.
    """
    known = _known_of_own(implied, region, above)
    mask = as_array(validity.mask, region.shape)
    if is_finest:
        return Sections(_encoded(mask, known), b"")
    own = as_array(validity.own_mask, region.shape)
    return Sections(_encoded(mask, _known_of_mask(implied, own)), _encoded(own, known))


def decode_validity(
    sections: Sections, implied: Mask, region: Region, above: Above | None, *, is_finest: bool
) -> Validity:
    """Undo `encode_validity`; whatever the bytes, all own samples are valid.

    Raises
    ------
    CorruptStreamError
        If a section is not exactly what it should be.
    """
    if not any(sections) and (above is None or above.own is None) and not implied.any():
        return ALL_VALID
    known = _known_of_own(implied, region, above)
    if is_finest:
        return Validity.of(_decoded(sections.mask, known))
    own = _decoded(sections.own, known)
    return Validity.of(_decoded(sections.mask, _known_of_mask(implied, own)), own)


def _known_of_own(implied: Mask, region: Region, above: Above | None) -> Knowledge:
    """Return what is known of own samples: voids that are implied, and the parent's samples."""
    known = implied.astype(np.uint8)  # VOID is 1
    if above is not None:
        row, col = region.row & 1, region.col & 1
        inherited = known[row::2, col::2]
        first_row, first_col = region.row + row >> 1, region.col + col >> 1
        n_rows, n_cols = inherited.shape
        outer = Region(first_row, first_col, n_rows, n_cols).slices_in(above.region)
        inherited[...] = VALID if above.own is None else np.where(above.own[outer], VALID, VOID)
    return known


def _known_of_mask(implied: Mask, own: Mask) -> Knowledge:
    """Return what is known of valid samples: voids that are implied, and all beside own ones."""
    near = np.zeros((own.shape[0] + 2, own.shape[1] + 2), dtype=np.bool_)
    near[1:-1, 1:-1] = own
    rows = near[:-2] | near[1:-1] | near[2:]
    spread = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    known = np.where(spread, np.uint8(VALID), np.uint8(UNKNOWN))
    known[implied] = VOID
    return known


def _encoded(mask: Mask, known: Knowledge) -> bytes:
    """Return the bytes of a mask; none where all that is not known to be void is valid."""
    if np.array_equal(mask, known != VOID):
        return b""
    out = np.empty(_BYTES_PER_SAMPLE * mask.size + 8, dtype=np.uint8)
    coder = new_encoder(out, new_models(N_MODELS))
    _code_known(np.ascontiguousarray(mask), coder, *_room(known))
    return out[: finish_encoder(coder.state, out)].tobytes()


def _decoded(section: bytes, known: Knowledge) -> Mask:
    if not section:
        mask: Mask = known != VOID
        return mask
    coder = new_decoder(section, new_models(N_MODELS))
    room = _room(known)
    _code_known(None, coder, *room)
    raise_for_status(*finish_decoder(coder.state, coder.stream))
    return room.padded[1:, 1:-1].copy()


class _Room(NamedTuple):
    """What `_code_known` works in: margins of what lies outside the unit, which is unknown."""

    known: Knowledge
    contexts: NDArray[np.int16]
    padded: NDArray[np.bool_]


def _room(known: Knowledge) -> _Room:
    n_rows, n_cols = known.shape
    framed = np.zeros((n_rows + 1, n_cols + 2), dtype=np.uint8)
    framed[:-1, 1:-1] = known
    padded = np.zeros((n_rows + 1, n_cols + 2), dtype=np.bool_)
    return _Room(framed, np.empty(n_cols, dtype=np.int16), padded)


@kernel
def _row_models(padded, known, row, contexts):
    """Fill `contexts` with each sample's model but for its western neighbour's part, or _KNOWN."""
    above, here, below = padded[row], known[row], known[row + 1]
    # All in 16 bits, so that vectors hold many.
    for col in range(np.uint64(contexts.shape[0])):
        middle, east = col + np.uint64(1), col + np.uint64(2)
        causal = np.int16(
            np.int16(np.int16(4 * np.int16(above[middle])) + np.int16(2 * np.int16(above[col])))
            + np.int16(above[east])
        )
        near = np.int16(np.int16(27 * np.int16(here[east])) + np.int16(9 * np.int16(below[middle])))
        far = np.int16(np.int16(3 * np.int16(below[east])) + np.int16(below[col]))
        context = np.int16(np.int16(np.int16(causal * _N_AHEAD) + near) + far)
        contexts[col] = context if here[middle] == UNKNOWN else np.int16(_KNOWN)


@inlined_kernel
def _is_settled(context, models):
    """Return whether a sample whose four coded neighbours are ones has a model that ones settled.

    `context` is that of `_row_models`, and the western neighbour is a one.
    """
    return context >= _INSIDE and models[np.uint64(context + _WEST)] == SETTLED_ON_ONES


@kernel_part
def _run_of_ones(mask, known, contexts, models, row, col, n_cols):
    """Return how many samples of a row are to be coded by settled models, and where the run ends.

    All these models are the same numbers, and ones do not move them: one stands for all. Known ones
    lie between them. When encoding, the run ends before a zero.
    """
    n, end = np.int64(0), col
    while end < n_cols:
        if contexts[end] == _KNOWN:
            if known[row, end + 1] != VALID:
                break
        elif not _is_settled(contexts[end], models):
            break
        else:
            if mask is not None:
                if not mask[row, end]:
                    break
            n += 1
        end += 1
    return n, end


@kernel
def _code_known(mask, coder, known, contexts, padded):
    """Encode what is not known of `mask` in raster order, or decode it; either way to `padded`."""
    coder, known, contexts, padded = borrowed((coder, known, contexts, padded))
    n_rows, n_cols = padded.shape[0] - 1, padded.shape[1] - 2
    state, stream, models, is_encoder = coder
    at = take_out(state)
    for row in range(n_rows):
        _row_models(padded, known, row, contexts)
        west, col = np.int64(0), 0
        while col < n_cols:
            if west == 1 and _is_settled(contexts[col], models):
                n, end = _run_of_ones(mask, known, contexts, models, row, col, n_cols)
                n_ones, at = code_ones(
                    at, state, stream, models, is_encoder, contexts[col] + _WEST, n
                )
                # Up to the zero that stopped it, if one did.
                while col < end and (n_ones > 0 or n_ones == n or contexts[col] == _KNOWN):
                    if contexts[col] != _KNOWN:
                        if n_ones == 0:
                            break
                        n_ones, n = n_ones - 1, n - 1
                    padded[row + 1, col + 1] = True
                    col += 1
                if col == n_cols:
                    break
            if contexts[col] == _KNOWN:
                west = np.int64(known[row, col + 1] == VALID)
            else:
                bit = np.int64(0)
                if mask is not None:
                    bit = np.int64(mask[row, col])
                model = contexts[col] + _WEST * west
                west, at = code_step(at, state, stream, models, is_encoder, model, bit)
            padded[row + 1, col + 1] = west == 1
            col += 1
        if mask is None and at[2] > stream.shape[0] + 4:
            break  # `finish_decoder` says so
    put_back(at, state)
