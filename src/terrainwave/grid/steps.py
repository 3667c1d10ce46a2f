"""Fixed steps: heights rounded to multiples of a height that depends only on bound and type.

Rounded heights do not move when they are rounded again, whatever lies around them, as the result
depends only on the sample itself. Steps are about twice the bound wide, so that the nearest is
within the bound.
"""

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

# Significant bits of a step: few of them leave many to its multiples, which are then floats
# themselves. For float32, 5 bits take 0.03 bits per sample on average, nothing for bounds like 0.5,
# 1 or 3, and reach 2^19 steps to each side.
_STEP_BITS = {"float32": 5, "float64": 12}
# Significant bits of multiples. One less than a float64 has: the middles between steps are floats,
# too, so the rounded quotient never lies on another side of a half than the exact one.
_FLOAT_BITS = {"float32": 24, "float64": 52}
# Limits of quanta and heights of all files (`grid.quantum`, FORMAT.md §4.1).
_WIDEST, _FINEST_EXPONENT, _LARGEST_EXPONENT = (1 << 31) - 1, -62, 59


@dataclass(frozen=True)
class FixedSteps:
    """Multiples of a step, in raw units.

    Attributes
    ----------
    dtype : str
        Type of the raw heights.
    numerator, denominator : int
        The step. For whole numbers it is odd and whole.
    nodata : int or float, optional
        The value of voids: it does not change, and no other height is rounded to it.
    """

    dtype: str
    numerator: int
    denominator: int
    nodata: int | float | None = None

    @classmethod
    def of(cls, bound: Fraction, dtype: str, nodata: int | float | None = None) -> Self | None:
        """Return the widest steps that keep a bound in raw units; None if each height is a step.

        `nodata` is the value as the raster stores it.
        """
        if np.dtype(dtype).kind in "iu":
            half = min(math.floor(bound), _WIDEST >> 1)
            return cls(dtype, 2 * half + 1, 1, nodata) if half > 0 else None
        width, bits = min(2 * bound, Fraction(_WIDEST)), _STEP_BITS[dtype]
        if width < Fraction(2) ** _FINEST_EXPONENT:
            return None
        exponent = math.floor(math.log2(width)) - bits
        while width >= Fraction(2) ** (exponent + bits):
            exponent += 1
        if exponent < _FINEST_EXPONENT:
            return None
        unit = Fraction(2) ** exponent
        step = math.floor(width / unit) * unit
        return cls(dtype, step.numerator, step.denominator, nodata)

    @property
    def step(self) -> Fraction:
        """Return the distance of neighbouring steps, in raw units."""
        return Fraction(self.numerator, self.denominator)

    @property
    def loss(self) -> Fraction:
        """Return the largest distance of a height from its step, in raw units."""
        return (self.step if np.dtype(self.dtype).kind == "f" else self.step - 1) / 2

    def rounded(self, heights: NDArray[Any]) -> NDArray[Any]:
        """Return heights on their nearest steps, in `dtype`, any shape. Copies.

        Clipped to the range of whole numbers. Voids are unchanged, and so are heights without a
        step: where floats lie too far apart, and where the step is the nodata value.
        """
        nearest, has_step = self._nearest(heights)
        return np.where(has_step, nearest, heights.astype(self.dtype, copy=False))

    def hold(self, heights: NDArray[Any]) -> bool:
        """Return whether each of some valid heights has a step."""
        return bool(self._nearest(heights)[1].all())

    def _nearest(self, heights: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return the nearest steps, and which heights have one."""
        own = heights.astype(self.dtype, copy=False)
        if own.dtype.kind == "f":
            nearest, has_step = self._nearest_floats(own)
        else:
            limits = np.iinfo(own.dtype)
            wide = (own.astype(np.int64) + (self.numerator >> 1)) // self.numerator
            nearest = np.clip(wide * self.numerator, limits.min, limits.max).astype(own.dtype)
            has_step = np.ones(own.shape, dtype=np.bool_)
        if self.nodata is not None:
            has_step &= (nearest != self.nodata) & (own != self.nodata)
        return nearest, has_step

    def _nearest_floats(self, own: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        step = float(self.step)  # exact: few bits
        most = (1 << _FLOAT_BITS[self.dtype]) // self.numerator
        if self.denominator == 1:
            # A power of two in the numerator takes no bits of a float.
            odd = self.numerator // (self.numerator & -self.numerator)
            most = min(
                (1 << _FLOAT_BITS[self.dtype]) // odd, 2**_LARGEST_EXPONENT // self.numerator
            )
        # Far and infinite heights overflow here, and voids are NaN: none of them has a step.
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            count = np.rint(own.astype(np.float64) / step)
            has_step = np.abs(count) <= most
            # + 0.0: no height is -0.0, which differs from 0.0 bit for bit.
            nearest = (count * step + 0.0).astype(own.dtype)
        return nearest, has_step
