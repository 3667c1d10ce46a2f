"""Is a file in memory the file on disk?"""

import numpy as np
import pytest
from strategies import terrain_like

import terrainwave
from terrainwave.container.digests import TileDigests
from terrainwave.errors import InvalidHeightsError


def test_bytes_are_those_of_the_file(tmp_path):
    heights = terrain_like(40, 70)
    heights[3:9, 5:50] = -1
    options = {"max_error": 1, "nodata": -1, "block": 32, "mesh": "none", "method": "store"}
    terrainwave.compress(heights, tmp_path / "a.twz", digest=False, **options)
    assert terrainwave.compress_to_bytes(heights, **options) == (tmp_path / "a.twz").read_bytes()


def test_bytes_are_proved_like_a_file(monkeypatch):
    from terrainwave.write.local import LocalPasses

    proved = []

    def prove(_, file, *rest):
        proved.append(file)
        return 0.0, TileDigests((9, 9))

    monkeypatch.setattr(LocalPasses, "prove", prove)
    data = terrainwave.compress_to_bytes(terrain_like(9, 9))
    assert proved == [data]


def test_bytes_open_as_a_terrain():
    heights = terrain_like(20, 20)
    with terrainwave.open(terrainwave.compress_to_bytes(heights, max_error=0)) as terrain:
        np.testing.assert_array_equal(terrain.read(), heights)


def test_bad_option_is_refused():
    with pytest.raises(InvalidHeightsError, match="found max_error -1"):
        terrainwave.compress_to_bytes(np.zeros((2, 2), np.int16), max_error=-1)
