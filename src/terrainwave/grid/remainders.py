"""Remainders: differences of a raster's heights from their quanta, which make them exact.

Floats are counted here in the order of their values: neighbours are 1 apart, also across 0 (-0.0 is
next to 0.0). A remainder is the number of floats from the decoded height up to the original, in
two's complement of the type's width; for whole numbers it is the plain difference (FORMAT.md §5.3).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Remainders = NDArray[np.signedinteger[Any]]


def remainders(
    raw: NDArray[np.generic], valid: NDArray[np.bool_], decoded: NDArray[np.generic]
) -> Remainders:
    """Count the floats from decoded heights up to originals; 0 where not `valid`.

    Parameters
    ----------
    raw, decoded : ndarray of one type of 4 or 8 bytes, shape (n_rows, n_cols)
    valid : ndarray of bool, same shape

    Returns
    -------
    ndarray of int32 or int64, same shape
    """
    with np.errstate(over="ignore"):  # sums wrap, and wrap back when they are added again
        rest: Remainders = np.where(valid, _ordered(raw) - _ordered(decoded), 0)
    return rest


def restored(heights: NDArray[np.generic], rest: Remainders) -> NDArray[np.generic]:
    """Return decoded heights with their remainders."""
    with np.errstate(over="ignore"):
        order = _ordered(heights) + rest
    return _swapped(order).view(heights.dtype) if heights.dtype.kind == "f" else order


def _ordered(heights: NDArray[np.generic]) -> Remainders:
    """Return numbers whose order is that of the heights."""
    bits = np.ascontiguousarray(heights).view(f"i{heights.dtype.itemsize}")
    return _swapped(bits) if heights.dtype.kind == "f" else bits


def _swapped(bits: Remainders) -> Remainders:
    """Return the bits of a float as a number in the order of floats, or the other way round."""
    below = bits >> (8 * bits.itemsize - 1)  # all ones if negative
    swapped: Remainders = bits ^ (below & np.iinfo(bits.dtype).max)
    return swapped
