"""Raw heights to quanta and back, array by array (FORMAT.md §2.3); called by `Quantizer`."""

import numpy as np

from terrainwave._jit import kernel


@kernel
def quantize_integers(raw, valid, numerator, base, quanta):
    """Divide multiples of `numerator`; 2-D arrays."""
    for row in range(raw.shape[0]):
        for col in range(raw.shape[1]):
            if valid[row, col]:
                quanta[row, col] = np.int64(raw[row, col]) // numerator - base
            else:
                quanta[row, col] = 0


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
