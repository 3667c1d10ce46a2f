"""Affine transforms (a, b, c, d, e, f) of pixels and samples to world coordinates.

x = a col + b row + c and y = d col + e row + f, as in rasterio: whole rows and columns are the
corners of pixels, and a sample lies in the middle of its pixel. Functions take numbers or arrays.

The package `affine` is not used: its inverse rounds 1 / determinant and a shift far from the
raster, so that most middles of 30 m pixels come back 1e-11 off a whole sample, where `sample` would
use a neighbour that may be void. Here the shift is subtracted first and the determinant divides
last; whole metres come back whole. (And its operators are `*` before version 3 and `@` from then
on.)
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Transform = tuple[float, ...]
Numbers = TypeVar("Numbers", float, NDArray[np.float64])


class Footprint(NamedTuple):
    """Area of a raster: its transform, and its rows and columns."""

    affine: Transform
    shape: tuple[int, int]


# Transform of an array without georeference.
IDENTITY: Transform = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def determinant(transform: Transform) -> float:
    """Return the area of a pixel: negative if rows go down, 0 if there is no inverse."""
    a, b, _, d, e, _ = transform
    return a * e - b * d


def pixel_size(transform: Transform) -> tuple[float, float]:
    """Return width and height of a pixel: along a row, and along a column."""
    a, b, _, d, e, _ = transform
    return math.hypot(a, d), math.hypot(b, e)


def pixels_to_places(transform: Transform, rows: Numbers, cols: Numbers) -> tuple[Numbers, Numbers]:
    """Return x and y of positions counted in pixels from the corner of the first one."""
    a, b, c, d, e, f = transform
    return a * cols + b * rows + c, d * cols + e * rows + f


def places_to_pixels(transform: Transform, x: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
    """Return rows and columns of points; the determinant must not be 0.

    For extreme numbers the result is NaN or infinite, and numpy warns.
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
    """Return a transform's linear part, for differences of points."""
    a, b, _, d, e, _ = transform
    return a, b, 0.0, d, e, 0.0


def of_window(transform: Transform, row: float, col: float) -> Transform:
    """Return the transform of a window that begins at a pixel."""
    a, b, _, d, e, _ = transform
    x, y = pixels_to_places(transform, row, col)
    return a, b, x, d, e, y


def of_level(transform: Transform, stride: int, row: float = 0, col: float = 0) -> Transform:
    """Return the transform of a level that has every `stride`-th sample, from one of them on.

    Samples stay in place and pixels grow around them: the corner of the first one moves out.
    """
    return of_strides(transform, row * stride, col * stride, stride, stride)


def of_strides(
    transform: Transform, row: float, col: float, row_stride: int, col_stride: int
) -> Transform:
    """Return the transform of samples at strides on a grid, from one of them on."""
    a, b, c, d, e, f = of_window(transform, row + (1 - row_stride) / 2, col + (1 - col_stride) / 2)
    return a * col_stride, b * row_stride, c, d * col_stride, e * row_stride, f


def bounds(
    transform: Transform, shape: tuple[int, int], *, inset: float = 0.0
) -> tuple[float, float, float, float]:
    """Return (left, bottom, right, top) of a grid's pixels.

    With `inset` 0.5, of its samples; generally of points `inset` pixels inside the edge.
    """
    corners = [
        pixels_to_places(transform, row, col)
        for row in (inset, shape[0] - inset)
        for col in (inset, shape[1] - inset)
    ]
    xs, ys = zip(*corners, strict=True)
    return min(xs), min(ys), max(xs), max(ys)


# Coordinates of arrays: centres of pixels, one number per row and column or, if rotated, per
# sample.

# Share of a pixel by which samples of one grid may differ from those of another.
EVEN = 0.01
# The same for coordinates and their own grid: 64 Gaussian latitudes, which are not a grid, are off
# by
# 0.011.
_STRAIGHT = 0.001
# Rounding of coordinates by text or type: digits are considered up to here, and float32 may be
# coarser than a pixel allows, but not so coarse that neighbours could change places.
_DECIMALS = 10
_COARSEST = 0.25
# The package `affine`, and so rioxarray, takes smaller terms of a rotated transform for 0.
_EPSILON = 1e-5
# Rows processed together.
_ROWS = 256
# Significant digits of a pixel size written by a person.
_DIGITS = range(16, 2, -1)


class Fit(NamedTuple):
    """A transform that coordinates follow, and their actual and allowed deviation, in pixels."""

    transform: Transform
    deviation: float
    allowed: float

    @property
    def is_even(self) -> bool:
        """Return whether the coordinates lie on the grid; NaN does not."""
        return self.deviation <= self.allowed


class Strides(NamedTuple):
    """First row and column of samples on another grid, and the whole strides between them."""

    row: int
    col: int
    row_stride: int
    col_stride: int


def coordinates(transform: Transform, rows: Numbers, cols: Numbers) -> tuple[Numbers, Numbers]:
    """Return x and y of whole samples, equal to rioxarray's coordinates to the last bit.

    Libraries join arrays by equal coordinates: with `samples_to_places`, which may differ by one
    ulp, they would lose samples. Here the shift to the middle of the first pixel comes first.
    """
    a, b, c, d, e, f = transform
    x, y = a * 0.5 + b * 0.5 + c, d * 0.5 + e * 0.5 + f
    return cols * a + rows * b + x, cols * d + rows * e + y


def is_turned(transform: Transform, shape: tuple[int, int]) -> bool:
    """Return whether rows and columns of a grid need coordinates of both x and y.

    False if the whole rotation is within `EVEN`, an effect of rounding, or rioxarray ignores it.
    """
    a, b, _, d, e, _ = transform
    if (b, d) == (0, 0):
        return False
    n_rows, n_cols = shape
    is_small = abs(b) * n_rows <= EVEN * abs(a) and abs(d) * n_cols <= EVEN * abs(e)
    return not is_small or max(abs(b), abs(d)) >= _EPSILON or b == d


def grid_of_axes(x: NDArray[np.generic], y: NDArray[np.generic]) -> tuple[Fit, Fit]:
    """Return the grid of columns at `x` and that of rows at `y`, each for its own axis.

    A single coordinate has a pixel width of 0.
    """
    a, c, x_deviation, x_allowed = _even_axis(x)
    e, f, y_deviation, y_allowed = _even_axis(y)
    transform = (a, 0.0, c, 0.0, e, f)
    return Fit(transform, x_deviation, x_allowed), Fit(transform, y_deviation, y_allowed)


def _even_axis(centres: NDArray[np.generic]) -> tuple[float, float, float, float]:
    """Return pixel, edge of the first, largest deviation from an even grid, allowed deviation."""
    numbers = centres.astype(np.float64)
    first, n_pixels = float(numbers[0]), numbers.size - 1
    is_finite = bool(np.isfinite(numbers).all())
    pixel = (float(numbers[-1]) - first) / n_pixels if n_pixels and is_finite else 0.0
    if pixel == 0:
        return 0.0, first, 0.0 if n_pixels == 0 and is_finite else math.inf, _STRAIGHT
    deviation = float(
        np.abs(numbers - (first + pixel * np.arange(numbers.size))).max() / abs(pixel)
    )
    pixel, edge = _written_axis(numbers, pixel)
    return pixel, edge, deviation, _allowed(centres, abs(pixel))


def _allowed(centres: NDArray[np.generic], pixel: float) -> float:
    """Return the deviation from a grid that rounding can explain, in pixels."""
    spacing = 0.0
    if centres.dtype.kind == "f":
        spacing = float(np.spacing(np.abs(centres).max()))
    numbers = centres.astype(np.float64)
    for decimals in range(_DECIMALS):
        if np.abs(np.round(numbers, decimals) - numbers).max() <= spacing:
            return max(
                _STRAIGHT, min(10.0**-decimals / pixel, EVEN), min(spacing / pixel, _COARSEST)
            )
    return max(_STRAIGHT, min(spacing / pixel, _COARSEST))


def _written_axis(centres: NDArray[np.float64], pixel: float) -> tuple[float, float]:
    """Return pixel and edge for which `coordinates` returns exactly these numbers, if possible.

    A pixel size with few digits is preferred to one computed from the ends, and so is one part of a
    whole number: 1/3600.
    """
    first, indices = float(centres[0]), np.arange(centres.size, dtype=np.float64)
    zeros = np.zeros_like(indices)
    for candidate in (pixel, *_few_digits(pixel), *(1 / part for part in _few_digits(1 / pixel))):
        edge = first - candidate * 0.5
        for corner in (edge, math.nextafter(edge, -math.inf), math.nextafter(edge, math.inf)):
            transform = (candidate, 0.0, corner, 0.0, 1.0, 0.0)
            if np.array_equal(coordinates(transform, zeros, indices)[0], centres):
                return candidate, corner
    return pixel, first - pixel / 2


def _few_digits(number: float) -> list[float]:
    rounded = (float(f"{number:.{digits}g}") for digits in _DIGITS)
    return [one for one in rounded if one and math.isfinite(one)]


def grid_of_places(
    read: Callable[[int, int], tuple[NDArray[Any], NDArray[Any]]], shape: tuple[int, int]
) -> Fit:
    """Return the grid of samples that have an x and a y each.

    `read` returns both for some rows, from a first one on. A single row or column has no step in
    one direction: the transform has no inverse.
    """
    n_rows, n_cols = shape
    top, bottom = read(0, 1), read(n_rows - 1, 1)
    down, right = max(n_rows - 1, 1), max(n_cols - 1, 1)
    a, d = ((float(z[0, -1]) - float(z[0, 0])) / right for z in top)
    b, e = ((float(z[0, 0]) - float(first[0, 0])) / down for first, z in zip(top, bottom))
    x, y = (float(z[0, 0]) for z in top)
    transform = (a, b, x - (a + b) / 2, d, e, y - (d + e) / 2)
    area = determinant(transform)
    if area == 0 or not math.isfinite(area):
        return Fit(transform, math.inf, _STRAIGHT)
    side = min(pixel_size(transform))
    allowed = max(_allowed(z, side) for z in (*top, *bottom))
    deviation = 0.0
    for row in range(0, n_rows, _ROWS):
        places = [z.astype(np.float64) for z in read(row, min(_ROWS, n_rows - row))]
        if not np.isfinite(places).all():
            return Fit(transform, math.inf, _STRAIGHT)
        rows, cols = places_to_samples(transform, *places)
        rows -= np.arange(row, row + rows.shape[0])[:, None]
        cols -= np.arange(n_cols)
        deviation = max(deviation, float(np.abs(rows).max()), float(np.abs(cols).max()))
    return Fit(transform, deviation, allowed)


def strides_on(transform: Transform, shape: tuple[int, int], other: Transform) -> Strides | None:
    """Return the strides of a grid's samples on another grid; None if they do not coincide.

    Ends are compared, as a nearly whole stride deviates over many samples. A single row or column
    has stride 1.
    """
    if determinant(other) == 0:
        return None
    n_rows, n_cols = shape
    ends = [(0.0, 0.0), (n_rows - 1.0, 0.0), (0.0, n_cols - 1.0)]
    with np.errstate(all="ignore"):
        found = [places_to_samples(other, *samples_to_places(transform, *end)) for end in ends]
    if not all(math.isfinite(number) for place in found for number in place):
        return None
    (row, col), (last_row, _), (_, last_col) = found
    row_stride = round((last_row - row) / (n_rows - 1)) if n_rows > 1 else 1
    col_stride = round((last_col - col) / (n_cols - 1)) if n_cols > 1 else 1
    strides = Strides(round(row), round(col), row_stride, col_stride)
    whole = [
        (strides.row + row_stride * end_row, strides.col + col_stride * end_col)
        for end_row, end_col in ends
    ]
    if not row_stride or not col_stride or np.abs(np.subtract(found, whole)).max() > EVEN:
        return None
    return strides
