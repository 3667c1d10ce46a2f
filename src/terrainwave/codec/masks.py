"""Lossless coding of a unit's validity mask (FORMAT.md §5.2).

One adaptive bit per sample that the parent does not already imply to be void, in raster order. The
context is six causal neighbours, and how many of two near and of four farther samples to come are
already known to be void: along an outline these say where it goes.
"""

import base64
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.refiner import Mask
from terrainwave.coding.borrowed import borrowed
from terrainwave.coding.jit import kernel
from terrainwave.coding.rangecoder import (
    code_ones,
    code_step,
    finish_decoder,
    finish_encoder,
    new_decoder,
    new_encoder,
    put_back,
    take_out,
)
from terrainwave.coding.status import raise_for_status

# Contexts of what lies ahead: 0 … 2 of the near ones times 0, 1, 2 or more of the farther ones.
_N_AHEAD = 9
_FARTHEST = 2
N_MASK_MODELS = 64 * _N_AHEAD
# Where all six neighbours are valid and no void is ahead: what `row_contexts` says, and the model.
_INSIDE = 29 * _N_AHEAD
_ALL_VALID = 63 * _N_AHEAD
_FOUR = np.uint64(_INSIDE * 0x0001_0001_0001_0001)  # four times
_IMPLIED = -1
# Start probabilities in 1/256, from tools/train_masks.py; an annex of the format, never edited.
_STARTS = (
    "5d#Sn1_Bfm1`Y-dA|U}HA|Mk4D=7#9DJdxv8&p(J9aL0QZ5AbEWfEm&WiAB^Jv{|IJw0G)cXxMWcXxL>O>AszQfz"
    "E&BqcU!HV<iODGm$_M>qsWM-~nd6Idw*SXdzn2oFg@2T4gCUTJ=Qer<k!el0j~aBwnkaBx<Betv#_etv!~N^x;<V"
    "{vhDfm3^be^Y;de`GRVd3h>%d3k$ufPjE>fPjE*dw+j_e}8{}$bO!lo=%>gp4wcB$;m^>$;q*2goK2EgoK2TT7-m"
    "zafF0~T}MTGdpCP~dm<JXR89s|R3bA!ZhU-Ye0+Qp3LaQk4_H_!h%tVCenEbIet}AvcXugwcXwGye0+Rve0+RY9b"
    ";Zz7+zjp(~F^{f_kN;rN5nsh=_=Yh=|^E%+iBe($dnZd4`meX_S<d_oAkzrlzK*rr?u|jEszojEwB9!NI}7!NI}I"
    "mY<)Wo1dSbv~qcba%qHwgpgl_fq`;?fq}bedZC3Mp`nn59z}eF8+?3KyLy3vfq{X6fs}QCfPjF2fPmAeqN1XrqN1"
    "XicZi6HZitA8<&1=cgoK2Igur@&f`WpAf`a3QjEszojEs!Ke}sgDgoK2I{j;*Nva+(Wvi!-uzP`S`zP|j(%gf8l%"
    "gf8}vc|^7#>U3R=cb5>iHV7ciOPVDjEsbgjEwcw(bePP)z#JMqo3X1tlizO_{N`~pP!$fpZ@gq_4WDn_4WVn_xJb"
    "r_xJbz{r~^}|NsC0"
)
START_COUNT = 2
_PROBABILITIES = np.frombuffer(base64.b85decode("".join(_STARTS)), dtype=np.uint8).astype(np.uint32)
_START_MODELS = (_PROBABILITIES << 24 | START_COUNT).astype(np.uint32)
# An adaptive bit costs at most 16 bits, so this is room for any mask.
_BYTES_PER_SAMPLE = 2


def encode_mask(mask: Mask, implied: Mask) -> bytes:
    """Return the bytes of `mask`, which must be False wherever `implied` is True.

    Parameters
    ----------
    mask, implied : ndarray of bool, shape (n_rows, n_cols)
        Valid samples, and samples known to be void without a bit.
    """
    out = np.empty(_BYTES_PER_SAMPLE * mask.size + 8, dtype=np.uint8)
    coder = new_encoder(out, start_models())
    mask = np.ascontiguousarray(mask)
    _code_mask(mask, coder, *_surroundings(implied))
    n_bytes = finish_encoder(coder.state, out)
    return out[:n_bytes].tobytes()


def decode_mask(data: bytes, implied: Mask) -> Mask:
    """Undo `encode_mask`.

    Raises
    ------
    CorruptStreamError
        If the bytes are not exactly one mask.
    """
    coder = new_decoder(data, start_models())
    surroundings = _surroundings(implied)
    _code_mask(None, coder, *surroundings)
    raise_for_status(*finish_decoder(coder.state, coder.stream))
    return surroundings.padded[2:, 2:-1].copy()


def start_models() -> NDArray[np.uint32]:
    """Return fresh models with the trained start values."""
    return _START_MODELS.copy()


class _Surroundings(NamedTuple):
    """What `row_contexts` takes and fills, before a sample is coded."""

    ahead: NDArray[np.uint8]
    contexts: NDArray[np.int16]
    padded: NDArray[np.bool_]


def _surroundings(implied: Mask) -> _Surroundings:
    n_rows, n_cols = implied.shape
    padded = np.zeros((n_rows + 2, n_cols + 3), dtype=np.bool_)
    contexts = np.empty(-(-n_cols // 4) * 4, dtype=np.int16)
    return _Surroundings(pad_implied(implied), contexts, padded)


def pad_implied(implied: Mask) -> NDArray[np.uint8]:
    """Return the `ahead` of `row_contexts`."""
    ahead = np.zeros((implied.shape[0] + 2, implied.shape[1] + 3), dtype=np.uint8)
    ahead[:-2, 1:-2] = implied
    return ahead


@kernel
def row_contexts(padded, ahead, row, contexts):
    """Fill `contexts` with the part of each sample's model that its own row does not decide.

    That is _IMPLIED where the sample is implied to be void, and not coded.

    `contexts` has room for a row. `padded` holds the mask behind two rows and columns of voids:
    samples outside the unit count as void. `ahead` is what is implied, with one column before, two
    behind and two rows below that are not.
    """
    above, above2 = padded[row + 1], padded[row]
    here, below, below2 = ahead[row], ahead[row + 1], ahead[row + 2]
    # All in 16 bits, so that vectors hold many.
    for col in range(np.uint64(padded.shape[1] - 3)):
        east, east2 = col + np.uint64(1), col + np.uint64(2)
        causal = np.int16(
            np.int16(16 * np.int16(above[east2]))
            + np.int16(8 * np.int16(above[east]))
            + np.int16(4 * np.int16(above[col + np.uint64(3)]))
            + np.int16(above2[east2])
        )
        near = np.int16(np.int16(here[east2]) + np.int16(below[east]))
        far = np.int16(
            np.int16(np.int16(here[col + np.uint64(3)]) + np.int16(below[col]))
            + np.int16(np.int16(below[east2]) + np.int16(below2[east]))
        )
        far = min(far, np.int16(_FARTHEST))
        context = np.int16(np.int16(np.int16(causal * _N_AHEAD) + np.int16(3 * near)) + far)
        contexts[col] = np.int16(_IMPLIED) if here[east] != 0 else context


@kernel
def _code_mask(mask, coder, ahead, contexts, padded):
    """Encode `mask` in raster order, or decode where it is None; either way into `padded`."""
    coder, ahead, contexts, padded = borrowed((coder, ahead, contexts, padded))
    n_rows, n_cols = padded.shape[0] - 2, padded.shape[1] - 3
    fours = contexts.view(np.uint64)
    state, stream, models, is_encoder = coder
    at = take_out(state)
    for row in range(n_rows):
        row_contexts(padded, ahead, row, contexts)
        west = west2 = np.int64(0)
        col = end = 0
        while col < n_cols:
            if west & west2 and contexts[col] == _INSIDE:
                end = max(end, col)
                while end < n_cols and contexts[np.uint64(end)] == _INSIDE:
                    end += 1
                    while end & 3 == 0 and end < n_cols and fours[np.uint64(end >> 2)] == _FOUR:
                        end += 4
                end = min(end, n_cols)
                last = end
                if mask is not None:
                    last = col
                    while last < end and mask[row, last]:
                        last += 1
                n_ones, at = code_ones(
                    at, state, stream, models, is_encoder, _ALL_VALID, last - col
                )
                for k in range(np.uint64(col + 2), np.uint64(col + 2 + n_ones)):
                    padded[np.uint64(row + 2), k] = True
                col += n_ones
                if col == n_cols:
                    break
            bit = np.int64(0)
            if contexts[col] != _IMPLIED:
                if mask is not None:
                    bit = np.int64(mask[row, col])
                model = contexts[col] + (32 * west + 2 * west2) * _N_AHEAD
                bit, at = code_step(at, state, stream, models, is_encoder, model, bit)
            padded[row + 2, col + 2] = bit == 1
            west2, west = west, bit
            col += 1
        if mask is None and at[2] > stream.shape[0] + 4:
            break  # `finish_decoder` says so
    put_back(at, state)
