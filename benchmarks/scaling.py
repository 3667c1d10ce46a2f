"""Measure compression on a cluster: ``python -m benchmarks.scaling dem.tif``.

The raster is made by mirroring a small one. It is compressed here in one thread, here task by task,
then by one and by two dask workers of one thread each; every file must have the same bytes. Two
files are written: what was measured, and what follows from it for 10^12 samples.

Other work on the machine makes seconds useless and leaves processor seconds alone. `ratio` is
therefore given twice: as measured, and as processor seconds allow where nothing else runs, workers
side by side and what is done in between by one.

Exit status: 0 good; 1 files differ; 2 wrong usage.
"""

import argparse
import csv
import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import asdict, dataclass
from pathlib import Path
from unittest import mock

from benchmarks.memory import make_mirrored

BLOCK = 256
MAX_ERROR = 1.0
RUNS = ("local", "tasks", "1 worker", "2 workers")
LARGE = 10**6  # samples on a side of the raster that is extrapolated to
CORES = 100


@dataclass(frozen=True)
class Row:
    """One run. `load` is the machine's average load; bytes of tasks and results are means.

    `peak_mib` is the memory of the largest worker; `overhead` is in processor seconds, over local.
    """

    run: str
    n_samples: int
    n_tasks: int
    n_calls: int
    seconds: float
    cpu_here: float
    cpu_workers: float
    overhead: float
    ratio: float
    ratio_by_cpu: float
    task_bytes: float
    result_bytes: float
    depot_bytes: int
    depot_levels_bytes: int
    peak_mib: float
    file_bytes: int
    load: float


@dataclass(frozen=True)
class Extrapolation:
    """What the measured run comes to on a raster of `LARGE` x `LARGE` samples."""

    n_samples: int
    n_tasks: int
    n_calls: int
    scheduler_mb: float
    calls_per_second: float
    depot_gb: float
    file_gb: float
    index_mb: float
    hours_here: float
    hours_workers: float


class CountingExecutor(Executor):
    """Passes tasks on, and counts the bytes of tasks and results."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self.n_calls = self.task_bytes = self.result_bytes = 0

    def submit(self, function, /, *arguments) -> Future:
        """Submit a task."""
        import cloudpickle

        self.n_calls += 1
        self.task_bytes += len(cloudpickle.dumps((function, arguments)))
        future = self._executor.submit(function, *arguments)
        future.add_done_callback(self._count_result)
        return future

    def _count_result(self, future: Future) -> None:
        import cloudpickle

        if not future.cancelled() and future.exception() is None:
            self.result_bytes += len(cloudpickle.dumps(future.result()))


def peak_mib() -> float:
    """Return the most memory this process has used."""
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


class InlineExecutor(Executor):
    """Runs a task where it is submitted."""

    def submit(self, function, /, *arguments) -> Future:
        """Run a task."""
        future: Future = Future()
        future.set_result(function(*arguments))
        return future


def run_local(source: Path, target: Path, client: Executor | None) -> dict[str, float]:
    """Compress in one thread of this process, task by task if there is a client."""
    import terrainwave

    start, cpu = time.perf_counter(), time.process_time()
    terrainwave.compress(
        source,
        target,
        max_error=MAX_ERROR,
        block=BLOCK,
        threads=1,
        overwrite=True,
        client=client,
    )
    return {"seconds": time.perf_counter() - start, "cpu_here": time.process_time() - cpu}


def run_cluster(source: Path, target: Path, n_workers: int, warm_up: Path) -> dict[str, float]:
    """Compress by workers of one thread each; kernels are compiled on a small raster before."""
    from distributed import Client, LocalCluster

    import terrainwave
    from terrainwave.container.depot import Depot
    from terrainwave.write.cluster import executor_of

    stored: Counter[str] = Counter()
    remove = Depot.remove

    def measured(depot: Depot) -> None:
        for path in Path(depot.root).iterdir():
            stored["levels" if "-heights-" in path.name else "segments"] += path.stat().st_size
        remove(depot)

    with (
        LocalCluster(n_workers=n_workers, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        executor = executor_of(client)
        options = {"max_error": MAX_ERROR, "overwrite": True, "threads": 1}
        for _ in range(2):
            terrainwave.compress(warm_up, target, client=executor, block=32, **options)
        counting = CountingExecutor(executor)
        before = sum(client.run(time.process_time).values())
        start, cpu = time.perf_counter(), time.process_time()
        with mock.patch.object(Depot, "remove", measured):
            terrainwave.compress(source, target, client=counting, block=BLOCK, **options)
        seconds, cpu_here = time.perf_counter() - start, time.process_time() - cpu
        return {
            "seconds": seconds,
            "cpu_here": cpu_here,
            "cpu_workers": sum(client.run(time.process_time).values()) - before,
            "n_calls": counting.n_calls,
            "task_bytes": counting.task_bytes / counting.n_calls,
            "result_bytes": counting.result_bytes / counting.n_calls,
            "peak_mib": max(client.run(peak_mib).values()),
            "depot_bytes": stored.total(),
            "depot_levels_bytes": stored["levels"],
        }


def measure(raster: Path, size: int, runs: Sequence[str], folder: Path) -> list[Row]:
    """Return the rows of all runs; `SystemExit` if a file differs."""
    from terrainwave.grid.quadtree import Grid
    from terrainwave.write.cluster import TASK_SAMPLES, task_level

    source, warm_up = folder / "large.tif", folder / "small.tif"
    make_mirrored(raster, source, size, "tiled")
    make_mirrored(raster, warm_up, 600, "tiled")
    grid = Grid(size, size, BLOCK)
    level = task_level(grid, TASK_SAMPLES)
    n_tasks = 0 if level is None else len(grid.blocks(level))
    rows: list[Row] = []
    contents = []
    for run in runs:
        target = folder / f"{run}.twz"
        if not run[0].isdigit():
            client = InlineExecutor() if run == "tasks" else None
            run_local(warm_up, target, client)
            found = run_local(source, target, client)
        else:
            found = run_cluster(source, target, int(run[0]), warm_up)
        contents.append(target.read_bytes())
        rows.append(_row(run, size, n_tasks, found, len(contents[0]), rows))
        print(rows[-1], flush=True)
    if any(content != contents[0] for content in contents):
        raise SystemExit("the files differ")
    return rows


def _row(
    run: str, size: int, n_tasks: int, found: dict[str, float], n_bytes: int, before: list[Row]
) -> Row:
    here, workers = found["cpu_here"], found.get("cpu_workers", 0.0)
    overhead = ratio = by_cpu = 0.0
    if before:
        overhead = (here + workers) / before[0].cpu_here - 1
    one = next((row for row in before if row.run == "1 worker"), None)
    if one is not None:
        ratio = one.seconds / found["seconds"]
        by_cpu = (one.cpu_here + one.cpu_workers) / (here + workers / 2)
    return Row(
        run=run,
        n_samples=size * size,
        n_tasks=n_tasks if before else 0,
        n_calls=int(found.get("n_calls", 0)),
        seconds=round(found["seconds"], 1),
        cpu_here=round(here, 1),
        cpu_workers=round(workers, 1),
        overhead=round(overhead, 3),
        ratio=round(ratio, 2),
        ratio_by_cpu=round(by_cpu, 2),
        task_bytes=round(found.get("task_bytes", 0)),
        result_bytes=round(found.get("result_bytes", 0)),
        depot_bytes=int(found.get("depot_bytes", 0)),
        depot_levels_bytes=int(found.get("depot_levels_bytes", 0)),
        peak_mib=round(found.get("peak_mib", 0.0), 1),
        file_bytes=n_bytes,
        load=round(os.getloadavg()[0], 1),
    )


def extrapolate(row: Row) -> Extrapolation:
    """Return what a run on `LARGE` x `LARGE` samples would take, from one on a cluster."""
    from terrainwave.container.page import MAX_PAGE
    from terrainwave.grid.quadtree import Grid
    from terrainwave.write.cluster import TASK_SAMPLES, task_level

    grid = Grid(LARGE, LARGE, BLOCK)
    level = task_level(grid, TASK_SAMPLES)
    assert level is not None
    n_rows, n_cols = grid.level_blocks(level)
    n_tasks = n_rows * n_cols
    n_segments = 1 + sum(n * m for n, m in map(grid.level_blocks, grid.segment_levels()))
    n_calls = n_tasks * row.n_calls // row.n_tasks
    scale = LARGE * LARGE / row.n_samples
    hours_workers = row.cpu_workers * scale / 3600
    # Of a page of 85 keys, as inflated: an upper bound below the format's.
    page = min(MAX_PAGE, 17 * 85 + 4 * 340)
    return Extrapolation(
        n_samples=LARGE * LARGE,
        n_tasks=n_tasks,
        n_calls=n_calls,
        scheduler_mb=round(n_calls * (row.task_bytes + row.result_bytes) / 1e6, 1),
        calls_per_second=round(n_calls / (hours_workers * 3600 / CORES), 2),
        depot_gb=round(row.depot_bytes * scale / 1e9, 1),
        file_gb=round(row.file_bytes * scale / 1e9, 1),
        index_mb=round(n_segments * page / 1e6, 1),
        hours_here=round(row.cpu_here * scale / 3600, 1),
        hours_workers=round(hours_workers, 1),
    )


def write_rows(path: Path, rows: Sequence[Row | Extrapolation]) -> None:
    """Write rows as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(asdict(rows[0])), lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the measurement; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("raster", type=Path, help="a small raster, repeated to the wanted size")
    parser.add_argument("--size", type=int, default=8193, help="samples on a side")
    parser.add_argument("--runs", nargs="+", choices=RUNS, default=RUNS, help="local comes first")
    parser.add_argument("--work-dir", type=Path, help="keep the rasters and files here")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/scaling.csv"))
    options = parser.parse_args(arguments)
    from benchmarks.machine import describe_machine

    with tempfile.TemporaryDirectory(dir=options.work_dir) as temporary:
        rows = measure(options.raster, options.size, options.runs, Path(temporary))
    write_rows(options.out, rows)
    larger = options.out.with_name(f"{options.out.stem}_extrapolated.csv")
    if rows[-1].n_calls:
        write_rows(larger, [extrapolate(rows[-1])])
    text = json.dumps(describe_machine(), indent=2) + "\n"
    options.out.with_suffix(".json").write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
