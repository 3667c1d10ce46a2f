"""Compression by tasks over subtrees gives the bytes of a local run (DESIGN §3.10)."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from strategies import terrain_like, write_geotiff

from terrainwave.compression import compress

NODATA = -32768
OPTIONS = {"max_error": 1, "block": 32, "overwrite": True}


@pytest.fixture
def cluster():
    with ThreadPoolExecutor(2) as executor:
        yield executor


def with_voids(heights):
    """Return heights with a hole beyond what a task sees, small ones, and a void task."""
    rows, cols = np.indices(heights.shape)
    void = (rows - 250) ** 2 + (cols - 300) ** 2 < 100**2
    void |= (rows % 97 == 5) & (cols % 53 < 4)
    void |= (rows > 511) & (cols > 511)
    return np.where(void, NODATA, heights).astype(heights.dtype)


# 3 x 2 tasks; the last row of them holds one row of samples.
HEIGHTS = terrain_like(1025, 600, seed=5)
VOIDS = with_voids(terrain_like(600, 1030, seed=6))
RASTERS = {
    "valid": (HEIGHTS, {}),
    "voids": (VOIDS, {"nodata": NODATA}),
    "floats": (terrain_like(600, 530, dtype="float32", seed=7), {}),
    "void": (np.full((600, 530), NODATA, "int16"), {"nodata": NODATA}),
    # Tasks of five segments: a strip of 259 blocks.
    "strip": (terrain_like(8300, 40, seed=8), {}),
}


def both(tmp_path, cluster, name, **options):
    """Return the bytes of a local and of a distributed run."""
    heights, profile = RASTERS[name]
    source, here, there = (tmp_path / file for file in ("dem.tif", "here.twz", "there.twz"))
    write_geotiff(source, heights, tiled=True, blockxsize=256, blockysize=256, **profile)
    compress(source, here, **OPTIONS | options)
    size = {"task_samples": 1 << 20 if name == "strip" else 1}
    compress(source, there, client=cluster, **OPTIONS | size | options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dem.tif", "here.twz", "there.twz"]
    return here.read_bytes(), there.read_bytes()


@pytest.mark.large
@pytest.mark.parametrize("name", list(RASTERS))
def test_tasks_give_the_bytes_of_a_local_run(tmp_path, cluster, name):
    here, there = both(tmp_path, cluster, name)
    assert there == here


@pytest.mark.large
@pytest.mark.parametrize("mesh", ["none", "halves", "zerotree", "rqt"])
def test_meshes_are_those_of_a_local_run(tmp_path, cluster, mesh):
    here, there = both(tmp_path, cluster, "voids", mesh=mesh, max_error=3)
    assert there == here


@pytest.mark.large
@pytest.mark.parametrize("method", ["cdf97", "store"])
def test_other_methods_give_the_bytes_of_a_local_run(tmp_path, cluster, method):
    here, there = both(tmp_path, cluster, "voids", method=method, border_rings=3, mesh="none")
    assert there == here
