"""Where pixels and samples lie in the world: affine transforms as tuples (a, b, c, d, e, f).

x = a col + b row + c and y = d col + e row + f, as rasterio counts: whole rows and columns are the
corners of pixels, and a sample lies in the middle of its pixel. Functions take numbers or arrays.

Not by the package `affine`: its inverse rounds 1 / determinant and a shift far from the raster, so
that most middles of pixels of 30 m come back 1e-11 beside a whole sample, where `sample` would look
at a neighbour that may be void. Here the shift goes first and the determinant divides last; whole
metres come back whole. (And its operators are `*` before version 3 and `@` from then on.)
"""

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Transform = tuple[float, ...]
Numbers = TypeVar("Numbers", float, NDArray[np.float64])

# Of an array that nobody placed.
IDENTITY: Transform = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def determinant(transform: Transform) -> float:
    """Return the area of a pixel: negative where rows go down, 0 where there is no inverse."""
    a, b, _, d, e, _ = transform
    return a * e - b * d


def pixel_size(transform: Transform) -> tuple[float, float]:
    """Return width and height of a pixel: along a row, and along a column."""
    a, b, _, d, e, _ = transform
    return math.hypot(a, d), math.hypot(b, e)


def pixels_to_places(transform: Transform, rows: Numbers, cols: Numbers) -> tuple[Numbers, Numbers]:
    """Return x and y of places counted in pixels from the corner of the first one."""
    a, b, c, d, e, f = transform
    return a * cols + b * rows + c, d * cols + e * rows + f


def places_to_pixels(transform: Transform, x: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
    """Return rows and columns of places; the determinant must not be 0.

    Where numbers are extreme the result is NaN or infinite, and numpy warns.
    """
    a, b, c, d, e, f = transform
    area = determinant(transform)
    x, y = x - c, y - f
    return (a * y - d * x) / area, (e * x - b * y) / area


def samples_to_places(
    transform: Transform, rows: Numbers, cols: Numbers
) -> tuple[Numbers, Numbers]:
    """Return x and y of fractional samples: whole ones lie in the middle of pixels."""
    return pixels_to_places(transform, rows + 0.5, cols + 0.5)


def places_to_samples(transform: Transform, x: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
    """Return fractional samples, rows and columns, as `places_to_pixels`."""
    rows, cols = places_to_pixels(transform, x, y)
    return rows - 0.5, cols - 0.5


def without_shift(transform: Transform) -> Transform:
    """Return a transform's linear part, for differences of places."""
    a, b, _, d, e, _ = transform
    return a, b, 0.0, d, e, 0.0


def of_window(transform: Transform, row: float, col: float) -> Transform:
    """Return the transform of a window that begins at a pixel."""
    a, b, _, d, e, _ = transform
    x, y = pixels_to_places(transform, row, col)
    return a, b, x, d, e, y


def of_level(transform: Transform, stride: int, row: float = 0, col: float = 0) -> Transform:
    """Return the transform of a level that has every `stride`-th sample, from one of them on.

    Samples stay where they are and pixels grow around them: the corner of the first one moves out.
    """
    shift = (1 - stride) / 2
    a, b, c, d, e, f = of_window(transform, shift + row * stride, shift + col * stride)
    return a * stride, b * stride, c, d * stride, e * stride, f


def bounds(
    transform: Transform, shape: tuple[int, int], *, inset: float = 0.0
) -> tuple[float, float, float, float]:
    """Return (left, bottom, right, top) of a grid's pixels.

    With `inset` 0.5 of its samples, or of any place so many pixels inside the edge.
    """
    corners = [
        pixels_to_places(transform, row, col)
        for row in (inset, shape[0] - inset)
        for col in (inset, shape[1] - inset)
    ]
    xs, ys = zip(*corners, strict=True)
    return min(xs), min(ys), max(xs), max(ys)
