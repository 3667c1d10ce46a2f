"""Compression by tasks over subtrees gives the bytes of a local run."""

from concurrent.futures import Executor, Future, ThreadPoolExecutor

import numpy as np
import pytest
from cases import some
from clusters import LosingCluster
from strategies import terrain_like, write_geotiff
from twz import grouped

from terrainwave.container.depot import Depot
from terrainwave.errors import ClusterError, InvalidHeightsError
from terrainwave.grid.quadtree import Grid
from terrainwave.names import METHODS
from terrainwave.write.cluster import task_level
from terrainwave.write.compress import compress

NODATA = -32768
OPTIONS = {"max_error": 1, "block": 32, "overwrite": True}


@pytest.fixture
def cluster():
    with ThreadPoolExecutor(2) as executor:
        yield executor


def with_voids(heights):
    """Return heights with a hole larger than what a task sees around it, and with small ones."""
    rows, cols = np.indices(heights.shape)
    void = (rows > 150) & (rows < 420) & (cols < 60)
    void |= (rows % 97 == 5) & (cols % 53 < 4)
    void |= (rows > 511) & (cols > 511)
    return np.where(void, NODATA, heights).astype(heights.dtype)


# Tasks of blocks of 32 have 512 samples a side.
HEIGHTS = terrain_like(514, 70, seed=5)
RASTERS = {
    "valid": (HEIGHTS, {}),
    "voids": (with_voids(terrain_like(530, 66, seed=6)), {"nodata": NODATA}),
    "four tasks": (with_voids(terrain_like(520, 530, seed=6)), {"nodata": NODATA}),
    "floats": (terrain_like(530, 40, dtype="float32", seed=7), {}),
    "void": (np.full((530, 40), NODATA, "int16"), {"nodata": NODATA}),
    # 257 blocks in a row: a task may have several segments.
    "strip": (terrain_like(8200, 5, seed=8), {}),
    # Tasks begin three levels below the root.
    "deep": (terrain_like(2100, 70, seed=9), {}),
}


def both(tmp_path, cluster, name, **options):
    """Return the bytes of a local and of a distributed run."""
    heights, profile = RASTERS[name]
    source, here, there = (tmp_path / file for file in ("dem.tif", "here.twz", "there.twz"))
    write_geotiff(source, heights, tiled=True, blockxsize=256, blockysize=256, **profile)
    options = grouped(OPTIONS | options)
    compress(source, here, **options)
    size = {"task_samples": 1 << 20 if name == "strip" else 1}
    compress(source, there, client=cluster, **options | size)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dem.tif", "here.twz", "there.twz"]
    return here.read_bytes(), there.read_bytes()


@pytest.mark.few(2)
@pytest.mark.parametrize("name", some(RASTERS, 2))
def test_tasks_give_the_bytes_of_a_local_run(tmp_path, cluster, name):
    here, there = both(tmp_path, cluster, name)
    assert there == here


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "mesh", some(["halves", "none", "zerotree-plain", "zerotree-layer", "rqt"], 2)
)
def test_meshes_are_those_of_a_local_run(tmp_path, cluster, mesh):
    here, there = both(tmp_path, cluster, "voids", mesh=mesh, max_error=3)
    assert there == here


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["voids", "strip"])
def test_measured_meshes_are_those_of_a_local_run(tmp_path, cluster, name):
    here, there = both(tmp_path, cluster, name, measure_meshes=True)
    assert there == here


@pytest.mark.parametrize(
    "meshes", [{"mesh": "rqt"}, {"mesh": "halves", "measure_meshes": True}], ids=["rqt", "halves"]
)
def test_meshes_of_blocks_far_above_the_tasks_are_those_of_a_local_run(tmp_path, cluster, meshes):
    here, there = both(tmp_path, cluster, "deep", **meshes)
    assert there == here


@pytest.mark.few(2)
@pytest.mark.parametrize("method", ["rapid", "predictive", "cdf97", "store"])
def test_other_methods_give_the_bytes_of_a_local_run(tmp_path, cluster, method):
    rings = {"border_rings": 3} if METHODS[method].has_rings else {}
    here, there = both(tmp_path, cluster, "voids", method=method, mesh="none", **rings)
    assert there == here


@pytest.mark.parametrize("mesh", some(["zerotree", "halves"], 2))
def test_a_faithful_file_is_that_of_a_local_run(tmp_path, cluster, mesh):
    options = {"method": "cdf97", "faithful": True, "max_error": 3, "mesh": mesh}
    here, there = both(tmp_path, cluster, "voids", **options)
    assert there == here


@pytest.mark.parametrize(
    ("shape", "task_samples", "level"),
    [
        ((600, 1030), 1, 2),  # k_max 6: segments begin at level 2, 512 samples a side
        ((600, 1030), 512**2, 2),
        ((600, 1030), 512**2 + 1, 2),  # there are no larger ones
        ((8300, 40), 1, 5),
        ((8300, 40), 512**2, 5),
        ((8300, 40), 512**2 + 1, 1),
        ((300, 200), 1, 0),  # k_max 4: one segment below the root's
        ((257, 200), 1, None),  # k_max 3: all is in the top segment
    ],
)
def test_tasks_begin_at_the_finest_segments_that_are_large_enough(shape, task_samples, level):
    assert task_level(Grid(*shape, 32), task_samples) == level


def test_a_raster_without_tasks_is_compressed_here(tmp_path):
    write_geotiff(tmp_path / "dem.tif", HEIGHTS[:20, :30])
    compress(tmp_path / "dem.tif", tmp_path / "here.twz", **OPTIONS)
    compress(tmp_path / "dem.tif", tmp_path / "there.twz", client=LosingCluster(), **OPTIONS)
    assert (tmp_path / "there.twz").read_bytes() == (tmp_path / "here.twz").read_bytes()


class KilledWorker(Exception):
    """Has the name of dask's error."""


class KillingCluster(Executor):
    """Fails every task as dask does where it has killed three workers."""

    def submit(self, function, /, *arguments):
        future = Future()
        future.set_exception(KilledWorker())
        return future


@pytest.mark.parametrize("cluster", [LosingCluster(), KillingCluster()])
def test_a_lost_task_is_one_clear_line_and_the_target_is_untouched(tmp_path, cluster):
    write_geotiff(tmp_path / "dem.tif", terrain_like(300, 40))
    with pytest.raises(ClusterError, match="has lost a task"):
        compress(tmp_path / "dem.tif", tmp_path / "dem.twz", client=cluster, **OPTIONS)
    assert [path.name for path in tmp_path.iterdir()] == ["dem.tif"]


def test_what_workers_cannot_open_is_refused(tmp_path, cluster):
    with pytest.raises(InvalidHeightsError, match="found a ndarray; expected the path or URL"):
        compress(HEIGHTS, tmp_path / "dem.twz", client=cluster)


def test_tiles_are_not_shared_out(tmp_path, cluster):
    with pytest.raises(InvalidHeightsError, match="found method cdf53 and a client"):
        compress(tmp_path / "dem.tif", tmp_path / "dem.twz", client=cluster, method="cdf53")


def test_an_error_of_a_task_is_the_error_of_the_run(tmp_path, cluster):
    heights = terrain_like(300, 40, dtype="float32")
    heights[250, 3] = np.inf
    write_geotiff(tmp_path / "dem.tif", heights)
    with pytest.raises(InvalidHeightsError, match="row 250, column 3 is inf"):
        compress(tmp_path / "dem.tif", tmp_path / "dem.twz", client=cluster, **OPTIONS)
    assert [path.name for path in tmp_path.iterdir()] == ["dem.tif"]


@pytest.mark.full
@pytest.mark.parametrize("more", [{}, {"measure_meshes": True}, {"mesh": "rqt"}])
def test_a_depot_may_be_a_url(tmp_path, cluster, monkeypatch, more):
    from fsspec.implementations.memory import MemoryFileSystem

    remove = Depot.remove

    def remove_known(depot, names):
        """Some stores show late what is there, so all of it must be named."""
        stored = {path.rpartition("/")[2] for path in MemoryFileSystem.store if "twz" in path}
        assert stored
        assert stored <= set(names)
        remove(depot, names)

    monkeypatch.setattr(Depot, "remove", remove_known)
    heights, profile = RASTERS["four tasks"]
    write_geotiff(tmp_path / "dem.tif", heights, **profile)
    options = OPTIONS | more
    compress(tmp_path / "dem.tif", tmp_path / "here.twz", **options)
    url = {"temp_dir": "memory://depot", "task_samples": 1}
    compress(tmp_path / "dem.tif", tmp_path / "there.twz", client=cluster, **url, **options)
    assert (tmp_path / "there.twz").read_bytes() == (tmp_path / "here.twz").read_bytes()
    assert not [path for path in MemoryFileSystem.store if "twz" in path]
    names = ["dem.tif", "here.twz", "there.twz"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
