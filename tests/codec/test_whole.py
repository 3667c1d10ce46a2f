"""Masks of units without voids."""

import numpy as np
import pytest

from terrainwave.codec.memory import new_heights
from terrainwave.codec.rapid.refiner import _flat
from terrainwave.codec.whole import all_valid, is_whole


def test_masks_without_voids_are_whole_and_so_are_their_parts():
    mask = all_valid((7, 9))
    assert mask.shape == (7, 9)
    assert mask.all()
    assert is_whole(mask)
    assert is_whole(mask[2:, 3:5])
    with pytest.raises(ValueError, match="read-only"):
        mask[0, 0] = False


def test_other_masks_are_looked_at_and_so_is_one_older_than_a_larger():
    small = all_valid((3, 3))
    larger = all_valid((2000, 1000))
    assert is_whole(small)
    assert is_whole(larger)
    assert is_whole(np.ones((3, 3), dtype=np.bool_))
    assert not is_whole(np.array([[True, False]]))


@pytest.mark.parametrize("part", [np.s_[:, :], np.s_[2:5, 1:6], np.s_[3:, 4:]])
def test_a_part_of_a_unit_is_seen_in_its_memory(part):
    heights = new_heights((7, 9))
    heights[:] = np.arange(63).reshape(7, 9)
    views = heights[part]
    flat, pitch = _flat(views)
    assert np.shares_memory(flat, heights)
    seen = [flat[row * pitch : row * pitch + views.shape[1]] for row in range(views.shape[0])]
    assert np.array_equal(seen, views)


def test_parts_of_other_arrays_are_copied():
    heights = np.arange(63, dtype=np.int32).reshape(7, 9).copy()
    for views in (heights[1:, 2:], heights[::2, ::2], heights.T):
        flat, pitch = _flat(views)
        assert not np.shares_memory(flat, heights)
        assert np.array_equal(flat.reshape(-1, pitch), views)
