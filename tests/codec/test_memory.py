"""Memory that threads take turns with."""

import numpy as np
import pytest

from terrainwave.codec import memory as spare
from terrainwave.codec.memory import Spares, flat, new_heights


def test_memory_is_lent_to_one_at_a_time_and_then_again():
    spares = Spares(lambda: np.zeros(3))
    with spares.lent() as first, spares.lent() as second:
        assert first is not second
    with spares.lent() as third, spares.lent() as fourth:
        assert {id(third), id(fourth)} == {id(first), id(second)}


def address_of(heights):
    return heights.__array_interface__["data"][0]


def test_memory_of_heights_is_used_again_when_no_view_refers_to_it():
    recycler = spare._Recycler()
    first = recycler.heights((513, 513))
    assert first.shape == (513, 513)
    assert first.dtype == np.int32
    assert first.flags.c_contiguous
    assert first.flags.writeable
    place, view = address_of(first), first[7:, 3:].T[2]
    del first
    other = recycler.heights((513, 513))
    assert address_of(other) != place
    del view
    assert address_of(recycler.heights((512, 513))) == place


def test_no_more_memory_of_heights_is_kept_than_said():
    recycler = spare._Recycler()
    arrays = [recycler.heights((1024, 1024)) for _ in range(6)]
    assert recycler._n_bytes == 0
    arrays.clear()
    assert recycler._n_bytes == sum(map(len, recycler._spare.values())) << 22 == 1 << 24


@pytest.mark.parametrize("part", [np.s_[:, :], np.s_[2:5, 1:6], np.s_[3:, 4:]])
def test_a_part_of_a_unit_is_seen_in_its_memory(part):
    heights = new_heights((7, 9))
    heights[:] = np.arange(63).reshape(7, 9)
    views = heights[part]
    memory, pitch = flat(views)
    assert np.shares_memory(memory, heights)
    seen = [memory[row * pitch : row * pitch + views.shape[1]] for row in range(views.shape[0])]
    assert np.array_equal(seen, views)
