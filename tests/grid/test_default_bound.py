"""The bound that heights on no vertical grid get where none is named; expected by hand."""

from fractions import Fraction

import pytest

from terrainwave.grid.default_bound import default_bound


@pytest.mark.parametrize(
    ("span", "unit", "length", "error", "reason"),
    [
        ("800", "m", 1.0, "0.01", "no vertical grid"),
        ("1", "m", 1.0, "0.01", "no vertical grid"),  # 1 % of it
        ("0.999", "m", 1.0, "0.00005", "more than 1 %"),
        ("0.008", "m", 1.0, "0.0000005", "more than 1 %"),
        ("2", "km", 1000.0, "0.00001", "this is 0.01 m"),
        ("9000", "mm", 0.001, "10", "this is 0.01 m"),
        ("8", "mm", 0.001, "0.0005", "more than 1 %"),
        ("100", None, None, "0.01", "no vertical grid"),
        ("99.9", None, None, "0.005", "rounded down"),
        ("0.000004", None, None, "0.0000000002", "rounded down"),
        ("0.035", "m/yr", None, "0.0000035", "m/yr is no known length"),
        ("360", "degrees", None, "0.036", "degrees is no known length"),
        ("0", "m", 1.0, "0", "the same"),
        ("0", "K", None, "0", "the same"),
    ],
)
def test_the_bound_follows_from_range_and_unit(span, unit, length, error, reason):
    found = default_bound(Fraction(span), unit, length)
    assert found.error == Fraction(error)
    assert reason in found.reason
