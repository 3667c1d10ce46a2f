"""Which samples of a unit are valid, and which by themselves (FORMAT.md §5.2).

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
from terrainwave.coding.jit import kernel, kernel_part
from terrainwave.coding.rangecoder import (
    code_ones,
    code_ones_in_turns,
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
# Of arrays in frames: what is known, and masks.
_KNOWN_INNER = np.s_[:-1, 1:-1]
_INNER = np.s_[1:-1, 1:-1]
# Samples of a run that are looked at together, even; shorter runs are coded one by one.
_AT_ONCE = 32
_LEAST_RUN = 4
_ONE, _TWO = np.uint64(1), np.uint64(2)
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
    """Return the sections of a unit's validity (FORMAT.md §5.2).

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
    return Sections(_encoded(mask, _known_of_mask(implied, _padded(own))), _encoded(own, known))


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
    mask = _decoded(sections.mask if is_finest else sections.own, known)
    if is_finest:
        return Validity.of(mask[_INNER].copy())
    own, mask = mask, _decoded(sections.mask, _known_of_mask(implied, mask))
    return Validity.of(mask[_INNER].copy(), own[_INNER].copy())


def _known_of_own(implied: Mask, region: Region, above: Above | None) -> Knowledge:
    """Return what is known of own samples: voids that are implied, and the parent's samples."""
    framed = _unknown(implied.shape)
    known = framed[_KNOWN_INNER]
    known[...] = implied  # VOID is 1
    if above is not None:
        row, col = region.row & 1, region.col & 1
        inherited = known[row::2, col::2]
        first_row, first_col = region.row + row >> 1, region.col + col >> 1
        n_rows, n_cols = inherited.shape
        outer = Region(first_row, first_col, n_rows, n_cols).slices_in(above.region)
        if above.own is None:
            inherited[...] = VALID
        else:
            np.add(above.own[outer].view(np.uint8), VOID, out=inherited)  # VALID is one more
    return framed


def _known_of_mask(implied: Mask, own: Mask) -> Knowledge:
    """Return what is known of valid samples: voids that are implied, and all beside own ones.

    `own` is `_padded`.
    """
    rows = own[:-2] | own[1:-1]
    rows |= own[2:]
    spread = rows[:, :-2] | rows[:, 1:-1]
    spread |= rows[:, 2:]
    framed = _unknown(implied.shape)
    known = framed[_KNOWN_INNER]
    np.multiply(spread.view(np.uint8), VALID, out=known)
    np.copyto(known, VOID, where=implied)
    return framed


def _unknown(shape: tuple[int, int]) -> Knowledge:
    """Return that nothing is known of samples, in a frame of what `_code_known` looks at beside."""
    return np.zeros((shape[0] + 1, shape[1] + 2), dtype=np.uint8)


def _padded(mask: Mask) -> Mask:
    """Return a mask in a frame of samples that are not."""
    padded = np.zeros((mask.shape[0] + 2, mask.shape[1] + 2), dtype=np.bool_)
    padded[_INNER] = mask
    return padded


def _encoded(mask: Mask, known: Knowledge) -> bytes:
    """Return the bytes of a mask; none where all that is not known to be void is valid."""
    if np.array_equal(mask, known[_KNOWN_INNER] != VOID):
        return b""
    out = np.empty(_BYTES_PER_SAMPLE * mask.size + 8, dtype=np.uint8)
    coder = new_encoder(out, new_models(N_MODELS))
    _code_known(np.ascontiguousarray(mask), coder, known, *_room(mask.shape))
    return out[: finish_encoder(coder.state, out)].tobytes()


def _decoded(section: bytes, known: Knowledge) -> Mask:
    """Return a mask, `_padded`."""
    contexts, padded = _room((known.shape[0] - 1, known.shape[1] - 2))
    if not section:
        np.not_equal(known[_KNOWN_INNER], VOID, out=padded[_INNER])
        return padded
    coder = new_decoder(section, new_models(N_MODELS))
    _code_known(None, coder, known, contexts, padded)
    raise_for_status(*finish_decoder(coder.state, coder.stream))
    return padded


def _room(shape: tuple[int, int]) -> tuple[NDArray[np.int16], Mask]:
    """Return what `_code_known` works in: contexts of a row, and a mask, `_padded`."""
    padded = np.zeros((shape[0] + 2, shape[1] + 2), dtype=np.bool_)
    return np.empty(shape[1], dtype=np.int16), padded


@kernel
def _row_models(padded, known, row, contexts):
    """Fill `contexts` with each sample's model but for its western neighbour's part, or _KNOWN.

    Return whether all are known.
    """
    most = np.int16(_KNOWN)
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
        context = context if here[middle] == UNKNOWN else np.int16(_KNOWN)
        contexts[col] = context
        most = max(most, context)
    return most == _KNOWN


@kernel_part
def _goes_on(known, contexts, row, col):
    """Return whether samples from `col` on are each known, or coded, like the one two before."""
    here, first = np.uint64(row), np.uint64(col)
    other, unlike = np.int16(0), np.uint8(0)
    for k in range(np.uint64(_AT_ONCE)):
        at = first + k
        other = np.int16(other | np.int16(contexts[at] ^ contexts[at - _TWO]))
    for k in range(np.uint64(_AT_ONCE)):
        at = first + k  # of `known` one more
        unlike = np.uint8(unlike | np.uint8(known[here, at + _ONE] ^ known[here, at - _ONE]))
    return other == 0 and unlike == 0


@kernel_part
def _end_of_run(known, contexts, row, col, n_cols):
    """Return up to where each sample from `col` on is known, or coded, like the one two before.

    Far from voids all are: every second one is the parent's. Many are compared at a time.
    """
    end = np.int64(col) + 2
    while end + _AT_ONCE <= n_cols and _goes_on(known, contexts, row, end):
        end += _AT_ONCE
    while end < n_cols:
        if contexts[end] != contexts[end - 2] or known[row, end + 1] != known[row, end - 1]:
            break
        end += 1
    return min(end, n_cols)


@kernel_part
def _code_run(at, mask, coder, known, contexts, row, col, end):
    """Code the ones that samples of a run (`_end_of_run`) begin with; return where they end.

    And `at`. The sample to the west is a one.
    """
    state, stream, models, is_encoder = coder
    first, second = contexts[col], contexts[col + 1]
    # A known void: no ones to code.
    if first == _KNOWN and known[row, col + 1] != VALID:
        return col, at
    if second == _KNOWN and known[row, col + 2] != VALID:
        return col, at
    last = end
    if mask is not None:
        last = col
        while last < end and mask[row, last]:
            last += 1
    if first == second == _KNOWN:
        return last, at
    if first != _KNOWN and second != _KNOWN:
        n_ones, at = code_ones_in_turns(
            at, state, stream, models, is_encoder, first + _WEST, second + _WEST, last - col
        )
        return col + n_ones, at
    skipped = np.int64(first == _KNOWN)
    n = (last - col + 1 - skipped) >> 1
    n_ones, at = code_ones(
        at, state, stream, models, is_encoder, max(first, second) + _WEST, n
    )  # the model of the samples between known ones
    return last if n_ones == n else col + skipped + 2 * n_ones, at


@kernel_part
def _copy_known(padded, known, row, n_cols):
    """Take a row of samples that are all known."""
    to, source = padded[row + 1], known[row]
    for col in range(np.uint64(1), np.uint64(n_cols + 1)):
        to[col] = source[col] == VALID


@kernel
def _code_known(mask, coder, known, contexts, padded):
    """Encode what is not known of `mask` in raster order, or decode it; either way to `padded`.

    `known` has a row and a column more at each side but the top, of what is not known, and `padded`
    a row as well there.
    """
    coder, known, contexts, padded = borrowed((coder, known, contexts, padded))
    n_rows, n_cols = known.shape[0] - 1, known.shape[1] - 2
    state, stream, models, is_encoder = coder
    at = take_out(state)
    for row in range(n_rows):
        west, col, end = np.int64(0), np.int64(0), np.int64(0)
        if _row_models(padded, known, row, contexts):
            _copy_known(padded, known, row, n_cols)
            continue
        while col < n_cols:
            if west == 1:
                if col >= end:
                    end = _end_of_run(known, contexts, row, col, n_cols)
                if end - col >= _LEAST_RUN:
                    after, at = _code_run(at, mask, coder, known, contexts, row, col, end)
                    padded[row + 1, col + 1 : after + 1] = True
                    col = after
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
