"""`terrain.check` finds what FORMAT.md asks a verifier to find, and says so once."""

from pathlib import Path

import numpy as np
import pytest
from conformance.editor import Editor
from twz import twz_bytes

import terrainwave

GOLDEN = Path(__file__).parents[1] / "golden" / "v2"


def problems(tmp_path, data):
    path = tmp_path / "file.twz"
    path.write_bytes(data)
    with terrainwave.open(path) as terrain:
        return list(terrain.check())


def test_remainders_that_make_a_height_infinite_are_found(tmp_path):
    (found,) = problems(tmp_path, (GOLDEN / "invalid" / "remainders-infinite.twz").read_bytes())[:1]
    assert "remainders make a height that is not finite" in found


@pytest.mark.parametrize("number", [1, 2])  # below a segment that is there, and beside the edge
def test_a_unit_that_differs_from_an_absent_one_beside_it_is_found(tmp_path, number):
    editor = Editor((GOLDEN / "store-int16-segments.twz").read_bytes())
    assert editor.top.children[number] is not None
    editor.top.children[number] = None
    found = problems(tmp_path, editor.bytes())
    assert found
    assert all("differ in samples that they share" in one for one in found)


@pytest.mark.large
@pytest.mark.parametrize("method", ["store", "cdf53"])
def test_absent_segments_among_others_are_sound(tmp_path, method):
    row, col = np.mgrid[:1060, :1100]
    heights = ((row + col) // 90).astype(np.int16)
    heights[row + col > 1100] = -1
    data = twz_bytes(heights, method=method, block=32, max_error=0, nodata=-1, mesh="none")
    assert not all(Editor(data).top.children)
    assert problems(tmp_path, data) == []
