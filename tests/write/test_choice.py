"""What `auto` takes: from the raster alone."""

import numpy as np
import pytest
from strategies import terrain_like

from terrainwave.file import TerrainFile
from terrainwave.write import choice
from terrainwave.write.compress import compress_to_bytes


def method_of(data):
    with TerrainFile(data) as file:
        return file.info().method


def smooth(shape):
    rows, cols = np.indices(shape)
    waves = 300 * np.sin(rows / 40) + 200 * np.cos(cols / 33 + rows / 90)
    return np.rint(waves + np.random.default_rng(1).normal(0, 2, shape)).astype(np.int16)


def roofs(shape):
    """Return level ground with boxes of random heights."""
    rng = np.random.default_rng(2)
    heights = np.full(shape, 100, dtype=np.int16)
    for _ in range(shape[0] * shape[1] // 150):
        row, col = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        n_rows, n_cols = rng.integers(4, 16, 2)
        heights[row : row + n_rows, col : col + n_cols] = 100 + rng.integers(0, 90)
    return heights


def rough(shape):
    """Return boxes on ground that is rough itself: most bits of a sample are saved by nobody."""
    noise = np.random.default_rng(3).normal(0, 30, shape)
    return np.rint(5 * roofs(shape) + noise).astype(np.int16)


@pytest.mark.parametrize(
    ("heights", "method"), [(smooth, "rapid"), (roofs, "predictive"), (rough, "predictive")]
)
def test_auto_is_the_fast_method_unless_the_other_saves_much(heights, method):
    raster = heights((300, 280))
    data = compress_to_bytes(raster, max_error=1)
    assert method_of(data) == method
    assert data == compress_to_bytes(raster, max_error=1, method=method)
    with TerrainFile(data) as file:
        assert np.abs(file.read().astype(int) - raster).max() <= 1


@pytest.mark.parametrize(
    ("n_saved", "n_bytes", "is_worth"),
    [
        (400, 20_000, True),  # 2 %, 1/8 bit per sample
        (300, 20_000, False),  # 1.5 %, less than 1/8 bit
        (210, 2_500, True),  # 8.4 %, more than 1/16 bit
        (210, 2_700, False),  # 7.8 %
        (190, 1_900, False),  # 10 %, less than 1/16 bit
        (-190, 1_900, False),
    ],
)
def test_what_is_saved_counts_by_share_and_by_sample(n_saved, n_bytes, is_worth):
    assert choice._is_worth(n_saved, n_bytes, 25_600) == is_worth


@pytest.mark.parametrize(
    ("heights", "max_error", "n_tries"),
    [(roofs, 1, 1), (smooth, 1, 0), (roofs, 40, 0)],
)
def test_a_slower_method_is_tried_where_ground_is_rough_and_files_are_not_next_to_nothing(
    monkeypatch, heights, max_error, n_tries
):
    tries = []
    monkeypatch.setattr(choice, "_is_worth", lambda *numbers: tries.append(numbers))
    compress_to_bytes(heights((300, 280)), max_error=max_error)
    assert len(tries) == n_tries


@pytest.mark.parametrize(
    ("n_bytes", "is_rough", "may_be"),
    [
        (1000, True, True),  # a fifth of them, 1/16 bit per sample
        (999, True, False),
        (12_800, False, True),  # 4 bits per sample
        (12_799, False, False),
    ],
)
def test_smooth_ground_must_take_more_for_a_try(n_bytes, is_rough, may_be):
    assert choice._may_be_worth(n_bytes, 25_600, is_rough) == may_be


@pytest.mark.parametrize("method", ["rapid", "predictive"])
def test_auto_gives_the_bytes_of_the_method_on_any_number_of_threads(monkeypatch, method):
    raster = terrain_like(140, 130, seed=4)
    monkeypatch.setattr(choice, "_may_be_worth", lambda *_: True)
    monkeypatch.setattr(choice, "_is_worth", lambda *_: method == "predictive")
    made = {compress_to_bytes(raster, max_error=1, block=32, threads=n) for n in (1, 2)}
    assert made == {compress_to_bytes(raster, max_error=1, block=32, method=method)}


def test_a_raster_without_heights_is_the_fast_method():
    void = np.full((40, 40), -9999, dtype=np.int16)
    assert method_of(compress_to_bytes(void, max_error=1, nodata=-9999)) == "rapid"


def test_efforts_of_auto_are_those_of_its_methods():
    raster = terrain_like(60, 50)
    fast, best = (compress_to_bytes(raster, max_error=1, effort=e) for e in ("fast", "best"))
    assert fast == compress_to_bytes(raster, max_error=1, method="rapid")
    assert best == compress_to_bytes(raster, max_error=1, method="predictive", effort="best")
