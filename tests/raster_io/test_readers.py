"""Several threads read a raster at a time: which rasters, and of what bytes."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import rasterio
from strategies import terrain_like, write_geotiff

from terrainwave.grid.quadtree import Region
from terrainwave.raster_io.dataset import DatasetBackend
from terrainwave.raster_io.source import RasterSource

HEIGHTS = terrain_like(40, 50)


@pytest.fixture
def path(tmp_path):
    return write_geotiff(tmp_path / "a.tif", HEIGHTS)


def read_at_once(monkeypatch, source, n_threads, timeout=20):
    """Return what threads read; each read waits until all of them are reading."""
    together, read = threading.Barrier(n_threads, timeout=timeout), DatasetBackend.read

    def meet(*arguments):
        together.wait()
        return read(*arguments)

    monkeypatch.setattr(DatasetBackend, "read", meet)
    with ThreadPoolExecutor(n_threads) as pool:
        return [
            heights for heights, _ in pool.map(source.read, *zip(*[(0, 0, 40, 50)] * n_threads))
        ]


def test_three_threads_read_a_geotiff_at_a_time(monkeypatch, path):
    with RasterSource(path) as source:
        for _ in range(2):
            found = read_at_once(monkeypatch, source, 3)
            monkeypatch.undo()
            for heights in found:
                np.testing.assert_array_equal(heights, HEIGHTS)
        assert source.n_bytes_read == 6 * HEIGHTS.nbytes


def test_one_thread_opens_a_file_once(monkeypatch, path):
    monkeypatch.setattr(DatasetBackend, "again", lambda _: pytest.fail("opened again"))
    with RasterSource(path) as source:
        for _ in range(3):
            source.read(0, 0, 40, 50)


def test_all_that_was_opened_is_closed(monkeypatch, path):
    closed, close = [], DatasetBackend.close
    monkeypatch.setattr(DatasetBackend, "close", lambda own: (closed.append(own), close(own)))
    with RasterSource(path) as source:
        read_at_once(monkeypatch, source, 3)
    assert len({id(own) for own in closed}) == 3


def another_of_its_name(path):
    write_geotiff(path.with_name("b.tif"), HEIGHTS + 1)
    os.replace(path.with_name("b.tif"), path)


def changed(path):
    with rasterio.open(path, "r+") as dataset:
        dataset.write(HEIGHTS + 1, 1)
    os.utime(path, ns=(1, 1))


@pytest.mark.parametrize("change", [another_of_its_name, changed, os.unlink])
def test_a_file_that_is_another_one_now_is_not_opened_again(path, change):
    backend = DatasetBackend(rasterio.open(path), 1, owned=True)
    again = backend.again()
    assert again is not None
    again.close()
    change(path)
    assert backend.again() is None
    backend.close()


def test_what_may_differ_is_not_opened_again(tmp_path, path):
    with rasterio.open(path) as dataset:  # opened by somebody else, who may write to it
        assert DatasetBackend(dataset, 1, owned=False).again() is None
    with rasterio.open(path, "r+") as dataset:
        dataset.write_mask(HEIGHTS > 0)
    backend = DatasetBackend(rasterio.open(path), 1, owned=True)
    assert backend.has_mask
    assert backend.again() is None
    backend.close()


def test_without_room_for_another_one_threads_take_turns(monkeypatch, path):
    monkeypatch.setattr(DatasetBackend, "again", lambda _: None)
    with RasterSource(path) as source, ThreadPoolExecutor(3) as pool:
        for heights, _ in pool.map(source.read, *zip(*[(0, 0, 40, 50)] * 12)):
            np.testing.assert_array_equal(heights, HEIGHTS)
        with pytest.raises(threading.BrokenBarrierError):
            read_at_once(monkeypatch, source, 2, timeout=0.2)


def test_blocks_without_bytes_are_known_to_all(tmp_path):
    path = tmp_path / "sparse.tif"
    shape = {"width": 64, "height": 64, "tiled": True, "blockxsize": 32, "blockysize": 32}
    with rasterio.open(
        path, "w", "GTiff", count=1, dtype="int16", nodata=-7, sparse_ok=True, **shape
    ) as dataset:
        dataset.write(np.ones((32, 32), "int16"), 1, window=((0, 32), (0, 32)))
    first = DatasetBackend(rasterio.open(path), 1, owned=True)
    gap = Region(32, 32, 32, 32)
    assert first.even(gap).value == -7
    other = first.again()
    first.close()
    assert other.even(gap).value == -7
    assert other.even(Region(0, 0, 64, 64)) is None
    other.close()
