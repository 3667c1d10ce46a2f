"""Measure compression on a cluster: ``python -m benchmarks.scaling dem.tif``.

The raster, mirrored, is compressed in one thread, task by task, then by one, two and three dask
workers of one thread each; all files must have the same bytes. ``scaling_tasks.csv`` has a line for
each task, from which `benchmarks.cluster_plan` plans larger runs. `ratio` is given as measured, and
as processor seconds allow where nothing else runs: workers side by side, of which two have a core,
and what is done in between by one.

Exit status: 0 good; 1 files differ; 2 wrong usage.
"""

import os
import time
from collections import Counter, namedtuple
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from contextlib import nullcontext
from pathlib import Path
from unittest import mock

import click
import cloudpickle

import terrainwave
from benchmarks import common
from benchmarks.rasters import make_mirrored
from benchmarks.task_reports import TaskReport, TimingExecutor, reported
from terrainwave.container.depot import Depot
from terrainwave.grid.quadtree import Grid
from terrainwave.write.cluster import TASK_SAMPLES, task_level
from terrainwave.write.tasks.workers import executor_of

BLOCK = 256
MAX_ERROR = 1.0
RUNS = ("local", "tasks", "1 worker", "2 workers", "3 workers")
TASKS_CSV = "scaling_tasks.csv"
N_CORES = 2  # of the machine

# One run. `load` is the machine's average load; bytes of tasks and results are means.
# `peak_mib` is the memory of the largest worker; `overhead` is in processor seconds, over local.
Row = namedtuple(
    "Row",
    "run n_samples n_tasks n_calls seconds cpu_here cpu_workers overhead ratio ratio_by_cpu "
    "task_bytes result_bytes depot_bytes depot_levels_bytes peak_mib file_bytes load",
)  # fmt: skip

Task = namedtuple("Task", ["run", *TaskReport._fields])


class CountingExecutor(Executor):
    """Passes tasks on, and counts the bytes of tasks and results."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self.n_calls = self.task_bytes = self.result_bytes = 0

    def submit(self, function, /, *arguments) -> Future:
        """Submit a task."""
        self.n_calls += 1
        self.task_bytes += len(cloudpickle.dumps((function, arguments)))
        future = self._executor.submit(function, *arguments)
        future.add_done_callback(self._count_result)
        return future

    def _count_result(self, future: Future) -> None:
        if not future.cancelled() and future.exception() is None:
            self.result_bytes += len(cloudpickle.dumps(future.result()))


def peak_mib() -> float:
    """Return the most memory this process has used."""
    import resource  # not on Windows, where tests import this module

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def run_local(
    source: Path, target: Path, client: Executor | None, reports: list[TaskReport]
) -> dict[str, float]:
    """Compress in one thread of this process, task by task if there is a client."""
    start, cpu = time.perf_counter(), time.process_time()
    with nullcontext() if client is None else reported(reports.append):
        terrainwave.compress(
            source, target, max_error=MAX_ERROR, block=BLOCK, threads=1, overwrite=True,
            client=client,
        )  # fmt: skip
    return {"seconds": time.perf_counter() - start, "cpu_here": time.process_time() - cpu}


def run_cluster(
    source: Path, target: Path, n_workers: int, warm_up: Path, reports: list[TaskReport]
) -> dict[str, float]:
    """Compress by workers of one thread each; kernels are compiled on a small raster before."""
    from distributed import Client, LocalCluster

    stored: Counter[str] = Counter()
    remove = Depot.remove

    def measured(depot: Depot, names: Sequence[str]) -> None:
        for path in Path(depot.root).iterdir():
            stored["levels" if "-heights-" in path.name else "segments"] += path.stat().st_size
        remove(depot, names)

    with (
        LocalCluster(n_workers=n_workers, threads_per_worker=1, dashboard_address=":0") as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        executor = executor_of(client)
        options = {"max_error": MAX_ERROR, "overwrite": True, "threads": 1}
        for _ in range(2):
            terrainwave.compress(warm_up, target, client=executor, block=32, **options)
        counting = CountingExecutor(TimingExecutor(executor))
        before = sum(client.run(time.process_time).values())
        start, cpu = time.perf_counter(), time.process_time()
        with mock.patch.object(Depot, "remove", measured), reported(reports.append):
            terrainwave.compress(source, target, client=counting, block=BLOCK, **options)
        seconds, cpu_here = time.perf_counter() - start, time.process_time() - cpu
        return {
            "seconds": seconds, "cpu_here": cpu_here,
            "cpu_workers": sum(client.run(time.process_time).values()) - before,
            "n_calls": counting.n_calls,
            "task_bytes": counting.task_bytes / counting.n_calls,
            "result_bytes": counting.result_bytes / counting.n_calls,
            "peak_mib": max(client.run(peak_mib).values()),
            "depot_bytes": stored.total(), "depot_levels_bytes": stored["levels"],
        }  # fmt: skip


def measure(
    raster: Path, size: int, runs: Sequence[str], folder: Path
) -> tuple[list[Row], list[Task]]:
    """Return the rows of all runs, and of their tasks; `SystemExit` if a file differs."""
    source, warm_up = folder / "large.tif", folder / "small.tif"
    make_mirrored(raster, source, size)
    make_mirrored(raster, warm_up, 600)
    grid = Grid(size, size, BLOCK)
    level = task_level(grid, TASK_SAMPLES)
    n_tasks = 0 if level is None else len(grid.blocks(level))
    rows: list[Row] = []
    contents = []
    tasks: list[Task] = []
    for run in runs:
        reports: list[TaskReport] = []
        target = folder / f"{run}.twz"
        if run[0].isdigit():
            found = run_cluster(source, target, int(run[0]), warm_up, reports)
        else:
            client = TimingExecutor(common.InlineExecutor()) if run == "tasks" else None
            for one in (warm_up, source):
                reports.clear()
                found = run_local(one, target, client, reports)
        tasks += [Task(run, *report._replace(host="here")) for report in reports]
        contents.append(target.read_bytes())
        rows.append(_row(run, size, n_tasks, found, len(contents[0]), rows))
    if any(content != contents[0] for content in contents):
        raise SystemExit("the files differ")
    return rows, tasks


def _row(
    run: str, size: int, n_tasks: int, found: dict[str, float], n_bytes: int, before: list[Row]
) -> Row:
    here, workers = found["cpu_here"], found.get("cpu_workers", 0.0)
    overhead = (here + workers) / before[0].cpu_here - 1 if before else 0.0
    ratio = by_cpu = 0.0
    for one in before:
        if one.run == "1 worker":
            ratio = one.seconds / found["seconds"]
            by_cpu = (one.cpu_here + one.cpu_workers) / (here + workers / min(int(run[0]), N_CORES))
    # What only a run on a cluster has.
    names = "task_bytes", "result_bytes", "depot_bytes", "depot_levels_bytes"
    return Row(
        run, size * size, n_tasks if before else 0, int(found.get("n_calls", 0)),
        round(found["seconds"], 1), round(here, 1), round(workers, 1), round(overhead, 3),
        round(ratio, 2), round(by_cpu, 2), *(round(found.get(name, 0)) for name in names),
        round(found.get("peak_mib", 0.0), 1), n_bytes, round(os.getloadavg()[0], 1),
    )  # fmt: skip


@common.command("scaling.csv")
@common.dem_argument
@common.option("--size", type=common.COUNT, default=12289, help="Samples on a side.")
@common.option("--runs", cls=common.ListOption, type=click.Choice(RUNS), default=RUNS)
def main(dem: Path, size: int, runs: tuple[str, ...], folder: Path, out: Path) -> None:
    """Measure; local comes first."""
    rows, tasks = measure(dem, size, runs, folder)
    common.write_rows(out, rows)
    common.write_rows(out.with_name(TASKS_CSV), tasks)


if __name__ == "__main__":
    main()
