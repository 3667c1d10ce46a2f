"""Compress on three dask workers that are killed, stopped or out of disk: ``-m faults.cluster``.

Every worker is a process with a nanny, a thread and a folder of its own. A trial starts a run and
strikes at a random moment of it. The file is compared byte by byte with that of a local run; where
no worker can do the work, the error has to be one line that names a worker, its machine and its
folder, or the depot. `store` trials put the depot on an S3 server (moto, with s3fs; both are to be
installed for this script alone), and cut its connections.

Writes ``faults_cluster.csv``. Exit status: 0 good; 1 other bytes, an unclear error, a hang, or
something left over; 2 wrong usage.
"""

import os
import random
import re
import select
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import threading
import time
import urllib.request
import warnings
from collections import Counter, namedtuple
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest import mock

import click
import psutil

import terrainwave
from benchmarks import common
from benchmarks.rasters import make_mirrored
from faults.commands import everything_on_disk, synthesised, write_raster
from faults.disk import mounted
from terrainwave.errors import ClusterError, StorageError, TerrainwaveWarning
from terrainwave.ext.distributed import connected
from terrainwave.write.tasks import workers

# What was done to the run; trials; runs whose file had the right bytes; runs that failed with one
# clear line, and with another one; other bytes; runs that did not end; trials that left something
# in the folder of the target, or in the depot; tasks that were done, and attempts that failed;
# seconds of undisturbed and of disturbed runs.
Row = namedtuple(
    "Row",
    "fault trials same_bytes refused unclear wrong hangs left_over tasks failed_attempts "
    "undisturbed_s median_s longest_s",
)
N_WORKERS = 3
BUCKET = "s3://terrainwave-faults"
_PATIENCE = 600.0  # seconds after which a run hangs
_START = 300.0  # seconds for workers to appear
_PARTS = ("kills", "stops", "disks", "store")
# What an error has to tell if no worker could do the work.
_CLEAR = re.compile(
    r"disk is full; free space there, or (start the worker with .*; found by the worker tcp://.* on"
    r" .*, with temporary files in |name another directory)|the cluster has lost a task"
)


class Cluster:
    """A scheduler and workers, each a process of its own; `environment` is for the workers."""

    def __init__(self, folder: Path, environment: dict[str, str] | None = None) -> None:
        self._folder = folder
        # By default, a trial with a stopped worker would be waiting for five minutes.
        patience = {"DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "20s"}
        self._environment = os.environ | patience | (environment or {})
        self._port = free_port()
        self.address = f"tcp://127.0.0.1:{self._port}"
        self.nannies: list[subprocess.Popen] = []
        self._scheduler = self._start(
            "scheduler", "--port", str(self._port), "--dashboard-address", ":0"
        )
        wait_for(self._port)
        for number in range(N_WORKERS):
            self.folder(number).mkdir(parents=True, exist_ok=True)
            self.nannies.append(self._start_worker(number))

    def folder(self, number: int) -> Path:
        """Return the folder for temporary files of a worker."""
        return self._folder / f"worker-{number}"

    def _start(self, *words: str) -> subprocess.Popen:
        with (self._folder / "dask.log").open("a") as log:
            return subprocess.Popen(
                ["nice", sys.executable, "-m", "dask", *words],
                cwd=common.ROOT, env=self._environment, stdout=log, stderr=log,
            )  # fmt: skip

    def _start_worker(self, number: int) -> subprocess.Popen:
        preload = "from faults.commands import everything_on_disk; everything_on_disk()"
        return self._start(
            "worker", self.address, "--nthreads", "1", "--dashboard-address", ":0",
            "--preload", preload, "--name", str(number),
            "--local-directory", str(self.folder(number)),
        )  # fmt: skip

    def worker(self, number: int) -> psutil.Process:
        """Return the process of a worker, which its nanny starts anew."""
        nanny = psutil.Process(self.nannies[number].pid)
        for child in nanny.children():
            if "multiprocessing.spawn" in " ".join(child.cmdline()):
                return child
        raise ProcessLookupError(number)

    def complete(self) -> None:
        """Let stopped workers go on, start what is gone, and wait until all are there."""
        for number, nanny in enumerate(self.nannies):
            with suppress(ProcessLookupError, psutil.NoSuchProcess):
                self.worker(number).send_signal(signal.SIGCONT)
            if nanny.poll() is not None:
                self.nannies[number] = self._start_worker(number)
        end = time.monotonic() + _START
        while time.monotonic() < end:
            with suppress(ClusterError), connected(self.address) as client:
                client.wait_for_workers(N_WORKERS, timeout=_START)
                return
            time.sleep(0.2)
        raise click.ClickException("workers do not appear: see dask.log")

    def close(self) -> None:
        """End all that has been started."""
        for process in (*self.nannies, self._scheduler):
            with suppress(psutil.NoSuchProcess):
                started = psutil.Process(process.pid)
                below = [*started.children(recursive=True), started]
                for one in below:
                    with suppress(psutil.NoSuchProcess):
                        one.kill()
                psutil.wait_procs(below, _START)  # what they had open keeps disks mounted
            process.wait()


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def wait_for(port: int) -> None:
    """Wait until somebody listens on a port."""
    end = time.monotonic() + _START
    while time.monotonic() < end:
        with suppress(OSError):
            socket.create_connection(("127.0.0.1", port), 1).close()
            return
        time.sleep(0.05)
    raise click.ClickException(f"nobody listens on port {port}")


# Does something to a cluster in the middle of a run.
Strike = Callable[[Cluster, random.Random], None]


def kill_worker(cluster: Cluster, generator: random.Random) -> None:
    """Kill a worker; its nanny starts another one."""
    with suppress(ProcessLookupError, psutil.NoSuchProcess):
        cluster.worker(generator.randrange(N_WORKERS)).kill()


def kill_machine(cluster: Cluster, generator: random.Random) -> None:
    """Kill a nanny and its worker: nothing comes back."""
    number = generator.randrange(N_WORKERS)
    with suppress(ProcessLookupError, psutil.NoSuchProcess):
        worker = cluster.worker(number)
        cluster.nannies[number].kill()
        worker.kill()
    cluster.nannies[number].wait()


def kill_twice(cluster: Cluster, generator: random.Random) -> None:
    """Kill two workers, one after the other."""
    kill_worker(cluster, generator)
    time.sleep(generator.random())
    kill_worker(cluster, generator)


def stop_worker(cluster: Cluster, generator: random.Random) -> None:
    """Stop a worker for the rest of the run."""
    with suppress(ProcessLookupError, psutil.NoSuchProcess):
        cluster.worker(generator.randrange(N_WORKERS)).send_signal(signal.SIGSTOP)


def stop_for_a_while(cluster: Cluster, generator: random.Random) -> None:
    """Stop a worker for two seconds."""
    with suppress(ProcessLookupError, psutil.NoSuchProcess):
        worker = cluster.worker(generator.randrange(N_WORKERS))
        worker.send_signal(signal.SIGSTOP)
        time.sleep(2)
        worker.send_signal(signal.SIGCONT)


def nothing(_cluster: Cluster, _generator: random.Random) -> None:
    """Let the run be."""


class Trials:
    """Runs of one raster on a cluster."""

    def __init__(self, raster: Path, folder: Path, task_side: int, seed: int) -> None:
        self.raster, self.folder = raster, folder
        self.options = {"max_error": 1, "block": 32, "threads": 1, "overwrite": True}
        self.task_samples = task_side**2
        self.generator = random.Random(seed)
        local = folder / "local.twz"
        terrainwave.compress(raster, local, **self.options)
        self.expected = local.read_bytes()
        self.undisturbed = 0.0

    def calm(self, cluster: Cluster) -> None:
        """Note how long an undisturbed run takes, once all is compiled."""
        for _ in range(2):
            found = self.run(cluster, nothing, None)
            if found["outcome"] != "same_bytes":
                raise click.ClickException(f"an undisturbed run fails: {found}")
        self.undisturbed = found["seconds"]

    def row(
        self, fault: str, cluster: Cluster, n: int, strike: Strike, depot: str | None = None
    ) -> Row:
        """Run `n` trials of a fault."""
        outcomes: Counter[str] = Counter()
        numbers: Counter[str] = Counter()
        seconds = []
        cluster.complete()
        self.run(cluster, nothing, depot)  # what is new has to be loaded
        for _ in range(n):
            cluster.complete()
            found = self.run(cluster, strike, depot)
            outcomes[found["outcome"]] += 1
            outcomes["left_over"] += found["left_over"]
            numbers.update(found["numbers"])
            seconds.append(found["seconds"])
        return Row(
            fault, n, *(outcomes[name] for name in Row._fields[2:8]),
            *(numbers[name] for name in Row._fields[8:10]), round(self.undisturbed, 1),
            round(statistics.median(seconds), 1), round(max(seconds), 1),
        )  # fmt: skip

    def run(self, cluster: Cluster, strike: Strike, depot: str | None) -> dict:
        """Return what became of a run that is struck at a random moment."""
        work = self.folder / "target"
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        target = work / "out.twz"
        delay = self.generator.random() * self.undisturbed
        gremlin = threading.Thread(
            target=lambda: (time.sleep(delay), strike(cluster, self.generator))
        )
        outcomes: list = []
        take = workers._outcome

        def noted(future: Future) -> Any:
            outcomes.append(take(future))
            return outcomes[-1]

        ended: dict = {"outcome": "hangs"}

        def compress() -> None:
            try:
                with (
                    warnings.catch_warnings(),
                    connected(cluster.address) as client,
                    mock.patch.object(workers, "_outcome", noted),
                ):
                    warnings.simplefilter("ignore", TerrainwaveWarning)
                    terrainwave.compress(
                        self.raster, target, client=client, task_samples=self.task_samples,
                        temp_dir=depot, **self.options,
                    )  # fmt: skip
            except (StorageError, ClusterError) as error:
                is_clear = _CLEAR.search(str(error)) and "\n" not in str(error)
                ended["outcome"] = "refused" if is_clear else "unclear"
                ended["error"] = str(error)
            except Exception as error:  # noqa: BLE001  whatever it is, it is unclear
                ended["outcome"] = "unclear"
                ended["error"] = repr(error)
            else:
                is_same = target.read_bytes() == self.expected
                ended["outcome"] = "same_bytes" if is_same else "wrong"

        start = time.monotonic()
        runner = threading.Thread(target=compress, daemon=True)
        runner.start()
        gremlin.start()
        runner.join(_PATIENCE)
        seconds = time.monotonic() - start
        gremlin.join()
        if ended["outcome"] not in ("same_bytes", "refused"):
            click.echo(f"{ended}", err=True)
        n_failed = sum(outcome.error is not None for outcome in outcomes)
        numbers = {"tasks": len(outcomes) - n_failed, "failed_attempts": n_failed}
        expected = {"out.twz"} if ended["outcome"] == "same_bytes" else set()
        left = {one.name for one in work.iterdir()} - expected
        if depot is not None and "://" not in depot:
            left |= {one.name for one in Path(depot).iterdir()}
        return ended | {"numbers": numbers, "seconds": seconds, "left_over": bool(left)}


# --- disks ---


def on_small_disks(trials: Trials, folder: Path, n: int, n_bytes: int) -> Iterator[Row]:
    """Run on workers of which one, and then all, have small disks; then with a small depot."""
    for n_small in (1, N_WORKERS):
        with ExitStack() as stack:
            place = folder / f"small-{n_small}"
            for number in range(n_small):
                small = place / f"worker-{number}"
                small.mkdir(parents=True)
                stack.enter_context(mounted(small, n_bytes))
            cluster = Cluster(place)
            stack.callback(cluster.close)
            cluster.complete()
            fault = "one full disk of a worker" if n_small == 1 else "full disks of all workers"
            yield trials.row(fault, cluster, n, nothing)
    place = folder / "small-depot"
    place.mkdir()
    cluster = Cluster(place)
    try:
        with mounted(place / "depot", n_bytes):
            yield trials.row("a full depot", cluster, n, nothing, str(place / "depot"))
    finally:
        cluster.close()


# --- a store ---


class CuttingProxy(threading.Thread):
    """Passes connections on to a port; cuts some in the middle of what is sent, and delays all.

    `share` is that of the connections which are cut, after at most `_CUT_BYTES` bytes.
    """

    def __init__(self, port: int, share: float, seed: int) -> None:
        super().__init__(daemon=True)
        self._to = port
        self._share = share
        self._generator = random.Random(seed)
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self.n_cut = self.n_passed = 0
        self.start()

    def run(self) -> None:
        """Take connections."""
        while True:
            try:
                client, _ = self._listening.accept()
            except OSError:  # closed
                return
            threading.Thread(target=self._pass_on, args=[client], daemon=True).start()

    def _pass_on(self, client: socket.socket) -> None:
        is_cut = self._generator.random() < self._share
        left = self._generator.randrange(_CUT_BYTES) if is_cut else sys.maxsize
        time.sleep(self._generator.random() * 0.05)
        with client, socket.create_connection(("127.0.0.1", self._to)) as server, suppress(OSError):
            others = {client: server, server: client}
            while True:
                for one in select.select(list(others), [], [])[0]:
                    data = one.recv(1 << 16)
                    if one is client:
                        data, left = data[:left], left - len(data)
                    if data:
                        others[one].sendall(data)
                    if not data or left <= 0:
                        self.n_cut += left <= 0
                        self.n_passed += left > 0
                        return


_CUT_BYTES = 4_000


@contextmanager
def s3_server(log: Path) -> Iterator[int]:
    """Give the port of a local S3 server with a bucket."""
    port = free_port()
    with log.open("w") as file:
        words = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
        process = subprocess.Popen(["nice", *words], stdout=file, stderr=file)
    try:
        wait_for(port)
        request = urllib.request.Request(
            f"http://127.0.0.1:{port}/{BUCKET.removeprefix('s3://')}", method="PUT"
        )
        urllib.request.urlopen(request).close()
        yield port
    finally:
        process.kill()
        process.wait()


def on_a_store(trials: Trials, folder: Path, n: int, share: float, seed: int) -> Iterator[Row]:
    """Run with the depot on an S3 server, then over connections that are cut."""
    if not (find_spec("s3fs") and find_spec("moto")):
        raise click.UsageError("--only store needs s3fs and moto: pip install s3fs 'moto[server]'")
    with s3_server(folder / "moto.log") as port:
        for fault, cut in (("a depot on S3", 0.0), ("… whose connections are cut", share)):
            place = folder / f"store-{cut}"
            place.mkdir()
            proxy = CuttingProxy(port, cut, seed)
            environment = {
                "FSSPEC_S3_ENDPOINT_URL": f"http://127.0.0.1:{proxy.port}",
                "AWS_ACCESS_KEY_ID": "faults", "AWS_SECRET_ACCESS_KEY": "faults",
                "AWS_DEFAULT_REGION": "us-east-1", "AWS_MAX_ATTEMPTS": "1",
            }  # fmt: skip
            os.environ.update(environment)
            import fsspec

            fsspec.config.set_conf_env(fsspec.config.conf)
            cluster = Cluster(place, environment)
            try:
                row = trials.row(fault, cluster, n, nothing, f"{BUCKET}/scratch")
                n_left = objects_at(port)
                click.echo(
                    f"{proxy.n_cut} connections cut, {proxy.n_passed} not; {n_left} objects left"
                )
                yield row._replace(left_over=row.left_over + bool(n_left))
            finally:
                cluster.close()


def objects_at(port: int) -> int:
    """Return how many objects the bucket has."""
    url = f"http://127.0.0.1:{port}/{BUCKET.removeprefix('s3://')}?list-type=2"
    with urllib.request.urlopen(url) as reply:
        return reply.read().count(b"<Contents>")


@common.command("faults_cluster.csv")
@common.option("--dem", type=common.EXISTING, help="A raster. Default: made-up hills.")
@common.option("--side", type=common.COUNT, default=2049, help="Samples on a side.")
@common.option("--task-side", type=common.COUNT, default=512, help="Of a task.")
@common.option("--kills", "n_kills", type=common.COUNT, default=20, help="Trials of each kind.")
@common.option("--others", "n_others", type=common.COUNT, default=5, help="Of other faults.")
@common.option("--disk", "n_bytes", type=common.COUNT, default=512 << 10, help="Bytes.")
@common.option("--cut", type=click.FloatRange(0, 1), default=0.3, help="Share of connections.")
@common.option("--only", type=click.Choice(_PARTS), cls=common.ListOption, default=_PARTS)
@common.option("--seed", type=int, default=0)
@click.option("--append", is_flag=True, help="Keep the lines of the CSV.")
def main(
    dem: Path | None, side: int, task_side: int, n_kills: int, n_others: int, n_bytes: int,
    cut: float, only: tuple[str, ...], seed: int, append: bool, folder: Path, out: Path,
) -> None:  # fmt: skip
    """Run the trials."""
    everything_on_disk()
    raster = folder / "raster.tif"
    if dem is None:
        write_raster(raster, synthesised(side, side, seed))
    else:
        make_mirrored(dem, raster, side)
    trials = Trials(raster, folder, task_side, seed)

    def rows() -> Iterator[Row]:
        cluster = Cluster(folder)
        try:
            cluster.complete()
            trials.calm(cluster)
            if "kills" in only:
                yield trials.row("a worker killed", cluster, n_kills, kill_worker)
                yield trials.row("two workers killed", cluster, n_kills, kill_twice)
                yield trials.row("a machine lost", cluster, n_kills, kill_machine)
            if "stops" in only:
                yield trials.row("a worker stopped for 2 s", cluster, n_others, stop_for_a_while)
                yield trials.row("a worker stopped", cluster, n_others, stop_worker)
        finally:
            cluster.close()
        if "disks" in only:
            yield from on_small_disks(trials, folder, n_others, n_bytes)
        if "store" in only:
            yield from on_a_store(trials, folder, n_others, cut, seed)

    written = common.write_rows(out, rows(), append=append)
    raise SystemExit(any(is_bad(row) for row in written))


def is_bad(row: Row) -> bool:
    """Say whether a row has a fault of ours."""
    may_refuse = row.fault in ("full disks of all workers", "a full depot")
    n_good = row.refused if may_refuse else row.same_bytes
    return n_good != row.trials or bool(row.left_over)


if __name__ == "__main__":
    main()
