"""What a file keeps of where it comes from, and whether it is still that."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from strategies import terrain_like, write_geotiff
from twz import grouped

import terrainwave
from terrainwave.write.origin import difference

OPTIONS = {"method": "store", "block": 32, "mesh": "none", "max_error": 0}


@pytest.fixture
def raster(tmp_path):
    return write_geotiff(tmp_path / "a.tif", terrain_like(200, 300))


def origin_in(path):
    with terrainwave.open(path) as terrain:
        return terrain.header.metadata.get("origin")


def test_only_what_is_asked_to_keeps_it(tmp_path, raster):
    terrainwave.compress(raster, tmp_path / "plain.twz", **OPTIONS)
    terrainwave.compress(raster, tmp_path / "kept.twz", keep_origin=True, **OPTIONS)
    assert origin_in(tmp_path / "plain.twz") is None
    assert origin_in(tmp_path / "kept.twz")["options"]["max_error"] == 0
    for name in ("plain", "kept"):
        with terrainwave.open(tmp_path / f"{name}.twz") as terrain:
            assert np.array_equal(terrain.read(), terrain_like(200, 300))
    assert difference(tmp_path / "kept.twz", raster, **OPTIONS) is None
    found = difference(tmp_path / "plain.twz", raster, **OPTIONS)
    assert found == "it does not say what it was made of"


def test_it_is_the_same_by_threads_windows_and_on_a_cluster(tmp_path, raster):
    import rasterio.shutil

    tiled = tmp_path / "tiled.tif"
    rasterio.shutil.copy(raster, tiled, tiled=True, blockxsize=64, blockysize=16, driver="GTiff")
    files = []
    for source in (raster, tiled):
        for threads in (1, 3):
            path = tmp_path / f"{source.stem}{threads}.twz"
            terrainwave.compress(source, path, keep_origin=True, threads=threads, **OPTIONS)
            files.append(path.read_bytes())
    with ThreadPoolExecutor(2) as executor:
        path = tmp_path / "cluster.twz"
        terrainwave.compress(
            tiled, path, keep_origin=True, client=executor, task_samples=64, **OPTIONS
        )
    files.append(path.read_bytes())
    terrainwave.compress(terrain_like(200, 300), path, overwrite=True, keep_origin=True, **OPTIONS)
    assert origin_in(path) == origin_in(tmp_path / "tiled1.twz")
    assert len(set(files)) == 1


@pytest.mark.parametrize(
    "other", [{"max_error": None}, {"max_error": 0.5}, {"verify": False}, {"faithful": True}]
)
def test_other_options_are_seen_without_reading(tmp_path, raster, other):
    terrainwave.compress(raster, tmp_path / "a.twz", keep_origin=True, **OPTIONS)
    asked = grouped(OPTIONS | other | ({"method": "cdf97"} if "faithful" in other else {}))
    found = difference(tmp_path / "a.twz", tmp_path / "none.tif", **asked)
    assert found == "it was made with other options"


@pytest.mark.parametrize("value", [None, 5, "x", [], {"heights": 3}, {"options": []}])
def test_readers_take_any_value(tmp_path, raster, value, monkeypatch):
    """Nothing is decoded by it."""
    from terrainwave.write import job

    monkeypatch.setattr(job, "origin_of", lambda options, scan: value)
    terrainwave.compress(raster, tmp_path / "a.twz", keep_origin=True, **OPTIONS)
    monkeypatch.undo()
    assert origin_in(tmp_path / "a.twz") == value
    assert difference(tmp_path / "a.twz", raster, **OPTIONS) is not None
