"""Values that look like undeclared voids, also where they hide each other."""

import numpy as np
import pytest

from terrainwave.raster_io.source import RasterSource
from terrainwave.raster_io.undeclared_voids import note_on_marks


def named(values, dtype="int32", low=100, high=900):
    """Return the values that notes name, of heights from `low` to `high` with these among them."""
    heights = np.linspace(low, high, 64 * 64).reshape(64, 64).astype(dtype)
    for row, value in enumerate(values):
        heights[2 * row, :5] = value
    with RasterSource(heights) as source:
        notes = note_on_marks(source, float(heights.min()), float(heights.max()))
    assert all(note.startswith("5 heights are ") for note in notes)
    return [float(note.rsplit(" ", 1)[1]) for note in notes]


@pytest.mark.parametrize("dtype", ["int32", "float32", "float64"])
@pytest.mark.parametrize(
    "values",
    [
        (-32768, -32767),
        (-32768, -32767, -32766, -32765, -32764),  # ISIS: five kinds of unknown heights
        (-9999, -9998),
        (-32768, -9999),
        (-32768, 32767),
        (32767, 65535),
        (-999999, -99999),
    ],
)
def test_marks_that_hide_each_other_are_all_named(dtype, values):
    assert named(values, dtype) == sorted(values)


def test_zeros_do_not_hide_a_mark():
    # 65535 - 40000 is less than 40000 - 0.
    assert named((0, 65535), "uint16", 30000, 40000) == [65535]


@pytest.mark.parametrize("dtype", ["int32", "float64"])
def test_ends_of_int32_are_marks(dtype):
    assert named((-2147483648,), dtype) == [-2147483648]


def test_values_next_to_a_mark_are_heights_without_it():
    assert named((-9998, -9997)) == []


def test_heights_that_reach_a_mark_are_no_voids():
    assert named((-32768, -32767), low=-32760) == []
    assert named((), low=9000, high=9999) == []
