"""The digest of heights: the same for all ways of reading, another one for any change."""

import numpy as np
import pytest

from terrainwave.grid.digest import HeightDigest

SHAPE = (301, 257)


def splitmix(word):
    """Return the finaliser of splitmix64, with Python's whole numbers."""
    word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9 % 2**64
    word = (word ^ word >> 27) * 0x94D049BB133111EB % 2**64
    return word ^ word >> 31


def by_hand(heights, valid):
    total = 0
    bits = heights.view(f"u{heights.dtype.itemsize}")
    for place in np.flatnonzero(valid).tolist():
        mixed = splitmix((place + 1) * 0x9E3779B97F4A7C15 % 2**64)
        total += splitmix(mixed ^ int(bits.flat[place]))
    return f"{total % 2**64:016x}"


def digest_of(heights, valid, windows=None):
    digest = HeightDigest(heights.shape[1])
    for row, col, n_rows, n_cols in windows or [(0, 0, *heights.shape)]:
        part = np.s_[row : row + n_rows, col : col + n_cols]
        digest.update(heights[part], valid[part], row, col)
    return digest.text


def raster(dtype, seed=0):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 200, SHAPE).astype(dtype), rng.random(SHAPE) > 0.1


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "int32", "float32", "float64"])
def test_it_is_the_sum_that_the_format_describes(dtype):
    heights, valid = raster(dtype)
    assert digest_of(heights, valid) == by_hand(heights, valid)


def test_it_does_not_depend_on_the_windows_or_their_order():
    heights, valid = raster("float32")
    whole = digest_of(heights, valid)
    rng = np.random.default_rng(1)
    for n_rows, n_cols in [(1, 257), (301, 1), (64, 64), (7, 200), (300, 256)]:
        windows = [
            (row, col, min(n_rows, SHAPE[0] - row), min(n_cols, SHAPE[1] - col))
            for row in range(0, SHAPE[0], n_rows)
            for col in range(0, SHAPE[1], n_cols)
        ]
        rng.shuffle(windows)
        assert digest_of(heights, valid, windows) == whole
        parts = [HeightDigest(SHAPE[1]) for _ in range(3)]
        for number, (row, col, *shape) in enumerate(windows):
            part = np.s_[row : row + shape[0], col : col + shape[1]]
            parts[number % 3].update(heights[part], valid[part], row, col)
        parts[0].merge(parts[1])
        parts[2].merge(parts[0])
        assert parts[2].text == whole


def test_wide_rasters_are_summed_in_parts():
    heights = np.arange(70_000, dtype=np.int32).reshape(2, -1)
    valid = heights % 3 > 0
    assert digest_of(heights, valid) == by_hand(heights, valid)


def test_any_change_changes_it():
    heights, valid = raster("float64")
    found = {digest_of(heights, valid)}
    changes = 0
    for row, col in [(0, 0), (150, 128), (300, 256)]:
        for value in (heights[row, col] + 1, np.nextafter(heights[row, col], 1e9), -1.0):
            changed, is_valid = heights.copy(), valid.copy()
            changed[row, col], is_valid[row, col] = value, True
            found.add(digest_of(changed, is_valid))
            changes += 1
    signs, everywhere = np.zeros(SHAPE), np.ones(SHAPE, dtype=bool)
    found |= {digest_of(signs, everywhere), digest_of(-signs, everywhere)}
    found |= {digest_of(heights.T.copy(), valid.T), digest_of(heights[::-1], valid[::-1])}
    turned = heights.copy()
    turned[0, :2] = heights[0, 1::-1] + [0.5, 0]
    found.add(digest_of(turned, valid))
    assert len(found) == 1 + changes + 5


def test_what_voids_hold_does_not_count():
    heights, valid = raster("float32")
    assert digest_of(np.where(valid, heights, np.float32(np.nan)), valid) == digest_of(
        heights, valid
    )
