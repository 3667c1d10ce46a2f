"""Memory that threads take turns with."""

import numpy as np
import pytest

from terrainwave.codec.spare import Spares


def test_memory_is_lent_to_one_at_a_time_and_then_again():
    spares = Spares(lambda: np.zeros(3))
    with spares.lent() as first, spares.lent() as second:
        assert first is not second
    with spares.lent() as third, spares.lent() as fourth:
        assert {id(third), id(fourth)} == {id(first), id(second)}


def test_memory_comes_back_after_an_error():
    spares = Spares(lambda: np.zeros(3))
    with pytest.raises(KeyError), spares.lent() as first:
        raise KeyError
    with spares.lent() as second:
        assert second is first
