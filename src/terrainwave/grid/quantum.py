"""The vertical quantum p, the odd step n, raw heights to quanta and back (FORMAT.md §2.3).

A raw height (as stored in the raster, before scale and offset) is ``(base + k) * p`` with an int32
number of quanta ``k``. On a *true grid* every sample is such a multiple exactly; otherwise p is a
power of two well below the bound and rounding to it is charged to the bound as `rho`. A bound too
small for that needs remainders, which make every height exact (`grid.remainders`).
"""

import math
from bisect import bisect_left, bisect_right
from copy import copy
from dataclasses import dataclass, replace
from decimal import ROUND_CEILING, Context, Decimal
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainwave.coding import native_library
from terrainwave.errors import InvalidHeightsError
from terrainwave.grid.digest import HeightDigest
from terrainwave.grid.steps import FixedSteps
from terrainwave.names import methods_that

MAX_QUANTA = 1 << 30
# A smaller base plus a quantum fits 32 bits.
_LARGE = 1 << 29
# An exact quotient needs numerators below 2^53 (the float64 significand).
_MAX_NUMERATOR = 1 << 53
# Rounding to p = 2^-FINE_BITS * bound costs less than 0.01 bit per sample; COARSE_BITS is the
# minimum.
_FINE_BITS, _COARSE_BITS = 9, 5
# Quanta with remainders, in spacings: finer ones make `rapid` code noise, at a cost of a third on
# rough ground; 16 and 256 differ by some per cent either way.
_REMAINDER_SPACINGS = 16
# Keep (|base| + 2^31) * p below 2^63, and both parts of p in their fields (FORMAT.md §4.1).
_MAX_HEIGHT = 1 << 59
_FINEST_QUANTUM, _COARSEST_QUANTUM = Fraction(1, 1 << 62), Fraction(1 << 31)

_FOOT = Fraction(3048, 10000)
GRID_CANDIDATES = tuple(
    sorted(
        {Fraction(1, 10**d) for d in range(7)}
        | {Fraction(1, 2**m) for m in range(1, 11)}
        | {_FOOT / 10**d for d in range(4)},
        reverse=True,
    )
)


def as_fraction(value: float) -> Fraction:
    """Return the decimal number that a person reads in `value`: 0.1 gives 1/10."""
    return Fraction(repr(float(value)))


@dataclass(frozen=True)
class Quantizer:
    """Raw heights to quanta and back.

    Attributes
    ----------
    dtype : str
        Type of the raw heights.
    numerator, denominator : int
        The quantum p in raw units.
    base : int
        Raw height of quantum 0, in quanta.
    step : int
        Odd quantiser width n, in quanta; decoded heights lie within ``(step - 1) / 2`` quanta.
    rho : float
        Largest error of rounding to the grid and to `dtype`, in raw units; 0 on a true grid.
    z_min, z_max : int
        Smallest and largest quantum of the valid samples.
    remainder_bytes : int
        Bytes per sample of remainders that make heights of the full grid exact, else 0.
    lift : int
        Quanta by which `base` moves decoded heights to one side of the originals; 0 for both sides.
    """

    dtype: str
    numerator: int
    denominator: int
    base: int
    step: int
    rho: float
    z_min: int
    z_max: int
    remainder_bytes: int = 0
    lift: int = 0

    @property
    def quantum(self) -> float:
        """Return p in raw units."""
        return self.numerator / self.denominator

    @property
    def effective_error(self) -> float:
        """Return the effective bound, in raw units; 0 if remainders make heights exact."""
        return 0.0 if self.remainder_bytes else self.quanta_error

    @property
    def quanta_error(self) -> float:
        """Return the largest distance of quantised heights from the originals, in raw units.

        ``((step - 1) / 2 + |lift|) * p + rho``: meshes and coarse levels do not use remainders.
        """
        n_quanta = (self.step >> 1) + abs(self.lift)
        return float(n_quanta * Fraction(self.numerator, self.denominator)) + self.rho

    @property
    def float_error(self) -> float:
        """Return how much further stored floats may differ than the heights they represent.

        In raw units. Two floats are each at most half a spacing from their multiples of p; 0 if
        every multiple is a float itself, and off the grid, where `rho` includes it.
        """
        if np.dtype(self.dtype).kind != "f" or self.rho > 0:
            return 0.0
        spacing = _spacing(
            self.dtype, max(abs(self.height_of(z)) for z in (self.z_min, self.z_max))
        )
        return float(_float_error(Fraction(self.numerator, self.denominator), spacing))

    def is_strict(self, bound: float, error: float | None = None) -> bool:
        """Return whether stored values themselves are within a bound, in raw units.

        ``abs(decoded - original) <= bound``, exactly and as numpy computes it in `dtype`, if the
        heights they represent are within `error`, by default `effective_error`.
        """
        error = self.effective_error if error is None else error
        limit = _rounded_down(as_fraction(bound), self.dtype)
        return error == 0 or as_fraction(error) + as_fraction(self.float_error) <= limit

    @cached_property
    def lost(self) -> int:
        """Return the largest loss by rounding to quanta, in quanta, rounded up."""
        return int(-(-Fraction(self.rho) * self.denominator // self.numerator))

    def quantize(self, raw: NDArray[np.generic], valid: NDArray[np.bool_]) -> NDArray[np.int32]:
        """Return the quanta of `raw`, shape as given; 0 where not `valid`. Copies."""
        from terrainwave.grid import convert

        base = self.base - self.lift
        quanta = np.empty(raw.shape, dtype=np.int32)
        # Integers too far apart for their own grid are rounded to a coarser one, as floats are.
        is_whole = np.dtype(self.dtype).kind in "iu" and self.rho == 0
        in_c = native_library.is_used()
        if is_whole and self.numerator == 1 and raw.dtype.itemsize < 8 and not in_c:
            # Needs no compiled kernel.
            wide = np.int32 if raw.dtype.itemsize < 4 and abs(base) < _LARGE else np.int64
            np.subtract(raw, base, out=quanta, dtype=wide, casting="unsafe")
            if not valid.all():
                quanta *= valid
            return quanta
        if not in_c:  # kernels are compiled only for contiguous arrays
            raw, valid = np.ascontiguousarray(raw), np.ascontiguousarray(valid)
        if is_whole:
            convert.quantize_integers(raw, valid, self.numerator, base, quanta)
        else:
            convert.quantize_floats(raw, valid, self.numerator, self.denominator, base, quanta)
        return quanta

    def dequantize(
        self, quanta: NDArray[np.int32], out: NDArray[np.generic] | None = None
    ) -> NDArray[np.generic]:
        """Return the raw heights of `quanta` in `dtype`, clipped to its range; in `out` if given.

        Quanta outside of `z_min` … `z_max`, as in voids, give undefined heights. Integers are
        exact; floats are the correctly rounded float64 quotient, cast. Both are the same on every
        machine.
        """
        # Imported here, because reading a header needs no numba.
        from terrainwave.grid import convert

        if out is None:
            out = np.empty(quanta.shape, dtype=self.dtype)
        if out.dtype.kind in "iu":
            if self.shift is not None:
                # Needs no compiled kernel. In one step, as threads whose units meet fill the
                # samples of their common border: each time with the same values.
                if self.base:
                    np.add(quanta, self.base, out=out, casting="unsafe")
                else:
                    np.copyto(out, quanta, casting="unsafe")  # half the time
                return out
            limits = np.iinfo(np.dtype(self.dtype))
            convert.dequantize_integers(
                quanta, self.numerator, self.denominator, self.base, limits.min, limits.max, out
            )
        else:
            convert.dequantize_floats(quanta, self.numerator, self.denominator, self.base, out)
        return out

    @cached_property
    def shift(self) -> int | None:
        """Return the difference of whole heights and quanta, if none is beyond the dtype."""
        if np.dtype(self.dtype).kind not in "iu":
            return None
        limits = np.iinfo(np.dtype(self.dtype))
        heights = self.z_min + self.base, self.z_max + self.base
        is_usual = self.numerator == self.denominator == 1 and abs(self.base) < _LARGE
        fits = limits.min <= heights[0] and heights[1] <= limits.max
        return self.base if is_usual and fits else None

    def quanta_of_value(self, value: float | int | None) -> tuple[int, int]:
        """Return the closed interval of quanta that give `value`; (0, -1) if it is empty."""
        if value is None or not math.isfinite(value):
            return 0, -1
        if np.dtype(self.dtype).kind == "f":  # nodata 0.1 of float32 means the nearest float32
            with np.errstate(over="ignore", under="ignore"):
                value = float(np.dtype(self.dtype).type(value))
        # Heights grow with quanta. A binary search, as an untrusted header may map all of 2^30
        # quanta to one value.
        quanta = range(self.z_min, self.z_max + 1)
        first = bisect_left(quanta, value, key=self.height_of)
        end = bisect_right(quanta, value, lo=first, key=self.height_of)
        return (quanta[first], quanta[end - 1]) if first < end else (0, -1)

    def height_of(self, quantum: int) -> float | int:
        """Return the raw height of one quantum, as `dequantize` does."""
        product = (quantum + self.base) * self.numerator
        if np.dtype(self.dtype).kind == "f":
            height = np.float64(product) / np.float64(self.denominator)
            return float(np.dtype(self.dtype).type(height))
        if self.denominator != 1:
            product = int(np.rint(np.float64(product) / np.float64(self.denominator)))
        limits = np.iinfo(np.dtype(self.dtype))
        return min(max(product, int(limits.min)), int(limits.max))


# Integers whose common divisor is computed at a time: for most rasters it is 1 after the first
# chunk.
_GCD_CHUNK = 4096


class HeightScan:
    """Range, validity and vertical quantum of a raster, collected window by window.

    Call `update` with every window once, then `quantizer`. With `steps` heights will be rounded to
    these, if all of them can be. A `digest` is updated with it.
    """

    def __init__(
        self, dtype: str, steps: FixedSteps | None = None, digest: HeightDigest | None = None
    ) -> None:
        self.dtype = dtype
        self.steps = steps
        self.digest = digest
        self.has_negative_zeros = False
        self.n_valid = 0
        self.n_samples = 0
        self.minimum: float | int = math.inf
        self.maximum: float | int = -math.inf
        self._gcd = 0
        self._candidates = list(GRID_CANDIDATES)

    @property
    def has_voids(self) -> bool:
        """Return whether any sample so far is void."""
        return self.n_valid < self.n_samples

    def update(
        self, raw: NDArray[np.generic], valid: NDArray[np.bool_], row: int = 0, col: int = 0
    ) -> None:
        """Add one window; only the digest needs its position."""
        self.n_samples += raw.size
        if self.digest is not None:
            self.digest.update(raw, valid, row, col)
        heights = raw.ravel() if valid.all() else raw[valid]
        self.n_valid += heights.size
        if heights.size == 0:
            return
        self.minimum = min(self.minimum, heights.min().item())
        self.maximum = max(self.maximum, heights.max().item())
        if heights.dtype.kind in "iu":
            for first in range(0, heights.size, _GCD_CHUNK):
                if self._gcd == 1:
                    break
                part = heights[first : first + _GCD_CHUNK].astype(np.int64)
                self._gcd = int(np.gcd(self._gcd, np.gcd.reduce(part)))
        else:
            self._narrow_candidates(heights)
            if self.minimum <= 0 <= self.maximum and not self.has_negative_zeros:
                self.has_negative_zeros = bool(np.signbit(heights[heights == 0]).any())
        if self.steps is not None and not self.steps.hold(heights):
            self.steps = None

    def update_even(self, value: np.generic, n_samples: int, *, is_valid: bool) -> None:
        """Add samples of one value, except to a digest, which needs the positions of valid ones."""
        if self.digest is not None and is_valid:
            raise ValueError("a digest needs every valid sample at its place")
        self.update(np.full((1, 1), value, dtype=self.dtype), np.full((1, 1), is_valid))
        self.n_samples += n_samples - 1
        self.n_valid += (n_samples - 1) * is_valid

    def merge(self, other: "HeightScan") -> None:
        """Merge another scan of the same raster."""
        self.n_samples += other.n_samples
        if self.digest is not None and other.digest is not None:
            self.digest.merge(other.digest)
        self.n_valid += other.n_valid
        self.minimum = min(self.minimum, other.minimum)
        self.maximum = max(self.maximum, other.maximum)
        self._gcd = math.gcd(self._gcd, other._gcd)
        self.steps = other.steps and self.steps
        self.has_negative_zeros |= other.has_negative_zeros
        self._candidates = [p for p in self._candidates if p in other._candidates]

    def reaching(self, low: Fraction, high: Fraction) -> "HeightScan":
        """Return a scan of the same raster whose range also holds two heights, in raw units.

        Raises `InvalidHeightsError` if the type of the raster cannot hold them.
        """
        wide = copy(self)
        if not self.n_valid:
            return wide
        dtype = np.dtype(self.dtype)
        limits: Any = np.iinfo(dtype) if dtype.kind in "iu" else np.finfo(dtype)
        if low < Fraction(int(limits.min)) or high > Fraction(int(limits.max)):
            raise InvalidHeightsError(
                f"found `height_range` from {float(low):g} to {float(high):g} (stored units),"
                f" expected heights of {self.dtype}"
            )
        if dtype.kind in "iu":
            wide.minimum = min(self.minimum, math.floor(low))
            wide.maximum = max(self.maximum, math.ceil(high))
        else:
            wide.minimum = min(self.minimum, float(low))
            wide.maximum = max(self.maximum, float(high))
        return wide

    def to_state(self) -> dict[str, Any]:
        """Return the state of the scan, as plain values for JSON."""
        return {
            "counts": [self.n_samples, self.n_valid, self._gcd],
            "range": [self.minimum, self.maximum],
            "candidates": [[p.numerator, p.denominator] for p in self._candidates],
            "holds_steps": self.steps is not None,
            "has_negative_zeros": self.has_negative_zeros,
            "digest": None if self.digest is None else self.digest.text,
        }

    def take_state(self, state: dict[str, Any]) -> None:
        """Continue from the `to_state` of a scan of the same raster."""
        self.n_samples, self.n_valid, self._gcd = state["counts"]
        self.minimum, self.maximum = state["range"]
        self._candidates = [Fraction(*p) for p in state["candidates"]]
        self.steps = self.steps if state["holds_steps"] else None
        self.has_negative_zeros = state["has_negative_zeros"]
        if self.digest is not None:
            self.digest.take(state["digest"])

    def _narrow_candidates(self, heights: NDArray[np.generic]) -> None:
        wide = heights.astype(np.float64)
        passed: list[Fraction] = []
        for p in self._candidates:
            # A multiple of p that holds implies p: both mean the same rational numbers.
            if any((q / p).denominator == 1 for q in passed) or _on_grid(heights, wide, p):
                passed.append(p)
        self._candidates = passed

    def true_quantum(self) -> Fraction | None:
        """Return p if every valid sample is a multiple of it exactly, else None."""
        if self.n_valid == 0:
            return Fraction(1)
        if np.dtype(self.dtype).kind in "iu":
            return Fraction(max(self._gcd, 1))
        if not self._candidates:
            return None
        p = self._candidates[0]
        # Below twice the spacing of the floats themselves every float is "on" a decimal grid.
        if not _is_binary(p) and p < 2 * as_fraction(self._output_ulp()):
            return None
        return p

    def _output_ulp(self) -> float:
        """Return the spacing of `dtype` at the largest absolute height; 0 for integers."""
        if np.dtype(self.dtype).kind != "f":
            return 0.0
        return _spacing(self.dtype, max(abs(self.minimum), abs(self.maximum)))

    def quantizer(
        self,
        max_error: Fraction,
        *,
        may_have_remainders: bool = False,
        is_strict: bool = False,
        side: int = 0,
    ) -> Quantizer:
        """Choose p, base and step for a bound in raw units.

        `is_strict`: the bound applies to the stored floats (`Quantizer.is_strict`), not to the
        multiples of p that they represent. `side`: decoded numbers are never below their originals
        (1) or never above them (-1).

        Raises `InvalidHeightsError` if the bound needs remainders: 0 without a true grid, or too
        small for the range of the heights in 30 bits. The message gives the smallest possible
        bound.
        """
        if self.n_valid == 0:
            return Quantizer(self.dtype, 1, 1, 0, 1, 0.0, 0, 0)
        if side:
            half = self.quantizer(max_error / 2, may_have_remainders=may_have_remainders)
            return _on_one_side(half, max_error, side)
        if self.steps is not None:
            stepped = self._with_quantum(self.steps.step, self.steps.loss, self.steps.loss)
            if stepped.z_max - stepped.z_min < MAX_QUANTA - 1:
                return stepped
        p = self.true_quantum()
        limit = _rounded_down(max_error, self.dtype) if is_strict else max_error
        if p is None or self.span / p >= MAX_QUANTA or not self._fits(p):
            return self._continuous(limit, may_have_remainders)
        plain = self._with_quantum(p, max_error, Fraction(0))
        if max_error == 0 and self.has_negative_zeros and may_have_remainders:
            return replace(plain, remainder_bytes=np.dtype(self.dtype).itemsize)
        if not is_strict or plain.is_strict(float(max_error)):
            return plain
        # On the grid a whole quantum is lost at each end of a bin; off it hardly anything, but half
        # of one, as originals are no longer in the middle.
        narrow_limit = max(limit - as_fraction(plain.float_error), Fraction(0))
        narrow = self._with_quantum(p, narrow_limit, Fraction(0))
        try:
            free = self._continuous(limit, may_have_remainders=False)
        except InvalidHeightsError:
            return narrow
        return max(narrow, free, key=lambda quantizer: quantizer.step * quantizer.quantum)

    def _fits(self, p: Fraction) -> bool:
        return self._largest() / p * p.numerator < _MAX_NUMERATOR

    def _largest(self) -> Fraction:
        """Return the largest absolute height."""
        return max(abs(as_fraction(self.minimum)), abs(as_fraction(self.maximum)))

    def _continuous(self, max_error: Fraction, may_have_remainders: bool) -> Quantizer:
        largest = self._largest()
        if largest > _MAX_HEIGHT:
            raise InvalidHeightsError(
                f"found a height of {float(largest):g} in magnitude, expected at most"
                f" {float(_MAX_HEIGHT):g}; if it marks voids, declare it with `nodata`"
            )
        half_ulp = as_fraction(self._output_ulp()) / 2
        finest, smallest = self._finest(), self.least_bound()
        if max_error < smallest and may_have_remainders:
            return self._exact(finest, half_ulp)
        if max_error < smallest:
            fit = methods_that(lambda method: method.has_remainders)
            raise InvalidHeightsError(
                "these heights lie on no common vertical grid, so this method cannot store them"
                f" losslessly or this exactly: found `max_error` {float(max_error):g}, expected at"
                f" least {rounded_up(smallest)} (raw units), or method {fit}, which can"
            )
        # A bound beyond the range has no benefit, and heights must be exact in float64 before they
        # are rounded to the output's type.
        p = _power_of_two_above(min(max_error, max(self.span, smallest))) / (1 << _FINE_BITS)
        p = max(min(p, _COARSEST_QUANTUM), finest, _power_of_two_above(largest / _MAX_NUMERATOR))
        return self._with_quantum(p, max_error, p / 2 + half_ulp)

    @property
    def span(self) -> Fraction:
        """Return highest less lowest height, in raw units; 0 if none is valid."""
        if not self.n_valid:
            return Fraction(0)
        return as_fraction(self.maximum) - as_fraction(self.minimum)

    def _finest(self) -> Fraction:
        """Return the finest p whose numbers of quanta fit 30 bits; both ends are rounded."""
        return max(_power_of_two_above(self.span / (MAX_QUANTA - 2)), _FINEST_QUANTUM)

    def least_bound(self) -> Fraction:
        """Return the smallest bound without a grid and without remainders, in raw units."""
        return max(self._finest() * (1 << _COARSE_BITS), 2 * as_fraction(self._output_ulp()))

    def _exact(self, finest: Fraction, half_ulp: Fraction) -> Quantizer:
        """Return a quantizer with remainders: quanta are some spacings of the largest float32.

        Of a float64 too, so that values that came from float32 have remainders of few bits.
        """
        spacing = as_fraction(np.spacing(np.float32(float(self._largest()))))
        p = max(_power_of_two_above(spacing) * _REMAINDER_SPACINGS, finest)
        quantizer = self._with_quantum(p, Fraction(0), p / 2 + half_ulp)
        return replace(quantizer, remainder_bytes=np.dtype(self.dtype).itemsize)

    def _with_quantum(self, p: Fraction, max_error: Fraction, rho: Fraction) -> Quantizer:
        # Exact, not as a person reads them: the last bit may decide which step is the nearest.
        number = as_fraction if self.steps is None else Fraction
        low, high = (round(number(end) / p) for end in (self.minimum, self.maximum))
        base = low + (high - low) // 2
        # A bound beyond the range has no benefit; the cap keeps the step within its field.
        half = max(min(math.floor((max_error - rho) / p), high - low), 0)
        return Quantizer(
            self.dtype,
            p.numerator,
            p.denominator,
            base,
            2 * half + 1,
            float(rho),
            low - base,
            high - base,
        )


def _on_one_side(plain: Quantizer, max_error: Fraction, side: int) -> Quantizer:
    """Return a quantizer of half a bound whose heights are moved by that half to one side."""
    if plain.effective_error == 0:
        return plain
    # Off the grid an original lies up to half a quantum from its own, and is rounded to its type.
    half, more = plain.step >> 1, int(plain.rho > 0)
    p, rho = Fraction(plain.numerator, plain.denominator), Fraction(plain.rho)
    while half and (2 * half + more) * p + rho > max_error:
        half -= 1
    lift = side * (half + more)
    return replace(plain, step=2 * half + 1, base=plain.base + lift, lift=lift)


def _spacing(dtype: str, largest: float) -> float:
    return float(np.spacing(np.dtype(dtype).type(largest)))


def _float_error(p: Fraction, spacing: float) -> Fraction:
    """Return how much further the nearest floats may differ than multiples of p."""
    exact = as_fraction(spacing)
    if _is_binary(p) and p >= exact:
        return Fraction(0)
    # Heights are rounded twice: to float64, then to their type.
    return exact * (1 + Fraction(1, 1 << 20))


def _is_binary(p: Fraction) -> bool:
    """Return whether multiples of p are binary fractions."""
    return p.denominator & (p.denominator - 1) == 0


def _rounded_down(bound: Fraction, dtype: str) -> Fraction:
    """Return a bound that no difference exceeds after numpy rounds it to a type."""
    if np.dtype(dtype).kind != "f":
        return bound
    floats = np.dtype(dtype).type
    nearest = floats(min(bound, Fraction(float(np.finfo(dtype).max))))
    if Fraction(float(nearest)) > bound:
        nearest = np.nextafter(nearest, floats(0))
    return Fraction(float(nearest))


def _on_grid(heights: NDArray[np.generic], wide: NDArray[np.float64], p: Fraction) -> bool:
    # A cheap check of a few samples first: most grids fail at once.
    for part, part_wide in ((heights[:64], wide[:64]), (heights, wide)):
        multiples = part_wide * p.denominator / p.numerator
        if not (np.abs(multiples) < _MAX_NUMERATOR / max(p.numerator, 1)).all():
            return False
        products = np.rint(multiples) * p.numerator  # exact: below 2^53
        values = (products / p.denominator).astype(heights.dtype)
        if not np.array_equal(values, part):
            return False
    return True


def rounded_up(value: Fraction) -> str:
    """Return a decimal number of six digits that is not below `value`, for a user to type."""
    upward = Context(prec=6, rounding=ROUND_CEILING)
    return f"{float(upward.divide(Decimal(value.numerator), Decimal(value.denominator))):g}"


def _power_of_two_above(value: Fraction) -> Fraction:
    """Return the smallest power of two >= value (0 for 0)."""
    if value <= 0:
        return Fraction(0)
    power = Fraction(1)
    while power < value:
        power *= 2
    while power / 2 >= value:
        power /= 2
    return power
