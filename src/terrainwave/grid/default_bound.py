"""Default bound of heights without a vertical grid, derived from unit and range."""

from fractions import Fraction
from typing import NamedTuple

from terrainwave.grid.quantum import as_fraction

# Metres; or the heights' own unit if that is unknown.
_USUAL = Fraction(1, 100)
# Shares of the range of heights: the bound if the usual one has no meaning, and the upper limit of
# the usual one for heights in a unit of length.
_SHARE, _MOST = Fraction(1, 10_000), Fraction(1, 100)


class DefaultBound(NamedTuple):
    """A bound in physical units, and the reason for it."""

    error: Fraction
    reason: str


def default_bound(span: Fraction, unit: str | None, length: float | None) -> DefaultBound:
    """Return the bound of heights without a vertical grid; 0 if all are equal.

    Parameters
    ----------
    span : Fraction
        Highest less lowest height, in physical units.
    unit : str, optional
        Their unit, if known.
    length : float, optional
        Metres of the unit, if it is one of length.
    """
    if span == 0:
        return DefaultBound(span, "all heights are the same")
    if unit is not None and length is None:
        return DefaultBound(span * _SHARE, f"{unit} is no known length: a 10,000th of the range")
    usual = _USUAL if length is None else _USUAL / as_fraction(length)
    if usual <= span * (_SHARE if length is None else _MOST):
        metres = "" if usual == _USUAL else "this is 0.01 m, and "
        return DefaultBound(usual, f"{metres}the heights lie on no vertical grid")
    rounded = "a 10,000th of the range, rounded down"
    if length is None:
        return DefaultBound(
            _rounded_down(span * _SHARE), f"no unit is named, and 0.01 is more than {rounded}"
        )
    why = f"0.01 m is more than 1 % of the range: {rounded}"
    return DefaultBound(_rounded_down(span * _SHARE), why)


def _rounded_down(value: Fraction) -> Fraction:
    """Return the largest 1, 2 or 5 times a power of ten that is not above `value`, which is > 0."""
    power = Fraction(1)
    while power > value:
        power /= 10
    while power * 10 <= value:
        power *= 10
    return max(power * digit for digit in (1, 2, 5) if power * digit <= value)
