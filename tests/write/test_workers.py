"""Tasks that fail on one worker are done by another."""

import errno
import itertools
import os
import threading
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor

import pytest
from clusters import LosingCluster

from terrainwave.container.spool import TEMPORARY_ADVICE, cannot_write
from terrainwave.errors import ClusterError, StorageError, TerrainwaveWarning
from terrainwave.write.tasks import workers
from terrainwave.write.tasks.task import Workplace
from terrainwave.write.tasks.workers import Workers

TASKS = {number: (number,) for number in range(6)}


class Client:
    """Has the parts of a dask client that are used, and workers that are threads.

    `broken` are workers on which tasks raise `error`.
    """

    def __init__(self, names, broken=(), error=None, slow=()):
        self.names = list(names)
        self.broken, self.error, self.slow = set(broken), error, set(slow)
        self.given = []  # (key, worker)
        self.release = threading.Event()
        self._pool = ThreadPoolExecutor(32)
        self._turn = 0

    def get_executor(self, **options):
        return ClientExecutor(self)

    def nthreads(self):
        return dict.fromkeys(self.names, 1)

    def close(self):
        self.release.set()
        self._pool.shutdown()


class ClientExecutor(Executor):
    def __init__(self, client):
        self._client = client

    def submit(self, function, /, *arguments, key, workers=None, allow_other_workers=None):
        client = self._client
        if not workers or allow_other_workers:  # for an idle worker may steal it
            workers = client.names
        choice = [name for name in workers if name in client.names]
        if not choice:
            return Future()  # waits for a worker that is allowed
        worker = choice[client._turn % len(choice)]
        client._turn += 1
        client.given.append((key, worker))
        return client._pool.submit(self._run, worker, function, arguments)

    def _run(self, worker, function, arguments):
        if worker in self._client.slow:
            self._client.release.wait(20)
        here.worker, here.client = worker, self._client
        return function(*arguments)


here = threading.local()


def squared(number):
    if here.worker in here.client.broken:
        raise here.client.error
    return number**2


@pytest.fixture
def make_client(monkeypatch):
    monkeypatch.setattr(
        "terrainwave.write.tasks.task.workplace",
        lambda: Workplace(here.worker, f"host of {here.worker}", f"/scratch/{here.worker}"),
    )
    monkeypatch.setattr(workers, "_LOOK_AFTER", 0.02)
    made = []

    def make(*args, **more):
        made.append(Client(*args, **more))
        return made[-1]

    yield make
    for client in made:
        client.close()


def run(client):
    return dict(Workers(client).run("encoding", squared, TASKS))


def full():
    return cannot_write("/scratch", OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
                        advice=TEMPORARY_ADVICE)  # fmt: skip


def test_tasks_of_a_full_disk_are_done_by_another_worker_and_one_note_says_so(make_client):
    client = make_client(["a", "b", "c"], broken=["b"], error=full())
    with pytest.warns(TerrainwaveWarning) as notes:
        assert run(client) == {number: number**2 for number in TASKS}
    (note,) = notes
    assert str(note.message) == (
        "the worker b on host of b, with temporary files in /scratch/b, fails: cannot write"
        " /scratch: the disk is full; free space there, or start the worker with --local-directory"
        " on a larger disk; others do its tasks again"
    )


@pytest.mark.filterwarnings("ignore::terrainwave.TerrainwaveWarning")
def test_an_error_of_all_workers_names_one_with_its_folder(make_client):
    client = make_client(["a", "b"], broken=["a", "b"], error=full())
    with pytest.raises(
        StorageError,
        match=r"the disk is full; .*--local-directory on a larger disk; found by the worker [ab] on"
        r" host of [ab], with temporary files in /scratch/[ab], and by 1 other worker before,"
        r" while encoding",
    ):
        run(client)


def test_what_no_other_worker_can_mend_is_not_repeated(make_client):
    client = make_client(["a", "b"], broken=["a", "b"], error=ValueError("of the heights"))
    with pytest.raises(ValueError, match="of the heights"):
        run(client)
    assert len(client.given) == len(TASKS)


def test_a_task_whose_workers_are_gone_is_given_to_others(make_client):
    client = make_client(["a", "b"], broken=["b"], error=full())
    nthreads, n_calls = client.nthreads, itertools.count(1)

    def nthreads_at_first():
        if next(n_calls) == 2:  # a is lost when it has just been chosen
            client.names, client.nthreads = ["b", "c"], nthreads
        return {"a": 1, "b": 1}

    client.nthreads = nthreads_at_first
    start = time.monotonic()
    with pytest.warns(TerrainwaveWarning):
        assert run(client) == {number: number**2 for number in TASKS}
    assert time.monotonic() - start < 10  # sooner than a slow one is helped
    assert {worker for _, worker in client.given} == {"a", "b", "c"}


def test_tasks_that_are_lost_are_one_line():
    with pytest.raises(ClusterError, match="the cluster has lost a task"):
        run(LosingCluster())
