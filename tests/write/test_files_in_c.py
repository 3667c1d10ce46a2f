"""Do files that the native library encodes have the bytes of those that numba's kernels make?

`benchmarks.both_encoders` draws the rasters; `make long` compares 500, up to 3000 x 2000.
"""

import sys
from unittest.mock import patch

import numpy as np
import pytest
from golden_files import GOLDEN

import terrainwave
from benchmarks.both_encoders import Drawn, compare, compressed, drawn_raster
from terrainwave.coding import native_library
from terrainwave.reference.units import decode

sys.path.append(str(GOLDEN.parents[1] / "tools"))
import make_golden

pytestmark = [pytest.mark.native, pytest.mark.full]
MOST = 600, 500


@pytest.mark.parametrize("part", range(8))
def test_random_rasters_make_the_same_files(part, with_library):
    rows = [compare(number, MOST) for number in range(part, 96, 8)]
    assert [row for row in rows if not row.is_same] == []
    assert [row.outcome for row in rows if row.outcome] == []


def test_files_of_the_library_decode_by_the_text_of_the_format(with_library):
    """The reference decoder shares nothing with it."""
    for number in range(12):
        drawn = drawn_raster(number, (48, 64))
        data = compressed(drawn, in_c=True)
        with terrainwave.open(data) as terrain:
            heights, valid = terrain.read_with_mask()
        found, found_valid = decode(data)
        np.testing.assert_array_equal(found_valid, valid)
        np.testing.assert_array_equal(found[valid], heights[valid])
        apart = found[valid].astype(np.float64) - drawn.heights[valid].astype(np.float64)
        assert np.abs(apart).max(initial=0) <= drawn.options["max_error"] * (1 + 1e-6)


@pytest.mark.filterwarnings("ignore:.*near the radius of the body")  # of 32 bits
@pytest.mark.parametrize("part", range(4))
def test_golden_files_are_made_the_same(part, with_library, tmp_path):
    """All that are compressed from a raster: of each method, patched ones among them."""
    for name in sorted(make_golden.CASES)[part::4]:
        made = []
        for in_c in (False, True):
            path = tmp_path / f"{name}-{in_c}.twz"
            with patch.object(native_library, "is_used", lambda in_c=in_c: in_c):
                make_golden.write_case(path, *make_golden.CASES[name])
            made.append(path.read_bytes())
        assert made[0] == made[1], name


def test_heights_that_are_not_finite_make_the_same_files(with_library):
    rng = np.random.default_rng(7)
    heights = rng.normal(size=(90, 70)).astype(np.float32)
    heights[::7, ::5] = np.nan
    heights[::11] = -np.inf
    heights[3] = np.finfo(np.float32).smallest_subnormal
    drawn = Drawn(heights, {"max_error": 0.01, "nodata": -np.inf})
    data = compressed(drawn, in_c=True)
    assert data == compressed(drawn, in_c=False)
    assert isinstance(data, bytes)
    with terrainwave.open(data) as terrain:
        assert np.abs(terrain.read()[3, 1:4]).max() <= 0.01
