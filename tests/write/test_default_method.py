"""What `auto` is: the same method whatever the raster, another one for archives alone."""

import numpy as np
import pytest

from terrainwave.file import TerrainFile
from terrainwave.write.compress import compress_to_bytes

SHAPE = 300, 280


def smooth():
    rows, cols = np.indices(SHAPE)
    waves = 300 * np.sin(rows / 40) + 200 * np.cos(cols / 33 + rows / 90)
    return np.rint(waves + np.random.default_rng(1).normal(0, 2, SHAPE)).astype(np.int16)


def roofs():
    """Return level ground with boxes of random heights: predictive is 20 % smaller there."""
    rng = np.random.default_rng(2)
    heights = np.full(SHAPE, 100, dtype=np.int16)
    for _ in range(SHAPE[0] * SHAPE[1] // 150):
        row, col = rng.integers(0, SHAPE[0]), rng.integers(0, SHAPE[1])
        n_rows, n_cols = rng.integers(4, 16, 2)
        heights[row : row + n_rows, col : col + n_cols] = 100 + rng.integers(0, 90)
    return heights


def noise():
    return np.random.default_rng(3).normal(0, 300, SHAPE).astype(np.int16)


@pytest.mark.few(3)
@pytest.mark.parametrize("heights", [smooth, roofs, noise])
@pytest.mark.parametrize(
    ("effort", "method"), [("fast", "rapid"), ("default", "rapid"), ("best", "predictive")]
)
def test_auto_is_rapid_on_any_ground_and_predictive_with_effort_best(heights, effort, method):
    raster = heights()
    data = compress_to_bytes(raster, max_error=1, effort=effort)
    with TerrainFile(data) as file:
        assert file.info().method == method
        assert np.abs(file.read().astype(int) - raster).max() <= 1
    named_effort = effort if method == "predictive" else "default"
    assert data == compress_to_bytes(raster, max_error=1, method=method, effort=named_effort)
