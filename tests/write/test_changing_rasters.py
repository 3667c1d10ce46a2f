"""Is a raster that changes while it is compressed told from a fault of ours?"""

import os

import numpy as np
import pytest
from strategies import terrain_like, write_geotiff

import terrainwave
from terrainwave.errors import BoundViolationError, StorageError
from terrainwave.write import compress as module


def compressed(heights, tmp_path, **options):
    return terrainwave.compress(heights, tmp_path / "a.twz", max_error=1, threads=1, **options)


def test_an_array_that_changes_is_named_with_the_window(tmp_path, monkeypatch):
    heights = terrain_like(300, 200)
    own = module.LocalPasses.prove

    def prove(passes, path, job):
        heights[70:90, 20:30] += 9
        return own(passes, path, job)

    monkeypatch.setattr(module.LocalPasses, "prove", prove)
    with pytest.raises(StorageError, match=r"changed in .* compress a copy"):
        compressed(heights, tmp_path)
    assert os.listdir(tmp_path) == []


def test_a_fault_of_ours_stays_one(tmp_path, monkeypatch):
    monkeypatch.setattr("terrainwave.write.passes.proof._largest_error", lambda *_: 9.0)
    with pytest.raises(BoundViolationError, match="this is a fault of terrainwave"):
        compressed(terrain_like(300, 200), tmp_path)


def test_a_file_that_is_written_meanwhile_is_refused(tmp_path, monkeypatch):
    """Even by heights within the bound: nobody knows what else changes."""
    monkeypatch.setattr(module, "MEMORY_LIMIT", 0)
    (tmp_path / "dem").mkdir()
    raster = tmp_path / "dem" / "dem"
    write_geotiff(raster, np.zeros((70, 90), dtype=np.int16))
    own = module.LocalPasses.encode

    def encode(passes, job):
        os.utime(raster, ns=(1, 1))
        return own(passes, job)

    monkeypatch.setattr(module.LocalPasses, "encode", encode)
    with pytest.raises(StorageError, match="dem changed while it was compressed"):
        compressed(raster, tmp_path)
    assert os.listdir(tmp_path) == ["dem"]
