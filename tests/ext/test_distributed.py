"""Compression on a dask cluster of processes, one of them killed."""

import os
import signal

import pytest
from click.testing import CliRunner
from strategies import terrain_like, write_geotiff

from terrainwave.cli import main
from terrainwave.ext import distributed as ext_distributed
from terrainwave.write.compress import compress

OPTIONS = {"max_error": 1, "block": 32, "overwrite": True}
# Two blocks of 512 samples a side, two rows of samples below them: four tasks.
HEIGHTS = terrain_like(514, 600, seed=3)

pytestmark = [
    pytest.mark.large,
    pytest.mark.full,
    # A killed worker leaves open what it had open.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        dashboard_address=":0",
        local_directory=str(tmp_path_factory.mktemp("workers")),
    ) as cluster:
        yield cluster


@pytest.fixture
def client(cluster):
    with ext_distributed.connected(cluster.scheduler_address) as client:
        client.wait_for_workers(2)
        yield client


@pytest.fixture
def raster(tmp_path):
    write_geotiff(tmp_path / "dem.tif", HEIGHTS)
    return tmp_path / "dem.tif"


def test_a_worker_killed_in_the_middle_is_survived(client, raster, tmp_path):
    compress(raster, tmp_path / "here.twz", **OPTIONS)
    killed = []

    def kill(progress):
        if progress.stage == "encoding" and not killed:
            process = min(client.run(os.getpid).values())
            os.kill(process, signal.SIGKILL)
            killed.append(process)

    compress(raster, tmp_path / "there.twz", client=client, progress=kill, **OPTIONS)
    assert len(killed) == 1
    assert killed[0] not in client.run(os.getpid).values()
    assert (tmp_path / "there.twz").read_bytes() == (tmp_path / "here.twz").read_bytes()


def test_the_command_takes_the_address_of_a_scheduler(client, cluster, raster, tmp_path):
    arguments = ["compress", raster, tmp_path / "dem.twz", "--max-error", 1, "--block", 32, "-q"]
    arguments += ["--mesh", "rqt", "--scheduler", cluster.scheduler_address]
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert (result.exit_code, result.output) == (0, "")
    compress(raster, tmp_path / "here.twz", mesh="rqt", **OPTIONS)
    assert (tmp_path / "dem.twz").read_bytes() == (tmp_path / "here.twz").read_bytes()


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense"])
def test_a_scheduler_that_does_not_answer_is_one_line(monkeypatch, raster, tmp_path, address):
    monkeypatch.setattr(ext_distributed, "_TIMEOUT", 0.5)
    arguments = ["compress", raster, tmp_path / "dem.twz", "--scheduler", address]
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert result.exit_code == 1
    assert result.stderr.startswith(f"terrainwave: no dask scheduler answers at {address}")
    assert result.stderr.count("\n") == 1
