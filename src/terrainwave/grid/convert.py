"""Kernels of `quantum` and `pyramid`: raw heights to quanta and back (FORMAT.md §2.3), fills."""

import numpy as np

from terrainwave.coding.jit import kernel
from terrainwave.coding.native_library import also_in_c

_IN_C = "terrainwave.grid.convert_in_c"

# Marks a void in the input of `push`.
UNKNOWN = -(1 << 31)
_ONE = np.uint64(1)


@also_in_c(_IN_C)
@kernel
def quantize_integers(raw, valid, numerator, base, quanta):
    """Divide multiples of `numerator`; 2-D arrays."""
    for row in range(raw.shape[0]):
        for col in range(raw.shape[1]):
            if valid[row, col]:
                quanta[row, col] = np.int64(raw[row, col]) // numerator - base
            else:
                quanta[row, col] = 0


@also_in_c(_IN_C)
@kernel
def quantize_floats(raw, valid, numerator, denominator, base, quanta):
    """Round to the grid, ties to even; 2-D arrays."""
    for row in range(raw.shape[0]):
        for col in range(raw.shape[1]):
            if valid[row, col]:
                multiple = (
                    np.float64(raw[row, col]) * np.float64(denominator) / np.float64(numerator)
                )
                quanta[row, col] = np.int64(np.rint(multiple)) - base
            else:
                quanta[row, col] = 0


@kernel
def dequantize_integers(quanta, numerator, denominator, base, low, high, out):
    """Fill `out` with whole heights; ties of a fractional quantum go to even. 2-D arrays.

    The header's limits keep (base + k) * numerator below 2^63.
    """
    for row in range(quanta.shape[0]):
        for col in range(quanta.shape[1]):
            height = (np.int64(quanta[row, col]) + base) * numerator
            if denominator != 1:
                height = np.int64(np.rint(np.float64(height) / np.float64(denominator)))
            out[row, col] = min(max(height, low), high)


@kernel
def dequantize_floats(quanta, numerator, denominator, base, out):
    """Fill `out` with the quotients, rounded to float64 and then to its own type. 2-D arrays."""
    for row in range(quanta.shape[0]):
        for col in range(quanta.shape[1]):
            product = (np.int64(quanta[row, col]) + base) * numerator
            out[row, col] = np.float64(product) / np.float64(denominator)


@also_in_c(_IN_C)
@kernel
def push(fine, first_row, first_col, lines, values, known):
    """Average the known samples of a level around each sample of the level above.

    Sample (i, j) of `values` lies on ``fine[2 i + first_row, 2 j + first_col]``; weights are
    (1, 2, 1) both ways, past the edge of `fine` those of its border. Samples of `fine` (int32) that
    are UNKNOWN count for nothing; without any other the result is 0 and not `known`. `lines` is
    scratch, int64, two rows as wide as `fine`.
    """
    n_rows, n_cols = fine.shape
    unknown, one = np.int32(UNKNOWN), np.uint64(1)
    parts, shares = np.uint64(0), one
    for i in range(values.shape[0]):
        row = 2 * i + first_row
        above, here = np.uint64(max(row - 1, 0)), np.uint64(row)
        below = np.uint64(min(row + 1, n_rows - 1))
        for k in range(np.uint64(n_cols)):
            a, b, c = fine[above, k], fine[here, k], fine[below, k]
            part = np.int64(0 if a == unknown else a) + np.int64(0 if c == unknown else c)
            lines[parts, k] = part + 2 * np.int64(0 if b == unknown else b)
            lines[shares, k] = (
                np.int64(a != unknown) + np.int64(c != unknown) + 2 * np.int64(b != unknown)
            )
        for j in range(values.shape[1]):
            col = 2 * j + first_col
            left, at = np.uint64(max(col - 1, 0)), np.uint64(col)
            right = np.uint64(min(col + 1, n_cols - 1))
            total = lines[parts, left] + 2 * lines[parts, at] + lines[parts, right]
            weight = lines[shares, left] + 2 * lines[shares, at] + lines[shares, right]
            if weight == 16:
                values[i, j], known[i, j] = total >> 4, True
            elif weight > 0:
                values[i, j], known[i, j] = total // weight, True
            else:
                values[i, j], known[i, j] = 0, False


@also_in_c(_IN_C)
@kernel
def pull(coarse, first_row, first_col, known, values):
    """Fill samples that are not `known` with the rounded mean of those around, a level above.

    `values` is changed in place. Its sample (i, j) lies on ``coarse[(i + first_row) / 2, (j +
    first_col) / 2]``, int32, or between samples, the last one counting twice if none follows.
    """
    last_row, last_col = np.uint64(coarse.shape[0] - 1), np.uint64(coarse.shape[1] - 1)
    for i in range(values.shape[0]):
        row = np.uint64(i + first_row)
        above, below = row >> _ONE, min((row + _ONE) >> _ONE, last_row)
        for j in range(values.shape[1]):
            if not known[i, j]:
                col = np.uint64(j + first_col)
                left, right = col >> _ONE, min((col + _ONE) >> _ONE, last_col)
                total = np.int64(coarse[above, left]) + np.int64(coarse[above, right])
                total += np.int64(coarse[below, left]) + np.int64(coarse[below, right])
                values[i, j] = (total + 2) >> 2
