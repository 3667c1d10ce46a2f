"""Plan a run on up to 1,000 workers by simulation: ``python -m benchmarks.cluster_plan dem.tif``.

What tasks take is that of one dask worker in ``scaling_tasks.csv`` (`benchmarks.scaling`). What the
client takes between the passes, and for each result, is measured here, by runs in one process over
one task, nine tasks, and a raster whose half is void. Then discrete events: tasks go one by one
through the scheduler to workers that are free, read from the source, compute, and write to the
depot; source and depot are pipes that all workers share. All seconds that are measured are those of
processors, so that other work on the machine matters little. ``cluster_plan.csv`` has the plans,
``cluster_plan_check.csv`` the same simulation of the runs of `benchmarks.scaling` on this machine.
"""

import heapq
import random
import time
from collections import defaultdict, namedtuple
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rasterio

import terrainwave
from benchmarks import common
from benchmarks.rasters import make_mirrored
from benchmarks.scaling import BLOCK, MAX_ERROR, TASKS_CSV
from benchmarks.task_reports import TaskReport, TimingExecutor, reported
from terrainwave.write.cluster import AT_A_TIME

PASSES = ("scanning", "averaging", "making levels", "encoding", "proving")
TASK_SIDE = 4096
LARGER = 16  # sides of larger tasks: segments span four levels
_REQUESTS = 2  # for an entry of the depot: how large it is, and its bytes
WORKERS = (1, 3, 100, 1000)
# Rows, columns, share of tasks that are dense; all others are void.
RASTERS = {"10⁶ × 10⁶": (10**6, 10**6, 1.0), "planet at 1″": (648_000, 1_296_000, 0.1)}

# `serial_hours` are those in which no task runs; `busy` the share of the workers' time in tasks.
Plan = namedtuple(
    "Plan",
    "raster task_side n_workers n_tasks n_calls hours serial_hours busy client_hours source_tb "
    "depot_gb_written depot_gb_read",
)
# `simulated_s` is by the seconds that the tasks of this very run took, with all that ran beside
# them; `idle_s` by the processor seconds of one worker, as plans are.
Check = namedtuple("Check", "run n_tasks measured_s simulated_s ratio idle_s load")


@dataclass(frozen=True)
class Cost:
    """What a task of a pass takes: seconds, bytes from the source, from and to the depot."""

    seconds: float = 0.0
    source: float = 0.0
    read: float = 0.0
    written: float = 0.0

    def times(self, factor: float) -> "Cost":
        """Return that of a task over so many times the samples."""
        fields = (self.seconds, self.source, self.read, self.written)
        return Cost(*(factor * value for value in fields))


@dataclass(frozen=True)
class Client:
    """What the client takes, in seconds: before a pass, constant and for each task; each result."""

    constant: float = 0.0
    each: float = 0.0
    result: float = 0.0


@dataclass(frozen=True)
class Costs:
    """What is measured: of dense and void tasks, and of the client, by pass; the end is "end"."""

    dense: dict[str, Cost]
    void: dict[str, Cost]
    client: dict[str, Client]
    call: float  # seconds of the scheduler for a task


@dataclass(frozen=True)
class Site:
    """Workers, and how fast they are fed: bytes a second of each one, and of all together.

    `latency` are seconds that a request to the depot takes; the client makes some at a time.
    """

    n_workers: int
    n_cores: int
    link: float
    source: float
    depot: float
    latency: float = 0.0


@dataclass
class Pipe:
    """What is shared by all: one transfer after the other, at the rate of all together."""

    rate: float
    free: float = 0.0

    def end(self, now: float, n_bytes: float, link: float) -> float:
        """Return when a transfer that begins now has ended."""
        begin = max(now, self.free)
        self.free = begin + n_bytes / self.rate
        return max(self.free, now + n_bytes / link)


def simulate_pass(tasks: list[Cost], client: Client, call: float, site: Site, start: float):
    """Return when the last result is taken, and the seconds of workers and of the client."""
    source, depot = Pipe(site.source, start), Pipe(site.depot, start)
    slower = max(1.0, site.n_workers / site.n_cores)
    events: list[tuple[float, int, str, int]] = []  # time, order, what, task
    free = site.n_workers
    dispatched, waiting, order = start, 0, 0
    client_free, busy = start, 0.0
    began: dict[int, float] = {}

    def push(at: float, what: str, task: int) -> None:
        nonlocal order
        order += 1
        heapq.heappush(events, (at, order, what, task))

    def give(now: float) -> None:
        nonlocal free, dispatched, waiting
        while free and waiting < len(tasks):
            dispatched = max(now, dispatched) + call
            push(dispatched, "read", waiting)
            free -= 1
            waiting += 1

    give(start)
    while events:
        now, _, what, task = heapq.heappop(events)
        cost = tasks[task]
        if what == "read":
            began[task] = now
            end = max(source.end(now, cost.source, site.link), depot.end(now, cost.read, site.link))
            push(end + cost.seconds * slower, "write", task)
        elif what == "write":
            push(depot.end(now, cost.written, site.link), "done", task)
        else:
            busy += now - began.pop(task)
            client_free = max(client_free, now) + client.result
            free += 1
            give(now)
    return client_free, busy, client.result * len(tasks)


def simulate(
    costs: Costs, n_dense: int, n_void: int, site: Site, larger: int = 1, seed: int = 0
) -> dict[str, float]:
    """Return seconds and bytes of a run; tasks have `larger` times the sides."""
    now = busy = serial = of_client = 0.0
    total: dict[str, float] = defaultdict(float)
    has_voids = n_void > 0
    for name in PASSES:
        if name == "averaging" and not has_voids:
            continue
        tasks = [costs.dense[name].times(larger**2)] * n_dense
        tasks += [costs.void.get(name, Cost()).times(larger**2)] * n_void
        random.Random(seed).shuffle(tasks)
        client = costs.client.get(name, Client())
        waits = _REQUESTS * site.latency / AT_A_TIME
        if name in ("averaging", "making levels"):  # it loads what each task has left
            client = replace(client, result=client.result + waits)
        elif name == "encoding":  # it copies segments while tasks are running
            n_bytes = sum(cost.written for cost in tasks) / len(tasks)
            client = replace(client, result=client.result + waits + n_bytes / site.link)
        # The file is copied before it is proved; all else grows with the number of tasks.
        n_copied = larger**2 if name == "proving" else 1
        gap = client.constant + client.each * n_copied * len(tasks)
        now += gap
        serial += gap
        end, of_workers, of_results = simulate_pass(tasks, client, costs.call, site, now)
        now, busy, of_client = end, busy + of_workers, of_client + gap + of_results
        for cost in tasks:
            total["source"] += cost.source
            total["read"] += cost.read
            total["written"] += cost.written
    return {
        "seconds": now, "serial": serial, "busy": busy / (now * site.n_workers),
        "client": of_client, **total,
    }  # fmt: skip


# --- what is measured ---


class Inline(NamedTuple):
    """A run in one process: reports, each with the processor seconds when it came."""

    start: float
    reports: list[tuple[float, TaskReport]]


def client_costs(runs: dict[int, Inline]) -> dict[str, Client]:
    """Return what the client takes, by two runs in one process; keys are numbers of tasks."""
    few, many = sorted(runs)
    found = {n: gaps(run) for n, run in runs.items()}
    clients = {}
    for name, (gap, result) in found[many].items():
        each = max(0.0, (gap - found[few].get(name, (gap, 0))[0]) / (many - few))
        clients[name] = Client(max(0.0, gap - each * many), each, result / many)
    return clients


def gaps(run: Inline) -> dict[str, tuple[float, float]]:
    """Return for each pass the client's seconds before it, and those for its results.

    In one process, all tasks of a pass are done before the first of them is reported.
    """
    found: dict[str, tuple[float, float]] = {}
    last = run.start
    for stage, group in groupby(run.reports, lambda pair: pair[1].stage):
        own = list(group)
        first, end = own[0][0], own[-1][0]
        of_tasks = sum(report.cpu_seconds for _, report in own)
        found[stage] = max(0.0, first - last - of_tasks), end - first
        last = end
    return found


def task_costs(reports: list[dict], is_void: bool, clock: str = "cpu_seconds") -> dict[str, Cost]:
    """Return means of dense or void tasks: a void one has read nothing to scan it."""
    void_at = {
        (one["row"], one["col"])
        for one in reports
        if one["stage"] == "scanning" and not one["source_bytes"]
    }
    chosen: dict[str, list[dict]] = defaultdict(list)
    for one in reports:
        if ((one["row"], one["col"]) in void_at) == is_void:
            chosen[one["stage"]].append(one)
    names = (clock, "source_bytes", "depot_bytes_read", "depot_bytes_written")
    return {
        stage: Cost(*(float(np.mean([one[name] for one in own])) for name in names))
        for stage, own in chosen.items()
    }


def run_inline(raster: Path, folder: Path) -> Inline:
    """Compress task by task in this process."""
    run = Inline(time.process_time(), [])
    with reported(lambda report: run.reports.append((time.process_time(), report))):
        terrainwave.compress(
            raster, folder / "plan.twz", max_error=MAX_ERROR, block=BLOCK, threads=1,
            overwrite=True, client=TimingExecutor(common.InlineExecutor()),
        )  # fmt: skip
    return run


def make_half_void(dense: Path, path: Path) -> None:
    """Write a raster again of which the right half has no bytes."""
    with rasterio.open(dense) as source:
        profile = source.profile | {"nodata": -32768, "sparse_ok": True, "tiled": True}
        profile |= {"blockxsize": 256, "blockysize": 256}
        with rasterio.open(path, "w", **profile) as half:
            side = TASK_SIDE
            for row in range(0, source.height, side):
                n_rows = min(side, source.height - row)
                window = rasterio.windows.Window(0, row, side, n_rows)
                half.write(source.read(1, window=window), 1, window=window)


def seconds_of_a_call(n_calls: int = 1000) -> float:
    """Return what client and scheduler of dask, in this process, take for an empty task."""
    from distributed import Client as DaskClient
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster,
        DaskClient(cluster, set_as_default=False) as client,
    ):
        client.gather(client.map(abs, range(100), pure=False))
        start = time.process_time()
        client.gather(client.map(abs, range(n_calls), pure=False))
        return (time.process_time() - start) / n_calls


def measured_costs(dem: Path, folder: Path, tasks: list[dict]) -> Costs:
    """Return what tasks and the client take here."""
    runs = {}
    for n_on_side in (1, 3):
        raster = folder / f"dense-{n_on_side}.tif"
        make_mirrored(dem, raster, TASK_SIDE * n_on_side + 1)
        for _ in range(2):  # the first compiles
            found = run_inline(raster, folder)
        runs[n_on_side**2] = found
    half = folder / "half.tif"
    make_mirrored(dem, folder / "dense-2.tif", 2 * TASK_SIDE + 1)
    make_half_void(folder / "dense-2.tif", half)
    run = run_inline(half, folder)
    of_half = [report._asdict() for _, report in run.reports]
    dense, void = task_costs(tasks, is_void=False), task_costs(of_half, is_void=True)
    # What tasks with voids take longer, and a pass that others don't have.
    dense["averaging"] = task_costs(of_half, is_void=False)["averaging"]
    client = client_costs(runs)
    client["averaging"] = Client(result=gaps(run)["averaging"][1] / 4)
    return Costs(dense, void, client, seconds_of_a_call())


def plans(costs: Costs, rates: tuple[float, ...]) -> Iterator[Plan]:
    """Yield the plan of every raster for every number of workers and size of tasks."""
    for name, (n_rows, n_cols, share) in RASTERS.items():
        for larger in (1, LARGER):
            side = TASK_SIDE * larger
            n_tasks = -(-(n_rows - 1) // side) * -(-(n_cols - 1) // side)
            n_dense = round(share * n_tasks)
            for n_workers in WORKERS:
                site = Site(n_workers, n_workers, *rates)
                found = simulate(costs, n_dense, n_tasks - n_dense, site, larger)
                n_calls = n_tasks * (len(PASSES) - (share == 1))
                yield Plan(
                    name, side, n_workers, n_tasks, n_calls, round(found["seconds"] / 3600, 2),
                    round(found["serial"] / 3600, 2), round(found["busy"], 3),
                    round(found["client"] / 3600, 2), round(found["source"] / 1e12, 2),
                    round(found["written"] / 1e9, 1), round(found["read"] / 1e9, 1),
                )  # fmt: skip


def checks(costs: Costs, rows: list[dict], tasks: list[dict], n_cores: int) -> Iterator[Check]:
    """Yield measured runs beside the simulation of them: here, nothing is far."""
    for row in rows:
        run, n_tasks = row["run"], row["n_tasks"]
        if run[0].isdigit():
            n_workers = int(run[0])
            site = Site(n_workers, n_cores, 1e9, 1e9, 1e9)
            idle = simulate(costs, n_tasks, 0, site)["seconds"]
            own = [one for one in tasks if one["run"] == run]
            as_it_was = replace(costs, dense=task_costs(own, is_void=False, clock="seconds"))
            # The cores that they shared are in the seconds of the tasks.
            seconds = simulate(as_it_was, n_tasks, 0, replace(site, n_cores=n_workers))["seconds"]
            ratio = round(seconds / row["seconds"], 2)
            yield Check(
                run, n_tasks, row["seconds"], round(seconds, 1), ratio, round(idle, 1), row["load"]
            )


@common.command("cluster_plan.csv")
@common.dem_argument
@common.option("--link", type=common.COUNT, default=100, help="MB/s of each worker.")
@common.option("--source", type=common.COUNT, default=5000, help="MB/s that the source gives.")
@common.option("--depot", type=common.COUNT, default=2000, help="MB/s that the depot takes.")
@common.option("--latency", type=common.COUNT, default=20, help="ms of a request to the depot.")
@common.option("--cores", type=common.COUNT, default=2, help="Of the machine that measured.")
def main(
    dem: Path, link: int, source: int, depot: int, latency: int, cores: int, folder: Path, out: Path
) -> None:  # fmt: skip
    """Measure the client, simulate."""
    tasks = common.read_rows(out.with_name(TASKS_CSV))
    costs = measured_costs(dem, folder, [one for one in tasks if one["run"] == "1 worker"])
    runs = common.read_rows(out.with_name("scaling.csv"))
    common.write_rows(out.with_name(f"{out.stem}_check.csv"), checks(costs, runs, tasks, cores))
    rates = link * 1e6, source * 1e6, depot * 1e6, latency / 1e3
    common.write_rows(out, plans(costs, rates))


if __name__ == "__main__":
    main()
