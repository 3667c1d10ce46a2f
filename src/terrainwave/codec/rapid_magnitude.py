"""How large a detail is expected to be, and what follows: contexts (format-rapid.md, R.7).

The expected magnitude is a weighted sum of what is known around a sample: errors of earlier
predictions, the range of the core, its twist, curvatures of the coarse samples. All in integers:
features come in units of about the step, so that no sum passes 2**31.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.lattice import HH, HL, LH
from terrainwave.codec.rapid_layout import (
    ABOVE_HH,
    ABOVE_HL,
    ABOVE_LH,
    BENDS_HH,
    BENDS_HL,
    BENDS_LH,
    CONTEXT,
    EXPECTED,
    FAR_HL,
    FAR_LH,
    FEATURE,
    LEAST,
    MOST,
    N_FEATURES,
    NEAR_HL,
    NEAR_LH,
    ON_LINE,
    PREDICTED,
    SIDE,
    SUM,
    TWIST,
    WHOLE,
    Scale,
)
from terrainwave.coding.jit import kernel

N_BINS, N_SIDES = 44, 4
N_CONTEXTS = N_BINS * N_SIDES
# The expected magnitude is in 1/4096 step; the second bin begins at 48/4096.
_FIRST_BIN = 2 * (127 + 5)  # of float32's exponent and first bit
_EXPECTED_SHIFT = 4
_EXACT = 1 << 24  # below, float32 holds whole numbers exactly
_DROPPED = 7  # above, it does so without the lowest bits
_FINE_BINS = 16
_FINE_STEP = 3  # up to this step the prediction's fraction matters
MOST_ERROR = (1 << 18) - 1
_MOST_SIDE = (1 << 20) - 1
# Features in the order of the weights; those of errors and those of ranges have different units.
F_CONST, F_NORTH, F_DIAGONAL, F_NORTH_2, F_RANGE, F_TWIST, F_BEND, F_NEAR, F_FAR = range(9)
_OF_RANGES = (F_RANGE, F_TWIST, F_BEND)

_C = tuple(np.uint64(k) for k in range(N_FEATURES))


def scale_of(step: int, low: int, high: int) -> Scale:
    """Return what follows from a step and heights between `low` and `high` (R.4)."""
    log2 = step.bit_length() - 1
    range_shift = max(log2 - 4, 0)
    return Scale(
        step=step,
        error_shift=log2,
        range_shift=range_shift,
        most_range=(1 << 15 + min(log2, 4)) - 1,
        side_shift=max(log2 - 5, 0),
        side_scale=(1024 << log2) // step if step > _FINE_STEP else 65536 // (8 * step),
        is_fine=step <= _FINE_STEP,
        most_detail=(high - low) // step + 1,
        low=low,
        high=high,
    )


def scaled_features(weights: NDArray[np.int64], scale: Scale) -> NDArray[np.int64]:
    """Return feature weights, given in 2**-24 per step, for the units of `scale` (R.7)."""
    shifts = np.zeros(N_FEATURES, dtype=np.int64)
    units = np.full(N_FEATURES, scale.step, dtype=np.int64)
    shifts[F_NORTH : F_NORTH_2 + 1] = shifts[F_NEAR:] = scale.error_shift
    shifts[list(_OF_RANGES)] = scale.range_shift
    units[F_CONST] = 1
    return (((weights << shifts) // units) + 128) >> 8


@kernel
def expect_hh(m, at, n, scale):
    """Fill `EXPECTED` for a row of HH."""
    cast, w = m.dtype.type, FEATURE[HH]
    c1, c2, c3, c6 = m[w + _C[1]], m[w + _C[2]], m[w + _C[3]], m[w + _C[6]]
    _expect_ranges(m, n, w, scale)
    for j in range(n):
        k = at + np.uint64(j)
        total = cast(
            m[np.uint64(j) + EXPECTED]
            + c1 * m[k + ABOVE_HH[0]]
            + c2 * (m[k + ABOVE_HH[1]] + m[k + ABOVE_HH[2]])
            + c3 * m[k + ABOVE_HH[3]]
            + c6
            * (m[k + BENDS_HH[0]] + m[k + BENDS_HH[1]] + m[k + BENDS_HH[2]] + m[k + BENDS_HH[3]])
        )
        m[np.uint64(j) + EXPECTED] = cast(total >> _EXPECTED_SHIFT)


@kernel
def expect_hl(m, at, n, scale):
    """Fill `EXPECTED` for a row of HL."""
    cast, w = m.dtype.type, FEATURE[HL]
    c1, c2, c3, c6 = m[w + _C[1]], m[w + _C[2]], m[w + _C[3]], m[w + _C[6]]
    c7, c8 = m[w + _C[7]], m[w + _C[8]]
    _expect_ranges(m, n, w, scale)
    for j in range(n):
        k = at + np.uint64(j)
        m[np.uint64(j) + EXPECTED] = cast(
            m[np.uint64(j) + EXPECTED]
            + c1 * m[k + ABOVE_HL[0]]
            + c2 * (m[k + ABOVE_HL[1]] + m[k + ABOVE_HL[2]])
            + c3 * m[k + ABOVE_HL[3]]
            + c6 * (m[k + BENDS_HL[0]] + m[k + BENDS_HL[1]])
        )
    for j in range(n):
        k = at + np.uint64(j)
        total = cast(
            m[np.uint64(j) + EXPECTED]
            + c7 * (m[k + NEAR_HL[0]] + m[k + NEAR_HL[1]])
            + c8 * (m[k + FAR_HL[0]] + m[k + FAR_HL[1]] + m[k + FAR_HL[2]] + m[k + FAR_HL[3]])
        )
        m[np.uint64(j) + EXPECTED] = cast(total >> _EXPECTED_SHIFT)


@kernel
def expect_lh(m, at, n, scale):
    """Fill `EXPECTED` for a row of LH."""
    cast, w = m.dtype.type, FEATURE[LH]
    c1, c2, c3, c6 = m[w + _C[1]], m[w + _C[2]], m[w + _C[3]], m[w + _C[6]]
    c7, c8 = m[w + _C[7]], m[w + _C[8]]
    _expect_ranges(m, n, w, scale)
    for j in range(n):
        k = at + np.uint64(j)
        m[np.uint64(j) + EXPECTED] = cast(
            m[np.uint64(j) + EXPECTED]
            + c1 * m[k + ABOVE_LH[0]]
            + c2 * (m[k + ABOVE_LH[1]] + m[k + ABOVE_LH[2]])
            + c3 * m[k + ABOVE_LH[3]]
            + c6 * (m[k + BENDS_LH[0]] + m[k + BENDS_LH[1]])
        )
    for j in range(n):
        k = at + np.uint64(j)
        near = m[k + NEAR_LH[0]] + m[k + NEAR_LH[1]] + m[k + NEAR_LH[2]] + m[k + NEAR_LH[3]]
        total = cast(
            m[np.uint64(j) + EXPECTED]
            + c7 * (near + m[k + NEAR_LH[4]] + m[k + NEAR_LH[5]])
            + c8 * (m[k + FAR_LH[0]] + m[k + FAR_LH[1]] + m[k + FAR_LH[2]] + m[k + FAR_LH[3]])
        )
        m[np.uint64(j) + EXPECTED] = cast(total >> _EXPECTED_SHIFT)


@kernel
def expect_on_line(m, n, scale):
    """Fill `EXPECTED` for samples that are predicted from a line or from corners alone."""
    cast = m.dtype.type
    _expect_ranges(m, n, FEATURE[ON_LINE], scale)
    for j in range(n):
        k = np.uint64(j) + EXPECTED
        m[k] = cast(m[k] >> _EXPECTED_SHIFT)


@kernel
def _expect_ranges(m, n, w, scale):
    """Start `EXPECTED` with the features that need nothing coded before."""
    cast, shift, most = m.dtype.type, scale.range_shift, m.dtype.type(scale.most_range)
    c0, c4, c5 = m[w + _C[0]], m[w + _C[4]], m[w + _C[5]]
    for j in range(n):
        k = np.uint64(j)
        wide = min(cast(cast(m[k + MOST] - m[k + LEAST]) >> shift), most)
        twist = min(cast(m[k + TWIST] >> shift), most)
        m[k + EXPECTED] = cast(c0 + c4 * wide + c5 * twist)


@kernel
def round_predictions(m, n, scale):
    """Clamp `PREDICTED` to the core's range; fill `WHOLE` and `SIDE`."""
    cast = m.dtype.type
    for j in range(n):
        k = np.uint64(j)
        low, high = cast(m[k + LEAST] << 6), cast(m[k + MOST] << 6)
        m[k + PREDICTED] = min(max(m[k + PREDICTED], low), high)
    for j in range(n):
        k = np.uint64(j)
        m[k + WHOLE] = cast(cast(m[k + PREDICTED] + 32) >> 6)
    if scale.is_fine:
        for j in range(n):
            k = np.uint64(j)
            m[k + SIDE] = cast(m[k + PREDICTED] - 64 * m[k + WHOLE])
    else:
        for j in range(n):
            k = np.uint64(j)
            m[k + SIDE] = cast(16 * m[k + SUM] - m[k + PREDICTED])


@kernel
def fill_contexts(m, reals, bits_of_reals, n, scale):
    """Fill `CONTEXT` from `EXPECTED` and `SIDE`.

    Bins are half octaves. float32 holds the upper bits of the expected magnitude exactly, so that
    its exponent and first bit are the bin, on every machine.
    """
    cast = m.dtype.type
    for j in range(n):
        e = m[np.uint64(j) + EXPECTED]
        reals[j] = e & cast(~_DROPPED) if e >= _EXACT else e
    for j in range(n):
        bin_ = cast((bits_of_reals[j] >> 22) - _FIRST_BIN)
        m[np.uint64(j) + CONTEXT] = min(max(bin_, cast(0)), cast(N_BINS - 1))
    side_scale = scale.side_scale
    if scale.is_fine:
        for j in range(n):
            k = np.uint64(j)
            quarter = min(cast(cast(abs(m[k + SIDE]) * side_scale) >> 16), cast(3))
            bin_ = m[k + CONTEXT]
            m[k + CONTEXT] = cast(4 * bin_ + (quarter if bin_ < _FINE_BINS else cast(0)))
        return
    shift, end_shift = scale.side_shift, 2 + scale.error_shift - scale.side_shift
    for j in range(n):
        k = np.uint64(j)
        far = min(cast(abs(m[k + SIDE]) >> shift), cast(_MOST_SIDE))
        far = cast(cast(far * side_scale) >> end_shift)  # in 1/16384 step
        e = m[k + EXPECTED]
        steps = cast(far > e) + cast(cast(4 * far) > cast(11 * e)) + cast(far > cast(6 * e))
        m[k + CONTEXT] = cast(4 * m[k + CONTEXT] + steps)
