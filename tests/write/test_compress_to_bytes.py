"""Is a file in memory the file on disk?"""

from strategies import terrain_like

import terrainwave
from terrainwave.container.digests import TileDigests


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
