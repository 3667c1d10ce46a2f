"""How large a detail is expected to be, and what follows: contexts (format-rapid.md, R.7).

The expected magnitude is a weighted sum of what is known around a sample: errors of earlier
predictions, the range of the core, its twist, curvatures of the coarse samples. All in integers:
features come in units of about the step, so that no sum passes 2**31.
"""

import numpy as np
from numpy.typing import NDArray

from terrainwave.codec.rapid.layout import (
    CONTEXT,
    END_SHIFT,
    EXPECTED,
    F_BEND,
    F_CONST,
    F_NEAR,
    F_NORTH,
    F_NORTH_2,
    F_RANGE,
    F_TWIST,
    LEAST,
    MOST,
    N_FEATURES,
    OF_FEATURES,
    PREDICTED,
    RANGE_SHIFT,
    SHIFT_MASK,
    SIDE,
    SIDE_SHIFT,
    SUM,
    TWIST,
    WEIGHTS,
    WHOLE,
    Scale,
)
from terrainwave.coding.jit import kernel, kernel_part

N_BINS, N_SIDES = 44, 4
N_CONTEXTS = N_BINS * N_SIDES
# The expected magnitude is in 1/4096 step; the second bin begins at 48/4096.
FIRST_BIN = 2 * (127 + 5)  # of float32's exponent and first bit
EXPECTED_SHIFT = 4
EXACT = 1 << 24  # below, float32 holds whole numbers exactly
DROPPED = 7  # above, it does so without the lowest bits
FIRST_COARSE = 4 * 16  # the context from which on a fine step's are as those of others
_FINE_STEP = 3  # up to this step the prediction's fraction matters
MOST_ERROR = (1 << 18) - 1
MOST_FAR = (1 << 20) - 1
OF_RANGES = (F_RANGE, F_TWIST, F_BEND)
_F_CONST, _F_RANGE, _F_TWIST = np.uint64(F_CONST), np.uint64(F_RANGE), np.uint64(F_TWIST)


def scale_of(step: int, low: int, high: int, is_by_reach: bool) -> Scale:
    """Return the constants of a step and of heights between `low` and `high` (R.4).

    `is_by_reach` says which contexts a file's tables are for.
    """
    log2 = step.bit_length() - 1
    range_shift = max(log2 - 4, 0)
    return Scale(
        step=step,
        error_shift=log2,
        range_shift=range_shift,
        most_range=(1 << 15 + min(log2, 4)) - 1,
        side_shift=max(log2 - 5, 0),
        side_scale=65536 // (8 * step),
        far_scale=(1024 << log2) // step,
        is_fine=step <= _FINE_STEP,
        is_by_reach=is_by_reach,
        most_detail=(high - low) // step + 1,
        low=low,
        high=high,
    )


def scaled_features(weights: NDArray[np.int64], scale: Scale) -> NDArray[np.int64]:
    """Return feature weights, given in 2**-24 per step, for the units of `scale` (R.7)."""
    shifts = np.zeros(N_FEATURES, dtype=np.int64)
    units = np.full(N_FEATURES, scale.step, dtype=np.int64)
    shifts[F_NORTH : F_NORTH_2 + 1] = shifts[F_NEAR:] = scale.error_shift
    shifts[list(OF_RANGES)] = scale.range_shift
    units[F_CONST] = 1
    return (((weights << shifts) // units) + 128) >> 8


@kernel
def fill_contexts(m, reals, bits_of_reals, n, plane, scale):
    """Fill `CONTEXT`, and what it takes: `EXPECTED`, `WHOLE`, `SIDE`; clamp `PREDICTED`."""
    _expect(m, reals, n, plane, scale)
    is_left = True
    if scale.is_fine:
        is_left = _fill_fine_contexts(m, bits_of_reals, n, scale) and scale.is_by_reach
    if is_left and scale.is_by_reach:
        _fill_contexts_by_reach(m, bits_of_reals, n, scale)
    elif is_left:
        _fill_contexts_by_mean(m, bits_of_reals, n, scale)


@kernel_part
def _expect(m, reals, n, plane, scale):
    """Complete `EXPECTED` by what needs nothing coded before; fill `WHOLE`; clamp `PREDICTED`.

    The features const, range and twist; predictions stay within the core's range. `reals` become
    the upper bits of the expected magnitude, which float32 holds exactly.
    """
    cast, shift = m.dtype.type, m[RANGE_SHIFT] & SHIFT_MASK
    most = cast(scale.most_range)
    w = WEIGHTS[plane] + OF_FEATURES
    of_const, of_range, of_twist = m[w + _F_CONST], m[w + _F_RANGE], m[w + _F_TWIST]
    for j in range(n):
        low, high = m[LEAST + j], m[MOST + j]
        wide = min(cast(cast(high - low) >> shift), most)
        twist = min(cast(m[TWIST + j] >> shift), most)
        total = cast(m[EXPECTED + j] + of_const + of_range * wide + of_twist * twist)
        e = cast(total >> EXPECTED_SHIFT)
        m[EXPECTED + j] = e
        reals[j] = cast(e & cast(~DROPPED)) if e >= EXACT else e
        predicted = min(max(m[PREDICTED + j], cast(low << 6)), cast(high << 6))
        m[PREDICTED + j] = predicted
        m[WHOLE + j] = cast(predicted + 32) >> 6


@kernel_part
def _bin_of(bits):
    """Return the bin of an expected magnitude from the bits of its float32: half octaves.

    Exponent and first bit of the fraction are the same on every machine.
    """
    return min(max((bits >> 22) - FIRST_BIN, 0), N_BINS - 1)


@kernel_part
def _fill_contexts_by_mean(m, bits_of_reals, n, scale):
    """Fill `CONTEXT` and `SIDE` by how far predictions lie from the middle of the core."""
    cast, far_scale = m.dtype.type, m.dtype.type(scale.far_scale)
    shift, end_shift = m[SIDE_SHIFT] & SHIFT_MASK, m[END_SHIFT] & SHIFT_MASK
    for j in range(n):
        side = cast(16 * m[SUM + j] - m[PREDICTED + j])
        m[SIDE + j] = side
        far = min(cast(abs(side) >> shift), cast(MOST_FAR))
        far = cast(cast(far * far_scale) >> end_shift)  # in 1/16384 step
        e = m[EXPECTED + j]
        quarter = cast(far > e) + cast(cast(4 * far) > cast(11 * e)) + cast(far > cast(6 * e))
        m[CONTEXT + j] = cast(4 * _bin_of(bits_of_reals[j])) + quarter


@kernel_part
def _fill_contexts_by_reach(m, bits_of_reals, n, scale):
    """Fill `CONTEXT` and `SIDE` by how far the core reaches beyond predictions, against the side.

    On rough ground this tells how even the two sides are, where the middle is close to both. Of
    fine steps, where errors are expected to be small, what is there stays.
    """
    cast, far_scale = m.dtype.type, m.dtype.type(scale.far_scale)
    shift, end_shift = m[SIDE_SHIFT] & SHIFT_MASK, m[END_SHIFT] & SHIFT_MASK
    first = cast(FIRST_COARSE) if scale.is_fine else cast(0)
    for j in range(n):
        predicted = m[PREDICTED + j]
        side = cast(16 * m[SUM + j] - predicted)
        above, below = cast((m[MOST + j] << 6) - predicted), cast(predicted - (m[LEAST + j] << 6))
        far = min(cast((above if side < 0 else below) >> shift), cast(MOST_FAR))
        far = cast(cast(far * far_scale) >> end_shift)  # in 1/16384 step
        e = m[EXPECTED + j]
        reach = cast(far > cast(2 * e)) + cast(far > cast(6 * e)) + cast(far > cast(12 * e))
        context = cast(4 * _bin_of(bits_of_reals[j]))
        m[SIDE + j] = side if context >= first else m[SIDE + j]
        m[CONTEXT + j] = cast(context + reach) if context >= first else m[CONTEXT + j]


@kernel_part
def _fill_fine_contexts(m, bits_of_reals, n, scale):
    """Fill `CONTEXT` and `SIDE` by where predictions lie between quanta: steps are small.

    Return whether errors are expected to be so large somewhere that this tells nothing.
    """
    cast, side_scale = m.dtype.type, m.dtype.type(scale.side_scale)
    most = cast(0)
    for j in range(n):
        side = cast(m[PREDICTED + j] - 64 * m[WHOLE + j])
        m[SIDE + j] = side
        context = cast(4 * _bin_of(bits_of_reals[j]))
        most = max(most, context)
        quarter = min(cast(cast(abs(side) * side_scale) >> 16), cast(3))
        m[CONTEXT + j] = context + (quarter if context < FIRST_COARSE else cast(0))
    return most >= FIRST_COARSE
